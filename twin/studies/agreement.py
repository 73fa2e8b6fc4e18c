"""Agreement of surrogate surveys with rendered surveys of the same scenarios and seeds, compared with limits.

Each rendered survey is paired with the surrogate survey that has the same seed and the same values of all varied keys
other than `imaging.fidelity`.
"""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from twin.judge.map_error import INFINITE_WITH_HOLES
from twin.report.figures import log_axis
from twin.report.style import COLOURS, FIGURE_STYLE
from twin.report.wording import percent, plain
from twin.studies import wording
from twin.studies.analysis import StudyAnalysis
from twin.studies.figures import make_panels
from twin.studies.statistics import LEVEL, RESAMPLES, Array, Interval, wilson_interval
from twin.studies.study_file import n_planned_surveys

FIDELITY = "imaging.fidelity"
MEDIAN_LIMIT = 0.2  #: largest amount by which the ratio of medians, or its inverse, may exceed 1
P_LIMIT = 0.01  #: smallest p-value of the Kolmogorov-Smirnov test
PASS_LIMIT = 0.9  #: smallest fraction of pairs with the same verdict
_FLOWN = ("complete", "degraded")  # statuses of a survey that was flown to its end


class MetricAgreement(NamedTuple):
    """Comparison of one metric over the pairs in which both surveys were flown to their end.

    If `pairs` is 0, all other numbers are NaN.
    """

    metric: str  #: dotted name of the metric
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
        """Returns whether the ratio of medians and the p-value are within their limits."""
        within = 1 / (1 + MEDIAN_LIMIT) <= self.ratio.value <= 1 + MEDIAN_LIMIT
        return bool(within and self.p_value >= P_LIMIT)


class Agreement(NamedTuple):
    """Agreement of all pairs of a study."""

    pairs: int  #: number of pairs in which both surveys have a result
    metrics: list[MetricAgreement]  #: comparison of each metric
    #: fraction of the pairs in which both surveys pass or both do not pass, with its confidence interval
    verdicts: Interval
    only_rendered: int  #: number of pairs in which only the rendered survey passes
    only_surrogate: int  #: number of pairs in which only the surrogate survey passes

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


HEADER = ("metric", "pairs", "rendered", "surrogate", "surrogate / rendered", "KS p", "verdict")
LIMITS = (
    f"Limits: medians within {percent(MEDIAN_LIMIT)} of each other, p of the two-sample Kolmogorov-Smirnov "
    f"test at least {percent(P_LIMIT)}, the same verdict in at least {percent(PASS_LIMIT)} of the "
    "pairs. In brackets: 95 % intervals, from a bootstrap of pairs and by Wilson's method."
)


def table(result: Agreement) -> list[tuple[str, ...]]:
    """Returns the rows of the table, one row per metric, with the columns `HEADER`."""
    return [_row(metric) for metric in result.metrics]


def verdict_line(result: Agreement) -> str:
    """Returns a sentence with the verdict and the fraction of the pairs whose surveys have the same verdict."""
    return (
        f"{'PASS' if result.agrees else 'FAIL'}: {result.pairs} pairs; both surveys pass or both do not pass in "
        f"{wording.percent_interval(result.verdicts)} of them ({_verdict(result.verdicts_agree)}; only the rendered "
        f"survey passes in {result.only_rendered}, only the surrogate survey in {result.only_surrogate})."
    )


def figure(analysis: StudyAnalysis) -> Figure:
    """Returns the figure: one plot per compared metric, with the surrogate values against the rendered ones.

    To be called, and saved, with `FIGURE_STYLE`.
    """
    drawing, panels = make_panels(len(analysis.study.compare), columns=3)
    for metric, axes in zip(analysis.study.compare, panels, strict=True):
        _draw_pairs(axes, metric, *values_of_pairs(analysis, metric))
    return drawing


def write_document(analysis: StudyAnalysis, folder: Path) -> None:
    """Writes agreement.md, with the command and the table, and its figure agreement.png to a folder.

    Writes nothing if the study compares no metrics or no pair of surveys has two results.
    """
    result = agreement(analysis)
    if result is None:
        return
    with matplotlib.rc_context(FIGURE_STYLE):
        figure(analysis).savefig(folder / "agreement.png", bbox_inches="tight")
    (folder / "agreement.md").write_text(_markdown(analysis, result), encoding="utf-8")


def _markdown(analysis: StudyAnalysis, result: Agreement) -> str:
    study = analysis.study
    lines = [
        "# Agreement of surrogate with rendered surveys", "",
        f"`twin study {study.name}` flies {n_planned_surveys(study) // 2} pairs of surveys, each rendered and with the "
        "surrogate, and writes this page and its figure to the results folder; `make agreement` copies them here. "
        f"Requirements of a survey: {_requirements(study.limits)}.", "",
        verdict_line(result), "", *_markdown_table(result), "", LIMITS, "",
        "![Surrogate against rendered values](agreement.png)", "",
        "Each dot is a pair with the same scenario and seed. Values at the upper or right edge are infinite.",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _markdown_table(result: Agreement) -> list[str]:
    rows = [HEADER, ("---",) * len(HEADER), *table(result)]
    return [f"| {' | '.join(row)} |" for row in rows]


def _requirements(limits: dict[str, float]) -> str:
    return ", ".join(f"{wording.metric_name(name)} {wording.metric_value(name, v)}" for name, v in limits.items())


def _row(metric: MetricAgreement) -> tuple[str, ...]:
    ratio = metric.ratio
    return (
        wording.metric_name(metric.metric),
        str(metric.pairs),
        _value(metric.metric, metric.rendered),
        _value(metric.metric, metric.surrogate),
        f"{ratio.value:.2f} ({ratio.low:.2f} to {ratio.high:.2f})",
        f"{metric.p_value:.3f}",
        _verdict(metric.agrees),
    )


def _value(metric: str, value: float) -> str:
    if np.isinf(value):
        return "infinite"
    return wording.metric_value(metric, value) if metric.endswith("_m") else plain(value)


def _verdict(agrees: bool) -> str:
    return "agrees" if agrees else "does not agree"


def _draw_pairs(axes: Axes, metric: str, rendered: Array, surrogate: Array) -> None:
    """Plots surrogate against rendered values (n,), with the line of equal values and the limits on the medians."""
    finite = np.concatenate([rendered[np.isfinite(rendered)], surrogate[np.isfinite(surrogate)]])
    if len(finite) == 0:
        return
    low, high = float(finite.min()), float(finite.max())
    logarithmic = low > 0 and high > 5 * low
    edge = high * 1.3 if logarithmic else high + 0.05 * ((high - low) or 1.0)
    start = low / 1.3 if logarithmic else low - 0.05 * ((high - low) or 1.0)
    line, limit = np.linspace(start, edge, 50), 1 + MEDIAN_LIMIT
    axes.fill_between(line, line / limit, line * limit, color=COLOURS["reference"], alpha=0.25, linewidth=0)
    axes.plot(line, line, color=COLOURS["reference"])
    x, y = (np.minimum(values, edge) for values in (rendered, surrogate))
    axes.plot(x, y, "o", markersize=3.5, color=COLOURS["online"], alpha=0.7)
    if logarithmic:
        log_axis(axes.xaxis)
        log_axis(axes.yaxis)
    axes.set(xlim=(start, edge), ylim=(start, edge), xlabel="rendered", ylabel="surrogate")
    axes.set_title(textwrap.fill(wording.metric_name(metric), 30), fontsize=8)
