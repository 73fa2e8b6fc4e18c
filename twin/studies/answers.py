"""Verdicts on ranges of a key: where the pass probability is shown to reach, or to miss, the required one."""

import math
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import xlogy

from twin.core.records import Mask
from twin.studies.monotone import FallingCurve, falling_curve
from twin.studies.statistics import Array, Proportion, clustered_proportion, surveys_to_decide

Verdict = Literal["passes", "fails", "undecided"]
_INFLUENCE_DEVIANCE = 10.0  # exceeded in 2 to 5 % of studies by a key without influence
_TURNING_DEVIANCE = 15.0  # exceeded in less than 1 % of samples with one pass probability


class Answer(NamedTuple):
    """Verdict on the pass probability for one range of values of a scenario key, or for one of its listed values."""

    #: "passes" if the lower confidence bound of the pass probability reaches the required value, "fails" if the upper
    #: bound is below it, else "undecided"; for a range, the regression must show the same at each of its values
    verdict: Verdict
    label: str  #: the range or the value as text, e.g. "1.6 to 1.9".
    low: float  #: smallest value in the range; NaN for text
    high: float  #: largest value in the range; NaN for text
    surveys: int
    probability: Proportion  #: pass probability in the range, with its 95 % confidence interval
    #: number of further surveys that would decide the verdict if the observed fractions stay the same; 0 if it is
    #: decided; NaN if the surveys of the range differ, so that more of them only narrow it; infinite if the observed
    #: fraction equals the required one or the required one is 1, or if the verdict depends on the unknown results
    more_surveys: float
    unknown: int = 0  #: number of these surveys whose result is unknown; see `PassRecord`


class KeyLimit(NamedTuple):
    """Value where the pass probability crosses the required one, and 95 % interval; infinite beyond flown values."""

    value: float  #: NaN if it depends on the unknown results
    low: float
    high: float
    rises: bool  #: whether the pass probability rises with the key


class PassRecord(NamedTuple):
    """Pass or fail of n surveys with their cluster labels, and the required pass probability."""

    passed: Mask  #: (n,)
    clusters: NDArray[Any]  #: (n,)
    required: float
    #: (n,) whether the result of each survey is unknown; such a survey counts as one that did not pass at the lower
    #: bound of the pass probability, and as one that passed at the upper bound
    unknown: Mask | np.bool_ = np.False_

    def results(self, worst: bool) -> Mask:
        """Returns the passes (n,) if no unknown result is one (`worst`), or if every one is."""
        return self.passed & ~self.unknown if worst else self.passed | self.unknown

    def answer(self, chosen: Mask, label: str, low: float = np.nan, high: float = np.nan) -> Answer:
        """Returns the answer for the surveys of the mask `chosen` (n,), of which there is at least one."""
        clusters, unknown = self.clusters[chosen], (self.unknown & chosen)[chosen]
        passed = self.results(worst=True)[chosen]
        probability = clustered_proportion(passed, clusters, unknown)
        verdict: Verdict = "undecided"
        if probability.low >= self.required:
            verdict = "passes"
        elif probability.high < self.required:
            verdict = "fails"
        more = 0.0 if verdict != "undecided" else self._more_surveys(passed, clusters, unknown)
        return Answer(verdict, label, low, high, len(passed), probability, more, int(unknown.sum()))

    def _more_surveys(self, passed: Mask, clusters: NDArray[Any], unknown: Mask) -> float:
        """Returns `Answer.more_surveys` of surveys (n,) that do not decide the verdict."""
        if passed.mean() >= self.required:  # even if no unknown result is a pass
            return surveys_to_decide(passed, clusters, self.required)
        if (passed | unknown).mean() < self.required:
            return surveys_to_decide(passed | unknown, clusters, self.required)
        return math.inf

    def of_range(self, x: Array, chosen: Mask, allowed: tuple[Verdict, ...]) -> Answer:
        """Returns the answer for a range of values x (n,), "undecided" unless its verdict is an allowed one."""
        low, high = float(x[chosen].min()), float(x[chosen].max())
        found = self.answer(chosen, range_text(x[chosen]) if high > low else f"{low:.4g}", low, high)
        if found.verdict == "undecided" or found.verdict in allowed:
            return found
        return found._replace(verdict="undecided", more_surveys=math.inf if found.unknown else math.nan)


