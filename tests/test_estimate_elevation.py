"""The composite map: exact on planes, no webs at edges, every piece of information once, shared errors kept."""

import numpy as np
import pytest
from seafloor_scene import Seafloor, down_camera, look, plane, small_rig, smooth_texture, stereo_pair

from twin.core import geometry
from twin.core.records import MapGrid
from twin.estimate.mapping import depth_filter, elevation, surface
from twin.estimate.mapping.depth_filter import DepthMap
from twin.estimate.mapping.map_builder import KeyframeImages, Light, build_map

RIG = small_rig(160, 120)
GRID = MapGrid(-2.0, 1.6, 0.02, 160, 200)
EXACT = np.zeros((6, 6))
X, Y = np.meshgrid(*GRID.centres())


def depth_of_plane(slope_x, slope_y, world_from_camera):
    u, v = np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px))
    rays = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones(u.shape)], -1)
    normal = np.array([-slope_x, -slope_y, 1.0])
    return (-normal @ world_from_camera[:3, 3] / (rays @ world_from_camera[:3, :3].T @ normal)).astype(np.float32)


def even(depth, variance=1e-4):
    return DepthMap(np.asarray(depth, np.float32), np.full(np.shape(depth), variance, np.float32))


def on_grid(patch, layer):
    whole = np.full((GRID.rows, GRID.cols), np.nan)
    whole[patch.row : patch.row + layer.shape[0], patch.col : patch.col + layer.shape[1]] = layer
    return whole


@pytest.mark.parametrize("pose", [down_camera(0.1, -0.2, 2.0), down_camera(0, 0, 1.5, (0.1, -0.15, 2.0))])
def test_a_plane_is_rasterised_exactly_at_cell_centres(pose):
    patch = surface.rasterise(even(depth_of_plane(0.5, -0.3, pose)), pose, EXACT, RIG, GRID)
    error = on_grid(patch, patch.height_m) - (0.5 * X - 0.3 * Y)
    assert np.isfinite(error).sum() > 2000
    assert np.nanmax(np.abs(error)) < 2e-6  # float32 depths of 2 m have steps of 2.4e-7 m


def test_the_surface_has_no_holes_and_ends_where_the_image_ends():
    pose = down_camera(0, 0, 2.0)
    patch = surface.rasterise(even(np.full((120, 160), 2.0)), pose, EXACT, RIG, GRID)
    half_y, half_x = (np.array([160, 120]) - 1) / 2 / RIG.focal_px * 2.0  # the bow, image up, is at +x
    inside = (np.abs(X) < half_x) & (np.abs(Y) < half_y)
    assert (np.isfinite(on_grid(patch, patch.height_m)) == inside).all()


@pytest.mark.parametrize(("raised", "step_m"), [(np.s_[:, 80:], 0.4), (np.s_[:, 30:], 0.25), (np.s_[25:, :], 0.25)])
def test_no_pixel_flies_at_a_step(raised, step_m):
    """Least of all over the floor that the raised part hides, where a web would face up."""
    depth = np.full((120, 160), 2.0, np.float32)
    depth[raised] -= step_m
    patch = surface.rasterise(even(depth), down_camera(0, 0, 2.0), EXACT, RIG, GRID)
    known = patch.height_m[np.isfinite(patch.height_m)]
    assert np.minimum(np.abs(known), np.abs(known - step_m)).max() < 1e-6
    assert (known < 0.1).any() and (known > 0.1).any()


def test_variance_of_depth_and_pose_become_variance_of_height():
    """On a slope s along x, seen from straight above: dh = s dx from the side, dh = dz from above."""
    pose, sigma_x, sigma_z = down_camera(0, 0, 2.0), 0.03, 0.02
    world = np.diag([0, 0, 0, sigma_x**2, 0, sigma_z**2])
    rotation = np.kron(np.eye(2), pose[:3, :3])
    patch = surface.rasterise(even(depth_of_plane(0.5, 0, pose), 4e-4), pose, rotation.T @ world @ rotation, RIG, GRID)
    i, j = np.unravel_index(np.nanargmin(np.abs(on_grid(patch, patch.pixel[..., 0]) - RIG.cx_px)
                            + np.abs(on_grid(patch, patch.pixel[..., 1]) - RIG.cy_px)), X.shape)  # fmt: skip
    lateral = (surface.LATERAL_PX * 2.0 / RIG.focal_px) ** 2 * 0.25
    assert on_grid(patch, patch.common_m2)[i, j] == pytest.approx(0.25 * sigma_x**2 + sigma_z**2 + lateral, rel=0.02)
    assert on_grid(patch, patch.variance_m2)[i, j] == pytest.approx(4e-4, rel=0.02)


