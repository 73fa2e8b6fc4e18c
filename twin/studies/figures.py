"""Figures of the study report."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from twin.report.figures import WIDTH_IN, log_axis, to_data_uri
from twin.report.style import COLOURS, FIGURE_STYLE
from twin.report.wording import percent
from twin.studies import statistics
from twin.studies.analysis import MetricSummary, Sensitivity, StudyAnalysis
from twin.studies.statistics import Array, Interval
from twin.studies.wording import metric_name, metric_value

PASSED, NOT_PASSED, LIMIT, POINTS = COLOURS["final"], COLOURS["f2f"], COLOURS["limit"], COLOURS["link"]
_MAX_POINTS = 3000


def draw_all(analysis: StudyAnalysis) -> dict[str, str]:
    """Returns the figures for which the study has data, as a dictionary from figure name to data URI."""
    drawings: dict[str, Callable[[], Figure | None]] = {
        "pass_probability": lambda: pass_probability(analysis),
        "histograms": lambda: metric_histograms(analysis, analysis.metric_summaries),
        "sensitivity": lambda: sensitivity(analysis.sensitivities),
        "key_histograms": lambda: key_histograms(analysis),
    } | {f"metric.{metric}": lambda metric=metric: metric_by_key(analysis, metric) for metric in analysis.metrics}
    with matplotlib.rc_context(FIGURE_STYLE):
        figures = {name: draw() for name, draw in drawings.items()}
        return {name: to_data_uri(figure) for name, figure in figures.items() if figure is not None}


def make_panels(count: int, columns: int = 3, row_in: float = 2.7) -> tuple[Figure, list[Axes]]:
    """Returns a figure and its `count` axes, in rows of at most `columns`; by default, four axes form a square."""
    columns = 2 if count == 4 and columns == 3 else min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDTH_IN if columns > 1 else WIDTH_IN * 0.62, row_in * rows))
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]


def pass_probability(analysis: StudyAnalysis) -> Figure | None:
    """Plots the pass probability against each varied key; returns None if no key varies or no survey was evaluated."""
    if not analysis.keys or not analysis.evaluated.any():
        return None
    figure, panels = make_panels(len(analysis.keys))
    rows = np.flatnonzero(analysis.counted)
    for key, axes in zip(analysis.keys, panels, strict=True):
        groups, names = analysis.key_groups(key, analysis.counted)
        proportions = [analysis.proportion(rows[groups == k]) for k in np.unique(groups)]
        x = _key_axis(axes, analysis.key_numbers(key), analysis.counted, groups, names)
        _error_bars(axes, x, proportions, COLOURS["online"])
        axes.axhline(analysis.pass_probability.value, color=COLOURS["reference"], linestyle="--", linewidth=1)
        _shade_answers(axes, analysis, key)
        axes.set(ylim=(-0.03, 1.03), xlabel=key)
        axes.yaxis.set_major_formatter(lambda value, _: percent(value))
    panels[0].set_ylabel("pass probability")
    return figure


def _shade_answers(axes: Axes, analysis: StudyAnalysis, key: str) -> None:
    """Shades the ranges of a key that reach the required pass probability (green) or miss it (orange).

    The required pass probability is drawn as a horizontal line.
    """
    answers = analysis.answers.get(key, [])
    if answers:
        axes.axhline(analysis.required_probability or 0.0, color=LIMIT, linestyle=":", linewidth=1)
    for k, answer in enumerate(answers):
        if answer.verdict != "undecided":
            colour = PASSED if answer.verdict == "passes" else NOT_PASSED
            low, high = (answer.low, answer.high) if np.isfinite(answer.low) else (float(k), float(k))
            axes.axvspan(low, high, color=colour, alpha=0.18, linewidth=6 if low == high else 0)


def _key_axis(axes: Axes, values: Array | None, chosen: NDArray[np.bool_], groups: NDArray, names: list[str]) -> Array:
    """Formats the x axis for a key and returns the x position of each group of surveys.

    The position is the median of the key within the group, or the index of the group if the key is text.

    Args:
        axes: axes to format.
        values: values of the key; None if it is text.
        chosen: (n,) mask of the surveys shown.
        groups: group index of each chosen survey.
        names: names of the groups.
    """
    if values is None:
        rotation = 25 if max(len(name) for name in names) > 8 else 0
        axes.set_xticks(range(len(names)), names, rotation=rotation)
        axes.set_xlim(-0.5, len(names) - 0.5)
        return np.arange(len(names), dtype=float)
    if spans_decades(values):
        log_axis(axes.xaxis)
    else:
        axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlim(*_axis_range(values[chosen], spans_decades(values)))
    return np.array([np.median(values[chosen][groups == k]) for k in np.unique(groups)])


def _axis_range(values: Array, log: bool) -> tuple[float, float]:
    """Returns the limits of an axis, logarithmic or linear, that shows the values with a margin."""
    low, high = float(values.min()), float(values.max())
    if log:
        return low / 1.15, high * 1.15
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def spans_decades(values: Array) -> bool:
    """Returns whether a logarithmic axis suits the values: all are positive, and largest / smallest exceeds 8."""
    return bool(values.min(initial=np.inf) > 0 and values.max(initial=0) > 8 * values.min(initial=np.inf))


def _error_bars(axes: Axes, x: Array, intervals: list[Interval], colour: str) -> None:
    y = np.array([i.value for i in intervals])
    bars = np.array([[i.value - i.low, i.high - i.value] for i in intervals]).T
    bars = np.where(np.isfinite(bars), np.maximum(bars, 0), 0)
    axes.errorbar(x, y, bars, fmt="o-", color=colour, markersize=4, capsize=2.5, linewidth=1.2, zorder=4)


def metric_histograms(analysis: StudyAnalysis, summaries: list[MetricSummary]) -> Figure | None:
    """Plots the histogram of each metric with its median, its 95th (or 5th) percentile and its limit.

    Returns None if no metric has values of two or more surveys.
    """
    summaries = [summary for summary in summaries if summary.surveys > 1]
    if not summaries:
        return None
    figure, panels = make_panels(len(summaries))
    for summary, axes in zip(summaries, panels, strict=True):
        values = analysis.numbers(summary.name)
        values = values[analysis.included(summary.name)]
        log = spans_decades(values)
        edges = _bin_edges(values, log)
        axes.hist(values, list(edges), color=COLOURS["online"], alpha=0.75)
        if log:
            log_axis(axes.xaxis)
        else:
            axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        if np.isfinite(summary.median.low):
            axes.axvspan(summary.median.low, summary.median.high, color=PASSED, alpha=0.25, linewidth=0)
        axes.axvline(summary.median.value, color=PASSED, label="median")
        axes.axvline(summary.bound.value, color=NOT_PASSED, linestyle=":", label="95 % bound")
        if summary.limit is not None:
            axes.axvline(summary.limit, color=LIMIT, linestyle="--", label="limit")
        unit_axis(axes.xaxis, summary.name)
        axes.set_xlabel(axis_label(summary.name))
    panels[0].set_ylabel("surveys")
    panels[0].legend(fontsize=8)
    return figure


def _bin_edges(values: Array, log: bool) -> Array:
    count = int(np.clip(2 * len(values) ** (1 / 3), 5, 40))
    low, high = float(values.min()), float(values.max())
    if log:
        return np.geomspace(low, high, count + 1)
    return np.linspace(low, high if high > low else low + 1e-9 + abs(low) * 1e-3, count + 1)


def axis_label(metric: str) -> str:
    """Returns the name of a metric, wrapped to the width of one plot."""
    return textwrap.fill(metric_name(metric), 26)


def unit_axis(axis: Any, metric: str) -> None:
    """Formats the ticks of an axis in the unit of the metric."""
    axis.set_major_formatter(lambda value, _: metric_value(metric, value))
    axis.set_tick_params(labelsize=8)


def metric_by_key(analysis: StudyAnalysis, metric: str) -> Figure | None:
    """Plots a metric against each varied key: each survey as a dot, group medians with confidence intervals.

    Returns None if no key varies, or if fewer than two surveys have a value.
    """
    y, included = analysis.numbers(metric), analysis.included(metric)
    if not analysis.keys or included.sum() < 2:
        return None
    figure, panels = make_panels(len(analysis.keys))
    for key, axes in zip(analysis.keys, panels, strict=True):
        values = analysis.key_numbers(key)
        groups, names = analysis.key_groups(key, included)
        group_x = _key_axis(axes, values, included, groups, names)
        jitter = np.random.default_rng(0)
        x = groups + jitter.uniform(-0.15, 0.15, len(groups)) if values is None else values[included]
        _dots(axes, x, y[included], analysis.passed[included], jitter)
        clusters = analysis.clusters[included]
        medians = [
            statistics.bootstrap_interval(y[included][groups == k], statistics.median, clusters[groups == k])
            for k in np.unique(groups)
        ]
        _error_bars(axes, group_x, medians, COLOURS["online"])
        if (limit := analysis.limits.get(metric)) is not None:
            axes.axhline(limit, color=LIMIT, linestyle="--", linewidth=1)
        if spans_decades(y[included]):
            log_axis(axes.yaxis)
        unit_axis(axes.yaxis, metric)
        axes.set_xlabel(key)
    return figure


def _dots(axes: Axes, x: Array, y: Array, passed: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Plots surveys as dots whose colour shows whether they passed; of more than 3000, a random subset of 3000."""
    shown = rng.permutation(len(x))[:_MAX_POINTS]
    for mask, colour in ((passed, POINTS), (~passed, NOT_PASSED)):
        subset = shown[mask[shown]]
        axes.plot(x[subset], y[subset], ".", color=colour, markersize=3.5, alpha=0.55, zorder=2)


