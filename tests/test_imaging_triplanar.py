"""Texture of steep parts of the floor: its detail, its agreement between views and with the true albedo, its limits."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from twin import terrains
from twin.core import geometry
from twin.core.records import MapGrid
from twin.imaging.scene.renderer import Renderer
from twin.terrains import Terrain, TextureSource
from twin.terrains.walls import wall_weights
from twin.world.top_surface import true_albedo

W, H, VFOV = 320, 240, 45.0
FOCAL_PX = float(H / 2 / np.tan(np.deg2rad(VFOV) / 2))
TEXEL_M = 0.005


def floor(heights: Callable[[np.ndarray, np.ndarray], np.ndarray | float], walls: bool = True) -> Terrain:
    """Returns a floor of 3 m x 3 m with the heights of a function of x (1, nx) and y (ny, 1)."""
    return terrains.generate_from(
        lambda x, y, _: heights(x[None], y[:, None]) + np.zeros((len(y), len(x))), (3.0, 3.0), 0.05,
        TextureSource(TEXEL_M, walls=walls), "sand", 3,
    )  # fmt: skip


def render(terrain: Terrain, *poses: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns albedo (H, W, 3) and depth (H, W) of a floor at each pose (4, 4) of the camera."""
    renderer = Renderer(terrain, W, H, FOCAL_PX)
    return [renderer.render(pose) for pose in poses]


def looking(along: np.ndarray, at: np.ndarray, distance_m: float) -> np.ndarray:
    """Returns the pose (4, 4) of a camera that looks along a direction at a point, with a horizontal x axis."""
    z = along / np.linalg.norm(along)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
    return geometry.pose(np.stack([x, np.cross(z, x), z], axis=1), at - distance_m * z)


