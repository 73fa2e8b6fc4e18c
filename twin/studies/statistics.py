"""Statistics of a sample of surveys: proportions, quantiles, correlations and Sobol indices, with 95 % intervals."""

import math
import warnings
from bisect import bisect_left
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from scipy.special import betaincinv, ndtri

from twin.core.geometry import Array

LEVEL = 0.95  #: confidence level of every interval
RESAMPLES = 2000  #: number of resamples of every bootstrap
_Z = float(ndtri(0.5 + LEVEL / 2))
_MIN_CLUSTERS = 5  # smallest number of clusters for a bootstrap interval
_EXTREME = 1e100  # stands for an infinite value: percentiles between infinite values are not defined
_MAX_DISCRETE = 12  # a key with at most this many distinct values is grouped by value; other keys are binned


class Interval(NamedTuple):
    """An estimate with the bounds of its confidence interval; a number is NaN if there are too few data for it."""

    value: float
    low: float
    high: float


UNDEFINED = Interval(np.nan, np.nan, np.nan)


class Proportion(NamedTuple):
    """Proportion of successes among trials, the outcome of some of which may be unknown."""

    value: float  #: proportion if no unknown trial is a success
    low: float  #: lower confidence bound of `value`
    high: float  #: upper confidence bound of `most`
    most: float  #: proportion if every unknown trial is a success; equals `value` if there is none


def wilson_interval(successes: float, n: float, unknown: int = 0) -> Proportion:
    """Returns the proportion of successes with Wilson's score interval (Wilson 1927, J. Am. Stat. Assoc. 22, 209).

    The bounds are (p + z^2 / (2 n) +- z sqrt(p (1 - p) / n + z^2 / (4 n^2))) / (1 + z^2 / n), with the proportion p
    and the normal quantile z of (1 + LEVEL) / 2. Without trials, the proportion is NaN and the interval is 0 to 1.
    `unknown` is the number of further trials, whose outcome is unknown.
    """
    if unknown:
        worst, best = (wilson_interval(successes + k, n + unknown) for k in (0, unknown))
        return Proportion(worst.value, worst.low, best.high, best.value)
    if n <= 0:
        return Proportion(np.nan, 0.0, 1.0, np.nan)
    z, p = _Z, successes / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    low, high = float(max(0.0, centre - half)), float(min(1.0, centre + half))
    return Proportion(p, low if p > 0 else 0.0, high if p < 1 else 1.0, p)  # exact bounds at 0 and 1


def exact_interval(successes: int, n: int, unknown: int = 0) -> Proportion:
    """Returns the proportion of successes in independent trials with its interval by Clopper and Pearson (1934).

    `unknown` is the number of further trials, whose outcome is unknown.
    """
    if unknown:
        worst, best = (exact_interval(successes + k, n + unknown) for k in (0, unknown))
        return Proportion(worst.value, worst.low, best.high, best.value)
    if n <= 0:
        return Proportion(np.nan, 0.0, 1.0, np.nan)
    low = betaincinv(successes, n - successes + 1, (1 - LEVEL) / 2) if successes else 0.0
    high = betaincinv(successes + 1, n - successes, (1 + LEVEL) / 2) if successes < n else 1.0
    return Proportion(successes / n, float(low), float(high), successes / n)


@cache
def trials_to_show(required: float, failures: int) -> float:
    """Returns the smallest number of trials, of which `failures` fail, whose `exact_interval` is above a proportion.

    Infinite if the required proportion is 1.
    """
    if required >= 1:
        return math.inf

    def is_enough(n: int) -> bool:
        return exact_interval(n - failures, n).low >= required

    most = failures + 1
    while not is_enough(most):
        most *= 2
    return bisect_left(range(most + 1), True, lo=failures + 1, key=is_enough)


def clustered_proportion(passed: ArrayLike, clusters: ArrayLike, unknown: ArrayLike | None = None) -> Proportion:
    """Returns the proportion of successes with Wilson's interval, corrected for correlation within clusters.

    Wilson's interval is computed for the effective number of surveys: their number divided by the design effect (Kish
    1965). The design effect is the variance of the proportion, estimated from the variation between clusters, divided
    by its variance for independent surveys. The effective number is limited to the range from the number of clusters
    to the number of surveys.

    `clusters` (n,) are labels of the surveys; `unknown` (n,) results as in `wilson_interval`.
    """
    success = np.asarray(passed, dtype=float)
    if len(success) == 0:
        return wilson_interval(0, 0)
    if unknown is not None and np.any(unknown):
        known = ~np.asarray(unknown, dtype=bool)
        worst, best = (clustered_proportion(np.where(known, success, k), clusters) for k in (0, 1))
        return Proportion(worst.value, worst.low, best.high, best.value)
    value, effective = float(success.mean()), effective_number(success, clusters)
    return wilson_interval(value * effective, effective)._replace(value=value, most=value)


