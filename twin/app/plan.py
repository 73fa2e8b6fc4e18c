"""Properties of a survey predicted from its plan, without simulation: a table and a drawing."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle

from controllers.forecast import forecast
from twin.report.style import COLOURS, FIGURE_STYLE, LABELS
from twin.report.wording import length, percent
from twin.world.mission import Mission

#: Standard deviation of the disparity on good texture [px]; the predicted depth error is proportional to it.
DISPARITY_SIGMA_PX = 0.1
_SHADE_SAMPLES = 400
#: For each pattern: name of a swath, and the swaths that make up a track.
_SWATHS = {"lawnmower": ("leg", "two legs"), "loops": ("loop", "a loop")}


def numbers(mission: Mission) -> list[tuple[str, str]]:
    """Returns the predicted properties of a survey as text: pairs (name, value with unit)."""
    f = forecast(mission.plan, mission.rig.baseline_m, DISPARITY_SIGMA_PX)
    width_m, height_m = f.footprint_m
    swath, of_track = _SWATHS[mission.scenario.plan.pattern]
    tracks = len(mission.tracks)
    hold_s = mission.scenario.control.hold_s * tracks
    return [
        (f"tracks L, {of_track} each", f"{tracks}"),
        ("frames per keyframe N", f"{f.n_frames_per_keyframe}"),
        (f"keyframes per {swath} M", f"{f.keyframes_per_swath}"),
        ("keyframes", f"{f.n_keyframes}"),
        ("frames", f"{mission.n_frames}"),
        ("time", f"{f.duration_s + hold_s:.0f} s, of which {hold_s:.0f} s station keeping"),
        ("path", length(f.path_m)),
        ("speed", f"{length(f.speed_mps)} per second along a {swath}"),
        ("footprint", f"{length(width_m)} across, {length(height_m)} along"),
        ("spacing", f"{length(f.keyframe_spacing_m)} between keyframes, {length(f.swath_spacing_m)} between {swath}s"),
        ("overlap", f"{percent(f.overlap_along)} along, {percent(f.overlap_across)} across"),
        ("disparity", f"{f.disparity_px:.1f} px"),
        ("depth error", f"{length(f.depth_sigma_m)} (1 sigma, for a disparity error of {DISPARITY_SIGMA_PX:g} px)"),
    ]


def draw(mission: Mission, file: Path) -> Path:
    """Writes a PNG of sea floor, planned path, image footprint and survey area from above; returns its path."""
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(7.5, 6.5))
        axes = figure.add_subplot()
        _draw_floor(axes, mission)
        _draw_path(axes, mission)
        axes.set(xlabel="x, east [m]", ylabel="y, north [m]", title=f"Plan of {mission.scenario.name}")
        axes.set_aspect("equal")
        figure.legend(loc="outside lower center", ncols=4)
        file.parent.mkdir(parents=True, exist_ok=True)
        FigureCanvasAgg(figure).print_png(str(file))
    return file


def _draw_floor(axes: Axes, mission: Mission) -> None:
    """Draws the shaded sea floor with height contours."""
    t = mission.terrain
    x, y = np.linspace(t.west_m, t.east_m, _SHADE_SAMPLES), np.linspace(t.north_m, t.south_m, _SHADE_SAMPLES)
    height = t.height_at(*np.meshgrid(x, y))
    steps = (x[1] - x[0], y[0] - y[1])
    shade = LightSource(315, 45).hillshade(height, vert_exag=1, dx=steps[0], dy=steps[1])
    axes.imshow(shade, cmap="gray", vmin=-0.5, vmax=1.1, extent=(t.west_m, t.east_m, t.south_m, t.north_m))
    if np.ptp(height) > 0:
        contours = axes.contour(x, y, height, levels=6, cmap="viridis", linewidths=0.8)
        axes.clabel(contours, fmt="%.2f m", fontsize=7)


def _draw_path(axes: Axes, mission: Mission) -> None:
    """Draws the planned path, the footprint of the first image and the survey area."""
    path = mission.plan.outline()
    axes.plot(path[:, 0], path[:, 1], color=COLOURS["online"], label=f"{LABELS['reference']} path")
    axes.plot(*path[0, :2], "o", color=COLOURS["final"], label="start")
    across_m, along_m = mission.plan.footprint_m
    first_image = (path[0, 0] - along_m / 2, path[0, 1] - across_m / 2)
    style = {"fill": False, "linewidth": 1.4}
    axes.add_patch(Rectangle(first_image, along_m, across_m, ec=COLOURS["f2f"], label="one image", **style))
    axes.add_patch(_area(mission, ec=COLOURS["limit"], ls="--", label="area", **style))


def _area(mission: Mission, **style) -> Patch:
    """Returns the outline of the survey area."""
    area_x, area_y = mission.plan.area_m
    if mission.scenario.plan.pattern == "loops":
        return Circle((0, 0), area_x / 2, **style)
    return Rectangle((-area_x / 2, -area_y / 2), area_x, area_y, **style)
