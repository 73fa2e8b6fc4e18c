"""Orthomosaic: placement, seams, exposure, occlusion, restored colours, its file and its errors, on scenes with known
answers."""

import dataclasses
import tracemalloc
import weakref

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp

from twin import terrains
from twin.core import geometry
from twin.core.georeference import Georeference
from twin.core.ortho_tiles import OrthoTile, at_centres, finer_grid, mean_colours, window
from twin.core.records import ElevationMap, MapGrid, StereoRig
from twin.errors import TwinError
from twin.estimate.mapping import exposure_balance
from twin.estimate.mapping import orthomosaic as estimate
from twin.estimate.mapping.orthomosaic import Views, heights_of, ortho_grid
from twin.estimate.mapping.orthophoto import footprint
from twin.exchange.geotiff import OrthomosaicFile
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import illumination_of
from twin.imaging.light.optics import Optics
from twin.imaging.restoration import Restoration, estimated_floor, linear_signal
from twin.judge.orthomosaic_errors import OrthomosaicJudge, ciede2000, lab_of
from twin.report.run_folder import read_mosaic
from twin.scenario.model import LampConfig, MapConfig, Scenario, SensorConfig, WaterConfig
from twin.world.top_surface import true_albedo

RIG = StereoRig(160, 120, 140.0, 0.15)
GRID = MapGrid(-0.6, 0.5, 0.04, 25, 30)
DOWN = geometry.BODY_FROM_DOWN_CAMERA


def pattern(x, y):
    """Returns grey levels (..., 3) of a smooth, asymmetric texture without detail finer than 20 image pixels."""
    waves = np.sin(40 * x + 13 * y) + np.sin(9 * x - 31 * y) + np.sin(22 * x * y + 7 * x)
    return np.stack([120 + 25 * waves, 110 + 20 * waves, 90 + 10 * x], axis=-1)


def pose(x, y, z=1.0, turn=(0.0, 0.0, 0.0)):
    return geometry.pose(DOWN @ geometry.so3_exp(np.array(turn)), np.array([x, y, z]))


def image_of(world_from_camera, height_m=0.1, gain=1.0, texture=pattern):
    """Returns the exact image of a horizontal plane: a homography of the texture."""
    u, v = np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px))
    rays = np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, np.ones(u.shape)], -1)
    rays = rays @ world_from_camera[:3, :3].T
    at = world_from_camera[:3, 3] + rays * ((height_m - world_from_camera[2, 3]) / rays[..., 2:])
    return np.clip(gain * texture(at[..., 0], at[..., 1]) + 0.5, 0, 255).astype(np.uint8)


def flat(height_m=0.1, grid=GRID):
    height = np.full((grid.rows, grid.cols), height_m, np.float32)
    return ElevationMap(grid, height, np.full_like(height, 0.001), np.zeros((grid.rows, grid.cols, 3), np.uint8))


POSES = np.array([
    pose(-0.25, 0.05, 1.0, (0.05, -0.03, 0.4)), pose(0.0, 0.0, 1.05, (-0.04, 0.06, 0.0)),
    pose(0.25, -0.05, 0.95, (0.02, 0.05, -0.3)),
])  # fmt: skip


def views(images, poses=POSES, exposures=None):
    known = [None] * len(images) if exposures is None else exposures
    return Views(np.asarray(poses), np.full(len(images), 0.9), known, lambda k: images[k])


def made(seen, elevation, restore=None):
    """Returns the whole orthomosaic as one tile."""
    tiles = list(estimate.orthomosaic(seen, elevation, RIG, restore))
    assert len(tiles) == 1
    return tiles[0]


def expected(tile, texture=pattern):
    x, y = np.meshgrid(*tile.grid.centres())
    return texture(x, y)


@pytest.fixture(scope="module")
def plane():
    return made(views([image_of(p) for p in POSES], exposures=[(1, 1, 1)] * 3), flat())


