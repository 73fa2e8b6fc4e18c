"""Noise as a function of position: value, fractal and cellular noise from a periodic lattice of random numbers.

Cellular noise: Worley 1996, A cellular texture basis function. The functions are compiled for use in loops over texels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.kernels import kernel

#: (LATTICE, LATTICE) float32 uniform random numbers, 0 to 1. All noise is periodic with LATTICE lattice spacings.
Table = NDArray[np.float32]
LATTICE = 512
_MASK = LATTICE - 1


def lattice_table(rng: np.random.Generator) -> Table:
    """Returns the random numbers (rows, cols) of a periodic lattice, uniform from 0 to 1."""
    return rng.random((LATTICE, LATTICE), np.float32)


@kernel
def value_noise(x: float, y: float, table: Table, layer: int) -> float:  # pragma: no cover (compiled)
    """Returns smooth noise, 0 to 1: the numbers at the points of the lattice, interpolated between the points.

    Args:
        layer: number of a layer; each layer is the same lattice with another shift.
    """
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    r0, c0 = (i + 61 * layer) & _MASK, (j + 113 * layer) & _MASK
    r1, c1 = (r0 + 1) & _MASK, (c0 + 1) & _MASK
    a, b = table[r0, c0], table[r1, c0]
    c, d = table[r0, c1], table[r1, c1]
    return (1.0 - v) * (a + u * (b - a)) + v * (c + u * (d - c))


@kernel(inline="always")
def fractal_noise(x: float, y: float, octaves: int, table: Table, layer: int) -> float:  # pragma: no cover (compiled)
    """Returns a sum of octaves of value noise, about -1 to 1 with a mean of about 0.

    Each octave has half the amplitude and half the wavelength of the previous one.

    Args:
        x, y: position in lattice spacings of the first octave.
        layer: layer of the first octave, see `value_noise`.
    """
    # numba compiles a function once for each value of an `int` constant in a call, but not of an `np.int64`
    return _octaves(x, y, np.int64(octaves), table, np.int64(layer))  # pyright: ignore[reportArgumentType]


@kernel
def _octaves(x: float, y: float, octaves: int, table: Table, layer: int) -> float:  # pragma: no cover (compiled)
    """Compiled loop of `fractal_noise`."""
    total, amplitude = 0.0, 1.0
    for octave in range(octaves):
        total += amplitude * (2.0 * value_noise(x, y, table, layer + 7 * octave) - 1.0)
        x, y, amplitude = 2.0 * x, 2.0 * y, 0.5 * amplitude
    return total


@kernel
def cells(x: float, y: float, table: Table, layer: int) -> tuple[float, float, float]:  # pragma: no cover (compiled)
    """Returns the distances to the nearest and second nearest point of cellular noise, and a random number.

    Each square of the lattice contains one point, at a random place.

    Returns:
        Both distances in lattice spacings; a random number from 0 to 1 that belongs to the nearest point.
    """
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
