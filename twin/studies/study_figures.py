"""Figures of the study report."""

import textwrap
from collections.abc import Sequence
from itertools import chain
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from twin.report.number_formats import metric_value, percent
from twin.report.plotting import WIDTH_IN, log_axis, to_data_uri
from twin.report.style import COLOURS, FIGURE_STYLE
from twin.report.words import label, words
from twin.studies import agreement, statistics
from twin.studies.analysis import Mask, MetricSummary, Sensitivity, StudyAnalysis
from twin.studies.answers import KeyRegression
from twin.studies.statistics import Array

PASSED, NOT_PASSED, LIMIT, POINTS = COLOURS["final"], COLOURS["f2f"], COLOURS["limit"], COLOURS["link"]
_MAX_POINTS = 3000
_LONGEST_LABEL = 20  # characters


def draw_all(analysis: StudyAnalysis, compared: bool) -> dict[str, str]:
    """Returns {name: data URI} of the figures for which the study has data; `compared`: it has pairs of surveys."""
    with matplotlib.rc_context(FIGURE_STYLE):
        drawn = {
            "pass_probability": pass_probability(analysis),
            "passing_map": passing_map(analysis),
            "histograms": metric_histograms(analysis, analysis.metric_summaries),
            "sensitivity": sensitivity(analysis.sensitivities),
            "key_histograms": key_histograms(analysis),
            **{f"metric.{metric}": metric_by_key(analysis, metric) for metric in analysis.metrics},
            "agreement": agreement_of_pairs(analysis) if compared else None,
        }
        return {name: to_data_uri(figure) for name, figure in drawn.items() if figure is not None}


# The functions that draw a figure return None without data for it.


def make_panels(count: int, columns: int = 3, row_in: float = 2.7) -> tuple[Figure, list[Axes]]:
    """Returns a figure and its axes, in rows of at most `columns`; by default, four form a square."""
    columns = 2 if count == 4 and columns == 3 else min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDTH_IN if columns > 1 else WIDTH_IN * 0.62, row_in * rows))
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]


def value_axis(axis: Any, values: Array, ticks: int | None = None) -> bool:
    """Makes an axis logarithmic, and returns True, if all values are positive and span more than a factor of 8."""
    is_log = bool(values.min(initial=np.inf) > 0 and values.max(initial=0) > 8 * values.min(initial=np.inf))
    if is_log:
        log_axis(axis)
    elif ticks:
        axis.set_major_locator(MaxNLocator(ticks))
    return is_log


def metric_axis(axis: Any, metric: str) -> None:
    axis.set_major_formatter(lambda value, _: metric_value(metric, value))
    axis.set_tick_params(labelsize=8)


def axis_label(metric: str) -> str:
    return textwrap.fill(words(metric), 26)


def key_label(key: str) -> str:
    return textwrap.fill(label(key), 26)


def pass_probability(analysis: StudyAnalysis) -> Figure | None:
    if not analysis.keys or not analysis.evaluated.any():
        return None
    figure, panels = make_panels(len(analysis.keys))
    rows = np.flatnonzero(analysis.counted)
    for key, axes in zip(analysis.keys, panels, strict=True):
        groups, x = _grouped(axes, analysis, key, analysis.counted)
        if key in analysis.regressions:
            _draw_regression(axes, analysis.regressions[key])
        else:
            _error_bars(axes, x, [analysis.proportion(rows[groups == k])[:3] for k in np.unique(groups)], line="")
        _shade_answers(axes, analysis, key)
        axes.set(ylim=(-0.03, 1.03), xlabel=key_label(key))
        axes.yaxis.set_major_formatter(lambda value, _: percent(value))
    panels[0].set_ylabel("pass probability")
    return figure


