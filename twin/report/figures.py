"""Figures of the survey report, and what the figures of all reports share: files, axes, legends, bars.

Each figure function returns None if its data are missing from the run.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from twin.judge.processing_budget import stage_times
from twin.report.run_folder import Raster, Run
from twin.report.stage_table import stage_rows
from twin.report.style import COLOURS, ESTIMATES, FIGURE_STYLE, LABELS
from twin.report.wording import PROCESSING_STAGES, improvement, length

WIDTH_IN = 9.6
#: Longest side of a map in a figure [cells]; maps with more cells are subsampled.
MAP_CELLS = 500
#: The true path is drawn as a broad band below the estimates, so it remains visible where they coincide with it.
PATH_STYLES: dict[str, dict[str, Any]] = {
    "reference": {"linestyle": "--", "linewidth": 1.0},
    "truth": {"linewidth": 5.0, "alpha": 0.35},
}


def draw_all(run: Run) -> dict[str, str]:
    """Returns the PNG data URI of each figure whose data the run contains, by name of the figure."""
    functions = {
        "plan_view": plan_view, "path_errors": path_error_curves, "stages": stage_bars, "tracks": track_bars,
        "stereo_quality": stereo_quality_curves, "elevation": elevation_maps, "error": error_maps,
        "histogram": error_histogram, "network": network_plot, "timing": timing_bars,
    }  # fmt: skip
    return drawn(functions, run)


def drawn(functions: Mapping[str, Callable[..., Figure | None]], *data: Any) -> dict[str, str]:
    """Returns the PNG data URI of each figure that a function of `data` draws, by name of the figure."""
    with matplotlib.rc_context(FIGURE_STYLE):
        figures = {name: draw(*data) for name, draw in functions.items()}
        return {name: to_data_uri(figure) for name, figure in figures.items() if figure is not None}


def to_data_uri(figure: Figure) -> str:
    """Returns a figure as a PNG data URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight", pad_inches=0.08)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def plan_view(run: Run) -> Figure | None:
    """Returns a plan view of the trajectories and keyframes, over the true floor in grey."""
    if not run.trajectories:
        return None
    figure = Figure(figsize=(WIDTH_IN, 5.2))
    axes = _map_axes(figure.add_subplot())
    if "dem_truth" in run.rasters:
        floor = run.rasters["dem_truth"]
        axes.imshow(hillshade(subsampled(floor), "gray"), extent=_extent(floor), alpha=0.35)
    for name in ("reference", "truth", *ESTIMATES):
        if name in run.trajectories:
            x, y, _ = run.trajectories[name].positions.T
            axes.plot(x, y, color=COLOURS[name], label=LABELS[name], **PATH_STYLES.get(name, {}))
    _add_keyframes(axes, run)
    legend_beside(axes)
    _limit_to_paths(axes, run)
    return figure


def legend_beside(axes: Axes) -> None:
    """Adds the legend to the right of the axes."""
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1))


def _add_keyframes(axes: Axes, run: Run) -> None:
    """Plots the keyframes at their final positions, or at their online ones if there is no final trajectory."""
    name = "final" if "final" in run.trajectories else "online"
    if name in run.trajectories and len(run.keyframes.frames):
        positions = run.trajectories[name].positions
        x, y, _ = positions[run.keyframes.frames[run.keyframes.frames < len(positions)]].T
        axes.plot(x, y, ".", markersize=2.5, color=COLOURS["truth"], label="keyframes")


def _limit_to_paths(axes: Axes, run: Run) -> None:
    """Sets the limits of the axes to the extent of the trajectories plus a margin."""
    xy = np.concatenate([path.positions[:, :2] for path in run.trajectories.values()])
    if len(xy):
        low, high = xy.min(axis=0), xy.max(axis=0)
        margin = 0.08 * max(*(high - low), 0.5)
        axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))


def path_error_curves(run: Run) -> Figure | None:
    """Returns curves of the position, height and heading error of each estimate over the length of the true path."""
    names = [name for name in ESTIMATES if name in run.trajectories]
    if "truth" not in run.trajectories or not names:
        return None
    figure = Figure(figsize=(WIDTH_IN, 5.6))
    position, height, heading = figure.subplots(3, 1, sharex=True)
    for name in names:
        errors = run.errors(name)
        style: dict[str, Any] = {"color": COLOURS[name], "label": LABELS[name]}
        position.plot(errors.travelled_m, errors.distance_m, **style)
        height.plot(errors.travelled_m, errors.position_m[:, 2], **style)
        heading.plot(errors.travelled_m, np.rad2deg(errors.heading_rad), **style)
    log_scale(position)
    position.set(ylabel="position error [m]")
    height.set(ylabel="height error [m]")
    heading.set(ylabel="heading error [deg]", xlabel="length of the true path [m]")
    position.legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0))
    return figure


