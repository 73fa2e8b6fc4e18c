"""Comparison of the daylight model with the Monte Carlo reference: illuminance, also of slopes, and upwelling light.

One cell is one water, elevation of the sun, depth of the camera and range of a level floor, in the green band, with the
default share of the sky. Model and reference use the same absorption, scattering and phase function.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import StereoRig
from twin.imaging.daylight import DaylightVeil, floor_daylight
from twin.imaging.illumination import Daylight, daylight_at
from twin.imaging.phase_function import PhaseFunction, phase_of
from twin.imaging.reference.pixel_light import (
    BandWater,
    BatchMean,
    Effort,
    PixelRay,
    ReferenceScene,
    Sunlight,
    pixel_light,
    plane_light,
)
from twin.imaging.sun_sky import sky_radiance
from twin.imaging.water import Medium, medium
from twin.scenario.model import SunConfig, WaterConfig

Array = NDArray[np.float64]

GREEN = 1
WATERS, DEPTHS_M, RANGES_M, ELEVATIONS_DEG = ("IB", "II", "III", "1C", "3C"), (2.0, 5.0, 15.0), (1.0, 3.0), (90.0, 45.0)
LIFT_M = 1e-3  # height of the slopes above the floor
SLOPE_DEG = 45.0  # angle of the slopes that face the sun and face away from it
SUN_RADIUS_RAD = 0.0047 / 1.34  # angular radius of the sun's disc, under water
SKY_STEPS = 4000  # number of steps of the table of the sky's radiance
WALKS = 40_000
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # pose of a camera that points straight down
RIG = StereoRig(2, 2, 1000.0, 0.1)  # only its principal ray is used


class DaylightSelection(NamedTuple):
    """The cells to compute: waters, depths of the camera [m], ranges of the floor [m], elevations of the sun [deg]."""

    waters: tuple[str, ...] = WATERS
    depths_m: tuple[float, ...] = DEPTHS_M
    ranges_m: tuple[float, ...] = RANGES_M
    elevations_deg: tuple[float, ...] = ELEVATIONS_DEG


ALL_DAYLIGHT = DaylightSelection()
QUICK_DAYLIGHT = DaylightSelection(("IB", "III"), (5.0,), (2.0,), ELEVATIONS_DEG)


class DaylightCell(NamedTuple):
    """One cell: key, light of the model, and light of the reference with standard errors, per lux at the surface.

    Args:
        water: Jerlov type.
        elevation_deg: elevation of the sun, in air.
        depth_m: depth of the camera below the surface.
        range_m: range of the floor, straight below.
        model_lx: illuminance, by the model, of a level plane at the camera, of a slope of `SLOPE_DEG` on the floor that
            faces the sun, and of one that faces away from it.
        truth_lx: the same by the reference, over a black floor.
        model_veil: upwelling radiance at the camera over a black floor, by the model [cd/m2].
        truth_veil: the same by the reference.
    """

    water: str
    elevation_deg: float
    depth_m: float
    range_m: float
    model_lx: tuple[float, ...]
    truth_lx: tuple[BatchMean, ...]
    model_veil: float
    truth_veil: BatchMean

    @property
    def reflectance(self) -> tuple[float, BatchMean]:
        """Upwelling radiance divided by illuminance at the camera, Lu/Ed [1/sr], of model and reference."""
        veil, lux = self.truth_veil, self.truth_lx[0]
        value = veil.value / lux.value
        relative = np.hypot(veil.standard_error / veil.value, lux.standard_error / lux.value)
        return self.model_veil / self.model_lx[0], BatchMean(value, float(value * relative))


def daylight_cells(selection: DaylightSelection = ALL_DAYLIGHT, walks: int = WALKS) -> Iterable[DaylightCell]:
    """Yields the cells of a selection; `walks` is the number of Monte Carlo walks for each value."""
    for water in selection.waters:
        for elevation_deg in selection.elevations_deg:
            for depth_m in selection.depths_m:
                for range_m in selection.ranges_m:
                    yield _cell((water, elevation_deg, depth_m, range_m), Effort(walks))


def _cell(key: tuple[str, float, float, float], effort: Effort) -> DaylightCell:
    """Returns one cell; `key`: Jerlov type, elevation of the sun [deg], depth of the camera [m], range [m]."""
    water_type, elevation_deg, depth_m, range_m = key
    water = medium(WaterConfig.model_validate({"jerlov": water_type}))
    sun = SunConfig(illuminance_lx=1.0, depth_m=depth_m + range_m, elevation_deg=elevation_deg)
    daylight = daylight_at(sun, water, range_m)
    veil = DaylightVeil(daylight, water, np.array([0.0, range_m])).radiance(np.array([0.0, 0.0, -1.0]), depth_m)
    places = tuple(zip(_normals(), (range_m, LIFT_M, LIFT_M), strict=True))  # normal, height above the floor
    model_lx = tuple(plane_lx(daylight, water, normal, depth_m + range_m - height) for normal, height in places)
    scene = reference_scene(daylight, water, phase_of(water.scatterers[GREEN]), depth_m + range_m)
    pose = DOWN.copy()
    pose[2, 3] = range_m
    truth_lx = tuple(
        plane_light(scene, np.array([0.0, 0.0, height]), normal, effort).total for normal, height in places
    )
    truth = pixel_light(scene, PixelRay(pose, RIG, (RIG.cx_px, RIG.cy_px)), effort).veil
    return DaylightCell(*key, model_lx, truth_lx, float(veil[1, GREEN]), truth)


def _normals() -> tuple[Array, Array, Array]:
    """Returns the normals of a level plane and of slopes that face the sun, in the east, and face away."""
    s, c = np.sin(np.deg2rad(SLOPE_DEG)), np.cos(np.deg2rad(SLOPE_DEG))
    return np.array([0.0, 0.0, 1.0]), np.array([s, 0.0, c]), np.array([-s, 0.0, c])


def plane_lx(daylight: Daylight, water: Medium, normal: Array, depth_m: float) -> float:
    """Returns the green illuminance [lx] of a floor at a depth with a unit normal, by the model."""
    floor = floor_daylight(daylight._replace(reference_depth_m=depth_m), water)
    four = np.append(normal, 1.0)
    beam = floor.beam_lx[GREEN] * np.exp(-floor.beam_per_m[GREEN] * depth_m)
    return float(beam * max(normal @ floor.to_sun, 0.0) + max(four @ floor.rest_lx[GREEN] @ four, 0.0))


def reference_scene(daylight: Daylight, water: Medium, phase: PhaseFunction, surface_m: float) -> ReferenceScene:
    """Returns the scene of the reference: daylight of 1 lx in green, over a black level floor at z = 0."""
    source = daylight.source
    sky = source.sky_share * sky_radiance(np.linspace(0.0, 1.0, SKY_STEPS + 1))
    sun = Sunlight(source.to_sun, source.beam_lx, surface_m, SUN_RADIUS_RAD, sky)
    band = BandWater(float(water.absorption_per_m[GREEN]), float(water.scattering_per_m[GREEN]), phase)
    return ReferenceScene(band, np.zeros((0, 7)), (), 0.0, sun=sun)


def daylight_table(found: Sequence[DaylightCell]) -> list[tuple[str, ...]]:
    """Returns the cells as rows of text, the header first; standard errors follow +-."""
    header = (
        "water, sun", "depth, range", "Ed, model / truth", f"{SLOPE_DEG:g} deg to the sun", "away from it",
        "Lu/Ed, truth", "model / truth",
    )  # fmt: skip
    rows = []
    for cell in found:
        model, truth = cell.reflectance
        over = [_over(value, mean) for value, mean in zip(cell.model_lx, cell.truth_lx, strict=True)]
        rows.append((
            f"{cell.water} {cell.elevation_deg:g} deg", f"{cell.depth_m:g} m, {cell.range_m:g} m", *over,
            f"{truth.value:.3g}", _over(model, truth),
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
    return row | {"veil_truth_se": cell.truth_veil.standard_error}
