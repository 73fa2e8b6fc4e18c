"""Drawing of a survey plan: the path over the sea floor, and the overlap of the images."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon, Rectangle

from twin.planning.summary import OVERLAP_TOLERANCE, PlanSummary, required_overlaps
from twin.report.style import COLOURS, FIGURE_STYLE, LABELS
from twin.world.mission import Mission

_SHADE_SAMPLES = 400
_LEAST_DRAWN_M = 0.005  #: height above the floor at which the outlines of the objects are drawn


def draw(summary: PlanSummary, file: Path) -> Path:
    """Writes a PNG file that shows path and overlap of the plan over the floor from above, and returns its path."""
    mission = summary.mission
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(14, 6.5))
        plan, overlap = figure.subplots(1, 2, sharex=True, sharey=True)
        _draw_floor(plan, summary)
        _draw_path(plan, mission)
        _draw_overlap(overlap, summary)
        plan.set(xlabel="x, east [m]", ylabel="y, north [m]", title=f"Plan of {mission.scenario.name}")
        overlap.set(xlabel="x, east [m]", title="Overlap over the floor")
        for axes in (plan, overlap):
            axes.set_aspect("equal")
        figure.legend(loc="outside lower center", ncols=5)
        file.parent.mkdir(parents=True, exist_ok=True)
        FigureCanvasAgg(figure).print_png(str(file))
    return file


def _draw_overlap(axes: Axes, summary: PlanSummary) -> None:
    """Draws the overlap of each image pair midway between its two cameras; outlined where it is insufficient."""
    floor, t = summary.floor, summary.mission.terrain
    along, across = required_overlaps(summary.mission)
    axes.set(xlim=(t.west_m, t.east_m), ylim=(t.south_m, t.north_m))
    axes.add_patch(_area(summary.mission, ec=COLOURS["limit"], ls="--", fill=False, linewidth=1.4))
    pairs = (
        ("along", "o", 14, floor.along_position_m, floor.overlap_along, along),
        ("across", "D", 9, floor.across_position_m, floor.overlap_across, across),
    )
    short_label = "less than required"
    for name, marker, size, position, values, least in pairs:
        colours = {"c": values, "cmap": "viridis", "vmin": 0, "vmax": 1}
        shown = axes.scatter(*position.T, s=size, marker=marker, label=f"overlap {name}", **colours)
        short = values < least - OVERLAP_TOLERANCE
        if short.any():
            style = {"facecolors": "none", "edgecolors": COLOURS["limit"], "linewidths": 0.8}
            axes.scatter(*position[short].T, s=2.2 * size, marker=marker, label=short_label, **style)
            short_label = "_"
        if name == "along":
            axes.figure.colorbar(shown, ax=axes, label="overlap", shrink=0.8)


def _draw_floor(axes: Axes, summary: PlanSummary) -> None:
    mission = summary.mission
    t, top = mission.terrain, summary.floor.surface
    x, y = np.linspace(t.west_m, t.east_m, _SHADE_SAMPLES), np.linspace(t.north_m, t.south_m, _SHADE_SAMPLES)
    hole = t.in_hole(*np.meshgrid(x, y))
    height, top_m = (np.where(hole, np.nan, surface.height_at(*np.meshgrid(x, y))) for surface in (t, top))
    steps = (x[1] - x[0], y[0] - y[1])
    shade = LightSource(315, 45).hillshade(top_m, vert_exag=1, dx=steps[0], dy=steps[1])
    axes.imshow(shade, cmap="gray", vmin=-0.5, vmax=1.1, extent=(t.west_m, t.east_m, t.south_m, t.north_m))
    if np.nanmax(height, initial=-np.inf) > np.nanmin(height, initial=np.inf):
        contours = axes.contour(x, y, height, levels=6, cmap="viridis", linewidths=0.8)
        axes.clabel(contours, fmt="%.2f m", fontsize=7)
    if top is not t:
        axes.contour(x, y, top_m - height, levels=[_LEAST_DRAWN_M], colors=[COLOURS["truth"]], linewidths=0.9)
        axes.plot([], [], color=COLOURS["truth"], linewidth=0.9, label=f"{len(mission.objects)} objects")


def _draw_path(axes: Axes, mission: Mission) -> None:
    path = mission.plan.outline()
    axes.plot(path[:, 0], path[:, 1], color=COLOURS["online"], label=f"{LABELS['reference']} path")
    axes.plot(*path[0, :2], "o", color=COLOURS["final"], label="start")
    across_m, along_m = mission.plan.request.footprint_m
    first_image = (path[0, 0] - along_m / 2, path[0, 1] - across_m / 2)
    style = {"fill": False, "linewidth": 1.4}
    turned = {"angle": np.degrees(mission.plan.area.heading), "rotation_point": "center"}
    axes.add_patch(Rectangle(first_image, along_m, across_m, ec=COLOURS["f2f"], label="one image", **turned, **style))
    axes.add_patch(_area(mission, ec=COLOURS["limit"], ls="--", label="area", **style))


def _area(mission: Mission, **style) -> Patch:
    return Polygon(mission.plan.area.outline(), closed=True, **style)
