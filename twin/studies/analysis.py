"""Statistical analysis of a study's results: pass probability, metrics, sensitivities and reasons for failure."""

import re
from collections import Counter
from collections.abc import Iterable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from twin.core.records import Mask
from twin.judge.map_error import with_completeness
from twin.judge.summary_statistics import percentile
from twin.judge.verdict import SIGNED, more_is_better
from twin.studies import statistics
from twin.studies.answers import (
    Answer,
    KeyLimit,
    KeyRegression,
    PassRecord,
    answers_of_ranges,
    answers_of_values,
    limit_of_key,
    range_text,
    regress,
)
from twin.studies.monotone import PassingMap, passing_map
from twin.studies.statistics import UNDEFINED, Array, Interval, Proportion, SobolIndex
from twin.studies.study_file import FIDELITY, Study

_MAX_REASONS = 12
_LEAST_EXPLAINED = 0.05  # of the variance; less is hardly distinguishable from chance
_MAX_LISTED = 12  # a key with more distinct numbers is treated as continuous, even if the study lists them


class MetricSummary(NamedTuple):
    """Median and bound of a metric; unknown values may be anything, so that an end of an interval may be infinite."""

    name: str
    surveys: int  #: number of surveys in these statistics; see `StudyAnalysis.included`
    median: Interval
    bound: Interval  #: 95th percentile, or 5th percentile if larger values of the metric are better
    limit: float | None  #: None if the metric has no requirement


class Sensitivity(NamedTuple):
    key: str
    metric: str
    correlation: Interval  #: rank correlation; NaN if the values of the key are not numbers
    explained: float  #: fraction of the variance of the metric's ranks; see `statistics.explained_variance`

    @property
    def strength(self) -> float:
        """Returns the larger of |correlation| and the square root of the explained variance; 0 if undefined."""
        return float(np.nanmax([abs(self.correlation.value), self.explained**0.5, 0.0]))


class KeyEnd(NamedTuple):
    """Surveys at one end of a key."""

    values: str  #: smallest and largest value of the key in them
    passed: float  #: fraction that passed
    median: float | None  #: of the first metric, over the completed ones; None without one


class Influence(NamedTuple):
    key: str
    explained: float  #: fraction of the variance of pass or fail, or else of the first metric, that the key explains
    ends: tuple[KeyEnd, KeyEnd]  #: smallest and largest values; of a text, those of which fewest and most passed


class FailureReason(NamedTuple):
    """Number of surveys with a status and a reason for it."""

    status: str
    reason: str
    surveys: int


class RefusedSample(NamedTuple):
    """A sample with refused surveys: its number, their number, value of each varied key, reason."""

    sample: int
    surveys: int
    values: dict[str, Any]
    reason: str


