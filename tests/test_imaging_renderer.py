"""Renderer against rays and images of MuJoCo, terrain heights and projected patterns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mujoco_floor import floor_model, image, ray_lengths

from twin import terrains
from twin.core import geometry
from twin.imaging.scene.floor_raster import BLOCK_CELLS, floor_grid
from twin.imaging.scene.renderer import Renderer
from twin.imaging.scene.texture_levels import levels_of
from twin.terrains import Terrain, TextureSource

W, H, VFOV = 160, 120, 45.0
FOCAL_PX = float(H / 2 / np.tan(np.deg2rad(VFOV) / 2))
POSES = [
    geometry.pose(geometry.rotation_from_rpy(*map(float, rpy)) @ geometry.BODY_FROM_DOWN_CAMERA, np.array(position))
    for rpy, position in [
        ((0.0, 0.0, 0.0), (0.2, 0.1, 2.2)),
        ((0.1, -0.15, 2.0), (-1.3, 0.4, 1.9)),
        ((-0.3, 0.2, -1.0), (2.8, -1.5, 2.4)),
    ]
]


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return terrains.generate("reef", (7.0, 5.0), 0.5, 0.1, 0.04, TextureSource(0.003, walls=False), 5)


def render(terrain: Terrain, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return Renderer(terrain, W, H, FOCAL_PX).render(pose)


def pixel_rays() -> np.ndarray:
    """Returns the viewing directions (H, W, 3) of the pixel centres in the camera, scaled to z = 1."""
    u, v = np.meshgrid(np.arange(W) - (W - 1) / 2, np.arange(H) - (H - 1) / 2)
    return np.stack([u / FOCAL_PX, v / FOCAL_PX, np.ones_like(u)], axis=-1)


def errors_of_depth(terrain: Terrain, pose: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Returns the errors (n,) [m] of the rendered depths at pixels (n, 2) against rays of MuJoCo; inf: floor or not."""
    _, depth = render(terrain, pose)
    rays = pixel_rays()[pixels[:, 1], pixels[:, 0]]
    expected = ray_lengths(floor_model(terrain), pose[:3, 3], rays @ pose[:3, :3].T)
    rendered = depth[pixels[:, 1], pixels[:, 0]]
    both_none = np.isinf(expected) & np.isinf(rendered)
    assert not both_none.all()
    return np.where(both_none, 0.0, np.abs(np.subtract(rendered, expected, where=~both_none, out=np.zeros(len(rays)))))


def some_pixels(n: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, (W, H), (n, 2))


@pytest.mark.parametrize("pose", POSES)
def test_depth_agrees_with_rays_through_the_pixel_centres(terrain: Terrain, pose: np.ndarray) -> None:
    error = errors_of_depth(terrain, pose, some_pixels(400))
    # single precision is about 1 um at a few metres from the origin
    assert np.median(error) < 5e-6 and np.percentile(error, 98) < 2e-5 and (error < 1e-3).mean() >= 0.995


def rough(spacing_m: float, steps_m: float, n: int) -> Terrain:
    """Returns a floor of n x n cells with random heights, much steeper than any real one, around a hill."""
    at = spacing_m * (np.arange(n + 1) - n / 2)
    hill = 0.5 * np.exp(-2 * (at[:, None] ** 2 + at**2))
    height = hill + np.random.default_rng(7).uniform(0, steps_m, (n + 1, n + 1))
    return Terrain(
        height.astype(np.float32), spacing_m, at[0], at[0], np.full((8, 8, 3), 100, np.uint8), n * spacing_m / 8
    )


@pytest.mark.parametrize(("spacing_m", "steps_m", "n"), [(0.006, 0.03, 200), (0.06, 0.15, 40), (0.7, 0.3, 12)])
def test_depth_agrees_with_rays_for_cells_of_any_size(spacing_m: float, steps_m: float, n: int) -> None:
    """Cells of 0.4, 4 and 46 pixels, which hide one another, under a camera tilted by 20 deg."""
    pose = geometry.pose(
        geometry.rotation_from_rpy(0.3, 0.2, 0.7) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([0.2, -0.1, 2.1])
    )
    error = errors_of_depth(rough(spacing_m, steps_m, n), pose, some_pixels(3000))
    assert (error < 1e-3).mean() >= 0.999


