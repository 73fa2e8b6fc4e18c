"""Contact sheet of `twin look`: stereo pair and light components of the left image, with units and value ranges."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from twin.app.look import ViewLayers
from twin.imaging.light.optics import range_of
from twin.imaging.light.water import clarity
from twin.report.number_formats import DASH
from twin.report.plotting import png_figure
from twin.scenario.model import Scenario

PANEL_IN = 3.5
#: Percentile of a light component that is displayed as white.
SHOWN_PERCENTILE = 99.5
_SHADOW = {"facecolor": "#00000088", "edgecolor": "none", "pad": 2.0}


class Panel(NamedTuple):
    title: str
    unit: str
    values: NDArray[Any]  #: values whose minimum, median and maximum are printed, apart from those that are not finite
    picture: NDArray[Any]  #: (H, W, 3) colours from 0 to 1, or (H, W) values for the colour map
    note: str = ""  #: text in the corner of the picture
    #: name of the colour map, and the values at its lower and upper end
    colours: tuple[str, float, float] = ("viridis", 0.0, 1.0)


def draw(scenario: Scenario, view: ViewLayers, file: Path) -> None:
    panels = _panels(scenario, view)
    columns = 4 if len(panels) <= 8 else 5
    rows = -(-len(panels) // columns)
    height, width = view.stereo_pair.depth_left.shape
    height_in = 0.5 + rows * (PANEL_IN * height / width + 0.42)
    with png_figure(file, columns * PANEL_IN, height_in, grid=False) as figure:
        figure.suptitle(_headline(scenario, view), fontsize=11)
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid:
            axes.set_axis_off()
        for axes, panel in zip(grid, panels, strict=False):
            _draw_panel(axes, panel)


def _headline(scenario: Scenario, view: ViewLayers) -> str:
    x, y, z = view.world_from_left[:3, 3]
    water, lamps = scenario.water, len(scenario.lamps)
    light = f"{lamps} lamp{'' if lamps == 1 else 's'}"
    if scenario.sun.illuminance_lx:
        light += f" and {scenario.sun.illuminance_lx:g} lx of daylight"
    at = f"left camera at ({x:g}, {y:g}, {z:g}) m"
    if scenario.sensor is not None:
        exposure = view.decomposed.setting
        light += f"; {1000 * exposure.exposure_s:.3g} ms at gain {exposure.analogue_gain:.3g}"
    return f"{scenario.name}: {at}; water {water.label}, {clarity(water)}; {light}"


def _panels(scenario: Scenario, view: ViewLayers) -> list[Panel]:
    a, left, right, noise = view.decomposed, view.stereo_pair.left, view.stereo_pair.right, view.noise
    assert right is not None
    range_m = range_of(a.depth, scenario.believed_rig())
    known_m = range_m[np.isfinite(range_m)]
    ends_m = (float(known_m.min()), float(known_m.max())) if known_m.size else (0.0, 1.0)
    reach = max(3 * noise.std(), 1.0)
    panels = [
        Panel("left", "grey level", left, left / 255),
        Panel("right", "grey level", right, right / 255),
        Panel("range", "m", range_m, range_m, colours=("viridis_r", *ends_m)),
        Panel("albedo", "1", a.albedo / 255, a.albedo / 255),
        _light("light on the sea floor", "lx", a.components.floor_lx, 0.0),
        _light("direct signal", "cd/m2", a.components.direct, a.setting.gain, a.linear),
        _light("backscatter", "cd/m2", a.components.backscatter, a.setting.gain, a.linear),
        Panel("noise", "grey level", noise, noise.mean(axis=2), "mean of the bands", ("RdBu_r", -reach, reach)),
    ]
    if a.components.forward is not None:
        panels.append(_light("forward scatter", "cd/m2", a.components.forward, a.setting.gain, a.linear))
    if a.components.snow is not None:
        panels.append(_light("marine snow", "cd/m2", a.components.snow, a.setting.gain, a.linear, 100.0))
    return panels


def _light(
    title: str, unit: str, layer: NDArray[np.float32], gain: float, linear: bool = True,
    percentile: float = SHOWN_PERCENTILE,
) -> Panel:  # fmt: skip
    """Returns the colour panel of one light component (H, W, 3); black where its `percentile` is not positive."""
    # A component whose `percentile` lies between half and full scale is shown as in the image. Any other is scaled so
    # that it is white, by the factor in the note (for gain 0, not in the image: the value shown as white).
    top = float(np.nanpercentile(layer, percentile)) if np.isfinite(layer).any() else 0.0
    if top <= 0:
        return Panel(title, unit, layer, np.zeros(layer.shape), "none")
    exposed = gain * top
    image = "in the image" if linear else "in the image\nbefore tone curve and white balance"
    if 0.5 < exposed <= 1:
        return Panel(title, unit, layer, layer * gain, f"as bright as {image}")
    note = f"white = {_short(top)} {unit}"
    if gain:
        factor = f"{1 / exposed:.2g}" if exposed > 0.01 else f"{round(1 / exposed, -2):.0f}"
        note = f"{factor} times as bright as {image}"
    return Panel(title, unit, layer, layer / top, note)


def _draw_panel(axes: Axes, panel: Panel) -> None:
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
    return f"min {_short(finite.min())}, median {_short(np.median(finite))}, max {_short(finite.max())}"


def _short(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
