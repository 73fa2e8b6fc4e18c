"""The key-point network (P10, P11, P13, P14): which nodes are linked, and the motion measured between them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from twin import geometry
from twin.estimate import matching, motion, stereo
from twin.estimate.key_points import ImageSpool, KeyPoint
from twin.geometry import Array
from twin.records import Link, StereoRig

_SAME_SWATH = 2  # the paper's two previous key points on the same swath
_LEAST_SHARE = 0.3  # of matched points that agree on one motion
_COMMON_PX = 0.013  # bias that all points of a match share: the largest of Lucas-Kanade measured on low contrast
#: Relief inside the patches makes neighbouring matches err together: over reefs the links' NEES is half more than noise
#: and shared pixels explain, alike for links along the swath and across, on generated and real reefs.
_RELIEF = 1.5
_SMALL_TURN_RAD = 0.06  # patches of 21 px are skewed by less than a pixel


def overlap(node: KeyPoint, other: KeyPoint, rig: StereoRig, patch_px: int) -> float:
    """Share of the node's points that the other's left image shows: overlap of the true 3-D footprints.

    Predicted from poses and depth (P11), not from a flat floor.
    """
    if node.points is None or len(node.points.xyz) == 0:
        return 0.0
    other_from_node = geometry.inverse(other.world_from_camera) @ node.world_from_camera
    pixels = stereo.project(geometry.transform(other_from_node, node.points.xyz), rig)
    return float(np.mean(matching.inside(pixels, (rig.height_px, rig.width_px), patch_px // 2)))


def choose_links(
    node: KeyPoint, earlier: Sequence[KeyPoint], rig: StereoRig, min_overlap: float, max_links: int, patch_px: int
) -> list[tuple[KeyPoint, float]]:
    """Earlier nodes to link with: the two previous ones, the farthest on the same swath, and the best of other swaths.

    The last links of a run of overlapping nodes carry the longest base; links to other swaths tie the legs together.
    """
    reach_m = _reach(node, rig)
    near = [k for k in earlier if np.linalg.norm(k.world_from_camera[:3, 3] - node.world_from_camera[:3, 3]) < reach_m]
    shares = [(k, overlap(node, k, rig, patch_px)) for k in near]
    linked = sorted((s for s in shares if s[1] >= min_overlap), key=lambda s: -s[0].number)
    previous = [s for s in linked if s[0] in earlier[-_SAME_SWATH:]]
    rest = [s for s in linked if s[0] not in earlier[-_SAME_SWATH:]]
    same = _unbroken(rest, earlier)
    others = sorted((s for s in rest if s not in same), key=lambda s: -s[1])
    return (previous + same[-1:] + _spread(others, rig, max_links))[:max_links]


def share_noise(links: Sequence[Link]) -> list[Link]:
    """The links of one new node with the covariance that they have together.

    They all start from the node's own stereo points, whose noise is most of what a link's motion errs by. Taken as
    independent, n links would count the node's one look n times: positions came out over-sure by n, about 5.
    """
    return [link._replace(cov=link.cov * len(links)) for link in links]


def _unbroken(linked: list[tuple[KeyPoint, float]], earlier: Sequence[KeyPoint]) -> list[tuple[KeyPoint, float]]:
    """Those that follow one another without a gap, back from the node: its own swath."""
    expected = len(earlier) - _SAME_SWATH - 1
    run = []
    for item in linked:
        if expected < 0 or item[0] is not earlier[expected]:
            break
        run.append(item)
        expected -= 1
    return run


def _spread(others: list[tuple[KeyPoint, float]], rig: StereoRig, count: int) -> list[tuple[KeyPoint, float]]:
    """The best of other swaths, no two of them neighbours on theirs as long as there is a choice."""
    chosen: list[tuple[KeyPoint, float]] = []
    for item in others:
        if all(abs(item[0].number - c[0].number) > 1 for c in chosen):
            chosen.append(item)
    return (chosen + [o for o in others if o not in chosen])[:count]


def _reach(node: KeyPoint, rig: StereoRig) -> float:
    """No camera farther away sees the same floor: the image's diagonal at the node's largest depth."""
    if node.points is None or len(node.points.xyz) == 0:
        return 0.0
    return float(node.points.xyz[:, 2].max() * np.hypot(rig.width_px, rig.height_px) / rig.focal_px)


class PairMatch:
    """Matches one node with an earlier one and measures the motion between them."""

    def __init__(self, rig: StereoRig, spool: ImageSpool, patch_px: int):
        self.rig, self.spool, self.patch_px = rig, spool, patch_px

    def flow(self, node: KeyPoint, other: KeyPoint) -> tuple[Array, Array, float] | None:
        """The same points as measured in the other pair and in the node's: (n, 3), (n, 3), sigma [px]; None if none.

        Matching starts from the flow that positions and depth predict (P11). The node's image is first turned into the
        other's attitude, so that patches differ by parallax alone.
        """
        if node.points is None:
            return None
        other_from_node = geometry.inverse(other.world_from_camera) @ node.world_from_camera
        source, pixels = self._turned(self.spool.normalised(node.row)[0], node.points.pixels, other_from_node)
        guess = stereo.project(geometry.transform(other_from_node, node.points.xyz), self.rig)
        shape, margin = source.shape, self.patch_px // 2
        usable = matching.inside(guess, shape, margin) & matching.inside(pixels, shape, margin)
        left, right = self.spool.normalised(other.row)
        found, ok = matching.track(source, left, pixels[usable], guess[usable], self.patch_px)
        node_points = node.points.subset(usable).subset(ok)
        predicted = geometry.transform(other_from_node, node_points.xyz)
        disparity_px = self.rig.focal_px * self.rig.baseline_m / predicted[:, 2]
        points, both = stereo.measure(left, right, found[ok], disparity_px, self.rig, self.patch_px)
        if not np.isfinite(points.sigma_px):  # too few to tell their noise
            return None
        return points.measured, node_points.measured[both], max(points.sigma_px, node_points.sigma_px)

    def motion(self, node: KeyPoint, other: KeyPoint, matched: tuple[Array, Array, float]) -> motion.Motion | None:
        """Motion between the two pairs by structure and motion together (P14), None where it is not to be trusted."""
        measured_other, measured_node, sigma_px = matched
        guess = geometry.inverse(other.world_from_camera) @ node.world_from_camera
        shape = (self.rig.height_px, self.rig.width_px)
        result = motion.pair_motion(
            measured_other,
            measured_node,
            stereo.point_cov(sigma_px / self.rig.focal_px),
            self.rig.baseline_m,
            guess,
            common_sigma=_COMMON_PX / self.rig.focal_px,
            correlation=_RELIEF * matching.correlation(len(measured_node), self.patch_px, shape),
        )
        return None if result is None or result.n_points < _LEAST_SHARE * len(measured_node) else result

    def _turned(
        self, image: matching.Image, pixels: matching.Points, other_from_node: Array
    ) -> tuple[matching.Image, matching.Points]:
        """Image and pixels as a camera in the same place with the other's attitude sees them: exact at any depth.

        Small turns are left to the matcher: OpenCV rounds the coordinates of a warp to 1/32 pixel, and where the turn
        is nearly a shift all pixels round alike (0.034 px common to the image, ten times the noise of its mean flow).
        """
        if np.linalg.norm(geometry.so3_log(other_from_node[:3, :3])) < _SMALL_TURN_RAD:
            return image, pixels
        camera = self.rig.matrix
        homography = camera @ other_from_node[:3, :3] @ np.linalg.inv(camera)
        size = (self.rig.width_px, self.rig.height_px)
        turned = cv2.warpPerspective(
            image, homography, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=128
        )
        moved = cv2.perspectiveTransform(pixels[:, None].astype(np.float32), homography)[:, 0]
        return np.asarray(turned, np.uint8), np.asarray(moved, np.float32)


def to_link(node: KeyPoint, other: KeyPoint, share: float, result: motion.Motion) -> Link:
    """The network's record of a measured motion."""
    return Link(other.number, node.number, result.a_from_b, result.cov, share, result.n_points)
