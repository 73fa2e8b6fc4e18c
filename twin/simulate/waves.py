"""Orbital motion of surface waves by linear theory, as a sum of sines with a JONSWAP spectrum."""

import math
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.errors import TwinError
from twin.kernels import kernel
from twin.scenario.model import WavesConfig
from twin.simulate.hydrodynamics import GRAVITY_MPS2

_N = 64  # number of components
_BAND = 0.6, 4.0  # lowest and highest frequency of the components, relative to the peak
_STEEPEST = 0.6  # greatest ratio of significant height to depth; higher waves break


class Waves(NamedTuple):
    """Components of the waves; all travel along `direction`."""

    #: (n, 4) amplitude times angular frequency [m/s], angular frequency [rad/s], wavenumber [rad/m], phase [rad]
    components: Array
    direction: Array  #: (2,) unit vector: east, north
    depth_m: float  #: of the reference plane z = 0


CALM = Waves(np.zeros((0, 4)), np.array([1.0, 0.0]), 1.0)


def wave_components(waves: WavesConfig, sun_depth_m: float, rng: np.random.Generator | None) -> Waves:
    """Returns the components of waves with random phases; without `rng` the waves are only checked.

    Their frequencies are drawn within equal intervals of the band, so that the sum does not repeat. Raises TwinError if
    the depth is missing, fetch or wind is missing, or the waves would break.
    """
    depth_m = waves.depth_m or sun_depth_m
    if not waves.is_calm or waves.fetch_m is not None:
        _check(waves, depth_m)
    if waves.is_calm or rng is None:
        return CALM
    edges = np.linspace(*_BAND, _N + 1) * peak_radps(waves)
    omega = rng.uniform(edges[:-1], edges[1:])
    amplitude_m = np.sqrt(2 * jonswap(waves, omega) * np.diff(edges))
    phase = rng.uniform(0.0, 2 * np.pi, _N)
    bearing = math.radians(waves.direction_deg)
    components = np.column_stack([amplitude_m * omega, omega, wavenumbers(omega, depth_m), phase])
    return Waves(components, np.array([math.cos(bearing), math.sin(bearing)]), depth_m)


def _check(waves: WavesConfig, depth_m: float) -> None:
    if depth_m == 0:
        raise TwinError("waves.depth_m", "missing: the orbital motion depends on it", "above 0, or with sun.depth_m")
    if (waves.wind_mps is None) != (waves.fetch_m is None):
        missing, given = ("fetch_m", "wind_mps") if waves.fetch_m is None else ("wind_mps", "fetch_m")
        raise TwinError(f"waves.{missing}", f"missing, as there is a waves.{given}", "both or none")
    if waves.wind_mps is not None and waves.height_m:
        problem = f"{waves.height_m:g}, and waves.wind_mps is given: the height is given twice"
        raise TwinError("waves.height_m", problem, "one of them")
    height_m = significant_height_m(waves)
    if height_m > _STEEPEST * depth_m:
        key = "height_m" if waves.wind_mps is None else "wind_mps"
        problem = f"waves of {height_m:.2g} m break in a depth of {depth_m:g} m"
        raise TwinError(f"waves.{key}", problem, f"a height up to {_STEEPEST * depth_m:.2g} m")


def peak_radps(waves: WavesConfig) -> float:
    """Returns the angular frequency of the peak; with wind U and fetch F, 22 (g^2 / U F)^(1/3)."""
    if waves.wind_mps is None or waves.fetch_m is None:
        return 2 * math.pi / waves.period_s
    return 22 * float(GRAVITY_MPS2**2 / (waves.wind_mps * _growing_m(waves.wind_mps, waves.fetch_m))) ** (1 / 3)