def judged(tile, albedo, restored=False):
    judge = OrthomosaicJudge(restored)
    judge.add(tile, albedo.astype(np.float32), np.ones(tile.rgba.shape[:2], bool))
    return judge.metrics()


def test_the_pixels_divide_the_cells_and_have_the_ground_sample_distance_of_the_images():
    grid = ortho_grid(views([None] * 3), flat(), RIG)
    assert grid.cell_m <= 0.9 / 140 < grid.cell_m * 7 / 6 and (grid.west_m, grid.north_m) == (-0.6, 0.5)
    assert grid.rows * grid.cell_m == pytest.approx(25 * 0.04) and grid.cell_m == pytest.approx(0.04 / 7)
    assert finer_grid(GRID, 0.02).cell_m == 0.02 and finer_grid(GRID, 0.1) == GRID


def test_tilted_images_of_a_plane_are_placed_within_a_tenth_of_a_pixel(plane):
    """Images are exact homographies of the texture. A shift by a tenth of a pixel changes 4 grey levels at most."""
    true = expected(plane)
    inner = plane.known & (np.hypot(*np.meshgrid(*plane.grid.centres())) < 0.3)
    assert inner.sum() > 5000
    slope = np.gradient(true[..., 0])
    error = plane.rgba[..., 0][inner] - true[..., 0][inner]
    shift = np.linalg.lstsq(np.column_stack([part[inner] for part in slope]), -error, rcond=None)[0]
    assert np.abs(shift).max() < 0.1
    assert np.abs(error).max() < 3  # rounding twice, and cubic interpolation
    metrics = judged(plane, true)
    assert metrics["ce90_px"] < 0.1 and metrics["matched"] > 0.8  # this smooth texture repeats itself in some patches


def test_heights_move_the_colours_where_they_belong():
    """A map that is wrong by h displaces colours by h tan(n); the right map does not."""
    step = flat()
    step.height_m[:, 15:] = 0.25
    near = image_of(POSES[1], 0.1)
    right = made(views([near], POSES[1:2]), flat())
    wrong = made(views([near], POSES[1:2]), step)
    east = np.s_[:, 20 * 7 :, 0]
    use = right.known[:, 20 * 7 :] & wrong.known[:, 20 * 7 :]
    error = np.abs(expected(right)[east] - right.rgba[east])[use]
    assert error.max() < 3 < 10 < np.abs(expected(right)[east] - wrong.rgba[east])[use].max()


def test_every_pixel_shows_the_view_nearest_to_nadir_and_seams_are_blended():
    """Three grey images of different brightness: the nearest camera decides, except in a narrow seam."""
    tile = made(views([np.full((120, 160, 3), level, np.uint8) for level in (50, 100, 150)], exposures=[(1, 1, 1)] * 3),
                flat())  # fmt: skip
    x, y = np.meshgrid(*tile.grid.centres())
    tangents = np.array([np.hypot(x - p[0, 3], y - p[1, 3]) / (p[2, 3] - 0.1) for p in POSES])
    order = np.sort(tangents**2, axis=0)
    clear, seam = order[1] - order[0] > 0.06, order[1] - order[0] < 1e-3
    inside = tile.known & (np.abs(x) < 0.3) & (np.abs(y) < 0.15)
    nearest = np.array([50, 100, 150])[tangents.argmin(axis=0)]
    assert (clear & inside).sum() > 1000 and (seam & inside).sum() > 20
    np.testing.assert_array_equal(tile.rgba[..., 0][clear & inside], nearest[clear & inside])
    between = np.abs(tile.rgba[..., 0][seam & inside].astype(int) - [[75], [125]]).min(axis=0)
    assert between.max() <= 6


