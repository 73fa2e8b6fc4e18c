"""Offset that all disparities share, estimated from the motions between keyframes.

An error of a principal point along the rows of the image adds the same offset to all disparities and does not change
the rows of points. A small yaw of one camera has nearly the same effect. Depths, and with them the lengths of all
motions, are then wrong. Over a floor with relief the offset is observable: image motions of near and far points must be
proportional to their disparities, and are not if there is an offset. Over a level floor the offset is not observable:
errors of a hundredth of a pixel that all matches share then appear as an offset of several pixels, and the scatter of
the links does not reveal these errors.
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
    """Returns the weighted mean of the offsets estimated by the links, and its standard deviation.

    None without links, and where the offset is not observable (`MAX_LINK_SIGMA_PX`).

    The links of a node share the noise of its stereo points, so the variance is multiplied by the number of links per
    node. All nodes that see the same floor share part of the errors that its relief causes, for example at the edges of
    an object: the variance is multiplied by 1 + c (m - 1), with m views of a point of the floor and c the recurrence of
    `link_selection.inflate_for_shared_noise`. There, only the fraction of the variance that image noise does not
    explain recurs; here this fraction is unknown, as few near points determine the offset, and is taken as 1. The
    variance is also multiplied by the mean chi-square of the links' offsets about the mean if that exceeds 1.

    Args:
        offsets: offset of each link, with a standard deviation that assumes independent links.
        n_nodes: number of nodes that can have links to earlier nodes.
        n_views: mean number of nodes that see a point of the floor (`mean_views`).
        focal_px: focal length [px].
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

    The overlap of two images is that of their rectangles on a plane parallel to the first image, at the median depth of
    its floor. Rotations are neglected.

    Args:
        world_from_camera: (n, 4, 4) poses of the nodes.
        depth_m: (n,) median depth of the floor at each node [m].
        rig: calibration of the images.
    """
    images_per_unit = np.array([rig.fx_px / rig.width_px, rig.fy_px / rig.height_px])
    views = []
    for pose, depth in zip(world_from_camera, depth_m, strict=True):
        shift = geometry.transform(geometry.inverse(pose), world_from_camera[:, :3, 3])[:, :2] / depth * images_per_unit
        views.append(np.sum(np.prod(np.clip(1 - np.abs(shift), 0.0, None), axis=1)))
    return float(np.mean(views)) if views else 1.0
