"""Evaluation of a replayed survey: errors against a recorded truth; without one, consistency only."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, ElevationMap, SurveyResult, Trajectory
from twin.core.series import nearest_index
from twin.judge.links import ALONG_NODES, linked_nodes, node_distance
from twin.judge.metrics import SCHEMA, empty_metrics, timing_metrics
from twin.judge.self_check import self_check_metrics
from twin.judge.stereo_quality import stereo_quality
from twin.judge.summary_statistics import finite_tree, percentile
from twin.judge.trajectory import PathErrors, anchor, cumulative_length, trajectory_metrics
from twin.judge.true_map import recorded_map_metrics
from twin.judge.warnings import metric_warnings

#: How an estimate is moved to the truth before the comparison. se3: by the rigid motion that minimises the squared
#: position errors (Umeyama 1991, without scale); first: by the motion that maps the first pose to the true one; none:
#: not at all.
AlignmentName = Literal["se3", "first", "none"]
ALIGNMENTS: tuple[AlignmentName, ...] = get_args(AlignmentName)
#: Largest time difference of associated poses [s]; the default of evo.
MAX_DIFFERENCE_S = 0.01
#: Keys of `network_residuals`.
NETWORK_KEYS = ("links", "loops", "loop_translation_m", "loop_rotation_deg", "loop_chi2")
_MIN_ASSOCIATED = 3  # two positions leave the rotation about the line through them undetermined
_MAX_AXIS_DEG, _MAX_EXTENT_RATIO = 5.0, 2.0
_MAX_AXIS_SIGMA_DEG = 10.0  # where the turn is less certain, it is not judged: along a line or noise, any turn fits
_SIGNIFICANT = 3.0  # standard deviations of the turn of the axes
_BLOCKS = 4  # parts of the path, left out one at a time for the standard deviation of the turn


class Associated(NamedTuple):
    """Pairs of rows of an estimated and a true trajectory with matching times.

    Args:
        estimate: (n,) rows of the estimated trajectory.
        truth: (n,) rows of the true trajectory.
    """

    estimate: NDArray[np.int64]
    truth: NDArray[np.int64]


@dataclass(frozen=True)
class ReplayEvaluation:
    """Input of `evaluate_replay`.

    Args:
        result: output of the estimators.
        truth: recorded poses of the left camera; None if there is no truth.
        alignment: rigid motion that is applied to the estimates before the comparison, see `true_from_world`.
        elevation: the map; None without one.
        timing: wall_s, simulated_s, peak_rss_mb and stages, as in `metrics.EvaluationInput`.
        identity: name, seed, version, scenario_hash, status and reason.
        source: description of the data set (reader, number of skipped frames by reason, etc.), copied to `replay`.
        warnings: sentences on limits of the data set.
        true_heights_m: (rows, cols) true heights at the cells of the map (`true_map.true_heights`); None if unknown.
    """

    result: SurveyResult
    truth: Trajectory | None
    alignment: AlignmentName
    elevation: ElevationMap | None
    timing: dict[str, Any]
    identity: dict[str, Any]
    source: dict[str, Any] = field(default_factory=dict[str, Any])
    warnings: tuple[str, ...] = ()
    true_heights_m: NDArray[np.float32] | None = None


def evaluate_replay(survey: ReplayEvaluation) -> dict[str, Any]:
    """Returns the contents of metrics.json of a replayed survey, with the keys of `metrics.evaluate`.

    The trajectories and, with true heights, the map are compared with the truth; without one, their errors are None.
    The other metrics that need a truth (links, control, etc.) are None, 0 or empty. The key `replay` holds the
    description of the data set, the alignment, the number of frames with a true pose, and the consistency of the
    network (`network_residuals`).
    """
    result, truth = survey.result, survey.truth
    trajectories, warnings, n_associated = dict[str, Any](), list(survey.warnings), 0
    if truth is not None:
        n_associated = len(associate(result.final.times_s, truth.times_s).estimate)
        warnings += truth_warnings(result.final, truth)
        trajectories = {
            name: trajectory_metrics(recorded_errors(path, truth, survey.alignment))
            for name, path in (("f2f", result.f2f), ("online", result.online), ("final", result.final))
        }
    empty = empty_metrics()
    metrics = empty | survey.identity | {
        "schema": SCHEMA,
        "trajectory": empty["trajectory"] | trajectories,
        "map": empty["map"] | _map_metrics(survey),
        "links": empty["links"] | {"bridged": int((result.links.n_points == 0).sum())},
        "vision": stereo_quality(result),
        "self_check": self_check_metrics(result),
        "timing": timing_metrics(survey.timing, len(result.online), len(result.keyframe_rows)),
        "replay": survey.source
        | {
            "alignment": None if truth is None else survey.alignment,
            "frames_with_truth": n_associated,
            "network": network_residuals(result),
        },
    }  # fmt: skip
    return _with_warnings(finite_tree(metrics), warnings)


def _map_metrics(survey: ReplayEvaluation) -> dict[str, float | None]:
    """Returns the metrics of the map: its cell size, and errors if the true heights are known."""
    if survey.elevation is None or survey.true_heights_m is None:
        return {"cell_m": None if survey.elevation is None else survey.elevation.grid.cell_m}
    return recorded_map_metrics(survey.elevation, survey.true_heights_m)


def unevaluated_replay(survey: ReplayEvaluation) -> dict[str, Any]:
    """Returns the metrics of a replay that was not evaluated.

    They hold schema, identity, description of the data set, timing and warnings; all others are None, 0 or empty.
    """
    result = survey.result
    unknown = {"alignment": None, "frames_with_truth": 0, "network": dict.fromkeys(NETWORK_KEYS)}
    metrics = empty_metrics() | survey.identity | {
        "schema": SCHEMA,
        "timing": timing_metrics(survey.timing, len(result.online), len(result.keyframe_rows)),
        "replay": survey.source | unknown,
    }  # fmt: skip
    return _with_warnings(finite_tree(metrics), list(survey.warnings))


def _with_warnings(metrics: dict[str, Any], warnings: list[str]) -> dict[str, Any]:
    """Returns the metrics with the given warnings and those that follow from the metrics themselves."""
    found = [*warnings, *metric_warnings(metrics)]
    return metrics | {"warnings": found, "warning": " ".join(found), "idealisations": [], "require": {}}


def associate(estimated_s: Array, true_s: Array, max_difference_s: float = MAX_DIFFERENCE_S) -> Associated:
    """Associates the poses of two trajectories by time as evo does (`evo.core.sync.associate_trajectories`).

    Each pose of the shorter trajectory is associated with the pose of the longer one whose time is nearest, if the two
    times differ by at most `max_difference_s`.

    Args:
        estimated_s, true_s: (n,) and (m,) times of the poses [s].
        max_difference_s: largest difference of the times [s].
    """
    truth_longer = len(true_s) > len(estimated_s)
    short, long = (estimated_s, true_s) if truth_longer else (true_s, estimated_s)
    if not len(short):
        return Associated(np.zeros(0, np.int64), np.zeros(0, np.int64))
    order = np.argsort(long, kind="stable")
    nearest = order[nearest_index(long[order], short)]
    kept = np.flatnonzero(np.abs(long[nearest] - short) <= max_difference_s)
    pair = (kept, nearest[kept]) if truth_longer else (nearest[kept], kept)
    return Associated(*pair)


def rigid_alignment(estimated: Array, true: Array) -> Array:
    """Returns true_from_estimated (4, 4), the rigid motion with the smallest squared position errors (Umeyama 1991).

    Args:
        estimated, true: (n, 3) positions [m], associated row by row.
    """
    centre, true_centre = estimated.mean(axis=0), true.mean(axis=0)
    u, _, vt = np.linalg.svd((true - true_centre).T @ (estimated - centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt
    return geometry.pose(rotation, true_centre - rotation @ centre)


def true_from_world(estimate: Trajectory, truth: Trajectory, alignment: AlignmentName) -> Array:
    """Returns the transform (4, 4) from the world frame of an estimate to that of a truth.

    Args:
        estimate, truth: poses that are associated row by row.
        alignment: "se3": best rigid fit of all positions; "first": the first poses coincide; "none": identity.
    """
    if alignment == "none":
        return np.eye(4)
    if alignment == "first":
        return anchor(estimate.world_from_camera[0], truth.world_from_camera[0])
    return rigid_alignment(estimate.positions, truth.positions)


def world_alignment(estimate: Trajectory, truth: Trajectory, alignment: AlignmentName) -> Array:
    """Returns the transform (4, 4) that moves an estimate to the truth, from the poses that are associated by time.

    It is the identity if fewer than three frames have a true pose.
    """
    a, b = _associated_poses(estimate, truth)
    return np.eye(4) if len(a) < _MIN_ASSOCIATED else true_from_world(a, b, alignment)


def recorded_errors(estimate: Trajectory, truth: Trajectory, alignment: AlignmentName) -> PathErrors:
    """Returns the errors of the aligned estimate at the frames that have a true pose.

    The errors are empty if fewer than three frames have a true pose.
    """
    a, b = _associated_poses(estimate, truth)
    if len(a) < _MIN_ASSOCIATED:
        return PathErrors(np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    moved, true = true_from_world(a, b, alignment) @ a.world_from_camera, b.world_from_camera
    heading = geometry.heading_of_camera(moved) - geometry.heading_of_camera(true)
    return PathErrors(cumulative_length(b.positions), moved[:, :3, 3] - true[:, :3, 3], geometry.wrap_angle(heading))


def truth_warnings(estimate: Trajectory, truth: Trajectory) -> list[str]:
    """Returns warnings if the truth seems to have another clock, unit, scale or body than the estimate.

    There are no warnings if the estimate has fewer than three frames, as after an early interrupt.
    """
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
    extents = [float(np.linalg.norm(np.ptp(path.positions, axis=0))) for path in (a, b)]  # noise adds to lengths
    if max(extents) > max(_MAX_EXTENT_RATIO * min(extents), 0.05):
        found.append(
            f"The true path extends over {extents[1]:.3g} m, the estimated one over {extents[0]:.3g} m: the truth "
            "seems to have another unit or scale."
        )
    angle_deg, sigma_deg = axis_turn_deg(a, b)
    if angle_deg > max(_MAX_AXIS_DEG, _SIGNIFICANT * sigma_deg) and sigma_deg < _MAX_AXIS_SIGMA_DEG:
        found.append(
            f"The axes of the truth are turned by {angle_deg:.0f} degrees (sigma {sigma_deg:.0f}) from those of the "
            "left camera: the truth seems to be that of another body."
        )
    return found


def axis_turn_deg(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Returns the angle by which the axes of the true bodies are turned from those of the camera, and its sigma [deg].

    The angle is that between the rotation that fits the positions and the one that fits the attitudes. The standard
    deviation is that of the jackknife that leaves out one of `_BLOCKS` parts of the path at a time (Kuensch 1989), so
    errors that are correlated along the path count; over a nearly still path it is as large as the angle.

    Args:
        estimate, truth: poses that are associated row by row.
    """
    block = np.arange(len(truth)) * _BLOCKS // len(truth)
    kept = [block != k for k in range(-1, _BLOCKS)]  # first all rows
    turns = [_axis_turn(_selected(estimate, rows), _selected(truth, rows)) for rows in kept]
    changes = [geometry.so3_log(turns[0].T @ part) for part in turns[1:]]
    sigma = np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum(np.square(changes)))
    return float(np.rad2deg(np.linalg.norm(geometry.so3_log(turns[0])))), float(np.rad2deg(sigma))