@pytest.mark.parametrize("reported", [True, False])
def test_an_exposure_step_between_images_disappears(reported):
    gains = [0.6, 1.0, 1.3]
    exposures = [(2 * g, 3 * g, g) for g in gains] if reported else None
    images = [image_of(p, gain=g) for p, g in zip(POSES, gains, strict=True)]
    balanced = made(views(images, exposures=exposures), flat())
    x, y = np.meshgrid(*balanced.grid.centres())
    inside = balanced.known & (np.abs(x) < 0.35) & (np.abs(y) < 0.2)
    ratio = (balanced.rgba[..., :3] / expected(balanced))[inside]
    # without the balance, the ratio would have the range of the gains, 0.6 to 1.3
    assert np.percentile(ratio, 98) / np.percentile(ratio, 2) < (1.04 if reported else 1.10)
    assert ratio.mean() == pytest.approx(np.prod(gains) ** (1 / 3), rel=0.05)


def test_exposures_cannot_be_estimated_without_patches_and_stay_equal():
    nothing = exposure_balance.PatchColours(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 2)))
    np.testing.assert_array_equal(exposure_balance.estimated_factors([nothing, nothing]), np.ones((2, 3)))
    assert exposure_balance.reported_factors([(1, 1, 1), None]) is None


def test_an_image_may_show_more_patches_than_opencv_can_resample_at_once():
    x = np.linspace(-0.2, 0.2, 40000)
    levels = np.linspace(50, 200, RIG.height_px).astype(np.uint8)
    image = np.tile(levels[:, None, None], (1, RIG.width_px, 3))
    colours = exposure_balance.patch_colours(image, pose(0, 0), RIG, np.column_stack([x, 0 * x, 0 * x]))
    assert len(colours.patch) == 40000  # cv2.remap refuses arrays of 32767 rows
    rows = RIG.cy_px - RIG.focal_px * x  # the top of the image is to the east
    np.testing.assert_allclose(np.exp(colours.log_colour[:, 1]), np.interp(rows, np.arange(120), levels), atol=1)


def test_floor_behind_a_block_is_not_shown_by_the_camera_that_cannot_see_it():
    """The nearest camera to nadir sees the block in front of the floor behind it; the other one sees that floor."""
    elevation = flat(0.0)
    elevation.height_m[:, 16:18] = 0.4
    west, east = pose(-0.05, 0.0), pose(0.55, 0.0)
    block, floor = np.full((120, 160, 3), 200, np.uint8), np.full((120, 160, 3), 50, np.uint8)
    tile = made(views([block, floor], [west, east], [(1, 1, 1)] * 2), elevation)
    x, y = np.meshgrid(*tile.grid.centres())
    # the ray from the western camera over the edge of the block (x = 0.10) meets the floor at x = 0.20
    hidden = (x > 0.14) & (x < 0.19) & (np.abs(y) < 0.2)
    assert (tile.rgba[..., 0][hidden] == 50).all()
    seen = (x > 0.21) & (x < 0.22) & (np.abs(y) < 0.2)
    assert (tile.rgba[..., 0][seen] > 150).all()  # the boundary of the nearest views is at x = 0.25


def test_saturated_pixels_are_taken_from_another_image():
    first, second = np.full((120, 160, 3), 100, np.uint8), np.full((120, 160, 3), 100, np.uint8)
    first[40:80, 60:100, 2] = 255
    tile = made(views([first, second], [pose(0, 0), pose(0.1, 0)], [(1, 1, 1)] * 2), flat())
    assert tile.rgba[tile.known][:, :3].max() <= 101
    alone = made(views([first], [pose(0, 0)], [(1, 1, 1)]), flat())
    assert alone.rgba[..., 2].max() == 255 and alone.known.sum() > 5000  # nothing else shows them


