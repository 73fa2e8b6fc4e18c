"""Map of the pass probability over two keys at once: isotonic regression along both, with an interval in each cell."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.studies.statistics import LEVEL, Array

_CELL_SURVEYS = 8  # mean number of surveys in a cell
_MAX_CELLS = 8  # along each key
_DRAWS, _SWEEPS = 200, 10


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
    """Returns the least squares fit (..., a, b) of a target that falls along both of the last two axes.

    By Dykstra and Robertson (1982, Ann. Stat. 10, 708): isotonic regression of the rows and of the columns in turn,
    each without its own last correction; about 0.02 from its limit by default. The weights have the shape (a, b).
    """
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
