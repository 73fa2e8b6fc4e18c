"""Change between two elevation maps: DEM of difference, level of detection, changed patches and volumes.

The errors are measured on the cells without change, which are found together with the registration, in rounds. A patch
is the region around a maximum of the smoothed difference that errors alone exceed anywhere in the map in 5 % of the
surveys: without change, one pair of surveys in 20 shows a patch.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter, uniform_filter
from scipy.special import ndtr, ndtri

from twin.core.records import MapGrid, Mask
from twin.products.error_field import ErrorField, SigmaParts, fitted
from twin.products.registration import Heights, MapRegistration, register
from twin.products.surface import Layer

CONFIDENCE = 0.95  #: of the level of detection, of intervals, and of a map without change having no patch
NORMAL_95 = float(ndtri(0.975))
DETECTION = 0.95  #: probability with which the detectable change is found
_LARGEST_Z = 4.0  # of a cell in the smoothed difference: one mismatch is no patch
_CALM_Z = 3.0  # of a square with which the errors are fitted at first
#: Quantile of the maxima above which their tail is fitted, and the share of those above that are errors, in each round:
#: at first, a quarter of all maxima may be changes.
_TAILS = (0.5, 0.5), (0.8, 0.5), (0.8, 0.9)


class Patch(NamedTuple):
    """Region whose heights have changed."""

    x_m: float  #: x, y of its centre in the scene of the first survey
    y_m: float
    area_m2: float
    change_m: float  #: mean change of height
    interval_m: tuple[float, float]  #: its 95 % interval
    volume_m3: float
    volume_sigma: SigmaParts


class Change(NamedTuple):
    """Change between two surveys; arrays are (rows, cols) on the grid of the first map, NaN where one is unknown."""

    grid: MapGrid
    registration: MapRegistration
    errors: ErrorField
    sigma_m: Layer  #: standard deviation of the difference of heights
    detection_level_m: Layer  #: change of a single cell that is significant at 95 %
    smoothed_sigma_m: Layer  #: standard deviation of the weighted mean of a square
    side: int  #: side of the square [cells]
    threshold: float  #: of |mean / sigma| of a square, which errors exceed anywhere in 5 % of the surveys
    labels: Layer  #: number of the patch of each cell, from 1; 0: none

    @property
    def patches(self) -> list[Patch]:
        return [self.patch(self.labels == number) for number in range(1, self.labels.max() + 1)]

    def patch(self, inside: Mask) -> Patch:
        """Returns mean change and volume of a mask of cells, which both maps have.

        The fitted random error is that of unchanged cells, in which errors that depend on the shape of the floor, such
        as those of smoothing, are equal in both maps. Where the shape has changed, they are as large as the maps state.
        """
        weights, of_maps = inside * self.grid.cell_m**2, self.registration
        sigma_m = np.where(self.labels > 0, np.fmax(of_maps.sigma_m, self.errors.sigma_m), self.errors.sigma_m)
        parts = self.errors._replace(sigma_m=sigma_m).covariances(weights[None])
        random, correlated = (float(part[0, 0]) for part in parts)
        lever = (of_maps.design * weights).sum(axis=(1, 2))
        parts = np.sqrt(np.maximum([random, correlated, lever @ of_maps.cov @ lever], 0.0))
        sigma = SigmaParts(*(float(part) for part in parts))
        volume_m3, area_m2 = float(np.nansum(of_maps.difference_m * weights)), float(weights.sum())
        x, y = (float(values[inside].mean()) for values in np.meshgrid(*self.grid.centres()))
        mean_m, half_m = volume_m3 / area_m2, NORMAL_95 * sigma.total / area_m2
        return Patch(x, y, area_m2, mean_m, (mean_m - half_m, mean_m + half_m), volume_m3, sigma)

    @property
    def significant(self) -> Mask:
        """Returns the cells whose own change exceeds the level of detection."""
        return np.abs(np.nan_to_num(self.registration.difference_m)) > self.detection_level_m

    @property
    def detectable_m(self) -> Layer:
        """Returns the mean change (rows, cols) of a square that is found with a probability of 95 % [m]."""
        return (self.threshold + ndtri(DETECTION)) * self.smoothed_sigma_m

    def detection_probability(self, true_m: Layer) -> Layer:
        """Returns the probability with which a change (rows, cols) [m] exceeds the threshold around each cell."""
        limit_m = _LARGEST_Z * np.nan_to_num(self.sigma_m)
        counted_m = np.clip(np.nan_to_num(true_m), -limit_m, limit_m)
        expected = np.abs(_weighted_mean(counted_m, _weights(self.errors.sigma_m), self.side))
        return np.nan_to_num(ndtr(expected / self.smoothed_sigma_m - self.threshold))


def change_between(first: Heights, second: Heights, scale_m: float) -> Change:
    """Returns the change between two maps; `scale_m` is the size of the changes that are looked for.

    Raises TwinError as `register` does, or if too few cells are unchanged.
    """
    everywhere, most = np.ones(first.height_m.shape, bool), max(first.height_m.shape)
    side = min(max(round(scale_m / first.grid.cell_m), 1), most)
    of_maps = register(first, second, everywhere)
    weights = _weights(np.where(np.isfinite(of_maps.difference_m), of_maps.sigma_m, 0.0))
    ratio = _weighted_mean(np.nan_to_num(of_maps.difference_m), weights, side) * np.sqrt(_mean(weights, side))
    calm = np.abs(ratio) <= _CALM_Z * _normal_scale(ratio[weights > 0])
    change = _look((first, second), calm, everywhere, side, _TAILS[0])
    calm = everywhere
    for tail in _TAILS[1:]:
        calm = calm & ~np.asarray(binary_dilation(change.labels > 0, iterations=(side + 1) // 2), bool)
        change = _look((first, second), calm, calm, side, tail)
    return change


def _look(maps: tuple[Heights, Heights], stable: Mask, counted: Mask, side: int, tail: tuple[float, float]) -> Change:
    """Returns the change if the errors are those of the `stable` cells; arguments as in `_threshold`."""
    of_maps, grid = register(*maps, stable), maps[0].grid
    errors = fitted(of_maps.difference_m, of_maps.sigma_m, grid.cell_m, stable)
    of_maps = register(*maps, stable, errors)
    known = np.isfinite(of_maps.difference_m)
    by_registration_m2 = np.einsum("irc,ij,jrc->rc", of_maps.design, of_maps.cov, of_maps.design)
    sigma_m = np.sqrt(errors.sigma_m**2 + errors.long_sigma_m**2 + by_registration_m2)
    mean_m, mean_sigma_m = _smoothed(of_maps, errors, sigma_m, side)
    mean_sigma_m *= _normal_scale((mean_m / mean_sigma_m)[stable])  # independent errors average out faster
    ratio, sigma_m = np.nan_to_num(mean_m / mean_sigma_m), np.where(known, sigma_m, np.nan)
    threshold = _threshold(ratio, counted, side, tail)
    level_m = float(np.quantile(np.abs(of_maps.difference_m / sigma_m)[stable & known], CONFIDENCE)) * sigma_m
    return Change(grid, of_maps, errors, sigma_m, level_m, mean_sigma_m, side, threshold, _labels(ratio, threshold))


def _smoothed(of_maps: MapRegistration, errors: ErrorField, sigma_m: Layer, side: int) -> tuple[Layer, Layer]:
    """Returns the weighted mean of the difference over squares and its standard deviation (rows, cols) [m].

    With weights 1 / s^2, the variance of random errors is (mean sum of correlations of a cell) / (sum of weights).
    """
    weights = _weights(errors.sigma_m)
    enough = (_mean((weights > 0).astype(float), side) >= 0.5) & (weights > 0)
    square = np.ones((side, side))
    unit = errors._replace(sigma_m=square, long_sigma_m=0 * square)
    correlated_cells = float(unit.covariances(square[None])[0][0, 0]) / side**2
    random_m2 = correlated_cells / np.where(enough, _mean(weights, side) * side**2, 1.0)
    slow_m2 = _weighted_mean(sigma_m**2 - errors.sigma_m**2, weights, side)
    difference_m = np.clip(np.nan_to_num(of_maps.difference_m), -_LARGEST_Z * sigma_m, _LARGEST_Z * sigma_m)
    missing = np.where(enough, 0.0, np.nan)
    return _weighted_mean(difference_m, weights, side) + missing, np.sqrt(random_m2 + slow_m2) + missing


def _threshold(ratio: Layer, counted: Mask, side: int, tail: tuple[float, float]) -> float:
    """Returns the |mean / sigma| that errors exceed anywhere in 5 % of the surveys, at least that of normal errors.

    The tail of the maxima is exponential (generalised Pareto distribution of shape 0) from a quantile of them on, with
    the scale of the quantile of the maxima above up to which they are errors (`_TAILS`); the others may be changes.
    """
    (upper, clean_share), size = tail, np.abs(ratio)
    n_squares = max(int((size > 0).sum() / side**2), 1)
    normal = -float(ndtri((1 - CONFIDENCE) / 2 / n_squares))
    peaks = size[(size == maximum_filter(size, side)) & (size > 0) & counted]
    start = np.quantile(peaks, upper) if len(peaks) else 0.0
    excess = peaks[peaks > start] - start
    scale = np.quantile(excess, clean_share) / -np.log(1 - clean_share) if len(excess) else 0.0
    return max(normal, float(start + scale * np.log(max(len(excess), 1) / (1 - CONFIDENCE))))


def _labels(ratio: Layer, threshold: float) -> Layer:
    """Returns the numbers (rows, cols) of the regions of one sign beyond 1.96 with a maximum above the threshold."""
    labels = np.zeros(ratio.shape, int)
    for signed in (ratio, -ratio):
        _, regions = cv2.connectedComponents((signed > NORMAL_95).astype(np.uint8), connectivity=4)
        for number in np.unique(regions[signed > threshold]):
            labels[regions == number] = labels.max() + 1
    return labels


def _weights(sigma_m: Layer) -> Layer:
    return np.where(sigma_m > 0, 1 / np.where(sigma_m > 0, sigma_m, 1.0) ** 2, 0.0)


def _weighted_mean(values: Layer, weights: Layer, side: int) -> Layer:
    inside = weights > 0
    return np.where(inside, _mean(values * weights, side) / np.where(inside, _mean(weights, side), 1.0), 0.0)


def _mean(values: Layer, side: int) -> Layer:
    """Returns the means (rows, cols) over squares of side x side cells, of positive values not negative by rounding."""
    mean = uniform_filter(values, side, mode="constant")
    return np.maximum(mean, 0.0) if values.min() >= 0 else mean


def _normal_scale(values: Layer) -> float:
    """Returns the standard deviation of numbers (n,), robust against outliers; NaN are left out."""
    return 1.4826 * float(np.nanmedian(np.abs(values)))
