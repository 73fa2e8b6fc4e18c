"""The sheet of a look: the stereo pair and every layer of the left image, each with its unit and its least, median and
largest value."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.app.look import Look, noise_of
from twin.imaging.optics import range_of
from twin.report.style import FIGURE_STYLE
from twin.report.wording import DASH
from twin.scenario.model import Scenario

PANEL_IN = 3.5
#: A layer is shown so bright that this share of it is not clipped.
SHOWN_PERCENTILE = 99.5
_SHADOW = {"facecolor": "#00000088", "edgecolor": "none", "pad": 2.0}


class Panel(NamedTuple):
    """One picture of the sheet.

    Args:
        title, unit: of the values.
        values: what is told in numbers; NaN does not count.
        picture: (H, W, 3) colours 0 to 1, or (H, W) for the colour map.
        note: said in the corner.
        colours: name of the colour map, its ends.
    """

    title: str
    unit: str
    values: NDArray[Any]
    picture: NDArray[Any]
    note: str = ""
    colours: tuple[str, float, float] = ("viridis", 0.0, 1.0)


def draw(scenario: Scenario, seen: Look, file: Path) -> Path:
    """Writes the sheet as PNG."""
    panels = _panels(scenario, seen)
    columns = 4 if len(panels) <= 8 else 5
    rows = -(-len(panels) // columns)
    height, width = seen.shot.depth_left.shape
    size_in = (columns * PANEL_IN, 0.5 + rows * (PANEL_IN * height / width + 0.42))
    style: dict[Any, Any] = {**FIGURE_STYLE, "axes.grid": False}
    with matplotlib.rc_context(style):
        figure = Figure(figsize=size_in)
        figure.suptitle(_headline(scenario, seen), fontsize=11)
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid:
            axes.set_axis_off()
        for axes, panel in zip(grid, panels, strict=False):
            _show(axes, panel)
        file.parent.mkdir(parents=True, exist_ok=True)
        FigureCanvasAgg(figure).print_png(str(file))
    return file


def _headline(scenario: Scenario, seen: Look) -> str:
    x, y, z = seen.world_from_left[:3, 3]
    water, lamps = scenario.water, len(scenario.lamps)
    light = f"{lamps} lamp{'' if lamps == 1 else 's'}"
    if scenario.sun.illuminance_lx:
        light += f" and {scenario.sun.illuminance_lx:g} lx of daylight"
    at = f"left camera at ({x:g}, {y:g}, {z:g}) m"
    if scenario.sensor is not None:
        light += f"; {1000 * seen.anatomy.setting.exposure_s:.3g} ms at gain {seen.anatomy.setting.analogue_gain:.3g}"
    return f"{scenario.name}: {at}; water {water.label}; {light}"


def _panels(scenario: Scenario, seen: Look) -> list[Panel]:
    a, shot = seen.anatomy, seen.shot
    assert shot.right is not None
    noise = noise_of(seen)
    range_m = range_of(a.depth, scenario.believed_rig())
    reach = max(3 * noise.std(), 1.0)
    panels = [
        Panel("left", "gray level", shot.left, shot.left / 255),
        Panel("right", "gray level", shot.right, shot.right / 255),
        Panel("range", "m", range_m, range_m, colours=("viridis_r", *_ends(range_m))),
        Panel("albedo", "1", a.albedo / 255, a.albedo / 255),
        _light("light on the floor", "lx", a.layers.floor_lx, 0.0),
        _light("direct signal", "cd/m2", a.layers.direct, a.gain),
        _light("veil (backscatter)", "cd/m2", a.layers.veil, a.gain),
        Panel("noise", "gray level", noise, noise.mean(axis=2), "mean of bands", ("RdBu_r", -reach, reach)),
    ]
    if a.layers.forward is not None:
        panels.append(_light("scattered forward", "cd/m2", a.layers.forward, a.gain))
    if a.layers.snow is not None:
        panels.append(_light("marine snow", "cd/m2", a.layers.snow, a.gain, 100.0))
    return panels


def _light(
    title: str, unit: str, layer: NDArray[np.float32], gain: float, percentile: float = SHOWN_PERCENTILE
) -> Panel:
    """A layer of light in its colours: as bright as in the image (gain > 0), or by a factor that is told."""
    top = float(np.nanpercentile(layer, percentile)) if np.isfinite(layer).any() else 0.0
    if top <= 0:
        return Panel(title, unit, layer, np.zeros(layer.shape), "none")
    exposed = gain * top
    if 0.5 < exposed <= 1:
        return Panel(title, unit, layer, layer * gain, "as bright as in the image")
    note = f"shown {_factor(1 / exposed)} as bright as in the image" if gain else f"white = {_short(top)} {unit}"
    return Panel(title, unit, layer, layer / top, note)


def _factor(value: float) -> str:
    return f"{value:.2g} times" if value < 100 else f"{round(value, -2):.0f} times"


def _show(axes: Axes, panel: Panel) -> None:
    shown = np.nan_to_num(panel.picture, nan=0.0) if panel.picture.ndim == 3 else panel.picture
    name, low, high = panel.colours
    image = axes.imshow(np.clip(shown, 0, 1) if shown.ndim == 3 else shown, cmap=name, vmin=low, vmax=high)
    axes.set_title(f"{panel.title} [{panel.unit}]\n", loc="left", fontsize=10)
    axes.text(0, 1.02, _in_numbers(panel.values), transform=axes.transAxes, fontsize=8, color="#44545c")
    if panel.note:
        axes.text(0.02, 0.03, panel.note, transform=axes.transAxes, fontsize=7.5, color="white", bbox=_SHADOW)
    if shown.ndim == 2:
        bar = axes.inset_axes((0.955, 0.05, 0.025, 0.9))
        axes.figure.colorbar(image, cax=bar)
        bar.yaxis.set_ticks_position("left")
        bar.tick_params(labelsize=7, colors="white", length=2)
        for label in bar.get_yticklabels():
            label.set_bbox(_SHADOW | {"pad": 1.0})


def _in_numbers(values: NDArray[Any]) -> str:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return f"min {DASH}, median {DASH}, max {DASH}"
    least, median, most = finite.min(), np.median(finite), finite.max()
    return f"min {_short(least)}, median {_short(median)}, max {_short(most)}"


def _short(value: float) -> str:
    """Three digits, whole numbers whole."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _ends(values: NDArray[np.float64]) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
