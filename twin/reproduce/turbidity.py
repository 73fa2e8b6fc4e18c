"""One object at five turbidities (Fig. 8 of Negahdaripour & Madjidi 2003), and contrast as a function of range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.app.look import image_quality, render_view
from twin.core.records import StereoRig
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.optics import Optics
from twin.reproduce import turbidity_sheet
from twin.reproduce.exhibit import Exhibit, Figure, make_table, write_json
from twin.reproduce.experiment_floors import block_on_sand
from twin.reproduce.turbidity_sheet import TurbidityLevel
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario
from twin.world.mission import prepare

Array = NDArray[np.float64]

JERLOV = "II"
TURBIDITIES = (0.0, 0.5, 1.5, 3.0, 6.0)  # values of `water.turbidity`
ALTITUDE_M = 0.9
SETTINGS = (
    f"water.jerlov={JERLOV}", f"plan.altitude_m={ALTITUDE_M}", "plan.area_m=[0.2, 0.2]", "plan.tracks=1",
    "plan.speed_mps=0.05", "rig.image_width_px=480", "rig.image_height_px=360", "terrain.kind=flat",
    "terrain.relief_m=0.0", "imaging.shadows=true",
)  # fmt: skip
QUICK = ("rig.image_width_px=240", "rig.image_height_px=180")
RANGES_M: Array = np.arange(0.3, 12.01, 0.05)


def run(folder: Path, quick: bool = False) -> Exhibit:
    """Renders the block at all turbidities, writes turbidity.json and turbidity.png, and returns the results."""
    results = write(render_levels(settings=QUICK if quick else ()), folder)
    text = "A concrete block on rippled sand in water of Jerlov type II at five turbidities, lit by two lamps (Fig. 8)."
    found = make_table("turbidity", f"Block at {results['range_m']:.2f} m in green light", table(results))
    figure = Figure("turbidity.png", "Images, histograms, and contrast of fine detail against range.")
    return Exhibit("turbidity", "Turbidity", text, (found,), (figure,))


def render_levels(
    turbidities: Sequence[float] = TURBIDITIES, settings: Sequence[str] = (), ranges_m: Array = RANGES_M
) -> list[TurbidityLevel]:
    """Returns the results at each `water.turbidity`, with further overrides of the scenario ("key=value")."""
    levels, floor = [], block_on_sand(seed=1)
    for turbidity in turbidities:
        scenario = load_scenario("reef", [*SETTINGS, f"water.turbidity={turbidity}", *settings])
        mission = replace(prepare(scenario), terrain=floor)
        view, water = render_view(mission), mission.illumination.water
        contrast = relative_contrast(scenario, mission.illumination, ranges_m)
        levels.append(TurbidityLevel(scenario, water, view.stereo_pair.left, image_quality(view), ranges_m, contrast))
    return levels


def relative_contrast(scenario: Scenario, illumination: Illumination, ranges_m: Array) -> Array:
    """Returns the contrast of fine detail on a level floor, relative to clear water.

    Only the direct signal carries fine detail; forward scatter (a blur) and backscatter add light without it. The
    contrast C relative to its value C0 in clear water is therefore C / C0 = direct / (direct + forward + backscatter)
    (Duntley 1963, here for lamps that are fixed to the camera).

    Returns:
        (n, 3) relative contrast for R, G, B at the ranges (n,) [m].
    """
    rig: StereoRig = replace(scenario.believed_rig(), width_px=64, height_px=48)
    rig = replace(rig, focal_px=rig.focal_px * 64 / scenario.rig.image_width_px)
    optics = Optics(rig, illumination, scenario.lamps)
    floor = np.full((48, 64, 3), 128, np.uint8)
    contrast = np.empty((len(ranges_m), 3))
    for k, range_m in enumerate(ranges_m):
        depth = np.full(floor.shape[:2], range_m, np.float32)
        direct, forward, backscatter = optics.parts(floor, depth, 0)
        centre = np.s_[20:28, 28:36]
        parts = (direct, backscatter if forward is None else forward + backscatter)
        signal, scattered = (np.mean(part[centre], axis=(0, 1), dtype=np.float64) for part in parts)
        contrast[k] = signal / (signal + scattered)
    return contrast


def _summary(levels: Sequence[TurbidityLevel]) -> dict[str, Any]:
    """Returns the contents of turbidity.json: water, image quality and contrast at each turbidity level."""
    names = ("gray_level", "contrast", "veil_share", "saturated_share", "snr", "texture_snr")
    return {
        "schema": "twin.turbidity/1",
        "jerlov": JERLOV,
        "range_m": levels[0].quality["depth_median_m"],
        "levels": [
            {
                "turbidity": level.scenario.water.turbidity,
                "attenuation_per_m": level.water.attenuation_per_m.tolist(),
                "gray_level_sd": (level.image.std(axis=(0, 1)) / 255).tolist(),
                "visibility_m": level.visibility_m,
            }
            | {name: level.quality[name] for name in names}
            for level in levels
        ],
        "contrast_left": {
            "range_m": levels[0].ranges_m.round(3).tolist(),
            "green": [level.contrast[:, 1].round(5).tolist() for level in levels],
        },
    }


def table(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """Returns the values of a summary for the green band as table rows, the header first."""
    header = ("turbidity", "attenuation c", "contrast", "backscatter", "grey level SD", "texture SNR", "visibility")
    max_range_m = summary["contrast_left"]["range_m"][-1]
    rows = [
        (
            f"{row['turbidity']:g}", f"{row['attenuation_per_m'][1]:.2f} /m", f"{row['contrast'][1]:.3f}",
            f"{100 * row['veil_share'][1]:.0f} %", f"{255 * row['gray_level_sd'][1]:.1f}",
            f"{row['texture_snr'][1]:.1f}",
            f"over {max_range_m:.0f} m" if row["visibility_m"] is None else f"{row['visibility_m']:.2f} m",
        )
        for row in summary["levels"]
    ]  # fmt: skip
    return [header, *rows]


def write(levels: Sequence[TurbidityLevel], folder: Path) -> dict[str, Any]:
    """Writes turbidity.png and turbidity.json to a folder, which is created if missing; returns the summary."""
    results = _summary(levels)
    write_json(folder / "turbidity.json", results)
    turbidity_sheet.draw(levels, folder / "turbidity.png")
    return results
