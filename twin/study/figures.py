"""The figures of a study's report."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray

from twin.report.figures import WIDTH_IN, to_data_uri
from twin.report.style import COLOURS, FIGURE_STYLE
from twin.study import statistics
from twin.study.findings import Findings, Influence, Level
from twin.study.statistics import Array, Interval
from twin.study.wording import name_of, percent, value_of

GOOD, BAD, LIMIT, POINTS = COLOURS["final"], COLOURS["f2f"], COLOURS["limit"], COLOURS["link"]
_MOST_POINTS = 3000
_ROW_IN = 2.7


def draw_all(found: Findings) -> dict[str, str]:
    """Every figure that the study has the data for, as data URIs by name."""
    drawings: dict[str, Callable[[], Figure | None]] = {
        "passing": lambda: passing(found),
        "levels": lambda: distributions(found, found.levels),
        "sensitivity": lambda: sensitivity(found.influences),
        "contrast": lambda: contrast(found),
    } | {f"curves.{metric}": lambda metric=metric: curves(found, metric) for metric in found.metrics}
    with matplotlib.rc_context(FIGURE_STYLE):
        figures = {name: draw() for name, draw in drawings.items()}
        return {name: to_data_uri(figure) for name, figure in figures.items() if figure is not None}


def make_panels(count: int, columns: int = 3) -> tuple[Figure, list[Axes]]:
    """Axes in rows of up to `columns`."""
    columns = 2 if count == 4 and columns == 3 else min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDTH_IN if columns > 1 else WIDTH_IN * 0.62, _ROW_IN * rows))
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]


def passing(found: Findings) -> Figure | None:
    """Share of surveys that pass, by each key."""
    if not found.keys or not found.ended.any():
        return None
    figure, panels = make_panels(len(found.keys))
    for key, axes in zip(found.keys, panels, strict=True):
        groups, names = found.key_groups(key, found.ended)
        good, units = found.passed[found.ended], found.units[found.ended]
        shares = [statistics.share(good[groups == k], units[groups == k]) for k in np.unique(groups)]
        _with_bars(axes, _places(axes, found, key, found.ended, groups, names), shares, COLOURS["online"])
        axes.axhline(found.share.value, color=COLOURS["reference"], linestyle="--", linewidth=1)
        if found.sought is not None and key == found.study.seek and np.isfinite(found.sought[0]).all():
            axes.axvline(found.sought[0].value, color=LIMIT, linewidth=1)
            axes.axvspan(found.sought[0].low, found.sought[0].high, color=LIMIT, alpha=0.12, linewidth=0)
        axes.set(ylim=(-0.03, 1.03), xlabel=key)
        axes.yaxis.set_major_formatter(lambda value, _: percent(value))
    panels[0].set_ylabel("surveys that pass")
    return figure


def _places(axes: Axes, found: Findings, key: str, chosen: NDArray[np.bool_], groups: NDArray, names: list[str]):
    """Where each group of a key stands on the x axis: at the median of its numbers, or one after another."""
    values = found.key_numbers(key)
    if values is None:
        turned = 25 if max(len(name) for name in names) > 8 else 0
        axes.set_xticks(range(len(names)), names, rotation=turned)
        axes.set_xlim(-0.5, len(names) - 0.5)
        return np.arange(len(names), dtype=float)
    if spans_decades(values):
        log_axis(axes.xaxis, axes.set_xscale)
    else:
        axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlim(*_around(values[chosen], spans_decades(values)))
    return np.array([np.median(values[chosen][groups == k]) for k in np.unique(groups)])


def _around(values: Array, log: bool) -> tuple[float, float]:
    """Limits of an axis a little beyond the values."""
    low, high = float(values.min()), float(values.max())
    if log:
        return low / 1.15, high * 1.15
    room = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - room, high + room


def spans_decades(values: Array) -> bool:
    return bool(values.min(initial=np.inf) > 0 and values.max(initial=0) > 8 * values.min(initial=np.inf))


def _with_bars(axes: Axes, x: Array, found: list[Interval], colour: str) -> None:
    y = np.array([f.value for f in found])
    ends = np.array([[f.value - f.low, f.high - f.value] for f in found]).T
    ends = np.where(np.isfinite(ends), np.maximum(ends, 0), 0)
    axes.errorbar(x, y, ends, fmt="o-", color=colour, markersize=4, capsize=2.5, linewidth=1.2, zorder=4)


def distributions(found: Findings, levels: list[Level]) -> Figure | None:
    """How a metric is spread over the surveys, with its limit and median."""
    levels = [level for level in levels if level.surveys > 1]
    if not levels:
        return None
    figure, panels = make_panels(len(levels))
    for level, axes in zip(levels, panels, strict=True):
        values = found.numbers(level.name)
        values = values[found.counted(level.name)]
        log = spans_decades(values)
        edges = _edges(values, log)
        axes.hist(values, list(edges), color=COLOURS["online"], alpha=0.75)
        if log:
            log_axis(axes.xaxis, axes.set_xscale)
        else:
            axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        if np.isfinite(level.median.low):
            axes.axvspan(level.median.low, level.median.high, color=GOOD, alpha=0.25, linewidth=0)
        axes.axvline(level.median.value, color=GOOD, label="median")
        axes.axvline(level.bound.value, color=BAD, linestyle=":", label="95 % keep")
        if level.limit is not None:
            axes.axvline(level.limit, color=LIMIT, linestyle="--", label="limit")
        unit_axis(axes.xaxis, level.name)
        axes.set_xlabel(label_of(level.name))
    panels[0].set_ylabel("surveys")
    panels[0].legend(fontsize=8)
    return figure


def _edges(values: Array, log: bool) -> Array:
    count = int(np.clip(2 * len(values) ** (1 / 3), 5, 40))
    low, high = float(values.min()), float(values.max())
    if log:
        return np.geomspace(low, high, count + 1)
    return np.linspace(low, high if high > low else low + 1e-9 + abs(low) * 1e-3, count + 1)


def label_of(metric: str) -> str:
    """A metric's name, in lines that fit beside a panel."""
    return textwrap.fill(name_of(metric), 26)


