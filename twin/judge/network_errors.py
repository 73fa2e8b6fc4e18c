"""Errors of the network: measured motions between keyframes, and keyframes after each positioning stage."""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.links import Links
from twin.core.records import Array, SurveyResult, Trajectory, Truth
from twin.judge.consistency import nees
from twin.judge.summary_statistics import mean, percentile, rms
from twin.judge.trajectory_errors import path_errors
from twin.kernels import kernel

#: A link is "along" if it connects a node to one of the two nodes before it (Negahdaripour & Madjidi 2003). All other
#: links are "across": to earlier nodes of the same swath, to neighbouring swaths, to the start of a loop.
_ALONG_NODES = 2
#: Positioning stages in the order in which they are applied.
STAGES = ("f2f", "chain", "online", "final")
#: Keys of `network_residuals`.
NETWORK_KEYS = ("links", "loops", "loop_translation_m", "loop_rotation_deg", "loop_chi2")


def link_metrics(result: SurveyResult, truth: Truth) -> dict[str, Any]:
    """Returns `links` of metrics.json: errors of links to the two previous nodes (along) and of all others (across).

    `bridged` links consist of frame-to-frame motion, as their measurement failed; their errors are not evaluated.
    """
    along, across = _measured_links(result)
    true = truth.trajectory.world_from_camera[result.keyframe_rows]
    return {
        "along": _link_errors(along, true),
        "across": _link_errors(across, true),
        "bridged": len(result.links) - len(along) - len(across),
    }


def _measured_links(result: SurveyResult) -> tuple[Links, Links]:
    measured = result.links.select(result.links.n_points > 0)
    near = _node_distance(measured, _linked_nodes(result.links)) <= _ALONG_NODES
    return measured.select(near), measured.select(~near)


def _linked_nodes(links: Links) -> NDArray[np.int64]:
    return np.unique(np.concatenate([links.i, links.j]))


def _node_distance(links: Links, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the distance (n,) between the two nodes of each link, counted in nodes: 1 for consecutive nodes."""
    return np.searchsorted(nodes, links.j) - np.searchsorted(nodes, links.i)


def _link_errors(links: Links, world_from_keyframe: Array) -> dict[str, float | int | None]:
    """Returns number, RMS errors log(T^-1 E) and mean NEES (6 if consistent) of links, and those of closed forms."""

    def errors_of(some: Links, motions: Array) -> Array:
        return _motion_errors(world_from_keyframe[some.i], world_from_keyframe[some.j], np.ascontiguousarray(motions))

    has_closed_form, closed_forms = links.by_closed_form
    errors, closed_errors = errors_of(links, links.i_from_j), errors_of(links.select(has_closed_form), closed_forms)
    return {
        "count": len(links),
        **_rmse(errors),
        "nees_mean": mean(nees(errors, links.own_cov)),
        **{f"closed_form_{key}": value for key, value in _rmse(closed_errors).items()},
    }


@kernel
def _motion_errors(true_i, true_j, estimates):
    """Returns the errors (n, 6) of motions (n, 4, 4) as twists [rotation, translation] in camera j (rad, m)."""
    errors = np.empty((len(true_i), 6))
    for k in range(len(true_i)):
        j_from_i = geometry.compose(geometry.inverse(true_j[k]), true_i[k])
        geometry.copy_into(errors[k], geometry.log(geometry.compose(j_from_i, estimates[k])))
    return errors


def _rmse(errors: Array) -> dict[str, float | None]:
    return {
        "rotation_rmse_deg": rms(np.rad2deg(np.linalg.norm(errors[:, :3], axis=1))),
        "translation_rmse_m": rms(np.linalg.norm(errors[:, 3:], axis=1)),
    }


def network_residuals(result: SurveyResult) -> dict[str, float | int | None]:
    """Returns `replay.network` of metrics.json: residuals of the links at the final poses of their keyframes.

    `links` is the number of links with matched points, `loops` that of those whose nodes are more than two nodes apart.
    The residual of a link is that of `motion_residuals` at the final poses.
    `loop_translation_m` and `loop_rotation_deg` are medians of their norms over the loops, `loop_chi2` the mean of r'
    C^-1 r / 6 with C the covariance of the measurement, below about 1 for consistent covariances; all None without
    loops. They are not errors: an error that all links have in common does not appear in them.
    """
    along, loops = _measured_links(result)
    residuals = motion_residuals(loops, result.final.world_from_camera[result.keyframe_rows])
    chi2 = mean(nees(residuals, loops.own_cov))
    values = (
        len(along) + len(loops), len(loops), percentile(np.linalg.norm(residuals[:, 3:], axis=1), 50),
        percentile(np.rad2deg(np.linalg.norm(residuals[:, :3], axis=1)), 50), None if chi2 is None else chi2 / 6,
    )  # fmt: skip
    return dict(zip(NETWORK_KEYS, values, strict=True))


def motion_residuals(links: Links, poses: Array) -> Array:
    """Returns log(M^-1 T) (m, 6) of links, M being the measured motion and T that between the node poses (n, 4, 4)."""
    motions = zip(links.i, links.j, links.i_from_j, strict=True)
    logs = [geometry.log(geometry.inverse(motion) @ geometry.inverse(poses[i]) @ poses[j]) for i, j, motion in motions]
    return np.array(logs).reshape(-1, 6)


def stage_metrics(result: SurveyResult, truth: Truth) -> dict[str, dict[str, float | None]]:
    """Returns `stages` of metrics.json: errors of the same nodes, anchored at the first; None if one is missing."""
    nodes = _linked_nodes(result.links)
    frames = result.keyframe_rows[nodes]
    paths = {name: getattr(result, name).world_from_camera[frames] for name in ("f2f", "online", "final")}
    paths["chain"] = compose_chain(result.links, nodes)
    true = Trajectory(truth.trajectory.times_s[frames], truth.trajectory.world_from_camera[frames])
    found = {}
    for stage in STAGES:
        complete = len(paths[stage]) == len(true)
        distance_m = path_errors(Trajectory(true.times_s, paths[stage]), true).distance_m if complete else []
        found[stage] = {"ate_rmse_m": rms(distance_m), "ate_max_m": percentile(distance_m, 100)}
    return found


def compose_chain(links: Links, nodes: NDArray[np.int64]) -> Array:
    """Returns node poses (n, 4, 4) relative to the first, composed of consecutive links; empty if one is missing."""
    chain = links.select(_node_distance(links, nodes) == 1)
    motions = dict(zip(zip(chain.i.tolist(), chain.j.tolist(), strict=True), chain.i_from_j, strict=True))
    poses = [np.eye(4)]
    for pair in pairwise(nodes.tolist()):
        if pair not in motions:
            return np.zeros((0, 4, 4))
        poses.append(poses[-1] @ motions[pair])
    return np.array(poses)
