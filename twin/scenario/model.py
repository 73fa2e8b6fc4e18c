"""Data model of a scenario: every section and key with its unit, range and meaning."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import fields
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_type_hints

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    Strict,
    ValidationInfo,
    create_model,
    field_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError

from twin.core import geometry
from twin.core.records import ImuErrorModel, SensorNoise, StereoRig
from twin.core.refraction import FlatPort
from twin.core.settings import EstimatorSettings
from twin.core.user_files import path_problem
from twin.errors import TwinError
from twin.scenario.water_sources import WATER_SOURCES, WaterSourceName

FINEST_TEXEL_M, COARSEST_TEXEL_M = 0.0006, 0.005  #: limits of the default size of a texel [m]
SEA_WATER_INDEX = 1.339  #: refractive index of sea water in visible light
PLUGIN_NAME = r"^[\w.-]+(:[\w.]+)?$"  #: module:Class, or the name of an entry point
_CALIBRATION_STREAM = 7311  # of random numbers, for the calibration error of a dive
_VISIBLE_NOISE = 1e-4  # noise that changes an 8-bit image, a fraction of full scale
JERLOV = Literal["clear", "I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C"]
AIDING = Literal["pressure", "ahrs", "dvl", "usbl", "beacons", "imu"]


Number = Annotated[float, Strict()]  #: no text and no Booleans
Coordinate = Annotated[Number, Field(ge=-1e5, le=1e5)]
Vector2 = tuple[Coordinate, Coordinate]
Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Metres = Annotated[Number, Field(gt=0, le=1e5)]
Efficiency = Annotated[Number, Field(gt=0, le=1)]
Positive = Annotated[Number, Field(gt=0, le=1e6)]
Coefficient = Annotated[Number, Field(ge=0, le=1e6)]
SixCoefficients = tuple[Coefficient, Coefficient, Coefficient, Coefficient, Coefficient, Coefficient]
SixNumbers = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
Matrix6 = tuple[SixNumbers, SixNumbers, SixNumbers, SixNumbers, SixNumbers, SixNumbers]
PerMetre = Annotated[Number, Field(ge=0, le=100)]
OffAxisDeg = Annotated[Number, Field(ge=0, le=90)]
LongitudeDeg = Annotated[Number, Field(ge=-180, le=360)]
LatitudeDeg = Annotated[Number, Field(ge=-90, le=90)]
WhiteGain = Annotated[Number, Field(ge=1, le=16)]
Latency = Annotated[Number, Field(ge=0, le=5)]
BlurPx = Annotated[Number, Field(ge=0, le=2)]
LateralColour = Annotated[Number, Field(ge=-0.02, le=0.02)]
ObjectNumber = Annotated[int, Field(ge=0, lt=20_000)]
Albedo = Annotated[Number, Field(ge=0, le=1)]
RelativeIntensity = Annotated[Number, Field(ge=0, le=100)]


def _path(text: str) -> str:
    if problem := path_problem(Path(text)):
        raise PydanticCustomError("path", "a path; it {problem}", {"problem": problem})
    return text


FilePath = Annotated[str, AfterValidator(_path)]


def _instant(text: str) -> str:
    try:
        datetime.strptime(text, "%Y-%m-%dT%H:%M")
    except ValueError:
        raise PydanticCustomError("instant", "an instant in UTC, as 2026-05-01T06:00") from None
    return text


Instant = Annotated[str, AfterValidator(_instant)]


_NUMBER_KINDS: dict[Any, Literal["int_type", "float_type"]] = {
    int: "int_type", int | None: "int_type", float: "float_type", float | None: "float_type",
}  # fmt: skip


def _refuse_model(value: str | None) -> str | None:
    """Refuses a model that has not been read from its file: in a file of its kind, or in Python."""
    if value is not None:
        raise PydanticCustomError("model", "none here: twin.load_scenario reads the file of a model")
    return value


ModelFile = Annotated[str | None, AfterValidator(_refuse_model)]


class Section(BaseModel):
    """Base class of the sections, which are immutable and reject unknown keys, NaN and infinity.

    The text below a key describes it in the schema and in docs/reference.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Returns a copy with some fields changed, validated like new values; raises ValidationError."""
        copied = super().model_copy(deep=deep)
        if update:
            changed = type(self).model_validate({**vars(self), **update})
            object.__setattr__(copied, "__dict__", vars(changed))
            object.__setattr__(copied, "__pydantic_fields_set__", self.model_fields_set | set(update))
        return copied

    @field_validator("*", mode="before")
    @classmethod
    def _require_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuses text and Booleans where a number is required; the items of a list are checked by `Number`."""
        kind = _NUMBER_KINDS.get(cls.model_fields[info.field_name or ""].annotation)
        if kind and isinstance(value, str | bool):
            raise PydanticCustomError(kind, "a number")
        return value

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        found = handler(schema)
        for key in handler.resolve_ref_schema(found)["properties"].values():
            if "description" in key:
                key["description"] = " ".join(key["description"].split())
        return found


class TerrainConfig(Section):
    """Sea floor."""

    kind: Literal["flat", "ripples", "fractal", "reef", "cliffs", "file", "mesh"] = "reef"
    """generator of the heights, file for a measured DEM, or mesh for the triangles of mesh_file, which may overhang"""
    plugin: str | None = Field(default=None, max_length=200, pattern=PLUGIN_NAME)
    """generator of another package for the heights, which replaces that of kind and its relief_m and base_m:
    module:Class, or the name of an entry point twin.terrains; it runs code of that package"""
    size_m: tuple[Metres, Metres] = (10.0, 10.0)
    """extent along x and y, centred at the origin [m]"""
    relief_m: float = Field(default=0.6, ge=0, le=20)
    """highest minus lowest point of a generated sea floor [m]"""
    base_m: float = Field(default=0.0, ge=-50, le=50)
    """height of the lowest point above the reference plane z = 0 [m]"""
    grid_m: float = Field(default=0.05, gt=0.001, le=1)
    """spacing of a generated height grid; of the height grid on which the survey of a mesh is planned, the largest
    spacing: with shorter edges of the mesh it is finer, with more than 2 million nodes coarser [m]"""
    mesh_file: FilePath | None = None
    """PLY, OBJ or GLB file with a texture or vertex colours that is the whole sea floor, centred at the origin, its
    lowest point at z = 0; needs kind = mesh; ${TWIN_DATA} is expanded"""
    mesh_up: Literal["z", "y"] | None = None
    """axis of mesh_file that points up; default: y for GLB, z for other files"""
    mesh_scale: float = Field(default=1.0, ge=1e-4, le=1e4)
    """metres per unit of mesh_file"""
    height_file: FilePath | None = None
    """DEM: GeoTIFF, ESRI grid (.asc) with its .prj, XYZ grid, 16-bit PNG or .npy; in metres unless a GeoTIFF names
    another unit; ${TWIN_DATA} is expanded"""
    height_spacing_m: float = Field(default=0.01, gt=0, le=10)
    """grid spacing of a PNG or .npy height file [m]"""
    height_range_m: float = Field(default=1.0, gt=0, le=1000)
    """height of full white above full black in a PNG height file [m]"""
    z: Literal["up", "down"] | None = None
    """direction of growing values of height_file: up, or down for depths; default: found from the file, or an error"""
    prior: Literal["floor", "none"] = "floor"
    """what is known of the sea floor before the survey, over which it is planned. floor: its heights, those of
    prior_file, or the true ones with prior_smoothing_m and prior_offset_m; none: only its height at the start"""
    prior_file: FilePath | None = None
    """DEM that is known before the survey, in the CRS and the vertical datum of height_file; ${TWIN_DATA} is expanded;
    default: height_file itself"""
    prior_smoothing_m: float = Field(default=0.0, ge=0, le=1000)
    """standard deviation of the Gaussian filter by which the known heights are smoother than the true ones [m]"""
    prior_offset_m: float = Field(default=0.0, ge=-20, le=20)
    """known heights minus true ones, a constant [m]"""
    cover: Literal["sand", "rubble", "rock", "reef", "coral", "seagrass", "mud"] | None = None
    """materials of a generated texture; reef: sand, rubble, rock and coral by height and slope; coral: sand, fragments
    of coral and rock with crustose algae; default: that of the kind of floor; not with texture_file"""
    texture_file: FilePath | None = None
    """photo of a piece of sea floor, which becomes the texture; default: a generated one"""
    texture_tiling: Literal["stochastic", "repeat"] = "stochastic"
    """stochastic: the texture is made of pieces of the photo, evenly lit, without visible repetition; repeat: the photo
    is repeated unchanged; needs texture_file"""
    orthophoto_file: FilePath | None = None
    """colour GeoTIFF in any CRS that is laid over the texture of a height file with coordinates"""
    texture_px_m: float | None = Field(default=None, gt=0.0005, le=1)
    """size of a texture pixel, and of a pixel of the photo, on the sea floor [m]; default: 0.005, or without a photo
    the ground sample distance of the images at plan.altitude_m, 0.0006 to 0.005; larger on a sea floor that would have
    more than 40 million texture pixels"""
    wall_texture: Literal["triplanar", "draped"] = "triplanar"
    """texture of slopes of more than 50 deg. triplanar: projected horizontally, with the detail of level ground, and
    blended with the texture from above up to 65 deg; wherever orthophoto_file has data, its colours stay. draped: the
    texture from above, stretched on slopes. Not with a mesh"""
    material: Literal["lambert", "oren_nayar", "hapke"] = "lambert"
    """reflection of the light of lamps. lambert: ideally diffuse; oren_nayar: rough, brighter towards the light; hapke:
    a layer of grains with an opposition effect. The texture is the albedo"""
    roughness_deg: float = Field(default=20.0, ge=0, le=60)
    """standard deviation of the slopes too small for the height grid; oren_nayar only [deg]"""
    specular: float = Field(default=0.0, ge=0, le=1)
    """fraction of the light of lamps mirrored in highlights (wet, metallic floors); the material reflects the rest"""
    specular_width_deg: float = Field(default=15.0, ge=2, le=45)
    """width of the highlights: slope of the mirroring facets (GGX) [deg]"""


