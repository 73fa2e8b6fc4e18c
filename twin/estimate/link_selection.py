"""Selection of links (P10, P11, P13): which earlier nodes a new node is linked to, by predicted overlap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link
from twin.core.records import StereoRig
from twin.estimate.vision.keyframes import Keyframe
from twin.estimate.vision.two_view_motion import Motion

_SAME_SWATH = 2  # the paper's two previous keyframes on the same swath
_NEAREST_M = 1e-3  # of a point before a camera


def overlaps(node: Keyframe, poses: Array, rig: StereoRig, patch_px: int) -> Array:
    """Shares (n,) of the node's points that the left images at poses (n, 4, 4) show: overlap of true 3-D footprints.

    Predicted from poses and depth (P11), not from a flat floor.
    """
    if node.points is None or len(node.points.xyz) == 0:
        return np.zeros(len(poses))
    world = np.ascontiguousarray(geometry.transform(node.world_from_camera, node.points.xyz))
    camera = (rig.focal_px, rig.cx_px, rig.cy_px, rig.width_px, rig.height_px, patch_px // 2)
    here, reach_m = node.world_from_camera[:3, 3].copy(), _reach_m(node.points.xyz, rig)
    return _overlaps(world, here, np.ascontiguousarray(poses), reach_m, *camera)


def choose_links(
    node: Keyframe,
    earlier: Sequence[Keyframe],
    poses: Array,
    rig: StereoRig,
    min_overlap: float,
    max_links: int,
    patch_px: int,
) -> list[tuple[Keyframe, float]]:
    """Earlier nodes to link with: the two previous ones, the farthest on the same swath, and the best of other swaths.

    The last link of a run of overlapping nodes carries the longest base; links to other swaths tie the legs together,
    and the oldest of them ties loops to where they all began.

    Args:
        poses: (n, 4, 4) of the earlier ones.
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


def share_noise(links: Sequence[Link]) -> list[Link]:
    """The links of one new node with the covariance that they have together.

    They all start from the node's own stereo points, whose noise is most of what a link's motion errs by. Taken as
    independent, n links would count the node's one look n times: positions came out over-sure by n, about 5.
    """
    return [link._replace(cov=link.cov * len(links), shared_by=len(links)) for link in links]


def _unbroken(linked: list[int], newest: int) -> list[int]:
    """Those that follow one another without a gap, back from the newest: the node's own swath."""
    return [k for back, k in enumerate(linked) if k == newest - back]


def _spread(others: list[int], earlier: Sequence[Keyframe], count: int) -> list[int]:
    """The best of other swaths, no two of them neighbours on theirs as long as there is a choice."""
    chosen: list[int] = []
    for k in others:
        if all(abs(earlier[k].number - earlier[c].number) > 1 for c in chosen):
            chosen.append(k)
    return (chosen + [k for k in others if k not in chosen])[:count]


def _reach_m(points: Array, rig: StereoRig) -> float:
    """No camera farther away sees the same floor: the image's diagonal at the largest depth of the points (n, 3)."""
    return float(points[:, 2].max() * np.hypot(rig.width_px, rig.height_px) / rig.focal_px)


@njit(cache=True, nogil=True)
def _overlaps(world, here, poses, reach, focal, cx, cy, width, height, margin):
    """As `overlaps`, of points (m, 3) in the world; cameras out of reach of the node's (3,) share nothing."""
    shares = np.zeros(len(poses))
    for k in range(len(poses)):
        pose, count = poses[k], 0
        if np.sum((here - pose[:3, 3]) ** 2) >= reach * reach:
            continue
        for x, y, z in world:
            dx, dy, dz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
            depth = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
            if depth < _NEAREST_M:
                continue
            u = focal * (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / depth + cx
            v = focal * (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / depth + cy
            count += margin <= u < width - margin and margin <= v < height - margin
        shares[k] = count / len(world)
    return shares


def to_link(node: Keyframe, other: Keyframe, share: float, result: Motion) -> Link:
    """The network's record of a measured motion."""
    return Link(
        other.number, node.number, result.a_from_b, result.cov, share, result.n_points, closed_form=result.closed_form
    )