def test_alpha_is_zero_where_no_image_or_no_height_is_known():
    elevation = flat()
    elevation.height_m[5:17, 10:22] = np.nan  # too wide to be filled
    elevation.height_m[20, 5] = np.nan  # a small hole, which is filled
    tile = made(views([image_of(p) for p in POSES]), elevation)
    alpha = tile.rgba[..., 3]
    assert set(np.unique(alpha)) == {0, 255}
    assert not tile.known[8 * 7 : 14 * 7, 13 * 7 : 19 * 7].any() and tile.known[20 * 7 : 21 * 7, 5 * 7 : 6 * 7].all()
    assert not tile.rgba[~tile.known].any()
    one = made(views([image_of(POSES[1])], POSES[1:2]), elevation)
    assert one.known.any() and not one.known[0].any()  # outside the image


@pytest.mark.parametrize("camera_m", [0.9, 0.3])
@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (0.6, 0.0, 0.4), (-0.3, 0.5, -1.0)])
def test_all_floor_in_an_image_is_within_its_footprint(camera_m, tilt):
    """Points of the floor between -0.5 and 0.4 m: the footprint holds all that the image shows, and no margin."""
    camera, rng = pose(0.2, -0.1, camera_m, tilt), np.random.default_rng(5)
    points = rng.uniform([-4, -4, -0.5], [4, 4, min(0.4, camera_m)], (400_000, 3))
    # more points near the camera, where the image shows little floor
    points = np.concatenate([points, camera[:3, 3] + (points - camera[:3, 3]) * rng.uniform(0, 0.3, (len(points), 1))])
    points = points[(points[:, 2] > -0.5) & (points[:, 2] < 0.4)]
    in_camera = geometry.transform(geometry.inverse(camera), points)
    in_camera, points = in_camera[in_camera[:, 2] > 0], points[in_camera[:, 2] > 0]
    u, v = RIG.project(in_camera).T
    shown = points[(np.abs(u - 79.5) < 80) & (np.abs(v - 59.5) < 60)]
    west, south, east, north = footprint(camera, RIG, (-0.5, 0.4))
    low, high = shown.min(axis=0), shown.max(axis=0)
    assert len(shown) > 300 and (low[:2] >= [west, south]).all() and (high[:2] <= [east, north]).all()
    # the points are 0.2 m apart at most at the corners of the frustum
    assert (np.abs([west - low[0], south - low[1], east - high[0], north - high[1]]) < 0.3).all()


def test_a_low_place_elsewhere_takes_no_colour_from_a_tilted_image():
    """The image shows floor up to 0.2 m from the point below the camera; the lowest floor that it shows is farther."""
    camera, lower = pose(-0.55, 0.0, 1.0, (0.0, 0.75, 0.0)), flat()
    lower.height_m[0, -1] = -3.0
    image = image_of(camera)
    whole, found = (made(views([image], [camera]), elevation) for elevation in (flat(), lower))
    assert whole.known.sum() > 3000
    same = np.ones_like(whole.known)
    same[:14, -14:] = False  # the low place and its border
    np.testing.assert_array_equal(found.known[same], whole.known[same])


def test_tiles_join_without_a_trace(monkeypatch):
    images = [image_of(p) for p in POSES]
    whole = made(views(images), flat())
    monkeypatch.setattr("twin.core.ortho_tiles.TILE_PX", 64)
    tiles = list(estimate.orthomosaic(views(images), flat(), RIG))
    assert len(tiles) == 12 and {tile.row % 7 for tile in tiles} == {0}
    joined = np.zeros_like(whole.rgba)
    for tile in tiles:
        joined[tile.row : tile.row + len(tile.rgba), tile.col : tile.col + tile.rgba.shape[1]] = tile.rgba
    np.testing.assert_array_equal(joined, whole.rgba)


def test_heights_between_cells_are_interpolated_linearly():
    elevation = flat()
    x, y = np.meshgrid(*GRID.centres())
    elevation.height_m[:] = 0.3 * x - 0.2 * y
    part = window(finer_grid(GRID, 0.01), 12, 20, 40, 30)
    px, py = np.meshgrid(*part.centres())
    np.testing.assert_allclose(heights_of(elevation, part), 0.3 * px - 0.2 * py, atol=1e-6)


