"""Renderer against ray casting, terrain heights and projected patterns, all independent of OpenGL."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from twin import scenes, terrains
from twin.core import geometry
from twin.errors import TwinError
from twin.imaging.scene.renderer import Renderer, linear_depth, visible_tiles
from twin.scenes.builder import SceneModel, build
from twin.scenes.gl import mujoco
from twin.terrains import Terrain, TextureSource

W, H, VFOV = 160, 120, 45.0
POSES = [
    geometry.pose(geometry.rotation_from_rpy(*map(float, rpy)) @ geometry.BODY_FROM_DOWN_CAMERA, np.array(position))
    for rpy, position in [
        ((0.0, 0.0, 0.0), (0.2, 0.1, 2.2)),
        ((0.1, -0.15, 2.0), (-1.3, 0.4, 1.9)),
        ((-0.3, 0.2, -1.0), (2.8, -1.5, 2.4)),
    ]
]


def world_of(terrain: Terrain) -> SceneModel:
    return build(terrain, 0.01)


@pytest.fixture(scope="module")
def world() -> SceneModel:
    return world_of(terrains.generate("reef", (7.0, 5.0), 0.5, 0.1, 0.04, TextureSource(0.003), 5))


@pytest.fixture(scope="module")
def renderer(world: SceneModel) -> Iterator[Renderer]:
    with Renderer(world, W, H, VFOV) as opened:
        yield opened


def pixel_rays(width_px: int, height_px: int, vfov_deg: float) -> np.ndarray:
    """Returns the viewing directions (height, width, 3) of the pixel centres in the camera, scaled to z = 1."""
    focal_px = height_px / 2 / float(np.tan(np.deg2rad(vfov_deg) / 2))
    u, v = np.meshgrid(np.arange(width_px) - (width_px - 1) / 2, np.arange(height_px) - (height_px - 1) / 2)
    return np.stack([u / focal_px, v / focal_px, np.ones_like(u)], axis=-1)


def ray_depths(world: SceneModel, pose: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Returns the depths (n,) [m] of pixels (n, 2) by ray casting in MuJoCo; inf where there is no floor."""
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
def test_depth_agrees_with_rays_through_the_pixel_centres(
    world: SceneModel, renderer: Renderer, pose: np.ndarray
) -> None:
    _, depth = renderer.render(pose)
    pixels = np.random.default_rng(1).integers(0, (W, H), (400, 2))
    rendered, expected = depth[pixels[:, 1], pixels[:, 0]], ray_depths(world, pose, pixels)
    inside = np.isfinite(expected)
    assert np.array_equal(np.isfinite(rendered), inside)
    error = np.abs(rendered[inside] - expected[inside])
    # single precision is about 1 um at a few metres from the origin
    assert np.median(error) < 5e-6 and np.percentile(error, 98) < 2e-5


@pytest.mark.parametrize("pose", POSES)
def test_rendered_points_are_on_the_terrain(world: SceneModel, renderer: Renderer, pose: np.ndarray) -> None:
    _, depth = renderer.render(pose)
    valid = np.isfinite(depth)
    points = geometry.transform(pose, pixel_rays(W, H, VFOV)[valid] * depth[valid][:, None].astype(np.float64))
    error = np.abs(points[:, 2] - world.terrain.height_at(points[:, 0], points[:, 1]))
    assert np.nanmedian(error) < 5e-6 and np.nanpercentile(error, 98) < 2e-5
    assert np.isnan(error).mean() < 0.002  # pixels on the edge of the floor


def test_tile_borders_are_invisible(monkeypatch: pytest.MonkeyPatch, world: SceneModel, renderer: Renderer) -> None:
    """A floor of 12 tiles is rendered like a floor of one tile."""
    tiled = [renderer.render(pose) for pose in POSES]
    monkeypatch.setattr(scenes.builder, "TILE_CELLS", 1000)
    with Renderer(world_of(world.terrain), W, H, VFOV) as untiled:
        for (albedo, depth), pose in zip(tiled, POSES, strict=True):
            single_albedo, single_depth = untiled.render(pose)
            both = np.isfinite(depth) & np.isfinite(single_depth)
            assert (np.isfinite(depth) != np.isfinite(single_depth)).mean() < 1e-3
            off = np.abs(depth[both] - single_depth[both]) > 1e-4
            assert off.mean() < 1e-3  # silhouettes may fall on the other side of a pixel centre
            difference = np.abs(albedo.astype(int) - single_albedo.astype(int))[both].max(axis=-1)
            assert np.percentile(difference, 99) <= 2 and (difference > 8).mean() < 1e-3


def test_a_uniform_colour_is_rendered_exactly() -> None:
    terrain = terrains.generate("reef", (5.0, 5.0), 0.4, 0.0, 0.05, TextureSource(0.02), 0)
    colour = np.array([200, 17, 93], np.uint8)
    painted = Terrain(
        terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m,
        np.broadcast_to(colour, terrain.texture.shape).copy(), terrain.texture_px_m,
    )  # fmt: skip
    with Renderer(world_of(painted), W, H, VFOV) as opened:
        albedo, _ = opened.render(POSES[0])
    assert np.all(albedo == colour)


def dotted(terrain: Terrain, dots_m: np.ndarray, sigma_m: float) -> Terrain:
    """Returns the floor in black with round white dots at the given positions (n, 2)."""
    h, w = terrain.texture.shape[:2]
    x = terrain.west_m + (np.arange(w) + 0.5) * terrain.size_m[0] / w
    y = terrain.north_m - (np.arange(h) + 0.5) * terrain.size_m[1] / h
    squared = (x[None, :, None] - dots_m[:, 0]) ** 2 + (y[:, None, None] - dots_m[:, 1]) ** 2
    grey = np.rint(255 * np.exp(-squared / (2 * sigma_m**2)).max(axis=2)).astype(np.uint8)
    texture = np.repeat(grey[..., None], 3, axis=2)
    return Terrain(terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m, texture, terrain.texture_px_m)