def points_of(depth: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Returns the points (H, W, 3) of the pixels in the world."""
    u, v = np.meshgrid(np.arange(W) - (W - 1) / 2, np.arange(H) - (H - 1) / 2)
    rays = np.stack([u / FOCAL_PX, v / FOCAL_PX, np.ones_like(u)], axis=2)
    rays *= np.where(np.isfinite(depth), depth, 100.0)[..., None]  # beyond the floor where there is none
    return geometry.transform(pose, rays.reshape(-1, 3).astype(np.float64)).reshape(H, W, 3)


def interpolated(image: np.ndarray, col: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Returns an image at columns and rows (H, W), interpolated bilinearly."""
    return np.asarray(cv2.remap(image, col.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR))


def steepness(terrain: Terrain, points: np.ndarray) -> np.ndarray:
    """Returns the slope [deg] of the cells at points (..., 3)."""
    north, east = np.gradient(terrain.height_m.astype(np.float64), terrain.spacing_m)
    col, row = ((points[..., k] - low) / terrain.spacing_m for k, low in ((0, terrain.west_m), (1, terrain.south_m)))
    return np.rad2deg(np.arctan(interpolated(np.hypot(north, east).astype(np.float32), col, row)))


def gradient_energy(albedo: np.ndarray) -> tuple[float, float]:
    """Returns the mean squared gradients along columns and along rows of an image, in relation to its variance."""
    grey = albedo.mean(axis=2)
    return float((np.diff(grey, axis=0) ** 2).mean() / grey.var()), float((np.diff(grey) ** 2).mean() / grey.var())


def bumps(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns heights [m] of rounded hills and hollows with slopes in all directions, up to 70 deg."""
    return 0.3 * np.tanh(2.5 * np.sin(3.5 * x + 0.4) * np.sin(3.5 * y - 0.3)) + 0.1 * x


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 200.0, 315.0])
def test_a_wall_has_the_detail_of_level_ground_and_a_draped_texture_a_fraction_of_it(azimuth_deg: float) -> None:
    slope, azimuth = np.tan(np.deg2rad(70.0)), np.deg2rad(azimuth_deg)
    falling = np.array([np.cos(azimuth), np.sin(azimuth)])
    wall = floor(lambda x, y: -slope * (falling[0] * x + falling[1] * y))
    normal = np.array([*(slope * falling), 1.0])
    facing = looking(-normal, np.array([0.0, 0.0, 0.0]), 1.2)
    ((level, _),) = render(floor(lambda x, y: 0.0), looking(np.array([0.0, 0.0, -1.0]), np.zeros(3), 1.2))
    expected = gradient_energy(level)
    found = gradient_energy(render(wall, facing)[0][0])
    draped = gradient_energy(render(replace(wall, walls=None), facing)[0][0])
    # stretched by 1 / cos 70 deg = 2.9, gradients along the slope have 1 / 8.5 of the energy; an azimuth between the
    # axes compresses by sqrt(2) across and blends two textures, whose filter removes some of the gradients
    print("gradient energy", azimuth_deg, np.divide(found, expected), np.divide(draped, expected))
    assert draped[0] < 0.3 * expected[0]
    assert 0.6 < found[0] / expected[0] < 1.7 and 0.6 < found[1] / expected[1] < 2.2


def test_pixels_of_moderate_slopes_keep_every_byte() -> None:
    terrain = floor(bumps)
    pose = looking(np.array([0.3, 0.4, -1.0]), np.zeros(3), 2.2)
    (albedo, depth), (draped, same) = render(terrain, pose)[0], render(replace(terrain, walls=None), pose)[0]
    assert np.array_equal(depth, same)
    assert terrain.walls is not None
    points = points_of(depth, pose)
    col, row = (points[..., 0] - terrain.west_m) / 0.05, (points[..., 1] - terrain.south_m) / 0.05
    edge = np.abs(col - np.rint(col)).clip(max=np.abs(row - np.rint(row))) < 1e-3  # either cell
    c, r = (np.clip(np.floor(k), 0, 59).astype(int) for k in (col, row))
    level = (terrain.walls.number[r, c] < 0) & ~edge & np.isfinite(depth)
    changed = (albedo != draped).any(axis=2)
    assert level.sum() > 5000 and changed.sum() > 5000
    assert not (changed & level).any()


def test_a_floor_without_steep_slopes_has_no_walls() -> None:
    slope = np.tan(np.deg2rad(49.0))
    assert floor(lambda x, y: slope * x).walls is None
    assert floor(lambda x, y: np.tan(np.deg2rad(52.0)) * x).walls is not None
    assert floor(bumps, walls=False).walls is None


def test_walls_do_not_change_the_texture_from_above_of_the_same_seed() -> None:
    with_walls, without = (
        terrains.generate("reef", (3.0, 3.0), 0.9, 0.0, 0.05, TextureSource(0.01, walls=walls), 4)
        for walls in (True, False)
    )
    assert with_walls.walls is not None
    assert np.array_equal(with_walls.texture, without.texture)


def test_two_views_of_a_wall_show_the_same_albedo() -> None:
    """The texture is blurred, so that only the different filters of the views remain: on walls as on level ground."""
    terrain = floor(bumps)
    assert terrain.walls is not None
    of_walls = terrain.walls.texture
    blurred = cv2.GaussianBlur(of_walls.image, (0, 0), 4)
    smooth = replace(
        terrain, colours=cv2.GaussianBlur(terrain.texture, (0, 0), 4),
        walls=terrain.walls._replace(texture=replace(of_walls, begin=lambda: blurred)),
    )  # fmt: skip
    first = looking(np.array([0.2, 0.1, -1.0]), np.zeros(3), 2.2)
    second = first @ geometry.pose(geometry.rotation_from_rpy(0.1, -0.15, 0.6), np.array([0.3, -0.1, 0.1]))
    (one, depth), (two, other) = render(smooth, first, second)
    points = points_of(depth, first)
    seen = geometry.transform(geometry.inverse(second), points.reshape(-1, 3)).reshape(H, W, 3)
    u, v = (seen[..., k] / seen[..., 2] * FOCAL_PX + (n - 1) / 2 for k, n in ((0, W), (1, H)))
    there, z = interpolated(two, u, v).astype(float), interpolated(other, u, v)
    same = np.isfinite(depth) & (u > 1) & (u < W - 2) & (v > 1) & (v < H - 2) & (np.abs(z - seen[..., 2]) < 0.002)
    slope = steepness(smooth, points)
    difference = (there - one).mean(axis=2)
    steep, level = same & (slope > 52), same & (slope < 30)
    assert steep.sum() > 3000 and level.sum() > 3000
    scatter = one.mean(axis=2)[steep].std()
    print("views", scatter, difference[level].std() / scatter, difference[steep].std() / scatter)
    assert difference[level].std() < 0.06 * scatter
    assert difference[steep].std() < 0.06 * scatter


def test_the_true_albedo_is_that_of_an_image_from_above() -> None:
    """Correlation with the image of a camera that looks down from far away, on steep ground as on level ground."""
    terrain = floor(bumps)
    pose = looking(np.array([0.0, 0.0, -1.0]), np.array([0.1, -0.05, 0.0]), 3.0)
    ((albedo, depth),) = render(terrain, pose)
    points = points_of(depth, pose)
    grid = MapGrid(-1.4, 1.4, 0.01, 280, 280)
    col, row = (points[..., 0] + 1.4) / 0.01 - 0.5, (1.4 - points[..., 1]) / 0.01 - 0.5
    inside = np.isfinite(depth) & (col > 1) & (col < 278) & (row > 1) & (row < 278)
    correlation = {}
    for name, of in (("walls", terrain), ("draped", replace(terrain, walls=None))):
        truth = interpolated(true_albedo(of, grid), col, row)
        for steep in (True, False):
            here = inside & ((steepness(terrain, points) > 60) == steep)
            assert here.sum() > 1000
            blurred = cv2.GaussianBlur(albedo, (0, 0), 0.5)[here].mean(axis=1)
            correlation[name, steep] = np.corrcoef(blurred, truth[here].mean(axis=1))[0, 1]
    print(correlation)
    assert correlation["walls", True] > 0.85 and correlation["walls", False] > 0.85
    assert correlation["draped", True] < 0.5


def test_a_uniform_colour_of_floor_and_walls_is_exact() -> None:
    """The weights of all samples of a pixel add up to one."""
    terrain = floor(bumps)
    assert terrain.walls is not None
    colour = np.array([200, 17, 93], np.uint8)
    of_walls = terrain.walls.texture
    plain = replace(of_walls, begin=lambda: np.full(of_walls.shape, colour, np.uint8))
    walls = terrain.walls._replace(texture=plain)
    painted = replace(terrain, colours=np.full_like(terrain.texture, colour), walls=walls)
    ((albedo, depth),) = render(painted, looking(np.array([0.5, 0.2, -1.0]), np.zeros(3), 2.0))
    assert np.all(albedo[np.isfinite(depth)] == colour)
    grid = MapGrid(-1.0, 1.0, 0.02, 100, 100)
    assert np.all(true_albedo(painted, grid) == colour)


def test_a_step_of_one_cell_is_a_wall_and_the_level_ground_beside_it_is_not() -> None:
    height = np.zeros((9, 9), np.float32)
    height[:, 5:] = 0.3
    found = wall_weights(height, 0.05)
    assert found is not None
    number, weights = found
    assert np.all(number[:, 4] >= 0)
    assert np.all(np.delete(number, 4, axis=1) == -1)
    np.testing.assert_allclose(weights[..., 0], -1.0, atol=0.01)  # the normal points to -x
    assert np.all(weights[..., 1] == 0)


def test_weights_are_continuous_on_a_smooth_floor() -> None:
    """Adjacent cells have the same weights at the corners that they share."""
    y, x = np.mgrid[0:3:121j, 0:3:121j]
    found = wall_weights(bumps(x, y).astype(np.float32), 0.025)
    assert found is not None
    number, weights = found
    west, east = number[:, :-1], number[:, 1:]
    both = (west >= 0) & (east >= 0)
    jump = np.abs(weights[west[both]][:, :, 1] - weights[east[both]][:, :, 0])
    assert both.sum() > 1000 and np.percentile(jump, 99) < 1e-6
    assert np.all(np.abs(weights).sum(axis=3) <= 1 + 1e-6)


def test_cells_that_an_orthophoto_covers_keep_its_texture() -> None:
    slope = np.tan(np.deg2rad(60.0)) * 0.05
    height = np.tile(slope * np.arange(11, dtype=np.float32), (11, 1))
    covered = np.zeros((100, 100), np.bool_)
    covered[:35, 20:] = True  # the northern rows; 10 texels per cell
    found = wall_weights(height, 0.05, covered)
    assert found is not None
    expected = np.ones((10, 10), np.bool_)
    expected[6:, 2:] = False  # row 6 is covered in part
    assert np.array_equal(found[0] >= 0, expected)


def test_the_result_does_not_depend_on_the_number_of_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    terrain, pose, images = floor(bumps), looking(np.array([0.3, 0.4, -1.0]), np.zeros(3), 2.2), []
    for processors in (1, 2):
        monkeypatch.setattr("twin.core.threads._n_processors", lambda n=processors: n)
        images.append(render(terrain, pose)[0][0])
    assert np.array_equal(*images)


def test_a_camera_that_sees_no_floor_keeps_its_image() -> None:
    terrain = floor(bumps)
    assert terrain.walls is not None
    row, col = np.argwhere(terrain.walls.number >= 0)[500]  # above a wall
    x, y = terrain.west_m + (col + 0.5) * terrain.spacing_m, terrain.south_m + (row + 0.5) * terrain.spacing_m
    ((albedo, depth),) = render(terrain, looking(np.array([0.0, 0.01, 1.0]), np.array([x, y, 3.0]), 0.0))
    assert np.all(np.isinf(depth)) and np.all(albedo == 0)


@pytest.mark.slow
def test_walls_in_half_of_the_pixels_multiply_the_time_of_rendering_by_at_most_four() -> None:
    terrain, pose = floor(bumps), looking(np.array([0.1, 0.0, -1.0]), np.zeros(3), 1.6)
    with_walls, without = (Renderer(t, 2 * W, 2 * H, 2 * FOCAL_PX) for t in (terrain, replace(terrain, walls=None)))
    changed = (with_walls.render(pose)[0] != without.render(pose)[0]).any(axis=2)
    assert 0.3 < changed.mean() < 0.7

    def least_time_s(renderer: Renderer) -> float:
        times = []
        for _ in range(20):
            start = time.process_time()
            renderer.render(pose)
            times.append(time.process_time() - start)
        return min(times)

    ratio = least_time_s(with_walls) / least_time_s(without)
    print("ratio", ratio)
    assert ratio < 4
