"""What the measurements of a survey err by, fitted to rendered surveys.

All errors follow one number: the least deviation with which noise lets a patch be placed (Cramer-Rao, `conditions`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Law(NamedTuple):
    """A deviation that has a floor and grows with the Cramer-Rao bound c: sqrt(floor^2 + (rise c)^2)."""

    floor: float
    rise: float

    def __call__(self, bound_px: float) -> float:
        return float(np.hypot(self.floor, self.rise * bound_px))


class Share(NamedTuple):
    """A share that is `most` in good conditions and falls to half of it where the bound is `half_px`."""

    most: float
    half_px: float
    power: float

    def __call__(self, bound_px: float) -> float:
        return float(self.most / (1 + (bound_px / self.half_px) ** self.power))


class ErrorModel(NamedTuple):
    """Errors of what images tell.

    Args:
        bound_px: (least, greatest) Cramer-Rao bound of the calibration.
        points: share of `estimate.points` that a keyframe finds.
        place_px: claimed deviation of a patch's place in one image.
        place_excess: true over claimed deviation of these.
        lamps: by how much patches err more where lamps that move along light the floor: the square of `place_excess`
            grows by that of this times their share of the light.
        matched: share of the points in view of another keyframe that are found there.
        correlation: by how much points are fewer than they seem, as `matching.correlation` tells.
        steady: how much of a place's deviation in the earlier images is the same in whatever link it is looked for.
        apart: by how much patches are claimed to be placed worse from farther off: the variance of a match grows by the
            square of this times the way between two keyframes, in depths.
        relief: by what part of what the floor under a patch lies out of its plane (`conditions`) the patch seems to
            move, the same for every match of that piece of the floor, so that it adds up along a path. With g the
            gradient of the texture and d by how much a pixel lies out, a patch moves by (sum g g')^-1 sum g g' d of the
            way. Stereo, along the rows, weighs d by the square of g's part along them and so knows what a way along
            them does to the columns. What is left is as much across either way, by the product of both parts, and
            twice as much (for a texture alike in all directions) in the rows by a way across them.
        common_px: deviation of a bias that all points of a link share.
        f2f_px: claimed deviation of a flow vector from frame to frame.
        f2f_excess: true over claimed deviation of a frame's motion.
        f2f_undone: share of a frame's error that the next frame undoes: both are measured against the same points.
        mosaic_px: claimed deviation of a vector to the mosaic, as if as many as from frame to frame told it.
        mosaic_excess: true over claimed deviation of a correction.
        depth_px: claimed deviation of a pixel's filtered depth [px of disparity].
        depth_excess: true over claimed deviation of these.
        lateral_px: deviation of the surface sideways that all views of it share.
        complete: share of the cells in view whose depth is known.
    """

    bound_px: tuple[float, float] = (0.0, 1.0)
    points: Share = Share(0.9, 1.0, 4.0)
    place_px: Law = Law(0.02, 1.0)
    place_excess: float = 1.05
    lamps: float = 0.0
    matched: Share = Share(0.97, 1.0, 4.0)
    correlation: float = 1.5
    steady: float = 0.8
    apart: float = 0.0
    relief: float = 0.0
    common_px: float = 0.005
    f2f_px: Law = Law(0.05, 1.0)
    f2f_excess: float = 1.4
    f2f_undone: float = 0.3
    mosaic_px: Law = Law(0.2, 1.0)
    mosaic_excess: float = 2.0
    depth_px: Law = Law(0.05, 1.0)
    depth_excess: float = 1.0
    lateral_px: float = 0.2
    complete: Share = Share(0.999, 2.0, 4.0)
