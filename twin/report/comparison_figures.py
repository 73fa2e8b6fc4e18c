"""Figures of a comparison of runs: one curve per run, in the colour of the run.

Each figure function returns None if no run has the data that its figure shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from twin.report.figures import WIDTH_IN, drawn, legend_beside, log_axis, log_scale
from twin.report.run_folder import Run
from twin.report.style import COLOURS

#: Colours of the runs in their order (Okabe & Ito palette, with grey in place of yellow).
RUN_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5d6d76", "#000000")
#: Line styles of the runs: coinciding curves stay visible.
_RUN_STYLES = ("-", "--", "-.", ":") * 2
#: Runs, each with the style of its curves.
Styled = Sequence[tuple[Run, dict[str, Any]]]


def draw_comparison(runs: Sequence[Run], names: Sequence[str]) -> dict[str, str]:
    """Returns the PNG data URI of each figure whose data at least one run contains, by name of the figure."""
    styles = [
        {"color": colour, "linestyle": style, "label": name}
        for name, colour, style in zip(names, RUN_COLOURS, _RUN_STYLES, strict=False)
    ]
    functions = {"errors": error_curves, "paths": path_curves, "heights": height_error_curves}
    return drawn(functions, list(zip(runs, styles, strict=True)))


def error_curves(runs: Styled) -> Figure | None:
    """Returns curves of the position error over the length of the true path: online above, final below."""
    figure = Figure(figsize=(WIDTH_IN, 5.0))
    panels = figure.subplots(2, 1, sharex=True)
    for axes, estimate in zip(panels, ("online", "final"), strict=True):
        for run, style in runs:
            if "truth" in run.trajectories and estimate in run.trajectories:
                errors = run.errors(estimate)
                axes.plot(errors.travelled_m, errors.distance_m, **style)
        log_scale(axes)
        axes.set(ylabel=f"position error, {estimate} [m]")
    panels[1].set_xlabel("length of the true path [m]")
    if not panels[0].lines and not panels[1].lines:
        return None
    (panels[0] if panels[0].lines else panels[1]).legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0))
    return figure


def path_curves(runs: Styled) -> Figure | None:
    """Returns a plan view of the final trajectories over the true path of the first run that has one."""
    if not any("final" in run.trajectories for run, _ in runs):
        return None
    figure = Figure(figsize=(WIDTH_IN, 4.4))
    axes = figure.add_subplot()
    axes.set_aspect("equal", adjustable="datalim")
    truth = next((run.trajectories["truth"] for run, _ in runs if "truth" in run.trajectories), None)
    if truth is not None:
        x, y, _ = truth.positions.T
        axes.plot(x, y, color=COLOURS["truth"], linewidth=5, alpha=0.25, label="true path")
    for run, style in runs:
        if "final" in run.trajectories:
            x, y, _ = run.trajectories["final"].positions.T
            axes.plot(x, y, linewidth=1.1, **style)
    axes.set(xlabel="x (east) [m]", ylabel="y (north) [m]")
    legend_beside(axes)
    return figure


def height_error_curves(runs: Styled) -> Figure | None:
    """Returns the cumulative distributions of the absolute height error of the map cells, with a line at 90 %."""
    figure = Figure(figsize=(WIDTH_IN, 3.4))
    axes = figure.add_subplot()
    share = np.linspace(2, 99.8, 490)  # both tails are long on a logarithmic axis
    for run, style in runs:
        size_m = np.abs(run.rasters["dem_error"].values) if "dem_error" in run.rasters else np.zeros(0)
        size_m = size_m[np.isfinite(size_m)]
        if len(size_m):
            axes.plot(np.percentile(size_m, share), share, **style)
    if not axes.lines:
        return None
    axes.axhline(90, color=COLOURS["limit"], linewidth=0.8)
    axes.set(xlabel="absolute height error [m]", ylabel="cells up to this error [%]", ylim=(0, 100))
    log_axis(axes.xaxis)
    legend_beside(axes)
    return figure
