"""Powers of two by a polynomial: agreement with numpy, exactness at integers, and underflow."""

import numpy as np
from numba import njit

from twin.core.vector_math import LOG2_E, two_to


@njit
def powers(exponents):
    out = np.empty_like(exponents)
    for k in range(exponents.size):
        out[k] = two_to(exponents[k])
    return out


def test_powers_agree_with_numpy_in_single_precision():
    exponents = np.concatenate([np.linspace(-126, 127, 100_001), np.linspace(-1e-3, 1e-3, 1001)]).astype(np.float32)
    np.testing.assert_allclose(powers(exponents), np.exp2(exponents.astype(np.float64)), rtol=2e-7)
    np.testing.assert_allclose(powers(np.array([LOG2_E], np.float32)), np.e, rtol=2e-7)


def test_integer_exponents_are_exact():
    integers = np.arange(-126, 128)
    np.testing.assert_array_equal(powers(integers.astype(np.float32)), np.ldexp(1.0, integers))


def test_exponents_below_the_normal_range_underflow():
    assert (powers(np.array([-127, -1e4, -1e30, -np.inf], np.float32)) <= 2.0**-126).all()
