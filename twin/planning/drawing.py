"""Drawing of a plan (path over the sea floor, overlap of the images) and of a vehicle's limits."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource, ListedColormap

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import cast_pixels
from twin.planning.summary import OVERLAP_TOLERANCE, PlanSummary, required_overlaps
from twin.planning.vehicle_limits import VehicleLimits, axes_of, electrical_power_w
from twin.report.plotting import add_coordinates, png_figure
from twin.report.style import COLOURS, LABELS
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import thrust_loads, top_speed_mps
from twin.world.mission import Mission
from twin.world.planning import floor_of

_SHADE_SAMPLES = 400
_EDGE_POINTS = 40  #: along each side of the outline of an image
_LEAST_DRAWN_M = 0.005  #: height above the floor at which the outlines of the objects are drawn


def draw(summary: PlanSummary, file: Path) -> None:
    """Writes a PNG file that shows path and overlap of the plan over the floor from above."""
    mission = summary.mission
    with png_figure(file, 14, 6.5) as figure:
        plan, overlap = figure.subplots(1, 2, sharex=True, sharey=True)
        _draw_floor(plan, summary)
        _draw_path(plan, summary)
        add_coordinates(plan, mission.chart.georeference)
        _draw_overlap(overlap, summary)
        plan.set(xlabel="x, east [m]", ylabel="y, north [m]", title=f"Plan of {mission.scenario.name}")
        overlap.set(xlabel="x, east [m]", title="Overlap over the floor")
        for axes in (plan, overlap):
            axes.set_aspect("equal")
        figure.legend(loc="outside lower center", ncols=5)


def _draw_overlap(axes: Axes, summary: PlanSummary) -> None:
    """Draws the overlap of each image pair midway between its two cameras; outlined where it is insufficient."""
    floor, t = summary.floor, summary.mission.chart
    along, across = required_overlaps(summary.mission)
    axes.set(xlim=(t.west_m, t.east_m), ylim=(t.south_m, t.north_m))
    _draw_area(axes, summary.mission)
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
    t, top = mission.chart, summary.floor.surface
    extent = t.west_m, t.east_m, t.south_m, t.north_m
    x, y = np.linspace(t.west_m, t.east_m, _SHADE_SAMPLES), np.linspace(t.north_m, t.south_m, _SHADE_SAMPLES)
    points = np.meshgrid(x, y)
    hole, height = t.in_hole(*points), t.height_at(*points)
    top_m = height if top is t else top.height_at(*points)
    shade = LightSource(315, 45).hillshade(top_m, dx=x[1] - x[0], dy=y[0] - y[1])
    axes.imshow(np.where(hole, np.nan, shade), cmap="gray", vmin=-0.5, vmax=1.1, extent=extent)
    height, top_m = (np.where(hole, np.nan, heights) for heights in (height, top_m))
    if np.nanmax(height, initial=-np.inf) > np.nanmin(height, initial=np.inf):
        contours = axes.contour(x, y, height, levels=6, cmap="viridis", linewidths=0.8)
        axes.clabel(contours, fmt="%.2f m", fontsize=7)
    if top is not t:
        axes.contour(x, y, top_m - height, levels=[_LEAST_DRAWN_M], colors=[COLOURS["truth"]], linewidths=0.9)
        axes.plot([], [], color=COLOURS["truth"], linewidth=0.9, label=f"{len(mission.objects)} objects")
    masks = {
        "hole": (hole, f"no height ({100 * t.unknown_share:.3g} % of the floor)"),
        "filled": (t.in_filled(*points), "small holes, filled"),
    }
    for colour, (mask, label) in masks.items():
        if mask.any():
            axes.imshow(np.where(mask, 1.0, np.nan), cmap=ListedColormap([COLOURS[colour]]), extent=extent)
            axes.plot([], [], "s", color=COLOURS[colour], label=label)


def _draw_path(axes: Axes, summary: PlanSummary) -> None:
    mission = summary.mission
    path = mission.plan.outline()
    axes.plot(path[:, 0], path[:, 1], color=COLOURS["online"], label=f"{LABELS['reference']} path")
    axes.plot(*path[0, :2], "o", color=COLOURS["final"], label="start")
    axes.plot(*_first_image(summary).T, color=COLOURS["f2f"], label="one image, on the floor")
    _draw_area(axes, mission, label="area")


def _first_image(summary: PlanSummary) -> Array:
    """Returns points (n, 2) around the floor in the first image [m]; NaN where it shows none."""
    rig, pose = summary.mission.rig, summary.floor.keyframes.world_from_camera[:1]
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * [rig.width_px, rig.height_px] - 0.5
    pixels = np.concatenate([np.linspace(a, b, _EDGE_POINTS) for a, b in pairwise(corners)])
    depth_m = cast_pixels(floor_of(summary.floor.surface), pose, rig, pixels)[0]
    depth_m[np.isinf(depth_m)] = np.nan
    rays = np.column_stack([rig.normalised(pixels), np.ones(len(pixels))])
    return geometry.transform(pose[0], depth_m[:, None] * rays)[:, :2]


def _draw_area(axes: Axes, mission: Mission, label: str = "_") -> None:
    for outline in mission.plan.area.outlines():
        axes.plot(*outline.T, color=COLOURS["limit"], linestyle="--", label=label)
        label = "_"


def draw_vehicle(vehicle: VehicleConfig, limits: VehicleLimits, file: Path) -> None:
    """Writes a PNG file that shows speed by thrust, power by speed, and the current that the vehicle holds."""
    with png_figure(file, 14, 4.5) as figure:
        speed, power = (figure.add_subplot(1, 3, k) for k in (1, 2))
        for name, axis in axes_of(vehicle).items():
            speeds = np.linspace(0, limits.speeds_mps[name], 60)
            velocities = speeds[:, None] * np.array(axis)
            speed.plot(100 * thrust_loads(vehicle, velocities), speeds, label=name)
            power.plot(speeds, electrical_power_w(vehicle, velocities), label=name)
        speed.axhline(limits.speed_mps, ls=":", color="0.4", label="planned speed")
        power.axvline(limits.speed_mps, ls=":", color="0.4")
        speed.set(xlabel="thrust of the busiest thruster [%]", ylabel="speed [m/s]", title=f"Speed of {limits.title}")
        power.set(xlabel="speed [m/s]", ylabel="electrical power [W]", title="Power", ylim=(0, None))
        speed.legend()
        if not vehicle.is_steered_by_fins:
            _draw_currents(figure.add_subplot(1, 3, 3, projection="polar"), vehicle)


def _draw_currents(axes: Any, vehicle: VehicleConfig) -> None:
    bearings = np.linspace(0, 2 * np.pi, 181)
    directions = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros_like(bearings)])
    axes.plot(bearings, [top_speed_mps(vehicle, direction) for direction in directions])
    axes.set_theta_zero_location("N")
    axes.set_title("Current that it holds, by bearing from the bow [m/s]")
