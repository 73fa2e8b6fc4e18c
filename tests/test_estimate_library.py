"""The estimators as a library: any view direction, principal point and pixel shape, uneven times, own keyframes."""

import cv2
import numpy as np
import pytest
import seafloor_scene as scene

from twin.core import geometry
from twin.errors import TwinError
from twin.estimate import EstimatorSettings, Frame, MapGrid, Navigator, Readings, SensorNoise, StereoRig
from twin.estimate.mapping import depth_filter, surface
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision.mosaic import viewing_plane

pytestmark = pytest.mark.long

RENDERED = scene.small_rig(400, 300, 55.0, 0.15)
CROP, ROW_SCALE = (slice(0, 280), slice(20, 360)), 0.9
#: The same images cropped off centre, with rows resampled: fx / fy = 1 / 0.9.
RIG = StereoRig(
    width_px=340,
    height_px=252,
    focal_px=RENDERED.focal_px,
    baseline_m=0.15,
    frame_rate_hz=15.0,
    focal_y_px=RENDERED.focal_px * ROW_SCALE,
    principal_point_px=(RENDERED.cx_px - 20, (RENDERED.cy_px + 0.5) * ROW_SCALE - 0.5),
)
SIDEWAYS = geometry.pose(geometry.rotation_from_rpy(0.3, 1.4, 0.5), np.array([5.0, -2.0, 1.0]))


def hills():
    nodes = np.linspace(-4, 4, 81)
    x, y = np.meshgrid(nodes, nodes)
    height = 0.15 * np.sin(2.1 * x + 0.4) * np.cos(1.7 * y)
    return scene.Seafloor(height, 0.1, -4.0, -4.0, scene.smooth_texture(3, 1024, 1.5), 0.006)


def image(floor, pose, rng):
    """Returns the RGB image of one camera of `RIG`."""
    gray = scene.digitise(scene.render_view(floor, RENDERED, pose, samples=1)[0], rng, 1.5)[CROP]
    matrix = np.array([[1, 0, 0], [0, ROW_SCALE, 0.5 * ROW_SCALE - 0.5]])
    gray = cv2.warpAffine(gray, matrix, (RIG.width_px, RIG.height_px), borderMode=cv2.BORDER_REPLICATE)
    return np.repeat(gray[..., None], 3, axis=2)


@pytest.fixture(scope="module")
def recorded():
    """Frames over 0.9 m of path at uneven times, all of them stereo pairs, and their true poses in the scene."""
    floor, rng = hills(), np.random.default_rng(4)
    times_s = np.cumsum(rng.choice([1, 2, 3], 40)) / 15
    times_s -= times_s[0]
    poses = [
        scene.down_camera(0.18 * t - 0.4, 0.03 * np.sin(t), 1.8, (0.02 * np.sin(t), 0.03 * np.cos(t) - 0.03, 0.0))
        for t in times_s
    ]
    shift = RENDERED.left_from_right
    frames = [
        Frame(k, float(t), image(floor, pose, rng), image(floor, pose @ shift, rng))
        for k, (t, pose) in enumerate(zip(times_s, poses, strict=True))
    ]
    return floor, frames, np.array(poses)


def navigate(frames, start, **settings):
    with Navigator(RIG, EstimatorSettings(**settings), start=start) as navigator:
        estimates = [navigator.update(frame) for frame in frames]
        result = navigator.finish()
        return estimates, result, navigator.build_map(result)


@pytest.fixture(scope="module")
def flown(recorded):
    return navigate(recorded[1], recorded[2][0])


def test_the_path_is_accurate_with_any_principal_point_pixel_shape_and_times(recorded, flown):
    estimates, result, _ = flown
    assert {estimate.status for estimate in estimates} == {"ok"}
    error_m = np.linalg.norm(result.final.positions - recorded[2][:, :3, 3], axis=1)
    assert error_m.max() < 0.003


def test_velocities_use_the_true_intervals_between_frames(recorded, flown):
    """Speed 0.18 m/s along x; divided by the nominal interval it would be up to three times as large."""
    speed_mps = [np.linalg.norm(estimate.camera_velocity[3:]) for estimate in flown[0][2:]]
    assert np.median(speed_mps) == pytest.approx(0.185, abs=0.02)
    assert max(speed_mps) < 0.3


