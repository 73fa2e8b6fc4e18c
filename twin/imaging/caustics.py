"""Caustics: bright moving lines on the floor where waves on the water surface focus the sunlight.

The surface is a sum of waves that are periodic in a square tile. A vertical ray that meets the surface at a small slope
s is refracted by the angle (1 - 1/n) s, with n the refractive index of water, and reaches a floor at depth D with a
horizontal displacement of (1 - 1/n) s D. A ray that leaves the tile re-enters on the opposite side, so the mean of the
pattern is 1. The angular size of the sun and scattering in the water (small-angle theory of Wells, as in
`forward_scatter`) blur the pattern, so its contrast decreases with depth.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft

from twin.imaging.forward_scatter import forward_scattering
from twin.imaging.illumination import Illumination
from twin.imaging.water import Medium

Array = NDArray[np.float64]

TILE_M, CELLS = 4.0, 128  # side of the tile [m]; number of cells per side, a power of two
RAYS = 2  # number of rays per side of a cell
WAVELENGTHS_M = (0.3, 3.0)  # shortest and longest water wave
SLOPE_RMS = 0.08  # RMS slope of the water surface in a light breeze
WATER_INDEX, GRAVITY_MPS2 = 1.339, 9.81
SUN_RAD = 0.0047 / 2 / WATER_INDEX  # standard deviation of directions within the solar disc along one axis, in water
STREAM = 1 << 16  # key of the random stream for the waves


class Caustics:
    """Caustics of one survey: a time-dependent pattern, computed on the reference plane.

    Args:
        illumination: optical properties of the water, depth of the reference plane, and the fraction of the daylight
            that the waves focus; the rest of the daylight is diffuse and uniform.
        seed: seed of the scenario.
    """

    def __init__(self, illumination: Illumination, seed: int):
        water, daylight = illumination
        depth_m = daylight.reference_depth_m
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
        per_m = 2 * np.pi * fft.fftfreq(CELLS, TILE_M / CELLS)
        kx, ky = np.meshgrid(per_m, per_m)
        k = np.hypot(kx, ky)
        in_band = (k >= 2 * np.pi / WAVELENGTHS_M[1]) & (k <= 2 * np.pi / WAVELENGTHS_M[0])
        # slope variance is equal in each octave; most waves run downwind (east), none upwind
        weight = np.where(in_band & (kx > 0), kx**2 / np.maximum(k, 1e-9) ** 4, 0.0)
        height = np.sqrt(weight) * (rng.normal(size=k.shape) + 1j * rng.normal(size=k.shape))
        height *= SLOPE_RMS * np.sqrt(2 / (np.abs(k * height) ** 2).sum())  # the mean square of a sine is 1/2
        # columns in which all waves are shorter than the shortest wavelength are zero and are not stored
        columns = slice(int(np.count_nonzero(per_m[: CELLS // 2] <= 2 * np.pi / WAVELENGTHS_M[0])))
        self._omega = np.sqrt(GRAVITY_MPS2 * k[:, columns])
        # 0.5: the spectrum of a real surface is Hermitian, and only one half of it is stored
        self._slope = [(0.5j * along * height)[:, columns].astype(np.complex64) for along in (kx, ky)]
        self._cells_per_slope = np.float32((1 - 1 / WATER_INDEX) * depth_m * CELLS / TILE_M)
        self._blur = _blur(k[:, : CELLS // 2 + 1], depth_m, water).astype(np.float32)
        self._share = np.float32(daylight.focused_share)
        self._cached: tuple[float, NDArray[np.float32]] | None = None

    def pattern(self, time_s: float) -> NDArray[np.float32]:
        """Returns the illuminance (CELLS, CELLS) divided by its mean; row 0 = south, column 0 = west.

        The latest pattern is cached, because both cameras use it.
        """
        if self._cached is None or self._cached[0] != time_s:
            self._cached = time_s, self._compute(time_s)
        return self._cached[1]

    def slopes(self, time_s: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Returns the slopes of the water surface towards east and towards north, each (CELLS, CELLS)."""
        phase = np.exp(-1j * self._omega * time_s).astype(np.complex64)  # deep-water dispersion
        size = CELLS, CELLS
        east, north = (np.asarray(fft.irfft2(slope * phase, s=size, norm="forward")) for slope in self._slope)
        return east, north

    def _compute(self, time_s: float) -> NDArray[np.float32]:
        light = np.zeros((CELLS, CELLS), np.float32)
        _trace_rays(*self.slopes(time_s), self._cells_per_slope, light)
        blurred = np.asarray(fft.irfft2(np.asarray(fft.rfft2(light)) * self._blur, s=light.shape))
        return 1 + self._share * (blurred - 1)


def _blur(k: Array, depth_m: float, water: Medium) -> Array:
    """Returns the modulation transfer function of the blur by the solar disc and by forward scattering of green light.

    With t the optical thickness of forward scattering over the depth, the fraction exp(-t) of the light is not
    scattered; the rest is scattered t / (1 - exp(-t)) times on average.

    Args:
        k: wave numbers of the pattern, of any shape [rad/m].
        depth_m: depth of the plane below the surface.
        water: optical properties of the water.
    """
    lobe = forward_scattering(water.mean_cosine)
    thickness = lobe.share * float(water.scattering_per_m[1]) * depth_m
    unscattered = np.exp(-thickness)
    n_scatterings = thickness / (1 - unscattered) if thickness > 1e-9 else 1.0
    scattered = np.exp(-0.5 * (k * depth_m) ** 2 * lobe.variance_rad2 * n_scatterings / 3)
    return np.exp(-0.5 * (k * depth_m * SUN_RAD) ** 2) * (unscattered + (1 - unscattered) * scattered)


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_rays(east, north, cells_per_slope, light):
    """Traces evenly spaced vertical rays through the surface; adds each to four cells of `light` with bilinear weights.

    Args:
        east, north: (n, n) slopes of the surface.
        cells_per_slope: displacement of a ray on the floor per unit of slope [cells].
        light: (n, n) illuminance relative to its mean, modified in place.
    """
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
                col, row = np.float32(j) + b - cells_per_slope * to_east, np.float32(i) + a - cells_per_slope * to_north
                left, low = np.floor(col), np.floor(row)
                w, h = col - left, row - low
                k, m = int(left) & (n - 1), int(low) & (n - 1)
                k1, m1 = (k + 1) & (n - 1), (m + 1) & (n - 1)
                light[m, k] += each * (one - w) * (one - h)
                light[m, k1] += each * w * (one - h)
                light[m1, k] += each * (one - w) * h
                light[m1, k1] += each * w * h
