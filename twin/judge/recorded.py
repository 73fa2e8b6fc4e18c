"""Comparison of a replay with its recorded truth: path (association by time, alignment, misfit) and map."""

from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from twin.core import geometry
from twin.core.records import Array, ElevationMap, MapGrid, SurveyResult, Trajectory, Truth
from twin.core.series import nearest_index
from twin.judge.consistency import position_consistency
from twin.judge.map_error import KEYS, map_metrics
from twin.judge.trajectory_errors import PathErrors, anchor, pose_errors

#: How an estimate is moved to the truth before the comparison. se3: by the rigid motion that minimises the squared
#: position errors (Umeyama 1991, without scale); first: by the motion that maps the first pose to the true one; none:
#: not at all.
AlignmentName = Literal["se3", "first", "none"]
ALIGNMENTS: tuple[AlignmentName, ...] = get_args(AlignmentName)
#: Largest time difference of associated poses [s]; the default of evo.
MAX_DIFFERENCE_S = 0.01
_MIN_ASSOCIATED = 3  # two positions leave the rotation about the line through them undetermined
_MAX_AXIS_DEG, _MAX_EXTENT_RATIO = 5.0, 2.0
_MAX_AXIS_SIGMA_DEG = 10.0  # where the turn is less certain, it is not judged: along a line or noise, any turn fits
_SIGNIFICANT = 3.0  # standard deviations of the turn of the axes
_BLOCKS = 4  # parts of the path, left out one at a time for the standard deviation of the turn
_LEAST_COVERED = 0.5  # of the frames, which have a true pose, without a warning
_MOST_OFFSET_S, _OFFSET_STEP_S = 2.0, 0.05  # of the clock of the truth that is searched for, and steps of the search
_CLEARLY = 0.3
_SAME_CURVATURE = 1e-3  # relative difference of rotation / displacement of two steps of one screw motion
_LEAST_TURN_RAD = 1e-5  # of a step whose curvature is compared
_MOST_STEPS = 20
_CONVERGED_M = 1e-5
_LEAST_COSINE = 0.7  # of the angle between the axes of height; a map of a wall is not compared with a height grid
_ROWS_PER_CALL = 256
#: Metrics of the map that need to know which cells the cameras saw, which area was asked for or where objects are.
_UNKNOWN = [key for key in KEYS if key.startswith(("completeness", "le90_area", "floor_", "objects_"))]


class RecordedTruth(NamedTuple):
    """Truth of a replay, as far as it was recorded."""

    trajectory: Trajectory | None  #: true poses of the left camera; None: not known
    alignment: AlignmentName  #: motion that is applied to the estimates before the comparison
    heights_m: NDArray[np.float32] | None = None  #: (rows, cols) true heights at the cells of the map; None: not known


class Associated(NamedTuple):
    """Pairs of rows (n,) of an estimated and a true trajectory with matching times."""

    estimate: NDArray[np.int64]
    truth: NDArray[np.int64]


def associate(estimated_s: Array, true_s: Array) -> Associated:
    """Associates the poses of two trajectories by time as evo does (`evo.core.sync.associate_trajectories`).

    Each pose of the shorter trajectory goes with the nearest of the longer one, at times (n,) and (m,) [s] that differ
    by at most `MAX_DIFFERENCE_S`; unlike there, of several true poses of a frame, only the closest goes with it.
    """
    truth_longer = len(true_s) > len(estimated_s)
    short, long = (estimated_s, true_s) if truth_longer else (true_s, estimated_s)
    if not len(short):
        return Associated(np.zeros(0, np.int64), np.zeros(0, np.int64))
    order = np.argsort(long, kind="stable")
    nearest = order[nearest_index(long[order], short)]
    differences = np.abs(long[nearest] - short)
    frames, closest = np.arange(len(short)) if truth_longer else nearest, np.argsort(differences, kind="stable")
    kept = np.sort(closest[np.unique(frames[closest], return_index=True)[1]])
    kept = kept[differences[kept] <= MAX_DIFFERENCE_S]
    return Associated(kept, nearest[kept]) if truth_longer else Associated(nearest[kept], kept)


