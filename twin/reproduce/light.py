"""The light model of the images beside the Monte Carlo reference: total light, sharp share, veil and blur.

One cell is one water, height, fit of lamps and pixel over a level floor of even albedo, in the green band. Both use the
same absorption, scattering and lamps; the phase function of the reference is the model's own (Henyey-Greenstein) or
that of sea water (molecules and Petzold's average particle).
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import StereoRig
from twin.imaging.forward_scatter import ForwardScatter, forward_scattering
from twin.imaging.illumination import illumination_of
from twin.imaging.lamps import light_sources_in_camera
from twin.imaging.optics import Optics
from twin.imaging.phase_function import PhaseFunction, henyey_greenstein, sea_water
from twin.imaging.reference.pixel_light import (
    BandWater,
    BatchMean,
    Effort,
    PixelLight,
    PixelRay,
    ReferenceScene,
    lamps_in_world,
    pixel_light,
)
from twin.imaging.water import Medium
from twin.reproduce import light_sheet
from twin.reproduce.light_cell import LightCell, ModelLight
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario

Array = NDArray[np.float64]

GREEN, GREEN_NM, ALBEDO = 1, 550.0, 128
WATERS, HEIGHTS_M = ("IB", "II", "III", "1C", "3C"), (1.0, 2.0, 3.0)
#: Pixels as fractions of image width and height: centre, right of it, lower right corner.
PIXELS = ((0.5, 0.5), (0.8, 0.5), (0.95, 0.95))
#: Fits of lamps: those of the demo survey, and narrow beams far from the cameras, panned inwards.
LAMP_FITS: dict[str, tuple[str, ...]] = {
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
WALKS = 40_000


class Selection(NamedTuple):
    """The cells to compute: waters, heights [m], names in `LAMP_FITS`, pixels as in `PIXELS`."""

    waters: tuple[str, ...] = WATERS
    heights_m: tuple[float, ...] = HEIGHTS_M
    lamp_fits: tuple[str, ...] = tuple(LAMP_FITS)
    pixels: tuple[tuple[float, float], ...] = PIXELS


ALL = Selection()
QUICK = Selection(("IB", "III"), (2.0,), ("leds",), PIXELS[:2])


def cells(selection: Selection = ALL, walks: int = WALKS, phase: str = "model") -> Iterable[LightCell]:
    """Yields the cells of a selection.

    Args:
        selection: which cells.
        walks: number of pairs of walks of the Monte Carlo in each cell.
        phase: phase function of the reference: "model", that of the light model, or "sea", that of sea water.
    """
    for water in selection.waters:
        for fit in selection.lamp_fits:
            scenario = load_scenario("quickstart", [f"water.jerlov={water}", "sun.illuminance_lx=0", *LAMP_FITS[fit]])
            for height_m in selection.heights_m:
                for place in selection.pixels:
                    yield _cell(scenario, (water, fit, height_m, place), Effort(walks), phase)


def _cell(
    scenario: Scenario, key: tuple[str, str, float, tuple[float, float]], effort: Effort, phase: str
) -> LightCell:
    water, fit, height_m, place = key
    rig, medium = scenario.believed_rig(), illumination_of(scenario).water
    pixel = round(place[0] * (rig.width_px - 1)), round(place[1] * (rig.height_px - 1))
    light = reference_light(scenario, height_m, pixel, effort, _phase(medium, phase))
    shares = light.blurred_share(0.0, NEAR_PX), light.blurred_share(FAR_PX)
    truth = (light.total, light.direct, light.sharp_share, light.veil, light.veil_once, *shares)
    return LightCell(water, height_m, fit, pixel, model_light(scenario, height_m, pixel), *truth)


def reference_light(
    scenario: Scenario, height_m: float, pixel: tuple[int, int], effort: Effort, phase: PhaseFunction
) -> PixelLight:
    """Returns the green light of a pixel of the left camera, which looks straight down, by Monte Carlo."""
    rig, illumination = scenario.believed_rig(), illumination_of(scenario)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = height_m
    sources = light_sources_in_camera(rig, scenario.lamps, illumination.daylight, 0)
    water = illumination.water
    band = BandWater(float(water.absorption_per_m[GREEN]), float(water.scattering_per_m[GREEN]), phase)
    scene = ReferenceScene(band, lamps_in_world(sources, pose, GREEN), sources.beam, ALBEDO / 255)
    return pixel_light(scene, PixelRay(pose, rig, pixel), effort)


def model_light(scenario: Scenario, height_m: float, pixel: tuple[int, int]) -> ModelLight:
    """Returns the green light of a pixel of the left camera, which looks straight down, by the light model."""
    rig, illumination = scenario.believed_rig(), illumination_of(scenario)
    shape = rig.height_px, rig.width_px
    depth = np.full(shape, height_m, np.float32)
    optics = Optics(rig, illumination, scenario.lamps)
    direct, veil = optics.split(np.full((*shape, 3), ALBEDO, np.uint8), depth, 0)
    blurred = ForwardScatter(rig, illumination.water).spread(direct, depth)
    at = pixel[1], pixel[0], GREEN
    near, beyond = (blur_share(rig, illumination.water, height_m, px) for px in (NEAR_PX, FAR_PX))
    blur = float(blurred[at]) if scenario.imaging.forward_scatter else 0.0
    return ModelLight(float(direct[at]), blur, float(veil[at]), near, 1 - beyond)


def blur_share(rig: StereoRig, water: Medium, range_m: float, radius_px: float) -> float:
    """Returns the share of the model's forward-scattered green light within a radius: its kernel is a Gaussian."""
    lobe = forward_scattering(water.mean_cosine)
    thickness = lobe.share * float(water.scattering_per_m[GREEN]) * range_m
    n_scatterings = thickness / -np.expm1(-thickness) if thickness else 1.0
    variance_px2 = rig.focal_px**2 * lobe.variance_rad2 / 3 * n_scatterings
    return float(-np.expm1(-(radius_px**2) / (2 * variance_px2)))


def _phase(water: Medium, phase: str) -> PhaseFunction:
    if phase == "sea":
        return sea_water(float(water.scattering_per_m[GREEN]), GREEN_NM)
    return henyey_greenstein(water.mean_cosine)


#: Columns of the table and of light.csv.
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
    """Returns the cells as rows of text, the header first; standard errors after +-."""
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
    return f"{truth.value / unit:.3g} +- {truth.standard_error / unit:.1g}" if unit else "-"


def _inverse(truth: BatchMean, model: float) -> str:
    """Returns model / truth with its standard error."""
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
