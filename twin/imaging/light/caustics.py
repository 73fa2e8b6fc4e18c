"""Caustics: bright moving lines on the floor where waves on the water surface focus the sunlight.

The surface is a sum of waves with the spectrum of a fully developed sea from gravity to capillary waves (Elfouhaily et
al. 1997, J. Geophys. Res. 102, 15781), periodic in a square tile: the elevation has the spectrum S(k) = B(k) / k^3, the
slopes the variance int B / k dk, spread over directions phi from the wind with (1 + Delta(k) cos(2 phi)) / (2 pi). A
ray of the sun that meets the surface at a small slope s is displaced at the depth D by q D (s + h (h . s) / w^2), where
(h, -w) is its unit direction under the level surface and q = 1 - c / (n w), with c the cosine of its zenith angle in
air and n the refractive index (derivative of Snell's law). For a sun in the zenith it is (1 - 1/n) s D. The pattern is
blurred by waves that the cells do not resolve (normally distributed deflections), by the disc of the sun, and by
scattering (Wells 1973). Waves longer than the tile focus far below the floor and are left out.
"""

import threading

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import j0

from twin.core.geometry import Array
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.phase_function import BandWater, table_of
from twin.imaging.light.water import Medium
from twin.kernels import kernel
from twin.scenario.model import SEA_WATER_INDEX

CELLS = 256  # number of cells per side of the tile, a power of two
TILE_DEPTHS = 1.5  # side of the tile in units of the depth
RESOLVED = 0.95  # wave number of the shortest resolved waves, in units of the Nyquist wave number of the cells
LEAST_CELLS = 0.9  # least standard deviation of the blur in cells, so that light between narrow lines is not negative
#: Standard deviation of directions within the solar disc along one axis, in water.
SUN_RAD = 0.00465 / 2 / SEA_WATER_INDEX
STREAM = 1 << 16  # key of the random stream for the waves
_HEIGHTS, _ANGLES, _WAVE_NUMBERS = 24, 512, 80  # numbers of nodes of `scattering_blur`
GRAVITY_MPS2 = 9.81
#: Wave number [rad/m] and phase speed [m/s] of the slowest waves; shorter waves are capillary waves.
SLOWEST_RAD_PER_M, SLOWEST_MPS = 370.0, 0.23
INVERSE_WAVE_AGE = 0.84  # of a fully developed sea
_PEAK_ENHANCEMENT, _PEAK_WIDTH = 1.7, 0.08 * (1 + 4 / INVERSE_WAVE_AGE**3)  # JONSWAP
_SHORTEST_RAD_PER_M = 2e4  # the spectrum of shorter waves is negligible


