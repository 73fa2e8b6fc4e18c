"""Comparison of the light model of the images with a Monte Carlo of any order of scattering, in the green band."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from twin.reproduce import light_sheet
from twin.reproduce.daylight_comparison import ALL_DAYLIGHT, QUICK_DAYLIGHT, daylight_cells, daylight_table
from twin.reproduce.exhibit import Exhibit, Figure, Table, make_table, write_json
from twin.reproduce.lamp_comparison import ALL_LAMPS, QUICK_LAMPS, lamp_cells, lamp_table
from twin.reproduce.light_cell import ALBEDO, MOST_WALKS, LightCell, write_csv


class LightComparison(NamedTuple):
    """Cells of the comparisons of the light of lamps and of daylight."""

    lamps: list[LightCell]
    daylight: list[LightCell]

    @property
    def tables(self) -> tuple[Table, Table]:
        """Returns the results as tables; standard errors follow "+-"."""
        lamps = make_table("light", "Lamps", lamp_table(self.lamps))
        return lamps, make_table("daylight", "Daylight", daylight_table(self.daylight))

    def write(self, folder: Path) -> dict[str, Any]:
        """Writes light.csv, light.json, light.png and daylight.csv to a folder; returns the contents of all."""
        rows = write_csv(self.lamps, folder / "light.csv")
        summary = {"schema": "twin.light/1", "band": "green", "albedo": ALBEDO / 255, "cells": rows}
        write_json(folder / "light.json", summary)
        light_sheet.draw(self.lamps, folder / "light.png")
        return summary | {"daylight": write_csv(self.daylight, folder / "daylight.csv")}


def compare(quick: bool, walks: int = MOST_WALKS, phase: str = "sea") -> LightComparison:
    """Returns the comparison; arguments as for `lamp_cells`."""
    lamps = list(lamp_cells(QUICK_LAMPS if quick else ALL_LAMPS, walks, phase))
    return LightComparison(lamps, list(daylight_cells(QUICK_DAYLIGHT if quick else ALL_DAYLIGHT, walks)))


def run(folder: Path, quick: bool = False) -> Exhibit:
    """Compares the light, writes the files to a folder, and returns the results."""
    found = compare(quick)
    found.write(folder)
    text = "The light model of the images compared with a Monte Carlo of any order of scattering, green band."
    figure = Figure("light.png", "Light model and Monte Carlo reference; bars: two standard errors.")
    return Exhibit("light", "Light of lamps and sun", text, found.tables, (figure,))