def sensitivity(sensitivities: list[Sensitivity]) -> Figure | None:
    """Plots the rank correlation of each metric with each numeric key, with its confidence interval.

    Returns None if no correlation is defined.
    """
    shown = [s for s in sensitivities if np.isfinite(s.correlation.value)]
    metrics = list(dict.fromkeys(s.metric for s in shown))
    if not shown:
        return None
    keys = list(dict.fromkeys(s.key for s in shown))
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
        axes.set_yticks([-k for k in range(len(keys))], keys if axes.get_position().x0 == left else [])
    return figure


def key_histograms(analysis: StudyAnalysis) -> Figure | None:
    """Plots a stacked histogram of each numeric key: surveys that passed, and surveys that did not pass.

    Returns None if no key is numeric or one of the two sets is empty.
    """
    good, bad = analysis.evaluated & analysis.passed, analysis.evaluated & ~analysis.passed
    keys = [key for key in analysis.keys if analysis.key_numbers(key) is not None]
    if not keys or not good.any() or not bad.any():
        return None
    figure, panels = make_panels(len(keys))
    for key, axes in zip(keys, panels, strict=True):
        values = analysis.key_numbers(key)
        assert values is not None
        log = spans_decades(values[analysis.evaluated])
        edges = _bin_edges(values[analysis.evaluated], log)
        both, colours = [values[good], values[bad]], [PASSED, NOT_PASSED]
        axes.hist(both, list(edges), stacked=True, color=colours, label=["passed", "not passed"], alpha=0.85)
        if log:
            log_axis(axes.xaxis)
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set_xlabel(key)
    panels[0].set_ylabel("surveys")
    panels[0].legend(fontsize=8)
    return figure
