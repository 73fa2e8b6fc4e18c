"""Comparison of the daylight model with the Monte Carlo reference: illuminance of planes and slopes, upwelling light.

One cell is one water, elevation of the sun, depth of the camera and range of a level floor, in the green band, with the
default share of the sky. The upwelling light is compared over a black floor and over one of albedo 0.5. Model and
reference use the same absorption, scattering and phase function.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import StereoRig
from twin.imaging.light.daylight import DaylightVeil, floor_daylight
from twin.imaging.light.illumination import Daylight, Illumination, daylight_at
from twin.imaging.light.optics import Optics
from twin.imaging.light.sun_sky import sky_radiance
from twin.imaging.light.water import Medium, medium
from twin.imaging.reference.pixel_light import (
    BatchMean,
    Effort,
    PixelLight,
    PixelRay,
    PlaneLight,
    ReferenceScene,
    Sunlight,
    pixel_light,
    plane_light,
    refined,
)
from twin.reproduce.light_cell import ALBEDO, GREEN, green_of, looking_down
from twin.scenario.model import SEA_WATER_INDEX, SunConfig, WaterConfig

Array = NDArray[np.float64]

WATERS, DEPTHS_M, RANGES_M, ELEVATIONS_DEG = ("IB", "II", "III", "1C", "3C"), (2.0, 5.0, 15.0), (1.0, 3.0), (90.0, 45.0)
LIFT_M = 1e-3  # height of the slopes above the floor
SLOPE_DEG = 45.0  # angle of the slopes that face the sun and face away from it
SUN_RADIUS_RAD = 0.0047 / SEA_WATER_INDEX  # angular radius of the sun's disc, under water
SKY_STEPS = 4000  # number of steps of the table of the sky's radiance
ROUND, MOST_WALKS = 8_000, 1_500_000  # walks (for a pixel: pairs) in a round; most walks for each value
LIGHT_ERROR, PLANE_ERROR = 0.05, 0.03  # largest relative standard errors accepted: upwelling light, illuminance
RIG = StereoRig(64, 48, 100.0, 0.1)  # the model's pixel next to the principal point is compared with the ray through it


class DaylightSelection(NamedTuple):
    """The cells to compute: waters, depths of the camera [m], ranges of the floor [m], elevations of the sun [deg]."""

    waters: tuple[str, ...] = WATERS
    depths_m: tuple[float, ...] = DEPTHS_M
    ranges_m: tuple[float, ...] = RANGES_M
    elevations_deg: tuple[float, ...] = ELEVATIONS_DEG


ALL_DAYLIGHT = DaylightSelection()
QUICK_DAYLIGHT = DaylightSelection(("IB", "III"), (5.0,), (2.0,), ELEVATIONS_DEG)


class DaylightCell(NamedTuple):
    """One cell of the comparison: conditions, light by the model, and light by the reference with standard errors.

    All light is given for an illuminance of 1 lx just below the water surface.

    Args:
        water: Jerlov type.
        elevation_deg: elevation of the sun, in air [deg].
        depth_m: depth of the camera below the surface [m].
        range_m: range of the floor, straight below [m].
        model_lx: illuminance, by the model, of a level plane at the camera, and of two slopes of `SLOPE_DEG` on the
            floor: one that faces the sun and one that faces away from it.
        truth_lx: the same illuminances by the reference, over a black floor.
        model_veil: upwelling radiance at the camera over a black floor, by the model [cd/m2].
        truth_veil: the same radiance by the reference.
        model_lu: upwelling radiance at the camera over a floor of albedo `ALBEDO` / 255, by the model [cd/m2].
        truth_lu: the same radiance by the reference.
    """

    water: str
    elevation_deg: float
    depth_m: float
    range_m: float
    model_lx: tuple[float, ...]
    truth_lx: tuple[BatchMean, ...]
    model_veil: float
    truth_veil: BatchMean
    model_lu: float
    truth_lu: BatchMean

    @property
    def reflectance(self) -> tuple[float, BatchMean]:
        """Returns upwelling radiance over a black floor / illuminance at the camera [1/sr]: by model and reference."""
        return self.model_veil / self.model_lx[0], _quotient(self.truth_veil, self.truth_lx[0])

    @property
    def bright_reflectance(self) -> tuple[float, BatchMean]:
        """Returns the values of `reflectance` for a floor of albedo `ALBEDO` / 255."""
        return self.model_lu / self.model_lx[0], _quotient(self.truth_lu, self.truth_lx[0])


def _quotient(part: BatchMean, whole: BatchMean) -> BatchMean:
    """Returns the quotient of two independent means, with its standard error."""
    value = part.value / whole.value
    relative = np.hypot(part.standard_error / part.value, whole.standard_error / whole.value)
    return BatchMean(value, float(value * relative))


def daylight_cells(selection: DaylightSelection = ALL_DAYLIGHT, walks: int = MOST_WALKS) -> Iterable[DaylightCell]:
    """Yields the cells of a selection; `walks` is the largest number of Monte Carlo walks for each value."""
    for water in selection.waters:
        for elevation_deg in selection.elevations_deg:
            for depth_m in selection.depths_m:
                for range_m in selection.ranges_m:
                    yield _cell((water, elevation_deg, depth_m, range_m), walks)


def _cell(key: tuple[str, float, float, float], walks: int) -> DaylightCell:
    """Returns one cell; `key`: Jerlov type, elevation of the sun [deg], depth of the camera [m], range [m]."""
    water_type, elevation_deg, depth_m, range_m = key
    water = medium(WaterConfig.model_validate({"jerlov": water_type}))
    sun = SunConfig(illuminance_lx=1.0, depth_m=depth_m + range_m, elevation_deg=elevation_deg)
    daylight = daylight_at(sun, water, range_m)
    veil = DaylightVeil(daylight, np.array([0.0, range_m])).radiance(np.array([0.0, 0.0, -1.0]), depth_m)
    places = tuple(zip(_normals(), (range_m, LIFT_M, LIFT_M), strict=True))  # normal, height above the floor
    model_lx = tuple(plane_lx(daylight, normal, depth_m + range_m - height) for normal, height in places)
    scene = reference_scene(daylight, water, depth_m + range_m)
    truth_lx = tuple(_plane_truth(scene, np.array([0.0, 0.0, height]), normal, walks) for normal, height in places)
    above_floor, ray = replace(scene, albedo=ALBEDO / 255), PixelRay(looking_down(range_m), RIG, (RIG.cx_px, RIG.cy_px))
    effort = Effort(min(walks, ROUND))
    truth = refined(lambda one: pixel_light(above_floor, ray, one), _is_accurate, effort, walks)
    model_lu = _model_lu(daylight, water, range_m)
    return DaylightCell(*key, model_lx, truth_lx, float(veil[1, GREEN]), truth.veil, model_lu, truth.total)


def _plane_truth(scene: ReferenceScene, point_m: Array, normal: Array, walks: int) -> BatchMean:
    """Returns the illuminance [lx] of a plane at a point by the Monte Carlo reference, with its standard error."""

    def enough(light: PlaneLight) -> bool:
        return light.total.standard_error <= PLANE_ERROR * light.total.value

    effort = Effort(min(walks, ROUND))
    return refined(lambda one: plane_light(scene, point_m, normal, one), enough, effort, walks).total


def _is_accurate(light: PixelLight) -> bool:
    return all(mean.standard_error <= LIGHT_ERROR * mean.value for mean in (light.total, light.veil))


def _model_lu(daylight: Daylight, water: Medium, range_m: float) -> float:
    """Returns the upwelling green light [cd/m2] at the camera over a floor of albedo `ALBEDO` / 255, by the model."""
    shape = RIG.height_px, RIG.width_px
    albedo, depth = np.full((*shape, 3), ALBEDO, np.uint8), np.full(shape, range_m, np.float32)
    light = Optics(RIG, Illumination(water, daylight), ()).radiance(albedo, depth, 0)
    return float(light[shape[0] // 2, shape[1] // 2, GREEN])


def _normals() -> tuple[Array, Array, Array]:
    """Returns unit normals (3,) of a level plane, a slope that faces the sun (in the east), and one that faces away."""
    s, c = np.sin(np.deg2rad(SLOPE_DEG)), np.cos(np.deg2rad(SLOPE_DEG))
    return np.array([0.0, 0.0, 1.0]), np.array([s, 0.0, c]), np.array([-s, 0.0, c])


def plane_lx(daylight: Daylight, normal: Array, depth_m: float) -> float:
    """Returns the green illuminance [lx] of a floor with a unit normal (3,), at a depth [m], by the model."""
    floor = floor_daylight(daylight._replace(reference_depth_m=depth_m))
    four = np.append(normal, 1.0)
    beam = floor.beam_lx[GREEN] * np.exp(-floor.beam_per_m[GREEN] * depth_m)
    return float(beam * max(normal @ floor.to_sun, 0.0) + max(four @ floor.rest_lx[GREEN] @ four, 0.0))


def reference_scene(daylight: Daylight, water: Medium, surface_m: float) -> ReferenceScene:
    """Returns the scene of the reference: daylight of 1 lx in green, over a black level floor at z = 0.

    Args:
        daylight: direction and shares of sun and sky.
        water: optical properties of the water.
        surface_m: height of the water surface above the floor [m].
    """
    source = daylight.source
    sky = source.sky_share * sky_radiance(np.linspace(0.0, 1.0, SKY_STEPS + 1))
    sun = Sunlight(source.to_sun, source.beam_lx, surface_m, SUN_RADIUS_RAD, sky)
    return ReferenceScene(green_of(water), np.zeros((0, 7)), (), 0.0, sun=sun)


def daylight_table(found: Sequence[DaylightCell]) -> list[tuple[str, ...]]:
    """Returns the table of the results: a header, then one row per `DaylightCell`; standard errors follow "+-"."""
    header = (
        "water, sun", "depth, range", "Ed, model / truth", f"{SLOPE_DEG:g} deg to the sun", "away from it",
        "Lu/Ed, truth", "model / truth", "albedo 0.5, truth", "model / truth",
    )  # fmt: skip
    rows = []
    for cell in found:
        pairs = cell.reflectance, cell.bright_reflectance
        over = [_over(value, mean) for value, mean in zip(cell.model_lx, cell.truth_lx, strict=True)]
        rows.append((
            f"{cell.water} {cell.elevation_deg:g} deg", f"{cell.depth_m:g} m, {cell.range_m:g} m", *over,
            *(text for model, truth in pairs for text in (f"{truth.value:.3g}", _over(model, truth))),
        ))  # fmt: skip
    return [header, *rows]


def _over(model: float, truth: BatchMean) -> str:
    """Returns model / truth with its standard error, as text."""
    value = model / truth.value
    return f"{value:.3f} +- {value * truth.standard_error / truth.value:.1g}"


def write_daylight(found: Sequence[DaylightCell], folder: Path) -> list[dict[str, Any]]:
    """Writes daylight.csv to a folder, which is created if missing; returns its rows."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [_row(cell) for cell in found]
    with (folder / "daylight.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return rows


def _row(cell: DaylightCell) -> dict[str, Any]:
    row: dict[str, Any] = {
        "water": cell.water, "elevation_deg": cell.elevation_deg, "depth_m": cell.depth_m, "range_m": cell.range_m,
    }  # fmt: skip
    for name, model, truth in zip(("level", "to_sun", "from_sun"), cell.model_lx, cell.truth_lx, strict=True):
        row |= {f"{name}_model_lx": model, f"{name}_truth_lx": truth.value, f"{name}_truth_se": truth.standard_error}
    row |= {"veil_model_cd_m2": cell.model_veil, "veil_truth_cd_m2": cell.truth_veil.value}
    row |= {"veil_truth_se": cell.truth_veil.standard_error, "lu_model_cd_m2": cell.model_lu}
    return row | {"lu_truth_cd_m2": cell.truth_lu.value, "lu_truth_se": cell.truth_lu.standard_error}
