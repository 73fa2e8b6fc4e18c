"""Verdicts on ranges of a key: whether the pass probability reaches the required value, or this is undecided."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri, xlogy

from twin.studies.statistics import LEVEL, Array, Interval, clustered_proportion, effective_number, surveys_to_decide

Verdict = Literal["passes", "fails", "undecided"]
_BIN_SURVEYS = 12  # smallest number of surveys in a bin of a continuous key
_MAX_BINS = 20
_DIVIDING_DEVIANCE = 15.0  # exceeded in less than 1 % of samples with one pass probability


class Answer(NamedTuple):
    """Verdict on the pass probability for one range of values of a scenario key, or for one of its listed values."""

    #: "passes" if the lower confidence bound of the pass probability reaches the required value, "fails" if the upper
    #: bound is below it, else "undecided". The bounds of ranges are corrected for multiple comparisons.
    verdict: Verdict
    label: str  #: the range or the value as text, e.g. "1.6 to 1.9".
    low: float  #: smallest value in the range; NaN for text
    high: float  #: largest value in the range; NaN for text
    surveys: int
    probability: Interval  #: pass probability in the range, with its 95 % confidence interval
    #: number of further surveys that would decide the verdict if the observed fractions stay the same; 0 if it is
    #: decided, infinite if the observed fraction equals the required one or the required one is 1, or if the verdict
    #: depends on the unknown results
    more_surveys: float
    unknown: int = 0  #: number of these surveys whose result is unknown; see `PassRecord`


class PassRecord(NamedTuple):
    """Pass or fail of n surveys with their cluster labels, and the required pass probability."""

    passed: NDArray[np.bool_]  #: (n,)
    clusters: Array  #: (n,)
    required: float
    pass_level: float = LEVEL  #: confidence level of the lower bound for the verdict "passes"
    fail_level: float = LEVEL  #: confidence level of the upper bound for the verdict "fails"
    #: (n,) whether the result of each survey is unknown; such a survey counts as one that did not pass at the lower
    #: bound of the pass probability, and as one that passed at the upper bound
    unknown: NDArray[np.bool_] | np.bool_ = np.False_

    def answer(self, chosen: NDArray[np.bool_], label: str, low: float = np.nan, high: float = np.nan) -> Answer:
        """Returns the answer for the surveys of the mask `chosen` (n,), of which there is at least one."""
        clusters, unknown = self.clusters[chosen], (self.unknown & chosen)[chosen]
        passed = self.passed[chosen] & ~unknown
        verdict: Verdict = "undecided"
        if clustered_proportion(passed, clusters, unknown, self.pass_level).low >= self.required:
            verdict = "passes"
        elif clustered_proportion(passed, clusters, unknown, self.fail_level).high < self.required:
            verdict = "fails"
        more = 0.0 if verdict != "undecided" else self._more_surveys(passed, clusters, unknown)
        probability = clustered_proportion(passed, clusters, unknown)
        return Answer(verdict, label, low, high, len(passed), probability, more, int(unknown.sum()))

    def _more_surveys(self, passed: NDArray[np.bool_], clusters: Array, unknown: NDArray[np.bool_]) -> float:
        """Returns `Answer.more_surveys` of surveys (n,) that do not decide the verdict."""
        if passed.mean() >= self.required:  # even if no unknown result is a pass
            return surveys_to_decide(passed, clusters, self.required, self.pass_level)
        if (passed | unknown).mean() < self.required:
            return surveys_to_decide(passed | unknown, clusters, self.required, self.fail_level)
        return math.inf

    def for_ranges(self, n_bins: int) -> PassRecord:
        """Returns the record with the confidence levels for ranges that are searched among `n_bins` bins.

        The error probability is divided by the number of disjoint ranges that could get the verdict (Bonferroni). For
        "fails", this is `n_bins`, because the surveys of one bin can be enough. For "passes", a range needs at least
        z^2 r / (1 - r) effective surveys, even if all of them passed; r is the required probability and z = 1.96 the
        normal quantile for 95 % confidence.
        """
        smallest = float(ndtri(0.5 + LEVEL / 2)) ** 2 * self.required / max(1 - self.required, 1e-9)
        n_passing = max(1, min(n_bins, int(effective_number(self.passed, self.clusters) / max(smallest, 1e-9))))
        return self._replace(pass_level=1 - (1 - LEVEL) / n_passing, fail_level=1 - (1 - LEVEL) / n_bins)


def answers_of_values(names: ArrayLike, record: PassRecord) -> list[Answer]:
    """Returns the answer for each distinct value of a key: `names` (n,), numbers or text."""
    values = np.asarray(names)
    if np.issubdtype(values.dtype, np.number):
        return [record.answer(values == value, f"{value:.4g}", value, value) for value in np.unique(values).tolist()]
    return [record.answer(values == value, str(value)) for value in np.unique(values)]


def answers_of_ranges(x: Array, record: PassRecord) -> list[Answer]:
    """Returns the answers for a continuous key with the values x (n,), as ranges in ascending order.

    The surveys are sorted by the key and divided into bins, see `pass_bins`. A decided range is a run of consecutive
    bins that is decided as a whole, begins and ends with bins whose observed fraction agrees with the verdict, and
    contains no run with the opposite verdict. The pass probability need not be monotonic in the key. Runs with the most
    surveys are chosen first; the bins between them form undecided ranges. The confidence levels allow for this search,
    see `PassRecord.for_ranges`. A range extends from the smallest to the largest value of the key in its surveys; no
    claim is made beyond them.
    """
    bins = pass_bins(x, np.where(record.unknown, 2, record.passed))
    n_bins = int(bins.max()) + 1
    searched = record.for_ranges(n_bins)

    def of_run(first: int, last: int) -> Answer:
        chosen = (bins >= first) & (bins <= last)
        low, high = float(x[chosen].min()), float(x[chosen].max())
        return searched.answer(chosen, range_text(x[chosen]) if high > low else f"{low:.4g}", low, high)

    runs = {(i, j): of_run(i, j) for i in range(n_bins) for j in range(i, n_bins)}
    return [runs[run] for run in _decided_runs(runs, 0, n_bins - 1, record.required)]


def value_bins(x: Array) -> NDArray[np.int64]:
    """Returns the bin of each value (n,), numbered in ascending order; equal values share a bin."""
    values, counts = np.unique(x, return_counts=True)
    size = max(_BIN_SURVEYS, math.ceil(len(x) / _MAX_BINS))
    of_value, filled = np.zeros(len(values), np.int64), 0
    for k in range(len(values)):
        of_value[k] = of_value[k - 1] if k else 0
        if filled >= size and counts[k:].sum() >= size:  # the last bin takes the remaining values
            of_value[k] += 1
            filled = 0
        filled += counts[k]
    return of_value[np.searchsorted(values, x)]


def pass_bins(x: Array, outcomes: ArrayLike) -> NDArray[np.int64]:
    """Returns the bin of each survey (n,), numbered in ascending order of its value x (n,): `value_bins`, divided.

    Bins are divided where the fractions of the outcomes (n,) change, so that no bin mixes two pass probabilities; an
    outcome is 0: did not pass, 1: passed, or 2: unknown.
    """
    order, bins = np.argsort(x, kind="stable"), value_bins(x)
    changes = _changes(x[order], np.asarray(outcomes)[order, None] == np.arange(3))
    starts = [float(x[bins == k].min()) for k in range(int(bins.max()) + 1)]
    return np.searchsorted(np.unique([*starts, *changes]), x, side="right") - 1


def _changes(x: Array, is_outcome: NDArray[np.bool_]) -> list[float]:
    """Returns the values in x (n,), ascending, at which the fractions of the outcomes (n, 3) change.

    The surveys are divided where this reduces the binomial deviance most, if by `_DIVIDING_DEVIANCE` or more, and both
    parts likewise, as in a classification tree (Breiman et al. 1984).
    """
    counts = np.cumsum(is_outcome, axis=0, dtype=np.int64)
    before, total = counts[:-1], counts[-1]
    gain = _deviance(total) - _deviance(before) - _deviance(total - before)
    gain[np.diff(x) == 0] = 0.0  # equal values stay together
    if gain.max(initial=0.0) < _DIVIDING_DEVIANCE:
        return []
    first = int(np.argmax(gain)) + 1
    return [*_changes(x[:first], is_outcome[:first]), float(x[first]), *_changes(x[first:], is_outcome[first:])]


def _deviance(counts: NDArray[np.int64]) -> Array:
    """Returns -2 ln L (...) of the counts (..., 3) of outcomes, with the largest likelihood L of their fractions."""
    n = counts.sum(axis=-1)
    return 2 * (xlogy(n, n) - xlogy(counts, counts).sum(axis=-1))


def _decided_runs(
    runs: dict[tuple[int, int], Answer], first: int, last: int, required: float
) -> Iterator[tuple[int, int]]:
    """Divides the bins `first` to `last` into decided and undecided runs; yields (first, last) of each, ascending."""
    if first > last:
        return
    inside = [(i, j) for i in range(first, last + 1) for j in range(i, last + 1)]
    decided = [run for run in inside if _is_consistent(runs, run, required)]
    if not decided:
        yield first, last
        return
    i, j = max(decided, key=lambda run: (runs[run].surveys, -run[0]))
    yield from _decided_runs(runs, first, i - 1, required)
    yield i, j
    yield from _decided_runs(runs, j + 1, last, required)


def _is_consistent(runs: dict[tuple[int, int], Answer], run: tuple[int, int], required: float) -> bool:
    verdict = runs[run].verdict
    if verdict == "undecided":
        return False
    first, last = run
    ends = [runs[end, end].probability.value for end in run]
    if not all(end >= required if verdict == "passes" else end < required for end in ends):  # none is NaN
        return False
    opposite = "fails" if verdict == "passes" else "passes"
    return all(runs[i, j].verdict != opposite for i in range(first, last + 1) for j in range(i, last + 1))


def rounded(value: float) -> str:
    """Returns a number as text with three significant digits, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def range_text(values: Array) -> str:
    """Returns the smallest and the largest of some numbers (n,) as text, e.g. "1.6 to 1.9"."""
    low, high = rounded(float(values.min())), rounded(float(values.max()))
    return low if values.min() == values.max() else f"{low} to {high}"
