"""Selection of the earlier nodes to which a new node is linked, by predicted overlap, and covariances of the links."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link
from twin.core.records import StereoRig
from twin.estimate.vision.keyframes import Keyframe
from twin.estimate.vision.two_view_motion import Motion
from twin.kernels import kernel

_SAME_SWATH = 2  # number of immediately preceding nodes to link, as in Negahdaripour & Madjidi 2003
_LARGEST_OVERLAP = 0.95  # larger overlaps occur where the vehicle keeps station, not along a path
#: Sum of the covariances between the errors of a patch in different links, as a fraction of the sum for errors that are
#: equal in all links over the patch: 0.15 to 0.32 in eight surveys at five places of a reef (`horseshoe`), measured
#: against the truth.
RECURRENCE = 0.25
#: Standard error of `Motion.residual` times the root of the number of points: 1 / (2 f(m) m), with f the density of the
#: chi distribution with three degrees of freedom and m its median.
_RESIDUAL_STANDARD_ERROR = 0.562
_NEAREST_M = 1e-3  # smallest depth of a visible point


class _View(NamedTuple):
    """Camera intrinsics and image size, for projection in compiled code."""

    #: fx, fy: focal lengths along the rows (fx) and the columns (fy) of the image [px].
    fx: float
    fy: float
    #: cx, cy: column and row of the principal point [px].
    cx: float
    cy: float
    #: width, height: image size [px].
    width: int
    height: int
    margin: int  #: smallest distance of a visible point from the image border [px]


def overlaps(node: Keyframe, poses: Array, rig: StereoRig, patch_px: int) -> Array:
    """Returns the overlap (n,), 0 to 1, of a node with the left image at each of the poses (n, 4, 4).

    The overlap is the fraction of the node's matched points that project into the other image, at least half a patch
    from its border. It is predicted from poses and depths, without the assumption of a flat floor. It is 0 for a node
    without points, and for an image whose camera is farther from the node's camera than the diagonal of the node's
    footprint at the largest depth of its points.
    """
    if node.points is None or len(node.points.xyz) == 0:
        return np.zeros(len(poses))
    world = np.ascontiguousarray(geometry.transform(node.world_from_camera, node.points.xyz))
    camera = _View(rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.width_px, rig.height_px, patch_px // 2)
    position, reach_m = node.world_from_camera[:3, 3].copy(), _reach_m(node.points.xyz, rig)
    return _overlaps(world, position, np.ascontiguousarray(poses), reach_m, camera)


def choose_links(
    node: Keyframe,
    earlier: Sequence[Keyframe],
    poses: Array,
    rig: StereoRig,
    min_overlap: float,
    max_links: int,
    patch_px: int,
) -> list[tuple[Keyframe, float]]:
    """Selects the earlier nodes to which a new node is linked.

    Up to `max_links` candidates with sufficient overlap are selected, in this order of priority: the two previous
    nodes; the oldest node of the same swath, for the greatest distance along the path; the oldest node of all other
    swaths, to close loops; the remaining nodes of other swaths by decreasing overlap. The same swath is the unbroken
    series of candidates with sufficient overlap before the two previous nodes. Among the remaining nodes, those that
    directly precede or follow one selected from them earlier come last.

    Args:
        earlier: candidate nodes in chronological order.
        poses: (n, 4, 4) world_from_camera of the candidates.
        min_overlap: smallest sufficient overlap, 0 to 1.

    Returns:
        The selected nodes with their overlaps (0 to 1).
    """
    shares = overlaps(node, poses, rig, patch_px)
    linked = np.flatnonzero(shares >= min_overlap)[::-1].tolist()
    previous = [k for k in linked if k >= len(earlier) - _SAME_SWATH]
    rest = linked[len(previous) :]
    same = _unbroken(rest, len(earlier) - _SAME_SWATH - 1)
    others = sorted(rest[len(same) :], key=lambda k: -shares[k])
    oldest = [min(others)] if others else []
    rest = [k for k in others if k not in oldest]
    chosen = (previous + same[-1:] + oldest + _spread(rest, earlier, max_links))[:max_links]
    return [(earlier[k], float(shares[k])) for k in chosen]


def inflate_for_shared_noise(links: Sequence[Link]) -> list[Link]:
    """Returns the links of one new node with covariances inflated to account for their correlated errors.

    All n links use the same stereo points of the node, whose noise dominates, so each covariance is multiplied by n.

    The fraction s that image noise does not explain (`Link.floor_share`) is due to relief within patches, and would be
    the same in all links while a patch is in view. With the overlap q of consecutive nodes, the summed error then has 1
    + 2 sum_l (1 - l (1 - q)) = m = 1 / (1 - q) times the variance of independent errors (1 <= l < m). Real shifts are
    only partly the same, so the covariance is also multiplied by 1 + c s (m - 1), with c = `RECURRENCE`.
    """
    growth = RECURRENCE * (_links_over_a_footprint(links) - 1)
    factors = [len(links) * (1 + growth * link.floor_share) for link in links]
    return [link._replace(cov=link.cov * k, shared_by=k) for link, k in zip(links, factors, strict=True)]


def _links_over_a_footprint(links: Sequence[Link]) -> float:
    """Returns the number m = 1 / (1 - q) of consecutive links during which a patch of floor stays in view.

    q is the overlap of the link from the latest earlier node, limited to `_LARGEST_OVERLAP`; 0 without links.
    """
    overlap = max(links, key=lambda link: link.i).overlap if links else 0.0
    return 1 / (1 - min(overlap, _LARGEST_OVERLAP))


def floor_share(motion: Motion) -> float:
    """Returns the fraction of a motion's variance that the image noise of its points does not explain, 0 to 1.

    1 - 1 / r^2 with r the relative residual (`Motion.residual`); 0 if r does not exceed 1 by two standard errors of
    0.56 / sqrt(n).
    """
    limit = 1 + 2 * _RESIDUAL_STANDARD_ERROR / max(motion.n_points, 1) ** 0.5
    return 1 - motion.residual**-2 if motion.residual > limit else 0.0


def _unbroken(linked: list[int], newest: int) -> list[int]:
    """Returns the consecutive indices newest, newest - 1, ... (one swath) with which the descending `linked` begins."""
    return [k for back, k in enumerate(linked) if k == newest - back]


def _spread(others: list[int], earlier: Sequence[Keyframe], count: int) -> list[int]:
    """Returns up to `count` of the indices `others`, in their order, but neighbours of nodes chosen before come last.

    Neighbours are nodes between which there is no other node: their keyframe numbers differ by the smallest difference
    between consecutive candidates (`EstimatorSettings.node_stride`).

    Args:
        others: indices in `earlier` of nodes of other swaths, by decreasing overlap.
    """
    numbers = np.array([node.number for node in earlier])
    stride = np.diff(numbers).min(initial=numbers[-1] + 1) if others else 1
    chosen: list[int] = []
    for k in others:
        if all(abs(numbers[k] - numbers[c]) > stride for c in chosen):
            chosen.append(k)
    return (chosen + [k for k in others if k not in chosen])[:count]


def _reach_m(points: Array, rig: StereoRig) -> float:
    """Returns the distance between cameras beyond which their overlap is zero [m]: the diagonal of the footprint."""
    return float(points[:, 2].max() * np.hypot(rig.width_px, rig.height_px) / min(rig.fx_px, rig.fy_px))


@kernel
def _overlaps(world, position, poses, reach, view):
    """Kernel of `overlaps` (n,) for points `world` (m, 3) [m]; zero from the distance `reach` [m] on."""
    shares = np.zeros(len(poses))
    for k in range(len(poses)):
        pose, count = poses[k], 0
        if np.sum((position - pose[:3, 3]) ** 2) >= reach * reach:
            continue
        for x, y, z in world:
            dx, dy, dz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
            depth = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
            if depth < _NEAREST_M:
                continue
            u = view.fx * (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / depth + view.cx
            v = view.fy * (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / depth + view.cy
            inside_columns = view.margin <= u < view.width - view.margin
            count += inside_columns and view.margin <= v < view.height - view.margin
        shares[k] = count / len(world)
    return shares


def to_link(node: Keyframe, other: Keyframe, overlap: float, result: Motion) -> Link:
    """Returns the link from the earlier node `other` to the new `node`.

    Args:
        node, other: the two nodes.
        overlap: predicted overlap of the two, 0 to 1.
        result: measured motion, the pose of `node` in the camera axes of `other`.
    """
    return Link(
        other.number, node.number, result.a_from_b, result.cov, overlap, result.n_points,
        closed_form=result.closed_form, floor_share=floor_share(result),
    )  # fmt: skip
