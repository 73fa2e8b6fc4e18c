"""Figure of a tank experiment: network, paths, true and estimated height, predicted and actual error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize

from twin.report.style import COLOURS
from twin.reproduce.exhibit import drawn, extent_of
from twin.reproduce.tank_survey import TankSurvey, height_errors

LEAST_M, LARGEST_M = 2e-4, 0.1  # limits of the logarithmic scale of sigma and error


def draw(title: str, survey: TankSurvey, file: Path) -> None:
    """Draws the figure to a PNG file."""
    with drawn(file, 13.0, 7.4) as figure:
        figure.suptitle(title, fontsize=12)
        panels = figure.subplots(2, 3)
        _network(panels[0, 0], survey)
        _paths(panels[1, 0], survey)
        heights, scale = Normalize(-0.01, float(survey.truth.height_m.max())), LogNorm(LEAST_M, LARGEST_M)
        error = np.maximum(np.abs(height_errors(survey)), LEAST_M)
        for axes, values, title, cmap, norm in (
            (panels[0, 1], survey.truth.height_m, "true height [m]", "viridis", heights),
            (panels[1, 1], survey.elevation.height_m, "height in the map [m]", "viridis", heights),
            (panels[0, 2], survey.elevation.sigma_m, "predicted sigma [m]", "magma", scale),
            (panels[1, 2], error, "absolute height error [m]", "magma", scale),
        ):
            image = axes.imshow(values, extent=extent_of(survey.mission.grid), cmap=cmap, norm=norm)
            axes.set(title=title)
            axes.set_facecolor("#dfe6ea")  # cells without a value
            axes.grid(visible=False)
            bar = figure.colorbar(image, ax=axes, shrink=0.7)
            if norm is scale:
                bar.ax.yaxis.set_major_formatter("{x:g}")


def _network(axes: Axes, survey: TankSurvey) -> None:
    links, positions = survey.result.links, survey.result.final.positions[survey.result.keyframe_rows]
    axes.imshow(survey.elevation.mosaic, extent=extent_of(survey.mission.grid))
    ends = np.stack([positions[links.i, :2], positions[links.j, :2]], axis=1)
    axes.add_collection(LineCollection(list(ends), colors=COLOURS["f2f"], linewidths=0.5, alpha=0.7))
    axes.plot(*positions[:, :2].T, ".", markersize=3, color=COLOURS["online"])
    axes.set(title=f"{len(positions)} keyframes, {len(links)} connections, mosaic", aspect="equal")
    axes.grid(visible=False)


def _paths(axes: Axes, survey: TankSurvey) -> None:
    shown = (
        (survey.path.planned_m, "reference", "as read on the track", 1.0),
        (survey.truth.trajectory.positions, "truth", "true", 4.0),
        (survey.result.f2f.positions, "f2f", "before alignment (F2F)", 1.2),
        (survey.result.final.positions, "final", "after alignment", 1.2),
    )
    for positions, role, label, width in shown:
        alpha = 0.35 if role == "truth" else 1.0
        axes.plot(*positions[:, :2].T, color=COLOURS[role], label=label, linewidth=width, alpha=alpha)
    axes.set(title="path of the left camera", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(fontsize=7, loc="upper right")
