"""Verdicts on ranges of a key: whether the pass probability reaches the required value, or this is undecided."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from twin.study.statistics import LEVEL, Array, Interval, effective_number, surveys_to_decide, wilson_interval

Verdict = Literal["passes", "fails", "undecided"]
_BIN_SURVEYS = 12  # smallest number of surveys in a bin of a continuous key
_MAX_BINS = 20


class Answer(NamedTuple):
    """Verdict on the pass probability for one range of values of a scenario key, or for one of its listed values.

    Args:
        verdict: "passes" if the lower confidence bound of the pass probability reaches the required value, "fails" if
            the upper bound is below it, else "undecided". The bounds of ranges are corrected for multiple comparisons.
        label: the range or the value as text, e.g. "1.6 to 1.9".
        low: smallest value in the range; NaN for text.
        high: largest value in the range; NaN for text.
        surveys: number of surveys in the range.
        probability: pass probability in the range, with its 95 % confidence interval.
        more_surveys: number of further surveys that would decide the verdict if the observed fraction stays the same; 0
            if it is decided, infinite if the observed fraction equals the required one or the required one is 1.
    """

    verdict: Verdict
    label: str
    low: float
    high: float
    surveys: int
    probability: Interval
    more_surveys: float


class PassRecord(NamedTuple):
    """Pass or fail of n surveys with their cluster labels, and the required pass probability.

    Args:
        passed: (n,) whether each survey passed.
        clusters: (n,) cluster label of each survey.
        required: required pass probability.
        pass_level: confidence level of the lower bound for the verdict "passes".
        fail_level: confidence level of the upper bound for the verdict "fails".
    """

    passed: NDArray[np.bool_]
    clusters: Array
    required: float
    pass_level: float = LEVEL
    fail_level: float = LEVEL

    def answer(self, chosen: NDArray[np.bool_], label: str, low: float = np.nan, high: float = np.nan) -> Answer:
        """Returns the answer for the surveys that the mask `chosen` (n,) selects, of which there is at least one.

        `label`, `low` and `high` are the fields of the answer.
        """
        passed, clusters = self.passed[chosen], self.clusters[chosen]
        n, k = effective_number(passed, clusters), float(passed.mean())
        verdict: Verdict = "undecided"
        if wilson_interval(k * n, n, self.pass_level).low >= self.required:
            verdict = "passes"
        elif wilson_interval(k * n, n, self.fail_level).high < self.required:
            verdict = "fails"
        level = self.pass_level if k >= self.required else self.fail_level
        more = 0.0 if verdict != "undecided" else surveys_to_decide(passed, clusters, self.required, level)
        return Answer(verdict, label, low, high, len(passed), wilson_interval(k * n, n), more)

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
    """Returns the verdict on the pass probability for each distinct value of a key with listed values.

    Args:
        names: (n,) value of the key in each survey, numbers or text.
        record: results of the surveys.
    """
    values = np.asarray(names)
    numeric = np.issubdtype(values.dtype, np.number)
    answers = []
    for value in np.unique(values):
        number = float(value) if numeric else np.nan
        answers.append(record.answer(values == value, f"{value:.4g}" if numeric else str(value), number, number))
    return answers


def answers_of_ranges(x: Array, record: PassRecord) -> list[Answer]:
    """Returns the answers for a continuous key, as ranges in ascending order.

    The surveys are sorted by the key and divided into bins. A decided range is a run of consecutive bins that is
    decided as a whole, begins and ends with bins whose observed fraction agrees with the verdict, and contains no run
    with the opposite verdict. The pass probability need not be monotonic in the key. Runs with the most surveys are
    chosen first; the bins between them form undecided ranges. The confidence levels allow for this search, see
    `PassRecord.for_ranges`. A range extends from the smallest to the largest value of the key in its surveys; no claim
    is made beyond them.

    Args:
        x: (n,) value of the key in each survey.
        record: results of the surveys.
    """
    if len(x) == 0:
        return []
    bins = value_bins(x)
    n_bins = int(bins.max()) + 1
    searched = record.for_ranges(n_bins)

    def of_run(first: int, last: int) -> Answer:
        chosen = (bins >= first) & (bins <= last)
        low, high = float(x[chosen].min()), float(x[chosen].max())
        return searched.answer(chosen, f"{rounded(low)} to {rounded(high)}" if high > low else f"{low:.4g}", low, high)

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
    """Returns whether the verdict on a range of consecutive bins (first, last) is supported by these bins.

    The verdict must be decided, the observed fractions of the first and the last bin must agree with it, and no range
    of bins within this one may have the opposite verdict.
    """
    verdict = runs[run].verdict
    if verdict == "undecided":
        return False
    first, last = run
    passes = verdict == "passes"
    if any((runs[end, end].probability.value >= required) != passes for end in run):
        return False
    opposite = "fails" if passes else "passes"
    return all(runs[i, j].verdict != opposite for i in range(first, last + 1) for j in range(i, last + 1))


def rounded(value: float) -> str:
    """Returns a number with three significant digits, or all digits before the decimal point, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