def test_keyframes_are_chosen_by_overlap(recorded, flown):
    """Overlap 0.9 of a footprint of 1.65 m along the path: a keyframe at least every 0.17 m, more where it rolls."""
    positions = flown[1].final.positions[flown[1].keyframe_rows]
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert 4 <= len(positions) <= 12
    assert steps_m.min() > 0.06 and steps_m.max() < 0.2
    fewer = navigate(recorded[1], recorded[2][0], keyframe_overlap=0.7)[1]
    assert len(fewer.keyframe_rows) < len(positions)


def test_rare_pairs_become_keyframes_before_the_overlap_is_lost(recorded):
    """A pair every 0.1 m: two steps, 0.2 m, leave less overlap than 0.9 (0.17 m), so no pair may be passed over."""
    pairs = range(0, 40, 4)
    frames = [Frame(f.index, f.time_s, f.left, f.right if f.index in pairs else None) for f in recorded[1]]
    rows = navigate(frames, recorded[2][0])[1].keyframe_rows
    steps_m = np.linalg.norm(np.diff(recorded[2][rows, :3, 3], axis=0), axis=1)
    assert rows.tolist()[1:] == [row for row in pairs if row > 0 and row >= rows[1]]
    assert steps_m.max() < 0.17


def test_the_caller_may_choose_the_keyframes(recorded):
    frames = [Frame(f.index, f.time_s, f.left, f.right, keyframe=f.index in (0, 20)) for f in recorded[1][:25]]
    assert navigate(frames, recorded[2][0])[1].keyframe_rows.tolist() == [0, 20]


def test_the_map_covers_the_view_and_is_accurate(recorded, flown):
    floor, elevation = recorded[0], flown[2]
    x, y = np.meshgrid(*elevation.grid.centres())
    known = np.isfinite(elevation.height_m)
    error_m = np.abs(elevation.height_m - floor.height_at(x, y))[known]
    assert known.mean() > 0.75
    assert np.percentile(error_m, 90) < 0.008
    np.testing.assert_array_equal(elevation.map_from_world, np.eye(4))


def test_a_rig_that_looks_sideways_gives_the_same_path_and_map(recorded, flown, monkeypatch):
    """The same images with a start in a world turned by 80 degrees; F2M registers as well as from above."""
    corrections = []
    register = StereoVision.register_with_mosaic

    def counted(self, world_from_camera):
        corrections.append(register(self, world_from_camera))
        return corrections[-1]

    monkeypatch.setattr(StereoVision, "register_with_mosaic", counted)
    _, result, elevation = navigate(recorded[1], SIDEWAYS @ recorded[2][0])
    assert sum(found is not None for found in corrections) >= len(corrections) - 1 > 2
    moved = geometry.transform(SIDEWAYS, flown[1].final.positions)
    assert np.linalg.norm(result.final.positions - moved, axis=1).max() < 0.002
    assert np.abs(elevation.map_from_world - np.eye(4)).max() > 0.5
    x, y = np.meshgrid(*elevation.grid.centres())
    known = np.isfinite(elevation.height_m)
    points = np.column_stack([x[known], y[known], elevation.height_m[known]])
    there = geometry.transform(geometry.inverse(elevation.map_from_world @ SIDEWAYS), points)
    error_m = np.abs(there[:, 2] - recorded[0].height_at(there[:, 0], there[:, 1]))
    assert known.mean() > 0.5 and np.percentile(error_m, 90) < 0.01


