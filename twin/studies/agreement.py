"""Agreement of surrogate surveys with rendered surveys of the same scenarios and seeds, compared with limits.

Each rendered survey is paired with the surrogate survey that has the same seed and the same values of all varied keys
other than `imaging.fidelity`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from twin.judge.map_error import INFINITE_WITH_HOLES
from twin.studies.analysis import StudyAnalysis
from twin.studies.statistics import LEVEL, RESAMPLES, Array, Interval, wilson_interval

FIDELITY = "imaging.fidelity"
MEDIAN_LIMIT = 0.2  #: largest amount by which the ratio of medians, or its inverse, may exceed 1
P_LIMIT = 0.01  #: smallest p-value of the Kolmogorov-Smirnov test
PASS_LIMIT = 0.9  #: smallest fraction of pairs with the same verdict
_FLOWN = ("complete", "degraded")  # statuses of a survey that was flown to its end


class MetricAgreement(NamedTuple):
    """Comparison of one metric over the pairs in which both surveys were flown to their end.

    If `pairs` is 0, all other numbers are NaN.

    Args:
        metric: dotted name of the metric.
        pairs: number of pairs with a value in both surveys; a missing value of a metric that is infinite if the map has
            too many holes counts as infinite.
        rendered: median over the rendered surveys.
        surrogate: median over the surrogate surveys.
        ratio: `surrogate` / `rendered`, with its confidence interval (percentile bootstrap of pairs); 1 if both medians
            are infinite or zero.
        p_value: p-value of the two-sample Kolmogorov-Smirnov test. The samples are paired, so the test is conservative.
    """

    metric: str
    pairs: int
    rendered: float
    surrogate: float
    ratio: Interval
    p_value: float

    @property
    def agrees(self) -> bool:
        """Returns whether the ratio of medians and the p-value are within their limits."""
        within = 1 / (1 + MEDIAN_LIMIT) <= self.ratio.value <= 1 + MEDIAN_LIMIT
        return bool(within and self.p_value >= P_LIMIT)


class Agreement(NamedTuple):
    """Agreement of all pairs of a study.

    Args:
        pairs: number of pairs in which both surveys have a result.
        metrics: comparison of each metric.
        verdicts: fraction of the pairs in which both surveys pass or both do not pass, with its confidence interval.
        only_rendered: number of pairs in which only the rendered survey passes.
        only_surrogate: number of pairs in which only the surrogate survey passes.
    """

    pairs: int
    metrics: list[MetricAgreement]
    verdicts: Interval
    only_rendered: int
    only_surrogate: int

    @property
    def verdicts_agree(self) -> bool:
        """Returns whether the fraction of pairs with equal verdicts is at least `PASS_LIMIT`."""
        return self.verdicts.value >= PASS_LIMIT

    @property
    def agrees(self) -> bool:
        """Returns whether every metric and the verdicts agree."""
        return bool(self.metrics) and self.verdicts_agree and all(metric.agrees for metric in self.metrics)


def agreement(analysis: StudyAnalysis) -> Agreement | None:
    """Returns the agreement of a study's pairs; None if the study compares no metrics or no pair has two results."""
    if not analysis.study.compare:
        return None
    rendered, surrogate = pairs(analysis)
    if len(rendered) == 0:
        return None
    passed = analysis.passed[rendered], analysis.passed[surrogate]
    compared = [_compare(metric, *values_of_pairs(analysis, metric)) for metric in analysis.study.compare]
    return Agreement(
        len(rendered),
        compared,
        wilson_interval(float(np.sum(passed[0] == passed[1])), len(rendered)),
        int(np.sum(passed[0] & ~passed[1])),
        int(np.sum(passed[1] & ~passed[0])),
    )


def pairs(analysis: StudyAnalysis) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the row numbers (n,) of the rendered and of the surrogate survey of each pair with two results."""
    keys = [f"vary.{key}" for key in analysis.keys if key != FIDELITY] + ["seed"]
    columns = [analysis.rows[name].to_pylist() for name in keys]
    fidelity = analysis.rows[f"vary.{FIDELITY}"].to_pylist()
    rows: dict[tuple, dict[str, int]] = {}
    for k in np.flatnonzero(analysis.evaluated):
        rows.setdefault(tuple(column[k] for column in columns), {})[fidelity[k]] = int(k)
    both = [row for row in rows.values() if len(row) == 2]
    return (
        np.array([row["rendered"] for row in both], np.int64),
        np.array([row["surrogate"] for row in both], np.int64),
    )


def values_of_pairs(analysis: StudyAnalysis, metric: str) -> tuple[Array, Array]:
    """Returns the values (n,) of a metric in the rendered and the surrogate surveys of the pairs that can be compared.

    These are the pairs in which both surveys were flown to their end and have a value; see `MetricAgreement`.
    """
    rendered, surrogate = pairs(analysis)
    status, values = analysis.status, analysis.numbers(metric)
    if metric in INFINITE_WITH_HOLES:
        values = np.where(np.isnan(values), np.inf, values)
    flown = np.isin(status[rendered], _FLOWN) & np.isin(status[surrogate], _FLOWN)
    known = flown & ~np.isnan(values[rendered]) & ~np.isnan(values[surrogate])
    return values[rendered[known]], values[surrogate[known]]


def _compare(metric: str, rendered: Array, surrogate: Array) -> MetricAgreement:
    """Returns the comparison of the values (n,) of a metric in rendered and surrogate surveys."""
    n = len(rendered)
    if n == 0:
        return MetricAgreement(metric, 0, np.nan, np.nan, Interval(np.nan, np.nan, np.nan), np.nan)
    chosen = np.random.default_rng(0).integers(n, size=(RESAMPLES, n))
    ratios = _ratio(_median(surrogate[chosen]), _median(rendered[chosen]))
    low, high = np.quantile(ratios, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="nearest")
    medians = _median(rendered[None]), _median(surrogate[None])
    interval = Interval(float(_ratio(medians[1], medians[0])[0]), float(low), float(high))
    p_value = float(np.asarray(stats.ks_2samp(rendered, surrogate))[1])
    return MetricAgreement(metric, n, float(medians[0][0]), float(medians[1][0]), interval, p_value)


def _median(values: Array) -> Array:
    """Returns the lower median along the last axis, which is one of the values, so that infinite values are allowed."""
    return np.quantile(values, 0.5, axis=-1, method="inverted_cdf")


def _ratio(numerator: Array, denominator: Array) -> Array:
    """Returns the ratio of non-negative values (n,); 1 where they are equal, also if both are zero or infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(numerator == denominator, 1.0, numerator / denominator)
