"""Figure that compares the light model with the reference: total light and veil over height, sharp share, blur."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from twin.imaging.reference.pixel_light import BatchMean
from twin.report.figures import log_axis
from twin.report.style import FIGURE_STYLE
from twin.reproduce.light_cell import LightCell

MARKERS = {"leds": "o", "spots": "^"}
OFFSET_M = 0.08  # horizontal distance between the markers of two pixels at the same height


def draw(cells: Sequence[LightCell], file: Path) -> Path:
    """Draws the figure, writes it to a PNG file and returns the path of the file."""
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(12.0, 7.5))
        grid = figure.subplots(2, 2)
        figure.suptitle(
            "Light model and Monte Carlo reference, green band; bars: two standard errors of the reference", fontsize=12
        )
        _ratios(grid[0, 0], cells, "total light, model / reference", lambda cell: _over(cell.model.total, cell.total))
        _ratios(grid[0, 1], cells, "veil, reference / model", lambda cell: _scaled(cell.veil, cell.model.veil))
        _shares(grid[1, 0], cells)
        _blur(grid[1, 1], cells)
        FigureCanvasAgg(figure).print_png(str(file))
    return file


def _over(model: float, truth: BatchMean) -> BatchMean:
    """Returns model / truth with its standard error."""
    value = model / truth.value
    return BatchMean(value, value * truth.standard_error / truth.value)


def _scaled(truth: BatchMean, model: float) -> BatchMean:
    """Returns truth / model with its standard error; NaN if the model is 0."""
    return BatchMean(truth.value / model, truth.standard_error / model) if model else BatchMean(np.nan, np.nan)


def _series(cells: Sequence[LightCell]) -> list[tuple[str, tuple[float, float, float, float], list[LightCell]]]:
    """Returns name, colour and cells of each water type."""
    waters = list(dict.fromkeys(cell.water for cell in cells))
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(waters)))
    return [
        (water, tuple(shade), [cell for cell in cells if cell.water == water])
        for water, shade in zip(waters, shades, strict=True)
    ]


def _ratios(axes: Axes, cells: Sequence[LightCell], label: str, value: Callable[[LightCell], BatchMean]) -> None:
    for water, colour, own in _series(cells):
        for lamps, marker in MARKERS.items():
            chosen = [cell for cell in own if cell.lamps == lamps]
            found = [value(cell) for cell in chosen]
            axes.errorbar(
                [_place_m(cell, chosen) for cell in chosen], [one.value for one in found],
                yerr=[2 * one.standard_error for one in found], fmt=marker, color=colour, markersize=4,
                label=water if lamps == "leds" else None,
            )  # fmt: skip
    axes.axhline(1.0, color="#9aa8b0", linewidth=1)
    log_axis(axes.yaxis)
    axes.set(xlabel="height [m] (one column of markers per pixel)", ylabel=label, title=label)
    axes.legend(fontsize=7, title="circles: LED lamps\ntriangles: spots", title_fontsize=7, loc="center left",
                bbox_to_anchor=(1.0, 0.5))  # fmt: skip


def _place_m(cell: LightCell, cells: Sequence[LightCell]) -> float:
    """Returns the abscissa of a cell [m]: the camera height, shifted for each pixel so that markers do not overlap."""
    return cell.height_m + OFFSET_M * list(dict.fromkeys(other.pixel for other in cells)).index(cell.pixel)


def _shares(axes: Axes, cells: Sequence[LightCell]) -> None:
    for _, colour, own in _series(cells):
        for cell in own:
            axes.errorbar(
                cell.sharp_share.value, cell.model.sharp_share, xerr=2 * cell.sharp_share.standard_error,
                fmt=MARKERS[cell.lamps], color=colour, markersize=4,
            )  # fmt: skip
    axes.plot([0, 1], [0, 1], color="#9aa8b0", linewidth=1)
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="reference", ylabel="model", title="share of unscattered light")


def _blur(axes: Axes, cells: Sequence[LightCell]) -> None:
    for _, colour, own in _series(cells):
        for cell in own:
            marker = MARKERS[cell.lamps]
            axes.plot(cell.blur_near.value, cell.model.blur_near, marker, color=colour, markersize=4)
            axes.plot(cell.blur_far.value, cell.model.blur_far, marker, color=colour, markersize=4, fillstyle="none")
    axes.plot([1e-3, 1], [1e-3, 1], color="#9aa8b0", linewidth=1)
    axes.set(
        xlim=(1e-3, 1), ylim=(1e-3, 1), xlabel="reference", ylabel="model",
        title="blur: share within 2 px (full), beyond 40 px (open)",
    )  # fmt: skip
    log_axis(axes.xaxis)
    log_axis(axes.yaxis)