def test_the_bounds_of_a_block_of_cells_are_those_of_its_nodes() -> None:
    height, n = np.add.outer(np.arange(35), np.arange(50)).astype(np.float32), BLOCK_CELLS
    _, low, high = floor_grid(height)
    assert low.shape == (3, 4)
    for i, j in np.ndindex(low.shape):
        nodes = height[n * i : n * (i + 1) + 1, n * j : n * (j + 1) + 1]
        assert (low[i, j], high[i, j]) == (nodes.min(), nodes.max())


def test_triangles_that_reach_behind_the_camera_are_clipped_at_the_near_plane() -> None:
    """Camera 0.3 m above cells of 2 m, almost level: the triangles below it have corners behind it."""
    floor = rough(2.0, 0.0, 8)
    floor = replace(floor, height_m=floor.height_m / 100)  # MuJoCo needs some relief
    pose = geometry.pose(
        geometry.rotation_from_rpy(0.0, -1.2, 0.3) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([0.3, 0.2, 0.3])
    )
    pixels = some_pixels(2000)
    assert np.median(errors_of_depth(floor, pose, pixels)) < 1e-5
    assert (errors_of_depth(floor, pose, pixels) < 1e-3).mean() >= 0.999
    down = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.3, 0.2, 0.04]))
    assert np.all(np.isinf(render(floor, down)[1]))  # nearer than the near plane


@pytest.mark.parametrize("pose", POSES)
def test_rendered_points_are_on_the_terrain(terrain: Terrain, pose: np.ndarray) -> None:
    _, depth = render(terrain, pose)
    valid = np.isfinite(depth)
    points = geometry.transform(pose, pixel_rays()[valid] * depth[valid][:, None].astype(np.float64))
    error = np.abs(points[:, 2] - terrain.height_at(points[:, 0], points[:, 1]))
    assert np.nanmedian(error) < 5e-6 and np.nanpercentile(error, 98) < 2e-5
    assert np.isnan(error).mean() < 0.002  # pixels on the edge of the floor


@pytest.mark.parametrize("height_m", [0.9, 1.5, 2.5])
def test_albedo_agrees_with_the_image_of_mujoco(terrain: Terrain, height_m: float) -> None:
    """At up to 5 texels per pixel. Powers of two, for which OpenGL's levels are means of 2 x 2 texels, too."""
    texture = np.ascontiguousarray(terrain.texture[:1024, :2048])
    terrain = replace(terrain, colours=texture, texture_px_m=7 / 2048)
    pose = geometry.pose(
        geometry.rotation_from_rpy(0.15, -0.1, 0.5) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0.2, height_m])
    )
    albedo, _ = render(terrain, pose)
    difference = np.abs(albedo.astype(int) - image(floor_model(terrain), (H, W), FOCAL_PX, pose))
    assert albedo.std() > 10
    assert difference.mean() < 1.0 and np.percentile(difference, 99.5) <= 3


def test_a_gradient_of_colours_is_rendered_exactly_at_every_level() -> None:
    """Interpolation and averages keep a linear function: the colour of a point does not depend on the distance."""
    ramp = np.rint(np.linspace(0, 255, 511)).astype(np.uint8)
    texture = np.repeat(np.repeat(ramp[None, :, None], 511, axis=0), 3, axis=2)
    floor = Terrain(np.zeros((3, 3), np.float32), 2.0, -2.0, -2.0, texture, 4 / 511)
    for height_m in (0.3, 1.3, 2.9, 4.0):
        pose = geometry.pose(
            geometry.rotation_from_rpy(0.05, 0.1, 1.0) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0, height_m])
        )
        albedo, depth = render(floor, pose)
        x = pose[0, 3] + (pixel_rays() @ pose[0, :3]) * np.where(np.isfinite(depth), depth, 100.0)
        inside = (np.abs(x) < 1.9) & np.isfinite(depth)
        expected = 255 * ((x + 2) / 4 * 511 - 0.5) / 510
        assert (
            np.abs(albedo[..., 1] - expected)[inside].max() < 1.5
        )  # rounded in the texture, in levels and in the image