class StudyAnalysis:
    """Statistics of the results table of a study; the table and the array attributes (n,) have one row per survey.

    Refused surveys have no result and are excluded from every statistic except the lists of reasons. Those that only
    the surrogate refuses (`unmodelled`), and failed ones, are `unknown`: they count in pass probabilities, as unknown
    results, and in the bounds of metrics, as values that may be anything. Surveys of the same scenario with the same
    seed are identical and count once, except in `sobol`.

    `planned` is the number of surveys of the study; None: all of them are in the table.
    """

    def __init__(self, rows: pa.Table, study: Study, planned: int | None = None):
        self.rows, self.study, self.required_probability = rows, study, study.probability
        self.not_flown = max(0, (planned or 0) - rows.num_rows)
        self.status, self.reason, self.warning = (self._texts(name) for name in ("status", "reason", "warning"))
        self.refused, self.failed = self.status == "refused", self.status == "failed"
        unmodelled = self.refused & (self.numbers("unmodelled") == 1)
        self.duplicate = self._duplicates(~self.failed & (unmodelled | ~self.refused))
        self.unmodelled = unmodelled & ~self.duplicate
        self.unknown = self.unmodelled | self.failed
        self.evaluated = ~(self.refused | self.failed | self.duplicate)
        self.counted = self.evaluated | self.unknown  # in pass probabilities
        self.complete = self.evaluated & (self.status == "complete")
        self.keys = [key for key in study.varied_keys if f"vary.{key}" in rows.column_names]
        columns = [re.fullmatch(r"require\.(.+)\.limit", column) for column in rows.column_names]
        limits = {match[1]: self.numbers(match[0]) for match in columns if match}
        self.limits = {name: float(np.nanmax(v)) if np.isfinite(v).any() else np.nan for name, v in limits.items()}
        names = [n for n in with_completeness([*self.limits, *study.show]) if n in rows.column_names]
        self.metrics = [n for n in names if n in self.limits or np.isfinite(self.numbers(n)).any()]
        met = [self.numbers(f"require.{name}.passed") == 1 for name in self.limits]
        self.passed: Mask = np.logical_and.reduce([self.complete, *met])  # completed and met every requirement

    def _texts(self, name: str) -> NDArray:
        """Returns a column of the table as texts (n,), "" where a survey has no value or if there is no column."""
        column = self.rows[name].to_pylist() if name in self.rows.column_names else [None] * self.rows.num_rows
        return np.array(["" if value is None else str(value) for value in column], dtype=object)

    def numbers(self, name: str) -> Array:
        """Returns a numeric column of the table (n,), with NaN where a survey has no value or if there is no column."""
        if name not in self.rows.column_names:
            return np.full(self.rows.num_rows, np.nan)
        return np.array([np.nan if v is None else float(v) for v in self.rows[name].to_pylist()])

    def _duplicates(self, counted: Mask) -> Mask:
        """Returns the mask (n,) of the surveys in `counted` (n,) with the scenario and seed of an earlier one in it."""
        hashes, seeds = self._texts("scenario_hash"), self.numbers("seed")
        seen: set[tuple[str, float]] = set()
        duplicate = np.zeros(self.rows.num_rows, np.bool_)
        for k in np.flatnonzero(counted):
            identity = hashes[k], float(seeds[k])
            duplicate[k] = bool(hashes[k]) and identity in seen
            seen.add(identity)
        return duplicate

    def included(self, metric: str) -> Mask:
        """Returns the complete surveys (n,) with a finite metric; "vision." also counts degraded and aborted ones."""
        flown = self.evaluated if metric.startswith("vision.") else self.complete
        return flown & np.isfinite(self.numbers(metric))

    @cached_property
    def cluster_name(self) -> str:
        """Returns the column that labels correlated surveys: "sample", or "seed" if that has more distinct values."""
        n_samples, n_seeds = (len(np.unique(self.numbers(name))) for name in ("sample", "seed"))
        return "sample" if n_samples >= n_seeds else "seed"

    @cached_property
    def clusters(self) -> Array:
        return self.numbers(self.cluster_name)

    @property
    def n_clusters(self) -> int:
        return len(np.unique(self.clusters))

    @property
    def n_rendered(self) -> int:
        """Returns the number of surveys flown rendered because the surrogate refuses them."""
        fidelity = self._texts("fidelity")
        return (
            int((fidelity == "rendered").sum()) if (fidelity == "surrogate").any() and FIDELITY not in self.keys else 0
        )

    @cached_property
    def pass_probability(self) -> Proportion:
        return self.proportion(self.counted)

    def proportion(self, chosen: Mask | NDArray[np.int64]) -> Proportion:
        """Returns the pass probability of the chosen surveys, which are all in `counted`."""
        return statistics.clustered_proportion(self.passed[chosen], self.clusters[chosen], self.unknown[chosen])

    @property
    def requirement_missed(self) -> bool:
        """Returns whether the fraction that passed (unknown counts as not) is below the required one, or not known."""
        required = self.required_probability
        return required is not None and not (self.evaluated.any() and self.pass_probability.value >= required)

    def key_numbers(self, key: str) -> Array | None:
        """Returns the value of a key in each survey (n,), or None if the values are not numbers."""
        column = self.rows[f"vary.{key}"].type
        is_number = pa.types.is_floating(column) or pa.types.is_integer(column)
        return self.numbers(f"vary.{key}") if is_number else None

    def key_groups(self, key: str, chosen: Mask) -> tuple[NDArray[np.int64], list[str]]:
        """Returns the group (`statistics.group_indices`) of each chosen survey, and values or ranges as names."""
        values = self.key_numbers(key)
        if values is None:
            names, index = np.unique(self._texts(f"vary.{key}")[chosen].astype(str), return_inverse=True)
            return index, [str(name) for name in names]
        groups = statistics.group_indices(values[chosen])
        return groups, [range_text(values[chosen][groups == k]) for k in np.unique(groups)]

    @cached_property
    def metric_summaries(self) -> list[MetricSummary]:
        found, further = [], self.clusters[self.unknown]
        for name in self.metrics:
            included = self.included(name)
            data, clusters = self.numbers(name)[included], self.clusters[included]
            extreme = 5.0 if more_is_better(name) else 95.0
            median, bound = (
                statistics.bootstrap_with_unknown(part, lambda v, q=q: statistics.percentile(v, q), clusters, further)
                for part, q in ((data, 50.0), (np.abs(data) if name in SIGNED else data, extreme))
            )
            found.append(MetricSummary(name, len(data), median, bound, self.limits.get(name)))
        return found

    @cached_property
    def sensitivities(self) -> list[Sensitivity]:
        """Returns the sensitivity of each metric to each key, metric by metric, the strongest first."""
        of_metrics = ([self._sensitivity(key, metric) for key in self.keys] for metric in self.metrics)
        return [one for of_keys in of_metrics for one in sorted(of_keys, key=lambda s: -s.strength)]

    def _sensitivity(self, key: str, metric: str) -> Sensitivity:
        x, y, included = self.key_numbers(key), self.numbers(metric), self.included(metric)
        correlation = UNDEFINED if x is None else statistics.rank_correlation(x[included], y[included])
        groups, _ = self.key_groups(key, included)
        return Sensitivity(key, metric, correlation, statistics.explained_variance(groups, y[included]))

    @property
    def influences(self) -> list[Influence]:
        """Returns the influence of each varied key that has a clear one, the largest first."""
        if not self.evaluated.any():
            return []
        metric, passed = next(iter(self.metrics), ""), self.passed[self.evaluated].astype(float)
        values = np.where(self.included(metric), self.numbers(metric), np.nan)[self.evaluated]
        result, found = passed if np.ptp(passed) else values, list[Influence]()
        known = np.isfinite(result)
        for key in self.keys:
            groups, names = self.key_groups(key, self.evaluated)
            members = [groups == k for k in range(len(names))]
            if self.key_numbers(key) is None:
                members.sort(key=lambda one: passed[one].mean())
            parts = [(names[groups[one][0]], passed[one].mean(), values[one]) for one in members]
            ends = [KeyEnd(name, share, percentile(v[np.isfinite(v)], 50)) for name, share, v in parts]
            explained = statistics.explained_variance(groups[known], result[known])
            found.append(Influence(key, explained, (ends[0], ends[-1])))
        return sorted((one for one in found if one.explained > _LEAST_EXPLAINED), key=lambda one: -one.explained)

    @cached_property
    def sobol(self) -> dict[str, dict[str, SobolIndex]]:
        """Returns the Sobol indices by metric and axis; empty without a complete Saltelli design of several axes."""
        # without metrics that are constant, or of which a survey of the design has no value
        sampling, keys = self.study.sampling, self.study.axes(listed=False)
        axes = [name if isinstance(name, str) else " + ".join(name) for name in keys]
        usable = sampling.method == "saltelli" and self.rows.num_rows > 0 and len(axes) > 1
        if not usable or len(np.unique(self.numbers("sample"))) != (sampling.samples or 0) * (len(axes) + 2):
            return {}
        means = {metric: self._mean_of_samples(metric) for metric in self.metrics}
        return {
            metric: dict(zip(axes, statistics.sobol_indices(y, len(axes)), strict=True))
            for metric, y in means.items()
            if np.isfinite(y).all() and np.ptp(y) > 0
        }

    def _mean_of_samples(self, metric: str) -> Array:
        values = np.where(self.status == "complete", self.numbers(metric), np.nan)  # also duplicates
        sample = self.numbers("sample").astype(np.int64)
        return np.bincount(sample, values) / np.bincount(sample)

    @cached_property
    def answers(self) -> dict[str, list[Answer]]:
        """Returns, for each varied key, the verdicts on whether the pass probability reaches the required value.

        A key with a continuous distribution, or with more than 12 listed numbers, has one answer per range, another one
        per value. Empty without a required pass probability, or if no survey was evaluated.
        """
        if self.required_probability is None or not self.evaluated.any():
            return {}
        return {key: self._answers(key) for key in self.keys}

    @cached_property
    def pass_record(self) -> PassRecord:
        """Returns the results of the surveys that count in pass probabilities, in the order of the table."""
        chosen, required = self.counted, self.required_probability
        required = np.nan if required is None else required
        return PassRecord(self.passed[chosen], self.clusters[chosen], required, self.unknown[chosen])

    @cached_property
    def regressions(self) -> dict[str, KeyRegression]:
        """Returns the regression of each key that is continuous, or has many listed numbers."""
        values = {key: x[self.counted] for key in self.keys if (x := self._continuous(key)) is not None}
        return {key: regress(x, self.pass_record) for key, x in values.items()}

    def _continuous(self, key: str) -> Array | None:
        """Returns the value of a key in each survey (n,); None if its values are listed, or text."""
        x, distribution = self.key_numbers(key), self.study.vary.get(key)
        if x is None:
            return None
        is_listed = distribution is None or distribution.kind in ("choice", "grid")
        n_different = len(np.unique(x[self.counted]))
        return None if n_different <= 1 or (is_listed and n_different <= _MAX_LISTED) else x

    def _answers(self, key: str) -> list[Answer]:
        if key in self.regressions:
            return answers_of_ranges(self.regressions[key])
        numbers = self.key_numbers(key)
        names = self._texts(f"vary.{key}").astype(str) if numbers is None else numbers
        return answers_of_values(names[self.counted], self.pass_record)

    @cached_property
    def key_limits(self) -> dict[str, KeyLimit]:
        """Returns the limit of each continuous key with which the pass probability rises or falls; see `answers`."""
        found = {
            key: limit_of_key(self.regressions[key], self.answers[key]) for key in self.regressions if self.answers
        }
        return {key: limit for key, limit in found.items() if limit is not None}

    @cached_property
    def passing_map(self) -> PassingMap | None:
        """Returns the map of the two most influential keys of `key_limits`; None if there are fewer."""
        curves = {key: self.regressions[key].worst[0][0][1] for key in self.key_limits}
        ranked = sorted(curves, key=lambda key: -curves[key].deviance)[:2]
        if len(ranked) < 2:
            return None
        results = [self.pass_record.results(worst).astype(float) for worst in (True, False)]
        first, second = (curves[key] for key in ranked)
        return passing_map(
            (ranked[0], ranked[1]), np.array([self.regressions[key].x for key in ranked]), (first.rises, second.rises),
            (results[0], results[1]), max(first.design_effect, second.design_effect),
        )  # fmt: skip

    @cached_property
    def refused_samples(self) -> list[RefusedSample]:
        rows = np.flatnonzero(self.refused)
        numbers, first, counts = np.unique(self.numbers("sample")[rows], return_index=True, return_counts=True)
        values = [{key: self.rows[f"vary.{key}"][int(k)].as_py() for key in self.keys} for k in rows[first]]
        fields = zip(numbers.astype(int).tolist(), counts.tolist(), values, self.reason[rows[first]], strict=True)
        return [RefusedSample(*one) for one in fields]

    @cached_property
    def refusal_reasons(self) -> list[FailureReason]:
        """Returns the reasons of refusals, at most 12, the most frequent first; see `count_similar`."""
        counts = count_similar(self.reason[self.refused])
        return [FailureReason("refused", reason, count) for reason, count in counts.items()][:_MAX_REASONS]

    @cached_property
    def failure_reasons(self) -> list[FailureReason]:
        """Returns the reasons why surveys did not pass, with numbers masked: at most 12, the most frequent first."""
        rows = np.flatnonzero(~self.passed & ~self.refused & ~self.duplicate)
        counts = Counter((self.status[k], mask_numbers(self.reason[k]) or self._missed_limits(int(k))) for k in rows)
        reasons = [FailureReason(*key, count) for key, count in counts.items()]
        return sorted(reasons, key=lambda r: (-r.surveys, r.reason))[:_MAX_REASONS]

    @cached_property
    def warning_counts(self) -> dict[str, int]:
        """Returns the number of surveys with each warning; see `count_similar`."""
        return count_similar(self.warning[(self.warning != "") & ~self.duplicate])

    def _missed_limits(self, row: int) -> str:
        missed = [name for name in self.limits if self.numbers(f"require.{name}.passed")[row] != 1]
        return "requirement not met: " + " and ".join(missed)


def mask_numbers(reason: str) -> str:
    """Returns a reason with its numbers, but not digits within a word such as "LE90", replaced by "…"."""
    return re.sub(r"(?<![\w.])[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "…", reason)


def count_similar(texts: Iterable[str]) -> dict[str, int]:
    """Returns {text: count}, the most frequent first; texts that differ only in numbers count as the first of them."""
    first: dict[str, str] = {}
    return dict(Counter(first.setdefault(mask_numbers(text), text) for text in texts).most_common())
