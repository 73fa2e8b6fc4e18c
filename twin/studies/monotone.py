"""Pass probability as a monotone function of a key: isotonic regression, and what its likelihood ratio shows.

The surveys are sorted so that the pass probability p falls from one value of the key to the next. Its maximum
likelihood estimate is the isotonic regression of pass (1) and fail (0). With p(x) fixed to p0 at one value x, the
estimate is that of the values before x, at least p0, and that of the values after x, at most p0. Twice the difference
of both log-likelihoods follows a law without unknown parameters (Banerjee & Wellner 2001, Ann. Stat. 29, 1699; for
pass and fail data: 2005, Scand. J. Stat. 32, 405), so that p(x) differs from p0 where it exceeds `CRITICAL`.

A `PassingMap` is the isotonic regression along two keys at once, with an interval in each cell.
"""

import math
from bisect import bisect_left
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import isotonic_regression
from scipy.special import xlogy

from twin.studies.statistics import LEVEL, Array

CRITICAL = 2.27  #: 95th percentile of the law of Banerjee and Wellner
_CELL_SURVEYS = 8  # mean number of surveys in a cell
_MAX_CELLS = 8  # along each key
_DRAWS, _SWEEPS = 200, 10


class FallingCurve(NamedTuple):
    """Numbers of surveys and of passes at k distinct values of a key, in the order in which the probability falls."""

    values: Array  #: (k,) ascending, or descending if the pass probability rises with the key
    n: Array  #: (k,)
    passes: Array  #: (k,)
    fraction: Array  #: (k,) isotonic estimate of the pass probability
    design_effect: float  #: variance of the number of passes / its variance if all surveys were independent
    rises: bool  #: whether the pass probability rises with the key

    def deviance_at(self, k: int, required: float) -> float:
        """Returns twice the log-likelihood lost if the pass probability at value number k is the required one."""
        before, after = _isotonic(self.passes[:k], self.n[:k]), _isotonic(self.passes[k:], self.n[k:])
        fixed = np.concatenate([np.maximum(before, required), np.minimum(after, required)])
        fixed[k] = required
        return 2 * (self._log_likelihood(self.fraction) - self._log_likelihood(fixed))

    @property
    def deviance(self) -> float:
        """Returns twice the log-likelihood of the estimate above that of a constant pass probability."""
        constant = np.full(len(self.n), self.passes.sum() / self.n.sum())
        return 2 * (self._log_likelihood(self.fraction) - self._log_likelihood(constant))

    def _log_likelihood(self, fraction: Array) -> float:
        return float(np.sum(xlogy(self.passes, fraction) + xlogy(self.n - self.passes, 1 - fraction)))

    def shown(self, required: float) -> tuple[int, int]:
        """Returns the number of values shown to reach a probability, and the first shown to miss it."""
        # Both tests at a value use all surveys on the side where the probability is closer to the required one, so that
        # a value next to one that is shown, on the far side of the limit, is shown as well.
        indices, critical = range(len(self.values)), CRITICAL * self.design_effect

        def differs(k: int, is_beyond: bool) -> bool:
            return bool(is_beyond) and self.deviance_at(k, required) > critical

        n_reached = bisect_left(indices, True, key=lambda k: not differs(k, self.fraction[k] > required))
        return n_reached, bisect_left(indices, True, key=lambda k: differs(k, self.fraction[k] < required))

    def crossing(self, required: float) -> float:
        """Returns the value at which the estimate falls below a probability; infinite if it does not, by its sign."""
        n, end = int(np.sum(self.fraction >= required)), math.copysign(math.inf, self.values[-1] - self.values[0])
        if n in (0, len(self.values)):
            return end if n else -end
        return float(self.values[n - 1] + self.values[n]) / 2


def falling_curve(x: ArrayLike, passed: ArrayLike, clusters: ArrayLike, rises: bool) -> FallingCurve:
    """Returns the curve of surveys (n,) with values x of a key and cluster labels; `rises`: p rises with x."""
    values, index = np.unique(np.asarray(x, float), return_inverse=True)
    success = np.asarray(passed, float)
    order = slice(None, None, -1 if rises else 1)
    n = np.bincount(index)[order].astype(float)
    passes = np.bincount(index, success)[order].astype(float)
    fraction = _isotonic(passes, n)
    effect = _design_effect(success, fraction[order][index], clusters)
    return FallingCurve(values[order], n, passes, fraction, effect, rises)


