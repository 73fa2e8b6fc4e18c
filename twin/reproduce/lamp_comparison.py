"""Comparison of the light model with the Monte Carlo reference: total light, sharp share, veil and blur.

Each cell of the comparison has one water type, camera height, lamp arrangement and pixel, over a level floor of uniform
albedo, in the green band. Model and reference use the same absorption, scattering, phase function and lamps.
"""

from collections.abc import Iterable, Sequence
from itertools import product

import numpy as np

from twin.core.height_field import HeightField
from twin.imaging.light.forward_scatter import ForwardScatter
from twin.imaging.light.illumination import illumination_of
from twin.imaging.light.lamps import light_sources_in_camera
from twin.imaging.light.optics import Optics, range_of
from twin.imaging.reference.floor_crossings import LEVEL
from twin.imaging.reference.pixel_light import (
    BatchMean,
    Effort,
    PixelLight,
    PixelRay,
    ReferenceScene,
    lamps_in_world,
    pixel_light,
)
from twin.reproduce.light_cell import ALBEDO, GREEN, WALKS, Compared, LightCell, estimate, looking_down, text_of, within
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario

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
#: Standard errors at which the reference of a cell is accurate enough: of all light and of the veil (relative), of the
#: sharp share (absolute), of the blur shares (relative).
LIGHT_ERROR, SHARP_ERROR, BLUR_ERROR = 0.019, 0.01, 0.1


#: Cells to compute: Jerlov types, lamp arrangements, heights of the camera above the floor [m], pixels.
Selection = tuple[Sequence[str], Sequence[str], Sequence[float], Sequence[tuple[float, float]]]
ALL_LAMPS: Selection = (WATERS, tuple(LAMP_ARRANGEMENTS), HEIGHTS_M, PIXELS)
QUICK_LAMPS: Selection = (("IB", "III"), ("leds",), (2.0,), PIXELS[:2])


def lamp_cells(selection: Selection = ALL_LAMPS, walks: int = WALKS, phase: str = "sea") -> Iterable[LightCell]:
    """Yields cells of at most `walks` pairs of walks: a pixel by model and reference; `phase` of the scenario."""
    waters, arrangements, heights_m, pixels = selection
    for water, lamps in product(waters, arrangements):
        settings = f"water.jerlov={water}", f"water.phase_function={phase}", "sun.illuminance_lx=0"
        scenario = load_scenario("reef", [*settings, *LAMP_ARRANGEMENTS[lamps]])
        width_px, height_px = scenario.rig.image_width_px, scenario.rig.image_height_px
        for height_m, (across, down) in product(heights_m, pixels):
            pixel = round(across * (width_px - 1)), round(down * (height_px - 1))
            conditions = {"water": water, "height_m": height_m, "lamps": lamps}
            conditions |= {"column_px": pixel[0], "row_px": pixel[1]}
            yield LightCell(conditions, _compared(scenario, height_m, pixel, walks))


def _compared(scenario: Scenario, height_m: float, pixel: tuple[int, int], walks: int) -> dict[str, Compared]:
    """Returns the light of a pixel by the model and by the reference (`PixelLight`)."""
    # sharp_share: from the floor, not scattered up to the camera; blur_near and blur_far: shares of the blurred light
    # whose point of the floor would, without scattering, be imaged within `NEAR_PX` of the pixel and beyond `FAR_PX`
    truth = estimate(lambda one: reference_light(scenario, height_m, pixel, one), _is_accurate, walks)
    model = model_light(scenario, height_m, pixel)
    near, far = _blur_shares(truth)
    unit = "_cd_m2"
    return {
        "total": Compared(model["total"], truth.total, unit),
        "direct": Compared(model["direct"], truth.direct, unit, ("model", "truth")),
        "sharp_share": Compared(model["sharp_share"], truth.sharp_share),
        "veil": Compared(model["veil"], truth.veil, unit),
        "veil_once": Compared(np.nan, truth.veil_once, unit, ("truth",)),
        "blur_near": Compared(model["blur_near"], near),
        "blur_far": Compared(model["blur_far"], far),
    }


