"""What passes between the rooms: frames (all an estimator may see), truth beside them, estimates, and their files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin import geometry

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
        """(3, 3) camera matrix K of both eyes [px]."""
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
        usbl_m: (3,) position of the left camera in the world, at some key points [m].
        beacons: those in view, at key points.
    """

    pressure_z_m: float | None = None
    ahrs_rpy_rad: Array | None = None
    dvl_mps: Array | None = None
    usbl_m: Array | None = None
    beacons: tuple[Sighting, ...] | None = None


@dataclass(frozen=True)
class Frame:
    """All that an estimator gets: time, images (H, W, 3) uint8 RGB, readings; the right image at key points."""

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


_ROOM = 2**17


class Rows:
    """Rows of one shape, one after another in one array; its room doubles when it is full.

    It begins with what most surveys need: pages that nothing is written to take no memory, copies to new room do.
    """

    def __init__(self, *shape: int, kind: type = float):
        self._room, self._n = np.empty((_ROOM, *shape), kind), 0

    @classmethod
    def of(cls, rows: NDArray[Any]) -> Rows:
        """These (n, *shape), and more to come."""
        made = cls.__new__(cls)
        made._room, made._n = rows, len(rows)
        return made

    def __len__(self) -> int:
        return self._n

    @property
    def array(self) -> NDArray[Any]:
        """All of them so far (n, *shape), a view."""
        return self._room[: self._n]

    def add(self, rows: ArrayLike) -> None:
        """Adds one row (*shape) or more (k, *shape)."""
        rows = np.asarray(rows).reshape(-1, *self._room.shape[1:])
        end = self._n + len(rows)
        if end > len(self._room):
            grown = np.empty((max(end, 2 * len(self._room)), *self._room.shape[1:]), self._room.dtype)
            grown[: self._n] = self.array
            self._room = grown
        self._room[self._n : end], self._n = rows, end


class Link(NamedTuple):
    """One connection of the key-point network: the measured motion between two nodes.

    Args:
        i, j: key-point numbers, i < j.
        i_from_j: (4, 4) pose of camera j in camera i.
        cov: (6, 6) covariance of [rotation, translation] in j (rad, m).
        overlap: share of image j that is seen in image i (0 to 1).
        n_points: matched points used; 0 where frame-to-frame motion stands in.
        shared_by: links of node j that rest on its one stereo look: `cov` is that of this motion alone, so many times.
        closed_form: (4, 4) the same motion by eq. (2), depth taken as exact; None without.
    """

    i: int
    j: int
    i_from_j: Array
    cov: Array
    overlap: float
    n_points: int
    shared_by: int = 1
    closed_form: Array | None = None

    @property
    def own_cov(self) -> Array:
        """(6, 6) covariance of this motion alone, beside no other link of its node."""
        return self.cov / self.shared_by


_LINK = np.dtype(
    [
        ("i", int), ("j", int), ("i_from_j", float, (4, 4)), ("information", float, (6, 6)), ("overlap", float),
        ("n_points", int), ("shared_by", int),
    ]
)  # fmt: skip


