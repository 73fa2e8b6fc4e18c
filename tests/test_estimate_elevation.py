"""Tests of the elevation map: rasterisation, fusion of height patches, uncertainty and photo mosaic."""

import numpy as np
import pytest
from seafloor_scene import Seafloor, down_camera, plane, render_view, small_rig, smooth_texture, stereo_pair

from twin.core import geometry
from twin.core.records import MapGrid
from twin.estimate.mapping import depth_filter, elevation, surface
from twin.estimate.mapping.depth_filter import DepthMap
from twin.estimate.mapping.map_builder import KeyframePath, build_map
from twin.estimate.mapping.surface import HeightPatch
from twin.estimate.vision import disparity
from twin.estimate.vision.light_pattern import MeanIllumination

RIG = small_rig(160, 120)
GRID = MapGrid(-2.0, 1.6, 0.02, 160, 200)
EXACT = np.zeros((6, 6))
X, Y = np.meshgrid(*GRID.centres())


def depth_of_plane(slope_x, slope_y, world_from_camera):
    u, v = np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px))
    rays = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones(u.shape)], -1)
    normal = np.array([-slope_x, -slope_y, 1.0])
    return (-normal @ world_from_camera[:3, 3] / (rays @ world_from_camera[:3, :3].T @ normal)).astype(np.float32)


def depth_map(depth, variance=1e-4):
    return DepthMap(np.asarray(depth, np.float32), np.full(np.shape(depth), variance, np.float32))


def on_grid(patch, layer):
    whole = np.full((GRID.rows, GRID.cols), np.nan)
    whole[patch.row : patch.row + layer.shape[0], patch.col : patch.col + layer.shape[1]] = layer
    return whole


@pytest.mark.parametrize("pose", [down_camera(0.1, -0.2, 2.0), down_camera(0, 0, 1.5, (0.1, -0.15, 2.0))])
def test_a_plane_is_rasterised_exactly_at_cell_centres(pose):
    patch = surface.rasterise(depth_map(depth_of_plane(0.5, -0.3, pose)), pose, EXACT, RIG, GRID)
    error = on_grid(patch, patch.height_m) - (0.5 * X - 0.3 * Y)
    assert np.isfinite(error).sum() > 2000
    assert np.nanmax(np.abs(error)) < 2e-6  # float32 depths of 2 m have steps of 2.4e-7 m


def test_the_surface_has_no_holes_and_ends_where_the_image_ends():
    pose = down_camera(0, 0, 2.0)
    patch = surface.rasterise(depth_map(np.full((120, 160), 2.0)), pose, EXACT, RIG, GRID)
    half_y, half_x = (np.array([160, 120]) - 1) / 2 / RIG.focal_px * 2.0  # the bow, image up, is at +x
    inside = (np.abs(X) < half_x) & (np.abs(Y) < half_y)
    assert (np.isfinite(on_grid(patch, patch.height_m)) == inside).all()


@pytest.mark.parametrize(("raised", "step_m"), [(np.s_[:, 80:], 0.4), (np.s_[:, 30:], 0.25), (np.s_[25:, :], 0.25)])
def test_no_surface_connects_the_two_sides_of_a_step(raised, step_m):
    """Also over the floor that the raised part occludes, where a connecting surface would face upwards."""
    depth = np.full((120, 160), 2.0, np.float32)
    depth[raised] -= step_m
    patch = surface.rasterise(depth_map(depth), down_camera(0, 0, 2.0), EXACT, RIG, GRID)
    known = patch.height_m[np.isfinite(patch.height_m)]
    assert np.minimum(np.abs(known), np.abs(known - step_m)).max() < 1e-6
    assert (known < 0.1).any() and (known > 0.1).any()