def _axis_turn(estimate: Trajectory, truth: Trajectory) -> Array:
    """Returns the mean rotation (3, 3) of the true bodies in the axes of the camera, once the positions are aligned."""
    rotation = rigid_alignment(estimate.positions, truth.positions)[:3, :3]
    turns = np.swapaxes(rotation @ estimate.world_from_camera[:, :3, :3], 1, 2) @ truth.world_from_camera[:, :3, :3]
    return geometry.nearest_rigid(geometry.pose(turns.mean(axis=0), np.zeros(3)))[:3, :3]


def network_residuals(result: SurveyResult) -> dict[str, float | int | None]:
    """Returns the consistency of the network: residuals of the links at the final poses of their keyframes.

    `links` is the number of links with matched points, `loops` the number of those whose nodes are more than two nodes
    apart. The residual of a link is log(M^-1 T), with M its measured motion and T the motion between the final poses.
    `loop_translation_m` and `loop_rotation_deg` are the medians over the loops of the norms of the translation and of
    the rotation in their residuals. `loop_chi2` is the mean of r' C^-1 r / 6 over their residuals r, with C the
    covariance of the measurement; it is below about 1 for consistent covariances. These three values are None without
    loops. They are not errors: an error that all links have in common does not appear in them.
    """
    measured = result.links.select(result.links.n_points > 0)
    loops = measured.select(node_distance(measured, linked_nodes(result.links)) > ALONG_NODES)
    poses = result.final.world_from_camera[result.keyframe_rows]
    found: dict[str, float | int | None] = {"links": len(measured), "loops": len(loops)}
    if not len(loops):
        return dict.fromkeys(NETWORK_KEYS) | found
    residuals = np.array(
        [
            geometry.log(geometry.inverse(motion) @ geometry.inverse(poses[i]) @ poses[j])
            for i, j, motion in zip(loops.i, loops.j, loops.i_from_j, strict=True)
        ]
    )
    chi2 = np.einsum("ni,ni->n", residuals, np.linalg.solve(loops.own_cov, residuals[..., None])[..., 0])
    return found | {
        "loop_translation_m": percentile(np.linalg.norm(residuals[:, 3:], axis=1), 50),
        "loop_rotation_deg": percentile(np.rad2deg(np.linalg.norm(residuals[:, :3], axis=1)), 50),
        "loop_chi2": float(np.mean(chi2) / 6),
    }


def _associated_poses(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Returns the associated poses of both trajectories, row by row (`associate`)."""
    rows = associate(estimate.times_s, truth.times_s)
    return _selected(estimate, rows.estimate), _selected(truth, rows.truth)


def _selected(path: Trajectory, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Trajectory:
    """Returns the poses of a trajectory in the given rows or where a mask is true."""
    return Trajectory(path.times_s[rows], path.world_from_camera[rows])