def _draw_regression(axes: Axes, regression: KeyRegression) -> None:
    """Plots surveys at 0, 1/2 (unknown) and 1, and the regression, twice (at worst, at best) if any is unknown."""
    x, record = regression.x, regression.record
    axes.axhline(float(record.passed.mean()), color=COLOURS["reference"], linestyle="--", linewidth=1)
    for _, curve in chain(*regression.worst[:1], *regression.best[-1:]):
        axes.plot(curve.values, curve.fraction, color=COLOURS["online"], linewidth=1.4, drawstyle="steps-mid")
    results = (record.results(worst=True), PASSED, 1.0), (record.unknown, POINTS, 0.5)
    for chosen, colour, y in (*results, (~record.results(worst=False), NOT_PASSED, 0.0)):
        inside = x[np.broadcast_to(chosen, x.shape)]
        axes.plot(inside, np.full(len(inside), y), "|", color=colour, markersize=7, alpha=0.6)


def passing_map(analysis: StudyAnalysis) -> Figure | None:
    """Plots where the required fraction passes over the two most influential keys: cells, and surveys as dots."""
    found, required = analysis.passing_map, analysis.required_probability
    if found is None or required is None:
        return None
    figure, (axes,) = make_panels(1, row_in=4.0)
    colours = ListedColormap([NOT_PASSED, "white", PASSED])
    axes.pcolormesh(*found.edges, found.verdicts(required).T, cmap=colours, vmin=-1, vmax=1, alpha=0.35)
    x, y = (analysis.numbers(f"vary.{key}")[analysis.counted] for key in found.keys)
    record = analysis.pass_record
    _dots(axes, x, y, record.passed, np.random.default_rng(0))
    axes.plot(x[record.unknown], y[record.unknown], "x", color=COLOURS["truth"], markersize=3.5)
    for axis, edges in zip((axes.xaxis, axes.yaxis), found.edges, strict=True):
        value_axis(axis, edges, ticks=6)
    axes.set(xlabel=key_label(found.keys[0]), ylabel=key_label(found.keys[1]))
    return figure


def _shade_answers(axes: Axes, analysis: StudyAnalysis, key: str) -> None:
    """Shades the ranges of a key that reach the required pass probability (green) or miss it (orange)."""
    answers = analysis.answers.get(key, [])
    if answers:
        axes.axhline(analysis.required_probability or 0.0, color=LIMIT, linestyle=":", linewidth=1)
    for k, answer in enumerate(answers):
        if answer.verdict != "undecided":
            colour = PASSED if answer.verdict == "passes" else NOT_PASSED
            low, high = (answer.low, answer.high) if np.isfinite(answer.low) else (float(k), float(k))
            axes.axvspan(low, high, color=colour, alpha=0.18, linewidth=6 if low == high else 0)


def _short(value: str) -> str:
    """Returns the label of a value: of a file its name, of a long text its beginning."""
    name = value.rpartition("/")[2]
    return name if len(name) <= _LONGEST_LABEL else f"{name[: _LONGEST_LABEL - 1]}…"


def _grouped(axes: Axes, analysis: StudyAnalysis, key: str, chosen: Mask) -> tuple[NDArray[np.int64], Array]:
    """Formats the x axis for a key; returns the group of each chosen survey and the x position of each group."""
    values, (groups, names) = analysis.key_numbers(key), analysis.key_groups(key, chosen)
    if values is None:
        short = [_short(name) for name in names]
        axes.set_xticks(range(len(names)), short, rotation=25 if max(len(name) for name in short) > 8 else 0)
        axes.set_xlim(-0.5, len(names) - 0.5)
        return groups, np.arange(len(names), dtype=float)
    is_log = value_axis(axes.xaxis, values, ticks=6)
    low, high = float(values[chosen].min()), float(values[chosen].max())
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    axes.set_xlim(*((low / 1.15, high * 1.15) if is_log else (low - margin, high + margin)))
    return groups, np.array([np.median(values[chosen][groups == k]) for k in np.unique(groups)])