def test_variances_of_depth_and_pose_are_projected_to_height():
    """On a slope s along x, seen from above: dh = s dx for a lateral error, dh = dz for a vertical error."""
    pose, sigma_x, sigma_z = down_camera(0, 0, 2.0), 0.03, 0.02
    world = np.diag([0, 0, 0, sigma_x**2, 0, sigma_z**2])
    rotation = np.kron(np.eye(2), pose[:3, :3])
    patch = surface.rasterise(
        depth_map(depth_of_plane(0.5, 0, pose), 4e-4), pose, rotation.T @ world @ rotation, RIG, GRID
    )
    i, j = np.unravel_index(np.nanargmin(np.abs(on_grid(patch, patch.pixel[..., 0]) - RIG.cx_px)
                            + np.abs(on_grid(patch, patch.pixel[..., 1]) - RIG.cy_px)), X.shape)  # fmt: skip
    lateral = (surface.LATERAL_SIGMA_PX * 2.0 / RIG.focal_px) ** 2 * 0.25
    assert on_grid(patch, patch.systematic_m2)[i, j] == pytest.approx(
        0.25 * sigma_x**2 + sigma_z**2 + lateral, rel=0.02
    )
    assert on_grid(patch, patch.variance_m2)[i, j] == pytest.approx(4e-4, rel=0.02)


def test_information_enters_the_map_exactly_once():
    """A cell of a flat floor that n keyframes see has n times the information (inverse variance) of one."""
    mapper, n_views = elevation.ElevationMapper(GRID), np.zeros(X.shape)
    state = before = last = None
    for k in range(8):
        pose = down_camera(-0.6 + 0.13 * k, 0.011 * k, 2.0, (0, 0, 0.02 * k))
        fused, inherited = depth_map(np.full((120, 160), 2.0)), None
        if state is not None:
            fused, inherited = depth_filter.propagate(state, fused, geometry.inverse(pose) @ before, EXACT, RIG)
        patch = surface.rasterise(fused, pose, EXACT, RIG, GRID)
        n_views += np.isfinite(on_grid(patch, patch.height_m))
        if state is not None:
            mapper.fuse(last, patch, inherited)
        state, before, last = fused, pose, patch
    mapper.fuse(last)
    information = np.where(np.isfinite(mapper._variance[0]), 1e-4 / mapper._variance[0], 0)
    assert np.isinf(mapper._variance[1]).all()
    # interpolation shares information between cells at the border of a keyframe: 7 borders of 200 of 32,000 cells
    assert (np.abs(information - n_views) < 0.02 * n_views + 1e-6).mean() > 0.95
    assert information.sum() == pytest.approx(n_views.sum(), rel=0.01)


def test_the_variance_of_the_pose_does_not_decrease_by_fusion():
    cov = np.diag([0, 0, 0, 0, 0, 0.02**2])
    mapper, pose = elevation.ElevationMapper(GRID), down_camera(0, 0, 2.0)
    for _ in range(50):
        mapper.fuse(surface.rasterise(depth_map(np.full((120, 160), 2.0)), pose, cov, RIG, GRID))
    sigma = mapper.result().sigma_m
    assert np.nanmin(sigma) >= 0.02
    assert np.nanmax(sigma) < 0.0215  # the part of depth is 0.01 / sqrt(50)


def test_a_wrong_first_height_is_replaced_by_three_that_agree():
    mapper, pose = elevation.ElevationMapper(GRID), down_camera(0, 0, 2.0)
    for height in (0.3, 0.0, 0.001, -0.001):
        mapper.fuse(surface.rasterise(depth_map(np.full((120, 160), 2.0 - height)), pose, EXACT, RIG, GRID))
    result = mapper.result().height_m
    half = 0.8 * RIG.cx_px / RIG.focal_px
    assert np.abs(result[(np.abs(X) < 0.3) & (np.abs(Y) < half)]).max() < 1e-3


def fused_heights(*heights_and_variances):
    """Returns heights and sigmas after the fusion of level floors, each (height, variance) once."""
    mapper, pose = elevation.ElevationMapper(GRID), down_camera(0, 0, 2.0)
    for height, variance in heights_and_variances:
        measured = depth_map(np.full((120, 160), 2.0 - height), variance)
        mapper.fuse(surface.rasterise(measured, pose, EXACT, RIG, GRID))
    result = mapper.result()
    middle = (np.abs(X) < 0.3) & (np.abs(Y) < 0.3)
    return result.height_m[middle], result.sigma_m[middle]


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("higher_m2", "expected"), [(1e-4, 0.0), (4e-5, 0.0), (4e-6, 0.3)])
def test_the_lower_of_two_heights_is_chosen_unless_the_higher_is_much_more_certain(order, higher_m2, expected):
    height, sigma = fused_heights(*[(0.0, 1e-4), (0.3, higher_m2)][::order])
    np.testing.assert_allclose(height, expected, atol=1e-6)
    assert np.all(sigma > 0.1)  # a probability of 0.16 of an error of 0.3 m
    assert np.all(sigma < 0.12)


