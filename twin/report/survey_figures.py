"""Figures of the survey report. Each figure function returns None if its data are missing from the run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from twin.report.number_formats import improvement, length
from twin.report.plotting import (
    WIDTH_IN,
    add_coordinates,
    drawn,
    extent_of,
    height_scale,
    hillshade,
    legend_beside,
    log_axis,
    log_scale,
    one_panel,
)
from twin.report.run_folder import Raster, Run
from twin.report.stage_tables import PROCESSING_STAGES, stage_rows, stage_times
from twin.report.style import COLOURS, ESTIMATES, LABELS

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
        "tasks": task_maps, "histogram": error_histogram, "network": network_plot, "timing": timing_bars,
    }  # fmt: skip
    return drawn(functions, run)


def plan_view(run: Run) -> Figure | None:
    """Returns a plan view of the trajectories and keyframes, over the true floor in grey."""
    if not run.trajectories:
        return None
    figure, axes = one_panel(5.2)
    map_axes(axes, run)
    if "dem_truth" in run.rasters:
        floor = run.rasters["dem_truth"]
        axes.imshow(hillshade(subsampled(floor), "gray"), extent=extent_of(floor.grid), alpha=0.35)
    for name in ("reference", "truth", *ESTIMATES):
        if name in run.trajectories:
            x, y, _ = run.trajectories[name].positions.T
            axes.plot(x, y, color=COLOURS[name], label=LABELS[name], **PATH_STYLES.get(name, {}))
    _add_keyframes(axes, run)
    legend_beside(axes)
    _limit_to_paths(axes, run)
    return figure


def _add_keyframes(axes: Axes, run: Run) -> None:
    """Plots the keyframes at their final positions, or at their online ones if there is no final trajectory."""
    name = "final" if "final" in run.trajectories else "online"
    if name in run.trajectories and len(run.keyframes.frames):
        positions = run.trajectories[name].positions
        x, y, _ = positions[run.keyframes.frames[run.keyframes.frames < len(positions)]].T
        axes.plot(x, y, ".", markersize=2.5, color=COLOURS["truth"], label="keyframes")


def _limit_to_paths(axes: Axes, run: Run) -> None:
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


def stage_bars(run: Run) -> Figure | None:
    """Returns bars of the RMS position error after each positioning stage, with the change from the preceding stage."""
    rows = stage_rows(run.metrics or {}, run.scenario)
    errors_m = [row.rmse_m for row in rows if row.rmse_m]
    if not errors_m:
        return None
    figure, axes = one_panel(0.7 + 0.4 * len(rows))
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
    figure, axes = one_panel(2.6)
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
    scale = height_scale(np.concatenate([raster.values.ravel() for raster, _ in rasters]))
    figure = Figure(figsize=(WIDTH_IN, 4.0))
    panels = figure.subplots(1, len(rasters), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (raster, title) in zip(panels, rasters, strict=True):
        map_axes(axes, run).imshow(hillshade(subsampled(raster), "viridis", scale), extent=extent_of(raster.grid))
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
    scalar_map(map_axes(left, run), run.rasters["dem_error"], title, "RdBu_r", Normalize(-limit, limit))
    if "dem_sigma" in run.rasters:
        title = "Estimated standard deviation (sigma)"
        scalar_map(map_axes(right, run), run.rasters["dem_sigma"], title, "magma", Normalize(0, limit))
    return figure


def task_maps(run: Run) -> Figure | None:
    """Returns hill-shaded maps of the tasks beside their height errors, one row for each task."""
    names = [name for name in run.rasters if name.startswith("task_") and name.endswith("/dem")]
    if not names:
        return None
    figure = Figure(figsize=(WIDTH_IN, 3.6 * len(names)))
    titles = [task["name"] for task in (run.metrics or {}).get("tasks", [])]
    for row, name in zip(figure.subplots(len(names), 2, squeeze=False), names, strict=True):
        number = int(name.removeprefix("task_").split("/")[0])
        title = titles[number - 1] if number <= len(titles) else name
        heights, error = run.rasters[name], run.rasters.get(name.replace("/dem", "/dem_error"))
        scale = height_scale(heights.values.ravel())
        map_axes(row[0], run).imshow(hillshade(subsampled(heights), "viridis", scale), extent=extent_of(heights.grid))
        row[0].set_title(title)
        figure.colorbar(ScalarMappable(Normalize(*scale), "viridis"), ax=row[0], label="height [m]", shrink=0.8)
        if error is not None and np.isfinite(error.values).any():
            limit = float(np.nanpercentile(np.abs(error.values), 98)) or 1e-3
            scalar_map(map_axes(row[1], run), error, "Height error", "RdBu_r", Normalize(-limit, limit))
    return figure


def scalar_map(axes: Axes, raster: Raster, title: str, cmap: str, norm: Normalize, unit: str = "m") -> None:
    """Draws a raster with one band and its colour bar; cells without data are light grey."""
    image = axes.imshow(subsampled(raster), cmap=cmap, norm=norm, extent=extent_of(raster.grid))
    axes.set_title(title)
    axes.set_facecolor("#dfe6ea")
    figure = axes.get_figure()
    assert figure is not None
    figure.colorbar(image, ax=axes, label=f"[{unit}]", shrink=0.8, extend="both" if norm.vmin else "max")


def error_histogram(run: Run) -> Figure | None:
    """Returns a histogram of the absolute height error, with lines at the percentiles given in metrics.json."""
    if "dem_error" not in run.rasters:
        return None
    size = np.abs(run.rasters["dem_error"].values)
    size = size[np.isfinite(size)]
    if len(size) == 0:
        return None
    figure, axes = one_panel(2.8)
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
    figure, axes = one_panel(4.4)
    map_axes(axes, run)
    axes.set_adjustable("datalim")  # a network along a line fills the figure too
    ends = np.pad(positions[edges][:, :, :2], ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)  # a gap after each link
    axes.plot(*ends.reshape(-1, 2).T, color=COLOURS["link"], linewidth=0.5, alpha=0.6)
    axes.plot(positions[:, 0], positions[:, 1], ".", markersize=3, color=COLOURS["final"])
    axes.set_title(f"{len(positions)} keyframes, {len(edges)} links")
    return figure


def timing_bars(run: Run) -> Figure | None:
    """Returns bars of the mean time per call of each processing stage, with a line at the budget of the stage."""
    stages = stage_times(run.metrics or {}, run.scenario, run.keyframes.n_frames_per_keyframe)
    rows = [row for row in stages if row.mean_ms is not None]
    if not rows:
        return None
    figure, axes = one_panel(0.6 + 0.34 * len(rows))
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


def map_axes(axes: Axes, run: Run) -> Axes:
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set(xlabel="east [m]", ylabel="north [m]")
    add_coordinates(axes, run.georeference)
    return axes