def log_scale(axes: Axes) -> None:
    """Makes the y axis logarithmic, from 0.7 times the 1st percentile of the positive values; linear if none is."""
    sizes = np.concatenate([np.zeros(0), *(np.asarray(curve.get_ydata(), dtype=float) for curve in axes.lines)])
    sizes = sizes[sizes > 0]
    if len(sizes):
        log_axis(axes.yaxis)
        axes.set_ylim(0.7 * float(np.percentile(sizes, 1)), None)


class _RoundNumbers(LogLocator):
    """Ticks at 1, 2 and 5, at 1 and 3 or at 1 times powers of 10: the most whose labels do not touch."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        axis: Any = self.axis
        space = max(axis.get_tick_space() // (2 if axis.axis_name == "x" else 1), 1)  # labels are broader than high
        decades = 10.0 ** np.arange(np.floor(np.log10(vmin)), np.log10(vmax) + 1)
        shown = decades
        for steps in ((1, 2, 5), (1, 3), (1,)):
            ticks = np.outer(decades, steps).ravel()
            shown = ticks[(ticks >= vmin) & (ticks <= vmax)]
            if 0 < len(shown) <= space:
                break
        return shown[:: -(-len(shown) // space) or 1]


def log_axis(axis: Any, label: Callable[[float], str] = "{:g}".format) -> None:
    """Makes an x or y axis logarithmic, with labels at round numbers; the default formatter would write raw markup."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    axis.set_major_locator(_RoundNumbers())
    axis.set_major_formatter(lambda value, _: label(value))
    axis.set_minor_formatter(lambda *_: "")


def stage_bars(run: Run) -> Figure | None:
    """Returns bars of the RMS position error after each positioning stage, with the change from the preceding stage."""
    rows = stage_rows(run.metrics or {}, run.scenario)
    errors_m = [row.rmse_m for row in rows if row.rmse_m]
    if not errors_m:
        return None
    figure = Figure(figsize=(WIDTH_IN, 0.7 + 0.4 * len(rows)))
    axes = figure.add_subplot()
    bars = {LABELS[row.stage]: (row.rmse_m, COLOURS[row.stage]) for row in rows}
    for y, row in zip(_rows_of_bars(axes, bars, 0.62), rows, strict=True):
        notes = [length(row.rmse_m), improvement(row.gain), row.disabled]
        axes.text(row.rmse_m or min(errors_m), y, "   ".join(["", *filter(None, notes)]), va="center")
    log_axis(axes.xaxis, length)
    axes.set(xlim=(min(errors_m) / 3, max(errors_m) * 3), xlabel="position error of the keyframes (RMSE)")
    return figure


def _rows_of_bars(axes: Axes, bars: Mapping[str, tuple[float, str]], height: float) -> Sequence[int]:
    """Draws horizontal bars, each with a length and a colour, by label from top to bottom; returns their y."""
    y = np.arange(len(bars))[::-1]
    lengths, colours = zip(*bars.values(), strict=True)
    axes.barh(y, lengths, height, color=colours)
    axes.set_yticks(y, list(bars))
    axes.grid(visible=False, axis="y")
    return y.tolist()


