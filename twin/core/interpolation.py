"""Compiled kernels that interpolate between the pixels of an image; fractions between two samples are in [0, 1)."""

import numpy as np

from twin.kernels import kernel


@kernel(inline="always")
def bilinear(image, row, col, row_fraction, col_fraction):
    """Returns the image value interpolated bilinearly between pixels (row, col) and (row + 1, col + 1)."""
    top = image[row, col] * (1 - col_fraction) + image[row, col + 1] * col_fraction
    bottom = image[row + 1, col] * (1 - col_fraction) + image[row + 1, col + 1] * col_fraction
    return top * (1 - row_fraction) + bottom * row_fraction


@kernel(inline="always")
def catmull_rom(a, b, c, e, t):
    """Returns value and derivative of the Catmull-Rom cubic (Keys 1981) at the fraction t between b and c."""
    c1 = 0.5 * (c - a)
    c2 = a - 2.5 * b + 2 * c - 0.5 * e
    c3 = 0.5 * (e - a) + 1.5 * (b - c)
    return b + t * (c1 + t * (c2 + t * c3)), c1 + t * (2 * c2 + 3 * t * c3)


@kernel(inline="always")
def catmull_rom_weights(t):
    """Returns the weights of four samples in the Catmull-Rom cubic at the fraction t (float32) of the middle two."""
    half, one, two = np.float32(0.5), np.float32(1), np.float32(2)
    first, last = half * t * (t * (two - t) - one), half * t * t * (t - one)
    second = one + half * t * t * (np.float32(3) * t - np.float32(5))
    return first, second, one - first - second - last, last


@kernel(inline="always")
def bicubic_with_gradient(image, x, y):
    """Returns an image and its derivatives at column x, row y inside it, by bicubic (Catmull-Rom) interpolation."""
    # In a row of integer y, as in rectified stereo, d/dy is the central difference at the column floor(x).
    height, width = image.shape
    i, j = int(x), int(y)
    s, t = np.float32(x - i), np.float32(y - j)
    i0, i2, i3 = max(i - 1, 0), min(i + 1, width - 1), min(i + 2, width - 1)
    j0, j2, j3 = max(j - 1, 0), min(j + 1, height - 1), min(j + 2, height - 1)
    b, gb = catmull_rom(image[j, i0], image[j, i], image[j, i2], image[j, i3], s)
    if t == 0:
        return b, gb, np.float32(0.5) * (image[j2, i] - image[j0, i])
    a, ga = catmull_rom(image[j0, i0], image[j0, i], image[j0, i2], image[j0, i3], s)
    c, gc = catmull_rom(image[j2, i0], image[j2, i], image[j2, i2], image[j2, i3], s)
    e, ge = catmull_rom(image[j3, i0], image[j3, i], image[j3, i2], image[j3, i3], s)
    value, gy = catmull_rom(a, b, c, e, t)
    return value, catmull_rom(ga, gb, gc, ge, t)[0], gy


@kernel(forceinline=True, fastmath=True)
def bspline_weights(s):
    """Returns the weights of four cubic B-spline coefficients at the fraction s (float32) between the middle two."""
    one, sixth = np.float32(1), np.float32(1 / 6)
    left, right = (one - s) * (one - s) * (one - s) * sixth, s * s * s * sixth
    middle = np.float32(2 / 3) - s * s * (one - s * np.float32(0.5))
    return left, middle, one - left - middle - right, right
