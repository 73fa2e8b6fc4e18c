"""Counterparts of Figs. 4 to 7 of Negahdaripour & Madjidi (2003)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from twin.judge.map_error import height_error
from twin.judge.trajectory_errors import keyframe_errors_m, path_errors
from twin.report.plotting import extent_of, hillshade, log_axis, png_figure
from twin.report.style import COLOURS
from twin.reproduce.paper_flight import Flown

SHADES = ("#d55e00", "#0072b2")  # coarse texture, full resolution
MAP_CELLS = 700  # longest side of a drawn map


def draw_paths(flights: Mapping[str, Flown], file: Path) -> None:
    """Draws the true, the F2F and the aligned path of each flight (Fig. 4)."""
    with png_figure(file, 12.0, 6.4) as figure:
        panels = figure.subplots(1, len(flights), squeeze=False)[0]
        for axes, (name, flown) in zip(panels, flights.items(), strict=True):
            truth, f2f, final = flown.truth.trajectory, flown.result.f2f, flown.result.final
            axes.plot(*truth.positions[:, :2].T, color=COLOURS["truth"], label="true", linewidth=4.0, alpha=0.35)
            axes.plot(*f2f.positions[:, :2].T, color=COLOURS["f2f"], label="F2F alone", linewidth=0.9)
            axes.plot(*final.positions[:, :2].T, color=COLOURS["final"], label="after alignment", linewidth=0.9)
            axes.set(title=name, xlabel="x [m]", ylabel="y [m]")
            axes.axis("equal")
            axes.legend(fontsize=8)


def draw_tracks(flights: Mapping[str, Flown], tracks: Sequence[int], file: Path) -> None:
    """Draws the errors of all keyframes up to the end of each track, before and after its alignment (Fig. 5)."""
    with png_figure(file, 12.0, 8.0) as figure:
        panels = figure.subplots(3, -(-len(tracks) // 3), squeeze=False).ravel()
        for axes, track in zip(panels, tracks, strict=False):
            for (name, flown), colour in zip(flights.items(), SHADES, strict=False):
                _keyframe_errors(axes, flown, track, name, colour)
            axes.set(title=f"track {track}")
            log_axis(axes.yaxis)
        panels[0].legend(fontsize=7)
        figure.supxlabel("keyframe")
        figure.supylabel("position error [mm]")


def _keyframe_errors(axes: Axes, flown: Flown, track: int, name: str, colour: str) -> None:
    result = flown.result
    numbers = [alignment.track for alignment in result.alignments[: len(result.before_ga)]]
    if track not in numbers:
        return
    k, frames = numbers.index(track), result.keyframe_rows[result.track_of_keyframe <= track]
    for positions, width, when in ((result.before_ga[k], 0.8, "before"), (result.after_ga[k], 2.2, "after")):
        error_mm = 1e3 * keyframe_errors_m(positions, frames, result, flown.truth)
        axes.plot(np.maximum(error_mm, 1e-2), color=colour, linewidth=width, label=f"{name}, {when} GA")


def draw_errors(flights: Mapping[str, Flown], file: Path) -> None:
    """Draws position, height and heading error along the path, with the ends of the tracks (Fig. 6)."""
    with png_figure(file, 12.0, 7.0) as figure:
        position, height, heading = figure.subplots(3, 1, sharex=True)
        for (name, flown), colour in zip(flights.items(), SHADES, strict=False):
            errors = path_errors(flown.result.final, flown.truth.trajectory)
            style = {"color": colour, "label": name, "linewidth": 0.9}
            position.plot(errors.travelled_m, 1e3 * errors.distance_m, **style)
            height.plot(errors.travelled_m, 1e3 * errors.position_m[:, 2], **style)
            heading.plot(errors.travelled_m, np.rad2deg(errors.heading_rad), **style)
        first = next(iter(flights.values()))
        travelled = path_errors(first.result.final, first.truth.trajectory).travelled_m
        ends = travelled[1:][np.diff(first.truth.track[: len(travelled)]) > 0]
        for axes in (position, height, heading):
            for end in ends:
                axes.axvline(end, color="#9aa8b0", linestyle="--", linewidth=0.6)
        position.set(ylabel="position error [mm]")
        height.set(ylabel="height error [mm]")
        heading.set(ylabel="heading error [deg]", xlabel="length of the true path [m]")
        position.legend(ncols=2, loc="lower left", bbox_to_anchor=(0, 1.0))


def draw_maps(coarse: Flown, unaligned: Flown, fine: Flown, file: Path) -> None:
    """Draws the true floor, the maps of the three flights and the histograms of their errors (Fig. 7)."""
    with png_figure(file, 13.0, 8.6) as figure:
        panels = figure.subplots(2, 3)
        heights = coarse.truth.height_m
        scale = float(np.nanmin(heights)), float(np.nanmax(heights))
        maps = (
            ("true elevation", coarse, heights),
            ("after alignment, coarse texture", coarse, coarse.elevation.height_m),
            ("flown without alignment, coarse texture", unaligned, unaligned.elevation.height_m),
            ("after alignment, full resolution", fine, fine.elevation.height_m),
        )
        for axes, (title, flown, values) in zip(panels.ravel(), maps, strict=False):
            _map(axes, flown, np.where(flown.truth.asked | flown.truth.seen, values, np.nan), scale)
            axes.set_title(title)
        _histogram(panels[1, 1], {"coarse texture": coarse, "full resolution": fine})
        _histogram(panels[1, 2], {"coarse texture": coarse, "flown without alignment": unaligned})


def _map(axes: Axes, flown: Flown, values: NDArray[np.floating], scale: tuple[float, float]) -> None:
    grid = flown.mission.grid
    step = max(1, -(-max(values.shape) // MAP_CELLS))
    axes.imshow(hillshade(values[::step, ::step], "viridis", scale), extent=extent_of(grid))
    axes.set_facecolor("white")
    axes.grid(visible=False)
    axes.set(xlabel="x [m]", ylabel="y [m]")


def _histogram(axes: Axes, flights: Mapping[str, Flown]) -> None:
    sizes = {}
    for name, flown in flights.items():
        error = np.abs(height_error(flown.elevation, flown.truth))
        sizes[name] = 1e3 * error[np.isfinite(error)]
    top = max((float(np.percentile(size, 99)) for size in sizes.values() if len(size)), default=1.0)
    for (name, size), colour in zip(sizes.items(), (*SHADES, "#999999"), strict=False):
        axes.hist(np.minimum(size, top), bins=60, range=(0, top), histtype="step", color=colour, label=name)
    axes.set(xlabel="absolute height error [mm]; last bar: or larger", ylabel="cells")
    log_axis(axes.yaxis)
    axes.legend(fontsize=8)
