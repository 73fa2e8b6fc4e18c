"""Tests of the interpolation kernels against scipy and against polynomials that they reproduce exactly."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from twin.core import interpolation
from twin.core.height_field import map_slopes

ROWS, COLUMNS = np.mgrid[:9, :11].astype(np.float32)


@pytest.mark.parametrize("s", [0.0, 0.25, 0.7])
def test_bspline_weights_are_those_of_scipy(s):
    basis = BSpline.basis_element(np.arange(-2.0, 3.0))
    expected = [basis(s + 1), basis(s), basis(s - 1), basis(s - 2) if s > 0 else 0.0]
    np.testing.assert_allclose(interpolation.bspline_weights(np.float32(s)), expected, atol=1e-6)


@pytest.mark.parametrize("t", [0.0, 0.3, 0.9])
def test_catmull_rom_reproduces_parabolas_and_their_slope(t):
    samples = [1 + 2 * x - 0.5 * x * x for x in (-1.0, 0.0, 1.0, 2.0)]
    value, slope = interpolation.catmull_rom(*samples, t)
    assert value == pytest.approx(1 + 2 * t - 0.5 * t * t)
    assert slope == pytest.approx(2 - t)


@pytest.mark.parametrize(("x", "y"), [(4.3, 5.6), (4.3, 5.0)])
def test_bicubic_interpolation_reproduces_parabolas_and_their_gradient(x, y):
    image = 1 + 2 * COLUMNS - 0.5 * COLUMNS**2 + 3 * ROWS + 0.25 * ROWS**2 - COLUMNS * ROWS
    expected = 1 + 2 * x - 0.5 * x * x + 3 * y + 0.25 * y * y - x * y, 2 - x - y, 3 + 0.5 * y - x
    value, by_x, by_y = interpolation.bicubic_with_gradient(image, x, y)
    # on an exact row, the derivative by y is that of the nearest column to the left
    tolerance = 1e-4 if y % 1 else 0.31
    assert (value, by_x) == pytest.approx(expected[:2], abs=1e-4)
    assert by_y == pytest.approx(expected[2], abs=tolerance)


def test_bilinear_interpolation_reproduces_bilinear_functions():
    image = 1 + 2 * COLUMNS + 3 * ROWS - COLUMNS * ROWS
    value = interpolation.bilinear(image, 5, 4, 0.6, 0.3)
    assert value == pytest.approx(1 + 2 * 4.3 + 3 * 5.6 - 4.3 * 5.6, abs=1e-5)


def test_the_slopes_of_a_plane_are_exact_and_zero_along_a_single_cell():
    """Height 0.3 x - 0.2 y: row 0 is in the north."""
    x, y = np.meshgrid(np.arange(4) * 0.5, -np.arange(3) * 0.5)
    plane = 0.3 * x - 0.2 * y
    for part, expected in ((plane, (0.3, -0.2)), (plane[:1], (0.3, 0.0)), (plane[:, :1], (0.0, -0.2))):
        for found, value in zip(map_slopes(part, 0.5), expected, strict=True):
            np.testing.assert_allclose(found, np.full(part.shape, value), atol=1e-12)