def effective_number(passed: ArrayLike, clusters: ArrayLike) -> float:
    """Returns the effective number of surveys for a proportion; see `clustered_proportion`."""
    success = np.asarray(passed, dtype=float)
    labels, index = np.unique(np.asarray(clusters), return_inverse=True)
    n, k = len(success), len(labels)
    if n == 0 or n == k:
        return float(n)
    p = float(success.mean())
    residual = np.bincount(index, success - p)
    variance = float((residual**2).sum()) / n**2 * k / max(k - 1, 1)
    return float(min(max(p * (1 - p) / variance, k), n) if variance > 0 else k)


def surveys_to_decide(passed: ArrayLike, clusters: ArrayLike, required: float) -> float:
    """Returns the number of further surveys after which Wilson's interval would exclude the required proportion r.

    For n effective surveys and an observed proportion p, the interval contains r if (p - r)^2 <= z^2 r (1 - r) / n,
    where z is the normal quantile of (1 + LEVEL) / 2. If p stays the same, n = z^2 r (1 - r) / (p - r)^2 effective
    surveys are therefore needed. The result is at least 1, and infinite if p equals r, if r is 1, or without surveys.
    """
    success = np.asarray(passed, dtype=float)
    difference = float(success.mean()) - required if len(success) else 0.0
    if difference == 0 or required >= 1:
        return float("inf")
    effective = effective_number(success, clusters)
    needed = _Z**2 * required * (1 - required) / difference**2
    return float(np.ceil(max(needed - effective, 1.0) * len(success) / effective))


