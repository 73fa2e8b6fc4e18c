"""The figures of the report, each drawn from the files of a run; None where the run does not have them."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure

from twin.judge.budget import budget
from twin.judge.stages import stage_rows
from twin.judge.trajectory import path_errors
from twin.report.run_folder import Raster, Run
from twin.report.style import COLOURS, ESTIMATES, FIGURE_STYLE, LABELS
from twin.report.wording import better, length

WIDTH_IN = 9.6
#: Longest side of a map in a figure [cells]; finer maps are thinned.
MAP_CELLS = 500
#: The truth lies under the estimates as a broad band: where it shows, they are off.
PATH_STYLES: dict[str, dict[str, Any]] = {
    "reference": {"linestyle": "--", "linewidth": 1.0},
    "truth": {"linewidth": 5.0, "alpha": 0.35},
}


def draw_all(run: Run) -> dict[str, str]:
    """Every figure that the run has the data for, as data URIs by name."""
    drawings: dict[str, Callable[[Run], Figure | None]] = {
        "plan_view": plan_view,
        "path_errors": path_error_curves,
        "stages": stage_bars,
        "tracks": track_bars,
        "stereo_quality": stereo_quality_curves,
        "elevation": elevation_maps,
        "error": error_maps,
        "histogram": error_histogram,
        "network": network_plot,
        "timing": timing_bars,
    }
    with matplotlib.rc_context(FIGURE_STYLE):
        figures = {name: draw(run) for name, draw in drawings.items()}
        return {name: to_data_uri(figure) for name, figure in figures.items() if figure is not None}


def to_data_uri(figure: Figure) -> str:
    """A figure as an inlined PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight", pad_inches=0.08)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def plan_view(run: Run) -> Figure | None:
    """The trajectories from above, over the true floor in grey, with the keyframes."""
    if not run.trajectories:
        return None
    figure = Figure(figsize=(WIDTH_IN, 5.2))
    axes = _map_axes(figure.add_subplot())
    if "dem_truth" in run.rasters:
        axes.imshow(
            _relief(thinned(run.rasters["dem_truth"]), "gray"), extent=_extent(run.rasters["dem_truth"]), alpha=0.35
        )
    for name in ("reference", "truth", *ESTIMATES):
        if name in run.trajectories:
            x, y, _ = run.trajectories[name].positions.T
            axes.plot(x, y, color=COLOURS[name], label=LABELS[name], **PATH_STYLES.get(name, {}))
    _draw_keyframes(axes, run)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1))
    _frame_paths(axes, run)
    return figure


def _draw_keyframes(axes: Axes, run: Run) -> None:
    name = "final" if "final" in run.trajectories else "online"
    if name in run.trajectories and len(run.keyframes.frames):
        positions = run.trajectories[name].positions
        x, y, _ = positions[run.keyframes.frames[run.keyframes.frames < len(positions)]].T
        axes.plot(x, y, ".", markersize=2.5, color=COLOURS["truth"], label="keyframes")


def _frame_paths(axes: Axes, run: Run) -> None:
    """Limits around the paths, not around the whole floor."""
    xy = np.concatenate([path.positions[:, :2] for path in run.trajectories.values()])
    if len(xy):
        low, high = xy.min(axis=0), xy.max(axis=0)
        margin = 0.08 * max(*(high - low), 0.5)
        axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))


def path_error_curves(run: Run) -> Figure | None:
    """Position, height and heading error along the true path, for each estimate."""
    names = [name for name in ESTIMATES if name in run.trajectories]
    if "truth" not in run.trajectories or not names:
        return None
    figure = Figure(figsize=(WIDTH_IN, 5.6))
    position, height, heading = figure.subplots(3, 1, sharex=True)
    for name in names:
        errors = path_errors(run.trajectories[name], run.trajectories["truth"])
        style: dict[str, Any] = {"color": COLOURS[name], "label": LABELS[name]}
        position.plot(errors.travelled_m, errors.distance_m, **style)
        height.plot(errors.travelled_m, errors.position_m[:, 2], **style)
        heading.plot(errors.travelled_m, np.rad2deg(errors.heading_rad), **style)
    _log_scale(position)
    position.set(ylabel="position error [m]")
    height.set(ylabel="height error [m]")
    heading.set(ylabel="heading error [deg]", xlabel="true path travelled [m]")
    position.legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0))
    return figure


def _log_scale(axes: Axes) -> None:
    """Decades from a little below the usual smallest of the curves: millimetres stay visible beside decimetres."""
    sizes = np.concatenate([np.asarray(curve.get_ydata(), dtype=float) for curve in axes.lines])
    sizes = sizes[sizes > 0]
    if len(sizes):
        axes.set(yscale="log", ylim=(0.7 * float(np.percentile(sizes, 1)), None))