def _error_bars(axes: Axes, x: Array, intervals: Sequence[tuple[float, ...]], line: str = "-") -> None:
    y, low, high = np.array(intervals).T
    bars = np.array([y - low, high - y])
    bars = np.where(np.isfinite(bars), np.maximum(bars, 0), 0)
    axes.errorbar(
        x, y, bars, fmt=f"o{line}", color=COLOURS["online"], markersize=4, capsize=2.5, linewidth=1.2, zorder=4
    )


def metric_histograms(analysis: StudyAnalysis, summaries: list[MetricSummary]) -> Figure | None:
    """Plots the histogram of each metric with two or more values, its median, 95 % bound and limit."""
    summaries = [summary for summary in summaries if summary.surveys > 1]
    if not summaries:
        return None
    figure, panels = make_panels(len(summaries))
    for summary, axes in zip(summaries, panels, strict=True):
        values = analysis.numbers(summary.name)[analysis.included(summary.name)]
        _histogram(axes, [values], values, ticks=4, color=COLOURS["online"], alpha=0.75)
        if np.isfinite([summary.median.low, summary.median.high]).all():
            axes.axvspan(summary.median.low, summary.median.high, color=PASSED, alpha=0.25, linewidth=0)
        axes.axvline(summary.median.value, color=PASSED, label="median")
        axes.axvline(summary.bound.value, color=NOT_PASSED, linestyle=":", label="95 % bound")
        if summary.limit is not None:
            axes.axvline(summary.limit, color=LIMIT, linestyle="--", label="limit")
        metric_axis(axes.xaxis, summary.name)
        axes.set_xlabel(axis_label(summary.name))
    panels[0].set_ylabel("surveys")
    panels[0].legend(fontsize=8)
    return figure


def _histogram(axes: Axes, samples: list[Array], values: Array, ticks: int | None = None, **style: Any) -> None:
    is_log = value_axis(axes.xaxis, values, ticks)
    count = int(np.clip(2 * len(values) ** (1 / 3), 5, 40))
    low, high = float(values.min()), float(values.max())
    high = high if high > low else low + 1e-9 + abs(low) * 1e-3
    edges = np.geomspace(low, high, count + 1) if is_log else np.linspace(low, high, count + 1)
    axes.hist(samples, list(edges), stacked=True, **style)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))


def metric_by_key(analysis: StudyAnalysis, metric: str) -> Figure | None:
    """Plots a metric against each varied key: each survey as a dot, group medians with confidence intervals."""
    y, included = analysis.numbers(metric), analysis.included(metric)
    if not analysis.keys or included.sum() < 2:
        return None
    figure, panels = make_panels(len(analysis.keys))
    y, clusters = y[included], analysis.clusters[included]
    for key, axes in zip(analysis.keys, panels, strict=True):
        values, jitter = analysis.key_numbers(key), np.random.default_rng(0)
        groups, group_x = _grouped(axes, analysis, key, included)
        x = groups + jitter.uniform(-0.15, 0.15, len(groups)) if values is None else values[included]
        _dots(axes, x, y, analysis.passed[included], jitter)
        of_groups = (groups == k for k in np.unique(groups))
        medians = [statistics.bootstrap_interval(y[one], statistics.median, clusters[one]) for one in of_groups]
        _error_bars(axes, group_x, medians)
        if (limit := analysis.limits.get(metric)) is not None:
            axes.axhline(limit, color=LIMIT, linestyle="--", linewidth=1)
        value_axis(axes.yaxis, y)
        metric_axis(axes.yaxis, metric)
        axes.set_xlabel(key_label(key))
    return figure


def _dots(axes: Axes, x: Array, y: Array, passed: Mask, rng: np.random.Generator) -> None:
    """Plots surveys, of more than 3000 a random subset, as dots whose colour shows whether they passed."""
    shown = rng.permutation(len(x))[:_MAX_POINTS]
    for mask, colour in ((passed, POINTS), (~passed, NOT_PASSED)):
        subset = shown[mask[shown]]
        axes.plot(x[subset], y[subset], ".", color=colour, markersize=3.5, alpha=0.55, zorder=2)


