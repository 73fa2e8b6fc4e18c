"""Powers of two inside a compiled loop, in steps that a processor does for many numbers at once."""

from __future__ import annotations

import numpy as np
from numba import njit

LOG2_E = 1.4426950408889634
LEAST = -126.0  # of exponents: smaller ones count as this, which single precision just holds in full


@njit(cache=True, nogil=True, inline="always")
def two_to(t):
    """2^t for t up to 127, to 2e-7 of itself; exactly 1 at 0.

    2^t = 2^n 2^f, n whole and f within 1/2 of 0; of 2^f - 1 the minimax polynomial, of 2^n the bits of a float32.
    """
    one, t = np.float32(1.0), max(t, np.float32(LEAST))
    n = np.floor(t + np.float32(0.5))
    f = t - n
    p = np.float32(9.671513e-3) + f * np.float32(1.3264727e-3)
    p = np.float32(2.4022242e-1) + f * (np.float32(5.5507336e-2) + f * p)
    power = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return power * (one + f * (np.float32(6.931470e-1) + f * p))