@pytest.mark.parametrize(("rows", "cols"), [(1, 80), (80, 2), (2, 40), (1, 1)])
def test_a_grid_of_one_or_two_rows_or_columns_is_mapped(rows, cols):
    grid = MapGrid(-0.01 * cols, 0.01 * rows, 0.02, rows, cols)
    mapper = elevation.ElevationMapper(grid)
    mapper.fuse(surface.rasterise(depth_map(np.full((120, 160), 1.7)), down_camera(0, 0, 2.0), EXACT, RIG, grid))
    height = mapper.result().height_m
    assert np.isfinite(height).sum() >= elevation.MIN_CELLS or rows * cols < elevation.MIN_CELLS
    np.testing.assert_allclose(height[np.isfinite(height)], 0.3, atol=1e-6)


def test_two_heights_that_agree_form_one_hypothesis():
    _, sigma = fused_heights((0.0, 1e-4), (0.001, 1e-4))
    np.testing.assert_allclose(sigma, 0.01 / np.sqrt(2), rtol=1e-3)


def level_map(low_m, area):
    """Returns heights around the centre of two views of a floor, level at 0; the second has `low_m` in an area."""
    mapper = elevation.ElevationMapper(GRID)
    for lowered in (np.zeros(X.shape, bool), area):
        height = np.where((np.abs(X) < 0.4) & (np.abs(Y) < 0.4), 0.0, np.nan).astype(np.float32)
        height[lowered] = low_m
        variance_m2, systematic_m2 = (np.full(X.shape, variance, np.float32) for variance in (1e-4, 1e-6))
        pixel = np.zeros((*X.shape, 2), np.float32)
        mapper.fuse(HeightPatch(0, 0, height, variance_m2, systematic_m2, pixel, 0.002))
    return mapper.result().height_m


def block(rows, cols):
    area = np.zeros(X.shape, bool)
    area[80 : 80 + rows, 100 : 100 + cols] = True
    return area


@pytest.mark.parametrize(("rows", "cols"), [(1, 1), (1, 2), (2, 1)])
def test_a_lower_height_that_the_neighbours_contradict_is_not_chosen(rows, cols):
    np.testing.assert_allclose(level_map(-0.3, block(rows, cols))[block(rows, cols)], 0.0, atol=1e-6)


@pytest.mark.parametrize(("rows", "cols"), [(2, 2), (2, 8), (8, 8)])
def test_the_lower_height_is_chosen_at_the_corners_and_sides_of_a_pit(rows, cols):
    area = block(rows, cols)
    found = level_map(-0.3, area)
    np.testing.assert_allclose(found[area], -0.3, atol=1e-6)
    np.testing.assert_allclose(found[~area & np.isfinite(found)], 0.0, atol=1e-6)


def map_with(height):
    """Returns the heights of a map of one patch with these heights [m], known to 1 mm."""
    mapper = elevation.ElevationMapper(GRID)
    variance_m2, systematic_m2 = (np.full(X.shape, variance, np.float32) for variance in (1e-6, 1e-8))
    pixel = np.zeros((*X.shape, 2), np.float32)
    mapper.fuse(HeightPatch(0, 0, height.astype(np.float32), variance_m2, systematic_m2, pixel, 0.002))
    return mapper.result().height_m


@pytest.mark.parametrize(("height_m", "kept"), [(-1.7, False), (1.7, False), (0.03, True)])
def test_a_cell_at_the_border_of_the_map_that_contradicts_all_its_neighbours_is_removed(height_m, kept):
    floor = np.where(X < 0, 0.0, np.nan)
    row, col = 80, int(np.argmax(X[0] >= 0))
    floor[row, col] = height_m
    found = map_with(floor)
    assert np.isfinite(found[row, col]) == kept
    np.testing.assert_array_equal(np.isfinite(np.delete(found[row], col)), X[0, np.arange(X.shape[1]) != col] < 0)


