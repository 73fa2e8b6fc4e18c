"""Wind waves from gravity to capillary waves: the spectrum of Elfouhaily et al. (1997, J. Geophys. Res. 102, 15781).

The elevation has the spectrum S(k) = B(k) / k^3, the slopes the variance int B / k dk. Waves are spread over directions
phi from the wind with the density (1 + Delta(k) cos(2 phi)) / (2 pi). The sea is fully developed.
"""

import numpy as np

from twin.core.geometry import Array

GRAVITY_MPS2 = 9.81
#: Wave number [rad/m] and phase speed [m/s] of the slowest waves; shorter waves are capillary waves.
SLOWEST_RAD_PER_M, SLOWEST_MPS = 370.0, 0.23
INVERSE_WAVE_AGE = 0.84  # of a fully developed sea
_PEAK_ENHANCEMENT, _PEAK_WIDTH = 1.7, 0.08 * (1 + 4 / INVERSE_WAVE_AGE**3)  # JONSWAP
_SHORTEST_RAD_PER_M = 2e4  # the spectrum of shorter waves is negligible


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