def answers_of_values(names: ArrayLike, record: PassRecord) -> list[Answer]:
    """Returns the answer for each distinct value of a key: `names` (n,), numbers or text."""
    values = np.asarray(names)
    if np.issubdtype(values.dtype, np.number):
        return [record.answer(values == value, f"{value:.4g}", value, value) for value in np.unique(values).tolist()]
    return [record.answer(values == value, str(value)) for value in np.unique(values)]


Piece = tuple[Mask, FallingCurve]  #: surveys (n,) between two turning points, and their regression


class KeyRegression(NamedTuple):
    """Monotone regressions of n surveys with values x of a continuous key, each in pieces that rise or fall.

    There is one of each kind, or two if the directions in which the pass probability changes depend on the unknown
    results; none if no influence of the key is shown.
    """

    x: Array  #: (n,)
    record: PassRecord
    worst: list[list[Piece]]  #: if no unknown result is a pass
    best: list[list[Piece]]  #: if every unknown result is a pass


def regress(x: Array, record: PassRecord) -> KeyRegression:
    results = [record.results(worst) for worst in (True, False)]
    shapes = [monotone_pieces(x, passed) for passed in results]
    same = [[(one.tobytes(), rises) for one, rises in shape] for shape in shapes]
    different = [shape for shape in (shapes if same[0] != same[1] else shapes[:1]) if shape]
    worst, best = (
        [
            [(one, falling_curve(x[one], passed[one], record.clusters[one], rises)) for one, rises in shape]
            for shape in different
        ]
        for passed in results
    )
    return KeyRegression(x, record, worst, best)


def answers_of_ranges(regression: KeyRegression) -> list[Answer]:
    """Returns the answers for a continuous key, as ranges in ascending order.

    A range passes or fails if the regression shows it at each of its values, and its surveys show it for their mean; if
    no influence of the key is shown, all values are one range, for which the mean is enough. Unknown results count as
    not passed where a range is to pass, and as passed where it is to fail. A range extends from the smallest to the
    largest value of the key in its surveys; no claim is made beyond them.
    """
    x, record = regression.x, regression.record
    codes = _shown(regression, reached=True) + 2 * _shown(regression, reached=False)
    ranges: list[tuple[Mask, Answer]] = []
    for chosen in _runs(x, codes):
        code = int(codes[chosen][0])
        allowed: tuple[Verdict, ...] = (("passes",) if code & 1 else ()) + (("fails",) if code & 2 else ())
        found = record.of_range(x, chosen, allowed)
        if ranges and found.verdict == ranges[-1][1].verdict == "undecided":
            chosen |= ranges.pop()[0]
            found = record.of_range(x, chosen, ())
        ranges.append((chosen, found))
    return [found for _, found in ranges]


def limit_of_key(regression: KeyRegression, answers: list[Answer]) -> KeyLimit | None:
    """Returns the limit of a key, given its answers; None unless the pass probability only rises, or falls, with it."""
    # The interval extends from the end of the range that passes to that of the range that fails.
    if [len(pieces) for pieces in regression.worst] != [1]:
        return None
    curves = [pieces[0][1] for pieces in (regression.worst[0], regression.best[0])]
    rises, first, last = curves[0].rises, answers[0], answers[-1]
    low_verdict, high_verdict = ("fails", "passes") if rises else ("passes", "fails")
    low = first.high if first.verdict == low_verdict else -math.inf
    high = last.low if last.verdict == high_verdict else math.inf
    at_worst, at_best = (curve.crossing(regression.record.required) for curve in curves)
    return KeyLimit(at_worst if at_worst == at_best else math.nan, low, high, rises)