def sensitivity(sensitivities: list[Sensitivity]) -> Figure | None:
    shown = [s for s in sensitivities if np.isfinite(s.correlation.value)]
    metrics, keys = list(dict.fromkeys(s.metric for s in shown)), list(dict.fromkeys(s.key for s in shown))
    if not shown:
        return None
    figure, panels = make_panels(len(metrics), row_in=0.9 + 0.36 * len(keys))
    left = panels[0].get_position().x0
    for metric, axes in zip(metrics, panels, strict=True):
        for s in (s for s in shown if s.metric == metric):
            y, r = -keys.index(s.key), s.correlation
            axes.barh(y, r.value, 0.6, color=NOT_PASSED if r.value > 0 else COLOURS["online"], alpha=0.8)
            axes.plot([r.low, r.high], [y, y], color=COLOURS["truth"], linewidth=1.2)
        axes.axvline(0, color=COLOURS["truth"], linewidth=0.8)
        axes.set(xlim=(-1.05, 1.05), ylim=(0.6 - len(keys), 0.6), xlabel="rank correlation")
        axes.set_title(axis_label(metric), fontsize=9)
        axes.grid(visible=False, axis="y")
        names = [axis_label(key) for key in keys]
        axes.set_yticks([-k for k in range(len(keys))], names if axes.get_position().x0 == left else [])
    return figure


def key_histograms(analysis: StudyAnalysis) -> Figure | None:
    """Plots a stacked histogram of each numeric key: surveys that passed, and that did not."""
    good, bad = analysis.evaluated & analysis.passed, analysis.evaluated & ~analysis.passed
    numeric = {key: x for key in analysis.keys if (x := analysis.key_numbers(key)) is not None}
    if not numeric or not good.any() or not bad.any():
        return None
    figure, panels = make_panels(len(numeric))
    style = {"color": [PASSED, NOT_PASSED], "label": ["passed", "not passed"], "alpha": 0.85}
    for (key, x), axes in zip(numeric.items(), panels, strict=True):
        _histogram(axes, [x[good], x[bad]], x[analysis.evaluated], **style)
        axes.set_xlabel(key_label(key))
    panels[0].set_ylabel("surveys")
    panels[0].legend(fontsize=8)
    return figure


def agreement_of_pairs(analysis: StudyAnalysis) -> Figure:
    figure, panels = make_panels(len(analysis.study.compare))
    for metric, axes in zip(analysis.study.compare, panels, strict=True):
        _draw_pairs(axes, *agreement.values_of_pairs(analysis, metric))
        if axes.lines:
            axes.set_title(textwrap.fill(words(metric), 30), fontsize=8)
    return figure


def _draw_pairs(axes: Axes, rendered: Array, surrogate: Array) -> None:
    """Plots surrogate against rendered values (n,), with the line of equal values and the limits on the medians."""
    finite = np.concatenate([rendered, surrogate])
    finite = finite[np.isfinite(finite)]
    if len(finite) == 0:
        return
    low, high = float(finite.min()), float(finite.max())
    logarithmic = low > 0 and high > 5 * low
    margin = 0.05 * ((high - low) or 1.0)
    start, edge = (low / 1.3, high * 1.3) if logarithmic else (low - margin, high + margin)
    line, limit = np.linspace(start, edge, 50), 1 + agreement.MEDIAN_LIMIT
    axes.fill_between(line, line / limit, line * limit, color=COLOURS["reference"], alpha=0.25, linewidth=0)
    axes.plot(line, line, color=COLOURS["reference"])
    x, y = (np.minimum(values, edge) for values in (rendered, surrogate))
    axes.plot(x, y, "o", markersize=3.5, color=COLOURS["online"], alpha=0.7)
    for axis in (axes.xaxis, axes.yaxis) if logarithmic else ():
        log_axis(axis)
    axes.set(xlim=(start, edge), ylim=(start, edge), xlabel="rendered", ylabel="surrogate")
