"""Measurement of a link: points of a node are matched in the images of an earlier node, and the motion is estimated."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Mask, StereoRig
from twin.core.settings import COMMON_BIAS_PX, MIN_INLIER_SHARE
from twin.estimate.vision import matching, observation_equations, patches, stereo, two_view_motion
from twin.estimate.vision.image_spool import ImageSpool
from twin.estimate.vision.observation_equations import PairMeasurements, PixelLocking
from twin.estimate.vision.rolling_shutter import at_mid_exposure
from twin.estimate.vision.stereo import Keyframe, StereoPoints

_LEVELS = 2  # pyramid levels above the full image
SEARCH_PX = 8.0  #: largest error of a predicted image position from which a point is found, with these levels [px]


class MatchedPair(NamedTuple):
    """Points that were matched in the stereo pairs of two nodes, n of them."""

    measured: PairMeasurements  #: measurements of the points in the earlier pair a and in the later pair b
    locking: PixelLocking  #: derivatives of the measurements with respect to the amplitude of pixel locking


class PairMatcher:
    """Matches a node with earlier nodes, at the scale of the grey levels in `spool`, and estimates their motions.

    By frame index of a keyframe, `removed_yaw` is the yaw of the right camera [rad] for which its images were
    corrected, and `twists` the twist (6,) of the camera, for the correction of a rolling shutter.
    """

    def __init__(self, rig: StereoRig, spool: ImageSpool, patch_px: int):
        self.rig, self.spool, self.patch_px = rig, spool, patch_px
        self.removed_yaw: dict[int, float] = {}
        self.twists: dict[int, Array] = {}
        self._workers = ThreadPoolExecutor(2)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_workers": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._workers = ThreadPoolExecutor(2)

    def close(self) -> None:
        self._workers.shutdown()

    def match(self, node: Keyframe, others: Sequence[Keyframe]) -> list[MatchedPair]:
        """Returns the points of `node` matched in both images of each other node. Raises OSError."""
        points = node.points
        assert points is not None
        left, _ = self.spool.gray(node.row)
        templates = patches.extract_templates(patches.pyramid(left, _LEVELS), points.pixels, self.patch_px)
        return list(self._workers.map(lambda other: self._match_pair(node, points, templates, other), others))

    def _match_pair(
        self, node: Keyframe, points: StereoPoints, templates: Sequence[patches.PatchTemplates], other: Keyframe
    ) -> MatchedPair:
        """Returns the points matched in both images of another node, from predicted positions, with warped patches."""
        rig = self.rig
        other_from_node = geometry.inverse(other.world_from_camera) @ node.world_from_camera
        expected, jacobian, _ = observation_equations.transfer(points.measured, other_from_node, rig.baseline_m)
        warp = jacobian[:, :, :2] + jacobian[:, :, 2:] * points.disparity_slope[:, None, :]
        left_warp, right_warp = warp[:, :2], warp[:, :2] - np.stack([warp[:, 2], np.zeros_like(warp[:, 2])], axis=1)
        left_px, shift_px = self._project(expected)
        left, right = self.spool.gray(other.row)
        left_splines = patches.spline_coefficients(patches.pyramid(left, _LEVELS))
        in_left = patches.match_templates(templates, left_splines, left_px, left_warp)
        right_px, right_splines = in_left.points - shift_px, patches.spline_coefficients([right])
        in_right = patches.match_templates(templates, right_splines, right_px, right_warp)
        ok = in_left.ok & in_right.ok & stereo.satisfies_epipolar(in_left.points, in_right.points)
        ok &= self._in_view(points, other_from_node)
        source_cov = (in_left.cov[ok] + in_right.cov[ok]) / 2
        cov = left_warp[ok] @ source_cov @ left_warp[ok].transpose(0, 2, 1)
        left_px, right_px = rig.without_refraction(in_left.points[ok], in_right.points[ok])
        node_points = points.subset(ok)
        cov *= stereo.row_noise_ratio(left_px, right_px, cov) ** 2
        measured, measured_cov = stereo.fuse(left_px, right_px, cov, rig)
        left_shift = patches.locking_shifts(left_px, left_warp[ok], self.patch_px)
        right_shift = patches.locking_shifts(right_px, right_warp[ok], self.patch_px)
        locking = stereo.fused_shift(left_shift, right_shift, measured_cov, rig)
        pair = PairMeasurements(measured, node_points.measured, measured_cov, node_points.cov)
        return MatchedPair(pair, PixelLocking(locking, self._locking_in_node(node_points)))

    def _locking_in_node(self, points: StereoPoints) -> Array:
        """Returns the derivative (n, 3) of a node's measurements by pixel locking, which is only in the right image."""
        left_px, shift_px = self._project(points.measured)
        warp = np.tile(np.eye(2), (len(left_px), 1, 1))
        warp[:, 0] -= points.disparity_slope
        right_shift = patches.locking_shifts(left_px - shift_px, warp, self.patch_px)
        return stereo.fused_shift(np.zeros_like(right_shift), right_shift, points.cov, self.rig)

    def _in_view(self, points: StereoPoints, other_from_node: Array) -> Mask:
        """Returns a mask (n,) of the points whose patches are predicted well inside both images of the other node."""
        smoothed = np.column_stack([points.measured[:, :2], points.mean_disparity_px / self.rig.focal_px])
        expected, _, _ = observation_equations.transfer(smoothed, other_from_node, self.rig.baseline_m)
        left_px, shift_px = self._project(expected)
        in_left, in_right = (stereo.well_inside(px, self.rig, self.patch_px) for px in (left_px, left_px - shift_px))
        return in_left & in_right

    def _project(self, points: Array) -> tuple[Array, Array]:
        """Returns the left-image positions (n, 2) [px] of normalised points (n, 3), and (disparity, 0) (n, 2)."""
        left_px = points[:, :2] * self.rig.focal_px + [self.rig.cx_px, self.rig.cy_px]
        return left_px, np.column_stack([points[:, 2] * self.rig.focal_px, np.zeros(len(points))])

    def motion(self, node: Keyframe, other: Keyframe, matched: MatchedPair) -> two_view_motion.Motion | None:
        """Estimates the pose of `node` in the axes of `other` from their matched points, jointly with the structure."""
        # starts from the closed form (Negahdaripour & Madjidi 2003, eq. 2), or from the current poses if that fails;
        # None if too few points are matched or inliers
        a, b = (self._corrected(z, node.yaw_rad, at) for z, at in zip(matched.measured[:2], (other, node), strict=True))
        measured = matched.measured._replace(a=a, b=b)
        predicted = geometry.inverse(other.world_from_camera) @ node.world_from_camera
        closed_form = two_view_motion.exact_depth_motion(measured.a, measured.b, self.rig.baseline_m, predicted)
        settings = two_view_motion.PairMotionSettings(
            common_sigma=COMMON_BIAS_PX / self.rig.focal_px,
            variance_inflation=matching.variance_inflation(measured.b[:, :2] * self.rig.focal_px, self.patch_px),
            locking=matched.locking,
            half_size=np.array([self.rig.width_px, self.rig.height_px]) / (2 * self.rig.focal_px),
        )
        guess = predicted if closed_form is None else closed_form
        motion = two_view_motion.pair_motion(measured, self.rig.baseline_m, guess, settings)
        if motion is None or motion.n_points < MIN_INLIER_SHARE * len(measured.b):
            return None
        yaw_rad = node.yaw_rad
        yaw = motion.yaw and motion.yaw._replace(estimate=motion.yaw.estimate + yaw_rad, removed_rad=yaw_rad)
        return motion._replace(closed_form=closed_form, yaw=yaw)

    def _corrected(self, points: Array, yaw_rad: float, keyframe: Keyframe) -> Array:
        """Returns points (n, 3) of a keyframe, corrected for a yaw of the right camera and a rolling shutter."""
        remaining = yaw_rad - self.removed_yaw.get(keyframe.row, 0.0)
        if remaining:
            points = points - remaining * observation_equations.change_by_yaw(points)
        return at_mid_exposure(points, self.twists.get(keyframe.row), self.rig)
