"""The measured motions between keyframes against the truth, beside the closed form that each started from."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.links import Links
from twin.core.records import Array, SurveyResult, Truth
from twin.judge.consistency import nees
from twin.judge.summary_statistics import mean, rms

#: A link "along" reaches back to one of the two nodes before (the paper's), one "across" farther: to the longest base
#: on the same swath, to neighbouring swaths, to where loops began.
ALONG_NODES = 2


def link_metrics(result: SurveyResult, truth: Truth) -> dict[str, Any]:
    """`links` of metrics.json: errors of the motions along and across, and how many frame-to-frame motions stand in."""
    measured = result.links.kept(result.links.n_points > 0)
    near = steps_back(measured, node_numbers(result.links)) <= ALONG_NODES
    true = truth.trajectory.world_from_camera[result.keyframe_rows]
    return {
        "along": _figures(measured.kept(near), true),
        "across": _figures(measured.kept(~near), true),
        "bridged": len(result.links) - len(measured),
    }


def node_numbers(links: Links) -> NDArray[np.int64]:
    """Numbers of the keyframes that links join, in their order."""
    return np.unique(np.concatenate([links.i, links.j]))


def steps_back(links: Links, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) nodes from the earlier to the later end of each link."""
    return np.searchsorted(nodes, links.j) - np.searchsorted(nodes, links.i)


def motion_errors(links: Links, estimates: Array, world_from_keyframe: Array) -> Array:
    """(n, 6) twist [rotation, translation] (rad, m) in j from the true to the estimated pose of j in i.

    Args:
        estimates: (n, 4, 4) of each link.
        world_from_keyframe: (n_keyframes, 4, 4) true poses of the keyframes.
    """
    return _motion_errors(world_from_keyframe[links.i], world_from_keyframe[links.j], np.ascontiguousarray(estimates))


@njit(cache=True, nogil=True)
def _motion_errors(true_i, true_j, estimates):
    errors = np.empty((len(true_i), 6))
    for k in range(len(true_i)):
        j_from_i = geometry.compose(geometry.inverse(true_j[k]), true_i[k])
        geometry.put(errors[k], geometry.log(geometry.compose(j_from_i, estimates[k])))
    return errors


def _figures(links: Links, world_from_keyframe: Array) -> dict[str, float | int | None]:
    """Count, RMS errors and mean NEES (6 if right) of links; RMS errors of the closed form of those that have one."""
    errors = motion_errors(links, links.i_from_j, world_from_keyframe)
    closed, motions = links.by_closed_form
    closed_errors = motion_errors(links.kept(closed), motions, world_from_keyframe)
    return {
        "count": len(links),
        **_rmse(errors),
        "nees_mean": mean(nees(errors, links.own_cov)),
        **{f"closed_form_{key}": value for key, value in _rmse(closed_errors).items()},
    }


def _rmse(errors: Array) -> dict[str, float | None]:
    """Of the lengths of both halves of twists (n, 6)."""
    return {
        "rotation_rmse_deg": rms(np.rad2deg(np.linalg.norm(errors[:, :3], axis=1))),
        "translation_rmse_m": rms(np.linalg.norm(errors[:, 3:], axis=1)),
    }
