"""Noise with detail at every scale: random fields, and functions of position for loops over texels.

The functions of position (value, fractal and cellular noise) take a lattice of random numbers, shifted for each
`layer`, and are periodic with LATTICE lattice spacings. Cellular noise: Worley 1996, A cellular texture basis function.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.kernels import kernel

LATTICE = 512
_MASK = LATTICE - 1


def fractal_field(
    shape: tuple[int, int], coarsest_px: float, gain: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Returns an approximate fractional Brownian surface (rows, cols), with zero mean and unit standard deviation.

    The random values of octave k are coarsest_px / 2^k cells apart, between 1 and at least 2 cells; its amplitude is
    gain^k, with the gain 2^-H for a Hurst exponent H.
    """
    total = np.zeros(shape, np.float32)
    amplitude, scale_px = 1.0, float(max(coarsest_px, 2.0))
    while scale_px >= 1.0:
        cells = [max(4, int(np.ceil(n / scale_px)) + 3) for n in shape]
        noise = rng.standard_normal(cells, dtype=np.float32)
        total += amplitude * _upsample(noise, shape, scale_px)
        amplitude, scale_px = amplitude * gain, scale_px / 2
    return (total - total.mean()) / total.std()


def _upsample(noise: NDArray[np.float32], shape: tuple[int, int], scale_px: float) -> NDArray[np.float32]:
    affine = np.array([[1 / scale_px, 0, 1], [0, 1 / scale_px, 1]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    upsampled = cv2.warpAffine(noise, affine, shape[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(upsampled, np.float32)


def pink_noise(shape: tuple[int, int], octaves: int, contrast: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Returns 8-bit pink noise (rows, cols), mean 128, of octaves of standard deviation `contrast` [grey levels]."""
    sizes = [tuple(-(-n // 2**k) for n in shape) for k in range(octaves)][::-1]
    value = np.full(sizes[0], 128, np.uint8)
    weight = contrast * np.sqrt(12) / 255  # uniform noise from 0 to 255 has the standard deviation 255 / sqrt(12)
    for rows, cols in sizes:
        value = cv2.resize(value, (cols, rows), interpolation=cv2.INTER_LINEAR)
        noise = np.frombuffer(rng.bytes(rows * cols), np.uint8).reshape(rows, cols)
        value = cv2.addWeighted(value, 1.0, noise, weight, -128 * weight)
    return np.asarray(value, np.uint8)


def lattice_table(rng: np.random.Generator) -> NDArray[np.float32]:
    return rng.random((LATTICE, LATTICE), np.float32)


@kernel
def value_noise(x, y, table, layer):
    """Returns smooth noise, 0 to 1: the numbers at the points of the lattice, interpolated between the points."""
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    r0, c0 = (i + 61 * layer) & _MASK, (j + 113 * layer) & _MASK
    r1, c1 = (r0 + 1) & _MASK, (c0 + 1) & _MASK
    a, b = table[r0, c0], table[r1, c0]
    c, d = table[r0, c1], table[r1, c1]
    return (1.0 - v) * (a + u * (b - a)) + v * (c + u * (d - c))


@kernel(inline="always")
def fractal_noise(x, y, octaves, table, layer):
    """Returns a sum of octaves of value noise, about -1 to 1; amplitude and wavelength halve with each octave."""
    # numba compiles a function once for each value of an `int` constant in a call, but not of an `np.int64`
    return _octaves(x, y, np.int64(octaves), table, np.int64(layer))  # pyright: ignore[reportArgumentType]


@kernel
def _octaves(x, y, octaves, table, layer):
    total, amplitude = 0.0, 1.0
    for octave in range(octaves):
        total += amplitude * (2.0 * value_noise(x, y, table, layer + 7 * octave) - 1.0)
        x, y, amplitude = 2.0 * x, 2.0 * y, 0.5 * amplitude
    return total


@kernel
def cells(x, y, table, layer):
    """Returns the distances to the nearest two points of cellular noise [spacings], and the number of the nearest."""
    # Each square of the lattice contains one point, at a random place.
    nearest, second, row, col = 9.0, 9.0, 0, 0
    i0, j0 = int(np.floor(x)) - 1, int(np.floor(y)) - 1
    for i in range(i0, i0 + 3):
        for j in range(j0, j0 + 3):
            r, c = (i + 61 * layer) & _MASK, (j + 113 * layer) & _MASK
            dx = i + table[r, c] - x
            dy = j + table[(r + 200) & _MASK, c] - y
            squared = dx * dx + dy * dy
            if squared < nearest:
                nearest, second, row, col = squared, nearest, r, c
            elif squared < second:
                second = squared
    return np.sqrt(nearest), np.sqrt(second), table[row, (col + 300) & _MASK]
