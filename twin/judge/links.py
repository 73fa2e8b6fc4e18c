"""Errors of the measured motions between keyframes, and of their closed-form initial values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.links import Links
from twin.core.records import Array, SurveyResult, Truth
from twin.judge.consistency import nees
from twin.judge.summary_statistics import mean, rms
from twin.kernels import kernel

#: A link is "along" if it connects a node to one of the two nodes before it (Negahdaripour & Madjidi 2003). All other
#: links are "across": to earlier nodes of the same swath, to neighbouring swaths, to the start of a loop.
ALONG_NODES = 2


def link_metrics(result: SurveyResult, truth: Truth) -> dict[str, Any]:
    """Returns `links` of metrics.json: errors of links to the two previous nodes (along) and of all others (across).

    `bridged` is the number of links that consist of frame-to-frame motion because their measurement failed. The errors
    of these links are not evaluated.
    """
    measured = result.links.select(result.links.n_points > 0)
    near = node_distance(measured, linked_nodes(result.links)) <= ALONG_NODES
    true = truth.trajectory.world_from_camera[result.keyframe_rows]
    return {
        "along": _link_errors(measured.select(near), true),
        "across": _link_errors(measured.select(~near), true),
        "bridged": len(result.links) - len(measured),
    }


def linked_nodes(links: Links) -> NDArray[np.int64]:
    """Returns the numbers of the keyframes that have at least one link, in increasing order."""
    return np.unique(np.concatenate([links.i, links.j]))


def node_distance(links: Links, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the distance (n,) between the two nodes of each link, counted in nodes: 1 for consecutive nodes.

    Args:
        links: n links between keyframes i < j.
        nodes: increasing numbers of the keyframes that are nodes.
    """
    return np.searchsorted(nodes, links.j) - np.searchsorted(nodes, links.i)


def motion_errors(links: Links, estimates: Array, world_from_keyframe: Array) -> Array:
    """Returns the errors (n, 6) of motions as twists [rotation, translation] in camera j (rad, m).

    The error is log(T^-1 E) of the true motion T and the estimated motion E, both poses of camera j in camera i.

    Args:
        links: n links, of which only i and j are read.
        estimates: (n, 4, 4) estimated motion for each link.
        world_from_keyframe: (n_keyframes, 4, 4) true poses of the keyframes.
    """
    return _motion_errors(world_from_keyframe[links.i], world_from_keyframe[links.j], np.ascontiguousarray(estimates))


@kernel
def _motion_errors(true_i, true_j, estimates):
    """Compiled kernel of `motion_errors`."""
    errors = np.empty((len(true_i), 6))
    for k in range(len(true_i)):
        j_from_i = geometry.compose(geometry.inverse(true_j[k]), true_i[k])
        geometry.copy_into(errors[k], geometry.log(geometry.compose(j_from_i, estimates[k])))
    return errors


def _link_errors(links: Links, world_from_keyframe: Array) -> dict[str, float | int | None]:
    """Returns number, RMS errors and mean NEES of links, and the RMS errors of their closed-form motions.

    Links without a closed-form motion are left out of the closed-form errors. The mean NEES is 6 for consistent
    covariances.
    """
    errors = motion_errors(links, links.i_from_j, world_from_keyframe)
    has_closed_form, closed_forms = links.by_closed_form
    closed_errors = motion_errors(links.select(has_closed_form), closed_forms, world_from_keyframe)
    return {
        "count": len(links),
        **_rmse(errors),
        "nees_mean": mean(nees(errors, links.own_cov)),
        **{f"closed_form_{key}": value for key, value in _rmse(closed_errors).items()},
    }


def _rmse(errors: Array) -> dict[str, float | None]:
    """Returns the RMS angle [deg] and RMS translation [m] of twists (n, 6)."""
    return {
        "rotation_rmse_deg": rms(np.rad2deg(np.linalg.norm(errors[:, :3], axis=1))),
        "translation_rmse_m": rms(np.linalg.norm(errors[:, 3:], axis=1)),
    }