class ThrusterConfig(Section):
    """Thruster of a vehicle, in the axes of the body: forward, left, up from the centre of gravity."""

    position_m: Vector3
    """position in the body [m]"""
    direction: Vector3
    """direction of positive thrust in the body; its length is irrelevant"""

    @field_validator("direction")
    @classmethod
    def _require_length(cls, value: Vector3) -> Vector3:
        if not any(value):
            raise PydanticCustomError("direction", "a vector that is not zero")
        return value


def _rising(table: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    commands, thrusts = [row[0] for row in table], [row[1] for row in table]
    rising = all(a < b for a, b in pairwise(commands)) and all(a <= b for a, b in pairwise(thrusts))
    if not (rising and commands and commands[0] == -1 and commands[-1] == 1 and thrusts[0] < 0 < thrusts[-1]):
        raise PydanticCustomError("thrust_table", "increasing pairs from command -1 (thrust below 0) to 1 (above 0)")
    return table


class ThrustCurveConfig(Section):
    """Thrust at rest and electrical power of a thruster at one supply voltage."""

    voltage_v: Positive
    """supply voltage [V]"""
    table: Annotated[tuple[tuple[Number, Number, Coefficient], ...], AfterValidator(_rising)] = Field(max_length=1000)
    """commands from -1 to 1, thrusts [N] and powers [W], interpolated linearly"""


class FinConfig(Section):
    """Fin or lifting part of a hull, in the axes of the body; its chord is along the x axis at an angle of 0.

    Movable fins have commands in [-1, 1], which follow those of the thrusters, in the order of the fins.
    """

    position_m: Vector3
    """centre of pressure in the body [m]"""
    lift_direction_deg: float = Field(ge=-180, le=180)
    """direction of the lift at a positive angle, from left (0: a rudder) towards up (90: an elevator) [deg]"""
    area_m2: Positive
    """planform area [m2]"""
    lift_slope_per_rad: Positive
    """slope of the lift coefficient over the angle of attack [1/rad]"""
    stall_deg: float = Field(default=15.0, gt=0, le=90)
    """angle of attack beyond which the coefficient of the force across the chord stays constant [deg]"""
    max_deg: float = Field(default=0.0, ge=0, le=45)
    """angle at a command of 1; 0: a fixed fin, without a command [deg]"""
    lag_s: float = Field(default=0.1, gt=0, le=5)
    """time constant with which the angle follows the command [s]"""


#: Position and direction of the thrusters of the BlueROV2 Heavy: four vectored at 45 deg, then four vertical ones.
_HEAVY_THRUSTERS = (
    ((0.156, -0.111, -0.085), (1.0, 1.0, 0.0)),
    ((0.156, 0.111, -0.085), (1.0, -1.0, 0.0)),
    ((-0.156, -0.111, -0.085), (1.0, -1.0, 0.0)),
    ((-0.156, 0.111, -0.085), (1.0, 1.0, 0.0)),
    ((0.12, -0.218, 0.0), (0.0, 0.0, 1.0)),
    ((0.12, 0.218, 0.0), (0.0, 0.0, 1.0)),
    ((-0.12, -0.218, 0.0), (0.0, 0.0, 1.0)),
    ((-0.12, 0.218, 0.0), (0.0, 0.0, 1.0)),
)


class VehicleConfig(Section):
    """Vehicle; the defaults are those of scenes/vehicles/bluerov2_heavy.toml (von Benzon et al. 2022, Table A1).

    Axes of the body: forward, left, up, from the centre of gravity; they are principal axes of inertia. Six values are
    those of surge, sway, heave, roll, pitch and yaw.
    """

    model: ModelFile = Field(default=None, min_length=1, max_length=500)
    """name of a vehicle in scenes/vehicles, or its file. It replaces the vehicle of the files that this file extends;
    further keys of this file change single values"""
    title: str = Field(default="BlueROV2 Heavy", max_length=80)
    """name of the vehicle for reports"""
    dynamics: Literal["rigid", "kinematic"] = "rigid"
    """rigid: a rigid body under thrust, drag and current; kinematic: stays level at constant height, keeps its heading
    and moves exactly at the commanded horizontal velocity, without forces"""
    buoyancy_n: float = Field(default=1.0, ge=-20, le=20)
    """buoyancy minus weight after trimming, positive upwards [N]"""
    drag_factor: float = Field(default=1.0, ge=0.05, le=20)
    """multiplies linear and quadratic drag; the controller does not know it"""
    added_mass_factor: float = Field(default=1.0, ge=0, le=5)
    """multiplies the added mass; the controller does not know it"""
    mass_kg: float = Field(default=13.5, gt=0.1, le=1e5)
    """mass in air [kg]"""
    inertia_kgm2: tuple[Positive, Positive, Positive] = (0.26, 0.23, 0.37)
    """moments of inertia about the axes of the body [kg m2]"""
    centre_of_buoyancy_m: Vector3 = (0.0, 0.0, 0.01)
    """centre of buoyancy in the body [m]"""
    added_mass: SixCoefficients = (6.36, 7.12, 18.68, 0.189, 0.135, 0.222)
    """diagonal of the added mass matrix [kg, kg m2]"""
    added_mass_matrix: Matrix6 | None = None
    """full added mass matrix, symmetric; replaces added_mass [kg, kg m, kg m2]"""
    linear_drag: SixCoefficients = (13.7, 0.0, 33.0, 0.0, 0.8, 0.0)
    """coefficients of drag proportional to the velocity [N s/m, N m s/rad]"""
    linear_drag_matrix: Matrix6 | None = None
    """full matrix of linear drag, positive on its diagonal; replaces linear_drag"""
    quadratic_drag: SixCoefficients = (141.0, 217.0, 190.0, 1.19, 0.47, 1.5)
    """coefficients of drag proportional to the square of the velocity [N s2/m2, N m s2/rad2]"""
    quadratic_drag_matrix: Matrix6 | None = None
    """full matrix of quadratic drag: column j multiplies v_j |v_j|; replaces quadratic_drag"""
    drag_centre_m: Vector3 = (0.0, 0.0, 0.0)
    """centre of drag in the body: drag acts there, by the velocity of the water relative to this point [m]"""
    thrusters: tuple[ThrusterConfig, ...] = Field(
        default=tuple(ThrusterConfig(position_m=at, direction=along) for at, along in _HEAVY_THRUSTERS),
        min_length=1,
        max_length=32,
    )
    """thrusters, in the order of the commands"""
    fins: tuple[FinConfig, ...] = Field(default=(), max_length=32)
    """fins; a vehicle with movable fins is steered by them: it has a minimum speed and a turning radius"""
    thrust_coefficients: tuple[Number, ...] = Field(default=(-140.3, 389.9, -404.1, 176.0, 8.9), max_length=12)
    """thrust at rest [N] of a command u from -1 to 1: coefficients of an odd polynomial, that of the highest power
    first; unused with thrust_table"""
    thrust_table: tuple[tuple[Number, Number], ...] = Field(default=(), max_length=1000)
    """thrust at rest: pairs of command and thrust [N], interpolated linearly; replaces thrust_coefficients"""
    thrust_curves: tuple[ThrustCurveConfig, ...] = Field(default=(), max_length=32)
    """thrust and power at different supply voltages; used with voltage_v"""
    voltage_v: float | None = None
    """supply voltage, for which thrust and power are interpolated linearly between thrust_curves; they replace
    thrust_table, thrust_coefficients and power_coefficient; default: these hold [V]"""
    thruster_lag: tuple[tuple[Number, ...], tuple[Number, ...]] = ((6136.0, 108700.0), (1.0, 89.0, 9258.0, 108700.0))
    """transfer function from steady to actual thrust: coefficients of numerator and denominator, that of the highest
    power of s first"""
    power_coefficient: float = Field(default=0.96, gt=0, le=100)
    """electrical power of a thruster / its thrust to the power 1.5 [W/N^1.5]; 0.96: T200 at 14 V"""
    hotel_w: float = Field(default=40.0, ge=0, le=1e5)
    """power of computer, cameras, sensors and lamps [W]"""
    battery_wh: float = Field(default=266.0, gt=0, le=1e6)
    """energy of the battery; `twin vehicle` leaves a fifth as a reserve [W h]"""
    size_m: tuple[Metres, Metres, Metres] = (0.457, 0.575, 0.254)
    """length, width and height of the box that stands for the hull in contacts [m]"""
    hull_centre_m: Vector3 = (0.0, 0.0, -0.03)
    """centre of this box in the body [m]"""

    @field_validator("added_mass_matrix")
    @classmethod
    def _require_inertia(cls, value: Matrix6 | None) -> Matrix6 | None:
        matrix = np.array(np.eye(6) if value is None else value)
        if not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix).min() < -1e-9:
            raise PydanticCustomError("added_mass_matrix", "a symmetric matrix without negative eigenvalues")
        return value

    @field_validator("linear_drag_matrix", "quadratic_drag_matrix")
    @classmethod
    def _require_resistance(cls, value: Matrix6 | None) -> Matrix6 | None:
        if value is not None and min(np.diag(np.array(value))) < 0:
            raise PydanticCustomError("drag_matrix", "a matrix with a diagonal of 0 or more: drag resists motion")
        return value

    @field_validator("fins")
    @classmethod
    def _require_thrust_ahead(cls, value: tuple[FinConfig, ...], info: ValidationInfo) -> tuple[FinConfig, ...]:
        ahead = all(thruster.direction[0] > 0 for thruster in info.data.get("thrusters", ()))
        if any(fin.max_deg > 0 for fin in value) and not ahead:
            raise PydanticCustomError("fins", "movable fins only with thrusters that all push forwards")
        return value

    @field_validator("thrust_coefficients")
    @classmethod
    def _require_thrust(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not sum(value) > 0:
            raise PydanticCustomError(
                "thrust", "coefficients of a thrust above 0 at full command: their sum is above 0"
            )
        return value

    @field_validator("thrust_table")
    @classmethod
    def _require_increasing(cls, value: tuple[tuple[float, float], ...]) -> Any:
        return value and _rising(value)

    @field_validator("voltage_v")
    @classmethod
    def _require_curves(cls, value: float | None, info: ValidationInfo) -> float | None:
        known = [curve.voltage_v for curve in info.data.get("thrust_curves", ())]
        if value is not None and (known != sorted(set(known)) or not known or not known[0] <= value <= known[-1]):
            raise PydanticCustomError(
                "voltage", "within those of thrust_curves, which increase: {known}", {"known": known}
            )
        return value

    @field_validator("thruster_lag")
    @classmethod
    def _require_unit_gain(cls, value: tuple[tuple[float, ...], tuple[float, ...]]) -> Any:
        numerator, denominator = value
        proper = 1 <= len(numerator) < len(denominator) and denominator[0] != 0 and denominator[-1] != 0
        if not proper or not math.isclose(numerator[-1], denominator[-1]):
            raise PydanticCustomError("lag", "a strictly proper transfer function with a gain of 1 at rest")
        if (np.roots(denominator).real >= 0).any():
            raise PydanticCustomError("lag", "a stable transfer function")
        return value

    @property
    def n_commands(self) -> int:
        """Returns the number of commands of a rigid vehicle: one per thruster, then one per movable fin."""
        return len(self.thrusters) + sum(fin.max_deg > 0 for fin in self.fins)

    @property
    def is_steered_by_fins(self) -> bool:
        return self.dynamics == "rigid" and any(fin.max_deg > 0 for fin in self.fins)


class RigConfig(Section):
    """Calibrated stereo pair that looks down, with the top of the image towards the bow."""

    model: ModelFile = Field(default=None, min_length=1, max_length=500)
    """name of a rig in scenes/rigs, or its file: cameras, sensor, lens, port, calibration error and lamps. They replace
    those of the files that this file extends; further keys of this file change single values"""
    title: str = Field(default="", max_length=80)
    """name of the rig for reports, set by model"""
    image_width_px: int = Field(default=320, ge=64, le=4096)
    """image width [px]"""
    image_height_px: int = Field(default=240, ge=48, le=4096)
    """image height [px]"""
    hfov_deg: float = Field(default=60.0, gt=5, lt=150)
    """horizontal field of view in water [deg]"""
    baseline_m: float = Field(default=0.15, gt=0.005, le=3)
    """distance between the cameras [m]"""
    frame_rate_hz: float = Field(default=30.0, ge=5, le=120)
    """rate of frames and commands; at low rates the control oscillates [Hz]"""
    mount_m: Vector3 = (0.0, 0.0, -0.15)
    """midpoint of the cameras in the body frame: forward, left, up [m]"""


#: How light is scattered: see `imaging.scattering`.
ScatteringModel = Literal["full", "single", "none"]


class ImagingConfig(Section):
    """Image formation."""

    fidelity: Literal["rendered", "surrogate"] = "rendered"
    """rendered: images are rendered and matched; surrogate: measurements of a fitted error model, 100 times faster"""
    error_model: FilePath | None = None
    """error model of the surrogate, written by `twin fit-surrogate`; default: built-in"""
    extrapolate: bool = False
    """run a surrogate survey outside the fitted range of its error model, with a warning; set by --extrapolate"""
    gray_level: float = Field(default=0.45, gt=0.01, lt=1)
    """target of auto-exposure: mean image level, a fraction of full scale"""
    noise_sd: float = Field(default=0.008, ge=0, le=0.5)
    """read noise (1 sigma), a fraction of full scale; unused with [sensor]"""
    shot_noise: float = Field(default=0.006, ge=0, le=0.5)
    """shot noise (1 sigma) at full scale, a fraction of it; grows as the root of the signal; unused with [sensor]"""
    shadows: bool = True
    """the sea floor and objects cast shadows in the light of lamps and sun"""
    scattering: ScatteringModel = "full"
    """full: multiple scattering softens the beams, blurs the image and brightens the backscatter; single: light
    scattered once is the backscatter, that of daylight as for a level camera at the planned height below a sun at the
    zenith, other scattered light is lost; none: the water only absorbs"""


class SensorConfig(Section):
    """Physical image sensor in the terms of an EMVA 1288 data sheet; replaces the noise of [imaging].

    The defaults are typical of a colour machine-vision camera with a global shutter and 3.45 um pixels.
    """

    exposure_min_ms: float = Field(default=0.05, gt=0, le=1000)
    """shortest exposure time [ms]"""
    exposure_max_ms: float = Field(default=15.0, gt=0, le=1000)
    """longest exposure time, at most the frame interval; in less light the gain is raised [ms]"""
    exposure_lag_s: float = Field(default=0.5, ge=0, le=60)
    """time constant (1/e) of auto-exposure [s]"""
    gain_max_db: float = Field(default=24.0, ge=0, le=60)
    """largest analogue gain; 20 dB is a factor of 10 [dB]"""
    f_number: float = Field(default=2.8, ge=0.7, le=64)
    """focal length divided by aperture diameter"""
    pixel_um: float = Field(default=3.45, ge=0.5, le=100)
    """side of a square pixel [um]"""
    quantum_efficiency: tuple[Efficiency, Efficiency, Efficiency] = (0.4, 0.55, 0.45)
    """electrons per photon for R, G, B, including filters and lens"""
    full_well_e: float = Field(default=10000.0, ge=100, le=1e7)
    """full-well capacity, which is full scale at gain 1 [e-]"""
    read_noise_e: float = Field(default=2.4, ge=0, le=1000)
    """read noise of a pixel (1 sigma) [e-]"""
    bits: Literal[8, 12] = 12
    """bit depth of the analogue-to-digital converter; delivered images have 8 bits"""
    bayer: bool = True
    """Bayer filter (RGGB) with interpolated colours; false: three bands per pixel"""
    vignetting_power: float = Field(default=4.0, ge=0, le=8)
    """irradiance falls with this power of the cosine of the field angle; 4: natural vignetting, 0: none"""
    shading_correction: bool = False
    """the camera divides its images by the vignetting, as with a flat field; it amplifies the noise near the borders"""
    motion_blur: bool = True
    """motion during the exposure blurs the image"""
    readout_ms: float = Field(default=0.0, ge=0, le=1000)
    """rolling shutter: first to last row; 0 is a global shutter [ms]"""
    tone_curve: Literal["linear", "srgb", "log"] = "linear"
    """level of the delivered image as a function of the signal: proportional; sRGB (IEC 61966-2-1); or logarithmic over
    6 stops; imaging.gray_level is the level after the curve"""
    white_balance: Literal["white_light", "gains", "grey_world", "temperature", "water"] = "white_light"
    """what appears grey: a grey surface in white light; gains: white_gains are set by hand; grey_world: the mean of the
    image; temperature: a grey surface in light of white_temperature_k; water: a grey floor seen from the planned
    altitude in the water of the scenario"""
    white_gains: tuple[WhiteGain, WhiteGain, WhiteGain] = (1.0, 1.0, 1.0)
    """gains: factors of the raw signals R, G, B"""
    white_temperature_k: float = Field(default=6500.0, ge=1000, le=40000)
    """temperature: colour temperature of the light [K]"""


class LensConfig(Section):
    """True distortion (Brown-Conrady, as in OpenCV), blur and lateral colour of both lenses.

    Images are rectified with calibrated coefficients, which differ from the true ones by `calibration_error.k1_error`
    and `k2_error`. The image coordinates of the model are normalised coordinates in the air behind the port, or in
    water if there is no port.
    """

    k1: float = Field(default=0.0, ge=-2, le=2)
    """radial distortion, coefficient of r^2"""
    k2: float = Field(default=0.0, ge=-5, le=5)
    """radial distortion, coefficient of r^4"""
    k3: float = Field(default=0.0, ge=-10, le=10)
    """radial distortion, coefficient of r^6"""
    p1: float = Field(default=0.0, ge=-0.2, le=0.2)
    """tangential distortion along the columns"""
    p2: float = Field(default=0.0, ge=-0.2, le=0.2)
    """tangential distortion along the rows"""
    diffraction: bool = False
    """blur by diffraction at sensor.f_number; needs [sensor]"""
    blur_px: tuple[BlurPx, BlurPx, BlurPx] = (0.0, 0.0, 0.0)
    """blur by aberrations: standard deviation of a Gaussian point spread function for R, G, B [px]"""
    lateral_colour: tuple[LateralColour, LateralColour] = (0.0, 0.0)
    """magnification of the images in R and in B relative to that in G, minus 1"""
    focus_m: float = Field(default=0.0, ge=0, le=1000)
    """depth in focus; the aperture (sensor.f_number) blurs others; 0: all are in focus; needs [sensor] [m]"""


class PortConfig(Section):
    """Window in front of each lens; every ray is refracted at both faces of the window.

    `rig.hfov_deg` is the field of view of the equivalent pinhole camera in water. For a port that is neither tilted nor
    laterally offset, the image of this pinhole camera equals the image through the port near the image centre, at any
    distance of the floor. The position of a camera is the projection centre of its equivalent pinhole camera.
    """

    kind: Literal["none", "flat", "dome"] = "none"
    """none: pinhole in water; flat: plane port; dome: concentric spheres"""
    thickness_m: float = Field(default=0.01, gt=0, le=0.2)
    """thickness of the glass [m]"""
    distance_m: float = Field(default=0.02, gt=0, le=1)
    """flat: distance from the entrance pupil of the lens to the glass [m]"""
    tilt_deg: float = Field(default=0.0, ge=-30, le=30)
    """flat: rotation about the image rows, positive moves the lower side away from the lens [deg]"""
    radius_m: float = Field(default=0.05, gt=0, le=1)
    """dome: inner radius [m]"""
    offset_m: Vector3 = (0.0, 0.0, 0.0)
    """dome: centre relative to the entrance pupil, along right, down, forward [m]"""
    glass_index: float = Field(default=1.49, ge=1, le=3)
    """refractive index of the window of the port: acrylic 1.49, glass 1.52"""
    water_index: float = Field(default=SEA_WATER_INDEX, ge=1, le=2)
    """refractive index of sea water"""
    calibrated_at_m: float = Field(default=0.0, ge=0, le=100)
    """depth along the optical axis for which images are rectified exactly, as after a calibration in water; 0: the port
    is modelled as a change of focal length [m]"""

    def believed(self) -> FlatPort | None:
        """Returns the flat port that the estimators know, without its tilt; None if there is none or none is known."""
        if self.kind != "flat" or not self.calibrated_at_m:
            return None
        return FlatPort(self.distance_m, self.thickness_m, self.glass_index, self.water_index, self.calibrated_at_m)


class CalibrationErrorConfig(Section):
    """Calibration error: true camera parameters minus those that the estimators use.

    The errors of focal length and baseline are relative to the values that the estimators use. Errors that change from
    dive to dive are given as standard deviations: each seed draws its own, and the estimators know how large they may
    be.
    """

    rotation_sigma_deg: float = Field(default=0.0, ge=0, le=2)
    """standard deviation of the rotation of the right camera about each of its axes, which depends on the seed [deg]"""
    baseline_sigma_mm: float = Field(default=0.0, ge=0, le=20)
    """standard deviation of the error of the baseline, which depends on the seed [mm]"""

    focal_error: float = Field(default=0.0, ge=-0.2, le=0.2)
    """relative error of the focal length of both cameras"""
    left_principal_point_error_px: Vector2 = (0.0, 0.0)
    """error of the left principal point, to the right and down [px]"""
    right_principal_point_error_px: Vector2 = (0.0, 0.0)
    """error of the right principal point, to the right and down [px]"""
    baseline_error: float = Field(default=0.0, ge=-0.5, le=0.5)
    """relative error of the baseline"""
    right_roll_deg: float = Field(default=0.0, ge=-5, le=5)
    """rotation of the right camera about its optical axis, clockwise as seen from behind [deg]"""
    right_pitch_deg: float = Field(default=0.0, ge=-5, le=5)
    """upward rotation of the right camera [deg]"""
    right_yaw_deg: float = Field(default=0.0, ge=-5, le=5)
    """rotation of the right camera away from the left one [deg]"""
    k1_error: float = Field(default=0.0, ge=-2, le=2)
    """true lens.k1 minus its calibrated value"""
    k2_error: float = Field(default=0.0, ge=-5, le=5)
    """true lens.k2 minus its calibrated value"""


class WaterConfig(Section):
    """Inherent optical properties of the water for R, G, B: those of a Jerlov type, or given explicitly."""

    source: WaterSourceName = "solonenko2015"
    """table of absorption and scattering of the Jerlov types: Solonenko & Mobley 2015 (all types, derived from measured
    Kd) or Williamson & Hollins 2022 (IB, II, III, 1C, 3C, 5C; measured), whose scattering at 550 nm is 0.29 (III) to
    2.3 times (IB) as large"""
    jerlov: JERLOV = "IB"
    """Jerlov water type of the source, or clear (no attenuation, no scattering)"""
    turbidity: float = Field(default=1.0, ge=0, le=100)
    """multiplies the scattering coefficient"""
    visibility_m: float | None = Field(default=None, gt=0, le=200)
    """horizontal visibility of a black object in daylight; sets the scattering, instead of turbidity [m]"""
    visibility_constant: float = Field(default=4.8, ge=2, le=8)
    """visibility times the beam attenuation coefficient c in green (Zaneveld & Pegau 2003, Opt. Express 11, 2997)"""
    absorption_per_m: tuple[PerMetre, PerMetre, PerMetre] | None = None
    """absorption coefficient for R, G, B; replaces the Jerlov type; needs scattering_per_m [1/m]"""
    scattering_per_m: tuple[PerMetre, PerMetre, PerMetre] | None = None
    """scattering coefficient for R, G, B; replaces the Jerlov type; needs absorption_per_m [1/m]"""
    spectrum_file: FilePath | None = None
    """CSV of wavelength [nm], absorption and scattering [1/m]; replaces the Jerlov type; ${TWIN_DATA} is expanded"""
    phase_function: Literal["sea", "petzold", "fournier_forand", "henyey_greenstein"] = "sea"
    """angular distribution of scattered light: sea (molecules by Morel, the rest of the scattering by Petzold's average
    particle), or one function alone: petzold, fournier_forand, henyey_greenstein"""
    particle_index: float = Field(default=1.1, gt=1.0, le=1.5)
    """fournier_forand: refractive index of the particles relative to water"""
    particle_slope: float = Field(default=3.58, gt=3.0, lt=5.0)
    """fournier_forand: exponent of the size distribution of the particles"""
    mean_cosine: float = Field(default=0.924, ge=0, le=0.99)
    """henyey_greenstein: mean cosine g of the scattering angle; 0 is isotropic"""

    @property
    def label(self) -> str:
        own = "own values" if self.absorption_per_m else Path(self.spectrum_file).name if self.spectrum_file else ""
        name = f"Jerlov {self.jerlov} ({WATER_SOURCES[self.source].citation})" if self.is_jerlov_type else self.jerlov
        if self.visibility_m is not None:
            return f"{own or name}, visibility {self.visibility_m:g} m"
        return f"{own or name}, turbidity {self.turbidity:g}"

    @property
    def is_jerlov_type(self) -> bool:
        return self.jerlov != "clear" and self.absorption_per_m is None and self.spectrum_file is None

    @field_validator("jerlov")
    @classmethod
    def _require_type_of_source(cls, jerlov: str, info: ValidationInfo) -> str:
        source = info.data.get("source")
        if source is None or jerlov in (allowed := ("clear", *WATER_SOURCES[source].types)):
            return jerlov
        text = f"{', '.join(allowed)} with source = {source}"
        raise PydanticCustomError("water_type", "{allowed}", {"allowed": text})


class LampConfig(Section):
    """Lamp on the vehicle."""

    position_m: Vector3
    """position in the body frame: forward, left, up [m]"""
    tilt_deg: float = Field(default=0.0, ge=-90, le=90)
    """angle of the beam axis towards the bow, from the vertical plane across the vehicle [deg]"""
    pan_deg: float = Field(default=0.0, ge=-90, le=90)
    """rotation of the beam axis in the plane across the vehicle, from straight down to port [deg]"""
    intensity_cd: float = Field(default=1000.0, ge=0, le=1e6)
    """luminous intensity on the beam axis [cd]"""
    beam: tuple[tuple[OffAxisDeg, RelativeIntensity], ...] = Field(default=(), max_length=1000)
    """beam pattern: pairs of angle off the axis [deg], from 0, and intensity relative to the axis, interpolated
    linearly, dark beyond the last angle; empty: the measured beam of an LED lamp"""
    colour_temperature_k: float = Field(default=6500.0, ge=1000, le=40000)
    """colour temperature; 6500 is white; the luminous intensity does not change with it [K]"""


class SunConfig(Section):
    """Daylight of sun and sky through a level water surface."""

    illuminance_lx: float = Field(default=0.0, ge=0, le=2e5)
    """illuminance of a horizontal plane by white daylight, just below the surface [lx]"""
    elevation_deg: float = Field(default=90.0, ge=1, le=90)
    """elevation of the sun above the horizon, in air; the surface refracts its light; 90: zenith [deg]"""
    azimuth_deg: float = Field(default=0.0, ge=-360, le=360)
    """direction to the sun, counter-clockwise from x (east) [deg]"""
    sky_share: float = Field(default=0.2, ge=0, le=1)
    """share of the illuminance that is diffuse light of a uniform sky; 0.2: clear sky, high sun; 1: overcast"""
    depth_m: float = Field(default=0.0, ge=0, le=500)
    """depth of the reference plane z = 0 below the water surface; illuminance_lx applies at the surface and decreases
    with depth; 0: no surface, illuminance_lx applies on the sea floor at any height [m]"""
    caustics: float = Field(default=0.0, ge=0, le=1)
    """fraction of the daylight that surface waves focus into caustics; needs depth_m"""
    wind_mps: float = Field(default=5.0, ge=3, le=15)
    """wind speed 10 m above the sea, which makes the waves of the caustics; it blows towards east [m/s]"""


class SnowConfig(Section):
    """Marine snow: particles that drift with the current through the light of lamps and sun."""

    density_per_m3: float = Field(default=0.0, ge=0, le=5000)
    """particles per cubic metre; 0: none [1/m3]"""
    diameter_m: float = Field(default=0.001, ge=0.0001, le=0.02)
    """diameter of all particles, without junge_exponent [m]"""
    junge_exponent: float | None = Field(default=None, gt=1, le=8)
    """size distribution: the number of particles per interval of diameter falls as this power of the diameter, from
    diameter_min_m to diameter_max_m (Junge); 3 to 5 in the sea; default: one diameter"""
    diameter_min_m: float = Field(default=0.0003, ge=0.0001, le=0.02)
    """smallest diameter of the distribution [m]"""
    diameter_max_m: float = Field(default=0.01, ge=0.0001, le=0.02)
    """largest diameter of the distribution [m]"""
    albedo: float = Field(default=0.5, gt=0, le=1)
    """albedo of a particle, the fraction of light reflected"""


class CurrentConfig(Section):
    """Current: its mean over height, gusts and a tide; heights are above the reference plane z = 0.

    Marine snow drifts, and plants lean, with velocity_mps alone.
    """

    velocity_mps: Vector3 = (0.0, 0.0, 0.0)
    """mean velocity at reference_height_m: east, north, up [m/s]"""
    profile: Literal["uniform", "power", "log"] = "uniform"
    """mean velocity over the height z. power: as (z / reference_height_m)^exponent; log: as ln(z / roughness_m), zero
    below roughness_m"""
    reference_height_m: Metres = 2.0
    """height at which the velocity is velocity_mps [m]"""
    exponent: float = Field(default=1 / 7, gt=0, le=1)
    """power: exponent of the profile"""
    roughness_m: float = Field(default=0.05, gt=0, le=10)
    """log: roughness length of the sea floor; 0.05 over reefs (Lentz et al. 2017) [m]"""
    file: FilePath | None = None
    """measured or modelled current, which replaces velocity_mps and profile: CSV with the columns time_s, height_m,
    east_mps, north_mps and, if known, up_mps, or NetCDF (.nc) of the CF convention; interpolated linearly, constant
    after its last time. It covers the duration of the legs and, with more than one height, the heights of the path"""
    file_start: Instant | None = None
    """NetCDF: start of the survey in UTC, as 2026-05-01T06:00; default: the first time of the file"""
    file_place_deg: tuple[LongitudeDeg, LatitudeDeg] | None = None
    """NetCDF: longitude and latitude of the survey, where the file has several places; the nearest is taken [deg]"""
    gust_mps: float = Field(default=0.0, ge=0, le=2)
    """gusts: standard deviation of the velocity to the east, and to the north [m/s]"""
    gust_vertical_mps: float | None = Field(default=None, ge=0, le=2)
    """standard deviation of the vertical velocity of gusts; default: half of gust_mps [m/s]"""
    gust_time_s: float = Field(default=10.0, ge=1, le=3600)
    """correlation time of the gusts (Gauss-Markov process); about height over mean speed [s]"""
    tide_mps: Vector2 = (0.0, 0.0)
    """amplitude of the tidal current: east, north [m/s]"""
    tide_period_h: float = Field(default=12.42, gt=0.1, le=1000)
    """period of the tide; 12.42: semi-diurnal lunar [h]"""
    tide_phase_deg: float = Field(default=0.0, ge=-360, le=360)
    """phase of the tide at the start; 0: greatest current along tide_mps [deg]"""

    @property
    def is_netcdf(self) -> bool:
        return self.file is not None and self.file.lower().endswith(".nc")

    @property
    def is_still(self) -> bool:
        """Returns whether the water does not move, apart from waves."""
        return self.file is None and not any(
            (*self.velocity_mps, *self.tide_mps, self.gust_mps, self.gust_vertical_mps)
        )


class WavesConfig(Section):
    """Surface waves: their orbital motion, by linear theory, of long-crested waves with a JONSWAP spectrum.

    They move vehicle and water, not the light.
    """

    height_m: float = Field(default=0.0, ge=0, le=20)
    """significant height; 0: no waves, unless wind_mps is given [m]"""
    period_s: float = Field(default=8.0, ge=1, le=30)
    """period of the peak of the spectrum [s]"""
    wind_mps: float | None = Field(default=None, gt=0, le=60)
    """wind 10 m above the sea over fetch_m, from which height and period follow (Hasselmann et al. 1973) [m/s]"""
    fetch_m: float | None = Field(default=None, ge=100, le=1e6)
    """distance over which the wind blows, with wind_mps; it counts up to that of a fully developed sea [m]"""
    peak_enhancement: float = Field(default=3.3, ge=1, le=7)
    """peak of the spectrum relative to a fully developed sea; 3.3: mean of JONSWAP, 1: Pierson-Moskowitz"""
    direction_deg: float = Field(default=0.0, ge=-360, le=360)
    """direction in which the waves travel, counter-clockwise from x (east) [deg]"""
    depth_m: float | None = Field(default=None, gt=0, le=500)
    """depth of the reference plane z = 0 below the mean water surface; default: sun.depth_m [m]"""

    @property
    def is_calm(self) -> bool:
        return self.height_m == 0 and self.wind_mps is None


class TetherConfig(Section):
    """Tether of the vehicle: a neutrally buoyant line to a point above the start, paid out as needed.

    Its drag pulls at the vehicle, which the controller does not know. Diameter: Fathom of Blue Robotics.
    """

    length_m: float = Field(default=0.0, ge=0, le=1000)
    """height of its upper end above the start: surface, ship or clump weight; 0: no tether [m]"""
    diameter_m: float = Field(default=0.0076, gt=0, le=0.1)
    """diameter [m]"""
    drag_coefficient: float = Field(default=1.2, ge=0, le=3)
    """drag coefficient of a cylinder across the flow"""
    attachment_m: Vector3 = (-0.2, 0.0, 0.1)
    """point of the body where it is attached [m]"""


class NavigationConfig(Section):
    """Navigation sensors and their noise; the estimators receive only the readings of the sensors in `aiding`."""

    model: ModelFile = Field(default=None, min_length=1, max_length=500)
    """name of a set of sensors in scenes/navigations, or its file: this section and [imu]. They replace those of the
    files that this file extends; further keys of this file change single values"""
    title: str = Field(default="", max_length=80)
    """name of the set of sensors, set by model"""
    aiding: tuple[AIDING, ...] = ()
    """sensors that aid vision; empty: vision only; imu: that of [imu] predicts the motion between frames"""
    pressure_sigma_m: float = Field(default=0.01, gt=0, le=10)
    """standard deviation of the height from the pressure sensor [m]"""
    pressure_resolution_m: float = Field(default=0.0, ge=0, le=1)
    """step of its readings [m]"""
    pressure_rate_hz: float | None = Field(default=None, gt=0, le=1000)
    """readings per second, each at a frame; default: one at every frame [Hz]"""
    pressure_delay_s: float = Field(default=0.0, ge=0, le=10)
    """time from its measurement to its arrival; the readings have the time of the measurement [s]"""
    attitude_sigma_deg: float = Field(default=0.2, gt=0, le=30)
    """standard deviation of roll and pitch from the AHRS [deg]"""
    heading_sigma_deg: float = Field(default=0.5, gt=0, le=90)
    """standard deviation of the heading from the AHRS [deg]"""
    ahrs_rate_hz: float | None = Field(default=None, gt=0, le=1000)
    """readings per second, as of the pressure sensor [Hz]"""
    ahrs_delay_s: float = Field(default=0.0, ge=0, le=10)
    """delay of its readings, as of the pressure sensor [s]"""
    dvl_sigma_mps: float = Field(default=SensorNoise.dvl_mps, gt=0, le=10)
    """standard deviation of each axis of the velocity over ground from the DVL [m/s]"""
    dvl_scale_sigma: float = Field(default=SensorNoise.dvl_scale, gt=0, le=0.1)
    """standard deviation of the relative scale error of the DVL velocity, constant during a survey"""
    dvl_rate_hz: float | None = Field(default=None, gt=0, le=1000)
    """readings per second, as of the pressure sensor; vision bridges the frames between them [Hz]"""
    dvl_range_m: tuple[Metres, Metres] | None = None
    """shortest and longest beam that returns an echo; without three of its four beams, which the slope of the floor
    makes longer and shorter, the DVL has no bottom lock; default: it always has [m]"""
    dvl_beam_deg: float = Field(default=22.5, gt=0, lt=60)
    """angle between its beams and its axis, which points downwards; 22.5: Water Linked A50; 30: Teledyne [deg]"""
    usbl_sigma_m: float = Field(default=SensorNoise.usbl_m, gt=0, le=100)
    """standard deviation of each axis of an acoustic position fix [m]"""
    usbl_interval_s: float = Field(default=1.0, gt=0, le=3600)
    """shortest time between acoustic fixes, each taken at a keyframe [s]"""
    usbl_delay_s: float = Field(default=0.0, ge=0, le=30)
    """delay of its fixes, as of the pressure sensor [s]"""
    altimeter_range_m: tuple[Metres, Metres] = (0.3, 50.0)
    """nearest and farthest sea floor that the altimeter measures, for control.height = "altimeter"; 0.3: from there on
    the echo sounder Ping of Blue Robotics measures [m]"""
    altimeter_beam_deg: float = Field(default=6.0, ge=0, le=60)
    """width of its beam, whose nearest echo it returns; a narrow one; 25 to 30: Ping [deg]"""
    altimeter_sigma: float = Field(default=0.005, ge=0, le=0.5)
    """standard deviation of its noise, a fraction of the range"""
    beacon_sigma_px: float = Field(default=SensorNoise.beacon_px, gt=0, le=50)
    """standard deviation of column and row of a beacon in the image [px]"""

    @property
    def delays_s(self) -> dict[str, float]:
        """Returns the delays of the readings by the name of the sensor, without those that are zero."""
        delays = {"pressure": self.pressure_delay_s, "ahrs": self.ahrs_delay_s, "usbl": self.usbl_delay_s}
        return {name: delay_s for name, delay_s in delays.items() if delay_s}

    @property
    def needs_every_frame(self) -> bool:
        """Returns whether a survey without images cannot skip the frames between keyframes."""
        rates_hz = self.pressure_rate_hz, self.ahrs_rate_hz
        return bool(self.delays_s) or self.dvl_range_m is not None or rates_hz != (None, None)


class ImuConfig(Section):
    """Inertial measurement unit (IMU) at the origin of the body; its readings are recorded for exports and replays.
    With "imu" in navigation.aiding, it predicts the motion between frames.

    It measures angular rates and specific forces in body axes. Names and units of the noise are those of Kalibr and
    EuRoC: a noise density times the root of the rate is the standard deviation of the white noise of a reading. The
    defaults are those of an ADIS16448: noise from EuRoC (Burri et al. 2016), biases from RotorS (Furrer et al. 2016).
    A surrogate survey simulates no IMU.
    """

    rate_hz: float | None = Field(default=None, gt=0, le=1000)
    """rate of the readings, at most and by default that of the physics: the smallest multiple of rig.frame_rate_hz that
    is at least 120 Hz; kinematic vehicle: rig.frame_rate_hz [Hz]"""
    gyroscope_noise_density: float = Field(default=1.6968e-4, ge=0, le=1)
    """white noise of each angular rate [rad/s/sqrt(Hz)]"""
    gyroscope_random_walk: float = Field(default=1.9393e-5, ge=0, le=1)
    """random walk of the bias of each angular rate [rad/s2/sqrt(Hz)]"""
    gyroscope_bias_sigma_radps: float = Field(default=8.7e-3, ge=0, le=1)
    """standard deviation of the bias of each angular rate at 0 s [rad/s]"""
    accelerometer_noise_density: float = Field(default=2.0e-3, ge=0, le=10)
    """white noise of each specific force [m/s2/sqrt(Hz)]"""
    accelerometer_random_walk: float = Field(default=3.0e-3, ge=0, le=10)
    """random walk of the bias of each specific force [m/s3/sqrt(Hz)]"""
    accelerometer_bias_sigma_mps2: float = Field(default=0.196, ge=0, le=10)
    """standard deviation of the bias of each specific force at 0 s [m/s2]"""


class BeaconConfig(Section):
    """Small light at a surveyed position."""

    position_m: Vector3
    """position in the world: east, north, up [m]"""


class PlanConfig(Section):
    """Survey pattern to fly (Negahdaripour & Madjidi 2003, sections III and III-A)."""

    pattern: Literal["lawnmower", "loops"] = "lawnmower"
    """lawnmower: parallel legs; loops: circles through the start, which is the centre of a disc"""
    area_m: tuple[Metres, Metres] = (4.0, 2.0)
    """extent along and across the legs, around centre_m; loops: diameter of the disc (both); unused with polygon [m]"""
    centre_m: Vector2 = (0.0, 0.0)
    """centre of the area: x, y in the scene [m]"""
    centre_crs: tuple[Number, Number] | None = None
    """centre of the area: easting, northing in the CRS of the DEM, in the unit of the CRS; replaces centre_m"""
    heading_deg: float = Field(default=0.0, ge=-360, le=360)
    """direction of the first leg, and of the bow on it, counter-clockwise from x (east) [deg]"""
    along_contours: bool = False
    """true: legs along the contours of the sea floor, across its mean slope in the area; replaces heading_deg"""
    polygon: str | tuple[Vector2, ...] | None = None
    """area to cover by legs instead of a rectangle: corners x, y in the scene [m], or a file with polygons, with
    or without holes: GeoJSON in a CRS that it names, in degrees or in that of the DEM, KML, or a .plan of
    QGroundControl; ${TWIN_DATA} is expanded"""
    turns: Literal["reverse", "bow_first", "arcs"] = "reverse"
    """reverse: every second leg is flown backwards; bow_first: after each leg the vehicle yaws by 180 deg; arcs: it
    flies bow first at constant speed and turns in arcs, as a vehicle that is steered by fins has to"""
    altitude_m: float = Field(default=2.2, gt=0, le=100)
    """height of the cameras above the reference plane z = 0 or, with height = "floor", above the sea floor [m]"""
    speed_mps: float = Field(default=0.25, gt=0.01, le=2)
    """speed along legs and loops; lower on tight loops [m/s]"""
    overlap_along: float = Field(default=0.9, gt=0, lt=1)
    """overlap of consecutive keyframes, a fraction of the image width"""
    overlap_across: float = Field(default=0.8, gt=0, lt=1)
    """sidelap of neighbouring swaths, a fraction of the footprint"""
    overlap_reference: Literal["floor", "plane"] = "floor"
    """floor: 95 % of the keyframes reach the overlaps over the sea floor; plane: the overlaps are those at z = 0"""
    height: Literal["plane", "floor"] = "plane"
    """plane: altitude_m above the reference plane; floor: altitude_m above the smoothed sea floor"""
    tracks: int = Field(default=0, ge=0, le=1000)
    """number of tracks (two legs, or one loop); 0: enough to cover the area"""
    cross_lines: int = Field(default=0, ge=0, le=100)
    """number of lines across the legs that are flown after them, as a last track; 0: none"""
    cross_rise_m: float = Field(default=0.0, ge=0, le=20)
    """height of the cross lines above the legs: a second altitude shows wrong scales [m]"""
    fill_gaps: bool = False
    """true: after the last track, the vehicle flies legs over the parts of the area that fewer than two keyframes show,
    by the estimated poses and depths, until none is left or a second track of such legs has not covered them"""
    clearance_m: float = Field(default=0.3, ge=0, le=10)
    """smallest allowed vertical distance from the cameras to the sea floor in their images or, with height = "floor",
    within 0.4 m plus this distance around them [m]"""

    @field_validator("polygon", mode="before")
    @classmethod
    def _require_corners(cls, value: Any) -> Any:
        """Requires None, a string or a list of pairs of numbers up to 1e5; pydantic would list several errors."""
        if isinstance(value, list | tuple):
            corners = all(isinstance(corner, list | tuple) and len(corner) == 2 for corner in value)
            numbers = corners and all(type(c) in (int, float) and abs(c) <= 1e5 for pair in value for c in pair)
        else:
            numbers = value is None or isinstance(value, str)
        if not numbers:
            raise PydanticCustomError("polygon_type", "a list of corners [x, y], or a GeoJSON file")
        return value


class ObjectConfig(Section):
    """Object at `position_m` on the sea floor, or many of one kind, scattered at random with the density `per_m2`."""

    shape: Literal[
        "mesh", "boulder", "brain_coral", "branching_coral", "table_coral", "sponge", "sea_star", "pipe", "crate",
        "tyre", "bottle", "kelp",
    ]  # fmt: skip
    """built-in shape, or mesh for the triangles of mesh_file"""
    mesh_file: FilePath | None = None
    """PLY, OBJ or GLB file with vertex colours or a texture; needs shape = mesh; ${TWIN_DATA} is expanded"""
    mesh_up: Literal["z", "y"] | None = None
    """axis of mesh_file that points up; default: y for GLB, z for other files"""
    size_m: float | None = Field(default=None, gt=0, le=20)
    """largest extent of an object, median of a distribution; default: that of mesh_file in metres, or 0.4 [m]"""
    size_spread: float = Field(default=0.0, ge=0, le=1)
    """standard deviation of the logarithm of the size (log-normal, cut at 2 sigma); 0: all are of size_m"""
    width_m: float | None = Field(default=None, gt=0, le=20)
    """outer diameter of a pipe; default: an eighth of its length [m]"""
    colour: tuple[Albedo, Albedo, Albedo] | None = None
    """albedo for R, G, B; default: that of the shape; a mesh with colours or a texture keeps them"""
    position_m: Vector2 | None = None
    """position of one object: x, y in the scene [m]"""
    height_m: float | None = Field(default=None, ge=-100, le=100)
    """height of the base of the object at position_m above the reference plane z = 0; default: on the sea floor [m]"""
    heading_deg: float | None = Field(default=None, ge=-360, le=360)
    """rotation about the vertical, counter-clockwise from x (east); default: random [deg]"""
    upright: bool = True
    """whether the objects stand upright; false: perpendicular to the sea floor"""
    sunk: float = Field(default=0.1, ge=-5, le=0.95)
    """share of the height of an object that is in the sea floor; negative: above the sea floor"""
    per_m2: float | None = Field(default=None, gt=0, le=1000)
    """scattered objects per square metre of the ground given by `on` [1/m2]"""
    on: Literal["anywhere", "sand", "slopes"] = "anywhere"
    """ground of scattered objects. sand: less steep than 15 deg; slopes: at least that steep"""
    area_m: tuple[Metres, Metres] | None = None
    """extent along x and y of the area of scattered objects; default: the terrain [m]"""
    centre_m: Vector2 = (0.0, 0.0)
    """centre of area_m: x, y in the scene [m]"""
    spacing_m: float = Field(default=0.0, ge=0, le=1000)
    """least distance from the centre of a scattered object to the centres of all objects placed before it, those of
    other entries too (Poisson disc); scattered objects never overlap any object [m]"""
    growth_m: float = Field(default=0.0, ge=-20, le=20)
    """growth since an earlier survey: increase of the height of the objects, which keep their base and proportions; all
    positions are those of the objects before they grew [m]"""
    growing: tuple[ObjectNumber, ...] | None = None
    """numbers of the objects of this entry that grow, from 0 for the largest; default: all"""
    removed: tuple[ObjectNumber, ...] = ()
    """numbers of the objects of this entry that are gone since an earlier survey, from 0 for the largest"""


class TaskConfig(Section):
    """Close survey of a target, for which the survey is broken off; afterwards the vehicle returns to where it left.

    Its keyframes have an elevation map of their own, in the frame of the map of the area.
    """

    name: str = Field(default="target", min_length=1, max_length=40)
    """name of the target for reports"""
    position_m: Vector2
    """centre of the target: x, y in the scene [m]"""
    size_m: tuple[Metres, Metres] = (1.0, 1.0)
    """extent along and across the legs of the survey [m]"""
    altitude_m: Metres = 1.0
    """height of the cameras above the sea floor around the target [m]"""
    speed_mps: float = Field(default=0.1, gt=0.01, le=2)
    """speed along the legs [m/s]"""
    overlap_along: float = Field(default=0.9, gt=0, lt=1)
    """overlap of consecutive keyframes, a fraction of the image width"""
    overlap_across: float = Field(default=0.8, gt=0, lt=1)
    """sidelap of neighbouring legs, a fraction of the footprint"""
    after_track: int | None = Field(default=None, ge=1, le=10_000)
    """number of the planned track after which the survey is broken off; default: see start_s"""
    start_s: float | None = Field(default=None, ge=0, le=1e6)
    """time from which on the survey is broken off, at the next end of a leg; default: at the end of a leg that is
    nearest to the target [s]"""
    within_leg: bool = False
    """true: the survey is broken off within a leg, at start_s or, without it, at the point of a leg that is nearest to
    the target, and continues there; false: at the end of a leg"""
    cell_m: float | None = Field(default=None, gt=0.0005, le=1)
    """cell size of its map; default: map.cell_m in the ratio of the altitudes [m]"""


class ControlConfig(Section):
    """Trajectory following and station keeping."""

    plugin: str | None = Field(default=None, max_length=200, pattern=PLUGIN_NAME)
    """controller of another package, which replaces the pose controller: module:Class, or the name of an entry point
    twin.controllers; it runs code of that package"""
    hold_s: float = Field(default=2.0, ge=0.1, le=600)
    """station keeping at the end of a track, during global alignment [s]"""
    height: Literal["planned", "altimeter", "map"] = "planned"
    """height of the path. planned: as planned; altimeter, map: plan.altitude_m above the smoothed sea floor as measured
    during the survey, by the altimeter below the vehicle or by the stereo points of the keyframes so far, from which it
    also rises over obstacles (plan.clearance_m); where nothing has been measured yet, the floor is taken to continue"""
    natural_frequency_radps: float = Field(default=1.2, gt=0.05, le=10)
    """natural frequency of the closed position loop [rad/s]"""
    latency: Literal["none", "stated"] | Latency = "none"
    """time from an image to the command that follows from it, of a computer of finite speed, in whole frames [s]; the
    controller knows it and predicts the motion meanwhile. stated: the time of the estimators for a keyframe on a
    computer of computer_speed, proportional to the number of pixels"""
    computer_speed: float = Field(default=1.0, ge=0.01, le=100)
    """speed of the computer with latency = "stated", relative to the reference (2 cores of an x86-64 machine), which
    takes 84 ms for a keyframe of 320 x 240 pixels"""
    thruster_feedback: Literal["speed", "none"] = "speed"
    """what the speed controllers (ESC) of the thrusters report. speed: the speed of each propeller, from which its
    thrust follows; a thruster that misses half of the thrust of its commands is left out of the thrust allocation;
    none: nothing"""
    off_course_m: float | None = Field(default=None, gt=0, le=1000)
    """largest distance from the planned path; beyond it for one second, the survey is degraded; default: a quarter of
    the shorter side of the footprint [m]"""


SENSORS = ("pressure", "ahrs", "dvl", "usbl")  #: that can fail
#: Parts that can fail, with the ways in which they can, in the words of PX4.
FAULTS: dict[str, tuple[str, ...]] = {
    "thruster": ("off", "stuck", "wrong", "intermittent"),
    **dict.fromkeys(("cameras", "left_camera", "right_camera"), ("off", "stuck", "garbage", "intermittent")),
    "lamp": ("off", "intermittent"),
    **dict.fromkeys(SENSORS, ("off", "stuck", "wrong", "garbage", "intermittent", "delayed")),
    "tether": ("stuck",),
    "water": ("silt", "gust"),
    "fish": ("school",),
}


class FaultConfig(Section):
    """Fault of a part, at a time, at a place or at a rate; the estimators and the controller are not told of it."""

    part: Literal[
        "thruster", "cameras", "left_camera", "right_camera", "lamp", "pressure", "ahrs", "dvl", "usbl", "tether",
        "water", "fish",
    ]  # fmt: skip
    """part that fails, what drifts in front of the cameras, or the water; a sensor must be in navigation.aiding"""
    number: int | None = Field(default=None, ge=1, le=64)
    """number of the thruster or the lamp, from 1; default: all lamps"""
    type: Literal["off", "stuck", "wrong", "garbage", "intermittent", "delayed", "silt", "school", "gust"] = "off"
    """off: no thrust, no light, black images, no readings; stuck: the command, the images or the reading of its start
    are repeated, the tether is caught with a slack of `size`; wrong: thrust times `size`, readings plus `size`;
    garbage: images of noise, readings with added noise of standard deviation `size`; intermittent: as off, at random
    frames; delayed: readings arrive `size` seconds late; silt: a cloud hides the share `size` of the contrast, rises in
    1 s and settles at a time constant of 3 s; school: `size` fish swim between cameras and floor; gust: the water moves
    by `size` m/s more, rises and falls within 1 s"""
    start_s: float | None = Field(default=None, ge=0, le=1e6)
    """time at which it starts; default: see at_m and per_hour [s]"""
    at_m: Vector2 | None = None
    """place x, y in the scene: it starts when the left camera first comes within radius_m of it [m]"""
    radius_m: float = Field(default=0.5, gt=0, le=1000)
    """with at_m: horizontal distance at which it starts [m]"""
    per_hour: float | None = Field(default=None, gt=0, le=3600)
    """mean number of faults per hour, at random times"""
    duration_s: float | None = Field(default=None, gt=0, le=1e6)
    """duration of a fault; default: to the end of the survey [s]"""
    size: float = Field(default=0.5, ge=-100, le=100)
    """wrong, garbage: factor on the thrust; bias or noise of readings in their unit [m, deg, m/s]; intermittent: share
    of the frames that are lost, 0 to 1; delayed: delay [s]; tether: slack [m]; gust: added velocity [m/s]"""
    direction_deg: float | None = Field(default=None, ge=-360, le=360)
    """gust: direction of the added velocity, counter-clockwise from x (east); default: to port of the vehicle at its
    start [deg]"""

    @property
    def name(self) -> str:
        part = self.part.replace("_", " ")
        return f"{part} {self.number}" if self.number is not None else part


class _EstimatePlugin(Section):
    plugin: str | None = Field(default=None, max_length=200, pattern=PLUGIN_NAME)
    """estimator of another package, which replaces motion estimation, network and alignment: module:Class, or the name
    of an entry point twin.estimators; it runs code of that package"""


def _keys_of_settings() -> dict[str, Any]:
    types = get_type_hints(EstimatorSettings)
    keys = [setting for setting in fields(EstimatorSettings) if "description" in setting.metadata]
    return {key.name: (types[key.name], Field(default=key.default, **key.metadata)) for key in keys}


class EstimateConfig(create_model("EstimateKeys", __base__=_EstimatePlugin, **_keys_of_settings())):
    """Settings of motion estimation, the keyframe network and global alignment (GA)."""


class MapConfig(Section):
    """Elevation map from Kalman depth filters, and orthomosaic."""

    cell_m: float = Field(default=0.02, gt=0.001, le=1)
    """cell size of the elevation map [m]"""
    orthomosaic: bool = True
    """orthomosaic of the keyframe images at their ground sample distance; false: mosaic with the cells of the map"""
    restore: bool = False
    """remove lamp pattern and water of this scenario from the colours of the orthomosaic; false: colours as seen"""


class Source(BaseModel):
    """File, line numbers and overrides from which the keys of a scenario come, for error messages."""

    path: Path
    allow_plugins: bool = False  # whether keys may name a plug-in as module:Class, which runs code of any module
    lines: dict[str, int] = {}  # of each dotted key of the file
    base: Source | None = None  # of the file that this file extends
    overrides: tuple[str, ...] = ()  # from the command line, each `key=value`

    def describe(self, error: TwinError) -> str:
        """Returns the error as `FILE:LINE: key: problem (allowed: ...)` or, for an override, as `--set: ...`.

        FILE and LINE locate the key, or else the innermost section around it that a file contains, or else line 1. The
        second form applies if an override sets the key or a section around it, or a key of a section that `path` lacks.
        """
        key = error.field
        for override in self.overrides:
            name = override.split("=", 1)[0].strip().replace('"', "")
            if f"{key}.".startswith(f"{name}.") or (key not in self.lines and name.startswith(f"{key}.")):
                return f"--set: {error}"
        while "." in key and not any(key in file.lines for file in self._files()):
            key = key.rpartition(".")[0]
        file = next((file for file in self._files() if key in file.lines), self)
        return f"{file.path}:{file.lines.get(key, 1)}: {error}"

    def _files(self) -> list[Source]:
        return [self, *(self.base._files() if self.base else [])]


class Scenario(Section):
    """Complete description of one survey."""

    name: str = Field(default="survey", min_length=1, max_length=80)
    """name of the survey"""
    seed: int = Field(default=0, ge=0, lt=2**32)
    """seed of all random numbers"""
    scene_seed: int | None = Field(default=None, ge=0, lt=2**32)
    """seed of the floor, its texture and the objects; default: seed. Two surveys of one scene have different seeds and
    the same scene_seed"""
    record: Literal["none", "keyframes", "all"] = "keyframes"
    """images that the run folder keeps, for `twin export` and the report. keyframes: stereo pairs of the keyframes;
    all: also the left images of the frames between them; none: no images"""
    terrain: TerrainConfig = TerrainConfig()
    vehicle: VehicleConfig = VehicleConfig()
    rig: RigConfig = RigConfig()
    imaging: ImagingConfig = ImagingConfig()
    sensor: SensorConfig | None = None
    """physical image sensor; default: noise as fractions of full scale, from [imaging]"""
    lens: LensConfig = LensConfig()
    port: PortConfig = PortConfig()
    calibration_error: CalibrationErrorConfig = CalibrationErrorConfig()
    water: WaterConfig = WaterConfig()
    lamps: tuple[LampConfig, ...] = Field(default=(), max_length=64)
    """lamps on the vehicle"""
    sun: SunConfig = SunConfig()
    snow: SnowConfig = SnowConfig()
    current: CurrentConfig = CurrentConfig()
    waves: WavesConfig = WavesConfig()
    tether: TetherConfig = TetherConfig()
    navigation: NavigationConfig = NavigationConfig()
    imu: ImuConfig | None = None
    """inertial measurement unit; default: none"""
    plan: PlanConfig = PlanConfig()
    control: ControlConfig = ControlConfig()
    estimate: EstimateConfig = EstimateConfig()
    map: MapConfig = MapConfig()
    beacons: tuple[BeaconConfig, ...] = Field(default=(), max_length=1000)
    """small lights at surveyed positions"""
    objects: tuple[ObjectConfig, ...] = Field(default=(), max_length=1000)
    """objects on the sea floor"""
    tasks: tuple[TaskConfig, ...] = Field(default=(), max_length=100)
    """close surveys of targets within the survey"""
    faults: tuple[FaultConfig, ...] = Field(default=(), max_length=100)
    """faults of thrusters, cameras and navigation sensors"""
    require: dict[str, Number] = {}
    """limits on metrics, e.g. "map.le90_m" = 0.05"""

    _source: Source = PrivateAttr(default_factory=lambda: Source(path=Path("scenario")))

    @property
    def source(self) -> Source:
        """Returns the files and overrides from which the scenario was read, with line numbers, for error messages."""
        return self._source

    @property
    def seed_of_scene(self) -> int:
        return self.seed if self.scene_seed is None else self.scene_seed

    @property
    def delivers_linear_images(self) -> bool:
        """Returns whether images are proportional to the radiance."""
        sensor = self.sensor
        return sensor is None or (sensor.tone_curve == "linear" and sensor.white_balance == "white_light")

    @property
    def texel_m(self) -> float:
        """Returns the size of a texture pixel [m]: `terrain.texture_px_m`, or its default."""
        if self.terrain.texture_px_m is not None:
            return self.terrain.texture_px_m
        if self.terrain.texture_file is not None:
            return COARSEST_TEXEL_M
        width_m = 2.0 * self.plan.altitude_m * np.tan(np.deg2rad(self.rig.hfov_deg) / 2)
        return float(np.clip(width_m / self.rig.image_width_px, FINEST_TEXEL_M, COARSEST_TEXEL_M))

    def true_calibration_error(self) -> CalibrationErrorConfig:
        """Returns the calibration error with the errors that the seed draws."""
        error = self.calibration_error
        if not (error.rotation_sigma_deg or error.baseline_sigma_mm):
            return error
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(_CALIBRATION_STREAM,)))
        roll, pitch, yaw, baseline = rng.standard_normal(4).tolist()
        rotation, sigma = error.rotation_sigma_deg, error.baseline_sigma_mm / 1000 / self.rig.baseline_m
        drawn = {
            "right_roll_deg": error.right_roll_deg + rotation * roll,
            "right_pitch_deg": error.right_pitch_deg + rotation * pitch,
            "right_yaw_deg": error.right_yaw_deg + rotation * yaw,
            "baseline_error": error.baseline_error + sigma * baseline,
        }
        most = {"baseline_error": 0.5}  # limits of the keys
        within = {name: float(np.clip(value, -most.get(name, 5), most.get(name, 5))) for name, value in drawn.items()}
        return error.model_copy(update={**within, "rotation_sigma_deg": 0.0, "baseline_sigma_mm": 0.0})

    def believed_rig(self) -> StereoRig:
        """Returns the calibration that the estimators use; the true cameras differ from it by the calibration error."""
        rig = self.rig
        focal_px = rig.image_width_px / 2 / float(np.tan(np.deg2rad(rig.hfov_deg / 2)))
        forward, left, up = rig.mount_m
        position = np.array([forward, left + rig.baseline_m / 2, up])
        body_from_camera = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, position)
        size = rig.image_width_px, rig.image_height_px
        error = self.calibration_error
        return StereoRig(
            *size, focal_px, rig.baseline_m, rig.frame_rate_hz, body_from_camera,
            yaw_sigma_rad=float(np.deg2rad(error.rotation_sigma_deg)),
            baseline_sigma=error.baseline_sigma_mm / 1000 / rig.baseline_m, 
            readout_s=self.sensor.readout_ms / 1000 if self.sensor else 0.0, port=self.port.believed(),
        )  # fmt: skip

    def believed_noise(self) -> SensorNoise:
        navigation, rate_hz = self.navigation, self.navigation.dvl_rate_hz
        return SensorNoise(
            navigation.pressure_sigma_m, float(np.deg2rad(navigation.attitude_sigma_deg)),
            float(np.deg2rad(navigation.heading_sigma_deg)), navigation.dvl_sigma_mps, navigation.dvl_scale_sigma,
            navigation.usbl_sigma_m, navigation.beacon_sigma_px, tuple(beacon.position_m for beacon in self.beacons),
            imu=self._imu_noise() if "imu" in navigation.aiding else None,
            pressure_resolution_m=navigation.pressure_resolution_m,
            dvl_interval_s=0.0 if rate_hz is None or rate_hz >= self.rig.frame_rate_hz else 1 / rate_hz,
        )  # fmt: skip

    def _imu_noise(self) -> ImuErrorModel | None:
        imu = self.imu
        return imu and ImuErrorModel(
            imu.gyroscope_noise_density, imu.gyroscope_random_walk, imu.accelerometer_noise_density,
            imu.accelerometer_random_walk, imu.gyroscope_bias_sigma_radps, imu.accelerometer_bias_sigma_mps2,
        )  # fmt: skip

    def estimator_settings(self) -> EstimatorSettings:
        noise = self.imaging.noise_sd, self.imaging.shot_noise
        settings = self.estimate.model_dump(exclude={"plugin"})
        noisy, stops = self.sensor is not None or max(noise) >= _VISIBLE_NOISE, not self.vehicle.is_steered_by_fins
        return EstimatorSettings(**settings, noisy_images=noisy, stops_if_blind=stops)

    def fingerprint(self) -> str:
        """Returns a hash of all values but `record`, 16 hexadecimal digits; of files, only the paths are hashed."""
        return hashlib.sha256(self.model_dump_json(exclude={"record"}).encode()).hexdigest()[:16]

    @property
    def has_walls(self) -> bool:
        """Returns whether steep parts of the floor have a texture of their own in images (`terrain.wall_texture`)."""
        t = self.terrain
        return t.wall_texture == "triplanar" and t.kind != "mesh" and self.imaging.fidelity == "rendered"