def jonswap(waves: WavesConfig, omega: Array) -> Array:
    """Returns the spectrum (n,) of the surface elevation at angular frequencies (n,) [m2 s/rad].

    Hasselmann et al. (1973): alpha g^2 w^-5 exp(-1.25 (wp / w)^4) gamma^r, r = exp(-(w - wp)^2 / (2 s^2 wp^2)), with
    s = 0.07 up to the peak wp and 0.09 above. The variance in the band of the components is that of the significant
    height, from which alpha follows.
    """
    band = np.linspace(*_BAND, 2000) * peak_radps(waves)
    variance = np.trapezoid(_shape(waves, band), band)
    return (significant_height_m(waves) ** 2 / 16 / variance) * _shape(waves, omega)


def significant_height_m(waves: WavesConfig) -> float:
    """Returns four standard deviations of the surface elevation; with wind U and fetch F, 0.0016 U sqrt(F / g)."""
    # the fit of Hasselmann et al. (1973) to measured variances; their fit of alpha gives 1.27 times this height
    if waves.wind_mps is None or waves.fetch_m is None:
        return waves.height_m
    return 0.0016 * waves.wind_mps * math.sqrt(_growing_m(waves.wind_mps, waves.fetch_m) / GRAVITY_MPS2)


def _growing_m(wind_mps: float, fetch_m: float) -> float:
    """Returns the fetch over which waves grow: up to g F / U^2 = 2.3e4 (Shore Protection Manual 1984) [m]."""
    return min(fetch_m, 2.3e4 * wind_mps**2 / GRAVITY_MPS2)


def _shape(waves: WavesConfig, omega: Array) -> Array:
    peak = peak_radps(waves)
    s = np.where(omega <= peak, 0.07, 0.09)
    enhancement = waves.peak_enhancement ** np.exp(-((omega / peak - 1) ** 2) / (2 * s**2))
    return omega**-5.0 * np.exp(-1.25 * (peak / omega) ** 4) * enhancement


def wavenumbers(omega: Array, depth_m: float) -> Array:
    """Returns the wavenumbers k (n,) [rad/m] that solve w^2 = g k tanh(k h) for angular frequencies w (n,), depth h."""
    deep = omega**2 / GRAVITY_MPS2
    k = deep / np.sqrt(np.tanh(deep * depth_m))  # Eckart (1952): within 5 %
    for _ in range(20):  # Newton's method
        t = np.tanh(k * depth_m)
        k -= (k * t - deep) / (t + k * depth_m * (1 - t**2))
    return k


@kernel
def add_waves(waves, time_s, position, flow):
    """Adds the orbital motion at a time and a position (3,) to a flow (5, 3), see `sea.flow_at`.

    With theta = k x - w t + phase, depth h and height z above the reference plane, the velocity along the direction of
    travel is a w cosh(k z) / sinh(k h) cos theta, the vertical one a w sinh(k z) / sinh(k h) sin theta.
    """
    east, north = waves.direction
    along, z, h = east * position[0] + north * position[1], position[2], waves.depth_m
    u, w, u_t, w_t, u_x, u_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(len(waves.components)):
        speed, omega, k, phase = waves.components[n]
        up, down = math.exp(k * (z - h)), math.exp(-k * (z + h))
        scale = speed / (1 - math.exp(-2 * k * h))
        horizontal, vertical = scale * (up + down), scale * (up - down)
        theta = k * along - omega * time_s + phase
        c, s = math.cos(theta), math.sin(theta)
        u, w = u + horizontal * c, w + vertical * s
        u_t, w_t = u_t + omega * horizontal * s, w_t - omega * vertical * c
        u_x, u_z = u_x - k * horizontal * s, u_z + k * vertical * c
    for i, share in ((0, east), (1, north)):
        flow[0, i] += share * u
        flow[1, i] += share * u_t
        flow[2 + i, 0] += share * east * u_x
        flow[2 + i, 1] += share * north * u_x
        flow[2 + i, 2] += share * u_z
        flow[4, i] += share * u_z  # the motion is irrotational
    flow[0, 2] += w
    flow[1, 2] += w_t
    flow[4, 2] -= u_x  # and free of divergence
