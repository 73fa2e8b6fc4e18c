"""Figures of a comparison of runs: one curve per run, in the colour of the run.

Each figure function returns None if no run has the data that its figure shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from twin.report.figures import WIDTH_IN, log_axis, log_scale, to_data_uri
from twin.report.run_errors import run_errors
from twin.report.run_folder import Run
from twin.report.style import COLOURS, FIGURE_STYLE

#: Colours of the runs in their order (Okabe & Ito palette, with grey in place of yellow).
_RUN_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5d6d76", "#000000")
#: Line styles of the runs: coinciding curves stay visible.
_RUN_STYLES = ("-", "--", "-.", ":") * 2


def run_colours(n: int) -> list[str]:
    """Returns the colours of the first n runs."""
    return list(_RUN_COLOURS[:n])


def draw_comparison(runs: Sequence[Run], names: Sequence[str]) -> dict[str, str]:
    """Returns the PNG data URI of each figure whose data at least one run contains, by name of the figure."""
    functions: dict[str, Callable[[Sequence[Run], Sequence[str]], Figure | None]] = {
        "errors": error_curves,
        "paths": path_curves,
        "heights": height_error_curves,
    }
    with matplotlib.rc_context(FIGURE_STYLE):
        figures = {name: draw(runs, names) for name, draw in functions.items()}
        return {name: to_data_uri(figure) for name, figure in figures.items() if figure is not None}


def error_curves(runs: Sequence[Run], names: Sequence[str]) -> Figure | None:
    """Returns curves of the position error over the length of the true path: online above, final below."""
    figure = Figure(figsize=(WIDTH_IN, 5.0))
    panels = figure.subplots(2, 1, sharex=True)
    for axes, estimate in zip(panels, ("online", "final"), strict=True):
        for k, (run, name) in enumerate(zip(runs, names, strict=True)):
            if "truth" in run.trajectories and estimate in run.trajectories:
                errors = run_errors(run, estimate)
                axes.plot(
                    errors.travelled_m, errors.distance_m, _RUN_STYLES[k], color=_RUN_COLOURS[k], label=name
                )  # fmt: skip
        log_scale(axes)
        axes.set(ylabel=f"position error, {estimate} [m]")
    panels[1].set_xlabel("length of the true path [m]")
    if not panels[0].lines and not panels[1].lines:
        return None
    (panels[0] if panels[0].lines else panels[1]).legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0))
    return figure


def path_curves(runs: Sequence[Run], names: Sequence[str]) -> Figure | None:
    """Returns a plan view of the final trajectories over the true path of the first run that has one."""
    if not any("final" in run.trajectories for run in runs):
        return None
    figure = Figure(figsize=(WIDTH_IN, 4.4))
    axes = figure.add_subplot()
    axes.set_aspect("equal", adjustable="datalim")
    truth = next((run.trajectories["truth"] for run in runs if "truth" in run.trajectories), None)
    if truth is not None:
        x, y, _ = truth.positions.T
        axes.plot(x, y, color=COLOURS["truth"], linewidth=5, alpha=0.25, label="true path")
    for k, (run, name) in enumerate(zip(runs, names, strict=True)):
        if "final" in run.trajectories:
            x, y, _ = run.trajectories["final"].positions.T
            axes.plot(x, y, _RUN_STYLES[k], color=_RUN_COLOURS[k], label=name, linewidth=1.1)
    axes.set(xlabel="x (east) [m]", ylabel="y (north) [m]")
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1))
    return figure


def height_error_curves(runs: Sequence[Run], names: Sequence[str]) -> Figure | None:
    """Plots the cumulative distributions of the absolute height error of the map cells, with a line at 90 %.

    Returns:
        The figure; None if no run has height errors.
    """
    figure = Figure(figsize=(WIDTH_IN, 3.4))
    axes = figure.add_subplot()
    for k, (run, name) in enumerate(zip(runs, names, strict=True)):
        if "dem_error" not in run.rasters:
            continue
        size_m = np.abs(run.rasters["dem_error"].values)
        size_m = size_m[np.isfinite(size_m)]
        if len(size_m):
            share = np.linspace(2, 99.8, 490)  # both tails are long on a logarithmic axis
            axes.plot(np.percentile(size_m, share), share, _RUN_STYLES[k], color=_RUN_COLOURS[k], label=name)
    if not axes.lines:
        return None
    axes.axhline(90, color=COLOURS["limit"], linewidth=0.8)
    axes.set(xlabel="absolute height error [m]", ylabel="cells up to this error [%]", ylim=(0, 100))
    log_axis(axes.xaxis)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1))
    return figure