@pytest.mark.parametrize("n_cells", [1, 2, 3])
def test_mismatches_in_the_middle_of_the_map_do_not_excuse_themselves(n_cells):
    """The range of heights around a mismatch of 40 m would be part of its own sigma and of that of its neighbours."""
    floor = np.zeros(X.shape)
    floor[80, 80 : 80 + n_cells] = -40.0
    mapper = elevation.ElevationMapper(GRID)
    pixel = np.zeros((*X.shape, 2), np.float32)
    variance_m2, systematic_m2 = np.full(X.shape, 4.0, np.float32), np.zeros(X.shape, np.float32)
    variance_m2[floor == 0] = 1e-6
    mapper.fuse(HeightPatch(0, 0, floor.astype(np.float32), variance_m2, systematic_m2, pixel, GRID.cell_m))
    found = mapper.result()
    np.testing.assert_array_equal(np.isnan(found.height_m), floor < 0)
    assert np.nanmax(found.sigma_m) < 0.01


def test_a_rough_floor_with_slopes_of_45_degrees_has_no_holes():
    rough = np.random.default_rng(1).uniform(0, GRID.cell_m, X.shape)  # many times the reported errors
    assert np.isfinite(map_with(rough)).all()


def test_cells_on_both_sides_of_a_step_of_the_floor_are_kept():
    steps = np.where(X < 0, 0.0, 1.0) + np.where(Y < 0, 0.0, 0.5)
    np.testing.assert_allclose(map_with(steps), steps, atol=1e-6)


def test_sigma_of_cells_within_three_cells_of_a_step_includes_its_smoothing():
    mapper, step_m = elevation.ElevationMapper(GRID), 0.4
    patches = []
    for height, columns in ((step_m, np.s_[:80]), (0.0, np.s_[80:])):
        depth = np.full((120, 160), np.nan)
        depth[:, columns] = 2.0 - height
        patches.append(surface.rasterise(depth_map(depth, 1e-8), down_camera(0, 0, 2.0), EXACT, RIG, GRID))
        mapper.fuse(patches[-1])
    found, across_m = mapper.result(), np.abs(Y[:, 100])
    sigma, repeatability = found.sigma_m[:, 100], found.repeatability_m[:, 100]
    lateral_cells = np.mean([patch.lateral_m for patch in patches]) / GRID.cell_m
    near, away = across_m < 3 * GRID.cell_m, (across_m > 4 * GRID.cell_m) & (across_m < 0.3)
    # the heights 0, 0 and h of 3 x 3 cells have the RMS distance h / sqrt(18) from their plane
    np.testing.assert_allclose(sigma[near], 5 * lateral_cells * step_m / np.sqrt(18), rtol=1e-3)
    np.testing.assert_allclose(sigma[away], 1e-4, rtol=1e-2)
    # between two surveys, only the position of the step differs
    share, near = lateral_cells / 2, across_m < GRID.cell_m
    np.testing.assert_allclose(repeatability[near], np.hypot(np.sqrt(share), share) * step_m, rtol=1e-3)
    np.testing.assert_allclose(repeatability[away], 1e-4, rtol=1e-2)


def test_roughness_is_the_rms_distance_from_the_least_squares_plane():
    z = np.random.default_rng(3).normal(0, 0.1, (7, 8)) - 20
    z[0, 0] = np.nan
    y, x = np.mgrid[-1:2, -1:2]
    design = np.stack([np.ones(9), x.ravel(), y.ravel()], axis=1)
    found = elevation._roughness(z.astype(np.float32))
    assert found[1, 1] == 0  # a cell of the block is not known
    for row, col in ((2, 3), (5, 6), (3, 1)):
        block = z[row - 1 : row + 2, col - 1 : col + 2].ravel()
        rest = block - design @ np.linalg.lstsq(design, block, rcond=None)[0]
        assert found[row, col] == pytest.approx(np.sqrt(np.mean(rest**2)), rel=1e-4)


def test_the_gain_removes_the_pattern_of_a_lamp_on_the_vehicle():
    v, u = np.mgrid[:120, :160]
    lamp = np.exp(-((u - 80.0) ** 2 + (v - 60.0) ** 2) / 80**2)
    rgb = np.repeat((200 * lamp).astype(np.uint8)[..., None], 3, 2)
    illumination = MeanIllumination(RIG)
    for _ in range(5):
        illumination.add(rgb)
    flat = (rgb * illumination.gain())[10:-10, 10:-10]
    assert flat.std() / flat.mean() < 0.06 < 0.2 < rgb.std() / rgb.mean()


