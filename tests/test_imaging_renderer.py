"""The renderer against rays, heights and projected patterns: none of these oracles knows OpenGL."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

import scenes.floor
import scenes.gl
import terrains
from scenes.builder import SceneModel, build
from scenes.gl import mujoco
from terrains import Terrain
from twin.core import geometry
from twin.errors import TwinError
from twin.imaging.renderer import Renderer, linear_depth, visible_tiles

W, H, VFOV = 160, 120, 45.0
POSES = [
    geometry.pose(geometry.rotation_from_rpy(*rpy) @ geometry.BODY_FROM_DOWN_CAMERA, np.array(position))
    for rpy, position in [
        ((0.0, 0.0, 0.0), (0.2, 0.1, 2.2)),
        ((0.1, -0.15, 2.0), (-1.3, 0.4, 1.9)),
        ((-0.3, 0.2, -1.0), (2.8, -1.5, 2.4)),
    ]
]


def world_of(terrain: Terrain) -> SceneModel:
    return build(terrain, W, H, VFOV, 0.2, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)), 0.01)


@pytest.fixture(scope="module")
def world() -> SceneModel:
    return world_of(terrains.generate("reef", (7.0, 5.0), 0.5, 0.1, 0.04, 0.003, 5))


@pytest.fixture(scope="module")
def renderer(world: SceneModel) -> Iterator[Renderer]:
    with Renderer(world, W, H, VFOV) as made:
        yield made


def pixel_rays(width_px: int, height_px: int, vfov_deg: float) -> np.ndarray:
    """(height, width, 3) directions of the pixel centres in the camera, scaled to z = 1: times depth, points."""
    focal_px = height_px / 2 / float(np.tan(np.deg2rad(vfov_deg) / 2))
    u, v = np.meshgrid(np.arange(width_px) - (width_px - 1) / 2, np.arange(height_px) - (height_px - 1) / 2)
    return np.stack([u / focal_px, v / focal_px, np.ones_like(u)], axis=-1)


def ray_depths(world: SceneModel, pose: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(world.model)
    data.qpos[2] = 100.0
    mujoco.mj_forward(world.model, data)
    rays = pixel_rays(W, H, VFOV)[pixels[:, 1], pixels[:, 0]]
    geom, result = np.zeros(1, np.int32), []
    for ray in rays:
        direction = pose[:3, :3] @ ray / np.linalg.norm(ray)
        distance = mujoco.mj_ray(world.model, data, pose[:3, 3], direction, None, 1, -1, geom, None)
        result.append(distance / np.linalg.norm(ray) if distance >= 0 else np.inf)
    return np.array(result)


@pytest.mark.parametrize("pose", POSES)
def test_depth_is_that_of_rays_through_the_pixel_centres(
    world: SceneModel, renderer: Renderer, pose: np.ndarray
) -> None:
    _, depth = renderer.render(pose)
    pixels = np.random.default_rng(1).integers(0, (W, H), (400, 2))
    seen, expected = depth[pixels[:, 1], pixels[:, 0]], ray_depths(world, pose, pixels)
    inside = np.isfinite(expected)
    assert np.array_equal(np.isfinite(seen), inside)
    error = np.abs(seen[inside] - expected[inside])
    # single precision at some metres from the origin is about 1 um
    assert np.median(error) < 5e-6 and np.percentile(error, 98) < 2e-5


@pytest.mark.parametrize("pose", POSES)
def test_every_drawn_point_lies_on_the_terrain(world: SceneModel, renderer: Renderer, pose: np.ndarray) -> None:
    _, depth = renderer.render(pose)
    seen = np.isfinite(depth)
    points = geometry.transform(pose, pixel_rays(W, H, VFOV)[seen] * depth[seen][:, None].astype(np.float64))
    error = np.abs(points[:, 2] - world.terrain.height_at(points[:, 0], points[:, 1]))
    assert np.nanmedian(error) < 5e-6 and np.nanpercentile(error, 98) < 2e-5
    assert np.isnan(error).mean() < 0.002  # pixels on the very edge of the floor


def test_no_border_between_tiles_shows(monkeypatch: pytest.MonkeyPatch, world: SceneModel, renderer: Renderer) -> None:
    """Drawn whole or cut into 12 pieces the floor looks the same."""
    cut = [renderer.render(pose) for pose in POSES]
    monkeypatch.setattr(scenes.floor, "TILE_CELLS", 1000)
    with Renderer(world_of(world.terrain), W, H, VFOV) as uncut:
        for (albedo, depth), pose in zip(cut, POSES, strict=True):
            whole_albedo, whole_depth = uncut.render(pose)
            both = np.isfinite(depth) & np.isfinite(whole_depth)
            assert (np.isfinite(depth) != np.isfinite(whole_depth)).mean() < 1e-3
            off = np.abs(depth[both] - whole_depth[both]) > 1e-4
            assert off.mean() < 1e-3  # silhouettes may fall to the other side of a pixel centre
            difference = np.abs(albedo.astype(int) - whole_albedo.astype(int))[both].max(axis=-1)
            assert np.percentile(difference, 99) <= 2 and (difference > 8).mean() < 1e-3


def test_one_colour_is_drawn_exactly() -> None:
    terrain = terrains.generate("reef", (5.0, 5.0), 0.4, 0.0, 0.05, 0.02, 0)
    colour = np.array([200, 17, 93], np.uint8)
    painted = Terrain(
        terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m,
        np.broadcast_to(colour, terrain.texture.shape).copy(), terrain.texture_px_m,
    )  # fmt: skip
    with Renderer(world_of(painted), W, H, VFOV) as drawn:
        albedo, _ = drawn.render(POSES[0])
    assert np.all(albedo == colour)


def dotted(terrain: Terrain, dots_m: np.ndarray, sigma_m: float) -> Terrain:
    """The floor painted black with round white dots at the given places, seen from above."""
    h, w = terrain.texture.shape[:2]
    x = terrain.west_m + (np.arange(w) + 0.5) * terrain.size_m[0] / w
    y = terrain.north_m - (np.arange(h) + 0.5) * terrain.size_m[1] / h
    squared = (x[None, :, None] - dots_m[:, 0]) ** 2 + (y[:, None, None] - dots_m[:, 1]) ** 2
    grey = np.rint(255 * np.exp(-squared / (2 * sigma_m**2)).max(axis=2)).astype(np.uint8)
    texture = np.repeat(grey[..., None], 3, axis=2)
    return Terrain(terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m, texture, terrain.texture_px_m)


def test_a_pattern_appears_where_projection_says() -> None:
    """Dots painted at known places are drawn within 0.1 px of their projection, and on average at it."""
    tilted = np.add.outer(0.05 * np.arange(61), 0.02 * np.arange(91)).astype(np.float32) * 0.05
    plain = Terrain(tilted, 0.05, -2.25, -1.5, np.zeros((600, 900, 3), np.uint8), 0.005)
    x, y = np.meshgrid(np.linspace(-0.6, 0.7, 5), np.linspace(-0.6, 0.6, 5))
    dots = np.stack([x.ravel(), y.ravel()], axis=1) + np.random.default_rng(2).uniform(-0.04, 0.04, (25, 2))
    terrain = dotted(plain, dots, 0.03)
    pose = geometry.pose(
        geometry.rotation_from_rpy(0.03, 0.02, 0.4) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([0, 0, 2.0])
    )
    with Renderer(world_of(terrain), 320, 240, VFOV) as drawn:
        albedo, _ = drawn.render(pose)
    points = np.column_stack([dots, terrain.height_at(dots[:, 0], dots[:, 1])])
    camera = geometry.transform(geometry.inverse(pose), points)
    focal_px = 120 / np.tan(np.deg2rad(VFOV) / 2)
    expected = camera[:, :2] / camera[:, 2:] * focal_px + [159.5, 119.5]
    error = np.array([centroid(albedo[..., 0], uv) - uv for uv in expected if inside(uv)])
    assert len(error) >= 15 and np.abs(error).max() < 0.1 and np.abs(error.mean(axis=0)).max() < 0.03


def inside(uv: np.ndarray) -> bool:
    return bool(np.all(uv > 15) and np.all(uv < [304, 224]))


def centroid(grey: np.ndarray, around: np.ndarray) -> np.ndarray:
    c, r = np.rint(around).astype(int)
    v, u = np.mgrid[r - 14 : r + 15, c - 14 : c + 15]
    weight = grey[r - 14 : r + 15, c - 14 : c + 15].astype(float)
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


def test_texture_is_drawn_no_softer_than_a_pixel() -> None:
    """Texels in black and white, a pixel each, off by half a pixel at worst, keep half of their contrast."""
    texel_m = 0.01
    noise = np.where(np.random.default_rng(0).random((300, 300, 1)) < 0.5, 0, 255).astype(np.uint8).repeat(3, axis=2)
    terrain = Terrain(np.zeros((61, 61), np.float32), 0.05, -1.5, -1.5, noise, texel_m)
    focal_px = H / 2 / np.tan(np.deg2rad(VFOV) / 2)
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.005, 0.005, texel_m * focal_px]))
    with Renderer(world_of(terrain), W, H, VFOV) as drawn:
        albedo, _ = drawn.render(pose)
    assert albedo[..., 0].std() > 0.5 * noise[..., 0].std()


def test_hidden_tiles_are_those_that_no_pixel_sees(world: SceneModel, renderer: Renderer) -> None:
    tangents = np.tan(np.deg2rad(VFOV) / 2) * np.array([W / H, 1.0])
    for pose in POSES:
        albedo, depth = renderer.render(pose)
        assert 0 < visible_tiles(world, pose, tangents).sum() < len(world.tile_geom_ids)
        renderer._show(np.ones(len(world.tile_geom_ids), dtype=bool))
        mujoco.mjr_render(renderer._rect, renderer._scene, renderer._context)
        mujoco.mjr_readPixels(renderer._rgb, renderer._z, renderer._rect, renderer._context)
        assert np.array_equal(albedo, renderer._rgb[::-1])
        assert np.array_equal(depth, linear_depth(renderer._z[::-1], renderer._near, renderer._far))


def test_where_no_floor_is_depth_is_infinite(renderer: Renderer) -> None:
    up = geometry.pose(np.diag([1.0, 1.0, 1.0]), np.array([0.0, 0.0, 2.0]))
    _, depth = renderer.render(up)
    assert np.all(np.isinf(depth))


def test_frames_are_copies_and_the_same_pose_gives_the_same_bytes(renderer: Renderer) -> None:
    albedo, depth = renderer.render(POSES[0])
    kept = albedo.copy(), depth.copy()
    renderer.render(POSES[1])
    assert np.array_equal(albedo, kept[0]) and np.array_equal(depth, kept[1])
    again = renderer.render(POSES[0])
    assert np.array_equal(again[0], albedo) and np.array_equal(again[1], depth)


def test_linear_depth_inverts_the_projection() -> None:
    near, far = np.float32(0.05), np.float32(100.0)
    depth = np.array([0.05, 0.3, 2.2, 3.3, 50.0])
    z = (near * (far - depth) / (depth * (far - near))).astype(np.float32)
    assert linear_depth(z, near, far) == pytest.approx(depth, rel=1e-5)
    assert np.isinf(linear_depth(np.zeros(1, np.float32), near, far)[0])


def test_a_machine_without_opengl_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch, world: SceneModel) -> None:
    monkeypatch.setattr(scenes.gl, "_why_missing", "ImportError: no libEGL.so.1")
    with pytest.raises(TwinError, match=r"no libEGL.*apt-get install -y libegl1"):
        Renderer(world, W, H, VFOV)


def test_without_egl_physics_still_runs_and_drawing_says_why() -> None:
    """In a process of its own, where PyOpenGL finds no EGL."""
    code = """
import sys
sys.modules["OpenGL.EGL"] = None
from scenes.gl import GlMissing, mujoco, offscreen_context
model = mujoco.MjModel.from_xml_string("<mujoco/>")
try:
    offscreen_context(64, 48)
except GlMissing as error:
    print(error)
"""
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("rendering: no OpenGL on this machine: ")
    assert "apt-get install -y libegl1" in done.stdout