def _isotonic(passes: Array, n: Array) -> Array:
    """Returns the falling estimate (k,) of the fraction of passes; none for k = 0."""
    if len(n) == 0:
        return n
    result: Any = isotonic_regression(passes / n, weights=n, increasing=False)
    return np.clip(result.x, 0.0, 1.0)


def _design_effect(success: Array, expected: Array, clusters: ArrayLike) -> float:
    """Returns the design effect (Kish 1965) from the residuals of clusters: 1 to the mean number of surveys in one."""
    labels, index = np.unique(np.asarray(clusters), return_inverse=True)
    most = len(success) / len(labels)
    variance = float(np.sum(expected * (1 - expected)))
    if most == 1 or variance == 0:
        return most
    return float(np.clip(np.sum(np.bincount(index, success - expected) ** 2) / variance, 1.0, most))


class PassingMap(NamedTuple):
    """Pass probability in a x b cells of two keys: estimate and 95 % interval."""

    keys: tuple[str, str]
    edges: tuple[Array, Array]  #: (a + 1,), (b + 1,): ends of the cells, which have about as many surveys each
    low: Array  #: (a, b) if no unknown result is a pass
    high: Array  #: (a, b) if every unknown result is a pass

    def verdicts(self, required: float) -> NDArray[np.int64]:
        """Returns 1 in the cells (a, b) that are shown to reach a probability, -1 in those that miss it, else 0."""
        return (self.low >= required).astype(np.int64) - (self.high < required)


def passing_map(
    keys: tuple[str, str], x: Array, rises: tuple[bool, bool], results: tuple[Array, Array], design_effect: float = 1.0
) -> PassingMap:
    """Returns the map of surveys (n,) with values x (2, n) of two keys along which the pass probability rises or falls.

    `results` (n,), 0 or 1, are those at worst and at best, which differ where a result is unknown. The interval is that
    of draws from the posterior of each cell (Jeffreys' prior), made monotone (Dunson & Neelon 2003, Biometrics 59,
    286).
    """
    count = int(np.clip(np.sqrt(x.shape[1] / _CELL_SURVEYS), 2, _MAX_CELLS))
    edges = [np.quantile(values, np.linspace(0, 1, count + 1)) for values in x]
    cell = [np.searchsorted(ends[1:-1], values, side="right") for ends, values in zip(edges, x, strict=True)]
    flips = tuple(axis + 1 for axis, flip in enumerate(rises) if flip)

    def draws(passed: Array) -> Array:
        table = np.zeros((2, count, count))
        np.add.at(table, (1 - passed.astype(np.int64), *cell), 1 / design_effect)
        passes, failures = np.flip(table, flips)
        drawn = np.random.default_rng(0).beta(passes + 0.5, failures + 0.5, size=(_DRAWS, count, count))
        return np.flip(isotonic_table(drawn, passes + failures + 1), flips)

    worst = draws(results[0])
    best = worst if np.array_equal(*results) else draws(results[1])
    low, high = np.quantile(worst, (1 - LEVEL) / 2, axis=0), np.quantile(best, (1 + LEVEL) / 2, axis=0)
    return PassingMap(keys, (edges[0], edges[1]), low, high)


def isotonic_table(target: Array, weights: Array, sweeps: int = _SWEEPS) -> Array:
    """Returns the least squares fit (..., a, b), falling along the last two axes, with weights (a, b)."""
    # Dykstra and Robertson (1982, Ann. Stat. 10, 708): isotonic regression of the rows and of the columns in turn, each
    # without its own last correction; about 0.02 from its limit by default.
    columns, estimate = np.zeros_like(target), target
    for _ in range(sweeps):
        start = target + columns
        rows = _falling_rows(start, weights) - start
        start = target + rows
        estimate = np.swapaxes(_falling_rows(np.swapaxes(start, -1, -2), weights.T), -1, -2)
        columns = estimate - start
    return estimate


def _falling_rows(target: Array, weights: Array) -> Array:
    """Returns the falling regression along the last axis: min over i <= k of the max over j >= k of means of i to j."""
    k = target.shape[-1]
    before = np.cumsum(weights, -1) - weights
    sums_before = np.cumsum(weights * target, -1) - weights * target
    ordered = np.triu(np.ones((k, k), bool))
    weight = np.where(ordered, (before + weights)[..., None, :] - before[..., :, None], 1.0)
    total = (sums_before + weights * target)[..., None, :] - sums_before[..., :, None]
    means = np.where(ordered, total / weight, -np.inf)  # [..., i, j]
    largest = np.flip(np.maximum.accumulate(np.flip(means, -1), -1), -1)
    return np.minimum.accumulate(np.where(ordered, largest, np.inf), -2)[..., range(k), range(k)]