@pytest.fixture(scope="module")
def bumpy():
    rng = np.random.default_rng(7)
    y, x = np.mgrid[-3:3:0.02, -3:3:0.02]
    floor = Seafloor(0.08 * np.sin(3 * x) + 0.06 * np.cos(4 * y + x), 0.02, -3.0, -3.0, smooth_texture(1), 0.012)
    poses = np.stack([down_camera(-0.4 + 0.15 * k, 0.01 * k, 1.8, (0.01, 0.02 * k - 0.05, 0)) for k in range(6)])
    pairs = []
    for pose in poses:
        left, right, _ = stereo_pair(floor, RIG, pose, rng)
        pairs.append(tuple(np.repeat(gray[..., None], 3, 2) for gray in (left, right)))
    return floor, poses, build_map(iter(pairs), KeyframePath(poses, *np.zeros((2, 6, 6, 6))), RIG, GRID), pairs


def test_a_bumpy_floor_is_mapped_to_millimetres_with_a_consistent_sigma(bumpy):
    floor, _, elevation_map, _ = bumpy
    error = elevation_map.height_m - floor.height_at(X, Y)
    known = np.isfinite(error)
    assert known.sum() > 4000
    # one pair: Z^2/(f b) 0.06 px = 10 mm; up to six are fused, with motion depth
    assert np.percentile(np.abs(error[known]), 90) < 0.015
    assert 0.5 < np.sqrt(np.mean((error[known] / elevation_map.sigma_m[known]) ** 2)) < 1.6


def test_the_mosaic_shows_the_texture_of_known_cells(bumpy):
    floor, _, elevation_map, _ = bumpy
    above = render_view(floor, RIG, down_camera(0, 0, 1.8))[0]
    shown = elevation_map.mosaic[60:100, 80:120, 0]
    assert (elevation_map.mosaic[np.isnan(elevation_map.height_m)] == 0).mean() > 0.99
    assert abs(shown.mean() - above[50:70, 70:90].mean()) < 40 and shown.std() > 15


def test_the_map_is_reproducible_to_the_bit(bumpy):
    _, poses, elevation_map, pairs = bumpy
    again = build_map(iter(pairs), KeyframePath(poses, *np.zeros((2, 6, 6, 6))), RIG, GRID)
    assert again.height_m.tobytes() == elevation_map.height_m.tobytes()


def test_a_pair_without_texture_is_skipped(bumpy):
    _, poses, _, pairs = bumpy
    blank = (np.full((120, 160, 3), 90, np.uint8),) * 2
    elevation_map = build_map([pairs[0], blank, pairs[2]], KeyframePath(poses[:3], *np.zeros((2, 3, 6, 6))), RIG, GRID)
    assert np.isfinite(elevation_map.height_m).sum() > 2000


@pytest.mark.parametrize(("sigma_px", "known"), [(0.31, True), (0.33, False)])
def test_a_depth_with_a_relative_sigma_above_20_percent_does_not_enter_the_map(sigma_px, known):
    """Around the image centre, a disparity of 1.6 px (13 m) over a floor at 2 m; 20 % of it is 0.32 px."""
    px = np.full((120, 160), RIG.focal_px * RIG.baseline_m / 2.0, np.float32)
    sigma = np.full_like(px, 0.1)
    px[45:75, 65:95], sigma[45:75, 65:95] = 1.6, sigma_px
    view = np.full((120, 160, 3), 90, np.uint8), disparity.Disparity(px, sigma)
    elevation_map = build_map([view], KeyframePath(down_camera(0, 0, 2.0)[None], *np.zeros((2, 1, 6, 6))), RIG, GRID)
    assert bool((elevation_map.height_m < -10).any()) == known
    assert (np.abs(elevation_map.height_m) < 0.01).sum() > 2000


def test_without_keyframes_the_map_is_empty():
    elevation_map = build_map([], KeyframePath(np.zeros((0, 4, 4)), *np.zeros((2, 0, 6, 6))), RIG, GRID)
    assert (
        np.isnan(elevation_map.height_m).all()
        and np.isnan(elevation_map.sigma_m).all()
        and not elevation_map.mosaic.any()
    )
    assert plane().height_at(np.zeros(1), np.zeros(1)) == 0
