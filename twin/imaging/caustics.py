"""Caustics: sunlight that waves of the surface gather into bright lines, which run over the floor.

The surface is a sum of waves that fit into a square, which repeats itself. A ray from the zenith meets the surface
where its slope is s, is bent by (1 - 1/n) s for small slopes, and reaches the floor (1 - 1/n) s D away. Every ray keeps
its light and lands somewhere in the square: none is lost, and the mean is one. The sun's disc and scattering on the way
down spread it (Wells' small angles, as in `forward_scatter`): deep down the lines fade.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft

from twin.imaging.forward_scatter import forward_lobe
from twin.imaging.water import Medium

Array = NDArray[np.float64]

TILE_M, CELLS = 4.0, 128  # side of the square; a power of two
RAYS = 2  # along each side of a cell
WAVELENGTHS_M = (0.3, 3.0)
SLOPE_RMS = 0.08  # of a surface under a light breeze
WATER_INDEX, GRAVITY_MPS2 = 1.339, 9.81
SUN_RAD = 0.0047 / 2 / WATER_INDEX  # deviation of the directions within the sun's disc, along one axis, in water
STREAM = 1 << 16  # of the seed's randomness: of the waves alone


class Caustics:
    """The pattern on the floor of one survey.

    Args:
        depth_m: of the reference plane below the surface.
        share: of the light that is focused; the rest comes from all the sky and is even.
    """

    def __init__(self, depth_m: float, share: float, water: Medium, seed: int):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
        per_m = 2 * np.pi * fft.fftfreq(CELLS, TILE_M / CELLS)
        kx, ky = np.meshgrid(per_m, per_m)
        k = np.hypot(kx, ky)
        among = (k >= 2 * np.pi / WAVELENGTHS_M[1]) & (k <= 2 * np.pi / WAVELENGTHS_M[0])
        # equal slope in each octave of waves, most of it along the wind (east), none against it
        weight = np.where(among & (kx > 0), kx**2 / np.maximum(k, 1e-9) ** 4, 0.0)
        height = np.sqrt(weight) * (rng.normal(size=k.shape) + 1j * rng.normal(size=k.shape))
        height *= SLOPE_RMS * np.sqrt(2 / (np.abs(k * height) ** 2).sum())  # half of a wave's square is its mean
        some = slice(int(np.count_nonzero(per_m[: CELLS // 2] <= 2 * np.pi / WAVELENGTHS_M[0])))  # no waves beyond
        self._omega = np.sqrt(GRAVITY_MPS2 * k[:, some])
        # of a real surface half the waves tell the others
        self._slope = [(0.5j * along * height)[:, some].astype(np.complex64) for along in (kx, ky)]
        self._throw = np.float32((1 - 1 / WATER_INDEX) * depth_m * CELLS / TILE_M)
        self._blur = _blur(k[:, : CELLS // 2 + 1], depth_m, water).astype(np.float32)
        self._share = np.float32(share)
        self._now: tuple[float, NDArray[np.float32]] | None = None

    def pattern(self, time_s: float) -> NDArray[np.float32]:
        """(CELLS, CELLS) light against the mean, 1; row = north, column = east from the world's origin."""
        if self._now is None or self._now[0] != time_s:
            self._now = time_s, self._at(time_s)
        return self._now[1]

    def slopes(self, time_s: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(CELLS, CELLS) slopes of the surface to the east and to the north."""
        turned = np.exp(-1j * self._omega * time_s).astype(np.complex64)  # waves on deep water
        size = CELLS, CELLS
        east, north = (np.asarray(fft.irfft2(slope * turned, s=size, norm="forward")) for slope in self._slope)
        return east, north

    def _at(self, time_s: float) -> NDArray[np.float32]:
        light = np.zeros((CELLS, CELLS), np.float32)
        _land(*self.slopes(time_s), self._throw, light)
        spread = np.asarray(fft.irfft2(np.asarray(fft.rfft2(light)) * self._blur, s=light.shape))
        return 1 + self._share * (spread - 1)


def _blur(k: Array, depth_m: float, water: Medium) -> Array:
    """What is left of a pattern's waves of number k [1/m] by the sun's disc and by scattering, as green light finds it.

    exp(-t) of the light was never scattered forward; the rest was so n = t / (1 - exp(-t)) times.
    """
    lobe = forward_lobe(water.mean_cosine)
    thickness = lobe.share * float(water.scattering_per_m[1]) * depth_m
    straight = np.exp(-thickness)
    times = thickness / (1 - straight) if thickness > 1e-9 else 1.0
    scattered = np.exp(-0.5 * (k * depth_m) ** 2 * lobe.variance_rad2 * times / 3)
    return np.exp(-0.5 * (k * depth_m * SUN_RAD) ** 2) * (straight + (1 - straight) * scattered)


@njit(cache=True, nogil=True, error_model="numpy")
def _land(east, north, throw, light):
    """Adds to `light` (n, n) rays from all over the surface, each shared among the four cells it lands between."""
    n, each, one = light.shape[0], np.float32(1 / RAYS**2), np.float32(1.0)
    for i in range(n):
        i1 = (i + 1) & (n - 1)
        for j in range(n):
            j1 = (j + 1) & (n - 1)
            for part in range(RAYS * RAYS):
                a, b = np.float32((part // RAYS) / RAYS), np.float32((part % RAYS) / RAYS)
                to_east = (one - a) * ((one - b) * east[i, j] + b * east[i, j1])
                to_east += a * ((one - b) * east[i1, j] + b * east[i1, j1])
                to_north = (one - a) * ((one - b) * north[i, j] + b * north[i, j1])
                to_north += a * ((one - b) * north[i1, j] + b * north[i1, j1])
                col, row = np.float32(j) + b - throw * to_east, np.float32(i) + a - throw * to_north
                left, low = np.floor(col), np.floor(row)
                w, h = col - left, row - low
                k, m = int(left) & (n - 1), int(low) & (n - 1)
                k1, m1 = (k + 1) & (n - 1), (m + 1) & (n - 1)
                light[m, k] += each * (one - w) * (one - h)
                light[m, k1] += each * w * (one - h)
                light[m1, k] += each * (one - w) * h
                light[m1, k1] += each * w * h
