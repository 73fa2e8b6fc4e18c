"""Powers of two for compiled loops, written so that the compiler can vectorize them."""

from __future__ import annotations

import numpy as np

from twin.kernels import kernel

LOG2_E = 1.4426950408889634
LEAST = -126.0  # exponent of the smallest normal number in single precision; smaller exponents are clipped to it


@kernel(inline="always")
def two_to(t):
    """Returns 2^t for t from -126 to 127 with a relative error of 2e-7, exactly 1 at 0; a smaller t counts as -126.

    2^t = 2^n 2^f with n an integer and |f| <= 1/2: 2^f - 1 is computed by a minimax polynomial, 2^n by setting the
    exponent bits of a float32.
    """
    one, t = np.float32(1.0), max(t, np.float32(LEAST))
    n = np.floor(t + np.float32(0.5))
    f = t - n
    p = np.float32(9.671513e-3) + f * np.float32(1.3264727e-3)
    p = np.float32(2.4022242e-1) + f * (np.float32(5.5507336e-2) + f * p)
    power = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return power * (one + f * (np.float32(6.931470e-1) + f * p))
