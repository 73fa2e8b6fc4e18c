"""Ray casting on height fields and the overlap of images: closed forms, invariances, and a brute-force oracle."""

import numpy as np
import pytest

from twin.core import geometry
from twin.core.height_field import cast_pixels, height_field, image_overlap, map_height_field, ray_grid
from twin.core.records import MapGrid, StereoRig
from twin.terrains import Terrain

RIG = StereoRig(320, 240, 277.0, 0.15)


def looking_down(x, y, z, roll=0.0, pitch=0.0, yaw=0.0):
    """Returns world_from_camera (1, 4, 4)."""
    rotation = geometry.rotation_from_rpy(roll, pitch, yaw) @ geometry.BODY_FROM_DOWN_CAMERA
    return geometry.pose(rotation, np.array([x, y, z]))[None]


def level(height_m=0.0):
    return height_field(np.full((3, 3), height_m), 10.0, -10.0, -10.0)


def rough(seed=0, spacing_m=0.05, relief_m=1.0):
    """Returns a terrain of independent steep heights, 6 m x 6 m."""
    n = round(6 / spacing_m) + 1
    height = np.random.default_rng(seed).uniform(0, relief_m, (n, n)).astype(np.float32)
    return Terrain(height, spacing_m, -3.0, -3.0, np.zeros((2, 2, 3), np.uint8), 3.0)


def field_of(terrain):
    return height_field(terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m)


@pytest.mark.parametrize("step_m", [0.0, 0.137, 0.5, 1.9, 4.0])
@pytest.mark.parametrize("floor_m", [0.0, 0.8])
def test_overlap_over_a_level_floor_is_that_of_the_footprints(step_m, floor_m):
    range_m = 2.0 - floor_m
    width_m, length_m = RIG.width_px * range_m / RIG.focal_px, RIG.height_px * range_m / RIG.focal_px
    first, along, across = looking_down(0, 0, 2), looking_down(step_m, 0, 2), looking_down(0, step_m, 2)
    assert image_overlap(level(floor_m), first, along, RIG)[0] == pytest.approx(max(0, 1 - step_m / length_m), abs=1e-9)
    assert image_overlap(level(floor_m), first, across, RIG)[0] == pytest.approx(max(0, 1 - step_m / width_m), abs=1e-9)


@pytest.mark.parametrize("aside_m", [0.61, 0.623, 0.64, 0.66])
def test_parts_of_cells_count_where_the_second_image_is_taken_from_lower_down(aside_m):
    """From half the height, the footprint has half the sides; it ends in the middle of cells of the first image."""
    width_m, length_m = (2.0 * pixels / RIG.focal_px for pixels in (RIG.width_px, RIG.height_px))
    shown_m = width_m / 2 + width_m / 4 - aside_m
    found = image_overlap(level(), looking_down(0, 0, 2), looking_down(0, aside_m, 1), RIG)[0]
    assert found == pytest.approx(shown_m / width_m * (length_m / 2) / length_m, abs=1e-6)


def test_over_a_step_each_half_of_the_image_has_the_overlap_of_its_height():
    y = np.arange(-400, 401) * 0.01
    field = height_field(np.where(y > 0, 0.5, 0.0)[:, None] * np.ones((1, 801)), 0.01, -4.0, -4.0)
    step_m = 0.3
    found = image_overlap(field, looking_down(0, 0, 2), looking_down(step_m, 0, 2), RIG)[0]
    low, high = (1 - step_m * RIG.focal_px / (RIG.height_px * z) for z in (2.0, 1.5))
    # The two halves of the image show the step's two levels; its own face is one cell wide.
    assert found == pytest.approx((low + high) / 2, abs=0.005)


def test_a_wall_hides_the_floor_behind_it():
    x = np.arange(-400, 401) * 0.01
    field = height_field(np.where(np.abs(x) < 0.05, 1.5, 0.0)[None, :] * np.ones((801, 1)), 0.01, -4.0, -4.0)
    before, behind = looking_down(-0.6, 0, 2), looking_down(0.6, 0, 2)
    flat = image_overlap(level(), before, behind, RIG)[0]
    assert image_overlap(field, before, behind, RIG)[0] < flat - 0.1


def test_an_image_overlaps_itself_wholly_and_a_far_one_not_at_all():
    terrain = rough()
    poses = np.concatenate([looking_down(0.1, 0.2, 2.5, 0.05, -0.1, k) for k in range(4)])
    np.testing.assert_allclose(image_overlap(field_of(terrain), poses, poses, RIG), 1)
    assert image_overlap(level(), looking_down(-5, 0, 2), looking_down(5, 0, 2), RIG)[0] == 0


def test_overlap_does_not_change_when_floor_and_cameras_move_together():
    terrain, shift = rough(), np.array([3.7, -1.2, 0.6])
    moved = height_field(terrain.height_m + shift[2], terrain.spacing_m, -3.0 + shift[0], -3.0 + shift[1])
    first, second = looking_down(0, 0, 2.5, 0.02), looking_down(0.4, 0.3, 2.4, 0, 0.03)
    there = [pose + np.pad(shift[None, :, None], ((0, 0), (0, 1), (3, 0))) for pose in (first, second)]
    assert image_overlap(moved, *there, RIG)[0] == pytest.approx(
        image_overlap(field_of(terrain), first, second, RIG)[0], abs=1e-5
    )