@pytest.mark.parametrize("origin", [None, Georeference(332000.0, 7375000.0, -12.0, "EPSG:32756", 1.0)])
def test_the_file_shows_an_asymmetric_scene_in_the_right_place(tmp_path, origin, plane):
    if origin is not None:
        origin = Georeference(332000.0, 7375000.0, -12.0, rasterio.crs.CRS.from_epsg(32756).to_wkt(), 1.0)
    with OrthomosaicFile(tmp_path / "mosaic.tif", plane.grid, origin) as file:
        half = plane.rgba.shape[1] // 2
        file.write(OrthoTile(plane.grid, 0, 0, plane.rgba[:, :half]))
        file.write(OrthoTile(plane.grid, 0, half, plane.rgba[:, half:]))
    with rasterio.open(tmp_path / "mosaic.tif") as file:
        assert file.count == 4 and file.colorinterp[3] == ColorInterp.alpha and file.dtypes == ("uint8",) * 4
        east, north = (0.0, 0.0) if origin is None else (332000.0, 7375000.0)
        assert file.crs.to_epsg() == (None if origin is None else 32756)
        for x, y in ((-0.21, 0.13), (0.17, -0.08), (0.05, 0.2)):
            at = next(file.sample([(east + x, north + y)]))
            assert at[3] == 255
            np.testing.assert_allclose(at[:3], pattern(x, y), atol=8)  # half a pixel from the centre, and rounding
    raster = read_mosaic(tmp_path / "mosaic.tif")
    assert raster.grid.west_m == pytest.approx(-0.6) and raster.grid.north_m == pytest.approx(0.5)
    np.testing.assert_array_equal(raster.values, plane.rgba[..., :3])


def test_an_interrupted_file_is_removed(tmp_path, plane):
    with pytest.raises(KeyboardInterrupt), OrthomosaicFile(tmp_path / "mosaic.tif", plane.grid):
        raise KeyboardInterrupt
    assert not (tmp_path / "mosaic.tif").exists()


def test_a_large_orthomosaic_is_read_reduced(tmp_path, plane, monkeypatch):
    with OrthomosaicFile(tmp_path / "mosaic.tif", plane.grid) as file:
        file.write(plane)
    monkeypatch.setattr("twin.exchange.geotiff.MAX_MOSAIC_PX", 5000)
    raster = read_mosaic(tmp_path / "mosaic.tif")
    assert raster.values.size <= 3 * 5000 and raster.grid.cell_m == pytest.approx(3 * plane.grid.cell_m)


def test_the_colour_of_a_cell_is_the_mean_of_its_known_pixels():
    rgba = np.zeros((2, 4, 4), np.uint8)
    rgba[0, 0], rgba[1, 1] = (10, 20, 30, 255), (20, 40, 50, 255)
    np.testing.assert_array_equal(mean_colours(OrthoTile(GRID, 0, 0, rgba), 2)[0], [[15, 30, 40], [0, 0, 0]])


# memory


def peak_bytes(work):
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_the_mean_colours_of_a_tile_take_less_memory_than_the_tile():
    rgba = np.random.default_rng(0).integers(0, 256, (1024, 1024, 4), np.uint8)
    assert peak_bytes(lambda: mean_colours(OrthoTile(GRID, 0, 0, rgba), 4)) < rgba.nbytes


def test_the_holes_of_a_terrain_are_found_at_the_pixels_of_a_tile_in_20_bytes_per_pixel():
    floor = terrains.Terrain(np.zeros((5, 7), np.float32), 2.0, -6.0, -4.0, np.zeros((9, 9, 3), np.uint8), 1.0)
    grid = MapGrid(-5.0, 5.0, 0.01, 1000, 1000)
    assert peak_bytes(lambda: at_centres(floor.in_hole, grid)) < 20 * 1000 * 1000


