"""The measured motions between key points against the truth, beside the closed form that each started from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin import geometry
from twin.judge.consistency import nees
from twin.judge.numbers import mean, rms
from twin.records import Array, Link, SurveyResult, Truth

#: A link "along" reaches back to one of the two nodes before (the paper's), one "across" farther: to the longest base
#: on the same swath, to neighbouring swaths, to where loops began.
ALONG_NODES = 2


def link_metrics(result: SurveyResult, truth: Truth) -> dict[str, Any]:
    """`links` of metrics.json: errors of the motions along and across, and how many frame-to-frame motions stand in."""
    measured = [link for link in result.links if link.n_points > 0]
    near = steps_back(measured, node_numbers(result.links)) <= ALONG_NODES
    true = truth.trajectory.world_from_camera[result.key_frames]
    return {
        "along": _figures([link for link, along in zip(measured, near, strict=True) if along], true),
        "across": _figures([link for link, along in zip(measured, near, strict=True) if not along], true),
        "bridged": len(result.links) - len(measured),
    }


def node_numbers(links: Sequence[Link]) -> NDArray[np.int64]:
    """Numbers of the key points that links join, in their order."""
    return np.unique(np.array([(link.i, link.j) for link in links], dtype=np.int64))


def steps_back(links: Sequence[Link], nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) nodes from the earlier to the later end of each link."""
    ends = np.array([(link.i, link.j) for link in links], dtype=np.int64).reshape(-1, 2)
    return np.diff(np.searchsorted(nodes, ends), axis=1)[:, 0]


def motion_errors(links: Sequence[Link], estimates: Sequence[Array], world_from_key: Array) -> Array:
    """(n, 6) twist [rotation, translation] (rad, m) in j from the true to the estimated pose of j in i.

    Args:
        estimates: (4, 4) of each link.
        world_from_key: (n_keys, 4, 4) true poses of the key points.
    """
    ends = np.array([(link.i, link.j) for link in links], dtype=np.int64).reshape(-1, 2)
    return _motion_errors(ends, np.array(estimates).reshape(-1, 4, 4), np.ascontiguousarray(world_from_key))


@njit(cache=True, nogil=True)
def _motion_errors(ends, estimates, world_from_key):
    errors = np.empty((len(ends), 6))
    for k in range(len(ends)):
        i, j = ends[k]
        errors[k] = geometry.log(geometry.inverse(world_from_key[j]) @ world_from_key[i] @ estimates[k])
    return errors


def _figures(links: Sequence[Link], world_from_key: Array) -> dict[str, float | int | None]:
    """Count, RMS errors and mean NEES (6 if right) of links; RMS errors of the closed form of those that have one."""
    errors = motion_errors(links, [link.i_from_j for link in links], world_from_key)
    covs = np.array([link.own_cov for link in links]).reshape(-1, 6, 6)
    closed = [(link, link.closed_form) for link in links if link.closed_form is not None]
    closed_errors = motion_errors([link for link, _ in closed], [motion for _, motion in closed], world_from_key)
    return {
        "count": len(links),
        **_rmse(errors),
        "nees_mean": mean(nees(errors, covs)),
        **{f"closed_form_{key}": value for key, value in _rmse(closed_errors).items()},
    }


def _rmse(errors: Array) -> dict[str, float | None]:
    """Of the lengths of both halves of twists (n, 6)."""
    return {
        "rotation_rmse_deg": rms(np.rad2deg(np.linalg.norm(errors[:, :3], axis=1))),
        "translation_rmse_m": rms(np.linalg.norm(errors[:, 3:], axis=1)),
    }
