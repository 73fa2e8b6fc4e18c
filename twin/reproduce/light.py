"""Comparison of the light model with the Monte Carlo reference: total light, sharp share, veil and blur.

Each cell of the comparison has one water type, camera height, lamp arrangement and pixel, over a level floor of uniform
albedo, in the green band. Model and reference use the same absorption, scattering, phase function and lamps.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.imaging.light.forward_scatter import ForwardScatter
from twin.imaging.light.illumination import illumination_of
from twin.imaging.light.lamps import light_sources_in_camera
from twin.imaging.light.optics import Optics, range_of
from twin.imaging.reference.pixel_light import (
    BatchMean,
    Effort,
    PixelLight,
    PixelRay,
    ReferenceScene,
    lamps_in_world,
    pixel_light,
    refined,
)
from twin.reproduce import light_sheet
from twin.reproduce.light_cell import ALBEDO, GREEN, LightCell, ModelLight, green_of, looking_down
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario

Array = NDArray[np.float64]

WATERS, HEIGHTS_M = ("IB", "II", "III", "1C", "3C"), (1.0, 2.0, 3.0)
#: Pixels as fractions of image width and height: centre, right of it, near the lower right corner.
PIXELS = ((0.5, 0.5), (0.8, 0.5), (0.95, 0.95))
#: Lamp arrangements: that of the scenario `reef`, and narrow beams far from the cameras, panned inwards.
LAMP_ARRANGEMENTS: dict[str, tuple[str, ...]] = {
    "leds": (),
    "spots": tuple(
        f"lamps.{k}.{key}"
        for k, side in ((0, 1), (1, -1))
        for key in (
            f"position_m=[0.25, {0.6 * side}, 0.0]",
            f"pan_deg={-15.0 * side}",
            "beam=[[0, 1], [10, 0.7], [20, 0.3], [30, 0.05], [40, 0]]",
        )
    ),
}
NEAR_PX, FAR_PX = 2.0, 40.0
ROUND, MOST_WALKS = 8_000, 1_500_000  # pairs of walks in a round; most pairs of walks for a cell
#: Standard errors at which the reference of a cell is accurate enough: of all light and of the veil (relative), of the
#: sharp share (absolute), of the blur shares (relative).
LIGHT_ERROR, SHARP_ERROR, BLUR_ERROR = 0.019, 0.01, 0.1


class Selection(NamedTuple):
    """The cells to compute: water types, camera heights [m], names in `LAMP_ARRANGEMENTS`, pixels as in `PIXELS`."""

    waters: tuple[str, ...] = WATERS
    heights_m: tuple[float, ...] = HEIGHTS_M
    lamp_arrangements: tuple[str, ...] = tuple(LAMP_ARRANGEMENTS)
    pixels: tuple[tuple[float, float], ...] = PIXELS


ALL = Selection()
QUICK = Selection(("IB", "III"), (2.0,), ("leds",), PIXELS[:2])


def cells(selection: Selection = ALL, walks: int = MOST_WALKS, phase: str = "sea") -> Iterable[LightCell]:
    """Yields the cells of a selection: conditions, with the light of a pixel by the model and by the reference.

    Args:
        selection: the cells to compute.
        walks: largest number of pairs of random walks in a cell; fewer if the reference is accurate enough.
        phase: phase function of model and reference, a value of `water.phase_function`.
    """
    for water in selection.waters:
        for lamps in selection.lamp_arrangements:
            settings = f"water.jerlov={water}", f"water.phase_function={phase}", "sun.illuminance_lx=0"
            scenario = load_scenario("reef", [*settings, *LAMP_ARRANGEMENTS[lamps]])
            for height_m in selection.heights_m:
                for place in selection.pixels:
                    yield _cell(scenario, (water, lamps, height_m, place), walks)


def _cell(scenario: Scenario, key: tuple[str, str, float, tuple[float, float]], walks: int) -> LightCell:
    """Returns one cell; `key`: water type, name of the lamp arrangement, camera height [m], pixel as in `PIXELS`."""
    water, lamps, height_m, place = key
    rig = scenario.believed_rig()
    pixel = round(place[0] * (rig.width_px - 1)), round(place[1] * (rig.height_px - 1))
    light = refined(
        lambda effort: reference_light(scenario, height_m, pixel, effort),
        _is_accurate,
        Effort(min(walks, ROUND)),
        walks,
    )
    shares = _blur_shares(light)
    truth = (light.total, light.direct, light.sharp_share, light.veil, light.veil_once, *shares)
    return LightCell(water, height_m, lamps, pixel, model_light(scenario, height_m, pixel), *truth)


def _is_accurate(light: PixelLight) -> bool:
    """Returns whether the standard errors are within `LIGHT_ERROR`, `SHARP_ERROR` and `BLUR_ERROR`."""
    means = [(light.total, LIGHT_ERROR), (light.veil, LIGHT_ERROR), *((s, BLUR_ERROR) for s in _blur_shares(light))]
    within = all(mean.standard_error <= limit * mean.value for mean, limit in means)
    return within and light.sharp_share.standard_error <= SHARP_ERROR


def _blur_shares(light: PixelLight) -> tuple[BatchMean, BatchMean]:
    """Returns the shares of the blurred light that is displaced by less than `NEAR_PX`, and by at least `FAR_PX`."""
    return light.blurred_share(0.0, NEAR_PX), light.blurred_share(FAR_PX)


def reference_light(scenario: Scenario, height_m: float, pixel: tuple[int, int], effort: Effort) -> PixelLight:
    """Returns the Monte Carlo estimate of the green light of a pixel of the left camera, which points straight down."""
    rig, illumination = scenario.believed_rig(), illumination_of(scenario)
    pose = looking_down(height_m)
    sources = light_sources_in_camera(rig, scenario.lamps, illumination.daylight, 0)
    water, lamps = green_of(illumination.water), lamps_in_world(sources, pose, GREEN)
    scene = ReferenceScene(water, lamps, sources.beam, ALBEDO / 255)
    return pixel_light(scene, PixelRay(pose, rig, pixel), effort)


def model_light(scenario: Scenario, height_m: float, pixel: tuple[int, int]) -> ModelLight:
    """Returns the green light of a pixel of the left camera, which points straight down, by the light model."""
    rig, illumination = scenario.believed_rig(), illumination_of(scenario)
    shape = rig.height_px, rig.width_px
    depth, albedo = np.full(shape, height_m, np.float32), np.full((*shape, 3), ALBEDO, np.uint8)
    optics = Optics(rig, illumination, scenario.lamps)
    direct, forward, veil = optics.parts(albedo, depth, 0)
    at = pixel[1], pixel[0], GREEN
    if forward is None:
        return ModelLight(float(direct[at]), 0.0, float(veil[at]), np.nan, np.nan)
    blur, range_m = ForwardScatter(rig, illumination.water), range_of(depth, rig)
    # the light of the floor with the loss by absorption alone
    floor = (direct * np.exp(illumination.water.scattering_per_m * range_m[..., None])).astype(np.float32)
    around, place = optics.around(albedo, depth, 0)
    grid = blur.surroundings
    away = [
        np.hypot(*(np.indices(size).T - origin).T * side)
        for size, origin, side in (
            (shape, np.array(pixel[::-1]), 1.0),
            (grid.shape, grid.pad + np.array(pixel[::-1]) / 2**grid.level, 2.0**grid.level),
        )
    ]

    def from_within(radius_px: float) -> float:
        lit = [light * (px <= radius_px)[..., None] for light, px in zip((floor, around), away, strict=True)]
        return float(blur.spread(lit[0], range_m, (lit[1], place.copy()))[at] / forward[at])

    near, within = from_within(NEAR_PX), from_within(FAR_PX)
    return ModelLight(float(direct[at]), float(forward[at]), float(veil[at]), near, 1 - within)


#: Columns of light.csv, which are also the keys of each cell in light.json.
COLUMNS: tuple[tuple[str, Callable[[LightCell], Any]], ...] = (
    ("water", lambda cell: cell.water),
    ("height_m", lambda cell: cell.height_m),
    ("lamps", lambda cell: cell.lamps),
    ("column_px", lambda cell: cell.pixel[0]),
    ("row_px", lambda cell: cell.pixel[1]),
    ("total_model_cd_m2", lambda cell: cell.model.total),
    ("total_truth_cd_m2", lambda cell: cell.total.value),
    ("total_truth_se", lambda cell: cell.total.standard_error),
    ("direct_model_cd_m2", lambda cell: cell.model.direct),
    ("direct_truth_cd_m2", lambda cell: cell.direct.value),
    ("sharp_share_model", lambda cell: cell.model.sharp_share),
    ("sharp_share_truth", lambda cell: cell.sharp_share.value),
    ("sharp_share_truth_se", lambda cell: cell.sharp_share.standard_error),
    ("veil_model_cd_m2", lambda cell: cell.model.veil),
    ("veil_truth_cd_m2", lambda cell: cell.veil.value),
    ("veil_truth_se", lambda cell: cell.veil.standard_error),
    ("veil_once_truth_cd_m2", lambda cell: cell.veil_once.value),
    ("blur_near_model", lambda cell: cell.model.blur_near),
    ("blur_near_truth", lambda cell: cell.blur_near.value),
    ("blur_near_truth_se", lambda cell: cell.blur_near.standard_error),
    ("blur_far_model", lambda cell: cell.model.blur_far),
    ("blur_far_truth", lambda cell: cell.blur_far.value),
    ("blur_far_truth_se", lambda cell: cell.blur_far.standard_error),
)


def table(found: Sequence[LightCell]) -> list[tuple[str, ...]]:
    """Returns the comparison as table rows, a header and one row per `LightCell`; standard errors follow "+-"."""
    header = (
        "water, height", "lamps, pixel", "total, model / truth", "sharp, truth", "model", "veil, truth / model",
        f"blur < {NEAR_PX:g} px, truth", "model", f"> {FAR_PX:g} px, truth", "model",
    )  # fmt: skip
    rows = [
        (
            f"{cell.water} {cell.height_m:g} m", f"{cell.lamps} {cell.pixel[0]},{cell.pixel[1]}",
            _inverse(cell.total, cell.model.total), _text(cell.sharp_share, 1.0), f"{cell.model.sharp_share:.2f}",
            _text(cell.veil, cell.model.veil), _text(cell.blur_near, 1.0), f"{cell.model.blur_near:.3f}",
            _text(cell.blur_far, 1.0), f"{cell.model.blur_far:.3f}",
        )
        for cell in found
    ]  # fmt: skip
    return [header, *rows]


def _text(truth: BatchMean, unit: float) -> str:
    """Returns truth / unit with its standard error, as text; "-" if `unit` is 0."""
    return f"{truth.value / unit:.3g} +- {truth.standard_error / unit:.1g}" if unit else "-"


def _inverse(truth: BatchMean, model: float) -> str:
    """Returns model / truth with its standard error, as text."""
    value = model / truth.value
    return f"{value:.3g} +- {value * truth.standard_error / truth.value:.1g}"


def write(found: Sequence[LightCell], folder: Path) -> dict[str, Any]:
    """Writes light.csv, light.json and light.png to a folder, which is created if missing; returns the summary."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [{name: value(cell) for name, value in COLUMNS} for cell in found]
    with (folder / "light.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [name for name, _ in COLUMNS], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    summary = {"schema": "twin.light/1", "band": "green", "albedo": ALBEDO / 255, "cells": rows}
    (folder / "light.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    light_sheet.draw(found, folder / "light.png")
    return summary