def test_cells_are_tested_in_parts_as_all_at_once():
    grid = MapGrid(-1.0, 2.0, 0.01, 150, 7)
    x, y = np.meshgrid(*grid.centres())
    np.testing.assert_array_equal(at_centres(lambda x, y: x > y, grid), x > y)


def test_the_sums_of_a_tile_are_released_before_it_is_written(monkeypatch):
    held = []

    def empty_layers(*arguments, made=estimate.empty_layers):
        layers = made(*arguments)
        held.append(weakref.ref(layers.colour))
        return layers

    monkeypatch.setattr(estimate, "empty_layers", empty_layers)
    tiles = estimate.orthomosaic(views([image_of(p) for p in POSES]), flat(), RIG)
    assert next(tiles).known.any() and held[0]() is None


# restoration


def lit_scene(jerlov="II", tone_curve=None, altitude_m=1.5):
    """Returns a scenario with two lamps, and its believed rig."""
    lamps = tuple(LampConfig(position_m=(0.2, y, 0.0), intensity_cd=800.0) for y in (-0.3, 0.3))
    sensor = None if tone_curve is None else SensorConfig(tone_curve=tone_curve)
    scenario = Scenario(lamps=lamps, water=WaterConfig(jerlov=jerlov), sensor=sensor, map=MapConfig(restore=True))
    return scenario.model_copy(update={"plan": scenario.plan.model_copy(update={"altitude_m": altitude_m})})


@pytest.mark.parametrize("jerlov", ["clear", "IB", "II"])
def test_the_restored_colour_of_a_card_is_its_albedo(jerlov):
    """Grey, red and blue cards on the floor, in an image without noise; CIEDE2000 below 1 is not visible."""
    scenario, rig = lit_scene(jerlov), lit_scene(jerlov).believed_rig()
    illumination = illumination_of(scenario)
    albedo = np.full((rig.height_px, rig.width_px, 3), 110, np.uint8)
    albedo[80:160, 60:140], albedo[80:160, 180:260] = (160, 60, 40), (40, 70, 150)
    depth = np.full(albedo.shape[:2], 1.5, np.float32)
    light = Optics(rig, illumination, scenario.lamps).radiance(albedo, depth, 0)
    gain = 0.7 / float(light.max())
    image = np.clip(255 * gain * light + 0.5, 0, 255).astype(np.uint8)
    camera = pose(0.0, 0.0, 1.5)
    grid = MapGrid(-1.5, 1.5, 0.05, 60, 60)
    restored = Restoration(scenario, illumination, rig, flat(0.0, grid))(image, (gain,) * 3, camera)
    difference = ciede2000(lab_of(restored / 255), lab_of(albedo / 255.0))
    inner = np.s_[90:150, 70:250]
    assert np.median(difference[inner]) < 1.0 and np.percentile(difference[inner], 90) < 3.0
    uncorrected = ciede2000(lab_of(image / 255.0), lab_of(albedo / 255.0))
    assert np.median(uncorrected[inner]) > (1 if jerlov == "clear" else 5)


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_albedo_in_the_shadow_of_the_sun_is_restored(turn):
    """The sun is in the west of a wall along y; a quarter of the light reaches the shadow. -1: the map is turned."""
    sun = {"illuminance_lx": 900.0, "elevation_deg": 30.0, "azimuth_deg": 180.0, "sky_share": 0.25}
    sections = {"water": {"jerlov": "clear"}, "sun": sun, "imaging": {"shadows": True}, "lamps": []}
    scenario = Scenario.model_validate(sections)
    rig, illumination = scenario.believed_rig(), illumination_of(scenario)
    elevation, camera = flat(0.0, MapGrid(-1.5, 1.5, 0.05, 60, 60)), pose(0.0, 0.0, 1.5)
    elevation.height_m[:, 30] = 0.2
    formation = ImageFormation(scenario, illumination, estimated_floor(elevation), np.random.default_rng(0), rig)
    albedo, shape = 128, (rig.height_px, rig.width_px)
    depth = np.full(shape, 1.5, np.float32)
    light = formation.radiance(RenderedView(np.full((*shape, 3), albedo, np.uint8), depth, 0, StampedPose(camera, 0.0)))
    gain = 0.9 / float(light.max())
    image = np.clip(255 * gain * light + 0.5, 0, 255).astype(np.uint8)
    turned = np.diag([turn, turn, 1.0, 1.0])
    height = np.ascontiguousarray(elevation.height_m[:: int(turn), :: int(turn)])
    believed = dataclasses.replace(elevation, height_m=height, map_from_world=turned)
    restored = Restoration(scenario, illumination, rig, believed)(image, (gain,) * 3, turned @ camera)
    x = (rig.cy_px - np.arange(rig.height_px)) / rig.focal_px * 1.5  # the top of the image is to the east
    dark = (x > 0.1) & (x < 0.17)  # the wall is at x = 0.025 m and its shadow ends at 0.19 m
    assert dark.sum() > 5 and image[dark, 100].max() < 0.3 * image[x < -0.1, 100].min()
    # levels of 57 (a quarter of 230) are rounded by half a level, 1 %
    np.testing.assert_allclose(restored[dark, 100], albedo, rtol=0.02)
    np.testing.assert_allclose(restored[x < -0.1, 100], albedo, rtol=0.02)


