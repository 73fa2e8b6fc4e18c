"""What a study found, from its table alone: who passed, how far off, which key matters, what failures share."""

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
from twin.study.design import axes_of
from twin.study.statistics import Array, Interval, SobolIndex
from twin.study.study_file import Study

_MOST_GROUPS = 12  # reasons shown


class Level(NamedTuple):
    """A metric over the surveys that it counts in; `bound` is what 95 % of them keep."""

    name: str
    surveys: int
    median: Interval
    bound: Interval
    limit: float | None


class Influence(NamedTuple):
    """How a key and a metric go together: rank correlation (NaN of texts), and share of the ranks' variance."""

    key: str
    metric: str
    correlation: Interval
    explained: float


class Contrast(NamedTuple):
    """A key among surveys that passed and that did not; `above`: how often the latter's value is the higher."""

    key: str
    passed: float
    missed: float
    above: float


class Reason(NamedTuple):
    """Surveys that did not pass for the same reason."""

    status: str
    reason: str
    surveys: int


class Findings:
    """The results of a study, as arrays of one entry a survey."""

    def __init__(self, rows: pa.Table, study: Study):
        self.rows, self.study, self.required_share = rows, study, study.probability
        self.status, self.reason, self.warning = (self._texts(name) for name in ("status", "reason", "warning"))
        self.ended = self.status != "failed"
        self.complete = self.status == "complete"
        self.keys = [key for key in study.varied if f"vary.{key}" in rows.column_names]
        self.limits = self._limits()
        self.metrics = [name for name in dict.fromkeys([*self.limits, *study.show]) if self._known(name)]
        self.passed = self._passed()

    def _texts(self, name: str) -> NDArray:
        column = self.rows[name].to_pylist() if name in self.rows.column_names else []
        return np.array(["" if value is None else str(value) for value in column], dtype=object)

    def numbers(self, name: str) -> Array:
        """A column of numbers, NaN where there is none."""
        if name not in self.rows.column_names:
            return np.full(self.rows.num_rows, np.nan)
        return np.array([np.nan if v is None else float(v) for v in self.rows[name].to_pylist()])

    def _known(self, metric: str) -> bool:
        """Whether any survey has it, or must: contrast has none where no image is rendered."""
        needed = metric in self.limits and metric in self.rows.column_names
        return needed or bool(np.isfinite(self.numbers(metric)).any())

    def counted(self, metric: str) -> NDArray[np.bool_]:
        """Surveys whose figure counts: those complete; of what the cameras saw, those that broke off too."""
        flown = self.ended if metric.startswith("vision.") else self.complete
        return flown & np.isfinite(self.numbers(metric))

    def _limits(self) -> dict[str, float]:
        found = {}
        for column in self.rows.column_names:
            if named := re.fullmatch(r"require\.(.+)\.limit", column):
                limits = self.numbers(column)
                found[named[1]] = float(np.nanmax(limits)) if np.isfinite(limits).any() else np.nan
        return found

    def _passed(self) -> NDArray[np.bool_]:
        """Surveys that ended complete and kept every limit."""
        kept = [self.numbers(f"require.{name}.passed") == 1 for name in self.limits]
        return np.logical_and.reduce([self.complete, *kept])

    @cached_property
    def unit_name(self) -> str:
        """What makes surveys alike that have it in common: the sample, or the seed where there are more seeds."""
        n_samples, n_seeds = (len(np.unique(self.numbers(name))) for name in ("sample", "seed"))
        return "sample" if n_samples >= n_seeds else "seed"

    @cached_property
    def units(self) -> Array:
        """The unit of each survey."""
        return self.numbers(self.unit_name)

    @cached_property
    def share(self) -> Interval:
        """Share of those that ended which passed."""
        return statistics.share(self.passed[self.ended], self.units[self.ended])

    @property
    def missed(self) -> bool:
        """Whether fewer surveys pass than required; a study that seeks where they do misses nothing."""
        wanted = self.required_share if self.study.seek is None else None
        return wanted is not None and not self.share.value >= wanted

    def key_numbers(self, key: str) -> Array | None:
        """The values of a key; None where they are not numbers."""
        column = self.rows[f"vary.{key}"]
        if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
            return self.numbers(f"vary.{key}")
        return None

    def key_groups(self, key: str, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], list[str]]:
        """The group of each chosen survey by a key, and the names of the groups."""
        values = self.key_numbers(key)
        if values is None:
            names, index = np.unique(self._texts(f"vary.{key}")[chosen].astype(str), return_inverse=True)
            return index, [str(name) for name in names]
        groups = statistics.groups_of(values[chosen])
        return groups, [_span(values[chosen][groups == k]) for k in np.unique(groups)]

    @cached_property
    def levels(self) -> list[Level]:
        """Median of each metric, and what 95 % of surveys keep."""
        return [self._level(name) for name in self.metrics]

    def _level(self, name: str) -> Level:
        values, chosen = self.numbers(name), self.counted(name)
        data, units = values[chosen], self.units[chosen]
        worst = 5.0 if more_is_better(name) else 95.0
        return Level(
            name,
            len(data),
            statistics.bootstrap(data, statistics.median, units),
            statistics.bootstrap(data, lambda v: statistics.percentile(v, worst), units),
            self.limits.get(name),
        )

    @cached_property
    def influences(self) -> list[Influence]:
        """Of each metric and key, those that matter most first."""
        found = [self._influence(key, metric) for metric in self.metrics for key in self.keys]
        order = {metric: k for k, metric in enumerate(self.metrics)}
        return sorted(found, key=lambda f: (order[f.metric], -_size(f)))

    def _influence(self, key: str, metric: str) -> Influence:
        y, chosen = self.numbers(metric), self.counted(metric)
        x = self.key_numbers(key)
        nothing = Interval(np.nan, np.nan, np.nan)
        correlation = nothing if x is None else statistics.rank_correlation(x[chosen], y[chosen])
        groups, _ = self.key_groups(key, chosen)
        return Influence(key, metric, correlation, statistics.explained(groups, y[chosen]))

    @cached_property
    def sobol(self) -> dict[str, dict[str, SobolIndex]]:
        """By metric and axis, where the design allows it: a Saltelli design of which every survey ended complete."""
        axes = axes_of(self.study)
        whole = self.study.sampling.method == "saltelli" and self.rows.num_rows > 0 and len(axes) > 1
        if not whole or len(np.unique(self.numbers("sample"))) != (self.study.sampling.samples or 0) * (len(axes) + 2):
            return {}
        means = {metric: self._mean_of_samples(metric) for metric in self.metrics}
        return {
            metric: dict(zip(axes, statistics.sobol_indices(y, len(axes)), strict=True))
            for metric, y in means.items()
            if np.isfinite(y).all() and np.ptp(y) > 0
        }

    def _mean_of_samples(self, metric: str) -> Array:
        """Mean over the seeds of each sample; NaN where one did not end complete."""
        values = np.where(self.complete, self.numbers(metric), np.nan)
        sample = self.numbers("sample").astype(np.int64)
        return np.bincount(sample, values) / np.bincount(sample)

    @cached_property
    def sought(self) -> tuple[Interval, bool] | None:
        """How far the key that is sought may go, and whether it is a least rather than a greatest value."""
        key = self.study.seek
        x = self.key_numbers(key) if key is not None and key in self.keys else None
        if x is None or self.required_share is None or not self.ended.any():
            return None
        x, passed, units = x[self.ended], self.passed[self.ended], self.units[self.ended]
        rising = bool(statistics.how_often_above(x[passed], x[~passed]) >= 0.5)
        return statistics.threshold(x, passed, self.required_share, rising, units), rising

    @cached_property
    def contrasts(self) -> list[Contrast]:
        """Keys with numbers, those first that tell passed and not passed apart best."""
        found = []
        for key in self.keys:
            x = self.key_numbers(key)
            if x is not None:
                good, bad = x[self.ended & self.passed], x[self.ended & ~self.passed]
                if len(good) and len(bad):
                    above = statistics.how_often_above(bad, good)
                    found.append(Contrast(key, float(np.median(good)), float(np.median(bad)), above))
        return sorted(found, key=lambda c: -abs(c.above - 0.5))

    @cached_property
    def reasons(self) -> list[Reason]:
        """Why surveys did not pass: times and places out of the reasons, the most frequent first."""
        counted: dict[tuple[str, str], int] = {}
        for k in np.flatnonzero(~self.passed):
            said = general(self.reason[k]) or "missed " + " and ".join(self._missed_limits(int(k)))
            counted[self.status[k], said] = counted.get((self.status[k], said), 0) + 1
        found = [Reason(*key, count) for key, count in counted.items()]
        return sorted(found, key=lambda r: (-r.surveys, r.reason))[:_MOST_GROUPS]

    def _missed_limits(self, row: int) -> list[str]:
        return [name for name in self.limits if self.numbers(f"require.{name}.passed")[row] != 1]


