"""Frame-to-frame motion at video rate (P5, P6): flow of known points, eq. (2), composed along the path."""

from __future__ import annotations

import numpy as np

from twin import geometry
from twin.estimate import matching, motion
from twin.estimate.stereo import StereoPoints, normalised
from twin.geometry import Array
from twin.records import StereoRig

MOST_POINTS = 150  # the best ones: key points correct what the frames between them drift


class FrameToFrame:
    """Carries the points of the last key point from frame to frame.

    A step that fails keeps the last velocity, says so, and reports a covariance that admits it.
    """

    def __init__(self, rig: StereoRig, patch_px: int):
        self.rig, self.patch_px = rig, patch_px
        self.image: matching.Image | None = None
        self.pixels = np.zeros((0, 2), np.float32)
        self.xyz = np.zeros((0, 3))
        self.last_motion = np.eye(4)

    def restart(self, image: matching.Image, points: StereoPoints) -> None:
        """Takes the points of a new key point."""
        self.image, self.pixels, self.xyz = image, points.pixels[:MOST_POINTS], points.xyz[:MOST_POINTS]

    def step(self, image: matching.Image) -> tuple[motion.Motion, str]:
        """Motion from the last frame to this one, and "ok" or why it failed."""
        if self.image is None:
            self.image = image
            return motion.Motion(np.eye(4), np.eye(6) * 1e-12, 0, 0.0), "ok"
        expected = geometry.transform(geometry.inverse(self.last_motion), self.xyz)
        guess = self.rig.project(expected)
        found, ok = matching.track(self.image, image, self.pixels, guess, self.patch_px)
        result = motion.frame_motion(self.xyz[ok], normalised(found[ok], self.rig), self.last_motion)
        self.image = image
        if result is None:
            return self._coast()
        result = result._replace(cov=result.cov * matching.correlation(found[ok], self.patch_px))
        self.last_motion = result.a_from_b
        self.pixels = found[ok]
        self.xyz = geometry.transform(geometry.inverse(result.a_from_b), self.xyz[ok])
        return result, "ok"

    def _coast(self) -> tuple[motion.Motion, str]:
        """The last velocity, held: the points cannot be followed any more."""
        self.pixels, self.xyz = self.pixels[:0], self.xyz[:0]
        return coast(self.last_motion)


def coast(last_motion: Array) -> tuple[motion.Motion, str]:
    """The last motion (4, 4) of a frame once more, with a covariance that admits it, and why."""
    step = geometry.log(last_motion)
    sigma = np.concatenate([np.full(3, 0.01), np.full(3, 0.01 + np.linalg.norm(step[3:]))])
    return motion.Motion(last_motion, np.diag(np.asarray(sigma**2, np.float64)), 0, np.inf), "too few points matched"