def unit_axis(axis, metric: str) -> None:
    """Ticks in the metric's unit; few, as they are words."""
    axis.set_major_formatter(lambda value, _: value_of(metric, value))
    axis.set_tick_params(labelsize=8)


def log_axis(axis: Any, set_scale: Callable[[str], None]) -> None:
    """An axis in decades, with labels at 1, 2 and 5."""
    set_scale("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(lambda *_: "")


def curves(found: Findings, metric: str) -> Figure | None:
    """A metric against each key: every survey a dot, and the median of each group with its interval."""
    y, chosen = found.numbers(metric), found.counted(metric)
    if not found.keys or chosen.sum() < 2:
        return None
    figure, panels = make_panels(len(found.keys))
    for key, axes in zip(found.keys, panels, strict=True):
        groups, names = found.key_groups(key, chosen)
        places = _places(axes, found, key, chosen, groups, names)
        _dots(axes, found, key, chosen, groups, y[chosen])
        units = found.units[chosen]
        medians = [
            statistics.bootstrap(y[chosen][groups == k], statistics.median, units[groups == k])
            for k in np.unique(groups)
        ]
        _with_bars(axes, places, medians, COLOURS["online"])
        if (limit := found.limits.get(metric)) is not None:
            axes.axhline(limit, color=LIMIT, linestyle="--", linewidth=1)
        if spans_decades(y[chosen]):
            log_axis(axes.yaxis, axes.set_yscale)
        unit_axis(axes.yaxis, metric)
        axes.set_xlabel(key)
    return figure


def _dots(axes: Axes, found: Findings, key: str, chosen: NDArray[np.bool_], groups: NDArray, y: Array) -> None:
    rng = np.random.default_rng(0)
    values = found.key_numbers(key)
    x = groups + rng.uniform(-0.15, 0.15, len(groups)) if values is None else values[chosen]
    some = rng.permutation(len(x))[:_MOST_POINTS]
    good = found.passed[chosen]
    for kind, colour in ((good, POINTS), (~good, BAD)):
        at = some[kind[some]]
        axes.plot(x[at], y[at], ".", color=colour, markersize=3.5, alpha=0.55, zorder=2)


def sensitivity(influences: list[Influence]) -> Figure | None:
    """Rank correlation of each metric with each key that has numbers, and its interval."""
    shown = [f for f in influences if np.isfinite(f.correlation.value)]
    metrics = list(dict.fromkeys(f.metric for f in shown))
    if not shown:
        return None
    count = max(sum(f.metric == metric for f in shown) for metric in metrics)
    figure = Figure(figsize=(WIDTH_IN, 0.9 + 0.36 * count))
    panels = figure.subplots(1, len(metrics), squeeze=False, sharey=True)[0]
    keys = list(dict.fromkeys(f.key for f in shown))
    for metric, axes in zip(metrics, panels, strict=True):
        for f in (f for f in shown if f.metric == metric):
            at, r = -keys.index(f.key), f.correlation
            axes.barh(at, r.value, 0.6, color=BAD if r.value > 0 else COLOURS["online"], alpha=0.8)
            axes.plot([r.low, r.high], [at, at], color=COLOURS["truth"], linewidth=1.2)
        axes.axvline(0, color=COLOURS["truth"], linewidth=0.8)
        axes.set(xlim=(-1.05, 1.05), xlabel="rank correlation")
        axes.set_title(name_of(metric), fontsize=9)
        axes.grid(visible=False, axis="y")
    panels[0].set_yticks([-k for k in range(len(keys))], keys)
    return figure


def contrast(found: Findings) -> Figure | None:
    """How each key is spread among surveys that passed and that did not."""
    good, bad = found.ended & found.passed, found.ended & ~found.passed
    keys = [key for key in found.keys if found.key_numbers(key) is not None]
    if not keys or not good.any() or not bad.any():
        return None
    figure, panels = make_panels(len(keys))
    for key, axes in zip(keys, panels, strict=True):
        values = found.key_numbers(key)
        assert values is not None
        log = spans_decades(values[found.ended])
        edges = _edges(values[found.ended], log)
        both = [values[good], values[bad]]
        axes.hist(both, list(edges), stacked=True, color=[GOOD, BAD], label=["passed", "not passed"], alpha=0.85)
        if log:
            log_axis(axes.xaxis, axes.set_xscale)
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set_xlabel(key)
    panels[0].set_ylabel("surveys")
    panels[0].legend(fontsize=8)
    return figure
