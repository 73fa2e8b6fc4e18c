"""Records that are exchanged between packages: calibration, frames, readings, estimates, maps, and the truth."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Links
from twin.core.quality import EstimationQuality
from twin.core.refraction import FlatPort

Image = NDArray[np.uint8]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]
Radiance = NDArray[np.float32]  #: (H, W, 3) light of an image for R, G, B [cd/m2]
Depth = NDArray[np.float32]  #: (H, W) depth along the optical axis [m]; inf where there is nothing
#: Linear signal of R, G and B per unit of radiance on the optical axis [1 / (cd/m2)]; see `Frame.exposure`.
Exposure = tuple[float, float, float]

_WATER_KG_M3 = 1025.0
GRAVITY_MPS2 = 9.81  #: strength of gravity in the estimators [m/s2]
#: Increase of the pressure of sea water with depth [Pa/m].
PASCAL_PER_METRE = _WATER_KG_M3 * GRAVITY_MPS2


@dataclass(frozen=True)
class StereoRig:
    """Believed calibration of a rectified pair: equal pinhole cameras, the right one along +x of the left one."""

    #: width_px, height_px: image size.
    width_px: int
    height_px: int
    focal_px: float  #: focal length along the rows of the image (fx)
    baseline_m: float  #: distance between the cameras
    frame_rate_hz: float = 30.0  #: nominal number of frames per second; the times of the frames take precedence
    #: (4, 4) pose of the left camera in the body frame of the vehicle.
    body_from_camera: Array = field(default_factory=lambda: np.eye(4))
    #: focal length along the columns of the image (fy); equal to `focal_px` by default.
    focal_y_px: float | None = None
    #: (cx, cy); by default the image centre ((width - 1) / 2, (height - 1) / 2).
    principal_point_px: tuple[float, float] | None = None
    #: yaw_sigma_rad, baseline_sigma: standard deviations of the yaw between the cameras and of the relative change of
    #: the baseline since the calibration; 0: exact, and not estimated.
    yaw_sigma_rad: float = 0.0
    baseline_sigma: float = 0.0
    readout_s: float = 0.0  #: time from the exposure of the first row to that of the last; 0: global shutter
    port: FlatPort | None = None  #: flat ports in front of the lenses, for which matched points are corrected

    @property
    def fx_px(self) -> float:
        return self.focal_px

    @property
    def fy_px(self) -> float:
        return self.focal_px if self.focal_y_px is None else self.focal_y_px

    @property
    def focals_px(self) -> Array:
        return np.array([self.fx_px, self.fy_px])

    @property
    def cx_px(self) -> float:
        return (self.width_px - 1) / 2 if self.principal_point_px is None else self.principal_point_px[0]

    @property
    def cy_px(self) -> float:
        return (self.height_px - 1) / 2 if self.principal_point_px is None else self.principal_point_px[1]

    @property
    def matrix(self) -> Array:
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    @property
    def left_from_right(self) -> Array:
        return geometry.pose(np.eye(3), np.array([self.baseline_m, 0.0, 0.0]))

    def binned(self, by: int) -> "StereoRig":
        """Returns the calibration of images in which whole blocks of `by` x `by` pixels are averaged to one pixel."""
        if by == 1:
            return self
        divisible = self.width_px % by == 0 and self.height_px % by == 0
        has_default = self.principal_point_px is None and divisible
        centre = (self.cx_px + 0.5) / by - 0.5, (self.cy_px + 0.5) / by - 0.5
        focals = {"focal_px": self.focal_px / by, "focal_y_px": self.focal_y_px and self.focal_y_px / by}
        size = {"width_px": self.width_px // by, "height_px": self.height_px // by}
        return replace(self, **size, **focals, principal_point_px=None if has_default else centre)

    def with_square_pixels(self) -> "StereoRig":
        """Returns the calibration of images that are resampled along their columns so that fy equals fx."""
        scale = self.fx_px / self.fy_px
        if scale == 1:
            return self
        height = int(self.height_px * scale)
        centre = self.cx_px, (self.cy_px + 0.5) * scale - 0.5
        return replace(self, height_px=height, focal_y_px=None, principal_point_px=centre)

    def project(self, points: Array) -> Array:
        """Returns the pixels (n, 2) of points (n, 3) [m] in the axes of the left camera; NaN for depths up to 1 mm."""
        depth_m = np.where(points[:, 2:] > 1e-3, points[:, 2:], np.nan)
        return points[:, :2] / depth_m * self.focals_px + [self.cx_px, self.cy_px]

    def normalised(self, pixels: NDArray[np.floating]) -> Array:
        """Returns normalised coordinates (n, 2) = (pixel - principal point) / focal length of pixels (n, 2)."""
        return (pixels.astype(np.float64) - [self.cx_px, self.cy_px]) / self.focals_px

    def without_refraction(self, left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Returns the pixels (..., 2) of matched points in both images as pinhole cameras would see them."""
        if self.port is None:
            return left, right
        depth_m = self.fx_px * self.baseline_m / np.maximum(left[..., 0] - right[..., 0], 0.5)
        centre = np.array([self.cx_px, self.cy_px])
        first, second = (
            self.port.pinhole_positions((px - centre) / self.focals_px, depth_m) * self.focals_px + centre
            for px in (left, right)
        )
        return first, second


