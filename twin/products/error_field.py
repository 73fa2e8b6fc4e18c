"""Errors of the heights of a map, or of the difference of two maps, as a random field of two spherical structures.

Errors of dense matching are correlated over a matching window; errors of the poses over the extent of keyframes and
path (Rolstad et al. 2009, J. Glaciol. 55, 666; Hugonnet et al. 2022, IEEE JSTARS 15, 6456).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy import fft
from scipy.optimize import nnls

from twin.errors import TwinError
from twin.products.surface import Layer

LEAST_CELLS = 200  #: that two maps must have in common
_N_RANGES = 24  # ranges that a fit tries


class SigmaParts(NamedTuple):
    """Standard deviation of a volume [m3], a height [m] or another product, in independent parts."""

    random: float  #: of errors that are correlated over a matching window
    correlated: float  #: of errors that are correlated over keyframes and path
    systematic: float  #: common to the whole map: registration; or scale, level and resolution of a single map

    @property
    def total(self) -> float:
        return float(np.linalg.norm(self))


class ErrorField(NamedTuple):
    """Covariance C_ij = s_i s_j r(h / window) + l_i l_j r(h / range) of the errors of two cells at the distance h.

    r(x) = 1 - 1.5 x + 0.5 x^3 for x < 1, else 0 (spherical model, Webster & Oliver 2007): random and correlated errors.
    """

    cell_m: float
    sigma_m: Layer  #: (rows, cols) standard deviation s of the random error [m]; 0 in cells without a height
    window_m: float  #: range of its correlation, about a matching window [m]
    long_sigma_m: Layer  #: (rows, cols) standard deviation l of the correlated error [m]; 0 in cells without a height
    long_range_m: float  #: range of its correlation [m]

    def covariances(self, weights: Layer) -> tuple[Layer, Layer]:
        """Returns the covariances (n, n) of n weighted sums of errors, weights (n, rows, cols): random, correlated."""
        random = _quadratic_forms(weights * self.sigma_m, self.window_m / self.cell_m)
        return random, _quadratic_forms(weights * self.long_sigma_m, self.long_range_m / self.cell_m)

    def samples(self, n: int, seed: int) -> Iterator[Layer]:
        """Yields n random fields of errors (rows, cols) [m]."""
        rng, cell_m = np.random.default_rng(seed), self.cell_m
        for _ in range(n):
            random = self.sigma_m * _unit_field(self.sigma_m.shape, self.window_m / cell_m, rng)
            yield random + self.long_sigma_m * _unit_field(self.sigma_m.shape, self.long_range_m / cell_m, rng)


def fitted(difference_m: Layer, sigma_m: Layer, cell_m: float, stable: Layer) -> ErrorField:
    """Returns the error field of a difference (rows, cols) [m] by its `stable` cells; NaN where unknown, mean 0.

    The autocovariance of difference / sigma gives s^2 / sigma^2, the window and the range, and the part of l^2 that is
    proportional to sigma^2 (errors of poses on slopes); that with weights 1 / sigma^2 gives the part that is equal
    everywhere. Raises TwinError if too few cells are stable.
    """
    known = np.isfinite(difference_m) & (sigma_m > 0)
    used, sigma = known & stable, np.where(known, sigma_m, 1.0)
    if used.sum() < LEAST_CELLS:
        raise TwinError("RUN2", f"has {used.sum()} unchanged cells in common with RUN1", f"at least {LEAST_CELLS}")
    extent, z = max(known.shape), np.where(used, difference_m / sigma, 0.0)
    if not z.any():
        raise TwinError("RUN2", "its map equals that of RUN1", "another survey")
    curve = _autocovariance(z, used.astype(float))
    near = curve[:, curve[0] < 0.1 * extent]  # rapid errors lie upon a plateau, which slow errors make
    window, _, plateau = _best_range(near, np.geomspace(1.5, 0.08 * extent, _N_RANGES), True)
    noise = max(curve[1, 0] - plateau, 0.0)  # with the part that is independent from cell to cell
    far, ranges = curve[:, curve[0] > 1.2 * window], np.geomspace(2 * window, 1.5 * extent, _N_RANGES)
    reach, sloping, _ = _best_range(far, ranges, False)
    weights = used / sigma**2
    curve = _autocovariance(z / sigma, weights)
    _, common, _ = _best_range(curve[:, curve[0] > 1.2 * window], np.array([reach]), False)
    common = max(common - sloping * used.sum() / weights.sum(), 0.0)
    long_m = np.where(known, np.sqrt(common + sloping * sigma**2), 0.0)
    return ErrorField(cell_m, np.where(known, np.sqrt(noise) * sigma, 0.0), window * cell_m, long_m, reach * cell_m)


def _best_range(curve: Layer, ranges: Layer, plateau: bool) -> tuple[float, float, float]:
    """Returns the range [cells] and a, b >= 0 of the a r(h / range) + b that fits best; b = 0 without `plateau`."""
    lags, covariance, weights = curve
    best, root = (np.inf, float(ranges[0]), 0.0, 0.0), np.sqrt(weights)
    for reach in ranges:
        model = np.stack([_spherical(lags / reach), np.full(len(lags), float(plateau))], axis=1)
        (a, b), misfit = nnls(model * root[:, None], covariance * root)
        if misfit < best[0] * (1 - 1e-9):
            best = float(misfit), float(reach), float(a), float(b)
    return best[1:]


def _autocovariance(values: Layer, weights: Layer) -> Layer:
    """Returns lags [cells], mean products and sums of weights (3, n); `values` are multiplied by their weights."""
    reach = max(values.shape) // 2 + 1
    shape = _padded(values.shape, reach)
    products, sums = (fft.irfft2(np.abs(fft.rfft2(part, shape)) ** 2, shape) for part in (values, weights))
    ring = np.rint(_distances(shape)).astype(int)
    of_products, of_sums = (np.bincount(ring[ring < reach], part[ring < reach]) for part in (products, sums))
    lags = np.flatnonzero(of_sums > 1e-6 * of_sums[0])
    return np.stack([lags, of_products[lags] / of_sums[lags], of_sums[lags]])


def _quadratic_forms(layers: Layer, reach: float) -> Layer:
    """Returns the sums (n, n) over all pairs of cells of w_i r(h_ij / reach) v_j, for layers (n, rows, cols)."""
    _, rows, cols = layers.shape
    shape = _padded((rows, cols), reach)
    spectrum = _spectrum(shape, reach)
    spread = [fft.irfft2(fft.rfft2(layer, shape) * spectrum, shape)[:rows, :cols] for layer in layers]
    return np.einsum("irc,jrc->ij", layers, np.array(spread))


def _unit_field(shape: tuple[int, ...], reach: float, rng: np.random.Generator) -> Layer:
    """Returns normal numbers (rows, cols) of unit variance with spherical correlation (circulant embedding)."""
    padded = _padded(shape, reach)
    white = fft.rfft2(rng.standard_normal(padded))
    return fft.irfft2(white * np.sqrt(_spectrum(padded, reach)), padded)[: shape[0], : shape[1]]


def _spectrum(shape: tuple[int, ...], reach: float) -> Layer:
    return np.maximum(np.real(fft.rfft2(_spherical(_distances(shape) / reach))), 0.0)


def _spherical(distance: Layer) -> Layer:
    x = np.minimum(distance, 1.0)
    return 1 - 1.5 * x + 0.5 * x**3


def _distances(shape: tuple[int, ...]) -> Layer:
    """Returns the distances of all cells of a torus from its first cell [cells]."""
    return np.hypot(*np.meshgrid(*(np.minimum(np.arange(n), n - np.arange(n)) for n in shape), indexing="ij"))


def _padded(shape: tuple[int, ...], reach: float) -> tuple[int, ...]:
    return tuple(12 * ((n + min(int(reach), n) + 12) // 12) for n in shape)  # divisible: fast to transform
