"""Shadows against MuJoCo rays, the closed form of a wall, and dense sampling."""

from __future__ import annotations

import dataclasses
import types
from typing import Any

import numpy as np
import pytest
from mujoco_floor import floor_model, ray_lengths

from twin import terrains
from twin.core import geometry
from twin.core.height_field import cast_pixels, height_field
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light import shadows
from twin.imaging.light.illumination import daylight_at, illumination_of
from twin.imaging.light.lamp_halos import LampHalos, hidden_share
from twin.imaging.light.lamps import light_sources_in_camera
from twin.imaging.light.shading import HIDDEN_STEPS
from twin.imaging.light.shadows import BLOCK_CELLS, Shadows
from twin.imaging.light.spread import NODES_M
from twin.imaging.light.water import medium
from twin.imaging.scene.renderer import Renderer
from twin.scenario.model import LampConfig, Scenario, SunConfig, WaterConfig
from twin.scenes.gl import MjModel
from twin.terrains import TextureSource

LAMPS = [{"position_m": (0.25, 0.6, -0.05), "pan_deg": -15.0}, {"position_m": (0.25, -0.6, -0.05), "pan_deg": 15.0}]
SCENARIO = Scenario.model_validate(
    {
        "rig": {"image_width_px": 320, "image_height_px": 240},
        "lamps": LAMPS,
        "water": {"jerlov": "clear"},
        "imaging": {"shadows": True},
    }
)
RIG = SCENARIO.believed_rig()
POSES = [
    geometry.pose(geometry.rotation_from_rpy(*map(float, rpy)) @ geometry.BODY_FROM_DOWN_CAMERA, np.array(position))
    for rpy, position in [((0.0, 0.0, 0.0), (0.2, 0.1, 2.4)), ((0.1, -0.15, 2.0), (-1.3, 0.4, 2.2))]
]


def lamps_in(camera: int) -> np.ndarray:
    """Returns the lamp positions (lamps, 3) in the axes of a camera (0 left, 1 right)."""
    camera_from_body = geometry.inverse(RIG.body_from_camera @ (RIG.left_from_right if camera else np.eye(4)))
    return geometry.transform(camera_from_body, np.array([lamp["position_m"] for lamp in LAMPS]))


def points_of(depth: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """Returns the floor points (H, W, 3) of the pixels in the world."""
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    ray = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones(u.shape)], -1)
    return geometry.transform(world_from_camera, (ray * depth[..., None]).reshape(-1, 3)).reshape(ray.shape)


def cliffs() -> terrains.Terrain:
    """Returns a rough reef with steep slopes: plateaus 0.7 m above their surroundings."""
    reef = terrains.generate("reef", (8.0, 6.0), 1.0, 0.0, 0.025, TextureSource(0.02), 5)
    plateau = np.clip((reef.height_m - np.median(reef.height_m)) / 0.04, 0, 1)
    rough = np.random.default_rng(1).normal(scale=0.004, size=plateau.shape)
    return dataclasses.replace(reef, height_m=(0.2 * reef.height_m + 0.7 * plateau + rough).astype(np.float32))


