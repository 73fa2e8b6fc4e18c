"""Frame-to-frame motion at video rate (P5, P6): flow of known points, eq. (1), composed along the path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import StereoRig
from twin.estimate.vision import matching, observation_equations, two_view_motion
from twin.estimate.vision.stereo import StereoPoints, normalised

MOST_POINTS = 150  # the best ones: keyframes correct what the frames between them drift
_KEPT = 0.7  # of an anchor's points: where an image shows fewer, patches may have changed as well
_UNKNOWN = 1.0  # variance of a disparity that a single image does not tell, normalised


class _Anchor(NamedTuple):
    """What frames are held against: an image, and its points as `StereoPoints` has them."""

    image: matching.Image
    pixels: matching.Points
    measured: Array
    cov: Array

    def xyz(self, baseline_m: float) -> Array:
        """(n, 3) in its camera [m]."""
        x, y, disparity = self.measured.T
        return np.column_stack([x, y, np.ones_like(x)]) * (baseline_m / disparity[:, None])


class FrameToFrame:
    """Follows the points of the last keyframe; a frame's motion is the step between two positions against it.

    Patches are looked for as the keyframe shows them, and the structure is estimated along (`motion.pair_motion`).
    From one frame to the next, and with the depth taken as exact as eq. (2) has it, the motion over the 15 frames
    between two keyframes of a survey was biased: by 1.25 mrad of pitch over fine texture, for what the matching of
    each frame errs by adds up (now 0.1 +- 0.1), and by 4 mrad over coarse texture, whose depth is noisy (now 0.5 +-
    0.7). It scatters by 0.35 mrad, not by 0.6.

    A step that fails keeps the last velocity, says so, and reports a covariance that admits it.
    """

    def __init__(self, rig: StereoRig, patch_px: int):
        self.rig, self.patch_px = rig, patch_px
        self.anchor: _Anchor | None = None
        self.begun = False
        self.anchor_from_now = np.eye(4)
        self.last_motion = np.eye(4)

    def restart(self, image: matching.Image, points: StereoPoints) -> None:
        """Takes the image of a new keyframe and its points, best first."""
        best = slice(MOST_POINTS)
        self._hold(_Anchor(image, points.pixels[best], points.measured[best], points.cov[best]))

    def step(self, image: matching.Image) -> tuple[two_view_motion.Motion, str]:
        """Motion from the last frame to this one, and "ok" or why it failed.

        Its covariance is that of the position against the keyframe. Frames undo each other's errors: over several of
        them the sum of their covariances is too careful.
        """
        if not self.begun:
            self.begun = True
            return two_view_motion.Motion(np.eye(4), np.eye(6) * 1e-12, 0, 0.0), "ok"
        before, expected = self.anchor_from_now, self.anchor_from_now @ self.last_motion
        found = None if self.anchor is None else self._locate(image, self.anchor, expected)
        if found is None:
            self.anchor_from_now = expected
            return coast(self.last_motion)
        self.last_motion = geometry.inverse(before) @ found.a_from_b
        return found._replace(a_from_b=self.last_motion), "ok"

    def _hold(self, anchor: _Anchor) -> None:
        self.anchor, self.anchor_from_now = anchor, np.eye(4)

    def _locate(self, image: matching.Image, anchor: _Anchor, expected: Array) -> two_view_motion.Motion | None:
        """Position of an image against the anchor, where it is expected at (4, 4); None where too few points agree.

        An image that shows too few of the points becomes the anchor itself, with those that it shows.
        """
        now_from_anchor = geometry.inverse(expected)
        points = geometry.transform(now_from_anchor, anchor.xyz(self.rig.baseline_m))
        guess = self.rig.project(points).astype(np.float32)
        found, ok = matching.track(anchor.image, image, anchor.pixels, guess, self.patch_px)
        pixels, measured, cov = found[ok], anchor.measured[ok], anchor.cov[ok]
        seen, seen_cov = np.zeros_like(measured), np.zeros_like(cov)
        seen[:, :2], seen_cov[:, :2, :2], seen_cov[:, 2, 2] = normalised(pixels, self.rig), cov[:, :2, :2], _UNKNOWN
        shared = matching.correlation(pixels, self.patch_px)
        moved = two_view_motion.pair_motion(
            seen, measured, seen_cov, cov, self.rig.baseline_m, now_from_anchor, correlation=shared, told=2
        )
        if moved is None:
            return None
        carry = geometry.adjoint(moved.a_from_b)
        self.anchor_from_now = geometry.rigid(geometry.inverse(moved.a_from_b))  # else errors double with every frame
        located = moved._replace(a_from_b=self.anchor_from_now, cov=carry @ moved.cov @ carry.T)
        if ok.mean() < _KEPT:
            seen[:, 2] = observation_equations.transfer(measured, moved.a_from_b, self.rig.baseline_m)[0][:, 2]
            self._hold(_Anchor(image, pixels, seen, cov))
        return located


def coast(last_motion: Array) -> tuple[two_view_motion.Motion, str]:
    """The last motion (4, 4) of a frame once more, with a covariance that admits it, and why."""
    step = geometry.log(last_motion)
    sigma = np.concatenate([np.full(3, 0.01), np.full(3, 0.01 + np.linalg.norm(step[3:]))])
    return two_view_motion.Motion(
        last_motion, np.diag(np.asarray(sigma**2, np.float64)), 0, np.inf
    ), "too few points matched"