def general(reason: str) -> str:
    """A reason without its numbers, so that alike ones count together."""
    return re.sub(r"(?<![\w.])[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "…", reason)


def _size(found: Influence) -> float:
    sizes = [abs(found.correlation.value), found.explained**0.5]
    return max([size for size in sizes if np.isfinite(size)], default=0.0)


def _span(values: Array) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"


def summary(found: Findings, identity: Mapping[str, Any]) -> dict[str, Any]:
    """What `--json` prints: counts, probability and the spread of each metric."""
    probability = _listed(found.share) | {"required": found.required_share}
    metrics = {
        level.name: {
            "surveys": level.surveys,
            "median": _listed(level.median),
            "kept_by_95_percent": _listed(level.bound),
        }
        for level in found.levels
    }
    return dict(identity) | {
        "surveys": len(found.status),
        **{name: int((found.status == name).sum()) for name in ("complete", "aborted", "refused", "failed")},
        "passed": int(found.passed.sum()),
        "probability": probability,
        "missed": found.missed,
        "sought": None if found.sought is None else {"key": found.study.seek, **_listed(found.sought[0])},
        "metrics": metrics,
        "reasons": [reason._asdict() for reason in found.reasons],
    }


def _listed(interval: Interval) -> dict[str, float | None]:
    return {name: float(value) if np.isfinite(value) else None for name, value in interval._asdict().items()}
