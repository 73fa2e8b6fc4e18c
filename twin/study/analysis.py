"""Statistical analysis of a study's results: pass probability, metrics, sensitivities and reasons for failure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from twin.judge.require import more_is_better
from twin.study import statistics
from twin.study.design import axis_names
from twin.study.statistics import Array, Interval, SobolIndex
from twin.study.study_file import Study

_MAX_REASONS = 12


class MetricSummary(NamedTuple):
    """Distribution of a metric over the surveys: median, 95th or 5th percentile, and required limit.

    `surveys` is the number of surveys; `bound` is the 95th percentile, or the 5th percentile if larger values of the
    metric are better; `limit` is None if the metric has no requirement.
    """

    name: str
    surveys: int
    median: Interval
    bound: Interval
    limit: float | None


class Sensitivity(NamedTuple):
    """Dependence of a metric on a key: rank correlation (NaN for text) and explained fraction of the rank variance."""

    key: str
    metric: str
    correlation: Interval
    explained: float


class KeyComparison(NamedTuple):
    """Medians of a key over the surveys that passed and over the surveys that did not pass.

    `superiority` is the probability that the key has a greater value in a survey that did not pass than in one that
    passed; ties count half.
    """

    key: str
    passed: float
    not_passed: float
    superiority: float


class FailureReason(NamedTuple):
    """Reason why surveys did not pass, their status, and the number of these surveys."""

    status: str
    reason: str
    surveys: int


class StudyAnalysis:
    """Statistics of the results table of a study, which has one row per survey; array attributes follow its rows."""

    def __init__(self, rows: pa.Table, study: Study):
        self.rows, self.study, self.required_probability = rows, study, study.probability
        self.status, self.reason, self.warning = (self._texts(name) for name in ("status", "reason", "warning"))
        self.evaluated = self.status != "failed"
        self.complete = self.status == "complete"
        self.keys = [key for key in study.varied_keys if f"vary.{key}" in rows.column_names]
        self.limits = self._limits()
        self.metrics = [name for name in dict.fromkeys([*self.limits, *study.show]) if self._has_values(name)]
        self.passed = self._passed()

    def _texts(self, name: str) -> NDArray:
        column = self.rows[name].to_pylist() if name in self.rows.column_names else []
        return np.array(["" if value is None else str(value) for value in column], dtype=object)

    def numbers(self, name: str) -> Array:
        """Returns a numeric column of the table (n,), with NaN where a survey has no value."""
        if name not in self.rows.column_names:
            return np.full(self.rows.num_rows, np.nan)
        return np.array([np.nan if v is None else float(v) for v in self.rows[name].to_pylist()])

    def _has_values(self, metric: str) -> bool:
        """Returns whether the metric is required or has a value in any survey (surrogate surveys have no contrast)."""
        required = metric in self.limits and metric in self.rows.column_names
        return required or bool(np.isfinite(self.numbers(metric)).any())

    def included(self, metric: str) -> NDArray[np.bool_]:
        """Returns the mask (n,) of the surveys that are included in the statistics of a metric.

        These are the complete surveys with a value of the metric. The statistics of image quality metrics ("vision.")
        also include aborted surveys.
        """
        flown = self.evaluated if metric.startswith("vision.") else self.complete
        return flown & np.isfinite(self.numbers(metric))

    def _limits(self) -> dict[str, float]:
        limits = {}
        for column in self.rows.column_names:
            if match := re.fullmatch(r"require\.(.+)\.limit", column):
                values = self.numbers(column)
                limits[match[1]] = float(np.nanmax(values)) if np.isfinite(values).any() else np.nan
        return limits

    def _passed(self) -> NDArray[np.bool_]:
        """Returns the mask (n,) of the surveys that were completed and met every requirement."""
        met = [self.numbers(f"require.{name}.passed") == 1 for name in self.limits]
        return np.logical_and.reduce([self.complete, *met])

    @cached_property
    def cluster_name(self) -> str:
        """Returns the column that labels correlated surveys: "sample", or "seed" if that has more distinct values."""
        n_samples, n_seeds = (len(np.unique(self.numbers(name))) for name in ("sample", "seed"))
        return "sample" if n_samples >= n_seeds else "seed"

    @cached_property
    def clusters(self) -> Array:
        """Returns the cluster label of each survey (n,)."""
        return self.numbers(self.cluster_name)

    @cached_property
    def pass_probability(self) -> Interval:
        """Returns the fraction of the evaluated surveys that passed, with its confidence interval."""
        return statistics.clustered_proportion(self.passed[self.evaluated], self.clusters[self.evaluated])

    @property
    def requirement_missed(self) -> bool:
        """Returns whether the pass probability is below the required value; always False for a study with `seek`."""
        required = self.required_probability if self.study.seek is None else None
        return required is not None and not self.pass_probability.value >= required

    def key_numbers(self, key: str) -> Array | None:
        """Returns the value of a key in each survey (n,), or None if the values are not numbers."""
        column = self.rows[f"vary.{key}"]
        if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
            return self.numbers(f"vary.{key}")
        return None

    def key_groups(self, key: str, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], list[str]]:
        """Groups the chosen surveys by the value of a key; returns their group indices and the names of the groups."""
        values = self.key_numbers(key)
        if values is None:
            names, index = np.unique(self._texts(f"vary.{key}")[chosen].astype(str), return_inverse=True)
            return index, [str(name) for name in names]
        groups = statistics.group_indices(values[chosen])
        return groups, [_range_text(values[chosen][groups == k]) for k in np.unique(groups)]

    @cached_property
    def metric_summaries(self) -> list[MetricSummary]:
        """Returns the summary of the distribution of each metric."""
        return [self._metric_summary(name) for name in self.metrics]

    def _metric_summary(self, name: str) -> MetricSummary:
        values, included = self.numbers(name), self.included(name)
        data, clusters = values[included], self.clusters[included]
        percent = 5.0 if more_is_better(name) else 95.0
        return MetricSummary(
            name,
            len(data),
            statistics.bootstrap_interval(data, statistics.median, clusters),
            statistics.bootstrap_interval(data, lambda v: statistics.percentile(v, percent), clusters),
            self.limits.get(name),
        )

    @cached_property
    def sensitivities(self) -> list[Sensitivity]:
        """Returns the sensitivity of each metric to each key, sorted by metric, then strongest first."""
        unsorted = [self._sensitivity(key, metric) for metric in self.metrics for key in self.keys]
        order = {metric: k for k, metric in enumerate(self.metrics)}
        return sorted(unsorted, key=lambda s: (order[s.metric], -_strength(s)))

    def _sensitivity(self, key: str, metric: str) -> Sensitivity:
        y, included = self.numbers(metric), self.included(metric)
        x = self.key_numbers(key)
        undefined = Interval(np.nan, np.nan, np.nan)
        correlation = undefined if x is None else statistics.rank_correlation(x[included], y[included])
        groups, _ = self.key_groups(key, included)
        return Sensitivity(key, metric, correlation, statistics.explained_variance(groups, y[included]))

    @cached_property
    def sobol(self) -> dict[str, dict[str, SobolIndex]]:
        """Returns the Sobol indices by metric and axis; empty without a complete Saltelli design of several axes."""
        axes = axis_names(self.study)
        usable = self.study.sampling.method == "saltelli" and self.rows.num_rows > 0 and len(axes) > 1
        if not usable or len(np.unique(self.numbers("sample"))) != (self.study.sampling.samples or 0) * (len(axes) + 2):
            return {}
        means = {metric: self._mean_of_samples(metric) for metric in self.metrics}
        return {
            metric: dict(zip(axes, statistics.sobol_indices(y, len(axes)), strict=True))
            for metric, y in means.items()
            if np.isfinite(y).all() and np.ptp(y) > 0
        }

    def _mean_of_samples(self, metric: str) -> Array:
        """Returns the mean of a metric over the surveys of each sample; NaN if any of them was not completed."""
        values = np.where(self.complete, self.numbers(metric), np.nan)
        sample = self.numbers("sample").astype(np.int64)
        return np.bincount(sample, values) / np.bincount(sample)

    @cached_property
    def threshold(self) -> tuple[Interval, bool] | None:
        """Returns the value of the `seek` key at which the pass probability equals the required one.

        The second value is True if the pass probability increases with the key, else False. Returns None if the study
        has no numeric `seek` key or no required pass probability, or if no survey could be evaluated.
        """
        key = self.study.seek
        x = self.key_numbers(key) if key is not None and key in self.keys else None
        if x is None or self.required_probability is None or not self.evaluated.any():
            return None
        x, passed, clusters = x[self.evaluated], self.passed[self.evaluated], self.clusters[self.evaluated]
        rising = bool(statistics.probability_of_superiority(x[passed], x[~passed]) >= 0.5)
        return statistics.threshold(x, passed, self.required_probability, rising, clusters), rising

    @cached_property
    def key_comparisons(self) -> list[KeyComparison]:
        """Compares the numeric keys of surveys that passed and surveys that did not; best separating key first."""
        comparisons = []
        for key in self.keys:
            x = self.key_numbers(key)
            if x is not None:
                good, bad = x[self.evaluated & self.passed], x[self.evaluated & ~self.passed]
                if len(good) and len(bad):
                    superiority = statistics.probability_of_superiority(bad, good)
                    comparisons.append(KeyComparison(key, float(np.median(good)), float(np.median(bad)), superiority))
        return sorted(comparisons, key=lambda c: -abs(c.superiority - 0.5))

    @cached_property
    def failure_reasons(self) -> list[FailureReason]:
        """Returns the most frequent reasons why surveys did not pass, in descending order, with numbers masked."""
        counts: dict[tuple[str, str], int] = {}
        for k in np.flatnonzero(~self.passed):
            reason = mask_numbers(self.reason[k]) or "requirement not met: " + " and ".join(self._missed_limits(int(k)))
            counts[self.status[k], reason] = counts.get((self.status[k], reason), 0) + 1
        reasons = [FailureReason(*key, count) for key, count in counts.items()]
        return sorted(reasons, key=lambda r: (-r.surveys, r.reason))[:_MAX_REASONS]

    def _missed_limits(self, row: int) -> list[str]:
        return [name for name in self.limits if self.numbers(f"require.{name}.passed")[row] != 1]


def mask_numbers(reason: str) -> str:
    """Returns a reason with every number replaced by "…", so that reasons that differ only in numbers become equal."""
    return re.sub(r"(?<![\w.])[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "…", reason)


def _strength(sensitivity: Sensitivity) -> float:
    strengths = [abs(sensitivity.correlation.value), sensitivity.explained**0.5]
    return max([strength for strength in strengths if np.isfinite(strength)], default=0.0)


def _range_text(values: Array) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"


def summary(analysis: StudyAnalysis, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the summary that `--json` prints: counts, pass probability and the distribution of each metric.

    Args:
        identity: entries at the start of the summary, such as the name of the study.
    """
    probability = _as_dict(analysis.pass_probability) | {"required": analysis.required_probability}
    threshold = analysis.threshold
    metrics = {
        metric.name: {
            "surveys": metric.surveys,
            "median": _as_dict(metric.median),
            "bound_95_percent": _as_dict(metric.bound),
        }
        for metric in analysis.metric_summaries
    }
    return dict(identity) | {
        "surveys": len(analysis.status),
        **{name: int((analysis.status == name).sum()) for name in ("complete", "aborted", "refused", "failed")},
        "passed": int(analysis.passed.sum()),
        "probability": probability,
        "requirement_missed": analysis.requirement_missed,
        "threshold": None if threshold is None else {"key": analysis.study.seek, **_as_dict(threshold[0])},
        "metrics": metrics,
        "failure_reasons": [reason._asdict() for reason in analysis.failure_reasons],
    }


def _as_dict(interval: Interval) -> dict[str, float | None]:
    return {name: float(value) if np.isfinite(value) else None for name, value in interval._asdict().items()}