class ImuErrorModel(NamedTuple):
    """Noise of an IMU in the terms of Kalibr, and standard deviations of its biases at the start."""

    rate_density: float  #: white noise of each angular rate [rad/s/sqrt(Hz)]
    rate_walk: float  #: random walk of the bias of each angular rate [rad/s2/sqrt(Hz)]
    force_density: float  #: white noise of each specific force [m/s2/sqrt(Hz)]
    force_walk: float  #: random walk of the bias of each specific force [m/s3/sqrt(Hz)]
    rate_bias: float  #: standard deviation of the bias of each angular rate [rad/s]
    force_bias: float  #: standard deviation of the bias of each specific force [m/s2]


@dataclass(frozen=True)
class SensorNoise:
    """Believed noise of the navigation sensors: standard deviations from data sheets, and surveyed beacon positions."""

    pressure_m: float = 0.01  #: standard deviation of the height from the pressure sensor [m]
    attitude_rad: float = float(np.deg2rad(0.2))  #: standard deviation of roll and of pitch from the AHRS [rad]
    heading_rad: float = float(np.deg2rad(0.5))  #: standard deviation of the heading from the AHRS [rad]
    dvl_mps: float = 0.005  #: standard deviation of the white noise of each axis of the DVL velocity [m/s]
    dvl_scale: float = 0.002  #: standard deviation of the relative scale error of the DVL, constant over a survey
    usbl_m: float = 0.3  #: standard deviation of each axis of an acoustic position fix [m]
    beacon_px: float = 0.2  #: standard deviation of column and of row of a beacon in the image [px]
    #: (x, y, z) of each beacon in the world [m], treated as exact.
    beacons_m: tuple[tuple[float, float, float], ...] = ()
    #: standard deviation of the direction of the vertical about each horizontal axis [rad], common to all readings.
    up_rad: float = float(np.deg2rad(1.2))
    imu: ImuErrorModel | None = None  #: noise of the IMU that predicts the motion between frames; None: it is not used
    pressure_resolution_m: float = 0.0  #: step of the readings of the pressure sensor [m]
    dvl_interval_s: float = 0.0  #: time between readings of the DVL [s]; 0: one at every frame

    @property
    def height_sigma_m(self) -> float:
        """Returns the standard deviation of the height from pressure, with that of rounding to its steps."""
        return float(np.hypot(self.pressure_m, self.pressure_resolution_m / np.sqrt(12)))

    @property
    def attitude_sigmas_rad(self) -> Array:
        return np.array([self.attitude_rad, self.attitude_rad, self.heading_rad])


class BeaconDetection(NamedTuple):
    """A beacon detected in the left image: its index among the surveyed beacons, and its (column, row) [px]."""

    beacon: int
    pixel: tuple[float, float]


class ImuReadings(NamedTuple):
    """Readings of an inertial measurement unit (IMU) at the origin of the body, in the axes of the body.

    The specific force is the acceleration minus that of free fall: a body at rest measures 9.81 m/s2 upwards.
    """

    times_s: Array  #: (n,) times [s], increasing
    rates_radps: Array  #: (n, 3) angular rates of the body in its own axes [rad/s]
    specific_forces_mps2: Array  #: (n, 3) specific forces [m/s2]

    def until(self, time_s: float) -> "ImuReadings":
        """Returns the readings with the last one once more at a later time [s]; as they are without any."""
        if not len(self.times_s) or self.times_s[-1] >= time_s:
            return self
        return ImuReadings(np.append(self.times_s, time_s), *(np.vstack([part, part[-1:]]) for part in self[1:]))