def test_cropped_depth_maps_with_their_principal_point_give_the_crop_of_the_result():
    """Propagation to the next keyframe, pose variance and rasterisation see the rays, not the image centre."""
    full, (top, left) = scene.small_rig(120, 100, 50.0, 0.15), (12, 23)
    rows, cols = slice(top, top + 70), slice(left, left + 80)
    cropped = StereoRig(80, 70, full.focal_px, 0.15, principal_point_px=(full.cx_px - left, full.cy_px - top))
    _, depth = scene.render_view(hills(), full, scene.down_camera(0, 0, 1.6))
    whole = depth_filter.DepthMap(depth.astype(np.float32), np.full(depth.shape, 1e-4, np.float32))
    step, cov = geometry.exp(np.array([0.03, -0.02, 0.3, 0.02, 0.01, 0.03])), np.eye(6) * 1e-6
    part = depth_filter.DepthMap(whole.depth_m[rows, cols].copy(), whole.variance_m2[rows, cols].copy())
    ends = [depth_filter.propagate(one, one, step, cov, rig)[0] for one, rig in ((whole, full), (part, cropped))]
    inner = np.s_[25:45, 30:50]
    for a, b in zip(ends[0], ends[1], strict=True):
        np.testing.assert_allclose(b[inner], a[rows, cols][inner], rtol=1e-5)
    variances = [
        depth_filter._pose_variance(
            (15 / one.depth_m).astype(np.float32), step, cov, (rig.focal_px, rig.cx_px, rig.cy_px), 20.0
        )
        for one, rig in ((whole, full), (part, cropped))
    ]
    np.testing.assert_allclose(variances[1][inner], variances[0][rows, cols][inner], rtol=1e-5)
    grid = MapGrid(-1.0, 1.0, 0.02, 100, 100)
    pose = scene.down_camera(0, 0, 1.6)
    heights = [np.full((100, 100), np.nan, np.float32) for _ in range(2)]
    for height, one, rig in zip(heights, (whole, part), (full, cropped), strict=True):
        patch = surface.rasterise(one, pose, cov, rig, grid)
        size = patch.height_m.shape
        height[patch.row : patch.row + size[0], patch.col : patch.col + size[1]] = patch.height_m
    both = np.isfinite(heights[0]) & np.isfinite(heights[1])
    assert both.sum() > 1000
    np.testing.assert_allclose(heights[1][both], heights[0][both], atol=1e-5)


@pytest.mark.parametrize("axis", [[0, 0, -1.0], [0.5, 0, -1], [1, 0, 0], [0.3, -0.9, 0.2], [0, 0, 1]])
def test_the_viewing_plane_is_a_rotation_in_which_the_camera_looks_down(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    side = np.cross(axis, [0.1, 0.7, 0.2])
    side /= np.linalg.norm(side)
    camera = geometry.pose(np.column_stack([side, np.cross(axis, side), axis]), np.array([1.0, 2, 3]))
    plane = viewing_plane(camera)
    np.testing.assert_allclose(plane[:3, :3] @ plane[:3, :3].T, np.eye(3), atol=1e-12)
    assert (plane @ camera)[2, 2] < -0.7
    assert np.array_equal(plane, np.eye(4)) == (axis[2] < -np.cos(np.deg2rad(45)))


def test_readings_and_missing_right_images_are_accepted(recorded):
    noise = SensorNoise(pressure_m=0.002)
    frames = [
        Frame(f.index, f.time_s, f.left, f.right if f.index % 5 == 0 else None, Readings(pressure_z_m=1.8))
        for f in recorded[1]
    ]
    with Navigator(RIG, start=recorded[2][0], readings_noise=noise) as navigator:
        for frame in frames:
            navigator.update(frame)
        result = navigator.finish()
    assert set(result.keyframe_rows.tolist()) <= set(range(0, 40, 5))
    assert np.abs(result.final.positions[:, 2] - 1.8).max() < 0.002


def test_a_frame_that_is_not_later_than_the_last_is_an_error(recorded):
    with Navigator(RIG, start=recorded[2][0]) as navigator:
        navigator.update(recorded[1][0])
        with pytest.raises(ValueError, match=r"time_s: 0.0 s is not later than the last frame, at 0.0 s"):
            navigator.update(recorded[1][0])
        navigator.update(recorded[1][1])
        assert len(navigator.log) == 2


def test_a_navigator_without_frames_has_an_empty_result():
    with Navigator(RIG) as navigator:
        result = navigator.finish()
        assert len(result.final) == 0 and navigator.build_map(result) is None


@pytest.mark.parametrize(("name", "value"), [("patch_px", 3), ("min_overlap", 1.0), ("keyframe_overlap", 0.0)])
def test_settings_out_of_range_are_rejected(name, value):
    with pytest.raises(TwinError, match=f"estimate.{name}: {value} is out of range"):
        EstimatorSettings(**{name: value})