def test_every_piece_of_information_enters_the_map_once():
    """Keyframes over a flat floor: a cell seen in n of them ends with n times the information of one."""
    mapper, seen = elevation.ElevationMapper(GRID), np.zeros(X.shape)
    state = before = last = None
    for k in range(8):
        pose = down_camera(-0.6 + 0.13 * k, 0.011 * k, 2.0, (0, 0, 0.02 * k))
        fused, taken = even(np.full((120, 160), 2.0)), None
        if state is not None:
            fused, taken = depth_filter.carry(state, fused, geometry.inverse(pose) @ before, EXACT, RIG)
        patch = surface.rasterise(fused, pose, EXACT, RIG, GRID)
        seen += np.isfinite(on_grid(patch, patch.height_m))
        if state is not None:
            mapper.retire(last, patch, taken)
        state, before, last = fused, pose, patch
    mapper.retire(last)
    information = np.where(np.isfinite(mapper._variance[0]), 1e-4 / mapper._variance[0], 0)
    assert np.isinf(mapper._variance[1]).all()
    # a cell on the rim of a keyframe gains or loses what interpolation shares: 7 rims of 200 of the 32,000 cells
    assert (np.abs(information - seen) < 0.02 * seen + 1e-6).mean() > 0.95
    assert information.sum() == pytest.approx(seen.sum(), rel=0.01)


def test_the_error_of_the_pose_never_averages_away():
    cov = np.diag([0, 0, 0, 0, 0, 0.02**2])
    mapper, pose = elevation.ElevationMapper(GRID), down_camera(0, 0, 2.0)
    for _ in range(50):
        mapper.retire(surface.rasterise(even(np.full((120, 160), 2.0)), pose, cov, RIG, GRID))
    sigma = mapper.result().sigma_m
    assert np.nanmin(sigma) >= 0.02
    assert np.nanmax(sigma) < 0.0215  # the depth's own part is down to 0.01 / sqrt(50)


def test_a_wrong_first_height_is_outvoted():
    mapper, pose = elevation.ElevationMapper(GRID), down_camera(0, 0, 2.0)
    for height in (0.3, 0.0, 0.001, -0.001):
        mapper.retire(surface.rasterise(even(np.full((120, 160), 2.0 - height)), pose, EXACT, RIG, GRID))
    result = mapper.result().height_m
    half = 0.8 * RIG.cx_px / RIG.focal_px
    assert np.abs(result[(np.abs(X) < 0.3) & (np.abs(Y) < half)]).max() < 1e-3


def retired(*heights_and_variances):
    """The map of level floors at these heights, each seen once with this variance, one after another."""
    mapper, pose = elevation.ElevationMapper(GRID), down_camera(0, 0, 2.0)
    for height, variance in heights_and_variances:
        seen = even(np.full((120, 160), 2.0 - height), variance)
        mapper.retire(surface.rasterise(seen, pose, EXACT, RIG, GRID))
    result = mapper.result()
    middle = (np.abs(X) < 0.3) & (np.abs(Y) < 0.3)
    return result.height_m[middle], result.sigma_m[middle]


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("of_higher", "expected"), [(1e-4, 0.0), (4e-5, 0.0), (4e-6, 0.3)])
def test_of_two_heights_the_lower_stands_unless_the_higher_is_far_better_known(order, of_higher, expected):
    height, sigma = retired(*[(0.0, 1e-4), (0.3, of_higher)][::order])
    np.testing.assert_allclose(height, expected, atol=1e-6)
    assert np.all(sigma > 0.1)  # a doubt of one in six about 0.3 m
    assert np.all(sigma < 0.12)


