"""Radiance of daylight in water with a flat surface, by the method of discrete ordinates, for one colour band.

The water is homogeneous, between a surface without internal reflection and a black floor. With the depth z, the cosine
mu of the angle from straight down and the azimuth from the beam, the radiance is a cosine series in the azimuth whose
terms L_m obey (Chandrasekhar 1960; Stamnes et al. 1988, Appl. Opt. 27, 2502)

    mu dL_m/dz = -c L_m + b integral h_m(mu, mu') L_m(mu') dmu' + beam,
    h_m = 1/2 sum_l (2 l + 1) chi_l P_l^m(mu) P_l^m(mu'),

chi_l being the Legendre moments of the phase function, P_l^m the associated Legendre functions times sqrt((l - m)! / (l
+ m)!). At the nodes of a quadrature this is a linear system, solved by eigenvectors. The forward peak counts as
unscattered (delta-M+, Lin et al. 2018, J. Quant. Spectrosc. Radiat. Transf. 208, 140); sunlight scattered once into the
line of sight uses the phase function itself (Nakajima & Tanaka 1988, ibid. 40, 51).
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import eval_legendre, factorial, lpmv, poch

from twin.core.geometry import Array
from twin.imaging.light.phase_function import BandWater, PhaseTable, table_of
from twin.imaging.light.sun_sky import CRITICAL_COSINE, SunSky, sky_radiance

ORDERS = 32  # number L of Legendre moments
NODES = 11, 9  # quadrature nodes outside the cone of the sky, and within it
SLOPE_MODES, SLOPE_ORDERS = 8, 14  # light on slopes: terms of the series in azimuth; even moments below this order
STEEPEST_DEG, LEVEL_WEIGHT = 75.0, 100.0  # steepest slope to which the light is fitted, and weight of the level floor
LEAST_PEAK = 1e-9  # with a smaller moment L, a phase function has no forward peak
LEAST_ABSORPTION = 1e-6  # per unit of scattering: without absorption two eigenvalues coincide
_SLOPES = np.deg2rad(np.linspace(0.0, STEEPEST_DEG, 16)), np.deg2rad(np.linspace(0.0, 180.0, 13))


class _Mode(NamedTuple):
    """Solutions of one term of the series in azimuth."""

    decay_per_m: Array  # (n,) eigenvalues
    # (n, n) parts of the decaying eigenvectors, as columns; the growing ones have these parts exchanged
    down: Array
    up: Array
    beam_down: Array  # (n,) particular solution at depth 0
    beam_up: Array
    sky: Array  # (n,) radiance of the sky at the surface
    kernel: Array  # (orders l, n) products sqrt(2 l + 1) P_l^m at the nodes, with P_l^m normalised as in `_legendre`


def legendre_moments(phase: PhaseTable, orders: int) -> Array:
    """Returns the moments 2 pi integral p P_l dmu of a phase function p for l = 0 to `orders`, mu = cosine."""
    # by the midpoint rule over the cells of the table
    share = np.diff(phase.cumulative)
    return np.array([share @ values for values in _polynomials(len(share), orders)])


@cache
def _polynomials(cells: int, orders: int) -> Array:
    """Returns the Legendre polynomials (orders + 1, cells) in the middle of the cells of a phase table."""
    edges = np.linspace(0.0, 1.0, cells + 1) ** 4
    middle = 1 - (edges[1:] + edges[:-1])
    return np.array([eval_legendre(order, middle) for order in range(orders + 1)])


class LightField:
    """Radiance of daylight in water over a black floor, for 1 lx below the surface, in `modes` terms of azimuth."""

    def __init__(self, water: BandWater, daylight: SunSky, modes: int):
        self._water, self._daylight = water, daylight
        self._scaled = _without_peak(water)
        #: attenuation of the beam with depth [1/m]; light scattered within the forward peak counts as beam
        self.beam_per_m = self._scaled[0] / daylight.sun_cosine
        self._cosine, self._weight = _quadrature()
        count = modes if daylight.sun_cosine < 1 - 1e-9 and daylight.sky_share < 1 else 1
        self._modes = [self._mode(m) for m in range(count)]

    def scattered(self, depth_m: float, floor_m: float) -> tuple[Array, Array]:
        """Returns the downwelling and the upwelling radiance without the beam, (modes, nodes) each [cd/m2]."""
        down, up = zip(*(self._at(mode, np.array([floor_m]), depth_m) for mode in self._modes), strict=True)
        return np.array(down)[:, 0], np.array(up)[:, 0]

    def illuminance(self, depth_m: float, floor_m: float) -> tuple[float, float]:
        """Returns the illuminance of a horizontal plane at a depth by the beam and by all other light [lx]."""
        beam = self._daylight.beam_lx * self._daylight.sun_cosine * np.exp(-self.beam_per_m * depth_m)
        down, _ = self.scattered(depth_m, floor_m)
        return float(beam), float(2 * np.pi * (down[0] * self._weight * self._cosine).sum())

    def slope_form(self, depth_m: float, floor_m: float) -> Array:
        """Returns the light without the beam on a slope as a quadratic form (4, 4) of its normal [lx].

        With the unit normal n (x towards the sun, z up), the illuminance is (n, 1) Q (n, 1)'. Q is fitted to floors up
        to `STEEPEST_DEG`, whose light follows from the moments of the radiance and of Lambert's cosine (Ramamoorthi &
        Hanrahan 2001, J. Opt. Soc. Am. A 18, 2448); a level floor has the weight `LEVEL_WEIGHT`.
        """
        down, up = self.scattered(depth_m, floor_m)
        tilt, azimuth = (grid.ravel() for grid in np.meshgrid(*_SLOPES))
        light = np.zeros(tilt.size)
        for m in range(len(down)):
            for order in (1, *range(0, SLOPE_ORDERS, 2)):
                if order < m:
                    continue
                both = down[m] + (-1.0) ** (order + m) * up[m]
                moment = 2 * np.pi * (self._weight * _legendre(order, m, self._cosine) * both).sum()
                strength = _cosine_moment(order) * (2 * order + 1) / (4 * np.pi)
                light += strength * moment * _legendre(order, m, np.cos(tilt)) * np.cos(m * azimuth)
        light[tilt == 0] = self.illuminance(depth_m, floor_m)[1]
        return _fitted_form(np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt), light)

    def veil(self, depth_m: float, cosine: Array, floor_m: Array) -> Array:
        """Returns the upwelling radiance above black floors: azimuth series (modes, views, floors) [cd/m2].

        `cosine` (views,) is that of the angle between line of sight and straight down, above 0; `floor_m` are depths.
        """
        return np.array([self._veil_of(m, mode, depth_m, cosine, floor_m) for m, mode in enumerate(self._modes)])

    def _mode(self, m: int) -> _Mode:
        c, b, chi = self._scaled
        mu, weight, order = self._cosine, self._weight, np.arange(m, ORDERS, dtype=np.float64)
        root = np.sqrt(2 * order + 1)[:, None]
        kernel = root * _legendre(order[:, None], m, mu)
        to_beam = (root * _legendre(order[:, None], m, np.array([self._daylight.sun_cosine])))[:, 0]
        parity = (-1.0) ** (order - m)
        same = b / 2 * (kernel.T * chi[m:]) @ kernel
        other = b / 2 * (kernel.T * (chi[m:] * parity)) @ kernel
        x = (np.diag(np.full(mu.size, c)) - same * weight) / mu[:, None]
        y = other * weight / mu[:, None]
        squared, total = np.linalg.eig((x + y) @ (x - y))
        decay, total = np.sqrt(np.maximum(np.real(squared), 0.0)), np.real(total)
        difference = (x - y) @ total / np.maximum(decay, 1e-300)
        strength = b * self._daylight.beam_lx * (2 - (m == 0)) / (4 * np.pi) / mu
        onward, back = (strength * (kernel.T @ (chi[m:] * sign * to_beam)) for sign in (np.ones_like(parity), parity))
        k = self.beam_per_m
        system = np.block([[x - k * np.eye(mu.size), -y], [-y, x + k * np.eye(mu.size)]])
        z = np.asarray(np.linalg.solve(system, np.concatenate([onward, back])), np.float64)
        sky = sky_radiance(mu) if m == 0 else np.zeros(mu.size)
        sky = sky * self._daylight.sky_share / max(2 * np.pi * (weight * mu * sky).sum(), 0.5)  # exact on these nodes
        down, up = (total + difference) / 2, (total - difference) / 2
        return _Mode(decay, down, up, z[: mu.size], z[mu.size :], sky, kernel)

    def _coefficients(self, mode: _Mode, floor_m: Array) -> Array:
        """Returns the weights (floors, 2 n) of the decaying and growing eigenvectors, from the boundary conditions."""
        n, fade = mode.decay_per_m.size, np.exp(-mode.decay_per_m * floor_m[:, None])
        system = np.empty((floor_m.size, 2 * n, 2 * n))
        system[:, :n, :n], system[:, :n, n:] = mode.down, mode.up * fade[:, None]
        system[:, n:, :n], system[:, n:, n:] = mode.up * fade[:, None], mode.down
        given = np.empty((floor_m.size, 2 * n))
        given[:, :n] = mode.sky - mode.beam_down
        given[:, n:] = -mode.beam_up * np.exp(-self.beam_per_m * floor_m)[:, None]
        return np.asarray(np.linalg.solve(system, given[..., None])[..., 0], np.float64)

    def _at(self, mode: _Mode, floor_m: Array, depth_m: float) -> tuple[Array, Array]:
        """Returns down- and upwelling radiance, (floors, nodes) each, of one term without the beam at a depth."""
        n, weights = mode.decay_per_m.size, self._coefficients(mode, floor_m)
        decaying = weights[:, :n] * np.exp(-mode.decay_per_m * depth_m)
        growing = weights[:, n:] * np.exp(-mode.decay_per_m * (floor_m[:, None] - depth_m))
        beam = np.exp(-self.beam_per_m * depth_m)
        down = decaying @ mode.down.T + growing @ mode.up.T + beam * mode.beam_down
        return down, decaying @ mode.up.T + growing @ mode.down.T + beam * mode.beam_up

    def _veil_of(self, m: int, mode: _Mode, depth_m: float, cosine: Array, floor_m: Array) -> Array:
        """Returns term m (views, floors) of `veil`: light scattered into the lines of sight, integrated over depth."""
        c, b, chi = self._scaled
        n, order = mode.decay_per_m.size, np.arange(m, ORDERS, dtype=np.float64)
        weights = self._coefficients(mode, floor_m)
        to_view = np.sqrt(2 * order + 1)[:, None] * _legendre(order[:, None], m, cosine)
        parity = (-1.0) ** (order - m)
        back = b / 2 * (to_view.T * (chi[m:] * parity)) @ mode.kernel * self._weight  # (views, nodes)
        same = b / 2 * (to_view.T * chi[m:]) @ mode.kernel * self._weight
        per_decaying = back @ mode.down + same @ mode.up  # source of each eigenvector (views, n)
        per_growing = back @ mode.up + same @ mode.down
        below = (floor_m - depth_m)[:, None, None]
        slant, k, view = c / cosine[:, None], mode.decay_per_m, cosine[:, None]
        started = weights[:, None, :n] * np.exp(-k * depth_m)
        ended = weights[:, None, n:]
        light = (started * per_decaying * _decaying(slant, k, below) / view).sum(-1)
        light += (ended * per_growing * _growing(slant, k, below) / view).sum(-1)
        along = _decaying(slant, np.array([self.beam_per_m]), below)[..., 0] * np.exp(-self.beam_per_m * depth_m)
        source = back @ mode.beam_down + same @ mode.beam_up + self._exact_once(m, cosine)
        return (light + source * along / cosine).T

    def _exact_once(self, m: int, cosine: Array) -> Array:
        """Returns term m (views,) of the azimuth series of sunlight scattered once into lines of sight at depth 0."""
        turns = 64
        azimuth = 2 * np.pi * (np.arange(turns) + 0.5) / turns
        mu0 = self._daylight.sun_cosine
        sines = np.sqrt(1 - cosine**2) * np.sqrt(1 - mu0**2)
        angle = np.arccos(np.clip(-cosine[:, None] * mu0 + sines[:, None] * np.cos(azimuth), -1.0, 1.0))
        density = table_of(self._water.scatterer).density_per_sr
        cell = np.sqrt(np.sin(angle / 2)) * len(density)
        values = np.interp(cell, np.arange(len(density)) + 0.5, density)
        term = (2 - (m == 0)) * (values * np.cos(m * azimuth)).mean(1)
        return self._water.scattering_per_m * self._daylight.beam_lx * term


def _without_peak(water: BandWater) -> tuple[float, float, Array]:
    """Returns attenuation, scattering and moments (ORDERS,) without the forward peak, a narrow Gaussian (delta-M+)."""
    # It has the moments f exp(-l^2 / (2 s^2)), with f and s such that the rest reaches 0 with slope 0 at l = `ORDERS`;
    # another slope (delta-M) makes the radiance oscillate by up to 6 %.
    chi, b = legendre_moments(table_of(water.scatterer), ORDERS + 1), water.scattering_per_m
    peak = np.zeros(ORDERS)
    if chi[ORDERS] > LEAST_PEAK and chi[ORDERS + 1] > 0:
        per_order2 = max(np.log(chi[ORDERS] / chi[ORDERS + 1]), 0.0) / (2 * ORDERS + 1)
        peak = chi[ORDERS] * np.exp(per_order2 * (ORDERS**2 - np.arange(ORDERS) ** 2))
    b_rest = (1 - peak[0]) * b
    a = max(water.absorption_per_m, LEAST_ABSORPTION * b, 1e-9)
    return a + b_rest, b_rest, (chi[:ORDERS] - peak) / (1 - peak[0])


def _quadrature() -> tuple[Array, Array]:
    """Returns cosines and weights of the quadrature nodes of one hemisphere."""
    parts = []
    for n, low, high in ((NODES[0], 0.0, CRITICAL_COSINE), (NODES[1], CRITICAL_COSINE, 1.0)):
        x, w = np.polynomial.legendre.leggauss(n)
        parts.append((low + (high - low) * (x + 1) / 2, w * (high - low) / 2))
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _legendre(order: Array | int, m: int, cosine: Array) -> Array:
    """Returns the associated Legendre function P_l^m times sqrt((l - m)! / (l + m)!), without the factor (-1)^m."""
    order = np.asarray(order, np.float64)
    return (-1.0) ** m * lpmv(m, order, cosine) / np.sqrt(poch(order - m + 1, 2 * m))


def _cosine_moment(order: int) -> float:
    """Returns the Legendre moment of Lambert's cosine: 2 pi / 3 for order 1, pi, pi / 4, -pi / 24 ... for even ones."""
    if order == 1:
        return 2 * np.pi / 3
    half = order // 2
    share = factorial(order) / (2**order * factorial(half) ** 2)
    return float(2 * np.pi * (-1) ** (half - 1) / ((order + 2) * (order - 1)) * share)


