"""Agreement of surrogate surveys with rendered surveys of the same scenarios and seeds, compared with limits.

Each rendered survey is paired with the surrogate survey that has the same seed and the same values of all varied keys
other than `imaging.fidelity`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from twin.judge.map_error import INFINITE_WITH_HOLES
from twin.report.number_formats import metric_value, percent, plain
from twin.report.words import words
from twin.studies import sentences
from twin.studies.analysis import StudyAnalysis
from twin.studies.statistics import LEVEL, RESAMPLES, UNDEFINED, Array, Interval, Proportion, wilson_interval
from twin.studies.study_file import FIDELITY

MEDIAN_LIMIT = 0.2  #: largest amount by which the ratio of medians, or its inverse, may exceed 1
P_LIMIT = 0.01  #: smallest p-value of the Kolmogorov-Smirnov test
PASS_LIMIT = 0.9  #: smallest fraction of pairs with the same verdict
_FLOWN = ("complete", "degraded")  # statuses of a survey that was flown to its end

HEADER = ("metric", "pairs", "rendered", "surrogate", "surrogate / rendered", "KS p", "verdict")
LIMITS = (
    f"Limits: medians within {percent(MEDIAN_LIMIT)} of each other, p of the two-sample Kolmogorov-Smirnov "
    f"test at least {percent(P_LIMIT)}, the same verdict in at least {percent(PASS_LIMIT)} of the "
    "pairs. In brackets: 95 % intervals, from a bootstrap of pairs and by Wilson's method."
)


class MetricAgreement(NamedTuple):
    """Comparison of one metric over the pairs in which both surveys were flown to their end; NaN without a pair."""

    metric: str
    #: number of pairs with a value in both surveys; a missing value of a metric that is infinite if the map has too
    #: many holes counts as infinite
    pairs: int
    rendered: float  #: median over the rendered surveys
    surrogate: float  #: median over the surrogate surveys
    #: `surrogate` / `rendered`, with its confidence interval (percentile bootstrap of pairs); 1 if both medians are
    #: infinite or zero
    ratio: Interval
    #: p-value of the two-sample Kolmogorov-Smirnov test. The samples are paired, so the test is conservative.
    p_value: float

    @property
    def agrees(self) -> bool:
        within = 1 / (1 + MEDIAN_LIMIT) <= self.ratio.value <= 1 + MEDIAN_LIMIT
        return bool(within and self.p_value >= P_LIMIT)


class Agreement(NamedTuple):
    pairs: int  #: number of pairs in which both surveys have a result
    metrics: list[MetricAgreement]
    #: fraction of the pairs in which both surveys pass or both do not pass, with its confidence interval
    verdicts: Proportion
    only_rendered: int  #: number of pairs in which only the rendered survey passes
    only_surrogate: int  #: number of pairs in which only the surrogate survey passes

    @property
    def verdicts_agree(self) -> bool:
        return self.verdicts.value >= PASS_LIMIT

    @property
    def agrees(self) -> bool:
        return bool(self.metrics) and self.verdicts_agree and all(metric.agrees for metric in self.metrics)


def agreement(analysis: StudyAnalysis) -> Agreement | None:
    """Returns the agreement of a study's pairs; None if the study compares no metrics or no pair has two results."""
    if not analysis.study.compare or not analysis.evaluated.any():
        return None
    rendered, surrogate = (analysis.passed[rows] for rows in pairs(analysis))
    if len(rendered) == 0:
        return None
    return Agreement(
        len(rendered),
        [_compare(metric, *values_of_pairs(analysis, metric)) for metric in analysis.study.compare],
        wilson_interval(float(np.sum(rendered == surrogate)), len(rendered)),
        int(np.sum(rendered & ~surrogate)),
        int(np.sum(surrogate & ~rendered)),
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
    rendered, surrogate = (np.array([row[name] for row in both], np.int64) for name in ("rendered", "surrogate"))
    return rendered, surrogate


def values_of_pairs(analysis: StudyAnalysis, metric: str) -> tuple[Array, Array]:
    """Returns the values (n,) of a metric in the rendered and surrogate surveys of the pairs of `MetricAgreement`."""
    rendered, surrogate = pairs(analysis)
    values = analysis.numbers(metric)
    if metric in INFINITE_WITH_HOLES:
        values = np.where(np.isnan(values), np.inf, values)
    usable = np.isin(analysis.status, _FLOWN) & ~np.isnan(values)
    both = usable[rendered] & usable[surrogate]
    return values[rendered[both]], values[surrogate[both]]


def _compare(metric: str, rendered: Array, surrogate: Array) -> MetricAgreement:
    n = len(rendered)
    if n == 0:
        return MetricAgreement(metric, 0, np.nan, np.nan, UNDEFINED, np.nan)
    chosen = np.random.default_rng(0).integers(n, size=(RESAMPLES, n))
    ratios = _ratio(_median(surrogate[chosen]), _median(rendered[chosen]))
    low, high = np.quantile(ratios, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="nearest")
    medians = _median(rendered), _median(surrogate)
    interval = Interval(float(_ratio(medians[1], medians[0])), float(low), float(high))
    p_value = float(np.asarray(stats.ks_2samp(rendered, surrogate))[1])
    return MetricAgreement(metric, n, float(medians[0]), float(medians[1]), interval, p_value)


def _median(values: Array) -> Array:
    """Returns the lower median along the last axis: one of the values, so that they may be infinite."""
    return np.quantile(values, 0.5, axis=-1, method="inverted_cdf")


def _ratio(numerator: Array, denominator: Array) -> Array:
    """Returns the ratio of non-negative values; 1 also if both are zero or infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(numerator == denominator, 1.0, numerator / denominator)


def table(result: Agreement) -> list[tuple[str, ...]]:
    return [
        (
            words(one.metric), str(one.pairs), _value(one.metric, one.rendered), _value(one.metric, one.surrogate),
            f"{one.ratio.value:.2f} ({one.ratio.low:.2f} to {one.ratio.high:.2f})", f"{one.p_value:.3f}",
            _verdict(one.agrees),
        )
        for one in result.metrics
    ]  # fmt: skip


def verdict_line(result: Agreement) -> str:
    return (
        f"{'PASS' if result.agrees else 'FAIL'}: {result.pairs} pairs; both surveys pass or both do not pass in "
        f"{sentences.percent_interval(result.verdicts)} of them ({_verdict(result.verdicts_agree)}; only the rendered "
        f"survey passes in {result.only_rendered}, only the surrogate survey in {result.only_surrogate})."
    )


def _value(metric: str, value: float) -> str:
    if np.isinf(value):
        return "infinite"
    return metric_value(metric, value) if metric.endswith("_m") else plain(value)


def _verdict(agrees: bool) -> str:
    return "agrees" if agrees else "does not agree"