def stage_bars(run: Run) -> Figure | None:
    """Error of the keyframes after each stage of positioning, and by what factor that is less than before."""
    rows = stage_rows(run.metrics or {}, run.scenario)
    errors_m = [row.rmse_m for row in rows if row.rmse_m]
    if not errors_m:
        return None
    figure = Figure(figsize=(WIDTH_IN, 0.7 + 0.4 * len(rows)))
    axes = figure.add_subplot()
    at = np.arange(len(rows))[::-1]
    widths = [row.rmse_m or 0.0 for row in rows]
    axes.barh(at, widths, 0.62, color=[COLOURS[row.stage] for row in rows])
    for y, row in zip(at, rows, strict=True):
        notes = [length(row.rmse_m), better(row.gain), row.off]
        axes.text(row.rmse_m or min(errors_m), y, "   ".join(["", *filter(None, notes)]), va="center")
    axes.set_yticks(at, [LABELS[row.stage] for row in rows])
    axes.set(xscale="log", xlim=(min(errors_m) / 3, max(errors_m) * 3), xlabel="RMS error of the keyframes")
    axes.xaxis.set_major_formatter(lambda value_m, _: length(value_m))
    axes.grid(visible=False, axis="y")
    return figure


def track_bars(run: Run) -> Figure | None:
    """Key-point error before and after each global alignment."""
    tracks = (run.metrics or {}).get("tracks") or []
    if not tracks:
        return None
    figure = Figure(figsize=(WIDTH_IN, 2.6))
    axes = figure.add_subplot()
    at = np.arange(len(tracks))
    for shift, key, role, label in ((-0.2, "before", "online", "before GA"), (0.2, "after", "final", "after GA")):
        values = [row[f"{key}_ga_rmse_m"] or 0.0 for row in tracks]
        axes.bar(at + shift, values, 0.4, color=COLOURS[role], label=label)
    axes.set_xticks(at, [str(row["track"]) for row in tracks])
    axes.set(xlabel="track", ylabel="keyframe RMSE [m]")
    axes.grid(visible=False, axis="x")
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def stereo_quality_curves(run: Run) -> Figure | None:
    """Matched points and contrast of every look with both cameras, by the time of its frame; red: too few points."""
    looks, path = run.keyframes.stereo_observations, run.trajectories.get("online")
    if path is None or not len(looks) or looks[:, 0].max() >= len(path):
        return None
    times_s, blind = path.times_s[looks[:, 0].astype(int)], ~np.isin(looks[:, 0], run.keyframes.frames)
    shown = [(looks[:, 1], "matched points"), (looks[:, 2], "contrast of the image")]
    shown = [(values, label) for values, label in shown if np.isfinite(values).any()]
    figure = Figure(figsize=(WIDTH_IN, 1.9 * len(shown)))
    for (values, label), axes in zip(
        shown, figure.subplots(len(shown), 1, squeeze=False, sharex=True)[:, 0], strict=True
    ):
        axes.plot(times_s, values, ".-", color=COLOURS["online"], markersize=3, linewidth=0.8)
        axes.plot(times_s[blind], values[blind], ".", color=COLOURS["limit"], markersize=6)
        axes.set(ylabel=label, ylim=(0, 1.08 * np.nanmax(values) or None))
    figure.axes[-1].set_xlabel("time [s]")
    return figure


