"""Offset that all disparities share, estimated from the motions between keyframes.

An error of a principal point along the rows of the image (or a yaw of one camera) adds the same offset to all
disparities, and leaves all rows as they are. Depths, and with them the lengths of all motions, are then wrong. Over a
floor with relief the offset is visible: near points must move by more pixels than far points, in proportion to their
disparities, which they do not if there is an offset. Over a level floor the offset is not observable: errors of a
hundredth of a pixel that all matches share then appear as an offset of several pixels, and the scatter of the links
does not show them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from twin.core.quality import DisparityOffset

#: Largest median standard deviation of the offset from a single link at which the offset counts as observable [px].
MAX_LINK_SIGMA_PX = 0.3


def combine(offsets: Sequence[DisparityOffset], n_nodes: int, focal_px: float) -> DisparityOffset | None:
    """Returns the weighted mean of the offsets estimated by the links, and its standard deviation.

    None without links, and where the offset is not observable (`MAX_LINK_SIGMA_PX`).

    The links of a node share the noise of its stereo points, so the variance is multiplied by the number of links per
    node. It is also multiplied by the mean chi-square of the links' offsets about the mean if that exceeds 1.

    Args:
        offsets: offset of each link, with a standard deviation that assumes independent links.
        n_nodes: number of nodes from which the links start.
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
    variance = max(chi2, 1.0) * max(len(offsets) / n_nodes, 1.0) / float(np.sum(weight))
    return DisparityOffset(mean, variance**0.5)
