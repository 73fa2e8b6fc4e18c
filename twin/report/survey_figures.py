"""Figures of the survey report. Each figure function returns None if its data are missing from the run."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.report import map_figures
from twin.report.map_figures import TRUE_STYLE, map_axes, subsampled
from twin.report.plotting import WIDTH_IN, drawn, extent_of, hillshade, legend_beside, log_scale, one_panel
from twin.report.run_folder import Run
from twin.report.style import COLOURS, ESTIMATES, LABELS
from twin.report.survey_data import KeyframeCoverage

PATH_STYLES: dict[str, dict[str, Any]] = {"reference": {"linestyle": "--", "linewidth": 1.0}, "truth": TRUE_STYLE}


def draw_all(run: Run, coverage: KeyframeCoverage | None = None) -> dict[str, str]:
    """Returns the data URI of each figure whose data the run contains, by name of the figure."""
    functions = {
        "plan_view": plan_view, "path_errors": path_error_curves,
        "stereo_quality": stereo_quality_curves, "elevation": map_figures.elevation_maps,
        "error": map_figures.error_maps, "tasks": map_figures.task_maps,
        "network": network_plot, "mosaic": map_figures.orthomosaic_map,
        "sections": map_figures.cross_sections, "coverage": lambda run: map_figures.coverage_map(run, coverage),
    }  # fmt: skip
    return drawn(functions, run)


def plan_view(run: Run) -> Figure | None:
    """Returns a plan view of the trajectories and keyframes, over the true floor in grey."""
    if not run.trajectories:
        return None
    figure, axes = one_panel(5.2)
    map_axes(axes, run)
    if "dem_truth" in run.rasters and np.allclose(run.keyframes.map_from_world, np.eye(4)):
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