def test_a_pattern_is_rendered_at_its_projection() -> None:
    """Dots are within 0.1 px of their projection, 0.03 px on average."""
    tilted = np.add.outer(0.05 * np.arange(61), 0.02 * np.arange(91)).astype(np.float32) * 0.05
    plain = Terrain(tilted, 0.05, -2.25, -1.5, np.zeros((600, 900, 3), np.uint8), 0.005)
    x, y = np.meshgrid(np.linspace(-0.6, 0.7, 5), np.linspace(-0.6, 0.6, 5))
    dots = np.stack([x.ravel(), y.ravel()], axis=1) + np.random.default_rng(2).uniform(-0.04, 0.04, (25, 2))
    terrain = dotted(plain, dots, 0.03)
    pose = geometry.pose(
        geometry.rotation_from_rpy(0.03, 0.02, 0.4) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([0, 0, 2.0])
    )
    with Renderer(world_of(terrain), 320, 240, VFOV) as opened:
        albedo, _ = opened.render(pose)
    points = np.column_stack([dots, terrain.height_at(dots[:, 0], dots[:, 1])])
    camera = geometry.transform(geometry.inverse(pose), points)
    focal_px = 120 / np.tan(np.deg2rad(VFOV) / 2)
    expected = camera[:, :2] / camera[:, 2:] * focal_px + [159.5, 119.5]
    error = np.array([centroid(albedo[..., 0], uv) - uv for uv in expected if inside(uv)])
    assert len(error) >= 15 and np.abs(error).max() < 0.1 and np.abs(error.mean(axis=0)).max() < 0.03


def inside(uv: np.ndarray) -> bool:
    """Returns whether a dot at a pixel is completely within the image."""
    return bool(np.all(uv > 15) and np.all(uv < [304, 224]))


def centroid(grey: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Returns the centroid (2,) of a dot near a pixel [px]."""
    c, r = np.rint(around).astype(int)
    v, u = np.mgrid[r - 14 : r + 15, c - 14 : c + 15]
    weight = grey[r - 14 : r + 15, c - 14 : c + 15].astype(float)
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


def test_texture_keeps_detail_of_one_pixel() -> None:
    """Black and white texels of one pixel, displaced by half a pixel at most, keep half of their contrast."""
    texel_m = 0.01
    noise = np.where(np.random.default_rng(0).random((300, 300, 1)) < 0.5, 0, 255).astype(np.uint8).repeat(3, axis=2)
    terrain = Terrain(np.zeros((61, 61), np.float32), 0.05, -1.5, -1.5, noise, texel_m)
    focal_px = H / 2 / np.tan(np.deg2rad(VFOV) / 2)
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.005, 0.005, texel_m * focal_px]))
    with Renderer(world_of(terrain), W, H, VFOV) as opened:
        albedo, _ = opened.render(pose)
    assert albedo[..., 0].std() > 0.5 * noise[..., 0].std()


def test_hidden_tiles_do_not_change_the_image(world: SceneModel, renderer: Renderer) -> None:
    tangents = np.tan(np.deg2rad(VFOV) / 2) * np.array([W / H, 1.0])
    for pose in POSES:
        albedo, depth = renderer.render(pose)
        assert 0 < visible_tiles(world, pose, tangents).sum() < len(world.tile_geom_ids)
        renderer._show(np.ones(len(world.tile_geom_ids), dtype=bool))
        mujoco.mjr_render(renderer._rect, renderer._scene, renderer._context)
        mujoco.mjr_readPixels(renderer._rgb, renderer._z, renderer._rect, renderer._context)
        assert np.array_equal(albedo, renderer._rgb[::-1])
        assert np.array_equal(depth, linear_depth(renderer._z[::-1]))


def test_depth_is_infinite_where_there_is_no_floor(renderer: Renderer) -> None:
    up = geometry.pose(np.diag([1.0, 1.0, 1.0]), np.array([0.0, 0.0, 2.0]))
    _, depth = renderer.render(up)
    assert np.all(np.isinf(depth))


def test_images_are_copies_and_rendering_is_reproducible(renderer: Renderer) -> None:
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
    assert linear_depth(z) == pytest.approx(depth, rel=1e-5)
    assert np.isinf(linear_depth(np.zeros(1, np.float32))[0])


def test_missing_opengl_is_reported_with_the_package_to_install(
    monkeypatch: pytest.MonkeyPatch, world: SceneModel
) -> None:
    monkeypatch.setattr(scenes.gl, "_loaded", lambda: (sys.modules["mujoco"], "ImportError: no libEGL.so.1"))
    with pytest.raises(TwinError, match=r"no libEGL.*apt-get install -y libegl1"):
        Renderer(world, W, H, VFOV)


def test_without_egl_mujoco_loads_and_rendering_reports_the_reason() -> None:
    """Runs in a separate process in which PyOpenGL cannot load EGL."""
    code = """
import sys
sys.modules["OpenGL.EGL"] = None
from twin.scenes.gl import mujoco, offscreen_context
from twin.errors import TwinError
model = mujoco.MjModel.from_xml_string("<mujoco/>")
try:
    offscreen_context(64, 48)
except TwinError as error:
    print(error)
"""
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("rendering: no OpenGL on this machine: ")
    assert "apt-get install -y libegl1" in done.stdout