@dataclass(frozen=True, slots=True)
class Readings:
    """Readings of the navigation sensors at a frame; None for a sensor that is not used or has no new reading."""

    pressure_z_m: float | None = None  #: height of the left camera above the reference plane z = 0, from pressure [m]
    ahrs_rpy_rad: Array | None = None  #: (3,) roll, pitch, yaw of the body in the world [rad]
    dvl_mps: Array | None = None  #: (3,) velocity of the body's origin over ground, in body axes [m/s]
    usbl_m: Array | None = None  #: (3,) position of the left camera in the world, at some keyframes [m]
    altitude_m: float | None = None  #: distance from the left camera to the floor below, from the altimeter [m]
    beacons: tuple[BeaconDetection, ...] | None = None  #: beacons detected in the left image, at keyframes
    imu: ImuReadings | None = None  #: readings of the IMU after the previous frame, up to the time of this frame
    #: (3,) unit vector that points vertically upwards, in body axes: an attitude without heading, as an IMU gives it.
    up: Array | None = None
    #: (time [s], readings) of earlier times, which arrived after the previous frame: pressure, AHRS, USBL.
    late: tuple[tuple[float, "Readings"], ...] = ()


class Displacement(NamedTuple):
    """Displacement of the body's origin since a node, measured by the DVL, in the axes of the body at that node."""

    since: int  #: keyframe number of the node
    displacement_m: Array  #: (3,) measured displacement [m], with the scale error of the DVL
    cov: Array  #: (3, 3) covariance due to white noise and the attitude error since the node, without the scale error


@dataclass(frozen=True)
class Frame:
    """Input of the estimators at one time."""

    index: int  #: number of the frame, from 0
    time_s: float  #: time of the exposure [s]
    #: left, right: rectified images (H, W, 3) uint8 RGB; the right one may be missing between keyframes.
    left: Image
    right: Image | None
    readings: Readings = field(default_factory=Readings)  #: readings of the navigation sensors
    keyframe: bool | None = None  #: whether the frame is to become a keyframe; None leaves the choice to the estimator
    #: linear signal of R, G and B per unit of radiance on the optical axis [1 / (cd/m2)], 1 at full scale, from the
    #: exposure time, gain and white balance that the cameras report; None if they report none.
    exposure: Exposure | None = None


#: Statuses of a frame at which a camera is frozen; with the left camera alone, the motion is still measured.
LEFT_REPEATS, RIGHT_REPEATS = "the left camera repeats its image", "the right camera repeats its image"
RIGHT_REPEATS_BLIND = f"{RIGHT_REPEATS}, and the motion could not be measured in the left one"
REPEATS = LEFT_REPEATS, RIGHT_REPEATS, RIGHT_REPEATS_BLIND
NO_STEREO = "too few points in stereo"  #: status of a frame that could not become a keyframe


def is_measured(status: str) -> bool:
    return status in ("ok", RIGHT_REPEATS)


class Estimate(NamedTuple):
    """Online estimate at one frame."""

    time_s: float  #: time of the frame
    world_from_camera: Array  #: (4, 4) online pose of the left camera
    f2f_from_start: Array  #: (4, 4) world_from_camera from the start pose and frame-to-frame motion alone
    camera_velocity: Array  #: (6,) twist of the left camera [rad/s, m/s] in camera axes
    sigma_m: float  #: standard deviation of the online position: root of the sum of the variances of x, y and z [m]
    status: str  #: "ok", or the reason why vision failed at this frame

    @property
    def is_measured(self) -> bool:
        """Returns whether vision measured the motion to this frame."""
        return is_measured(self.status)


@dataclass
class Trajectory:
    """Poses of the left camera over time."""

    times_s: Array  #: (n,) times [s]
    world_from_camera: Array  #: (n, 4, 4) poses

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def positions(self) -> Array:
        return self.world_from_camera[:, :3, 3]

    def save(self, path: Path, digits: int = 9, header: str = "") -> None:
        """Writes a TUM file: time x y z qx qy qz qw, numbers of `digits` digits and at most `digits` - 2 decimals."""
        quaternions = geometry.quaternions_xyzw(self.world_from_camera[:, :3, :3])
        rows = np.round(np.column_stack([self.times_s, self.positions, quaternions]), digits - 2) + 0.0  # no -0
        line = "%.6f" + f" %.{digits}g" * 7 + "\n"
        path.write_text(header + line * len(rows) % tuple(rows.ravel().tolist()))

    @staticmethod
    def load(path: Path) -> "Trajectory":
        rows = np.loadtxt(path, ndmin=2)
        if rows.shape[1] != 8 or not np.isfinite(rows).all():
            raise ValueError(f"{path.name} has no rows of 8 finite numbers")
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, :3] = geometry.rotation_from_wxyz(rows[:, [7, 4, 5, 6]])
        poses[:, :3, 3] = rows[:, 1:4]
        return Trajectory(rows[:, 0].copy(), poses)  # a view would keep all of the rows