def bootstrap_interval(
    values: ArrayLike, statistic: Callable[[Array], Array], clusters: ArrayLike | None = None
) -> Interval:
    """Returns a statistic of data (n,) with its percentile bootstrap interval; whole clusters (n,) are resampled.

    It is NaN without data. The bounds are NaN if there are fewer than five clusters, or if both bounds are equal: data
    without variation do not show how much further data would vary. `statistic` is a function of data (..., n).
    """
    data = np.asarray(values, dtype=float)
    table = _by_cluster(data, np.arange(len(data)) if clusters is None else np.asarray(clusters))
    if len(table) == 0:
        return UNDEFINED
    value = float(statistic(table.reshape(-1)))
    if len(table) < _MIN_CLUSTERS:
        return Interval(value, np.nan, np.nan)

    def of_clusters(chosen: NDArray[np.int64], axis: int = -1) -> Array:
        return statistic(table[chosen].reshape(*chosen.shape[:-1], -1))

    bounds = stats.bootstrap(
        (np.arange(len(table)),), of_clusters, n_resamples=RESAMPLES, batch=max(1, 2_000_000 // table.size),
        vectorized=True, confidence_level=LEVEL, method="percentile", rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    if bounds.low == bounds.high:
        return Interval(value, np.nan, np.nan)
    return Interval(value, float(bounds.low), float(bounds.high))


def bootstrap_with_unknown(
    values: Array, statistic: Callable[[Array], Array], clusters: NDArray[Any], unknown_clusters: NDArray[Any]
) -> Interval:
    """Returns `bootstrap_interval` of known data if further values, of clusters (m,), may be anything."""
    # ends with them as small, and as large, as possible; an end may be infinite
    known = bootstrap_interval(values, statistic, clusters)
    if len(unknown_clusters) == 0 or len(values) == 0:
        return known
    labels, ends = np.concatenate([clusters, unknown_clusters]), []
    for k, extreme in enumerate((-_EXTREME, _EXTREME)):
        data = np.concatenate([values, np.full(len(unknown_clusters), extreme)])
        found = bootstrap_interval(data, statistic, labels)
        end = found[k + 1] if np.isfinite(found[k + 1]) else found.value
        ends.append(end if abs(end) < 1e-6 * _EXTREME else float(np.copysign(np.inf, end)))
    return Interval(known.value, *ends)


def _by_cluster(values: Array, clusters: NDArray) -> Array:
    """Returns the values as a table with one row per cluster; shorter rows are padded with NaN."""
    _, index = np.unique(clusters, return_inverse=True)
    order = np.argsort(index, kind="stable")
    sizes = np.bincount(index)
    table = np.full((len(sizes), sizes.max(initial=0)), np.nan)
    column = np.arange(len(values)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    table[index[order], column] = values[order]
    return table


def median(values: Array) -> Array:
    return percentile(values, 50)


def percentile(values: Array, percent: float) -> Array:
    function = np.nanpercentile if np.isnan(values).any() else np.percentile
    return function(values, percent, axis=-1)


def rank_correlation(x: ArrayLike, y: ArrayLike) -> Interval:
    """Returns Spearman's rank correlation with its interval; NaN for fewer than five pairs, or for a constant x or y.

    The interval is symmetric in Fisher's z = artanh(r), with variance (1 + r^2/2) / (n - 3) (Bonett & Wright 2000,
    Psychometrika 65, 23).
    """
    a, b = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if len(a) < 5 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return UNDEFINED
    result: Any = stats.spearmanr(a, b)
    r = float(result.statistic)
    z = float(stats.norm.ppf(0.5 + LEVEL / 2)) * np.sqrt((1 + r**2 / 2) / (len(a) - 3))
    centre = np.arctanh(np.clip(r, -1 + 1e-12, 1 - 1e-12))
    return Interval(r, float(np.tanh(centre - z)), float(np.tanh(centre + z)))


def explained_variance(groups: NDArray[np.int64], y: ArrayLike) -> float:
    """Returns the fraction of the variance of the ranks of y that the groups explain, corrected for chance.

    The result is epsilon squared (Kelley 1935), an estimate of the first-order Sobol index of the ranks:
    1 - (within / (n - k)) / (total / (n - 1)) for n values in k groups, where `within` is the sum of squared deviations
    of the ranks from their group means, and `total` the sum of squared deviations from the overall mean.
    It is at least 0, and NaN if there are fewer than five values per group on average, only one group, or a constant y.
    """
    ranks = stats.rankdata(y)
    n, k = len(ranks), len(np.unique(groups))
    if n < 5 * k or k < 2 or np.ptp(ranks) == 0:
        return float("nan")
    _, index = np.unique(groups, return_inverse=True)
    means = np.bincount(index, ranks) / np.bincount(index)
    within, total = float(((ranks - means[index]) ** 2).sum()), float(((ranks - ranks.mean()) ** 2).sum())
    return max(0.0, 1 - (within / (n - k)) / (total / (n - 1)))


class SobolIndex(NamedTuple):
    """Fractions of a metric's variance that a key, or joint keys, explain alone and together with interactions."""

    first: Interval
    total: Interval


def sobol_indices(values: ArrayLike, n_axes: int) -> list[SobolIndex]:
    """Returns the Sobol indices of each axis of a Saltelli design, with bootstrap intervals of the design points.

    The values are the metric at the points of each block of `surveys.design_points`. The estimators are those of
    `scipy.stats.sobol_indices` (Saltelli et al. 2010, Jansen 1999). If an interval is not defined, its bounds equal the
    index.
    """
    blocks = np.asarray(values, dtype=float).reshape(n_axes + 2, -1)
    blocks = blocks - blocks[:2].mean()

    def indices(points: NDArray[np.int64]) -> Array:
        a, b, mixed = blocks[0, points], blocks[1, points], blocks[2:, points]
        variance = np.var([a, b])
        first, total = np.mean(b * (mixed - a), axis=-1), np.mean((a - mixed) ** 2, axis=-1) / 2
        return np.array([first, total]) / variance

    points = np.arange(blocks.shape[-1])
    with warnings.catch_warnings(action="ignore"):  # an axis without any effect has a variance of 0
        bounds: Any = stats.bootstrap(
            (points,), indices, n_resamples=RESAMPLES, vectorized=False, confidence_level=LEVEL,
            rng=np.random.default_rng(0),
        ).confidence_interval  # fmt: skip
    value = indices(points)
    low, high = (np.where(np.isfinite(bounds.low), bound, value) for bound in bounds)
    intervals = np.stack([value, low, high], axis=-1).tolist()  # order, axis, field
    return [SobolIndex(Interval(*first), Interval(*total)) for first, total in zip(*intervals, strict=True)]


def group_indices(x: ArrayLike) -> NDArray[np.int64]:
    """Returns the group of each of n numbers.

    If there are at most 12 distinct values, and fewer than n, each distinct value is a group. Otherwise, the numbers
    are divided into 2 to 10 bins of about equal count; equal numbers may be in different bins.
    """
    values = np.asarray(x, dtype=float)
    distinct, index = np.unique(values, return_inverse=True)
    if len(distinct) <= _MAX_DISCRETE and len(distinct) < len(values):
        return index.astype(np.int64)
    bins = int(np.clip(len(values) // 6, 2, 10))
    return (stats.rankdata(values, method="ordinal") - 1).astype(np.int64) * bins // max(len(values), 1)
