"""Offset that all disparities share (principal point, yaw of a camera), from the motions between keyframes.

It is observable over relief, where the image motions of near and far points must be proportional to their disparities.
Over a level floor it is not, and the scatter between links does not reveal that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import DisparityOffset
from twin.core.records import StereoRig
from twin.estimate.link_selection import RECURRENCE

#: Largest median standard deviation of the offset from a single link at which the offset counts as observable [px].
MAX_LINK_SIGMA_PX = 0.3


def combine(
    offsets: Sequence[DisparityOffset], n_nodes: int, n_views: float, focal_px: float
) -> DisparityOffset | None:
    """Returns the weighted mean of the offsets of the links, with their standard deviations of independent links.

    None without offsets or nodes, and where the offset is not observable (`MAX_LINK_SIGMA_PX`). The variance is
    multiplied by the links per node, which share stereo points (if above 1), by 1 + c (m - 1) for nodes that share the
    errors of relief, with c = `link_selection.RECURRENCE`, and by the mean chi-square (if above 1).

    Args:
        n_nodes: number of nodes that can have links to earlier nodes.
        n_views: m, the mean number of nodes that see a point of the floor (`mean_views`).
    """
    if not offsets or n_nodes < 1:
        return None
    value, sigma = np.array(offsets).T
    if np.median(sigma) * focal_px > MAX_LINK_SIGMA_PX:
        return None
    weight = sigma**-2
    mean = float(np.sum(weight * value) / np.sum(weight))
    chi2 = float(np.mean(weight * (value - mean) ** 2))
    shared_by = max(len(offsets) / n_nodes, 1.0) * (1 + RECURRENCE * (n_views - 1))
    variance = max(chi2, 1.0) * shared_by / float(np.sum(weight))
    return DisparityOffset(mean, variance**0.5)


def mean_views(world_from_camera: Array, depth_m: Array, rig: StereoRig) -> float:
    """Returns the mean number of nodes that see a floor point in the image of a node, this node included.

    It is the mean sum of a node's overlaps with all nodes, of poses (n, 4, 4) and median depths (n,). The overlap of
    two images is that of their rectangles on a plane parallel to the first one at its depth; rotations are neglected.
    """
    images_per_unit = np.array([rig.fx_px / rig.width_px, rig.fy_px / rig.height_px])
    views = []
    for pose, depth in zip(world_from_camera, depth_m, strict=True):
        shift = geometry.transform(geometry.inverse(pose), world_from_camera[:, :3, 3])[:, :2] / depth * images_per_unit
        views.append(np.sum(np.prod(np.clip(1 - np.abs(shift), 0.0, None), axis=1)))
    return float(np.mean(views)) if views else 1.0