class Alignment(NamedTuple):
    """Size and wall time of one global alignment."""

    track: int  #: last track of the window
    ms: float  #: wall time [ms]
    #: nodes, edges: number of nodes (including fixed ones) and of links (including rejected ones).
    nodes: int
    edges: int
    dropped: int  #: number of links rejected as outliers
    #: mean chi-square of the remaining links per degree of freedom; 1 is expected; 0 without links.
    link_chi2: float = 1.0
    converged: bool = True  #: false if the iterations ended before the minimum was reached


class StereoObservation(NamedTuple):
    """Image quality of one stereo pair, whether or not its frame became a keyframe."""

    row: int  #: row of the pair's frame in the trajectories
    n_points: int  #: number of matched points; with the surrogate, the number predicted by its error model
    contrast: float | None  #: local RMS contrast of the left image (`image_quality.contrast`); None without an image
    #: fraction of the pixel values of the left image at full scale; None without an image.
    saturated: float | None = None
    #: median row difference of the matched points, right minus left [px]; None if not measured.
    row_offset_px: float | None = None
    row_spread_px: float | None = None  #: robust standard deviation of the row differences [px]; None if not measured
    #: standard deviation of the row differences that is expected from the texture [px]; None if not measured.
    row_sigma_px: float | None = None
    #: largest autocorrelation of the left image away from its main peak; None without an image.
    repetition: float | None = None

    @property
    def row_spread_ratio(self) -> float | None:
        return self.row_spread_px / self.row_sigma_px if self.row_spread_px is not None and self.row_sigma_px else None


@dataclass
class SurveyResult:
    """Result of the estimators over a whole survey."""

    f2f: Trajectory  #: trajectory from frame-to-frame motion alone
    online: Trajectory  #: trajectory of the online estimates
    final: Trajectory  #: trajectory after the last global alignment; `online` if `EstimatorSettings.use_ga` is false
    keyframe_rows: NDArray[np.int64]  #: (n_keyframes,) row of each keyframe in the trajectories
    track_of_keyframe: NDArray[np.int64]  #: (n_keyframes,) track number of each keyframe, from 1
    #: (n_keyframes, 6, 6) for each keyframe, the marginal covariance of the final pose of the latest node up to it,
    #: [rotation, translation] (rad, m) in the camera axes of that node; without a final alignment, the covariance of
    #: the last online pose for every keyframe.
    node_cov: Array
    keyframe_depth_m: Array = field(default_factory=lambda: np.zeros(0))  #: (n_keyframes,) of the matched points
    links: Links = field(default_factory=Links)  #: measured motions of the network
    alignments: list[Alignment] = field(default_factory=list[Alignment])
    #: before_ga, after_ga: for each global alignment at the end of a track, positions (n, 3) of the keyframes so far,
    #: just before and just after it [m].
    before_ga: list[Array] = field(default_factory=list[Array])
    after_ga: list[Array] = field(default_factory=list[Array])
    #: image quality of all stereo pairs, including those with too few points for a keyframe.
    stereo_observations: list[StereoObservation] = field(default_factory=list[StereoObservation])
    quality: EstimationQuality = EstimationQuality()  #: consistency of the estimates, measured by the estimators

    @property
    def unlinked(self) -> NDArray[np.bool_]:
        """Returns the mask (n_keyframes,) of the keyframes whose pose is dead reckoning from an earlier keyframe.

        No measured link joins them, or their node, to another node. None are without any measured link.
        """
        links, n = self.links, len(self.keyframe_rows)
        measured = links.n_points > 0
        if not measured.any():
            return np.zeros(n, bool)
        nodes = np.union1d([0], np.concatenate([links.i, links.j]))
        linked = np.union1d([0], np.concatenate([links.i[measured], links.j[measured]]))
        return ~np.isin(nodes[np.searchsorted(nodes, np.arange(n), side="right") - 1], linked)

    @property
    def step_cov(self) -> Array:
        """Returns `Link.own_cov` (n_keyframes, 6, 6) of the link from the previous keyframe; zeros without a link."""
        cov = np.zeros((len(self.keyframe_rows), 6, 6))
        chain = self.links.j == self.links.i + 1
        cov[self.links.j[chain]] = self.links.own_cov[chain]
        return cov