def test_where_two_heights_agree_there_is_no_doubt():
    _, sigma = retired((0.0, 1e-4), (0.001, 1e-4))
    np.testing.assert_allclose(sigma, 0.01 / np.sqrt(2), rtol=1e-3)


def test_cells_beside_a_step_may_be_those_of_the_other_side():
    mapper, step_m = elevation.ElevationMapper(GRID), 0.4
    patches = []
    for height, columns in ((step_m, np.s_[:80]), (0.0, np.s_[80:])):
        depth = np.full((120, 160), np.nan)
        depth[:, columns] = 2.0 - height
        patches.append(surface.rasterise(even(depth, 1e-8), down_camera(0, 0, 2.0), EXACT, RIG, GRID))
        mapper.retire(patches[-1])
    sigma, across_m = mapper.result().sigma_m[:, 100], np.abs(Y[:, 100])
    share = np.mean([patch.lateral_m for patch in patches]) / (2 * GRID.cell_m)
    beside, away = across_m < 0.02, (across_m > 0.06) & (across_m < 0.3)
    np.testing.assert_allclose(sigma[beside], np.hypot(np.sqrt(share), share) * step_m, rtol=1e-3)
    np.testing.assert_allclose(sigma[away], 1e-4, rtol=1e-2)


def test_the_mosaic_is_even_under_a_lamp_that_travels_along():
    v, u = np.mgrid[:120, :160]
    lamp = np.exp(-((u - 80.0) ** 2 + (v - 60.0) ** 2) / 80**2)
    rgb = np.repeat((200 * lamp).astype(np.uint8)[..., None], 3, 2)
    light = Light(RIG)
    for _ in range(5):
        light.see(rgb)
    flat = (rgb * light.gain())[10:-10, 10:-10]
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
        pairs.append(KeyframeImages(*(np.repeat(gray[..., None], 3, 2) for gray in (left, right))))
    return floor, poses, build_map(iter(pairs), poses, np.zeros((6, 6, 6)), RIG, GRID), pairs


def test_a_bumpy_floor_is_mapped_to_millimetres_and_the_map_knows(bumpy):
    floor, _, found, _ = bumpy
    error = found.height_m - floor.height_at(X, Y)
    known = np.isfinite(error)
    assert known.sum() > 4000
    # one pair: Z^2/(f b) 0.06 px = 10 mm; up to six fused, and motion
    assert np.percentile(np.abs(error[known]), 90) < 0.015
    assert 0.5 < np.sqrt(np.mean((error[known] / found.sigma_m[known]) ** 2)) < 1.6


def test_the_mosaic_shows_the_texture_where_the_map_is_known(bumpy):
    floor, _, found, _ = bumpy
    above = look(floor, RIG, down_camera(0, 0, 1.8))[0]
    seen = found.mosaic[60:100, 80:120, 0]
    assert (found.mosaic[np.isnan(found.height_m)] == 0).mean() > 0.99
    assert abs(seen.mean() - above[50:70, 70:90].mean()) < 40 and seen.std() > 15


def test_the_same_images_make_the_same_map(bumpy):
    _, poses, found, pairs = bumpy
    again = build_map(iter(pairs), poses, np.zeros((6, 6, 6)), RIG, GRID)
    assert again.height_m.tobytes() == found.height_m.tobytes()


def test_a_pair_without_texture_breaks_nothing(bumpy):
    _, poses, _, pairs = bumpy
    blank = KeyframeImages(*(np.full((120, 160, 3), 90, np.uint8),) * 2)
    found = build_map([pairs[0], blank, pairs[2]], poses[:3], np.zeros((3, 6, 6)), RIG, GRID)
    assert np.isfinite(found.height_m).sum() > 2000


def test_no_keyframe_makes_an_empty_map():
    found = build_map([], np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), RIG, GRID)
    assert np.isnan(found.height_m).all() and np.isnan(found.sigma_m).all() and not found.mosaic.any()
    assert plane().height_at(np.zeros(1), np.zeros(1)) == 0