def rigid_alignment(estimated: Array, true: Array) -> Array:
    """Returns true_from_estimated (4, 4) with the least squared errors of positions (n, 3) (Umeyama 1991)."""
    centre, true_centre = estimated.mean(axis=0), true.mean(axis=0)
    u, _, vt = np.linalg.svd((true - true_centre).T @ (estimated - centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt
    return geometry.pose(rotation, true_centre - rotation @ centre)


def true_from_world(estimate: Trajectory, truth: Trajectory, alignment: AlignmentName) -> Array:
    """Returns the transform (4, 4) that moves an estimate to the truth; the identity with too few common poses."""
    a, b = _associated_poses(estimate, truth)
    if alignment == "none" or len(a) < (_MIN_ASSOCIATED if alignment == "se3" else 1):
        return np.eye(4)
    if alignment == "first":
        return anchor(a.world_from_camera[0], b.world_from_camera[0])
    return rigid_alignment(a.positions, b.positions)


def in_world(truth: Trajectory, estimate: Trajectory, alignment: AlignmentName) -> Trajectory:
    """Returns the truth, moved to the world of an estimate."""
    world_from_true = geometry.inverse(true_from_world(estimate, truth, alignment))
    return Trajectory(truth.times_s, world_from_true @ truth.world_from_camera)


def are_comparable(estimate: Trajectory, truth: Trajectory) -> bool:
    """Returns whether enough frames have a true pose for errors of any alignment."""
    return len(associate(estimate.times_s, truth.times_s).truth) >= _MIN_ASSOCIATED


def recorded_errors(estimate: Trajectory, truth: Trajectory, alignment: AlignmentName) -> PathErrors:
    """Returns the errors of the aligned estimate at the frames that have a true pose; empty for fewer than three."""
    a, b = _associated_poses(estimate, truth)
    if len(a) < _MIN_ASSOCIATED:
        return pose_errors(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)))
    return pose_errors(true_from_world(estimate, truth, alignment) @ a.world_from_camera, b.world_from_camera)


def recorded_consistency(result: SurveyResult, truth: Trajectory, alignment: AlignmentName) -> dict[str, float | None]:
    """Returns `consistency.*` of the positions of the keyframes that have a true pose.

    Errors are those after the alignment: without the keyframe at which it was done for "first", and smaller than
    before for "se3", as it takes a part of them. Errors of the truth count as errors of the estimate; empty if it is
    interpolated, or fewer than three frames have a true pose.
    """
    n, final = min(len(result.keyframe_rows), len(result.node_cov)), result.final
    rows = associate(final.times_s, truth.times_s)
    if len(rows.truth) < _MIN_ASSOCIATED or _interpolated(truth) or _interpolated(_selected(truth, rows.truth)):
        return {}
    used = np.flatnonzero(np.isin(result.keyframe_rows[:n], rows.estimate))
    used = used[1:] if alignment == "first" else used
    frames, order = result.keyframe_rows[used], np.argsort(rows.estimate)
    true = truth.world_from_camera[rows.truth[order][np.searchsorted(rows.estimate, frames, sorter=order)]]
    return position_consistency(
        result, true_from_world(final, truth, alignment) @ final.world_from_camera[frames], true, used
    )


def truth_warnings(estimate: Trajectory, truth: Trajectory) -> list[str]:
    """Returns warnings if the truth seems to have another clock, unit, scale or body; none below three frames."""
    if len(estimate) < _MIN_ASSOCIATED:
        return []
    if not len(truth):
        return ["The truth has no poses."]
    a, b = _associated_poses(estimate, truth)
    if len(a) < _MIN_ASSOCIATED:
        return [
            f"Only {len(a)} frames have a true pose within {1000 * MAX_DIFFERENCE_S:g} ms: frames are from "
            f"{estimate.times_s[0]:.3f} to {estimate.times_s[-1]:.3f} s, the truth from {truth.times_s.min():.3f} to "
            f"{truth.times_s.max():.3f} s after the first frame. The truth seems to have another clock."
        ]
    found = []
    if len(a) < _LEAST_COVERED * len(estimate):
        found.append(f"Only {len(a)} of {len(estimate)} frames have a true pose; errors are those of these frames.")
    if (clock := _clock_offset(estimate, truth)) is not None:
        offset_s, shifted_m, as_given_m = clock
        found.append(
            f"The path fits the truth to {shifted_m:.2g} m if the true times are shifted by {offset_s:+.2f} s, "
            f"otherwise to {as_given_m:.2g} m: the truth seems to have another clock."
        )
    extents = [float(np.linalg.norm(np.ptp(path.positions, axis=0))) for path in (a, b)]  # noise adds to lengths
    if max(extents) > max(_MAX_EXTENT_RATIO * min(extents), 0.05):
        found.append(
            f"The true path extends over {extents[1]:.3g} m, the estimated one over {extents[0]:.3g} m: the truth "
            "seems to have another unit or scale."
        )
    angle_deg, sigma_deg = _axis_turn_deg(a, b)
    least_deg = max(_MAX_AXIS_DEG, _SIGNIFICANT * sigma_deg)
    if min(angle_deg, _turn_of_positions_deg(a, b)) > least_deg and sigma_deg < _MAX_AXIS_SIGMA_DEG:
        found.append(
            f"The axes of the truth are turned by {angle_deg:.0f} degrees (sigma {sigma_deg:.0f}) from those of the "
            "left camera: the truth seems to be that of another body."
        )
    if _interpolated(b) or _interpolated(truth):
        found.append(
            "The true poses lie on the same screw motion for most of the frames: they seem to be interpolated, so the"
            " errors of attitude and across the path, and the covariances, cannot be judged by them."
        )
    return found


