"""Pixel locking: a bias of matched positions that depends on their sub-pixel position.

A template is extracted at whole pixels. Aliasing and interpolation of detail near the resolution limit shift its match
by -A sin(2 pi u) in column and by -A sin(2 pi v) in row, with u and v the column and row of the match [px] and A the
amplitude [px]. Digital image correlation has the same systematic error, of period one pixel (Schreier, Braasch & Sutton
2000, "Systematic errors in digital image correlation caused by intensity interpolation", Opt. Eng. 39). Neighbouring
points on a smooth floor have nearly the same sub-pixel position, so their biases do not average out. The amplitude
depends on texture and optics and differs between surveys: 0.010 px was measured over the floor of `reef`, and 0 over
the photographed gravel of `horseshoe`. It is therefore an unknown of the motion between two stereo pairs
(`two_view_motion.pair_motion`); this module gives its derivatives.

Where a patch is scaled, sheared or rotated between the images, the sub-pixel position varies over the patch, and the
biases of its pixels partly cancel. Averaging the sine over a patch of side s [px] multiplies its amplitude along an
image axis by sinc(s d1) sinc(s d2), with (d1, d2) the row for this axis of the matrix "warp minus identity", and
sinc t = sin(pi t) / (pi t). The warp is the derivative of target pixels with respect to source pixels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array

#: Prior standard deviation of the amplitude [px]: the root mean square of 0.010, 0.006, 0.004 and 0, which are the
#: amplitudes measured against the truth over two generated reefs, a flat floor and gravel.
SIGMA_PX = 0.006
MAX_AMPLITUDE_PX = 3 * SIGMA_PX  #: largest plausible estimate of the amplitude


class PixelLocking(NamedTuple):
    """Derivatives of the measurements of n points in two stereo pairs with respect to the amplitude of pixel locking."""

    a: Array  #: (n, 3) derivative of the normalised (x, y, disparity) in the earlier pair a [1/px]
    b: Array  #: (n, 3) the same in the later pair b


def shifts(pixels: NDArray[np.floating], warp: Array, patch_px: int) -> Array:
    """Returns the shifts (n, 2) [px] of matched positions due to pixel locking with an amplitude of 1 px.

    Args:
        pixels: (n, 2) matched positions in the target image [px].
        warp: (n, 2, 2) derivative of target pixels with respect to source pixels over each patch.
        patch_px: side of the patch [px].
    """
    varying = np.sinc(patch_px * (warp - np.eye(2)))  # numpy's sinc is sin(pi x) / (pi x)
    return -np.sin(2 * np.pi * pixels) * varying[:, :, 0] * varying[:, :, 1]