def _shown(regression: KeyRegression, reached: bool) -> NDArray[np.int64]:
    """Returns 1 for surveys (n,) where every regression shows the probability, reached at worst or missed at best."""
    shown, required = np.ones(len(regression.x), bool), regression.record.required
    for pieces in regression.worst if reached else regression.best:
        part = np.zeros(len(regression.x), bool)
        for chosen, curve in pieces:
            n_reached, first_missed = curve.shown(required)
            part |= chosen & np.isin(regression.x, curve.values[:n_reached] if reached else curve.values[first_missed:])
        shown &= part
    return shown.astype(np.int64)


def _runs(x: Array, codes: NDArray[np.int64]) -> Iterator[Mask]:
    """Yields the surveys (n,) of each run of values x (n,), in ascending order, with the same code (n,)."""
    order = np.argsort(x, kind="stable")
    starts = np.flatnonzero(np.diff(codes[order], prepend=codes[order][0] + 1))
    for indices in np.split(order, starts[1:]):
        yield np.isin(np.arange(len(x)), indices)


def monotone_pieces(x: Array, passed: Mask) -> list[tuple[Mask, bool]]:
    """Divides surveys (n,) where their pass fraction turns from rising to falling with x (n,), or the other way.

    Returns the surveys (n,) of each piece, in ascending order, and whether its fraction rises; none if the fraction
    does not change. The turning points are the middles of the segments between changes (`_changes`) whose fraction is
    larger, or smaller, than those of both neighbours.
    """
    order = np.argsort(x, kind="stable")
    changes = _changes(x[order], passed[order])
    if not changes:
        return []
    segment = np.searchsorted(changes, x, side="right")
    fractions = np.bincount(segment, passed) / np.bincount(segment)
    rises = np.diff(fractions) > 0
    turning = np.flatnonzero(np.diff(rises)) + 1
    cuts = [float(np.median(x[segment == k])) for k in turning]
    piece = np.searchsorted(cuts, x, side="right")
    directions = rises[[0, *turning]]
    return [(piece == k, bool(directions[k])) for k in range(len(cuts) + 1)]


def _changes(x: Array, passed: Mask, least: float = _INFLUENCE_DEVIANCE) -> list[float]:
    """Returns the values in x (n,), ascending, at which the fraction that passed changes."""
    # divided where it reduces the binomial deviance most, if by `least`, and both parts likewise, if by
    # `_TURNING_DEVIANCE`, as in a classification tree (Breiman et al. 1984)
    n, passes = np.arange(1, len(x) + 1), np.cumsum(passed)
    gain = _deviance(passes[-1], n[-1]) - _deviance(passes, n)[:-1] - _deviance(passes[-1] - passes, n[-1] - n)[:-1]
    gain[np.diff(x) == 0] = 0.0  # equal values stay together
    if gain.max(initial=0.0) < least:
        return []
    first = int(np.argmax(gain)) + 1
    before, after = (_changes(x[part], passed[part], _TURNING_DEVIANCE) for part in (slice(first), slice(first, None)))
    return [*before, float(x[first]), *after]


def _deviance(passes: ArrayLike, n: ArrayLike) -> Array:
    """Returns -2 ln L (...) of numbers of passes (...) among n surveys (...), with the largest likelihood L."""
    k, total = np.asarray(passes, float), np.asarray(n, float)
    return 2 * (xlogy(total, total) - xlogy(k, k) - xlogy(total - k, total - k))


def rounded(value: float) -> str:
    """Returns a number as text with three significant digits, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def range_text(values: Array) -> str:
    """Returns the smallest and the largest of some numbers (n,) as text, e.g. "1.6 to 1.9"."""
    low, high = rounded(float(values.min())), rounded(float(values.max()))
    return low if values.min() == values.max() else f"{low} to {high}"