def elevation_maps(run: Run) -> Figure | None:
    """True and estimated elevation, hill-shaded, on one colour scale."""
    rasters = [
        (run.rasters[key], title) for key, title in (("dem_truth", "True floor"), ("dem", "Map")) if key in run.rasters
    ]
    if not rasters:
        return None
    scale = _height_scale(np.concatenate([raster.values.ravel() for raster, _ in rasters]))
    figure = Figure(figsize=(WIDTH_IN, 4.0))
    panels = figure.subplots(1, len(rasters), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (raster, title) in zip(panels, rasters, strict=True):
        _map_axes(axes).imshow(_relief(thinned(raster), "viridis", scale), extent=_extent(raster))
        axes.set_title(title)
    figure.colorbar(ScalarMappable(Normalize(*scale), "viridis"), ax=panels, label="height [m]", shrink=0.8)
    return figure


def error_maps(run: Run) -> Figure | None:
    """Map error, and beside it the map's own standard deviation."""
    if "dem_error" not in run.rasters or not np.isfinite(run.rasters["dem_error"].values).any():
        return None
    figure = Figure(figsize=(WIDTH_IN, 4.0))
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    limit = float(np.nanpercentile(np.abs(run.rasters["dem_error"].values), 98)) or 1e-3
    _scalar_map(left, run.rasters["dem_error"], "Error: map minus truth", "RdBu_r", Normalize(-limit, limit))
    if "dem_sigma" in run.rasters:
        _scalar_map(right, run.rasters["dem_sigma"], "What the map thinks: one sigma", "magma", Normalize(0, limit))
    return figure


def _scalar_map(axes: Axes, raster: Raster, title: str, cmap: str, norm: Normalize) -> None:
    image = _map_axes(axes).imshow(thinned(raster), cmap=cmap, norm=norm, extent=_extent(raster))
    axes.set_title(title)
    axes.set_facecolor("#dfe6ea")
    figure = axes.get_figure()
    assert figure is not None
    figure.colorbar(image, ax=axes, label="[m]", shrink=0.8, extend="both" if norm.vmin else "max")


def error_histogram(run: Run) -> Figure | None:
    """Distribution of the absolute map error, with the percentiles that metrics.json reports."""
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
    for key, label in (("p85_m", "85 %"), ("le90_m", "LE90"), ("le95_m", "LE95")):
        if (value := (run.metrics or {}).get("map", {}).get(key)) is not None:
            axes.axvline(value, color=COLOURS["limit"], linewidth=1)
            axes.text(value, axes.get_ylim()[1], f" {label}", rotation=90, va="top", ha="right", fontsize=8)
    axes.set(xlabel="|map error| [m]; the last bar holds all beyond", ylabel="cells", xlim=(0, top))
    return figure


def network_plot(run: Run) -> Figure | None:
    """The keyframe network from above: nodes and links."""
    positions, edges = run.network
    if len(positions) == 0:
        return None
    figure = Figure(figsize=(WIDTH_IN, 4.4))
    axes = _map_axes(figure.add_subplot())
    axes.add_collection(
        LineCollection(list(positions[edges][:, :, :2]), colors=COLOURS["link"], linewidths=0.5, alpha=0.6)
    )
    axes.plot(positions[:, 0], positions[:, 1], ".", markersize=3, color=COLOURS["final"])
    axes.set_title(f"{len(positions)} keyframes, {len(edges)} links")
    return figure


def timing_bars(run: Run) -> Figure | None:
    """Mean time of each stage per call, and its budget."""
    rows = [
        row
        for row in budget(run.metrics or {}, run.scenario, run.keyframes.n_frames_per_keyframe)
        if row.mean_ms is not None
    ]
    if not rows:
        return None
    figure = Figure(figsize=(WIDTH_IN, 0.6 + 0.34 * len(rows)))
    axes = figure.add_subplot()
    at = np.arange(len(rows))[::-1]
    axes.barh(
        at,
        [row.mean_ms or 0.0 for row in rows],
        0.6,
        color=[COLOURS["online" if r.budget_ms else "link"] for r in rows],
    )
    for y, row in zip(at, rows, strict=True):
        if row.budget_ms:
            axes.plot([row.budget_ms] * 2, [y - 0.4, y + 0.4], color=COLOURS["limit"], linewidth=2)
    axes.set_yticks(at, [row.what for row in rows])
    least = min(row.mean_ms or 1.0 for row in rows)
    axes.set(xscale="log", xlim=(least / 3, None), xlabel="mean time [ms]; red: budget")
    axes.grid(visible=False, axis="y")
    return figure


def thinned(raster: Raster) -> np.ndarray:
    """Every n-th cell, so that neither side has more than `MAP_CELLS`."""
    step = int(np.ceil(max(raster.values.shape[:2]) / MAP_CELLS))
    return raster.values[::step, ::step]


def _height_scale(heights: np.ndarray) -> tuple[float, float]:
    """Nearly the lowest and nearly the highest of the finite heights."""
    finite = heights[np.isfinite(heights)]
    low, high = np.percentile(finite, [0.5, 99.5]) if len(finite) else (0.0, 1.0)
    return float(low), float(high)


def _relief(heights: np.ndarray, cmap: str, scale: tuple[float, float] | None = None) -> np.ndarray:
    """Hill-shaded colours (rows, cols, 4) lit from the north-west; holes are transparent.

    Heights are clipped to the colour scale: a single wild one would leave no shade for all others.
    """
    holes = ~np.isfinite(heights)
    low, high = scale or _height_scale(heights)
    filled = np.clip(np.where(holes, (low + high) / 2, heights), low, high)
    shaded = LightSource(315, 45).shade(
        filled,
        matplotlib.colormaps[cmap],
        Normalize(low, high),
        "soft",
        vert_exag=0.12 * max(heights.shape) / ((high - low) or 1.0),
    )
    shaded[..., 3] = ~holes
    return shaded


def _extent(raster: Raster) -> tuple[float, float, float, float]:
    grid = raster.grid
    return (grid.west_m, grid.west_m + grid.cols * grid.cell_m, grid.north_m - grid.rows * grid.cell_m, grid.north_m)


def _map_axes(axes: Axes) -> Axes:
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set(xlabel="east [m]", ylabel="north [m]")
    return axes