def _interpolated(truth: Trajectory) -> bool:
    """Returns whether most steps have the rotation per displacement of the last at varying speed: a screw motion."""
    # Poses are interpolated by it; the rotation of a real vehicle varies with its speed.
    poses = truth.world_from_camera[np.argsort(truth.times_s, kind="stable")]
    steps = [geometry.inverse(a) @ b for a, b in zip(poses[:-1], poses[1:], strict=True)]
    turns = np.array([geometry.so3_log(step[:3, :3]) for step in steps]).reshape(-1, 3)
    lengths_m = np.array([np.linalg.norm(step[:3, 3]) for step in steps])
    curvature = turns / np.maximum(lengths_m, 1e-9)[:, None]
    same = np.linalg.norm(np.diff(curvature, axis=0), axis=1) < _SAME_CURVATURE * np.linalg.norm(curvature[1:], axis=1)
    same &= np.linalg.norm(turns[1:], axis=1) > _LEAST_TURN_RAD
    if len(same) < _MIN_ASSOCIATED or np.std(lengths_m) <= _SAME_CURVATURE * np.mean(lengths_m):
        return False
    return float(np.mean(same)) > _LEAST_COVERED


def _clock_offset(estimate: Trajectory, truth: Trajectory) -> tuple[float, float, float] | None:
    """Returns the shift of the true times [s] that clearly reduces the RMS misfit [m], without and with it; or None."""
    # misfit after a rigid alignment, with the truth interpolated; shifts within `_MOST_OFFSET_S`
    order = np.argsort(truth.times_s, kind="stable")
    true_s, true_m, times_s = truth.times_s[order], truth.positions[order], estimate.times_s
    if len(true_s) < _MIN_ASSOCIATED:
        return None
    step_s = max(float(np.median(np.diff(true_s))), _OFFSET_STEP_S)
    shifts_s = np.arange(-round(_MOST_OFFSET_S / step_s), round(_MOST_OFFSET_S / step_s) + 1) * step_s

    def misfit_m(shift_s: float) -> float:
        inside = (times_s >= true_s[0] + shift_s) & (times_s <= true_s[-1] + shift_s)
        if inside.sum() < max(_MIN_ASSOCIATED, _LEAST_COVERED * len(times_s)):
            return np.inf
        estimated = estimate.positions[inside]
        true = np.column_stack([np.interp(times_s[inside], true_s + shift_s, axis) for axis in true_m.T])
        moved = geometry.transform(rigid_alignment(estimated, true), estimated)
        return float(np.sqrt(np.mean(np.sum((moved - true) ** 2, axis=1))))

    misfits_m = np.array([misfit_m(shift_s) for shift_s in shifts_s])
    best, as_given_m = int(np.argmin(misfits_m)), float(misfits_m[len(shifts_s) // 2])
    if abs(shifts_s[best]) <= step_s or np.isinf(as_given_m) or not misfits_m[best] < _CLEARLY * as_given_m:
        return None
    return float(shifts_s[best]), float(misfits_m[best]), as_given_m


def _axis_turn_deg(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Returns the turn of the axes of true bodies from those of the camera, and its sigma by jackknife [deg]."""
    # That between the rotations that fit positions and attitudes; without one of `_BLOCKS` parts of the path at a time
    # (Kuensch 1989), so correlated errors count; over a nearly still path it is as large as the angle.
    block = np.arange(len(truth)) * _BLOCKS // len(truth)
    kept = [block != k for k in range(-1, _BLOCKS)]  # first all rows
    turns = [_axis_turn(_selected(estimate, rows), _selected(truth, rows)) for rows in kept]
    changes = [geometry.so3_log(turns[0].T @ part) for part in turns[1:]]
    sigma = np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum(np.square(changes)))
    return float(np.rad2deg(np.linalg.norm(geometry.so3_log(turns[0])))), float(np.rad2deg(sigma))


def _turn_of_positions_deg(estimate: Trajectory, truth: Trajectory) -> float:
    """Returns the angle by which these two rotations turn the positions apart [deg]: 0 about a straight path."""
    by_position = rigid_alignment(estimate.positions, truth.positions)[:3, :3]
    turns = truth.world_from_camera[:, :3, :3] @ np.swapaxes(estimate.world_from_camera[:, :3, :3], 1, 2)
    by_attitude = geometry.nearest_rigid(geometry.pose(turns.mean(axis=0), np.zeros(3)))[:3, :3]
    centred = estimate.positions - estimate.positions.mean(axis=0)
    chord = np.linalg.norm(centred @ (by_position - by_attitude).T) / max(float(np.linalg.norm(centred)), 1e-12)
    return float(np.rad2deg(2 * np.arcsin(min(chord / 2, 1.0))))


def _axis_turn(estimate: Trajectory, truth: Trajectory) -> Array:
    """Returns the mean rotation (3, 3) of the true bodies in the axes of the camera, once the positions are aligned."""
    rotation = rigid_alignment(estimate.positions, truth.positions)[:3, :3]
    turns = np.swapaxes(rotation @ estimate.world_from_camera[:, :3, :3], 1, 2) @ truth.world_from_camera[:, :3, :3]
    return geometry.nearest_rigid(geometry.pose(turns.mean(axis=0), np.zeros(3)))[:3, :3]


def _associated_poses(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    rows = associate(estimate.times_s, truth.times_s)
    return _selected(estimate, rows.estimate), _selected(truth, rows.truth)


def _selected(path: Trajectory, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Trajectory:
    return Trajectory(path.times_s[rows], path.world_from_camera[rows])


class TrueMap(NamedTuple):
    """True heights in the frame of the true trajectory."""

    grid: MapGrid  #: cells of the heights
    height_m: Array  #: (rows, cols) heights at the centres of the cells; NaN where unknown


def true_heights(elevation: ElevationMap, true: TrueMap, true_from_world: Array) -> NDArray[np.float32] | None:
    """Returns the true height at the centres of the cells of a map (rows, cols) [m], NaN where unknown.

    Heights are along the axis of height of the map; None if those of map and truth are not within 45 degrees. Iteration
    from the height of the map: the point (x, y, h) of a cell, moved by `true_from_world` (4, 4), is compared with the
    true height there, and h reduced by the difference. In a level frame one step is exact; with a tilt t it converges
    where the slope is below 1 / tan t.
    """
    true_from_map = true_from_world @ geometry.inverse(elevation.map_from_world)
    cosine = float(true_from_map[2, 2])
    if cosine < _LEAST_COSINE:
        return None
    x, y = elevation.grid.centres()
    height = np.empty(elevation.height_m.shape, np.float32)
    known = elevation.height_m[np.isfinite(elevation.height_m)]
    middle = float(np.median(known)) if len(known) else 0.0
    for row in range(0, len(y), _ROWS_PER_CALL):
        part = slice(row, row + _ROWS_PER_CALL)
        level = np.where(np.isfinite(elevation.height_m[part]), elevation.height_m[part], middle).astype(np.float64)
        points = np.stack([*np.meshgrid(x, y[part]), level], axis=-1).reshape(-1, 3)
        for _ in range(_MOST_STEPS):
            moved = geometry.transform(true_from_map, points)
            step = (moved[:, 2] - _height_at(true, moved[:, 0], moved[:, 1])) / cosine
            points[:, 2] -= step
            if not np.nanmax(np.abs(step), initial=0.0) > _CONVERGED_M:
                break
        height[part] = points[:, 2].reshape(level.shape)
    return height


def _height_at(true: TrueMap, x: Array, y: Array) -> Array:
    """Returns true heights (n,) at positions, interpolated bilinearly; NaN outside and beside unknown cells."""
    grid = true.grid
    rows, cols = (grid.north_m - y) / grid.cell_m - 0.5, (x - grid.west_m) / grid.cell_m - 0.5
    return map_coordinates(true.height_m, [rows, cols], order=1, mode="constant", cval=np.nan)


def recorded_map_metrics(elevation: ElevationMap, heights: NDArray[np.float32]) -> dict[str, float | None]:
    """Returns `map.*` of metrics.json over the cells (rows, cols) with `true_heights`; None if it needs more."""
    cells = np.isfinite(heights)
    return map_metrics(elevation, truth_without_flight(heights, cells, np.zeros_like(cells))) | dict.fromkeys(_UNKNOWN)


def truth_without_flight(height_m: NDArray[np.float32], seen: NDArray[np.bool_], asked: NDArray[np.bool_]) -> Truth:
    none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    return Truth(none, np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0, np.int64), height_m, seen, asked)
