"""Cells observed with both cameras: closed forms and brute-force projection."""

import time

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import MapGrid, StereoRig
from twin.world.observed_cells import Coverage
from twin.world.top_surface import true_heights

RIG = StereoRig(320, 240, 277.128, 0.15, 30, np.eye(4))
GRID = MapGrid(-2.0, 2.0, 0.02, 200, 200)
CAMERA = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, -0.2, 2.0]))  # bow to the east


def level_depth(camera: np.ndarray, offset_x_m: float = 0.0) -> np.ndarray:
    """Returns the depth image (height, width) of the floor z = 0 along the optical axis, from a shifted camera [m]."""
    v, u = np.mgrid[: RIG.height_px, : RIG.width_px]
    rays = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones(u.shape)], axis=-1)
    shifted = camera @ geometry.pose(np.eye(3), np.array([offset_x_m, 0, 0]))
    return (-shifted[2, 3] / (rays @ shifted[2, :3])).astype(np.float32)


def brute_force(camera: np.ndarray) -> np.ndarray:
    """Returns the cells of the floor z = 0 whose centres project into both images."""
    x, y = np.meshgrid(*GRID.centres())
    points = geometry.transform(geometry.inverse(camera), np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3))
    u = RIG.focal_px * points[:, 0] / points[:, 2] + RIG.cx_px
    v = RIG.focal_px * points[:, 1] / points[:, 2] + RIG.cy_px
    u_right = u - RIG.focal_px * RIG.baseline_m / points[:, 2]
    return ((u_right >= 0) & (u <= 319) & (v >= 0) & (v <= 239)).reshape(x.shape)


@pytest.mark.parametrize("rpy_deg", [(0, 0, 0), (4, -7, 30), (-10, 5, 170)])
def test_on_a_level_floor_exactly_the_cells_in_both_images_are_seen(rpy_deg):
    rotation = geometry.rotation_from_rpy(*np.deg2rad(rpy_deg)) @ geometry.BODY_FROM_DOWN_CAMERA
    camera = geometry.pose(rotation, CAMERA[:3, 3])
    coverage = Coverage(GRID, RIG)
    coverage.add(camera, level_depth(camera), level_depth(camera, RIG.baseline_m))
    expected = brute_force(camera)
    # the boundary is accurate to one pixel (7 mm, cell 20 mm): only cells at the boundary may differ
    differs = coverage.seen != expected
    assert differs.sum() < 0.4 * 4 * np.sqrt(expected.sum())
    assert not differs[eroded(expected, 1) | ~dilated(expected, 1)].any()
    centroids = [np.mean(np.nonzero(mask), axis=1) for mask in (coverage.seen, expected)]
    np.testing.assert_allclose(*centroids, atol=0.1)  # no half-cell shift [cells]


def dilated(mask: np.ndarray, n: int) -> np.ndarray:
    rolls = [np.roll(mask, (i, j), (0, 1)) for i in range(-n, n + 1) for j in range(-n, n + 1)]
    return np.any(rolls, axis=0)


def eroded(mask: np.ndarray, n: int) -> np.ndarray:
    return ~dilated(~mask, n)


def test_cells_hidden_from_the_right_camera_are_not_seen():
    depth_left, depth_right = level_depth(CAMERA), level_depth(CAMERA, RIG.baseline_m)
    depth_right[:, 100:180] = 1.0  # a near object in front of the right camera only
    coverage = Coverage(GRID, RIG)
    coverage.add(CAMERA, depth_left, depth_right)
    disparity = RIG.focal_px * RIG.baseline_m / 2.0
    u = np.array([102, 140, 177]) + disparity  # left pixels of the hidden points
    y = CAMERA[1, 3] - (u - RIG.cx_px) / RIG.focal_px * 2.0  # image right is starboard: south
    rows = ((GRID.north_m - y) / GRID.cell_m).astype(int)
    assert not coverage.seen[rows, 105].any()
    assert coverage.seen[rows[0] - 12, 105] and coverage.seen[rows[2] + 12, 105]


def test_the_floor_hidden_by_an_occluding_edge_is_not_seen():
    depth_left, depth_right = level_depth(CAMERA), level_depth(CAMERA, RIG.baseline_m)
    depth_left[:, :200] = 1.2  # the top of a wall, which hides a strip of the floor behind its edge
    depth_right[:, : 200 - int(RIG.focal_px * RIG.baseline_m / 1.2)] = 1.2
    coverage = Coverage(GRID, RIG)
    coverage.add(CAMERA, depth_left, depth_right)
    y_wall = CAMERA[1, 3] - (199 - RIG.cx_px) / RIG.focal_px * 1.2
    y_floor = CAMERA[1, 3] - (200 - RIG.cx_px) / RIG.focal_px * 2.0
    y = GRID.centres()[1]
    hidden = (y < y_wall - 0.01) & (y > y_floor + 0.01)
    assert hidden.sum() >= 4
    assert not coverage.seen[hidden].any()
    assert coverage.seen[(y > y_wall + 0.02) & (y < y_wall + 0.3), 105].all()
    assert coverage.seen[(y < y_floor - 0.02) & (y > y_floor - 0.3), 105].all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1.0])
def test_pixels_without_depth_mark_no_cell(bad):
    coverage = Coverage(GRID, RIG)
    coverage.add(CAMERA, np.full((240, 320), bad, np.float32), level_depth(CAMERA))
    assert not coverage.seen.any()


def test_coverage_accumulates_over_keyframes_partly_outside_the_grid():
    coverage = Coverage(GRID, RIG)
    coverage.add(CAMERA, level_depth(CAMERA), level_depth(CAMERA, RIG.baseline_m))
    first = coverage.seen.copy()
    far = geometry.pose(CAMERA[:3, :3], np.array([1.9, 1.9, 2.0]))
    coverage.add(far, level_depth(far), level_depth(far, RIG.baseline_m))
    assert (coverage.seen >= first).all() and coverage.seen.sum() > first.sum()


def test_a_keyframe_takes_a_few_milliseconds():
    coverage = Coverage(GRID, RIG)
    left, right = level_depth(CAMERA), level_depth(CAMERA, RIG.baseline_m)
    times = []
    for _ in range(7):
        coverage.seen[:] = False
        start = time.perf_counter()
        coverage.add(CAMERA, left, right)
        times.append(time.perf_counter() - start)
    assert min(times[1:]) < 0.012  # measured 2 to 3 ms; the first call compiles


def test_true_heights_are_evaluated_at_the_cell_centres():
    grid = MapGrid(1.0, 5.0, 0.5, 2, 3)
    heights = true_heights(grid, lambda x, y: 10 * x + y)
    np.testing.assert_allclose(heights, [[17.25, 22.25, 27.25], [16.75, 21.75, 26.75]])
    assert heights.dtype == np.float32