def track_bars(run: Run) -> Figure | None:
    """Returns bars of the RMS position error of the keyframes before and after the alignment of each track."""
    tracks = (run.metrics or {}).get("tracks") or []
    if not tracks:
        return None
    figure = Figure(figsize=(WIDTH_IN, 2.6))
    axes = figure.add_subplot()
    bars = np.arange(len(tracks))
    for shift, key, role, label in ((-0.2, "before", "online", "before GA"), (0.2, "after", "final", "after GA")):
        values = [row[f"{key}_ga_rmse_m"] or 0.0 for row in tracks]
        axes.bar(bars + shift, values, 0.4, color=COLOURS[role], label=label)
    axes.set_xticks(bars, [str(row["track"]) for row in tracks])
    axes.set(xlabel="track", ylabel="keyframe position RMSE [m]")
    axes.grid(visible=False, axis="x")
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def stereo_quality_curves(run: Run) -> Figure | None:
    """Returns curves of matched points and contrast over time; red: too few points for a keyframe."""
    observations, path = run.keyframes.stereo_observations, run.trajectories.get("online")
    if path is None or not len(observations) or observations[:, 0].max() >= len(path):
        return None
    times_s = path.times_s[observations[:, 0].astype(int)]
    too_few = ~np.isin(observations[:, 0], run.keyframes.frames)
    shown = [(observations[:, 1], "matched points"), (observations[:, 2], "RMS contrast")]
    shown = [(values, label) for values, label in shown if np.isfinite(values).any()]
    figure = Figure(figsize=(WIDTH_IN, 1.9 * len(shown)))
    panels = figure.subplots(len(shown), 1, squeeze=False, sharex=True)[:, 0]
    for (values, label), axes in zip(shown, panels, strict=True):
        axes.plot(times_s, values, ".-", color=COLOURS["online"], markersize=3, linewidth=0.8)
        axes.plot(times_s[too_few], values[too_few], ".", color=COLOURS["limit"], markersize=6)
        axes.set(ylabel=label, ylim=(0, 1.08 * np.nanmax(values) or None))
    figure.axes[-1].set_xlabel("time [s]")
    return figure


