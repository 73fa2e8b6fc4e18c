"""What a sample of surveys allows to say: shares, quantiles and dependences, each with how sure that is."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats

Array = NDArray[np.float64]
LEVEL = 0.95  #: confidence of every interval
RESAMPLES = 2000  #: of every bootstrap
_LISTED = 12  #: a number with no more values than this is taken value by value, others in bins


class Interval(NamedTuple):
    """An estimate and the ends of its interval; NaN where there is too little to tell."""

    value: float
    low: float
    high: float


def wilson(passed: float, count: float) -> Interval:
    """Share of successes with Wilson's score interval (Wilson 1927, J. Am. Stat. Assoc. 22, 209).

    (p + z^2/2n +- z sqrt(p (1-p)/n + z^2/4n^2)) / (1 + z^2/n); `count` may be an effective number.
    """
    if count <= 0:
        return Interval(np.nan, 0.0, 1.0)
    z, p = float(stats.norm.ppf(0.5 + LEVEL / 2)), passed / count
    middle = (p + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z * np.sqrt(p * (1 - p) / count + z**2 / (4 * count**2)) / (1 + z**2 / count)
    return Interval(p, max(0.0, float(middle - half)), min(1.0, float(middle + half)))


def share(passed: ArrayLike, units: ArrayLike) -> Interval:
    """Wilson's interval where surveys of one unit (same seed, or same sample) resemble each other.

    The number of surveys is divided by the design effect (Kish 1965): the variance of the share as units scatter
    over that of as many independent surveys; it stays between the number of units and that of surveys.
    """
    good = np.asarray(passed, dtype=float)
    names, index = np.unique(np.asarray(units), return_inverse=True)
    n, k = len(good), len(names)
    if n == 0 or n == k:
        return wilson(float(good.sum()), n)
    p = float(good.mean())
    off = np.bincount(index, good - p)
    variance = float((off**2).sum()) / n**2 * k / max(k - 1, 1)
    effective = min(max(p * (1 - p) / variance, k), n) if variance > 0 else k
    return wilson(p * effective, effective)


def bootstrap(values: ArrayLike, statistic: Callable[[Array], Array], units: ArrayLike | None = None) -> Interval:
    """A statistic with its percentile bootstrap interval, whole units drawn; NaN ends of less than five units.

    Args:
        statistic: of the last axis, without regard to NaN.
    """
    data = np.asarray(values, dtype=float)
    table = _by_unit(data, np.arange(len(data)) if units is None else np.asarray(units))
    if len(table) == 0:
        return Interval(np.nan, np.nan, np.nan)
    value = float(statistic(table.reshape(-1)))
    if len(table) < 5:
        return Interval(value, np.nan, np.nan)

    def of_units(drawn: NDArray[np.int64], axis: int = -1) -> Array:
        return statistic(table[drawn].reshape(*drawn.shape[:-1], -1))

    found = stats.bootstrap(
        (np.arange(len(table)),), of_units, n_resamples=RESAMPLES, batch=max(1, 2_000_000 // table.size),
        vectorized=True, confidence_level=LEVEL, method="percentile", rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return Interval(value, float(found.low), float(found.high))


def _by_unit(values: Array, units: NDArray) -> Array:
    """(units, largest unit) table of the values, filled up with NaN."""
    _, index = np.unique(units, return_inverse=True)
    order = np.argsort(index, kind="stable")
    sizes = np.bincount(index)
    table = np.full((len(sizes), sizes.max(initial=0)), np.nan)
    place = np.arange(len(values)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    table[index[order], place] = values[order]
    return table


def median(values: Array) -> Array:
    return percentile(values, 50)


def percentile(values: Array, percent: float) -> Array:
    """Along the last axis, without regard to NaN (ten times slower where there is any)."""
    find = np.nanpercentile if np.isnan(values).any() else np.percentile
    return find(values, percent, axis=-1)


def rank_correlation(x: ArrayLike, y: ArrayLike) -> Interval:
    """Spearman's rank correlation; interval by Fisher's z of variance (1 + r^2/2)/(n - 3) (Bonett & Wright 2000)."""
    a, b = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if len(a) < 5 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return Interval(np.nan, np.nan, np.nan)
    found: Any = stats.spearmanr(a, b)
    r = float(found.statistic)
    z = float(stats.norm.ppf(0.5 + LEVEL / 2)) * np.sqrt((1 + r**2 / 2) / (len(a) - 3))
    centre = np.arctanh(np.clip(r, -1 + 1e-12, 1 - 1e-12))
    return Interval(r, float(np.tanh(centre - z)), float(np.tanh(centre + z)))


def explained(groups: NDArray[np.int64], y: ArrayLike) -> float:
    """Share of the variance of y's ranks that the group alone explains, without what chance alone would.

    The first-order Sobol index of the ranks from given samples, by groups; epsilon squared (Kelley 1935):
    1 - (within / (n - k)) / (total / (n - 1)). NaN of less than five values a group.
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
    """Share of a metric's variance that an axis explains alone (first order), and with all others (total)."""

    first: Interval
    total: Interval