def ray_reaches(model: MjModel, lamp: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns whether the MuJoCo ray from a lamp reaches each of the points (n, 3)."""
    reach = np.linalg.norm(points - lamp, axis=1)
    return ray_lengths(model, lamp, (points - lamp) / reach[:, None]) > reach - 2e-4


def test_shadows_agree_with_mujoco_rays() -> None:
    """At 99.5 % or more of the pixels of both cameras, on a reef that is steep enough for shadows."""
    terrain = cliffs()
    model, rng = floor_model(terrain), np.random.default_rng(0)
    casting = Shadows(terrain, RIG, [lamps_in(0), lamps_in(1)])
    agree, dark = [], []
    renderer = Renderer(terrain, RIG.width_px, RIG.height_px, RIG.focal_px)
    for pose in POSES:
        for camera in (0, 1):
            world_from_camera = pose @ RIG.left_from_right if camera else pose
            _, depth = renderer.render(world_from_camera)
            lit = casting.lit(depth, world_from_camera, camera)
            v, u = rng.integers(0, RIG.height_px, 3000), rng.integers(0, RIG.width_px, 3000)
            points = points_of(depth, world_from_camera)[v, u]
            for k, lamp in enumerate(geometry.transform(world_from_camera, lamps_in(camera))):
                expected = ray_reaches(model, lamp, points)
                agree.append(np.mean(lit[k, v, u] == expected))
                dark.append(1 - expected.mean())
    assert np.min(agree) >= 0.995
    assert np.mean(dark) > 0.03, "the test floor has too few shadows"


def wall(height_m: float, spacing_m: float = 0.05) -> Any:
    """Returns a flat floor, 10 m by 10 m, with a wall along y at x = 0 that falls to the floor within one cell."""
    n = round(10 / spacing_m) + 1
    height = np.zeros((n, n), np.float32)
    height[:, n // 2] = height_m
    return types.SimpleNamespace(height_m=height, spacing_m=spacing_m, west_m=-5.0, south_m=-5.0)


def test_the_shadow_of_a_wall_has_the_length_of_similar_triangles() -> None:
    """Lamp at 2 m height, 1 m in front of a wall of 0.5 m: the shadow is 0.5 / (2 - 0.5) * 1 m long."""
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))
    lamp = geometry.transform(geometry.inverse(pose), np.array([[-1.0, 0.0, 2.0]]))
    depth = np.full((RIG.height_px, RIG.width_px), 2.0, np.float32)  # depth without the wall
    lit = Shadows(wall(0.5), RIG, [lamp, lamp]).lit(depth, pose, 0)[0]
    x = points_of(depth, pose)[..., 0]
    end_m, pixel_m = 0.5 / 1.5, 2.0 / RIG.focal_px
    dark = (x > 0.06) & (x < end_m - pixel_m)  # without the foot of the wall
    assert not lit[dark].any() and lit[(x > end_m + pixel_m) | (x < -0.06)].all()


@pytest.mark.parametrize("seed", range(4))
def test_a_rough_floor_agrees_with_its_heights_sampled_densely(seed: int) -> None:
    """Spikes in every cell, lamps at all heights and outside of the grid: no occluding block is skipped."""
    rng = np.random.default_rng(seed)
    floor = terrains.Terrain(
        rng.normal(scale=0.2, size=(3 * BLOCK_CELLS + 2, 2 * BLOCK_CELLS + 1)).astype(np.float32), 0.1, -0.8, -1.2,
        np.zeros((2, 2, 3), np.uint8), 1.0,
    )  # fmt: skip
    tops = shadows.tops_of(floor.height_m)
    share = (np.arange(20000) + 0.5) / 20000
    wrong = total = 0
    for _ in range(250):
        x, y = rng.uniform(-0.79, 0.79), rng.uniform(-1.19, 1.19)
        start = np.array([x, y, float(floor.height_at(x, y))])
        lamp = rng.uniform([-1.5, -1.5, 0.3], [1.5, 1.5, 2.0])
        ray = start + share[:, None] * (lamp - start)
        over = floor.height_at(ray[:, 0], ray[:, 1]) - ray[:, 2]
        margin = np.nanmax(over)
        if abs(margin - shadows.BIAS_M) < 2e-3:  # grazing ray: the samples are not dense enough
            continue
        col, row = (x + 0.8) / 0.1, (y + 1.2) / 0.1
        to = (lamp[0] - x) / 0.1, (lamp[1] - y) / 0.1, lamp[2] - start[2]
        wrong += shadows.occluded(floor.height_m, *tops, col, row, start[2], *to) != (margin > 0)
        total += 1
    assert total > 60 and wrong == 0


def test_shadows_agree_with_a_ray_at_every_pixel() -> None:
    """At 99.8 % of the pixels of a reef, though most pixels are not tested: thin shadows are found as well."""
    terrain = cliffs()
    casting = Shadows(terrain, RIG, [lamps_in(0), lamps_in(1)])
    pixels = np.stack(np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px)), -1).reshape(-1, 2)
    field = height_field(terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m)
    depth = cast_pixels(field, POSES[1][None], RIG, pixels.astype(float))[0].reshape(RIG.height_px, -1)
    depth = depth.astype(np.float32)
    lit, lamps = casting.lit(depth, POSES[1], 0), geometry.transform(POSES[1], lamps_in(0))
    some = pixels[::2]
    alone = [shadows._cast(casting._grid, depth, RIG.focal_px, POSES[1], lamps[0], v, u) for u, v in some]
    assert np.mean(np.minimum(alone, 1) != lit[0][some[:, 1], some[:, 0]]) < 2e-3


def test_without_floor_there_is_no_shadow() -> None:
    depth = np.full((RIG.height_px, RIG.width_px), np.inf, np.float32)
    assert Shadows(wall(1.0), RIG, [lamps_in(0), lamps_in(1)]).lit(depth, POSES[0], 0).all()


def test_a_shadow_removes_the_light_of_its_lamp_only() -> None:
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))
    depth = np.full((RIG.height_px, RIG.width_px), 2.0, np.float32)
    white, stamped_pose = np.full((*depth.shape, 3), 255, np.uint8), StampedPose(pose, 0.0)
    high: Any = types.SimpleNamespace(height_m=wall(1.0).height_m.T.copy(), spacing_m=0.05, west_m=-5.0, south_m=-5.0)

    def light_of(lamps: list[dict], casts: bool) -> np.ndarray:
        changes = {
            "lamps": tuple(LampConfig(**lamp) for lamp in lamps),
            "imaging": SCENARIO.imaging.model_copy(update={"shadows": casts}),
        }
        here = SCENARIO.model_copy(update=changes)
        light = ImageFormation(here, illumination_of(here), high, np.random.default_rng(0))
        return light.radiance(RenderedView(white, depth, 0, stamped_pose))

    both, port, starboard = (light_of(lamps, True) for lamps in (LAMPS, LAMPS[:1], LAMPS[1:]))
    np.testing.assert_allclose(both, port + starboard, rtol=1e-5)
    free = light_of(LAMPS[:1], False)
    dark = port[..., 1] == 0
    assert 0.2 < dark.mean() < 0.8
    np.testing.assert_allclose(port[~dark], free[~dark], rtol=1e-5)


def halos(floor: Any, lamp_m: tuple[float, float, float], **properties: Any) -> LampHalos:
    """Returns the halo of an even lamp [m, world axes] for a camera 2 m above the origin, in water of type II."""
    even = {"position_m": (0.0, 0.0, 0.0), "beam": [(0.0, 1.0), (90.0, 1.0)]}
    water = medium(WaterConfig.model_validate(properties or {"jerlov": "II"}))
    daylight = daylight_at(SunConfig(illuminance_lx=0.0), water, 0.0)
    sources = light_sources_in_camera(RIG, (LampConfig.model_validate(even),), daylight, 0)
    position = geometry.transform(geometry.inverse(DOWN), np.array([lamp_m]))
    return LampHalos(floor, [sources._replace(position_m=position)] * 2, water)


DOWN = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))


def test_a_high_wall_beside_a_point_hides_half_of_the_halo_of_a_lamp_above_it() -> None:
    """But for light turned by less than `CORE_RAD`, which counts as straight, and paths before or above the wall."""
    floor = wall(1.9, 0.01)
    floor.height_m[:, floor.height_m.shape[1] // 2 :] = 1.9
    for x, expected in ((-0.0101, 0.4), (-4.0, 0.0)):
        halo = halos(floor, (x, 0.0, 2.0))
        lamp = np.array([x, 0.0, 2.0]), np.array([0.0, 0.0, -1.0]), halo._beams[0]
        assert halo._halo is not None
        core, dark, _ = halo._halo
        node = int(np.argmin(np.abs(np.array(NODES_M) - 2.0)))
        share = hidden_share(halo._solid, (x, 0.0, 0.0), lamp, halo._halo, False)
        assert share / dark[node] == pytest.approx(expected * (1 - core[node]), abs=0.06)


def test_light_is_hidden_also_in_water_that_scatters_no_green() -> None:
    lamp_m, absorption = (0.5, 0.0, 2.0), (0.1, 0.1, 0.1)
    found = [
        halos(wall(0.5), lamp_m, absorption_per_m=absorption, scattering_per_m=(0.3, green, 0.3))._halo
        for green in (0.0, 0.3)
    ]
    for without, with_green in zip(*(halo[:2] for halo in found if halo is not None), strict=True):
        np.testing.assert_allclose(without, with_green, rtol=0.05)
        assert np.isfinite(without).all()  # to the effect of the wavelength on molecules


def test_scattered_light_is_hidden_around_shadows_only() -> None:
    """Behind a wall of 0.5 m nearly all is hidden, less far from it, none at some distance; the masks stay the same."""
    lamp = geometry.transform(geometry.inverse(DOWN), np.array([[-1.0, 0.0, 2.0]]))
    depth = np.full((RIG.height_px, RIG.width_px), 2.0, np.float32)  # depth without the wall
    lit = Shadows(wall(0.5), RIG, [lamp, lamp]).lit(depth, DOWN, 0)
    masks = lit.copy()
    halos(wall(0.5), (-1.0, 0.0, 2.0)).hide(lit, depth, RIG.focal_px, DOWN, 0)
    np.testing.assert_array_equal(lit & 1, masks)
    hidden, x = (lit[0, :, 160] >> 1) / HIDDEN_STEPS, points_of(depth, DOWN)[:, 160, 0]
    near, end, lit_side = (hidden[np.argmin(np.abs(x - at))] for at in (0.08, 0.31, 0.36))
    assert near > 0.85 and near > end > 0.5 > lit_side > 0.1
    assert not hidden[(x < -0.4) | (x > 0.7)].any()


def test_light_is_hidden_by_objects_as_by_relief() -> None:
    """A grid of the heights of floor and object in place of a floor of these heights."""
    depth = np.full((RIG.height_px, RIG.width_px), 2.0, np.float32)
    of_relief, of_object = (np.ones((1, *depth.shape), np.uint8) for _ in range(2))
    for lit in (of_relief, of_object):
        lit[0, 75:115] = 0
    halo = halos(wall(0.5), (-1.0, 0.0, 2.0))
    halo.hide(of_relief, depth, RIG.focal_px, DOWN, 0)
    level = wall(0.0)
    beside = LampHalos(level, halo._sources, medium(WaterConfig(jerlov="II")), wall(0.5).height_m)
    beside.hide(of_object, depth, RIG.focal_px, DOWN, 0)
    far = points_of(depth, DOWN)[:, 160, 0] > 0.15  # beyond what the nodes do not resolve
    hidden, expected = (one[0, far, 160] >> 1 for one in (of_object, of_relief))
    np.testing.assert_allclose(hidden.astype(float), expected.astype(float), atol=0.1 * HIDDEN_STEPS)
    assert expected.max() > 0.5 * HIDDEN_STEPS
