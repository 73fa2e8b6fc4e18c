"""Selection of the earlier nodes to which a new node is linked, by predicted overlap, and covariances of the links."""

from collections.abc import Sequence

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link
from twin.core.records import StereoRig
from twin.core.settings import EstimatorSettings
from twin.estimate.vision.stereo import Keyframe
from twin.estimate.vision.two_view_motion import Motion
from twin.kernels import kernel

_SAME_SWATH = 2  # number of immediately preceding nodes to link, as in Negahdaripour & Madjidi 2003
_LARGEST_OVERLAP = 0.95  # larger overlaps occur where the vehicle keeps station, not along a path
#: Sum of the covariances between the errors of a patch in different links, as a fraction of the sum for errors that are
#: equal in all links over the patch: 0.15 to 0.32 against the truth in eight surveys at five places of `horseshoe`.
RECURRENCE = 0.25
#: Standard error of `Motion.residual` sqrt(n): 1 / (2 f(m) m), m the median of the density f of chi with 3 dof.
_RESIDUAL_STANDARD_ERROR = 0.562
_NEAREST_M = 1e-3  # smallest depth of a visible point


def overlaps(node: Keyframe, poses: Array, rig: StereoRig, patch_px: int) -> Array:
    """Returns the fraction (n,) of a node's matched points that project into the left image at the poses (n, 4, 4)."""
    # at least half a patch from its border; 0 without points
    if node.points is None or len(node.points.xyz) == 0:
        return np.zeros(len(poses))
    xyz, position = node.points.xyz, node.world_from_camera[:3, 3].copy()
    world = np.ascontiguousarray(geometry.transform(node.world_from_camera, xyz))
    # beyond the diagonal of the footprint at the largest depth, the overlap is zero
    reach_m = float(xyz[:, 2].max() * np.hypot(rig.width_px, rig.height_px) / min(rig.fx_px, rig.fy_px))
    camera = rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.width_px, rig.height_px, patch_px // 2
    return _overlaps(world, position, np.ascontiguousarray(poses), reach_m, camera)


@kernel
def _overlaps(world, position, poses, reach, camera):
    """Returns the fractions (n,) of points `world` (m, 3) in view; zero for cameras farther than `reach` [m]."""
    fx, fy, cx, cy, width, height, margin = camera
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
            u = fx * (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / depth + cx
            v = fy * (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / depth + cy
            count += margin <= u < width - margin and margin <= v < height - margin
        shares[k] = count / len(world)
    return shares


def choose_links(
    node: Keyframe, earlier: Sequence[Keyframe], poses: Array, rig: StereoRig, settings: EstimatorSettings
) -> list[tuple[Keyframe, float]]:
    """Returns the nodes, of the `earlier` ones in their order at poses (n, 4, 4), to link a new node to, with overlaps.

    Up to `max_links` candidates with an overlap of at least `min_overlap` are chosen, in this order: the two previous
    nodes; the oldest node of the same swath, for the greatest distance along the path; the oldest node of all other
    swaths, to close loops; the remaining nodes of other swaths by decreasing overlap, where neighbours of one chosen
    before come last. The same swath is the unbroken series of candidates before the two previous nodes.
    """
    shares = overlaps(node, poses, rig, settings.patch_px)
    linked = np.flatnonzero(shares >= settings.min_overlap)[::-1].tolist()
    newest_before = len(earlier) - _SAME_SWATH - 1
    previous = [k for k in linked if k > newest_before]
    rest = linked[len(previous) :]
    same = [k for back, k in enumerate(rest) if k == newest_before - back]
    others = sorted(rest[len(same) :], key=lambda k: -shares[k])
    oldest = [min(others)] if others else []
    rest = [k for k in others if k not in oldest]
    chosen = previous + same[-1:] + oldest + _spread(rest, earlier, settings.node_stride)
    return [(earlier[k], float(shares[k])) for k in chosen[: settings.max_links]]


def _spread(others: list[int], earlier: Sequence[Keyframe], stride: int) -> list[int]:
    """Returns the indices `others` of earlier nodes in their order, but neighbours of nodes before them come last."""
    chosen, last, near = list[int](), list[int](), set[int]()
    for k in others:
        number = earlier[k].number
        (last if number in near else chosen).append(k)
        if number not in near:
            near |= {number - stride, number, number + stride}
    return chosen + last


def to_link(node: Keyframe, other: Keyframe, overlap: float, motion: Motion) -> Link:
    ends, share = (other.number, node.number), floor_share(motion)
    yaw = (None, 0.0) if motion.yaw is None else (motion.yaw.by_yaw, motion.yaw.removed_rad)
    form, errors = motion.closed_form, motion.by_image_errors
    return Link(*ends, motion.a_from_b, motion.cov, overlap, motion.n_points, 1.0, form, *yaw, errors, share)


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
    """Returns m = 1 / (1 - q), with the overlap q of the link from the latest earlier node; 1 without links."""
    overlap = max(links, key=lambda link: link.i).overlap if links else 0.0
    return 1 / (1 - min(overlap, _LARGEST_OVERLAP))


def floor_share(motion: Motion) -> float:
    """Returns the fraction of a motion's variance that the image noise of its points does not explain, 0 to 1."""
    # 1 - 1 / r^2 with r the relative residual; 0 if r does not exceed 1 by two standard errors
    limit = 1 + 2 * _RESIDUAL_STANDARD_ERROR / max(motion.n_points, 1) ** 0.5
    return 1 - motion.residual**-2 if motion.residual > limit else 0.0
