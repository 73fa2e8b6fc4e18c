"""Correction of a plan's surrogate results, estimated from plans with both rendered and surrogate surveys."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from twin.judge.verdict import more_is_better
from twin.studies.distribution import Distribution

_WIDTH = 0.15  # standard deviation of the kernel, as a fraction of the searched range
_PRIOR_WEIGHT = math.exp(-2.0)  # weight of "no correction": that of a plan at a distance of two widths
_LARGEST = 100.0  # largest ratio that is used; the smallest is its inverse
_MISSING = 10.0  # ratio of an error metric without a rendered value, e.g. because the rendered surveys were aborted


class PlanRatio(NamedTuple):
    """A plan with both rendered and surrogate surveys."""

    values: dict[str, Any]  #: value of each searched key
    ratios: dict[str, float]  #: ratio rendered / surrogate of each metric
    complete: float  #: fraction of the rendered surveys with status "complete"


class PlanCorrection(NamedTuple):
    """Expected ratios rendered / surrogate for one plan: of each metric and of the pass probability."""

    factors: dict[str, float]
    pass_factor: float

    def apply(self, metric: str, value: float | None) -> float | None:
        return None if value is None else value * self.factors.get(metric, 1.0)


NO_CORRECTION = PlanCorrection({}, 1.0)


def metric_ratio(metric: str, rendered: float | None, surrogate: float | None) -> float:
    """Returns the ratio rendered / surrogate of a metric, from 1/100 to 100; 1 unless both are finite and positive.

    Without a finite rendered value alone, it is 10, or 1/10 if larger values of the metric are better.
    """
    if surrogate is None or surrogate <= 0 or not math.isfinite(surrogate):
        return 1.0
    if rendered is None or not math.isfinite(rendered):
        return 1 / _MISSING if more_is_better(metric) else _MISSING
    return min(max(rendered / surrogate, 1 / _LARGEST), _LARGEST) if rendered > 0 else 1.0


def correction_at(
    search: dict[str, Distribution], flown: Sequence[PlanRatio], values: dict[str, Any]
) -> PlanCorrection:
    """Returns the correction of a plan, by kernel regression over the plans that were verified by rendered surveys.

    For each metric, the logarithm of the factor is the kernel-weighted mean (Nadaraya 1964, Watson 1964) of the
    logarithms of the flown plans' ratios and of a prior value of 0. The pass factor is the same mean of the fractions
    of completed surveys, with a prior value of 1. The weights are exp(-d^2 / (2 w^2)), with the `plan_distance` d and
    the kernel width w; the prior has the weight of a plan at the distance 2 w.
    """
    if not flown:
        return NO_CORRECTION
    weights = [math.exp(-0.5 * (plan_distance(search, plan.values, values) / _WIDTH) ** 2) for plan in flown]
    total = _PRIOR_WEIGHT + sum(weights)
    factors = {
        metric: math.exp(sum(w * math.log(plan.ratios[metric]) for w, plan in zip(weights, flown, strict=True)) / total)
        for metric in flown[0].ratios
    }
    complete = sum(w * plan.complete for w, plan in zip(weights, flown, strict=True))
    return PlanCorrection(factors, (_PRIOR_WEIGHT + complete) / total)


def plan_distance(search: dict[str, Distribution], one: dict[str, Any], other: dict[str, Any]) -> float:
    """Returns the RMS over the searched keys of `_difference`, 0 to 1."""
    squares = [_difference(distribution, one[key], other[key]) ** 2 for key, distribution in search.items()]
    return math.sqrt(sum(squares) / len(squares))


def _difference(distribution: Distribution, one: Any, other: Any) -> float:
    """Returns the absolute difference of two values as a fraction of the searched range."""
    values = distribution.values
    if distribution.kind == "choice":
        if not all(isinstance(value, int | float) for value in values):
            return float(one != other)
        ordered = sorted(set(values))
        return abs(ordered.index(one) - ordered.index(other)) / max(len(ordered) - 1, 1)
    low, high = values
    if distribution.kind == "log_uniform":
        return abs(math.log(one / other)) / math.log(high / low)
    return abs(one - other) / (high - low)