def test_a_tone_curve_is_inverted():
    for curve in ("srgb", "log"):
        signal = linear_signal(lit_scene(tone_curve=curve))
        assert signal[0] == 0 and signal[255] == pytest.approx(1) and (np.diff(signal) > 0).all() and signal[128] < 0.4


def test_restoration_needs_the_exposure():
    scenario = lit_scene()
    rig = scenario.believed_rig()
    restore = Restoration(scenario, illumination_of(scenario), rig, flat())
    with pytest.raises(TwinError, match="exposure"):
        restore(np.zeros((rig.height_px, rig.width_px, 3), np.uint8), None, pose(0, 0))


# errors


@pytest.mark.parametrize(("first", "second", "difference"), [
    # pairs 1, 7, 9, 13, 17 and 25 of table 1 of Sharma, Wu & Dalal (2005)
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
    ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0009), 7.1792),
    ((50.0, -0.001, 2.49), (50.0, 0.0009, -2.49), 4.8045),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
])  # fmt: skip
def test_ciede2000_agrees_with_published_pairs(first, second, difference):
    assert ciede2000(np.array(first), np.array(second)) == pytest.approx(difference, abs=1e-4)
    assert ciede2000(np.array(second), np.array(first)) == pytest.approx(difference, abs=1e-4)


def test_white_has_lightness_100_and_mid_grey_50():
    np.testing.assert_allclose(lab_of(np.ones(3)), [100, 0, 0], atol=1e-6)
    np.testing.assert_allclose(lab_of(np.full(3, 0.18418)), [50, 0, 0], atol=0.01)


def noise_tile(shift=(0, 0), blur_px=0.0, factor=1.0):
    """Returns a tile of random texture, displaced by (right, down) pixels, and its true albedo."""
    import cv2

    rng = np.random.default_rng(3)
    true = cv2.GaussianBlur(rng.uniform(0, 255, (260, 260)).astype(np.float32), (0, 0), 0.8)
    shown = true if not blur_px else cv2.GaussianBlur(true, (0, 0), blur_px)
    moved = cv2.warpAffine(shown, np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float64), (260, 260),
                           flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)  # fmt: skip
    rgba = np.dstack([np.clip(factor * moved, 0, 255)] * 3 + [np.full(true.shape, 255)]).astype(np.uint8)
    return OrthoTile(MapGrid(0, 0, 0.01, 260, 260), 0, 0, rgba), np.dstack([true] * 3)