@pytest.mark.parametrize("shape", [(2, 2), (3, 2), (7, 512), (513, 1025)])
def test_each_level_has_half_the_rows_and_columns_of_the_one_before_rounded_up(shape: tuple[int, int]) -> None:
    texture = np.random.default_rng(0).integers(0, 255, (*shape, 3)).astype(np.uint8)
    levels = levels_of(texture)
    assert levels.finest.base is texture or np.shares_memory(levels.finest, texture)
    sizes = levels.table[:, 1:]
    assert np.array_equal(sizes[1:], -(-sizes[:-1] // 2)) and np.array_equal(sizes[0], shape) and sizes[-1].min() == 2
    assert len(levels.coarser) == 3 * sizes[1:].prod(axis=1).sum()


def test_a_uniform_colour_is_rendered_exactly() -> None:
    terrain = terrains.generate("reef", (5.0, 5.0), 0.4, 0.0, 0.05, TextureSource(0.02), 0)
    colour = np.array([200, 17, 93], np.uint8)
    painted = Terrain(
        terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m,
        np.broadcast_to(colour, terrain.texture.shape).copy(), terrain.texture_px_m,
    )  # fmt: skip
    albedo, _ = render(painted, POSES[0])
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
    albedo, _ = Renderer(terrain, 320, 240, 2 * FOCAL_PX).render(pose)
    points = np.column_stack([dots, terrain.height_at(dots[:, 0], dots[:, 1])])
    camera = geometry.transform(geometry.inverse(pose), points)
    expected = camera[:, :2] / camera[:, 2:] * 2 * FOCAL_PX + [159.5, 119.5]
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
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.005, 0.005, texel_m * FOCAL_PX]))
    albedo, _ = render(terrain, pose)
    assert albedo[..., 0].std() > 0.5 * noise[..., 0].std()


def test_depth_is_infinite_and_the_image_black_where_there_is_no_floor(terrain: Terrain) -> None:
    albedo, depth = render(terrain, geometry.pose(np.eye(3), np.array([0.0, 0.0, 2.0])))
    assert np.all(np.isinf(depth)) and not albedo.any()
    beside = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([3.5, 0.0, 2.2]))  # half of it
    albedo, depth = render(terrain, beside)
    assert 0.4 < np.isinf(depth).mean() < 0.6 and not albedo[np.isinf(depth)].any() and albedo[np.isfinite(depth)].all()


def test_images_are_copies_and_rendering_is_reproducible(terrain: Terrain) -> None:
    renderer = Renderer(terrain, W, H, FOCAL_PX)
    albedo, depth = renderer.render(POSES[0])
    kept = albedo.copy(), depth.copy()
    renderer.render(POSES[1])
    assert np.array_equal(albedo, kept[0]) and np.array_equal(depth, kept[1])
    again = renderer.render(POSES[0])
    assert np.array_equal(again[0], albedo) and np.array_equal(again[1], depth)


@pytest.mark.parametrize(
    ("floor", "texel_m", "tilts_rad"), [("reef", 0.003, (0.0, 0.3, 1.2)), ("flat", 0.001, (0.0, 0.45))]
)
def test_images_over_a_texture_that_is_painted_in_part_are_those_over_the_whole(floor, texel_m, tilts_rad) -> None:
    """The part is just the footprint; with the horizon in an image, and when one shows more, it is the whole."""
    size_m = 2400 * texel_m, 1600 * texel_m
    floors = [
        terrains.generate(floor, size_m, 0.5, 0.1, 0.04, TextureSource(texel_m), 5) for _ in (0.0, *tilts_rad)
    ]  # fmt: skip
    all_over, shares, rng = Renderer(floors.pop(), W, H, FOCAL_PX), list[float](), np.random.default_rng(3)
    for terrain, tilt_rad in zip(floors, tilts_rad, strict=True):
        rotation = geometry.rotation_from_rpy(tilt_rad, rng.uniform(-0.2, 0.2), rng.uniform(-3, 3))
        place = np.array([*rng.uniform(-0.2, 0.2, 2), size_m[1] / 6])
        pose = geometry.pose(rotation @ geometry.BODY_FROM_DOWN_CAMERA, place)
        partly = Renderer(terrain, W, H, FOCAL_PX, all_over.footprint(pose))
        further = geometry.pose(pose[:3, :3], place + [0.5, 0.0, 0.0])
        for k, view in enumerate((pose, further)):
            assert all(np.array_equal(*pair) for pair in zip(partly.render(view), all_over.render(view), strict=True))
            if k == 0:
                shares.append(float(terrain.texture_within(place[:2], place[:2]).any(axis=2).mean()))
    assert shares[0] < 0.3 and (floor == "flat" or shares[-1] == 1.0)


def test_the_image_does_not_depend_on_the_number_of_bands(terrain: Terrain, monkeypatch: pytest.MonkeyPatch) -> None:
    images = []
    for processors in (1, 2):
        monkeypatch.setattr("twin.core.threads._n_processors", lambda n=processors: n)
        images.append(render(terrain, POSES[2]))
    assert all(np.array_equal(*pair) for pair in zip(*images, strict=True))
