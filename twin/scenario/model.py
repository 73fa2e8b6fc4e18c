"""The scenario as frozen models: every section and key with its unit, range and meaning."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from twin.core import geometry
from twin.core.records import SensorNoise, StereoRig
from twin.errors import TwinError

JERLOV = Literal["clear", "I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C"]
AIDING = Literal["pressure", "ahrs", "dvl", "usbl", "beacons"]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Metres = Annotated[float, Field(gt=0)]
Efficiency = Annotated[float, Field(gt=0, le=1)]
PerMetre = Annotated[float, Field(ge=0, le=100)]
OffAxis = Annotated[float, Field(ge=0, le=90)]
Share = Annotated[float, Field(ge=0, le=100)]


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _numbers_are_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        """A text or a truth value is no number, even where it could be read as one."""
        kind = cls.model_fields[info.field_name or ""].annotation
        if kind in (float, int) and isinstance(value, str | bool):
            raise PydanticCustomError("float_type" if kind is float else "int_type", "a number")
        return value


class TerrainConfig(Section):
    """The sea floor."""

    kind: Literal["flat", "ripples", "fractal", "reef", "file"] = Field(
        default="reef", description="generator, or a real DEM"
    )
    size_m: tuple[Metres, Metres] = Field(
        default=(10.0, 10.0), description="extent along x and y [m], centred at the origin"
    )
    relief_m: float = Field(default=0.6, ge=0, le=20, description="highest minus lowest point of a generated floor [m]")
    base_m: float = Field(
        default=0.0, ge=-50, le=50, description="height of the lowest point above the reference plane [m]"
    )
    grid_m: float = Field(default=0.05, gt=0.001, le=1, description="spacing of a generated height grid [m]")
    height_file: str | None = Field(
        default=None, description="DEM: GeoTIFF, 16-bit PNG or .npy [m]; ${TWIN_DATA} is expanded"
    )
    height_spacing_m: float = Field(
        default=0.01, gt=0, le=10, description="grid spacing of a PNG or .npy height file [m]"
    )
    height_range_m: float = Field(
        default=1.0, gt=0, le=1000, description="height of a PNG's full white over full black [m]"
    )
    texture_file: str | None = Field(
        default=None, description="any image, tiled over the floor; generated where missing"
    )
    texture_px_m: float = Field(default=0.005, gt=0.0005, le=1, description="size of a texture pixel on the floor [m]")


class VehicleConfig(Section):
    """BlueROV2 Heavy (von Benzon et al. 2022, Table A1); drag factors let a study vary it."""

    dynamics: Literal["rigid", "kinematic"] = Field(
        default="rigid",
        description="a hull under thrust, drag and current; or a carrier that moves level, at constant height and at "
        "exactly the commanded velocity, without any of them",
    )
    buoyancy_n: float = Field(
        default=1.0, ge=-20, le=20, description="net buoyancy after trimming, positive floats [N]"
    )
    drag_factor: float = Field(default=1.0, ge=0.05, le=20, description="scales linear and quadratic drag")
    added_mass_factor: float = Field(default=1.0, ge=0, le=5, description="scales the added mass")


class RigConfig(Section):
    """The calibrated stereo pair, looking down, the top of the image towards the bow."""

    image_width_px: int = Field(default=320, ge=64, le=2048)
    image_height_px: int = Field(default=240, ge=48, le=2048)
    hfov_deg: float = Field(default=60.0, gt=5, lt=150, description="horizontal field of view in water [deg]")
    baseline_m: float = Field(default=0.15, gt=0.005, le=3, description="distance between the cameras [m]")
    frame_rate_hz: float = Field(
        default=30.0, ge=5, le=120, description="images a second; the control loop swings on much fewer [Hz]"
    )
    mount_m: Vector3 = Field(
        default=(0.0, 0.0, -0.15), description="middle of the pair in the body: forward, left, up [m]"
    )


class ImagingConfig(Section):
    """How light becomes numbers."""

    fidelity: Literal["rendered", "surrogate"] = Field(
        default="rendered",
        description="images are rendered, or their measurements drawn from calibrated errors a hundred times faster",
    )
    error_model: str | None = Field(
        default=None, description="of the surrogate: a file that `twin fit-surrogate` wrote; the shipped one if none"
    )
    gray_level: float = Field(
        default=0.45, gt=0.01, lt=1, description="mean image level that auto-exposure aims at (0 to 1)"
    )
    noise_sd: float = Field(
        default=0.008, ge=0, le=0.5, description="read noise, as a share of full scale; without [sensor]"
    )
    shot_noise: float = Field(
        default=0.006,
        ge=0,
        le=0.5,
        description="shot noise at full scale, grows with the root of signal; without [sensor]",
    )
    shadows: bool = Field(default=False, description="the floor throws shadows in the light of each lamp")
    forward_scatter: bool = Field(
        default=False,
        description="light scattered forward on its way to the eye arrives as a blur that grows with range",
    )


class SensorConfig(Section):
    """A physical camera, in the terms of an EMVA 1288 data sheet; it takes the place of the noise in `imaging`.

    The defaults are typical of a colour machine-vision camera with a global shutter and pixels of 3.45 um.
    """

    exposure_min_ms: float = Field(default=0.05, gt=0, le=1000, description="shortest exposure [ms]")
    exposure_max_ms: float = Field(
        default=15.0, gt=0, le=1000, description="longest exposure, no longer than a frame; then gain makes up [ms]"
    )
    exposure_lag_s: float = Field(
        default=0.5, ge=0, le=60, description="time in which auto-exposure makes up for all but 1/e of a change [s]"
    )
    gain_max_db: float = Field(
        default=24.0, ge=0, le=60, description="largest analogue gain, 20 dB = 10 times; beyond it stays dark [dB]"
    )
    f_number: float = Field(default=2.8, ge=0.7, le=64, description="focal length by aperture of the lens")
    pixel_um: float = Field(default=3.45, ge=0.5, le=100, description="side of a square pixel [um]")
    quantum_efficiency: tuple[Efficiency, Efficiency, Efficiency] = Field(
        default=(0.4, 0.55, 0.45), description="electrons by photons for R, G, B, filters and lens included"
    )
    full_well_e: float = Field(
        default=10000.0, ge=100, le=1e7, description="electrons a pixel holds; they fill the scale at gain 1"
    )
    read_noise_e: float = Field(default=2.4, ge=0, le=1000, description="noise of reading a pixel, in the dark [e-]")
    bits: Literal[8, 12] = Field(default=12, description="of a raw digital number; frames leave with 8 in any case")
    bayer: bool = Field(default=True, description="one band a pixel (RGGB), the others interpolated; else all three")
    vignetting_power: float = Field(
        default=4.0, ge=0, le=8, description="light falls with this power of the cosine of the view; 4 by nature, 0 off"
    )
    motion_blur: bool = Field(default=True, description="what moves during the exposure is smeared")
    readout_ms: float = Field(
        default=0.0, ge=0, le=1000, description="rolling shutter: from the first row to the last; 0 = all at once [ms]"
    )


class LensConfig(Section):
    """True distortion of both lenses (Brown-Conrady as in OpenCV); frames are rectified by what is believed of it.

    The coefficients are of tangents in the air behind a port, in water where there is none.
    """

    k1: float = Field(default=0.0, ge=-2, le=2, description="radial distortion, of r^2")
    k2: float = Field(default=0.0, ge=-5, le=5, description="radial distortion, of r^4")
    k3: float = Field(default=0.0, ge=-10, le=10, description="radial distortion, of r^6")
    p1: float = Field(default=0.0, ge=-0.2, le=0.2, description="tangential distortion, along the columns")
    p2: float = Field(default=0.0, ge=-0.2, le=0.2, description="tangential distortion, along the rows")


class PortConfig(Section):
    """The window in front of each lens, which bends every ray twice.

    The rig's field of view is that of the pinhole in water which agrees with the image near the middle of a straight
    port, at every distance; the position of a camera is that pinhole's.
    """

    kind: Literal["none", "flat", "dome"] = Field(
        default="none", description="none: pinhole in water; flat pane; dome of concentric spheres"
    )
    thickness_m: float = Field(default=0.01, gt=0, le=0.2, description="of the glass [m]")
    distance_m: float = Field(
        default=0.02, gt=0, le=1, description="flat: from the entrance pupil of the lens to the glass [m]"
    )
    tilt_deg: float = Field(
        default=0.0, ge=-30, le=30, description="flat: turn about the image's rows, lower side away from the lens [deg]"
    )
    radius_m: float = Field(default=0.05, gt=0, le=1, description="dome: inner radius [m]")
    offset_m: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="dome: its centre from the entrance pupil: right, down, forward [m]"
    )
    glass_index: float = Field(default=1.49, ge=1, le=3, description="refractive index: acrylic 1.49, glass 1.52")
    water_index: float = Field(default=1.339, ge=1, le=2, description="refractive index of sea water")
    calibrated_at_m: float = Field(
        default=0.0, ge=0, le=100,
        description="frames are rectified for what lies at this depth, as by a calibration in water; 0 = the port is "
        "believed to be a change of focal length [m]",
    )  # fmt: skip


class CalibrationErrorConfig(Section):
    """Errors of calibration: by what the true cameras differ from those that the estimators believe in."""

    focal_error: float = Field(default=0.0, ge=-0.2, le=0.2, description="of both focal lengths, a share of it")
    left_principal_point_error_px: Vector2 = Field(
        default=(0.0, 0.0), description="of the left image: to the right, down [px]"
    )
    right_principal_point_error_px: Vector2 = Field(
        default=(0.0, 0.0), description="of the right image: to the right, down [px]"
    )
    baseline_error: float = Field(default=0.0, ge=-0.5, le=0.5, description="of the baseline, a share of it")
    right_roll_deg: float = Field(
        default=0.0, ge=-5, le=5, description="turn of the right camera about its axis, clockwise from behind [deg]"
    )
    right_pitch_deg: float = Field(default=0.0, ge=-5, le=5, description="turn of the right camera, upwards [deg]")
    right_yaw_deg: float = Field(
        default=0.0, ge=-5, le=5, description="turn of the right camera, away from the left one [deg]"
    )
    k1_error: float = Field(default=0.0, ge=-2, le=2, description="of the believed lens.k1: the true one less it")
    k2_error: float = Field(default=0.0, ge=-5, le=5, description="of the believed lens.k2: the true one less it")


class WaterConfig(Section):
    """Inherent optical properties of the water, for R, G, B: of a Jerlov type, or of your own."""

    jerlov: JERLOV = Field(default="IB", description="Jerlov water type, or clear (no attenuation, no scattering)")
    turbidity: float = Field(default=1.0, ge=0, le=100, description="multiplies scattering")
    absorption_per_m: tuple[PerMetre, PerMetre, PerMetre] | None = Field(
        default=None, description="absorption for R, G, B in place of the type's, with scattering_per_m [1/m]"
    )
    scattering_per_m: tuple[PerMetre, PerMetre, PerMetre] | None = Field(
        default=None, description="scattering for R, G, B in place of the type's, with absorption_per_m [1/m]"
    )
    spectrum_file: str | None = Field(
        default=None,
        description="CSV of wavelength [nm], absorption and scattering [1/m] in place of the type's; ${TWIN_DATA} is "
        "expanded",
    )
    mean_cosine: float = Field(
        default=0.924, ge=0, le=0.99, description="of the angle of scattering (Henyey-Greenstein's g); 0 = even"
    )
    kept_share: float = Field(
        default=0.0, ge=0, le=1,
        description="share k of scattered light that stays in the light on its way (multiple scattering): attenuation "
        "is a + (1 - k) b, from the beam's c (0) to absorption alone (1); 0.74 keeps what turns by less than 15 deg",
    )  # fmt: skip

    @property
    def label(self) -> str:
        """What the water is called."""
        own = "own values" if self.absorption_per_m else Path(self.spectrum_file).name if self.spectrum_file else ""
        return f"{own or self.jerlov}, turbidity {self.turbidity:g}"


class LampConfig(Section):
    """A lamp on the vehicle."""

    position_m: Vector3 = Field(description="in the body: forward, left, up [m]")
    tilt_deg: float = Field(
        default=0.0, ge=-90, le=90, description="beam axis from straight down towards the bow [deg]"
    )
    pan_deg: float = Field(default=0.0, ge=-90, le=90, description="beam axis from straight down towards port [deg]")
    intensity_cd: float = Field(default=1000.0, ge=0, le=1e6, description="luminous intensity on the axis [cd]")
    beam: tuple[tuple[OffAxis, Share], ...] = Field(
        default=(),
        description="pairs of angle off the axis [deg], from 0, and intensity as a share of that on it, straight "
        "between and dark beyond; empty = a measured LED",
    )
    colour_temperature_k: float = Field(
        default=6500.0, ge=1000, le=40000, description="of a black body; 6500 is white, intensity stays [K]"
    )


class SunConfig(Section):
    """Daylight from straight above."""

    illuminance_lx: float = Field(default=0.0, ge=0, le=2e5, description="white daylight [lx]")
    depth_m: float = Field(
        default=0.0, ge=0, le=500,
        description="of the reference plane z = 0 below the surface, where the daylight is told: the water takes from "
        "it on its way down; 0 = it is told on the floor, and even [m]",
    )  # fmt: skip
    caustics: float = Field(
        default=0.0, ge=0, le=1,
        description="share of the daylight that comes from the sun itself and is focused by waves; needs depth_m",
    )  # fmt: skip


class SnowConfig(Section):
    """Marine snow: white particles that drift with the current through the light."""

    density_per_m3: float = Field(default=0.0, ge=0, le=5000, description="particles in a cubic metre; 0 = none [1/m3]")
    diameter_m: float = Field(default=0.001, ge=0.0001, le=0.02, description="size of a particle [m]")
    albedo: float = Field(default=0.5, gt=0, le=1, description="brightness: share of the light that it sends back")


class CurrentConfig(Section):
    """Steady, irrotational current."""

    velocity_mps: Vector3 = Field(default=(0.0, 0.0, 0.0), description="east, north, up [m/s]")


class NavigationConfig(Section):
    """Navigation sensors: all are simulated; only those in `aiding` reach the estimators."""

    aiding: tuple[AIDING, ...] = Field(default=(), description="sensors that aid vision; empty = vision only")
    pressure_sigma_m: float = Field(default=0.01, gt=0, le=10, description="noise of height by pressure [m]")
    attitude_sigma_deg: float = Field(default=0.2, gt=0, le=30, description="noise of roll and pitch [deg]")
    heading_sigma_deg: float = Field(default=0.5, gt=0, le=90, description="noise of heading [deg]")
    dvl_sigma_mps: float = Field(
        default=SensorNoise.dvl_mps, gt=0, le=10, description="noise of each axis of the velocity over ground [m/s]"
    )
    dvl_scale_sigma: float = Field(
        default=SensorNoise.dvl_scale, gt=0, le=0.1, description="scale error of that velocity, drawn once a survey"
    )
    usbl_sigma_m: float = Field(
        default=SensorNoise.usbl_m, gt=0, le=100, description="noise of each axis of an acoustic position fix [m]"
    )
    usbl_interval_s: float = Field(
        default=1.0, gt=0, le=3600, description="least time between acoustic fixes, each taken at a keyframe [s]"
    )
    beacon_sigma_px: float = Field(
        default=SensorNoise.beacon_px, gt=0, le=50, description="noise of a beacon's column and row in the image [px]"
    )


class BeaconConfig(Section):
    """A small light at a surveyed position."""

    position_m: Vector3 = Field(description="in the world: east, north, up [m]")


class PlanConfig(Section):
    """The survey to fly (Negahdaripour & Madjidi 2003, sections III and III-A)."""

    pattern: Literal["lawnmower", "loops"] = Field(
        default="lawnmower", description="parallel legs, or loops that cross at the start in the middle of a disc"
    )
    area_m: tuple[Metres, Metres] = Field(
        default=(4.0, 2.0),
        description="extent along x (the legs) and y, centred; of loops both are the diameter of the disc [m]",
    )
    altitude_m: float = Field(
        default=2.2, gt=0, le=100, description="height of the cameras above the reference plane z = 0 [m]"
    )
    speed_mps: float = Field(
        default=0.25, gt=0.01, le=2, description="speed along legs and loops; on tight loops less [m/s]"
    )
    overlap_along: float = Field(default=0.9, gt=0, lt=1, description="overlap of consecutive keyframes")
    overlap_across: float = Field(default=0.8, gt=0, lt=1, description="overlap of neighbouring swaths")
    tracks: int = Field(
        default=0, ge=0, le=1000, description="tracks to fly (two legs or a loop each); 0 fills the area"
    )
    clearance_m: float = Field(default=0.3, ge=0, le=10, description="least distance of the cameras to the floor [m]")


class ControlConfig(Section):
    """Trajectory following and station keeping."""

    hold_s: float = Field(
        default=2.0, ge=0.1, le=600, description="station keeping at the end of a track, while GA runs [s]"
    )
    natural_frequency_radps: float = Field(default=1.2, gt=0.05, le=10, description="closed-loop bandwidth [rad/s]")


class EstimateConfig(Section):
    """F2F, F2M, the keyframe network and global alignment."""

    window_tracks: int = Field(
        default=4, ge=0, le=1000, description="previous tracks in the window of global alignment"
    )
    node_stride: int = Field(default=1, ge=1, le=20, description="every n-th keyframe is a node of the network")
    min_overlap: float = Field(default=0.45, gt=0, lt=1, description="least true overlap of linked nodes")
    max_links: int = Field(default=7, ge=1, le=50, description="most links of a node to earlier ones")
    use_f2m: bool = Field(default=True, description="correct the position at keyframes by registration with the mosaic")
    use_ga: bool = Field(default=True, description="global alignment at the end of each track and of the survey")
    points: int = Field(default=500, ge=30, le=5000, description="most matched points of a keyframe")
    patch_px: int = Field(default=11, ge=7, le=61, description="window of matching, one for stereo and flow alike [px]")


class MapConfig(Section):
    """The Kalman depth map and its composition."""

    cell_m: float = Field(default=0.02, gt=0.001, le=1, description="cell of the elevation map [m]")


class Source(BaseModel):
    """Where a scenario came from, so that a fault found later can still be told with file and line."""

    path: Path
    lines: dict[str, int] = {}
    overrides: tuple[str, ...] = ()

    def fault(self, error: TwinError) -> str:
        """`FILE:LINE: key: what is wrong (allowed: ...)`; the line is of the nearest enclosing key that is there."""
        if any(o.split("=", 1)[0].strip().replace('"', "") == error.field for o in self.overrides):
            return f"--set: {error}"
        key = error.field
        while key not in self.lines and "." in key:
            key = key.rpartition(".")[0]
        return f"{self.path}:{self.lines.get(key, 1)}: {error}"


class Scenario(Section):
    """One survey, fully described."""

    name: str = Field(default="survey", min_length=1, max_length=80)
    seed: int = Field(default=0, ge=0, lt=2**32)
    terrain: TerrainConfig = TerrainConfig()
    vehicle: VehicleConfig = VehicleConfig()
    rig: RigConfig = RigConfig()
    imaging: ImagingConfig = ImagingConfig()
    sensor: SensorConfig | None = Field(
        default=None, description="a physical camera instead of noise by shares of full scale"
    )
    lens: LensConfig = LensConfig()
    port: PortConfig = PortConfig()
    calibration_error: CalibrationErrorConfig = CalibrationErrorConfig()
    water: WaterConfig = WaterConfig()
    lamps: tuple[LampConfig, ...] = ()
    sun: SunConfig = SunConfig()
    snow: SnowConfig = SnowConfig()
    current: CurrentConfig = CurrentConfig()
    navigation: NavigationConfig = NavigationConfig()
    plan: PlanConfig = PlanConfig()
    control: ControlConfig = ControlConfig()
    estimate: EstimateConfig = EstimateConfig()
    map: MapConfig = MapConfig()
    beacons: tuple[BeaconConfig, ...] = ()
    require: dict[str, float] = Field(default={}, description='limits on metrics, e.g. "map.le90_m" = 0.05')

    _source: Source = PrivateAttr(default_factory=lambda: Source(path=Path("scenario")))

    @property
    def source(self) -> Source:
        """Where the scenario was read, for faults that are found later."""
        return self._source

    def believed_rig(self) -> StereoRig:
        """The rig's calibration as the estimators know it."""
        rig = self.rig
        focal_px = rig.image_width_px / 2 / float(_tan_deg(rig.hfov_deg / 2))
        forward, left, up = rig.mount_m
        position = [forward, left + rig.baseline_m / 2, up]
        return StereoRig(
            rig.image_width_px,
            rig.image_height_px,
            focal_px,
            rig.baseline_m,
            rig.frame_rate_hz,
            geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array(position)),
        )

    def believed_noise(self) -> SensorNoise:
        """The navigation sensors' data sheet and the survey of the beacons as the estimators know them."""
        navigation = self.navigation
        return SensorNoise(
            navigation.pressure_sigma_m,
            float(np.deg2rad(navigation.attitude_sigma_deg)),
            float(np.deg2rad(navigation.heading_sigma_deg)),
            navigation.dvl_sigma_mps,
            navigation.dvl_scale_sigma,
            navigation.usbl_sigma_m,
            navigation.beacon_sigma_px,
            tuple(beacon.position_m for beacon in self.beacons),
        )

    def fingerprint(self) -> str:
        """Hash of the resolved scenario: equal hash and seed, equal survey."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]


def _tan_deg(angle_deg: float) -> float:
    return float(np.tan(np.deg2rad(angle_deg)))