def test_a_displaced_orthomosaic_has_this_error_and_bias():
    metrics = judged(*noise_tile((2.4, -1.3)))
    assert metrics["ce90_px"] == pytest.approx(np.hypot(2.4, 1.3), abs=0.15) and metrics["matched"] == 1
    assert metrics["bias_east_m"] == pytest.approx(0.024, abs=1e-3)
    assert metrics["bias_north_m"] == pytest.approx(0.013, abs=1e-3)
    assert metrics["ce90_m"] == pytest.approx(metrics["ce90_px"] * 0.01)
    assert metrics["colour_difference_median"] is None and metrics["coverage_area"] == 1


@pytest.mark.parametrize("blur_px", [0.7, 1.2, 2.0])
def test_the_edge_width_is_that_of_the_blur(blur_px):
    metrics = judged(*noise_tile(blur_px=blur_px, factor=0.8))
    assert metrics["edge_width_m"] == pytest.approx(0.01 * 2.563 * blur_px, rel=0.12)


def test_a_colour_error_is_measured_only_after_restoration():
    tile, true = noise_tile(factor=0.9)
    whole = ciede2000(lab_of(tile.rgba[..., :3] / 255.0), lab_of(true / 255))
    measured = judged(tile, true, restored=True)["colour_difference_median"]
    assert measured == pytest.approx(np.median(whole), abs=0.1) and measured > 1


def test_unrelated_pictures_are_not_matched_and_an_empty_one_has_no_errors():
    tile, true = noise_tile()
    metrics = judged(tile, np.ascontiguousarray(true[::-1]))
    assert metrics["matched"] < 0.05
    assert set(OrthomosaicJudge(True).metrics().values()) == {None}


def test_the_true_albedo_of_a_grid_with_more_columns_than_opencv_can_resample():
    texture = np.zeros((4, 5000, 3), np.uint8)
    texture[:, ::2] = 200
    floor = terrains.Terrain(np.zeros((2, 2501), np.float32), 0.02, -25.0, -0.01, texture, 0.01)
    albedo = true_albedo(floor, MapGrid(-25.0, 0.01, 0.00125, 2, 40_000))
    assert albedo.shape == (2, 40_000, 3) and np.isfinite(albedo).all()
    stripes = albedo[1, :, 0].reshape(5000, 8)[1:-1]  # bilinear within each texel: symmetric about its centre
    np.testing.assert_allclose(stripes, stripes[:, ::-1], atol=1)
    np.testing.assert_allclose(stripes.mean(axis=1), np.resize([50, 150], 4998), atol=1)


def test_a_hole_of_the_map_gets_the_height_of_the_nearest_cell():
    height = np.full((30, 400), np.nan, np.float32)
    height[:, :100], height[:, 300:] = 1.0, 2.0  # the hole is 200 cells wide
    grid = MapGrid(0.0, 3.0, 0.1, 30, 400)
    floor = estimated_floor(ElevationMap(grid, height, np.zeros_like(height), np.zeros((30, 400, 3), np.uint8)))
    assert (floor.height_m[:, :200] == 1.0).all() and (floor.height_m[:, 200:] == 2.0).all()


def test_the_true_albedo_is_the_mean_of_the_texture_in_each_pixel():
    texture = np.zeros((40, 60, 3), np.uint8)
    texture[:20, :30] = (200, 100, 50)  # north-west quarter
    texture[0::2, 30:] = 100  # stripes of one texel
    floor = terrains.Terrain(np.zeros((5, 7), np.float32), 0.1, -0.3, -0.2, texture, 0.01)
    grid = MapGrid(-0.4, 0.2, 0.02, 20, 40)
    albedo = true_albedo(floor, grid)
    np.testing.assert_allclose(albedo[3, 10], (200, 100, 50), atol=0.1)
    np.testing.assert_allclose(albedo[5, 30], 50, atol=1)  # mean of a stripe and the gap
    assert np.isnan(albedo[:, :5]).all() and np.isnan(albedo[:, 35:]).all() and np.isfinite(albedo[:, 5:35]).all()
    assert not albedo[15, 10].any()