class Caustics:
    """Time-dependent caustics on the reference plane, from waves of random phases (not amplitudes) that run east."""

    def __init__(self, illumination: Illumination, wind_mps: float, seed: int):
        water, daylight = illumination
        depth_m = daylight.reference_depth_m
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
        self.tile_m = TILE_DEPTHS * depth_m
        self.cells_per_m = CELLS / self.tile_m
        kx, ky = _wave_numbers(self.tile_m)
        k = np.hypot(kx, ky)
        shortest = RESOLVED * np.pi * CELLS / self.tile_m
        # waves travel downwind: the half plane kx > 0 has the variance of both; of kx = 0, one half is kept, too
        downwind = (k <= shortest) & ((kx > 0) | (ky > 0))
        variance = np.where(downwind, 2 * slope_density(kx, ky, wind_mps) * (2 * np.pi / self.tile_m) ** 2, 0.0)
        waves = np.sqrt(2 * variance) * np.exp(2j * np.pi * rng.random(k.shape))
        # the inverse transform counts the columns kx > 0 twice (Hermitian spectrum), and the real part of column 0 once
        waves *= np.where(kx > 0, 0.5, 1.0) / np.where(k > 0, k, 1.0)
        self._slope = [(along * waves).astype(np.complex64) for along in (kx, ky)]
        self._turns_per_s = angular_frequency(k) / (2 * np.pi)
        sun = daylight.source.to_sun
        self._cells_per_slope = (displacement(sun) * depth_m * self.cells_per_m).astype(np.float32)
        blur = self._blur_of(depth_m, water, slope_variance(wind_mps, shortest), sun)
        self._blur = (_packed(blur) * daylight.focused_share / CELLS**2).astype(np.float32)
        self._diffuse_share = np.float32(1 - daylight.focused_share)
        self._cached: tuple[float, NDArray[np.float32]] | None = None
        self._computing = threading.Lock()

    def closed_pattern(self, time_s: float) -> NDArray[np.float32]:
        """Returns the illuminance divided by its mean, (CELLS + 1, CELLS + 1); row 0 = south, column 0 = west.

        The first row and column are repeated at the end. Both cameras use the cached result, even at the same time.
        """
        with self._computing:
            if self._cached is None or self._cached[0] != time_s:
                self._cached = time_s, self._compute(time_s)
            return self._cached[1]

    def slopes(self, time_s: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Returns the slopes towards east and north, (CELLS, CELLS) each; their common sign is arbitrary."""
        turns = self._turns_per_s * time_s
        turns -= np.floor(turns)
        turns *= 2 * np.pi
        angle = turns.astype(np.float32)
        spectrum = np.zeros((CELLS, CELLS, 2), np.float32)
        east, north = self._slope
        _add_waves(east, north, np.cos(angle), np.sin(angle), spectrum)
        both = np.asarray(cv2.dft(spectrum, flags=cv2.DFT_INVERSE), np.float32)
        return both[..., 0], both[..., 1]

    def _compute(self, time_s: float) -> NDArray[np.float32]:
        light = np.zeros((CELLS, CELLS), np.float32)
        _trace_rays(*self.slopes(time_s), self._cells_per_slope, light)
        spectrum = np.asarray(cv2.dft(light), np.float32)
        spectrum *= self._blur
        closed = np.empty((CELLS + 1, CELLS + 1), np.float32)
        focused = np.asarray(cv2.dft(spectrum, flags=cv2.DFT_INVERSE), np.float32)
        np.add(focused, self._diffuse_share, out=closed[:-1, :-1])
        closed[-1, :-1] = closed[0, :-1]
        closed[:, -1] = closed[:, 0]
        return closed

    def _blur_of(
        self, depth_m: float, water: Medium, unresolved: tuple[float, float], to_sun: tuple[float, float, float]
    ) -> Array:
        """Returns the modulation transfer function (CELLS, CELLS / 2 + 1) of the blur by sun, water and short waves."""
        kx, ky = _wave_numbers(self.tile_m)
        by_slope, slant = displacement(to_sun), _slant(to_sun)
        cov = by_slope @ np.diag(unresolved) @ by_slope.T + SUN_RAD**2 / to_sun[2] ** 2 * slant
        cov += np.eye(2) * max((LEAST_CELLS * TILE_DEPTHS / CELLS) ** 2 - min(cov[0, 0], cov[1, 1]), 0.0)
        rough = np.exp(-0.5 * depth_m**2 * (cov[0, 0] * kx**2 + 2 * cov[0, 1] * kx * ky + cov[1, 1] * ky**2))
        return rough * scattering_blur(np.hypot(kx, ky), depth_m / to_sun[2], water.bands[1])


def displacement(to_sun: tuple[float, float, float]) -> Array:
    """Returns the displacement (2, 2) of a ray east and north, per depth and slope of the surface east and north."""
    cosine = to_sun[2]
    in_air = np.sqrt(max(1 - SEA_WATER_INDEX**2 * (1 - cosine**2), 0.0))
    return (1 - in_air / (SEA_WATER_INDEX * cosine)) * _slant(to_sun)


def _slant(to_sun: tuple[float, float, float]) -> Array:
    """Returns the factors (2, 2) by which a slanted ray crosses a horizontal plane farther than a vertical one."""
    aside = np.array(to_sun[:2]) / to_sun[2]
    return np.eye(2) + np.outer(aside, aside)


def scattering_blur(k: Array, depth_m: float, water: BandWater) -> Array:
    """Returns the modulation transfer function of the irradiance at a depth below a narrow vertical beam.

    Light scattered by the angle t at the height h above the plane meets it at h tan(t) from the beam. With any number
    of scattering events (Wells 1973), the transform is exp(b (F(k) - F(0))), F(k) being the integral over h from 0 to
    the depth and over downward directions of p(t) exp(-a h (1 / cos(t) - 1)) J0(k h tan(t)).
    """
    absorption, scattering, scatterer = water
    if scattering * depth_m == 0:
        return np.ones_like(k)
    cumulative = table_of(scatterer).cumulative
    every = (len(cumulative) - 1) // _ANGLES
    middle = (np.arange(_ANGLES) + 0.5) / _ANGLES
    angle, share = 2 * np.arcsin(middle**2), np.diff(cumulative[::every])
    angle, share = angle[angle < np.pi / 2], share[angle < np.pi / 2]
    node, weight = np.polynomial.legendre.leggauss(_HEIGHTS)
    height = depth_m * (node[:, None] + 1) / 2
    arriving = share * np.exp(-absorption * height * (1 / np.cos(angle) - 1)) * weight[:, None] * depth_m / 2
    at = np.concatenate([[0.0], np.geomspace(0.01 / depth_m, max(float(k.max()), 1 / depth_m), _WAVE_NUMBERS)])
    scattered = np.array([(arriving * j0(one * height * np.tan(angle))).sum() for one in at])
    return np.exp(scattering * (np.interp(k, at, scattered) - scattered[0]))


def _wave_numbers(tile_m: float) -> tuple[Array, Array]:
    """Returns the wave numbers towards east (1, CELLS / 2 + 1) and north (CELLS, 1) of one half plane [rad/m]."""
    step, index = 2 * np.pi / tile_m, np.arange(CELLS, dtype=np.float64)
    return step * index[None, : CELLS // 2 + 1], step * np.where(index < CELLS / 2, index, index - CELLS)[:, None]


def _packed(transfer: Array) -> Array:
    """Returns the factors (CELLS, CELLS) of the numbers in a spectrum of `cv2.dft` of a real image."""
    # It stores the parts of a coefficient in columns 2 k - 1 and 2 k or, in the first and last, in such rows.
    index = np.arange(CELLS)
    half = (index + 1) // 2
    rows = np.where((half == 0) | (half == CELLS // 2), half[:, None], index[:, None])
    return transfer[rows, half]


@kernel(error_model="numpy")
def _add_waves(east, north, cosine, sine, spectrum):
    """Adds waves to the spectrum of the slope to the east + i the slope to the north, both real: -k mirrors k."""
    n, half = spectrum.shape[0], spectrum.shape[1] // 2
    for i in range(n):
        opposite = spectrum[(n - i) % n]
        for j in range(half + 1):
            # the columns 0 and n / 2 hold both halves of their wave numbers
            share = np.float32(0.5 if j == 0 or j == half else 1.0)
            turn = np.complex64(complex(share * cosine[i, j], -share * sine[i, j]))
            a, b = east[i, j] * turn, north[i, j] * turn
            spectrum[i, j, 0] += a.real - b.imag
            spectrum[i, j, 1] += a.imag + b.real
            k = (n - j) % n
            opposite[k, 0] += a.real + b.imag
            opposite[k, 1] += b.real - a.imag


@kernel(error_model="numpy")
def _trace_rays(east, north, cells_per_slope, light):
    """Traces one ray per cell through the surface; adds it to four cells of `light`, bilinearly."""
    n, one = light.shape[0], np.float32(1.0)
    for i in range(n):
        for j in range(n):
            a, b = east[i, j], north[i, j]
            col = np.float32(j) - (cells_per_slope[0, 0] * a + cells_per_slope[0, 1] * b)
            row = np.float32(i) - (cells_per_slope[1, 0] * a + cells_per_slope[1, 1] * b)
            left, low = np.floor(col), np.floor(row)
            w, h = col - left, row - low
            k, m = int(left) & (n - 1), int(low) & (n - 1)
            k1, m1 = (k + 1) & (n - 1), (m + 1) & (n - 1)
            light[m, k] += (one - w) * (one - h)
            light[m, k1] += w * (one - h)
            light[m1, k] += (one - w) * h
            light[m1, k1] += w * h


def angular_frequency(k: Array) -> Array:
    """Returns the angular frequency of waves in deep water [rad/s]: omega^2 = g k (1 + (k / 370)^2)."""
    return np.sqrt(GRAVITY_MPS2 * k * (1 + (k / SLOWEST_RAD_PER_M) ** 2))


def curvature_spectrum(k: Array, wind_mps: float) -> Array:
    """Returns the omnidirectional curvature spectrum B(k) at wave numbers above 0 (Elfouhaily, eq. 30 to 41)."""
    peak = GRAVITY_MPS2 * (INVERSE_WAVE_AGE / wind_mps) ** 2
    speed, peak_mps = angular_frequency(k) / k, wind_mps / INVERSE_WAVE_AGE
    ratio = np.sqrt(k / peak)
    around_peak = np.exp(-1.25 / ratio**4) * _PEAK_ENHANCEMENT ** np.exp(-((ratio - 1) ** 2) / (2 * _PEAK_WIDTH**2))
    long = 0.006 * np.sqrt(INVERSE_WAVE_AGE) * peak_mps / speed
    long *= np.exp(-INVERSE_WAVE_AGE / np.sqrt(10) * (ratio - 1))
    friction = np.log(_friction_mps(wind_mps) / SLOWEST_MPS)
    short = max(0.01 * (1 + (friction if friction <= 0 else 3 * friction)), 0.0) * SLOWEST_MPS / speed
    short *= np.exp(-0.25 * (k / SLOWEST_RAD_PER_M - 1) ** 2)
    return 0.5 * around_peak * (long + short)


def directionality(k: Array, wind_mps: float) -> Array:
    """Returns Delta(k), the relative difference of the spectrum along and across the wind (Elfouhaily, eq. 57)."""
    speed, peak_mps = angular_frequency(k) / k, wind_mps / INVERSE_WAVE_AGE
    short = 0.13 * _friction_mps(wind_mps) / SLOWEST_MPS
    return np.tanh(np.log(2) / 4 + 4 * (speed / peak_mps) ** 2.5 + short * (SLOWEST_MPS / speed) ** 2.5)


def slope_density(kx: Array, ky: Array, wind_mps: float) -> Array:
    """Returns the slope variance per area of wave numbers along and across the wind [m^2/rad^2]; 0 at k = 0."""
    k = np.hypot(kx, ky)
    k_or_1 = np.where(k > 0, k, 1.0)
    spread = 1 + directionality(k_or_1, wind_mps) * (kx**2 - ky**2) / k_or_1**2
    return np.where(k > 0, curvature_spectrum(k_or_1, wind_mps) * spread / (2 * np.pi * k_or_1**2), 0.0)


def slope_variance(wind_mps: float, above_rad_per_m: float = 1e-3) -> tuple[float, float]:
    """Returns the variances of the slope along and across the wind, due to waves above a given wave number."""
    k = np.geomspace(above_rad_per_m, max(_SHORTEST_RAD_PER_M, 2 * above_rad_per_m), 4000)
    per_k, quarter = curvature_spectrum(k, wind_mps) / k, directionality(k, wind_mps) / 4
    along, across = (float(np.trapezoid(per_k * share, k)) for share in (0.5 + quarter, 0.5 - quarter))
    return along, across


def _friction_mps(wind_mps: float) -> float:
    """Returns the friction velocity of the wind [m/s], with the drag coefficient (0.8 + 0.065 U) 1e-3 (Wu 1982)."""
    return wind_mps * np.sqrt(1e-3 * (0.8 + 0.065 * wind_mps))