def _is_accurate(light: PixelLight) -> bool:
    of_light = within(LIGHT_ERROR, light.total, light.veil) and within(BLUR_ERROR, *_blur_shares(light))
    return of_light and light.sharp_share.standard_error <= SHARP_ERROR


def _blur_shares(light: PixelLight) -> tuple[BatchMean, BatchMean]:
    return light.blurred_share(0.0, NEAR_PX), light.blurred_share(FAR_PX)


def reference_light(
    scenario: Scenario, height_m: float, pixel: tuple[int, int], effort: Effort, relief: HeightField = LEVEL
) -> PixelLight:
    """Returns the Monte Carlo estimate of the green light of a pixel of the left camera, which points straight down."""
    rig, illumination, pose = scenario.believed_rig(), illumination_of(scenario), looking_down(height_m)
    sources = light_sources_in_camera(rig, scenario.lamps, illumination.daylight, 0)
    water, lamps = illumination.water.bands[GREEN], lamps_in_world(sources, pose, GREEN)
    scene = ReferenceScene(water, lamps, sources.beam, ALBEDO / 255, relief)
    return pixel_light(scene, PixelRay(pose, rig, pixel), effort)


def model_light(scenario: Scenario, height_m: float, pixel: tuple[int, int]) -> dict[str, float]:
    """Returns the green light of a pixel of the left camera, which points straight down, by the light model.

    The keys are "total", "direct" (not scattered between floor and camera), "blurred" (scattered on this way) and
    "veil" [cd/m2], and the shares of `_compared`; those of the blur are NaN without forward scatter.
    """
    rig, illumination = scenario.believed_rig(), illumination_of(scenario)
    shape = rig.height_px, rig.width_px
    depth, albedo = np.full(shape, height_m, np.float32), np.full((*shape, 3), ALBEDO, np.uint8)
    optics = Optics(rig, illumination, scenario.lamps)
    direct, forward, veil = optics.parts(albedo, depth, 0)
    at = pixel[1], pixel[0], GREEN
    blurred = 0.0 if forward is None else float(forward[at])
    parts = {"direct": float(direct[at]), "blurred": blurred, "veil": float(veil[at])}
    total = sum(parts.values())
    light = parts | {"total": total, "sharp_share": parts["direct"] / total, "blur_near": np.nan, "blur_far": np.nan}
    if forward is None:
        return light
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
        lit = [part * (px <= radius_px)[..., None] for part, px in zip((floor, around), away, strict=True)]
        return float(blur.spread(lit[0], range_m, (lit[1], place.copy()))[at] / forward[at])

    return light | {"blur_near": from_within(NEAR_PX), "blur_far": 1 - from_within(FAR_PX)}


def lamp_table(found: Sequence[LightCell]) -> list[tuple[str, ...]]:
    """Returns the results as table rows, the header first; standard errors follow "+-"."""
    header = (
        "water, height", "lamps, pixel", "total, model / truth", "sharp, truth", "model", "veil, truth / model",
        f"blur < {NEAR_PX:g} px, truth", "model", f"> {FAR_PX:g} px, truth", "model",
    )  # fmt: skip
    rows: list[tuple[str, ...]] = [header]
    for cell in found:
        water, height_m, lamps, column, row = cell.conditions.values()
        sharp, near, far = (cell.light[name] for name in ("sharp_share", "blur_near", "blur_far"))
        rows.append((
            f"{water} {height_m:g} m", f"{lamps} {column},{row}", text_of(cell.light["total"].ratio),
            text_of(sharp.truth), f"{sharp.model:.2f}", text_of(cell.light["veil"].inverse_ratio),
            text_of(near.truth), f"{near.model:.3f}", text_of(far.truth), f"{far.model:.3f}",
        ))  # fmt: skip
    return rows