def sobol_indices(outcomes: ArrayLike, n_axes: int) -> list[SobolIndex]:
    """First-order and total Sobol indices of a Saltelli design, with bootstrap intervals (`scipy.stats.sobol_indices`).

    Args:
        outcomes: (n (n_axes + 2),) of the blocks A, B, AB_1, AB_2, ...
    """
    blocks = np.asarray(outcomes, dtype=float).reshape(n_axes + 2, 1, -1)
    given: Any = {"f_A": blocks[0], "f_B": blocks[1], "f_AB": blocks[2:]}
    found: Any = stats.sobol_indices(func=given, n=blocks.shape[-1], rng=np.random.default_rng(0))
    with warnings.catch_warnings(action="ignore"):  # an axis without any effect has no spread
        ends: Any = found.bootstrap(confidence_level=LEVEL, n_resamples=RESAMPLES)

    def interval(name: str, k: int) -> Interval:
        value, between = float(np.ravel(getattr(found, name))[k]), getattr(ends, name).confidence_interval
        low, high = (float(np.ravel(end)[k]) for end in between)
        return Interval(value, low, high) if np.isfinite(low) else Interval(value, value, value)

    return [SobolIndex(interval("first_order", k), interval("total_order", k)) for k in range(n_axes)]


def threshold(x: ArrayLike, passed: ArrayLike, share: float, rising: bool, units: ArrayLike) -> Interval:
    """How far x may go until fewer than `share` pass, with its bootstrap interval.

    The probability of passing as a function of x is the monotone one of greatest likelihood (isotonic regression,
    Barlow et al. 1972); x is where it crosses `share`. Infinite where it never does.

    Args:
        rising: whether more pass as x grows.
    """
    sign, good = 1.0 if rising else -1.0, np.asarray(passed, float)
    _, unit = np.unique(np.asarray(units), return_inverse=True)
    values, place = np.unique(sign * np.asarray(x, float), return_inverse=True)
    n_units = unit.max(initial=-1) + 1
    if n_units < 5:
        return Interval(np.nan, np.nan, np.nan)

    def crossing(weight: Array) -> float:
        total = np.bincount(place, weight)
        at = total > 0
        level = optimize.isotonic_regression(np.bincount(place, weight * good)[at] / total[at], weights=total[at]).x
        first = int(np.searchsorted(level, share - 1e-9))
        if first in (0, len(level)):
            return -np.inf if first == 0 else np.inf
        return float(values[at][first - 1 : first + 1].mean())

    rng = np.random.default_rng(0)
    often = rng.multinomial(n_units, np.full(n_units, 1 / n_units), size=RESAMPLES).astype(float)
    found = [crossing(times[unit]) for times in often]
    low, high = sorted(sign * np.quantile(found, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2], method="inverted_cdf"))
    return Interval(sign * crossing(np.ones(len(good))), float(low), float(high))


def groups_of(x: ArrayLike) -> NDArray[np.int64]:
    """Which group each number is in: its value where there are few, else one of up to ten bins of equal count."""
    values = np.asarray(x, dtype=float)
    listed, index = np.unique(values, return_inverse=True)
    if len(listed) <= _LISTED and len(listed) < len(values):
        return index.astype(np.int64)
    bins = int(np.clip(len(values) // 6, 2, 10))
    return (stats.rankdata(values, method="ordinal") - 1).astype(np.int64) * bins // max(len(values), 1)


def how_often_above(x: ArrayLike, y: ArrayLike) -> float:
    """Share of pairs in which a value of x is above one of y, ties by half: Mann & Whitney's U over all pairs."""
    a, b = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if len(a) == 0 or len(b) == 0:
        return float("nan")
    return float(stats.mannwhitneyu(a, b).statistic) / (len(a) * len(b))
