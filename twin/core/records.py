"""What passes between the rooms: frames (all an estimator may see), truth beside them, estimates, and their files."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.links import Links

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class StereoRig:
    """The rig as its maker believes it: two equal rectified pinhole cameras, the right one at +x of the left.

    Args:
        width_px, height_px: image size.
        focal_px: focal length; the principal point is the image centre ((width - 1) / 2, (height - 1) / 2).
        baseline_m: distance between the cameras.
        frame_rate_hz: frames per second.
        body_from_camera: (4, 4) pose of the left camera in the vehicle's body.
    """

    width_px: int
    height_px: int
    focal_px: float
    baseline_m: float
    frame_rate_hz: float
    body_from_camera: Array

    @property
    def cx_px(self) -> float:
        return (self.width_px - 1) / 2

    @property
    def cy_px(self) -> float:
        return (self.height_px - 1) / 2

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix K of both cameras [px]."""
        return np.array([[self.focal_px, 0, self.cx_px], [0, self.focal_px, self.cy_px], [0, 0, 1.0]])

    @property
    def left_from_right(self) -> Array:
        """(4, 4) pose of the right camera in the left."""
        return geometry.pose(np.eye(3), np.array([self.baseline_m, 0.0, 0.0]))

    def binned(self, by: int) -> StereoRig:
        """The same rig where squares of `by` x `by` pixels are one; sides are multiples of it."""
        size = self.width_px // by, self.height_px // by
        return replace(self, width_px=size[0], height_px=size[1], focal_px=self.focal_px / by)

    def project(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in the left camera [m]; NaN behind it."""
        depth_m = np.where(points[:, 2:] > 1e-3, points[:, 2:], np.nan)
        return points[:, :2] / depth_m * self.focal_px + [self.cx_px, self.cy_px]


@dataclass(frozen=True)
class SensorNoise:
    """What is believed of the navigation sensors: standard deviations by their data sheets, beacons by a survey.

    Args:
        dvl_mps: white noise of each axis of velocity.
        dvl_scale: of the scale error, one for a whole survey (the speed of sound and the beams' angles are not exact).
        beacons_m: (x, y, z) of each beacon in the world, taken as exact.
    """

    pressure_m: float
    attitude_rad: float
    heading_rad: float
    dvl_mps: float = 0.005
    dvl_scale: float = 0.002
    usbl_m: float = 0.3
    beacon_px: float = 0.2
    beacons_m: tuple[tuple[float, float, float], ...] = ()


class Sighting(NamedTuple):
    """A beacon in the left image: which one of those surveyed (from 0), and its (column, row) [px]."""

    beacon: int
    pixel: tuple[float, float]


@dataclass(frozen=True)
class Readings:
    """What the navigation sensors said with this frame; None where a sensor is not fitted or has nothing new.

    Args:
        pressure_z_m: height of the left camera above the reference plane z = 0, from pressure [m].
        ahrs_rpy_rad: (3,) roll, pitch, yaw of the body in the world [rad].
        dvl_mps: (3,) velocity of the body's origin over ground, in the body [m/s].
        usbl_m: (3,) position of the left camera in the world, at some keyframes [m].
        beacons: those in view, at keyframes.
    """

    pressure_z_m: float | None = None
    ahrs_rpy_rad: Array | None = None
    dvl_mps: Array | None = None
    usbl_m: Array | None = None
    beacons: tuple[Sighting, ...] | None = None


class Displacement(NamedTuple):
    """How far the body's origin went since a node, in the body's axes at that node.

    Args:
        since: number of that node.
        metres: (3,) as the log says; its scale error makes it (1 + s) times too long, in the whole survey alike.
        cov: (3, 3) by the log's white noise and the error of the attitude between.
    """

    since: int
    metres: Array
    cov: Array


@dataclass(frozen=True)
class Frame:
    """All that an estimator gets: time, images (H, W, 3) uint8 RGB, readings; the right image at keyframes."""

    index: int
    time_s: float
    left: Image
    right: Image | None
    readings: Readings


class Estimate(NamedTuple):
    """Where the vehicle believes it is.

    Args:
        time_s: time of the frame.
        world_from_camera: (4, 4) pose of the left camera, online.
        f2f_from_start: (4, 4) pose of the left camera by frame-to-frame motion alone.
        camera_velocity: (6,) twist of the left camera [rad/s, m/s] in camera axes.
        sigma_m: one standard deviation of the online position, root of the summed variances [m].
        status: "ok", or why vision failed in this frame.
    """

    time_s: float
    world_from_camera: Array
    f2f_from_start: Array
    camera_velocity: Array
    sigma_m: float
    status: str


@dataclass
class Trajectory:
    """Poses of the left camera over time: times (n,) [s], world_from_camera (n, 4, 4)."""

    times_s: Array
    world_from_camera: Array

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def positions(self) -> Array:
        """(n, 3) [m]"""
        return self.world_from_camera[:, :3, 3]

    def save(self, path: Path) -> None:
        """Writes TUM: time x y z qx qy qz qw, a line a pose."""
        poses = self.world_from_camera
        rows = np.column_stack([self.times_s, self.positions, geometry.quaternions_xyzw(poses[:, :3, :3])])
        line = "%.6f" + " %.9g" * 7 + "\n"
        path.write_text(line * len(rows) % tuple(rows.ravel().tolist()))

    @staticmethod
    def load(path: Path) -> Trajectory:
        """Reads a TUM file that `save` or another tool wrote."""
        rows = np.loadtxt(path, ndmin=2)
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, :3] = geometry.rotation_from_wxyz(rows[:, [7, 4, 5, 6]])
        poses[:, :3, 3] = rows[:, 1:4]
        return Trajectory(rows[:, 0], poses)


class Alignment(NamedTuple):
    """One global alignment: which track closed it, its cost in time and size."""

    track: int
    ms: float
    nodes: int
    edges: int
    dropped: int


class StereoObservation(NamedTuple):
    """What a look with both cameras had to go by, whether it made a keyframe or not.

    Args:
        row: frame of the trajectory.
        n_points: matched points; of a surrogate, those it stands for.
        contrast: of the left image (`matching.contrast`); None where there is no image.
    """

    row: int
    n_points: int
    contrast: float | None


@dataclass
class SurveyResult:
    """What the estimators leave behind: the three trajectories, the network and the map.

    ``keyframe_rows`` are the rows of the trajectories that are keyframes, ``track_of_keyframe`` the track of each (from 1).
    ``node_cov`` (n_keyframes, 6, 6) is the marginal covariance of each final keyframe pose, in the camera.
    ``before_ga``/``after_ga`` hold per track the keyframes' positions (n, 3) just before and after its alignment.
    ``stereo_observations`` are all with both cameras, also those that found too little for a keyframe.
    """

    f2f: Trajectory
    online: Trajectory
    final: Trajectory
    keyframe_rows: NDArray[np.int64]
    track_of_keyframe: NDArray[np.int64]
    node_cov: Array
    links: Links = field(default_factory=Links)
    alignments: list[Alignment] = field(default_factory=list)
    before_ga: list[Array] = field(default_factory=list)
    after_ga: list[Array] = field(default_factory=list)
    stereo_observations: list[StereoObservation] = field(default_factory=list)


@dataclass(frozen=True)
class MapGrid:
    """The cells of every map of a survey: row 0 = north, (west_m, north_m) the outer corner of cell (0, 0)."""

    west_m: float
    north_m: float
    cell_m: float
    rows: int
    cols: int

    def centres(self) -> tuple[Array, Array]:
        """x (cols,) and y (rows,) of the cell centres [m]."""
        return (
            self.west_m + (np.arange(self.cols, dtype=np.float64) + 0.5) * self.cell_m,
            self.north_m - (np.arange(self.rows, dtype=np.float64) + 0.5) * self.cell_m,
        )


@dataclass
class ElevationMap:
    """A digital elevation model with its uncertainty and orthophoto on a `MapGrid`; NaN (black) where nothing was seen.

    Args:
        height_m, sigma_m: (rows, cols) float32.
        mosaic: (rows, cols, 3) uint8 RGB.
    """

    grid: MapGrid
    height_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    mosaic: Image


@dataclass
class Truth:
    """What only a simulator has; it meets the estimate in `judge` and nowhere else.

    Args:
        trajectory: true poses of the left camera, one a frame.
        reference: (n_frames, 3) planned positions of the left camera [m].
        holding: (n_frames,) bool, true while keeping station.
        track: (n_frames,) number of the track, from 1.
        height_m: (rows, cols) float32, true height at the cell centres of the survey's grid.
        seen: (rows, cols) bool, cells that at least one keyframe truly saw with both cameras.
    """

    trajectory: Trajectory
    reference: Array
    holding: NDArray[np.bool_]
    track: NDArray[np.int64]
    height_m: NDArray[np.float32]
    seen: NDArray[np.bool_]