class Links(Sequence[Link]):
    """Many links by columns, as arrays; one by one where speed does not matter."""

    def __init__(self, links: Iterable[Link] = ()):
        self._rows = Rows(kind=_LINK)
        self._closed_forms: list[Array | None] = []
        self._new = list(links)  # not among the rows yet

    @classmethod
    def of(cls, links: Sequence[Link]) -> Links:
        """These by columns."""
        return links if isinstance(links, cls) else cls(links)

    def add(self, links: Iterable[Link]) -> None:
        """Appends."""
        self._new += links

    def kept(self, mask: NDArray[np.bool_]) -> Links:
        """Those of a mask (n,); these themselves where all are."""
        if mask.all():
            return self
        kept = Links()
        kept._rows = Rows.of(self._table[mask])
        kept._closed_forms = [form for form, stays in zip(self._closed_forms, mask.tolist(), strict=True) if stays]
        return kept

    def __len__(self) -> int:
        return len(self._rows) + len(self._new)

    @overload
    def __getitem__(self, k: int) -> Link: ...

    @overload
    def __getitem__(self, k: slice) -> list[Link]: ...

    def __getitem__(self, k: int | slice) -> Link | list[Link]:
        if isinstance(k, slice):
            return [self[at] for at in range(*k.indices(len(self)))]
        i, j, i_from_j, information, overlap, n_points, shared_by = self._table[k]
        numbers = float(overlap), int(n_points), int(shared_by)
        return Link(int(i), int(j), i_from_j, inverses(information[None])[0], *numbers, self._closed_forms[k])

    @property
    def i(self) -> NDArray[np.int64]:
        """(n,) numbers of the earlier key points."""
        return self._table["i"]

    @property
    def j(self) -> NDArray[np.int64]:
        """(n,) numbers of the later ones."""
        return self._table["j"]

    @property
    def i_from_j(self) -> Array:
        """(n, 4, 4) motions."""
        return self._table["i_from_j"]

    @property
    def cov(self) -> Array:
        """(n, 6, 6) their covariances."""
        return inverses(self.information)

    @property
    def own_cov(self) -> Array:
        """(n, 6, 6) those of each alone."""
        return self.cov / self._table["shared_by"][:, None, None]

    @property
    def information(self) -> Array:
        """(n, 6, 6) inverse covariances, which is what is kept."""
        return self._table["information"]

    @property
    def n_points(self) -> NDArray[np.int64]:
        """(n,) matched points; 0 where frame-to-frame motion stands in."""
        return self._table["n_points"]

    @property
    def by_closed_form(self) -> tuple[NDArray[np.bool_], Array]:
        """Which links (n,) have a closed form, and theirs (m, 4, 4)."""
        found = [form for form in self._closed_forms if form is not None]
        return np.array([form is not None for form in self._closed_forms], bool), np.array(found).reshape(-1, 4, 4)

    @property
    def _table(self) -> NDArray[Any]:
        if self._new:
            new, self._new = self._new, []
            *columns, closed_forms = zip(*new, strict=True)
            table = np.empty(len(new), _LINK)
            for name, column in zip(_LINK.names, columns, strict=True):
                table[name] = inverses(np.array(column)) if name == "information" else column
            self._rows.add(table)
            self._closed_forms += closed_forms
        return self._rows.array


def inverses(covs: Array) -> Array:
    """Information of covariances (m, d, d), or the other way round; symmetric to the last bit."""
    found = np.asarray(np.linalg.inv(covs), np.float64)
    found = found + found.transpose(0, 2, 1)
    found /= 2
    return found


class Alignment(NamedTuple):
    """One global alignment: which track closed it, its cost in time and size."""

    track: int
    ms: float
    nodes: int
    edges: int
    dropped: int


class Look(NamedTuple):
    """What a look with both eyes had to go by, whether it made a key point or not.

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

    ``key_frames`` are the rows of the trajectories that are key points; ``track_of_key`` the track (from 1) of each.
    ``node_cov`` (n_keys, 6, 6) is the marginal covariance of each final key-point pose, in the camera.
    ``before_ga``/``after_ga`` hold per track the key points' positions (n, 3) just before and after its alignment.
    ``looks`` are all with both eyes, also those that found too little for a key point.
    """

    f2f: Trajectory
    online: Trajectory
    final: Trajectory
    key_frames: NDArray[np.int64]
    track_of_key: NDArray[np.int64]
    node_cov: Array
    links: Links = field(default_factory=Links)
    alignments: list[Alignment] = field(default_factory=list)
    before_ga: list[Array] = field(default_factory=list)
    after_ga: list[Array] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)


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
        seen: (rows, cols) bool, cells that at least one key point truly saw with both eyes.
    """

    trajectory: Trajectory
    reference: Array
    holding: NDArray[np.bool_]
    track: NDArray[np.int64]
    height_m: NDArray[np.float32]
    seen: NDArray[np.bool_]