def _fitted_form(x: Array, y: Array, z: Array, light: Array) -> Array:
    """Returns the quadratic form (4, 4) of (x, y, z, 1) that best fits the illuminance (n,) of sloping floors."""
    terms = np.stack([np.ones_like(z), z, x, z * z, x * z, x * x - y * y], 1)
    weight = np.where(z == 1, LEVEL_WEIGHT, 1.0)
    one, up, side, square, cross, across = np.linalg.lstsq(terms * weight[:, None], light * weight, rcond=None)[0]
    form = np.diag([across, -across, square, one])
    form[2, 3] = form[3, 2] = up / 2
    form[0, 3] = form[3, 0] = side / 2
    form[0, 2] = form[2, 0] = cross / 2
    return form


def _decaying(slant: Array, k: Array, below: Array) -> Array:
    """Returns the integral of exp(-k s) exp(-slant s) over s from 0 to `below`."""
    return -np.expm1(-(slant + k) * below) / (slant + k)


def _growing(slant: Array, k: Array, below: Array) -> Array:
    """Returns the integral of exp(-k (below - s)) exp(-slant s) over s from 0 to `below`."""
    gap = slant - k
    lower = np.minimum(slant, k) * below
    width = np.abs(gap) * below
    return np.exp(-lower) * np.where(width > 1e-9, -np.expm1(-width) / np.maximum(np.abs(gap), 1e-300), below)