def elevation_maps(run: Run) -> Figure | None:
    """Returns hill-shaded maps of the true and the estimated elevation with the same colour scale."""
    titles = {"dem_truth": "True elevation", "dem": "Estimated elevation"}
    rasters = [(run.rasters[key], title) for key, title in titles.items() if key in run.rasters]
    if not rasters:
        return None
    scale = _height_scale(np.concatenate([raster.values.ravel() for raster, _ in rasters]))
    figure = Figure(figsize=(WIDTH_IN, 4.0))
    panels = figure.subplots(1, len(rasters), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (raster, title) in zip(panels, rasters, strict=True):
        _map_axes(axes).imshow(hillshade(subsampled(raster), "viridis", scale), extent=_extent(raster))
        axes.set_title(title)
    figure.colorbar(ScalarMappable(Normalize(*scale), "viridis"), ax=panels, label="height [m]", shrink=0.8)
    return figure


def error_maps(run: Run) -> Figure | None:
    """Returns maps of the height error and of the estimated standard deviation."""
    if "dem_error" not in run.rasters or not np.isfinite(run.rasters["dem_error"].values).any():
        return None
    figure = Figure(figsize=(WIDTH_IN, 4.0))
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    limit = float(np.nanpercentile(np.abs(run.rasters["dem_error"].values), 98)) or 1e-3
    title = "Height error (estimated minus true)"
    _scalar_map(left, run.rasters["dem_error"], title, "RdBu_r", Normalize(-limit, limit))
    if "dem_sigma" in run.rasters:
        title = "Estimated standard deviation (sigma)"
        _scalar_map(right, run.rasters["dem_sigma"], title, "magma", Normalize(0, limit))
    return figure


def _scalar_map(axes: Axes, raster: Raster, title: str, cmap: str, norm: Normalize) -> None:
    """Draws a raster with one band and its colour bar; cells without data are light grey."""
    image = _map_axes(axes).imshow(subsampled(raster), cmap=cmap, norm=norm, extent=_extent(raster))
    axes.set_title(title)
    axes.set_facecolor("#dfe6ea")
    figure = axes.get_figure()
    assert figure is not None
    figure.colorbar(image, ax=axes, label="[m]", shrink=0.8, extend="both" if norm.vmin else "max")


def error_histogram(run: Run) -> Figure | None:
    """Returns a histogram of the absolute height error, with lines at the percentiles given in metrics.json."""
    if "dem_error" not in run.rasters:
        return None
    size = np.abs(run.rasters["dem_error"].values)
    size = size[np.isfinite(size)]
    if len(size) == 0:
        return None
    figure = Figure(figsize=(WIDTH_IN, 2.8))
    axes = figure.add_subplot()
    top = max(float(np.percentile(size, 99.5)), 1e-6)
    axes.hist(np.minimum(size, top), bins=80, range=(0, top), color=COLOURS["online"], alpha=0.85)
    for key, label in (("p85_m", "85th percentile"), ("le90_m", "LE90"), ("le95_m", "LE95")):
        if (value := (run.metrics or {}).get("map", {}).get(key)) is not None:
            axes.axvline(value, color=COLOURS["limit"], linewidth=1)
            axes.text(value, axes.get_ylim()[1], f" {label}", rotation=90, va="top", ha="right", fontsize=8)
    axes.set(xlabel="absolute height error [m] (last bar: this or larger)", ylabel="cells", xlim=(0, top))
    return figure


def network_plot(run: Run) -> Figure | None:
    """Returns a plan view of the keyframe network with its nodes and links; None if the network has no nodes."""
    positions, edges = run.network
    if len(positions) == 0:
        return None
    figure = Figure(figsize=(WIDTH_IN, 4.4))
    axes = _map_axes(figure.add_subplot())
    axes.set_adjustable("datalim")  # a network along a line fills the figure too
    links = list(positions[edges][:, :, :2])
    axes.add_collection(LineCollection(links, colors=COLOURS["link"], linewidths=0.5, alpha=0.6))
    axes.plot(positions[:, 0], positions[:, 1], ".", markersize=3, color=COLOURS["final"])
    axes.set_title(f"{len(positions)} keyframes, {len(edges)} links")
    return figure


def timing_bars(run: Run) -> Figure | None:
    """Returns bars of the mean time per call of each processing stage, with a line at the budget of the stage."""
    stages = stage_times(run.metrics or {}, run.scenario, run.keyframes.n_frames_per_keyframe)
    rows = [row for row in stages if row.mean_ms is not None]
    if not rows:
        return None
    figure = Figure(figsize=(WIDTH_IN, 0.6 + 0.34 * len(rows)))
    axes = figure.add_subplot()
    colours = [COLOURS["online" if row.budget_ms else "link"] for row in rows]
    bars = {PROCESSING_STAGES[r.stage]: (r.mean_ms or 0.0, colour) for r, colour in zip(rows, colours, strict=True)}
    for y, row in zip(_rows_of_bars(axes, bars, 0.6), rows, strict=True):
        if row.budget_ms:
            axes.plot([row.budget_ms] * 2, [y - 0.4, y + 0.4], color=COLOURS["limit"], linewidth=2)
    log_axis(axes.xaxis)
    shortest_ms = min(row.mean_ms or 1.0 for row in rows)
    axes.set(xlim=(shortest_ms / 3, None), xlabel="mean time per call [ms] (red: budget)")
    return figure


def subsampled(raster: Raster) -> np.ndarray:
    """Returns every n-th row and column of a raster, with the smallest n for which no side exceeds `MAP_CELLS`."""
    step = int(np.ceil(max(raster.values.shape[:2]) / MAP_CELLS))
    return raster.values[::step, ::step]


def _height_scale(heights: np.ndarray) -> tuple[float, float]:
    """Returns the 0.5th and 99.5th percentile of the finite heights [m]; (0, 1) if there are none."""
    finite = heights[np.isfinite(heights)]
    low, high = np.percentile(finite, [0.5, 99.5]) if len(finite) else (0.0, 1.0)
    return float(low), float(high)


def hillshade(heights: np.ndarray, cmap: str, scale: tuple[float, float] | None = None) -> np.ndarray:
    """Returns hill-shaded RGBA colours (rows, cols, 4), lit from the north-west; cells without data are transparent.

    Heights (rows, cols) [m] are clipped to `scale`, the lowest and highest height of the colour map `cmap` (by default
    `_height_scale`), because a single outlier would remove the shading from all other cells.
    """
    empty = ~np.isfinite(heights)
    low, high = scale or _height_scale(heights)
    filled = np.clip(np.where(empty, (low + high) / 2, heights), low, high)
    shaded = LightSource(315, 45).shade(
        filled,
        matplotlib.colormaps[cmap],
        Normalize(low, high),
        "soft",
        vert_exag=0.12 * max(heights.shape) / ((high - low) or 1.0),
    )
    shaded[..., 3] = ~empty
    return shaded


def _extent(raster: Raster) -> tuple[float, float, float, float]:
    """Returns the west, east, south and north edges of a raster [m], in the order of matplotlib's `extent`."""
    grid = raster.grid
    return (grid.west_m, grid.west_m + grid.cols * grid.cell_m, grid.north_m - grid.rows * grid.cell_m, grid.north_m)


def _map_axes(axes: Axes) -> Axes:
    """Returns the axes after setting equal scales and the labels of a map."""
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set(xlabel="east [m]", ylabel="north [m]")
    return axes
