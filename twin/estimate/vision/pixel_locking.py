"""Pixel locking: a bias of matched positions that depends on their sub-pixel position.

A match at column u and row v [px] is shifted by -A sin(2 pi u) and -A sin(2 pi v) (Schreier, Braasch & Sutton 2000,
Opt. Eng. 39). On a smooth floor this does not average out. The amplitude A depends on texture and optics (0 to 0.01
px), so it is an unknown of `two_view_motion.pair_motion`; this module gives its derivatives.

Where a patch of side s is warped, its pixels' biases partly cancel: A along an image axis is multiplied by sinc(s d1)
sinc(s d2), with (d1, d2) the row for this axis of "warp minus identity", and sinc t = sin(pi t) / (pi t).
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
    """Derivatives of the measurements of n points in two pairs with respect to the amplitude of pixel locking."""

    a: Array  #: (n, 3) derivative of the normalised (x, y, disparity) in the earlier pair a [1/px]
    b: Array  #: (n, 3) the same in the later pair b


def shifts(pixels: NDArray[np.floating], warp: Array, patch_px: int) -> Array:
    """Returns the shifts (n, 2) [px] of matched positions due to pixel locking with an amplitude of 1 px.

    Args:
        pixels: (n, 2) matched positions in the target image [px].
        warp: (n, 2, 2) derivative of target pixels with respect to source pixels over each patch.
    """
    varying = np.sinc(patch_px * (warp - np.eye(2)))  # numpy's sinc is sin(pi x) / (pi x)
    return -np.sin(2 * np.pi * pixels) * varying[:, :, 0] * varying[:, :, 1]
