"""Comparison of the daylight model with the Monte Carlo reference: illuminance of planes and slopes, upwelling light.

One cell is one water, elevation of the sun, depth of the camera and range of a level floor, in the green band, with the
default share of the sky. The upwelling light is compared over a black floor and over one of albedo 0.5. Model and
reference use the same absorption, scattering and phase function.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from twin.core.geometry import Array
from twin.core.records import StereoRig
from twin.imaging.light.daylight import DaylightVeil, floor_daylight
from twin.imaging.light.illumination import Daylight, Illumination, daylight_at
from twin.imaging.light.optics import Optics
from twin.imaging.light.sun_sky import sky_radiance
from twin.imaging.light.water import Medium, medium
from twin.imaging.reference.pixel_light import PixelRay, ReferenceScene, Sunlight, pixel_light, plane_light
from twin.reproduce.light_cell import ALBEDO, GREEN, WALKS, Compared, LightCell, estimate, looking_down, text_of, within
from twin.scenario.model import SEA_WATER_INDEX, SunConfig, WaterConfig

WATERS, DEPTHS_M, RANGES_M, ELEVATIONS_DEG = ("IB", "II", "III", "1C", "3C"), (2.0, 5.0, 15.0), (1.0, 3.0), (90.0, 45.0)
LIFT_M = 1e-3  # height of the slopes above the floor
SLOPE_DEG = 45.0  # angle of the slopes that face the sun and face away from it
SUN_RADIUS_RAD = 0.0047 / SEA_WATER_INDEX  # angular radius of the sun's disc, under water
SKY_STEPS = 4000  # number of steps of the table of the sky's radiance
LIGHT_ERROR, PLANE_ERROR = 0.05, 0.03  # largest relative standard errors accepted: upwelling light, illuminance
RIG = StereoRig(64, 48, 100.0, 0.1)  # the model's pixel next to the principal point is compared with the ray through it


#: Cells to compute: Jerlov types, elevations of the sun in air [deg], depths of the camera and ranges of the floor [m].
Selection = tuple[Sequence[str], Sequence[float], Sequence[float], Sequence[float]]
ALL_DAYLIGHT: Selection = (WATERS, ELEVATIONS_DEG, DEPTHS_M, RANGES_M)
QUICK_DAYLIGHT: Selection = (("IB", "III"), ELEVATIONS_DEG, (5.0,), (2.0,))


def daylight_cells(selection: Selection = ALL_DAYLIGHT, walks: int = WALKS) -> Iterable[LightCell]:
    """Yields the cells of a selection; `walks` is the largest number of Monte Carlo walks for each value."""
    for water, elevation_deg, depth_m, range_m in product(*selection):
        conditions = {"water": water, "elevation_deg": elevation_deg, "depth_m": depth_m, "range_m": range_m}
        yield LightCell(conditions, _compared(water, elevation_deg, depth_m, range_m, walks))


def _compared(water_type: str, elevation_deg: float, depth_m: float, range_m: float, walks: int) -> dict[str, Compared]:
    """Returns the light for 1 lx just below the water surface, by model and reference."""
    # level, to_sun, from_sun: illuminance of a level plane at the camera and of slopes of `SLOPE_DEG` on the floor
    # [lx]; veil, lu: upwelling radiance at the camera over a black floor and one of albedo `ALBEDO` / 255 [cd/m2]
    water = medium(WaterConfig.model_validate({"jerlov": water_type}))
    sun = SunConfig(illuminance_lx=1.0, depth_m=depth_m + range_m, elevation_deg=elevation_deg)
    daylight = daylight_at(sun, water, range_m)
    veil = DaylightVeil(daylight, np.array([0.0, range_m])).radiance(np.array([0.0, 0.0, -1.0]), depth_m)
    scene, found = reference_scene(daylight, water, depth_m + range_m), dict[str, Compared]()
    s, c = np.sin(np.deg2rad(SLOPE_DEG)), np.cos(np.deg2rad(SLOPE_DEG))  # the sun is in the east
    planes = {"level": ((0.0, 0.0, 1.0), range_m), "to_sun": ((s, 0.0, c), LIFT_M), "from_sun": ((-s, 0.0, c), LIFT_M)}
    for name, (normal, height_m) in planes.items():
        place = np.array([0.0, 0.0, height_m]), np.array(normal)
        truth = estimate(
            lambda one, place=place: plane_light(scene, *place, one),
            lambda light: within(PLANE_ERROR, light.total),
            walks,
        )
        found[name] = Compared(plane_lx(daylight, place[1], depth_m + range_m - height_m), truth.total, "_lx")
    above_floor, ray = replace(scene, albedo=ALBEDO / 255), PixelRay(looking_down(range_m), RIG, (RIG.cx_px, RIG.cy_px))
    truth = estimate(
        lambda one: pixel_light(above_floor, ray, one),
        lambda light: within(LIGHT_ERROR, light.total, light.veil),
        walks,
    )
    shape = RIG.height_px, RIG.width_px
    albedo, depth = np.full((*shape, 3), ALBEDO, np.uint8), np.full(shape, range_m, np.float32)
    light = Optics(RIG, Illumination(water, daylight), ()).radiance(albedo, depth, 0)
    return found | {
        "veil": Compared(float(veil[1, GREEN]), truth.veil, "_cd_m2"),
        "lu": Compared(float(light[shape[0] // 2, shape[1] // 2, GREEN]), truth.total, "_cd_m2"),
    }


def plane_lx(daylight: Daylight, normal: Array, depth_m: float) -> float:
    """Returns the green illuminance [lx] of a floor with a unit normal (3,), at a depth [m], by the model."""
    floor = floor_daylight(daylight._replace(reference_depth_m=depth_m))
    four = np.append(normal, 1.0)
    beam = floor.beam_lx[GREEN] * np.exp(-floor.beam_per_m[GREEN] * depth_m)
    return float(beam * max(normal @ floor.to_sun, 0.0) + max(four @ floor.rest_lx[GREEN] @ four, 0.0))


def reference_scene(daylight: Daylight, water: Medium, surface_m: float) -> ReferenceScene:
    """Returns the scene of the reference: daylight of 1 lx in green, `surface_m` above a black level floor at z = 0."""
    source = daylight.source
    sky = source.sky_share * sky_radiance(np.linspace(0.0, 1.0, SKY_STEPS + 1))
    sun = Sunlight(source.to_sun, source.beam_lx, surface_m, SUN_RADIUS_RAD, sky)
    return ReferenceScene(water.bands[GREEN], np.zeros((0, 7)), (), 0.0, sun=sun)


def daylight_table(found: Sequence[LightCell]) -> list[tuple[str, ...]]:
    """Returns rows, header first; Lu/Ed is upwelling radiance / level illuminance [1/sr]; "+-" a standard error."""
    header = (
        "water, sun", "depth, range", "Ed, model / truth", f"{SLOPE_DEG:g} deg to the sun", "away from it",
        "Lu/Ed, truth", "model / truth", "albedo 0.5, truth", "model / truth",
    )  # fmt: skip
    rows: list[tuple[str, ...]] = [header]
    for cell in found:
        water, elevation_deg, depth_m, range_m = cell.conditions.values()
        level, to_sun, from_sun, veil, lu = cell.light.values()
        row = [f"{water} {elevation_deg:g} deg", f"{depth_m:g} m, {range_m:g} m"]
        row += [text_of(one.ratio, ".3f") for one in (level, to_sun, from_sun)]
        for reflectance in (veil.over(level), lu.over(level)):
            row += [f"{reflectance.truth.value:.3g}", text_of(reflectance.ratio, ".3f")]
        rows.append(tuple(row))
    return rows
