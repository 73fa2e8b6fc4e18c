"""Heights that their camera cannot have seen: lines of sight against an exact ray caster, islands, and whole maps."""

import numpy as np
import pytest
from seafloor_scene import Seafloor, down_camera, render_view, small_rig, smooth_texture

from twin.core.records import MapGrid
from twin.estimate.mapping import elevation, surface, visibility
from twin.estimate.mapping.depth_filter import DepthMap
from twin.estimate.mapping.surface import HeightPatch

GRID = MapGrid(-1.0, 0.8, 0.02, 80, 100)
X, Y = np.meshgrid(*GRID.centres())
RIG = small_rig(160, 120)
ALTITUDE_M = 2.0
FLOOR = np.zeros(X.shape, np.float32)
CELL_M2 = np.full(X.shape, GRID.cell_m**2, np.float32)


def block(rows, cols, row=40, col=50):
    area = np.zeros(X.shape, bool)
    area[row : row + rows, col : col + cols] = True
    return area


def seen_from(position_m, depth_m, area):
    """Returns which of the heights `-depth_m` in an area are hidden from a camera by a level floor around the area."""
    height = np.where(area, -depth_m, np.nan).astype(np.float32)
    floor = np.where(area, np.nan, FLOOR).astype(np.float32)
    camera = np.zeros(X.shape, np.int32)
    return visibility.hidden(height, camera, np.array([position_m], float), (floor, CELL_M2), GRID)[area]


def test_the_floor_of_a_pit_is_seen_from_above_and_hidden_from_the_side():
    pit = block(6, 6)
    above = X[pit].mean(), Y[pit].mean(), ALTITUDE_M
    assert not seen_from(above, 15.0, pit).any()
    assert seen_from((above[0] - 0.9, above[1], ALTITUDE_M), 15.0, pit).all()


@pytest.mark.parametrize("bearing", np.deg2rad([0, 50, 90, 135, 200, 300]))
def test_a_line_of_sight_is_blocked_where_similar_triangles_say_so(bearing):
    """At a horizontal distance s from the height, the line is at -D + (D + Z) s / S, with S the distance of the camera.

    It is blocked if this is below -3 sigma at the first cell whose neighbours are all known, 2 to 3 cells away.
    """
    hole, far_m = block(1, 1), 0.7
    camera = X[hole][0] + far_m * np.cos(bearing), Y[hole][0] + far_m * np.sin(bearing), ALTITUDE_M
    for cells, factor, expected in ((3, 1.02, True), (2, 0.98, False)):
        rise = cells * GRID.cell_m / far_m  # fraction of the line after this many cells
        depth_m = (rise * ALTITUDE_M + 3 * GRID.cell_m) / (1 - rise)
        assert seen_from(camera, factor * depth_m, hole).all() == expected


def test_heights_above_the_surface_and_heights_of_unknown_cameras_are_never_hidden():
    top = block(3, 3)
    assert not seen_from((X.min(), Y.min(), ALTITUDE_M), -0.5, top).any()
    low, unknown = np.where(top, -15.0, np.nan).astype(np.float32), np.full(X.shape, -1, np.int32)
    floor = np.where(top, np.nan, FLOOR).astype(np.float32)
    far = np.array([[X.min(), Y.min(), ALTITUDE_M]])
    assert not visibility.hidden(low, unknown, far, (floor, CELL_M2), GRID).any()
    assert not visibility.hidden(low, unknown, np.zeros((0, 3)), (floor, CELL_M2), GRID).any()


@pytest.mark.parametrize(("more", "island"), [(-399, True), (0, True), (1, False)])
def test_islands_are_groups_of_at_most_400_cells(more, island):
    area = block(20, 20, 20, 10) & (np.cumsum(block(20, 20, 20, 10)).reshape(X.shape) <= 400 + min(more, 0))
    area[40, 10] |= more > 0
    found = visibility.main_surface(np.where(area, np.float32(-3), FLOOR), CELL_M2)
    assert (~found[area]).all() == island
    assert found[~area].all()


def test_cells_are_connected_over_slopes_and_not_over_steps_or_holes():
    slope = np.asarray(0.9 * X, np.float32)
    assert visibility.main_surface(slope, CELL_M2).all()
    slope[:, 50] = np.nan
    assert (visibility.main_surface(slope, CELL_M2) == np.isfinite(slope)).all()
    slope[:, 8] = np.nan  # 8 x 80 cells are a surface of their own, 4 x 80 are not
    slope[:, 4] = np.nan
    assert not visibility.main_surface(slope, CELL_M2)[:, :4].any()


def patch(height, position_m):
    variance, systematic = (np.full(X.shape, value, np.float32) for value in (1e-4, 1e-6))
    pixel = np.zeros((*X.shape, 2), np.float32)
    return HeightPatch(0, 0, np.asarray(height, np.float32), variance, systematic, pixel, 0.002, np.array(position_m))


@pytest.mark.parametrize("measured_again", [True, False])
def test_a_mismatch_far_below_the_floor_does_not_enter_the_map(measured_again):
    """Where the floor was measured too, height and sigma are those without the mismatch; elsewhere there is a hole."""
    area, side = block(7, 9), (-0.9, -0.6, ALTITUDE_M)
    mapper = elevation.ElevationMapper(GRID)
    mapper.fuse(patch(FLOOR if measured_again else np.where(area, np.nan, FLOOR), (0, 0, ALTITUDE_M)))
    mapper.fuse(patch(np.where(area, -14.0, np.nan), side))
    found = mapper.result()
    if measured_again:
        np.testing.assert_array_equal(found.height_m, FLOOR)
        assert found.sigma_m.max() < 0.011
    else:
        assert np.isnan(found.height_m[area]).all()
        np.testing.assert_array_equal(found.height_m[~area], 0)


def test_a_pit_that_the_cameras_see_is_kept():
    """Views of a pit of 16 cm and 25 cm depth from above and from the sides, with exact depths by ray casting."""
    nodes = np.linspace(-1.5, 1.5, 301)
    x, y = np.meshgrid(nodes, nodes)
    depth_m, half_m = 0.25, 0.08
    floor = Seafloor(
        np.where(np.maximum(np.abs(x), np.abs(y)) < half_m, -depth_m, 0.0), 0.01, -1.5, -1.5, smooth_texture(0), 0.006
    )
    mapper, unchecked = elevation.ElevationMapper(GRID), elevation.ElevationMapper(GRID)
    for position in ((0.0, 0.0), (0.25, 0.1), (-0.25, -0.1), (0.1, -0.3)):
        pose = down_camera(*position, ALTITUDE_M)
        _, depth = render_view(floor, RIG, pose, samples=1)
        variance = np.full(depth.shape, 1e-6, np.float32)
        found = surface.rasterise(DepthMap(depth.astype(np.float32), variance), pose, np.zeros((6, 6)), RIG, GRID)
        np.testing.assert_array_equal(found.camera_m, pose[:3, 3])
        mapper.fuse(found)
        unchecked.fuse(found._replace(camera_m=None))
    heights = mapper.result().height_m
    np.testing.assert_array_equal(heights, unchecked.result().height_m)
    middle = (np.abs(X) < half_m - 0.04) & (np.abs(Y) < half_m - 0.04)
    np.testing.assert_allclose(heights[middle], -depth_m, atol=1e-3)
