"""The paper's Fig. 8 by the project's own optics: one object at five turbidity levels, and contrast against range."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.app.look import figures, look
from twin.core.records import Image, StereoRig
from twin.imaging.forward_scatter import ForwardScatter
from twin.imaging.optics import Optics
from twin.imaging.water import medium
from twin.reproduce.block import block_on_sand
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario
from twin.world.mission import prepare

Array = NDArray[np.float64]

JERLOV = "II"
LEVELS = (0.0, 0.5, 1.5, 3.0, 6.0)  # of `water.turbidity`
ALTITUDE_M = 0.9
SETTINGS = (
    f"water.jerlov={JERLOV}", f"plan.altitude_m={ALTITUDE_M}", "plan.area_m=[0.2, 0.2]", "plan.tracks=1",
    "plan.speed_mps=0.05", "rig.image_width_px=480", "rig.image_height_px=360", "terrain.kind=flat",
    "terrain.relief_m=0.0", "imaging.shadows=true", "imaging.forward_scatter=true",
)  # fmt: skip
RANGES_M: Array = np.arange(0.3, 12.01, 0.05)
#: Share of its contrast at which a thing is no longer told from what surrounds it.
VISIBLE = 0.05


class Level(NamedTuple):
    """The object in one water.

    Args:
        scenario: of which the water's turbidity is the level.
        image: (H, W, 3) as the left camera sees it.
        told: figures of the look, see `twin.look`.
        contrast: (n, 3) share of fine detail's contrast that is left at `RANGES_M` for R, G, B.
    """

    scenario: Scenario
    image: Image
    told: dict[str, Any]
    contrast: Array

    @property
    def sight_m(self) -> float | None:
        """Range at which green contrast falls below `VISIBLE`; None beyond all that were looked at."""
        lost = np.flatnonzero(self.contrast[:, 1] < VISIBLE)
        return float(RANGES_M[lost[0]]) if lost.size else None


def climb(levels: tuple[float, ...] = LEVELS, settings: tuple[str, ...] = ()) -> list[Level]:
    """Looks at the block in each water.

    Args:
        settings: further overrides of the scenario.
    """
    seen, floor = [], block_on_sand(seed=1)
    for turbidity in levels:
        scenario = load_scenario("quickstart", [*SETTINGS, f"water.turbidity={turbidity}", *settings])
        view = look(replace(prepare(scenario), terrain=floor))
        seen.append(Level(scenario, view.shot.left, figures(view), contrast_left(scenario, RANGES_M)))
    return seen


def contrast_left(scenario: Scenario, ranges_m: Array) -> Array:
    """(n, 3) contrast of fine detail on a level floor at these ranges, as a share of that in clear water.

    Detail rides on the direct signal; what is scattered forward (a blur) and the veil only add light, so that
    C / C0 = direct / (direct + forward + veil) (Duntley 1963, for the light of lamps that move with the eye).
    """
    rig: StereoRig = replace(scenario.believed_rig(), width_px=64, height_px=48)
    rig = replace(rig, focal_px=rig.focal_px * 64 / scenario.rig.image_width_px)
    optics = Optics(rig, scenario.water, scenario.lamps, scenario.sun, scenario.plan.altitude_m)
    spread = ForwardScatter(rig, medium(scenario.water))
    floor = np.full((48, 64, 3), 128, np.uint8)
    left = np.empty((len(ranges_m), 3))
    for k, range_m in enumerate(ranges_m):
        depth = np.full(floor.shape[:2], range_m, np.float32)
        direct, veil = optics.split(floor, depth, 0)
        forward = spread.spread(direct, depth)
        middle = np.s_[20:28, 28:36]
        signal, rest = (np.mean(part[middle], axis=(0, 1), dtype=np.float64) for part in (direct, forward + veil))
        left[k] = signal / (signal + rest)
    return left


def summary(levels: list[Level]) -> dict[str, Any]:
    """What is kept as JSON."""
    names = ("gray_level", "contrast", "veil_share", "saturated_share", "snr", "texture_snr")
    return {
        "schema": "twin.turbidity/1",
        "jerlov": JERLOV,
        "range_m": levels[0].told["depth_median_m"],
        "levels": [
            {
                "turbidity": level.scenario.water.turbidity,
                "attenuation_per_m": medium(level.scenario.water).attenuation_per_m.tolist(),
                "gray_level_sd": (level.image.std(axis=(0, 1)) / 255).tolist(),
                "sight_m": level.sight_m,
            }
            | {name: level.told[name] for name in names}
            for level in levels
        ],
        "contrast_left": {
            "range_m": RANGES_M.round(3).tolist(),
            "green": [level.contrast[:, 1].round(5).tolist() for level in levels],
        },
    }


def table(told: dict[str, Any]) -> list[tuple[str, ...]]:
    """The summary in words, for green light."""
    head = ("turbidity", "attenuation c", "contrast", "veil", "spread of gray", "texture by noise", "sight")
    rows = [
        (
            f"{row['turbidity']:g}", f"{row['attenuation_per_m'][1]:.2f} /m", f"{row['contrast'][1]:.3f}",
            f"{100 * row['veil_share'][1]:.0f} %", f"{255 * row['gray_level_sd'][1]:.1f}",
            f"{row['texture_snr'][1]:.1f}",
            f"over {RANGES_M[-1]:.0f} m" if row["sight_m"] is None else f"{row['sight_m']:.2f} m",
        )
        for row in told["levels"]
    ]  # fmt: skip
    return [head, *rows]


def write(levels: list[Level], folder: Path) -> dict[str, Any]:
    """Leaves turbidity.png and turbidity.json in a folder; returns the summary."""
    from twin.reproduce import turbidity_sheet

    folder.mkdir(parents=True, exist_ok=True)
    told = summary(levels)
    (folder / "turbidity.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    turbidity_sheet.draw(levels, folder / "turbidity.png")
    return told