def test_overlap_does_not_change_when_scene_and_baseline_are_scaled():
    terrain = rough()
    larger = height_field(3 * terrain.height_m, 3 * terrain.spacing_m, -9.0, -9.0)
    first, second = (0.1, 0.0, 2.5), (0.5, 0.2, 2.4)
    small = image_overlap(field_of(terrain), looking_down(*first), looking_down(*second), RIG)
    scaled = (looking_down(*(3 * c for c in position)) for position in (first, second))
    np.testing.assert_allclose(image_overlap(larger, *scaled, RIG), small, atol=1e-5)


def test_an_image_without_floor_has_no_overlap():
    assert np.isnan(image_overlap(level(), looking_down(50, 0, 2), looking_down(50, 0, 2), RIG)[0])


def march(terrain, origin, directions, reach, steps):
    """Returns the first parameter t (n,) at which o + t d lies below the terrain; inf without one."""
    t = np.linspace(0, reach, steps)
    x, y, z = (origin[k] + directions[:, k, None] * t for k in range(3))
    below = z < terrain.height_at(x, y)
    return np.where(below.any(axis=1), t[below.argmax(axis=1)], np.inf)


@pytest.mark.parametrize("seed", [0, 1])
def test_overlap_over_a_rough_floor_agrees_with_brute_force_projection(seed):
    terrain = rough(seed, spacing_m=0.25)
    first, second = looking_down(0, 0, 2.6, 0.05)[0], looking_down(0.5, 0.4, 2.4, 0, -0.08, 0.2)[0]
    pixels = np.random.default_rng(seed).uniform(-0.5, [319.5, 239.5], (400, 2))
    rays = np.column_stack([RIG.normalised(pixels), np.ones(400)]) @ first[:3, :3].T
    depth = march(terrain, first[:3, 3], rays, 4.0, 1500)
    points = first[:3, 3] + depth[:, None] * rays
    seen = RIG.project(geometry.transform(geometry.inverse(second), points))
    inside = ((seen >= -0.5) & (seen <= [319.5, 239.5])).all(axis=1)
    hit = march(terrain, second[:3, 3], points - second[:3, 3], 0.99, 1500)
    share = (inside & np.isinf(hit)).mean()
    found = image_overlap(field_of(terrain), first[None], second[None], RIG)[0]
    assert 0.3 < share < 0.95
    assert found == pytest.approx(share, abs=3 * np.sqrt(share * (1 - share) / 400))  # binomial


def test_rays_meet_the_surface_of_a_steep_floor_from_above():
    terrain = rough(3, spacing_m=0.01)  # slopes of up to 45 between neighbouring nodes: hardest for any stepping
    poses = np.concatenate([looking_down(0.2, 0.1, 2.0, 0.1, 0.2, 0.3), looking_down(-0.5, 0, 1.2)])
    pixels = ray_grid(RIG, 16)
    depth = cast_pixels(field_of(terrain), poses, RIG, pixels)
    assert np.isfinite(depth).all()
    rays = np.column_stack([RIG.normalised(pixels), np.ones(len(pixels))])
    for pose, z in zip(poses, depth, strict=True):
        directions = rays @ pose[:3, :3].T
        points = pose[:3, 3] + z[:, None] * directions
        np.testing.assert_allclose(points[:, 2], terrain.height_at(points[:, 0], points[:, 1]), atol=1e-9)
        for share in np.linspace(0.4, 0.999, 200):
            before = pose[:3, 3] + share * z[:, None] * directions
            assert (before[:, 2] > terrain.height_at(before[:, 0], before[:, 1]) - 1e-9).all()


def test_a_map_is_a_height_field_with_its_cells_as_nodes():
    grid = MapGrid(-1.0, 2.0, 0.5, 4, 6)
    x, y = np.meshgrid(*grid.centres())
    field = map_height_field((0.1 * x + 0.2 * y).astype(np.float32), grid)
    depth = cast_pixels(field, looking_down(0.6, 0.9, 2.0), RIG, np.array([[RIG.cx_px, RIG.cy_px]]))
    assert depth[0, 0] == pytest.approx(2.0 - 0.1 * 0.6 - 0.2 * 0.9, abs=1e-6)


def test_cells_without_a_height_are_no_floor():
    height = np.zeros((5, 5))
    height[2, 2] = np.nan
    field = height_field(height, 1.0, -2.0, -2.0)
    centre = np.array([[RIG.cx_px, RIG.cy_px]])
    poses = np.concatenate([looking_down(0.5, 0.5, 2), looking_down(1.5, 1.5, 2)])
    assert np.isinf(cast_pixels(field, poses[:1], RIG, centre)).all()
    assert np.isfinite(cast_pixels(field, poses[1:], RIG, centre)).all()