@dataclass(frozen=True)
class MapGrid:
    """Regular grid of map cells."""

    #: west_m, north_m: x and y of the north-west corner of cell (0, 0) [m].
    west_m: float
    north_m: float
    cell_m: float  #: side of a cell [m]
    #: rows, cols: numbers of rows and columns; row 0 is the northernmost.
    rows: int
    cols: int

    def centres(self) -> tuple[Array, Array]:
        across, down = ((np.arange(n, dtype=np.float64) + 0.5) * self.cell_m for n in (self.cols, self.rows))
        return self.west_m + across, self.north_m - down


class HeightVariances(NamedTuple):
    """Mean variances of the heights of a map by their causes [m^2], over its typical cells (`ElevationMap`)."""

    stereo: float = 0.0  #: noise of the measured depths: noise, blur and contrast of the images
    pose: float = 0.0  #: errors of the poses of the keyframes
    relief: float = 0.0  #: slopes and steps, over which matching smooths and lateral errors change the height
    calibration: float = 0.0  #: errors of the calibration, which are common to all keyframes


@dataclass
class ElevationMap:
    """Digital elevation model with its uncertainty, and an orthomosaic on the same grid."""

    grid: MapGrid  #: cells in x and y of the map frame
    #: height_m, sigma_m: (rows, cols) float32, height (z) and its standard deviation [m]; NaN where unknown.
    height_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    mosaic: Image  #: (rows, cols, 3) uint8 RGB orthomosaic, black where unknown
    #: (4, 4) pose of the world in the map frame; the identity for a rig that looks down.
    map_from_world: Array = field(default_factory=lambda: np.eye(4))
    #: RMS difference of heights from two sets of keyframes / its sigma, without the largest 5 %; None: unknown.
    scatter: float | None = None
    #: (rows, cols) part of sigma_m squared that is equal in two surveys of a floor [m^2]; negative: they differ more.
    common_m2: NDArray[np.float32] | float = 0.0
    variances: HeightVariances = HeightVariances()  #: mean of sigma_m squared over the typical cells, in parts

    @property
    def typical(self) -> NDArray[np.bool_]:
        """Returns the mask (rows, cols) of the 95 % most certain cells: all but those at steep walls."""
        known = np.isfinite(self.sigma_m)
        return self.sigma_m <= (np.percentile(self.sigma_m[known], 95) if known.any() else 0.0)

    @property
    def repeatability_m(self) -> NDArray[np.float32]:
        """Returns the standard deviation (rows, cols) of the heights between two surveys of a floor [m]."""
        return np.sqrt(np.maximum(self.sigma_m**2 - self.common_m2, 0)).astype(np.float32)

    def to_world(self, points: Array) -> Array:
        return geometry.transform(geometry.inverse(self.map_from_world), points)


@dataclass
class Truth:
    """Ground truth of a survey, which no estimator receives."""

    trajectory: Trajectory  #: true poses of the left camera, one per frame
    reference: Array  #: (n_frames, 3) planned positions of the left camera [m]
    holding: NDArray[np.bool_]  #: (n_frames,) bool, true during station keeping
    track: NDArray[np.int64]  #: (n_frames,) number of the track, from 1
    height_m: NDArray[np.float32]  #: (rows, cols) float32, true height at the cell centres of the map grid [m]
    seen: NDArray[np.bool_]  #: (rows, cols) bool, cells that both cameras observed in at least one keyframe
    asked: NDArray[np.bool_]  #: (rows, cols) bool, cells whose centre lies in the asked area
    reference_yaw: Array | None = None  #: (n_frames,) planned heading of the bow [rad]; None: that at the start
    #: returns the true albedo (rows, cols, 3) of the floor at the cells of a grid, seen from above, 255 = white; NaN
    #: where there is no floor or an object lies on it. None: not known.
    albedo: Callable[[MapGrid], NDArray[np.float32]] | None = None
    #: returns whether points (x, y) [m] lie in the asked area. None: not known.
    in_area: Callable[[Array, Array], NDArray[np.bool_]] | None = None
    #: returns the height z [m] at which a camera is `plan.altitude_m` above the smoothed floor, and the height of the
    #: floor, at points (x, y) [m]. None: the path does not follow the floor.
    heights_to_follow: Callable[[Array, Array], tuple[Array, Array]] | None = None
    #: (rows, cols) uint16, 1 + number of the object at the top of each cell, 0 for the floor; None for a height grid
    #: without objects and for the surrogate. `height_m` is the height of the highest surface, floor or object.
    objects: NDArray[np.uint16] | None = None
    #: (rows, cols) bool, cells whose floor is hidden below an overhang of an object or mesh floor; None as `objects`.
    overhung: NDArray[np.bool_] | None = None
