"""Comparison of the light model with the Monte Carlo reference over relief: slope, step, box, cliff and wall.

One lamp shines from port of a camera that points straight down, 2 m above the level z = 0. Each cell is one water and
one relief with a point of it: in a shadow, beside an edge of depth, or lit. Model and reference use the same heights.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_pixels, height_field
from twin.imaging.light.illumination import illumination_of
from twin.imaging.light.lamp_halos import LampHalos
from twin.imaging.light.optics import Optics, SceneView
from twin.imaging.light.shadows import Shadows
from twin.imaging.scene.facets import Facets
from twin.reproduce.lamp_comparison import reference_light
from twin.reproduce.light_cell import ALBEDO, GREEN, WALKS, Compared, LightCell, estimate, looking_down, text_of, within
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario

WATERS, HEIGHT_M, EXTENT_M, SPACING_M = ("IB", "II", "III"), 2.0, 5.0, 0.02
LAMP = ("lamps.0.position_m=[0.25, 0.6, 0.0]", "lamps.0.pan_deg=-15.0", "lamps.1.intensity_cd=0.0")
LIGHT_ERROR, SHARP_ERROR = 0.03, 0.02  # standard errors of the reference: of all light (relative), of the sharp share


class Relief(NamedTuple):
    """Heights of a floor [m] at (x, y), starboard and forward of the camera [m], and the (x, y) that is compared."""

    height_m: Callable[[Array, Array], Array]
    point_m: tuple[float, float]


def _box(x: Array, y: Array) -> Array:
    return np.where((np.abs(x) < 0.2) & (np.abs(y) < 0.2), 0.4, 0.0)


def _cliff(x: Array, y: Array) -> Array:
    return np.where(x > 0, 1.0, -2.0)


def _wall(x: Array, y: Array) -> Array:
    return np.where((x > 0.1) & (x < 0.2), 0.6, 0.0)


RELIEFS = {
    "slope": Relief(lambda x, y: 0.5 * x, (0.0, 0.0)),
    "step, shadow": Relief(lambda x, y: np.where(x < 0, 0.3, 0.0), (0.05, 0.0)),
    "box, shadow": Relief(_box, (0.31, -0.02)),
    "box, lit": Relief(_box, (-0.3, 0.0)),
    "cliff, far side": Relief(_cliff, (-0.3, 0.0)),
    "cliff, near side": Relief(_cliff, (0.1, 0.0)),
    "wall, foot": Relief(_wall, (0.02, 0.0)),
    "wall, shadow": Relief(_wall, (0.38, 0.0)),
}

#: Cells to compute: Jerlov types and names of `RELIEFS`.
Selection = tuple[Sequence[str], Sequence[str]]
ALL_RELIEFS: Selection = (WATERS, tuple(RELIEFS))
QUICK_RELIEFS: Selection = (("II",), ("box, shadow", "cliff, far side"))


def relief_cells(selection: Selection = ALL_RELIEFS, walks: int = WALKS) -> Iterable[LightCell]:
    """Yields the cells of a selection; `walks` is the largest number of pairs of Monte Carlo walks for each."""
    for water, name in product(*selection):
        scenario = load_scenario("reef", [f"water.jerlov={water}", "sun.illuminance_lx=0", *LAMP])
        yield LightCell({"water": water, "relief": name}, _compared(scenario, name, walks))


@cache
def field_of(name: str) -> HeightField:
    """Returns the floor of one of `RELIEFS`."""
    at = np.linspace(-EXTENT_M, EXTENT_M, round(2 * EXTENT_M / SPACING_M) + 1)
    return height_field(RELIEFS[name].height_m(*np.meshgrid(at, at)), SPACING_M, -EXTENT_M, -EXTENT_M)


def pixel_of(scenario: Scenario, name: str) -> tuple[int, int]:
    """Returns column and row of the pixel that shows the point of a relief."""
    rig, (x, y) = scenario.believed_rig(), RELIEFS[name].point_m
    focal_px = rig.focal_px / (HEIGHT_M - float(RELIEFS[name].height_m(np.array(x), np.array(y))))
    return round(rig.cx_px + focal_px * x), round(rig.cy_px - focal_px * y)


def _compared(scenario: Scenario, name: str, walks: int) -> dict[str, Compared]:
    """Returns the light of a pixel by the model and by the reference; the keys are those of `lamp_comparison`."""
    pixel, field = pixel_of(scenario, name), field_of(name)
    truth = estimate(
        lambda one: reference_light(scenario, HEIGHT_M, pixel, one, field),
        lambda light: within(LIGHT_ERROR, light.total) and light.sharp_share.standard_error <= SHARP_ERROR,
        walks,
    )
    model, unit = model_light(scenario, pixel, field), "_cd_m2"
    return {
        "total": Compared(model["total"], truth.total, unit),
        "direct": Compared(model["direct"], truth.direct, unit, ("model", "truth")),
        "sharp_share": Compared(model["direct"] / model["total"], truth.sharp_share),
        "veil": Compared(model["veil"], truth.veil, unit),
    }


def model_light(scenario: Scenario, pixel: tuple[int, int], field: HeightField) -> dict[str, float]:
    """Returns the green light of a pixel [cd/m2] by the light model: "direct", "veil" and "total"."""
    rig, pose = scenario.believed_rig(), looking_down(HEIGHT_M)
    shape = rig.height_px, rig.width_px
    pixels = np.stack(np.meshgrid(np.arange(rig.width_px), np.arange(rig.height_px)), -1).reshape(-1, 2)
    depth = cast_pixels(field, pose[None], rig, pixels.astype(float)).reshape(shape).astype(np.float32)
    illumination = illumination_of(scenario)
    optics = Optics(rig, illumination, scenario.lamps)
    sources = optics.light_sources
    lit = Shadows(field, rig, [one.position_m for one in sources]).lit(depth, pose, 0)
    LampHalos(field, sources, illumination.water).hide(lit, depth, rig.focal_px, pose, 0)
    scene = SceneView(facets=Facets(field).seen_from(pose), lit=lit)
    parts = optics.parts(np.full((*shape, 3), ALBEDO, np.uint8), depth, 0, scene)
    at = pixel[1], pixel[0], GREEN
    direct, blurred, veil = (0.0 if part is None else float(part[at]) for part in parts)
    return {"direct": direct, "veil": veil, "total": direct + blurred + veil}


def relief_table(found: Sequence[LightCell]) -> list[tuple[str, ...]]:
    """Returns the results as table rows, the header first; the contrast of a texture is its sharp share."""
    rows: list[tuple[str, ...]] = [
        ("water", "relief", "total, model / truth", "contrast, truth", "model", "veil, truth / model")
    ]
    for cell in found:
        light, sharp = cell.light, cell.light["sharp_share"]
        rows.append((
            *cell.conditions.values(), text_of(light["total"].ratio), text_of(sharp.truth), f"{sharp.model:.2f}",
            text_of(light["veil"].inverse_ratio),
        ))  # fmt: skip
    return rows
