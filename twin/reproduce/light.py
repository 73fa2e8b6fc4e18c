"""Comparison of the light model of the images with a Monte Carlo of any order of scattering, in the green band."""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from twin.imaging.reference.pixel_light import BatchMean
from twin.report.plotting import log_axis, png_figure
from twin.reproduce.daylight_comparison import ALL_DAYLIGHT, QUICK_DAYLIGHT, daylight_cells, daylight_table
from twin.reproduce.exhibit import Exhibit, Figure, Table, make_table, write_json
from twin.reproduce.lamp_comparison import ALL_LAMPS, QUICK_LAMPS, lamp_cells, lamp_table
from twin.reproduce.light_cell import ALBEDO, WALKS, LightCell, write_csv
from twin.reproduce.relief_comparison import ALL_RELIEFS, QUICK_RELIEFS, relief_cells, relief_table

MARKERS = {"leds": "o", "spots": "^"}
OFFSET_M = 0.08  # horizontal distance between the markers of two pixels at the same height


class LightComparison(NamedTuple):
    """Cells of the comparisons of the light of lamps over level floors and over relief, and of daylight."""

    lamps: list[LightCell]
    relief: list[LightCell]
    daylight: list[LightCell]

    @property
    def tables(self) -> tuple[Table, ...]:
        return (
            make_table("light", "Lamps", lamp_table(self.lamps)),
            make_table("relief", "Lamps over relief", relief_table(self.relief)),
            make_table("daylight", "Daylight", daylight_table(self.daylight)),
        )

    def write(self, folder: Path) -> dict[str, Any]:
        """Writes light.csv, light.json, light.png, relief.csv and daylight.csv to a folder; returns the contents."""
        rows = write_csv(self.lamps, folder / "light.csv")
        summary = {"schema": "twin.light/1", "band": "green", "albedo": ALBEDO / 255, "cells": rows}
        write_json(folder / "light.json", summary)
        draw(self.lamps, folder / "light.png")
        more = {"relief": self.relief, "daylight": self.daylight}
        return summary | {name: write_csv(found, folder / f"{name}.csv") for name, found in more.items()}


def compare(quick: bool, walks: int = WALKS, phase: str = "sea") -> LightComparison:
    """Returns the comparison; arguments as for `lamp_cells`."""
    lamps = list(lamp_cells(QUICK_LAMPS if quick else ALL_LAMPS, walks, phase))
    relief = list(relief_cells(QUICK_RELIEFS if quick else ALL_RELIEFS, walks))
    return LightComparison(lamps, relief, list(daylight_cells(QUICK_DAYLIGHT if quick else ALL_DAYLIGHT, walks)))


def run(folder: Path, quick: bool = False) -> Exhibit:
    """Compares the light, writes the files to a folder, and returns the results."""
    found = compare(quick)
    found.write(folder)
    text = "The light model of the images compared with a Monte Carlo of any order of scattering, green band."
    figure = Figure("light.png", "Light model and Monte Carlo reference; bars: two standard errors.")
    return Exhibit("light", "Light of lamps and sun", text, found.tables, (figure,))


def draw(cells: Sequence[LightCell], file: Path) -> None:
    with png_figure(file, 12.0, 7.5) as figure:
        grid = figure.subplots(2, 2)
        figure.suptitle(
            "Light model and Monte Carlo reference, green band; bars: two standard errors of the reference", fontsize=12
        )
        _ratios(grid[0, 0], cells, "total light, model / reference", lambda cell: cell.light["total"].ratio)
        _ratios(grid[0, 1], cells, "veil, reference / model", lambda cell: cell.light["veil"].inverse_ratio)
        _against_truth(grid[1, 0], cells, {"sharp_share": "full"}, 0.0, "share of unscattered light")
        blur = {"blur_near": "full", "blur_far": "none"}
        _against_truth(grid[1, 1], cells, blur, 1e-3, "blur: share within 2 px (full), beyond 40 px (open)")


def _series(cells: Sequence[LightCell]) -> list[tuple[str, tuple[float, float, float, float], list[LightCell]]]:
    waters = list(dict.fromkeys(cell.conditions["water"] for cell in cells))
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(waters)))
    return [
        (water, tuple(shade), [cell for cell in cells if cell.conditions["water"] == water])
        for water, shade in zip(waters, shades, strict=True)
    ]


def _ratios(axes: Axes, cells: Sequence[LightCell], label: str, value: Callable[[LightCell], BatchMean]) -> None:
    for water, colour, own in _series(cells):
        for lamps, marker in MARKERS.items():
            chosen = [cell for cell in own if cell.conditions["lamps"] == lamps]
            found = [value(cell) for cell in chosen]
            pixels = [(cell.conditions["column_px"], cell.conditions["row_px"]) for cell in chosen]
            shifts_m = {pixel: OFFSET_M * k for k, pixel in enumerate(dict.fromkeys(pixels))}
            heights_m = [cell.conditions["height_m"] for cell in chosen]
            axes.errorbar(
                [h + shifts_m[pixel] for h, pixel in zip(heights_m, pixels, strict=True)], [one.value for one in found],
                yerr=[2 * one.standard_error for one in found], fmt=marker, color=colour, markersize=4,
                label=water if lamps == "leds" else None,
            )  # fmt: skip
    axes.axhline(1.0, color="#9aa8b0", linewidth=1)
    log_axis(axes.yaxis)
    axes.set(xlabel="height [m] (one column of markers per pixel)", ylabel=label, title=label)
    axes.legend(fontsize=7, title="circles: LED lamps\ntriangles: spots", title_fontsize=7, loc="center left",
                bbox_to_anchor=(1.0, 0.5))  # fmt: skip


def _against_truth(axes: Axes, cells: Sequence[LightCell], fills: Mapping[str, str], low: float, title: str) -> None:
    """Plots shares by the model against those by the reference, from `low` to 1; axes above 0 are logarithmic."""
    for _, colour, own in _series(cells):
        for cell, (name, fill) in product(own, fills.items()):
            model, truth = cell.light[name][:2]
            bar = 2 * truth.standard_error if name == "sharp_share" else None
            marker = MARKERS[cell.conditions["lamps"]]
            axes.errorbar(truth.value, model, xerr=bar, fmt=marker, color=colour, markersize=4, fillstyle=fill)
    axes.plot([low, 1], [low, 1], color="#9aa8b0", linewidth=1)
    axes.set(xlim=(low, 1), ylim=(low, 1), xlabel="reference", ylabel="model", title=title)
    for axis in (axes.xaxis, axes.yaxis) if low else ():
        log_axis(axis)
