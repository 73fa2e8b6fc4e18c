"""The keyframe network (P10, P11, P13, P14): which nodes are linked, and the motion measured between them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link
from twin.core.records import StereoRig
from twin.estimate.vision import matching, observation_equations, patches, stereo, two_view_motion
from twin.estimate.vision.image_spool import ImageSpool
from twin.estimate.vision.keyframes import Keyframe

_SAME_SWATH = 2  # the paper's two previous keyframes on the same swath
LEAST_SHARE = 0.3  # of matched points that agree on one motion
COMMON_PX = 0.005  # bias that all points of a match share: what interpolation leaves
_NEAREST_M = 1e-3  # of a point before a camera
_LEVELS = 2  # a quarter of the image: matches are found though positions err by 8 pixels


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


class Matched(NamedTuple):
    """The same points as two stereo pairs measure them, normalised (x, y, disparity): (n, 3) with (n, 3, 3)."""

    other: Array
    other_cov: Array
    node: Array
    node_cov: Array


class PairMatch:
    """Matches one node with an earlier one and measures the motion between them."""

    def __init__(self, rig: StereoRig, spool: ImageSpool, patch_px: int):
        self.rig, self.spool, self.patch_px = rig, spool, patch_px
        self._workers = ThreadPoolExecutor(2)

    def flows(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Matched | None]:
        """The node's points found in both images of each other pair, two pairs at a time; None where it has none."""
        points = node.points
        if points is None:
            return [None for _ in others]
        left, _ = self.spool.gray(node.row)
        cut = patches.cut(patches.pyramid(left, _LEVELS), points.pixels, self.patch_px)
        return list(self._workers.map(lambda other: self._flow(node, points, cut, other), others))

    def _flow(
        self, node: Keyframe, points: stereo.StereoPoints, cut: Sequence[patches.Patches], other: Keyframe
    ) -> Matched:
        """The points found in both images of one other pair.

        Matching starts from the flow that positions and depth predict (P11), and from how the plane under each patch
        looks from there.
        """
        rig = self.rig
        other_from_node = geometry.inverse(other.world_from_camera) @ node.world_from_camera
        expected, by_point, _ = observation_equations.transfer(points.measured, other_from_node, rig.baseline_m)
        warp = by_point[:, :, :2] + by_point[:, :, 2:] * points.slope[:, None, :]
        left_warp, right_warp = warp[:, :2], warp[:, :2] - np.stack([warp[:, 2], np.zeros_like(warp[:, 2])], axis=1)
        left_px, shift_px = self._places(expected)
        left, right = self.spool.gray(other.row)
        left_target = patches.splines(patches.pyramid(left, _LEVELS))
        in_left = patches.register(cut, left_target, left_px, left_warp)
        right_px, right_target = in_left.points - shift_px, patches.splines([right])
        in_right = patches.register(cut, right_target, right_px, right_warp)
        ok = in_left.ok & in_right.ok & stereo.on_one_row(in_left.points, in_right.points)
        ok &= self._shows(points, other_from_node)
        in_node_px = (in_left.cov[ok] + in_right.cov[ok]) / 2
        cov = left_warp[ok] @ in_node_px @ left_warp[ok].transpose(0, 2, 1)
        measured, measured_cov = stereo.fuse(in_left.points[ok], in_right.points[ok], cov, rig)
        return Matched(measured, measured_cov, points.measured[ok], points.cov[ok])

    def _shows(self, points: stereo.StereoPoints, other_from_node: Array) -> NDArray[np.bool_]:
        """Which points (n,) both images of the other pair show, patch and all."""
        around = np.column_stack([points.measured[:, :2], points.around_px / self.rig.focal_px])
        expected, _, _ = observation_equations.transfer(around, other_from_node, self.rig.baseline_m)
        left_px, shift_px = self._places(expected)
        in_left, in_right = (stereo.well_inside(px, self.rig, self.patch_px) for px in (left_px, left_px - shift_px))
        return in_left & in_right

    def _places(self, expected: Array) -> tuple[Array, Array]:
        """Where the left image shows points (n, 3), and how much farther left the right one does: (n, 2) [px]."""
        left_px = expected[:, :2] * self.rig.focal_px + [self.rig.cx_px, self.rig.cy_px]
        return left_px, np.column_stack([expected[:, 2] * self.rig.focal_px, np.zeros(len(expected))])

    def motion(self, node: Keyframe, other: Keyframe, matched: Matched) -> two_view_motion.Motion | None:
        """Motion between the two pairs by structure and motion together (P14), None where it is not to be trusted.

        It starts from the closed form of eq. (2), or where that has none from the predicted poses.
        """
        predicted = geometry.inverse(other.world_from_camera) @ node.world_from_camera
        closed_form = two_view_motion.exact_depth_motion(matched.other, matched.node, self.rig.baseline_m, predicted)
        result = two_view_motion.pair_motion(
            matched.other,
            matched.node,
            matched.other_cov,
            matched.node_cov,
            self.rig.baseline_m,
            predicted if closed_form is None else closed_form,
            common_sigma=COMMON_PX / self.rig.focal_px,
            correlation=matching.correlation(matched.node[:, :2] * self.rig.focal_px, self.patch_px),
        )
        if result is None or result.n_points < LEAST_SHARE * len(matched.node):
            return None
        return result._replace(closed_form=closed_form)


def to_link(node: Keyframe, other: Keyframe, share: float, result: two_view_motion.Motion) -> Link:
    """The network's record of a measured motion."""
    return Link(
        other.number, node.number, result.a_from_b, result.cov, share, result.n_points, closed_form=result.closed_form
    )
