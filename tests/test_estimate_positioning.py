"""F2F, F2M, the network and the pose filter on ray-cast floors that share no code with the renderer.

The pipeline is tested without images, on scripted measurements.
"""

import functools
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import seafloor_scene as scene
from scipy.stats import chi2

from twin.core import geometry
from twin.core.links import Link, Links
from twin.core.records import ElevationMap, Frame, Readings, SensorNoise, StereoObservation
from twin.core.settings import EstimatorSettings
from twin.estimate import link_selection, stereo_vision
from twin.estimate.navigation.pose_filter import PoseFilter, fuse_pressure_ahrs
from twin.estimate.pipeline import Navigator
from twin.estimate.self_check import check_survey
from twin.estimate.trajectory import interpolate_between_keyframes
from twin.estimate.vision import matching, stereo
from twin.estimate.vision.f2f import FrameToFrame, constant_velocity_motion
from twin.estimate.vision.image_spool import ImageSpool
from twin.estimate.vision.mosaic import Mosaic, Registration
from twin.estimate.vision.pair_matching import PairMatcher
from twin.estimate.vision.stereo import Keyframe
from twin.estimate.vision.two_view_motion import Motion
from twin.judge.survey_quality import self_check_metrics

PATCH_PX = 11
MATCHING = EstimatorSettings(points=300, patch_px=PATCH_PX)
RIG = scene.small_rig(320, 240, 50.0, 0.3048)
ALTITUDE_M = 3.353


@functools.cache
def hills(seed=1):
    nodes = np.linspace(-8, 8, 161)
    x, y = np.meshgrid(nodes, nodes)
    height = 1.0 + 0.5 * np.sin(1.3 * x + 0.5) * np.cos(1.1 * y) + 0.2 * np.sin(2.9 * x) * np.sin(3.3 * y)
    return scene.Seafloor(height, 0.1, -8.0, -8.0, scene.smooth_texture(seed, 1024, 2.0), 0.008)


def colour(gray):
    return np.repeat(gray[..., None], 3, axis=2)


class Diver:
    """Renders stereo pairs over the hills and makes keyframes of them."""

    def __init__(self, folder, seed=0):
        self.floor, self.rng, self.spool = hills(), np.random.default_rng(seed), ImageSpool(folder)
        self.count = 0

    def frame(self, pose):
        """Returns the image and the depth of a camera at this pose."""
        image, depth = scene.render_view(self.floor, RIG, pose, samples=1)
        return colour(scene.digitise(image, self.rng, 2.0)), depth

    def keyframe(self, pose, believed=None):
        (left, depth), (right, _) = self.frame(pose), self.frame(pose @ RIG.left_from_right)
        pair = matching.gray(left), matching.gray(right)
        dense_px = (RIG.focal_px * RIG.baseline_m / depth).astype(np.float32)
        points = stereo.match_stereo_points(*pair, dense_px, RIG, MATCHING)
        self.spool.put(self.count, left, right, pair)
        key = Keyframe(self.count, self.count, 1, pose if believed is None else believed, points, Readings())
        self.count += 1
        return key, matching.normalise(pair[0]), depth


@pytest.fixture()
def diver(tmp_path):
    return Diver(tmp_path)


def over_flat_floor(number, x_m, y_m, depth_m=2.4):
    """Returns a keyframe over a flat floor whose points fill the image; no image is rendered."""
    columns, rows = np.meshgrid(np.arange(5, RIG.width_px, 10.0), np.arange(5, RIG.height_px, 10.0))
    rays = np.column_stack([RIG.normalised(np.column_stack([columns.ravel(), rows.ravel()])), np.ones(768)])
    xyz = rays * depth_m
    measured = np.column_stack([rays[:, :2], np.full(768, RIG.baseline_m / depth_m)])
    points = stereo.StereoPoints(
        np.zeros((768, 2), np.float32),
        np.zeros((768, 2)),
        measured[:, 2] * RIG.focal_px,
        measured,
        np.tile(np.eye(3) * 1e-8, (768, 1, 1)),
        xyz,
        np.zeros(768),
    )
    return Keyframe(number, number, 1, scene.down_camera(x_m, y_m, depth_m), points, Readings())


def along(first, xs, y_m):
    return [over_flat_floor(first + k, x, y_m) for k, x in enumerate(xs)]


def away(first):
    """Returns keyframes between two swaths, without overlap: earlier ones are not on the node's own swath."""
    return along(first, [9.0, 9.3, 9.6], 0.0)


def chosen_of(earlier, node, most, stride=1):
    settings = EstimatorSettings(min_overlap=0.45, max_links=most, patch_px=PATCH_PX, node_stride=stride)
    links = link_selection.choose_links(node, earlier, poses_of(earlier), RIG, settings)
    return [k.number for k, _ in links]


def poses_of(nodes):
    return np.array([k.world_from_camera for k in nodes])


def error_of(true, estimated):
    return geometry.log(geometry.inverse(true) @ estimated)


def test_the_same_left_image_again_is_no_motion_even_if_the_rows_of_the_right_image_are_off(diver):
    """A pitch of 0.05 deg between the cameras shifts the right image by 0.25 px; before, it appeared as 0.16 mrad."""
    key, image, _ = diver.keyframe(scene.down_camera(0, 0, ALTITUDE_M))
    left, right = diver.spool.gray(key.row)
    moved = 0.75 * right + 0.25 * np.roll(right, 1, axis=0)
    dense_px = np.full(left.shape, np.median(key.points.measured[:, 2]) * RIG.focal_px, np.float32)
    points = stereo.match_stereo_points(left, moved, dense_px, RIG, MATCHING)
    assert np.median(points.row_difference_px) == pytest.approx(0.25, abs=0.03)
    tracker = FrameToFrame(RIG, PATCH_PX)
    tracker.step(image)
    tracker.restart(image, points)
    motion, status = tracker.step(image)
    twist = geometry.log(motion.a_from_b)
    assert status == "ok"
    assert np.abs(twist[:3]).max() < 1e-5 and np.abs(twist[3:]).max() < 1e-5


def test_normalised_images_are_invariant_to_a_uniform_gain():
    view, _ = scene.render_view(hills(), RIG, scene.down_camera(0, 0, ALTITUDE_M))
    image = colour(scene.digitise(view, np.random.default_rng(0), 0))
    half = (image * 0.5).astype(np.uint8)
    difference = matching.normalise(matching.gray(image)).astype(float) - matching.normalise(matching.gray(half))
    assert np.median(np.abs(difference)) < 3  # of 36 grey levels of contrast; the rest is rounding of the darker image


def test_overlapping_patches_inflate_the_variance_of_the_mean():
    """The variance of their mean: 1 / n if none overlap, that of one if all are the same, closed form between."""
    row = np.column_stack([np.arange(6) * 11.0, np.zeros(6)])
    assert matching.variance_inflation(row, 11) == 1.0
    assert matching.variance_inflation(np.zeros((6, 2)), 11) == pytest.approx(6)
    diagonal = np.array([[0.0, 0.0], [2.75, 5.5]])
    assert matching.variance_inflation(diagonal, 11) == pytest.approx(1 + 0.75 * 0.5)


def test_stereo_points_are_unbiased_and_their_covariance_is_of_the_right_size(diver):
    key, _, depth = diver.keyframe(scene.down_camera(-1, 0, ALTITUDE_M))
    columns, rows = np.round(key.points.pixels).astype(int).T
    error_px = key.points.measured[:, 2] * RIG.focal_px - RIG.focal_px * RIG.baseline_m / depth[rows, columns]
    assert len(error_px) > 150
    assert abs(np.mean(error_px)) < 0.03
    sigma_px = np.sqrt(np.median(key.points.cov[:, 2, 2])) * RIG.focal_px
    # relief in the patch comes on top; the scatter of the row differences of 250 points is known to about 7 %
    assert 0.8 * sigma_px < np.std(error_px) < 4 * sigma_px


def test_stereo_errors_on_a_slope_agree_with_their_covariance():
    """The patch is matched under its plane; as a square, it has an error of 0.024 px here, 1.8 standard deviations."""
    rig, rng, pose = scene.small_rig(), np.random.default_rng(1), scene.down_camera(0, 0, 2.0, (0, 0, np.pi / 2))
    left, right, depth = scene.stereo_pair(scene.plane(0.5, 0.2), rig, pose, rng)
    true_px = (rig.focal_px * rig.baseline_m / depth).astype(np.float32)
    pair = (matching.gray(colour(image)) for image in (left, right))
    points = stereo.match_stereo_points(*pair, true_px, rig, MATCHING)
    columns, rows = points.pixels.astype(int).T
    error_px = points.measured[:, 2] * rig.focal_px - true_px[rows, columns]
    assert np.median(np.abs(error_px)) < 0.015
    # of 280 points: a standard error of 0.06 in the root mean square
    assert np.sqrt(np.mean((error_px / rig.focal_px) ** 2 / points.cov[:, 2, 2])) == pytest.approx(1, abs=0.25)


def test_frame_to_frame_drifts_by_millimetres_over_fifteen_frames(diver):
    pose = scene.down_camera(-1, 0, ALTITUDE_M)
    key, image, _ = diver.keyframe(pose)
    f2f = FrameToFrame(RIG, PATCH_PX)
    f2f.step(image)
    f2f.restart(image, key.points)
    estimated, true = pose, pose
    for _ in range(15):
        true = true @ geometry.exp(np.array([0.001, 0.002, -0.001, 0.001, -0.02, 0.0]))
        motion, status = f2f.step(matching.normalise(matching.gray(diver.frame(true)[0])))
        assert status == "ok"
        estimated = estimated @ motion.a_from_b
    assert np.linalg.norm(error_of(true, estimated)[3:]) < 0.01


def test_frame_to_frame_reports_an_image_without_texture(diver):
    key, image, _ = diver.keyframe(scene.down_camera(0, 0, ALTITUDE_M))
    f2f = FrameToFrame(RIG, PATCH_PX)
    f2f.step(image)
    f2f.restart(image, key.points)
    motion, status = f2f.step(np.full_like(image, 128))
    assert status == "too few points matched"
    assert np.sqrt(motion.cov[3, 3]) >= 0.01  # a covariance that admits it


def test_frame_to_frame_recovers_after_a_blank_frame(diver):
    pose, step = scene.down_camera(-1, 0, ALTITUDE_M), geometry.exp(np.array([0.001, 0.0, 0.0, 0.0, -0.02, 0.0]))
    key, image, _ = diver.keyframe(pose)
    f2f, estimated, seen = FrameToFrame(RIG, PATCH_PX), pose, []
    f2f.step(image)
    f2f.restart(image, key.points)
    for k in range(6):
        picture = diver.frame(pose @ np.linalg.matrix_power(step, k + 1))[0]
        motion, status = f2f.step(np.full_like(image, 128) if k == 3 else matching.normalise(matching.gray(picture)))
        seen.append(status)
        estimated = estimated @ motion.a_from_b
    assert seen == ["ok"] * 3 + ["too few points matched"] + ["ok"] * 2
    assert np.linalg.norm(error_of(pose @ np.linalg.matrix_power(step, 6), estimated)[3:]) < 0.01


def test_a_frame_that_jumps_is_lost_and_the_next_one_is_not(diver):
    """A jump of 6 cm and back between two frames at 30 Hz takes 100 m/s2, although its points match well."""
    pose, step = scene.down_camera(-1, 0, ALTITUDE_M), geometry.exp(np.array([0.0, 0, 0, 0, -0.005, 0]))
    key, image, _ = diver.keyframe(pose)
    f2f, seen, true = FrameToFrame(RIG, PATCH_PX), [], pose
    f2f.step(image)
    f2f.restart(image, key.points)
    for k in range(6):
        true = true @ step
        jumped = true @ geometry.exp(np.array([0, 0, 0, 0.06, 0, 0])) if k == 3 else true
        motion, status = f2f.step(matching.normalise(matching.gray(diver.frame(jumped)[0])))
        seen.append(status)
        assert np.linalg.norm(error_of(step, motion.a_from_b)[3:]) < 0.004
    assert seen == ["ok"] * 3 + ["motion contradicts the prediction"] + ["ok"] * 2


def test_frame_to_frame_continues_after_most_of_the_keyframe_has_left_the_image(diver):
    """Half an image away, and turned by a quarter of a radian."""
    pose, step = scene.down_camera(-1, 0, ALTITUDE_M), geometry.exp(np.array([0.0, 0.0, 0.006, 0.0, -0.03, 0.0]))
    key, image, _ = diver.keyframe(pose)
    f2f, estimated, true = FrameToFrame(RIG, PATCH_PX), pose, pose
    f2f.step(image)
    f2f.restart(image, key.points)
    for _ in range(40):
        true = true @ step
        motion, status = f2f.step(matching.normalise(matching.gray(diver.frame(true)[0])))
        assert status == "ok"
        estimated = estimated @ motion.a_from_b
    assert np.linalg.norm(error_of(true, estimated)[3:]) < 0.02


def test_frame_to_frame_predicts_over_uneven_intervals(diver):
    """A frame after 14 intervals is 28 px away, found from velocity times interval but not from the last motion."""
    pose, step = scene.down_camera(-1, 0, ALTITUDE_M), geometry.exp(np.array([0.0, 0, 0, 0, -0.02, 0]))
    keyframe, image, _ = diver.keyframe(pose)
    error_m = {}
    for ratio in (14.0, 1.0):
        f2f, true = FrameToFrame(RIG, PATCH_PX), pose
        f2f.step(image)
        f2f.restart(image, keyframe.points)
        for interval in (1, 1, 14):
            true = true @ np.linalg.matrix_power(step, interval)
            picture = matching.normalise(matching.gray(diver.frame(true)[0]))
            motion, _ = f2f.step(picture, (ratio if interval == 14 else 1.0) / RIG.frame_rate_hz)
        error_m[ratio] = np.linalg.norm(error_of(np.linalg.matrix_power(step, 14), motion.a_from_b)[3:])
    assert error_m[14.0] < 0.01 < 0.05 < error_m[1.0], error_m


def test_frame_to_frame_follows_a_swaying_camera_at_five_frames_a_second(diver):
    """Accelerations of 1.5 rad/s2 move the image up to 12 px away from where constant velocity predicts it."""
    pose, interval_s = scene.down_camera(0, 0, ALTITUDE_M), 0.2
    keyframe, image, _ = diver.keyframe(pose)
    f2f, estimated, true = FrameToFrame(RIG, PATCH_PX), pose, pose
    f2f.step(image)
    f2f.restart(image, keyframe.points)
    for k in range(1, 16):
        true = pose @ geometry.exp(np.array([0.0, 0.04 * np.sin(6.1 * interval_s * k), 0.0, 0.0, 0.0, 0.0]))
        motion, status = f2f.step(matching.normalise(matching.gray(diver.frame(true)[0])), interval_s)
        estimated = estimated @ motion.a_from_b
        assert status == "ok"
        assert np.linalg.norm(error_of(true, estimated)[3:]) < 0.01


def test_points_that_move_in_two_ways_are_no_motion(diver):
    """Both halves of the image are tracked well, but no rigid motion moves them 8 px apart."""
    keyframe, image, _ = diver.keyframe(scene.down_camera(0, 0, ALTITUDE_M))
    f2f = FrameToFrame(RIG, PATCH_PX)
    f2f.step(image)
    f2f.restart(image, keyframe.points)
    torn = image.copy()
    torn[:120], torn[120:] = np.roll(image[:120], 4, axis=1), np.roll(image[120:], -4, axis=1)
    assert f2f.step(torn)[1] == "too few points agree"


def test_registration_with_the_mosaic_is_unbiased_to_a_millimetre_in_six_degrees(diver):
    cell_m = ALTITUDE_M / RIG.focal_px
    mosaic = Mosaic(cell_m, diver.spool.folder / "mosaic")
    mosaic.cells.max_tiles = 4  # so few that tiles come back from the disk
    for k, x in enumerate(np.arange(-1.0, 0.3, 0.3)):
        pose = scene.down_camera(x, 0, ALTITUDE_M)
        left, depth = diver.frame(pose)
        mosaic.add(100 * k, matching.normalise(matching.gray(left)), depth.astype(np.float32), pose, RIG)
    errors = []
    for _ in range(10):
        rpy = tuple(diver.rng.normal(size=3) * 0.02)
        pose = scene.down_camera(0.3, diver.rng.uniform(-0.5, 0.5), ALTITUDE_M + diver.rng.uniform(-0.05, 0.05), rpy)
        left, depth = diver.frame(pose)
        predicted = pose @ geometry.exp(diver.rng.normal(size=6) * [0.003, 0.003, 0.003, 0.01, 0.01, 0.01])
        found = mosaic.register(matching.normalise(matching.gray(left)), depth.astype(np.float32), predicted, 1.9, RIG)
        assert found is not None
        assert found.reference_keyframe in range(0, 500, 100)  # never between two
        errors.append(error_of(pose, predicted @ found.correction.a_from_b))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 1e-3)
    assert np.all(np.std(errors, axis=0) < 1.5e-3)


def test_an_empty_mosaic_gives_no_position(diver, tmp_path):
    pose = scene.down_camera(0, 0, ALTITUDE_M)
    left, depth = diver.frame(pose)
    assert (
        Mosaic(0.01, tmp_path).register(
            matching.normalise(matching.gray(left)), depth.astype(np.float32), pose, 1.9, RIG
        )
        is None
    )


def test_depth_noise_does_not_bias_the_registration_with_the_mosaic(diver, tmp_path):
    """Least squares with the mosaic's own depth in its rows turn the camera by 9 mrad, always the same way."""
    errors, claims = [], []
    for k in range(12):
        poses = [scene.down_camera(0.2 * k - 1.2, y, ALTITUDE_M) for y in (0.0, 0.8)]
        (laid, truth), (left, seen) = (diver.frame(pose) for pose in poses)
        noisy = [1 / (1 / d + diver.rng.normal(0, 0.01, d.shape)) for d in (truth, seen)]
        mosaic = Mosaic(ALTITUDE_M / RIG.focal_px, tmp_path / str(k))
        mosaic.add(k, matching.normalise(matching.gray(laid)), noisy[0].astype(np.float32), poses[0], RIG)
        found = mosaic.register(
            matching.normalise(matching.gray(left)), noisy[1].astype(np.float32), poses[1], 1.9, RIG
        )
        assert found is not None
        errors.append(error_of(poses[1], poses[1] @ found.correction.a_from_b))
        claims.append(np.sqrt(np.diag(found.correction.cov)))
    mean, spread = np.mean(errors, axis=0), np.std(errors, axis=0)
    assert np.all(np.abs(mean) < 3 * spread / np.sqrt(len(errors)) + 5e-4)
    assert np.all(spread < 4 * np.median(claims, axis=0))


@pytest.mark.parametrize(
    "step", [[0, 0, 0, 0, -0.3, 0], [0.01, -0.02, 0.03, 0.3, -0.5, 0.03], [0, 0, 0.2, 0.5, 0.2, 0]]
)
def test_pair_motion_is_accurate_to_millimetres_from_a_start_one_centimetre_off(diver, step):
    pose = scene.down_camera(-1, 0, ALTITUDE_M)
    earlier, _, _ = diver.keyframe(pose)
    true = geometry.exp(np.array(step, float))
    start = diver.rng.normal(size=6) * [0.003, 0.003, 0.003, 0.01, 0.01, 0.01]
    node, _, _ = diver.keyframe(pose @ true, believed=pose @ true @ geometry.exp(start))
    matcher = PairMatcher(RIG, diver.spool, PATCH_PX)
    matched = matcher.match(node, [earlier])[0]
    found = matcher.motion(node, earlier, matched)
    assert found is not None
    assert np.linalg.norm(error_of(true, found.a_from_b)[3:]) < 6e-3
    assert np.linalg.norm(error_of(true, found.a_from_b)[:3]) < 3e-3
    link = link_selection.to_link(node, earlier, 0.8, found)
    assert link.closed_form is not None
    # within the same bounds, which the predicted pose (11 mm and 6 mrad off) is not
    assert np.linalg.norm(error_of(true, link.closed_form)[3:]) < 6e-3
    assert np.linalg.norm(error_of(true, link.closed_form)[:3]) < 3e-3
    assert not np.allclose(link.closed_form, link.i_from_j, atol=1e-6)


def test_overlap_uses_the_true_footprint_and_decreases_with_relief(diver):
    pose = scene.down_camera(-1, 0, ALTITUDE_M)
    node, _, _ = diver.keyframe(pose)
    same, beside, far = (over_flat_floor(k, -1, y, ALTITUDE_M) for k, y in enumerate((0, 0.6, 3.0)))
    shares = link_selection.overlaps(node, poses_of([same, beside, far]), RIG, PATCH_PX)
    flat = 1 - 0.6 / (ALTITUDE_M * RIG.width_px / RIG.focal_px)
    assert shares[0] == 1.0 and 0.4 < shares[1] < flat and shares[2] == 0.0


def test_links_join_neighbours_on_the_swath_and_on_the_next_one():
    first = along(0, np.arange(-1.5, 1.6, 0.3), 0.0)
    second = along(11, np.arange(1.5, 0.2, -0.3), 0.6)
    node, earlier = second[-1], first + second[:-1]
    chosen = set(chosen_of(earlier, node, 7))
    assert {second[-2].number, second[-3].number} <= chosen
    assert chosen & {k.number for k in first}
    assert len(chosen) <= 7


def test_the_farthest_overlapping_node_of_the_same_swath_is_linked():
    """Steps of a tenth of the image: the fifth before it still shares more than 0.45."""
    *earlier, node = along(0, 0.15 * np.arange(10), 0.0)
    assert chosen_of(earlier, node, 7) == [8, 7, 4]


def test_the_oldest_overlapping_node_is_linked_even_if_others_overlap_more():
    """It closes a loop to its start: the first leg is farther away than the second."""
    first, second = along(0, [0.0], 0.9), along(1, np.arange(-1.2, 1.21, 0.3), 0.4)
    earlier, node = first + second + away(10), over_flat_floor(13, 0.0, 0.0)
    shares = link_selection.overlaps(node, poses_of(earlier), RIG, PATCH_PX)
    assert sum(share > shares[0] for share in shares) >= 3 and shares[0] > 0.45
    assert 0 in chosen_of(earlier, node, 3)


@pytest.mark.parametrize("stride", [1, 3])
def test_links_to_another_swath_are_spread_along_it(stride):
    second = along(1, np.arange(-0.6, 0.61, 0.15), 0.4)  # nodes 1 to 9, node 5 straight abeam
    earlier, node = along(0, [0.1], 0.8) + second + away(10), over_flat_floor(13, 0.02, 0.0)
    for key in [*earlier, node]:
        key.number *= stride
    assert chosen_of(earlier, node, 4, stride) == [stride * k for k in [0, 5, 7, 3]]
    assert chosen_of(earlier, node, 8, stride) == [stride * k for k in [0, 5, 7, 3, 9, 1, 6, 4]]  # neighbours at last


def test_links_of_one_node_together_have_the_information_of_one_link():
    link = Link(0, 3, np.eye(4), np.eye(6) * 1e-6, 0.8, 200)
    links = link_selection.inflate_for_shared_noise([link, link._replace(i=1), link._replace(i=2)])
    together = np.linalg.inv(sum(np.linalg.inv(shared.cov) for shared in links))
    np.testing.assert_allclose(together, link.cov)
    for shared in links:
        np.testing.assert_allclose(shared.own_cov, link.cov)


def test_errors_that_recur_over_the_floor_are_counted_once_per_footprint():
    """Monte Carlo: a walk of links whose errors are sums over patches, each patch in view in m links of the walk.

    With a share s of floor errors that recur with correlation c in all m links, the variance of the end of a long walk
    is 1 + c s (m - 1) times that of independent errors. 4000 walks: standard error 2 %; the ends of a walk of 100 links
    see fewer patches, m^2 / 300 = 8 % of the growth at most.
    """
    rng, m, n, share, recurrence = np.random.default_rng(3), 5, 100, 0.6, link_selection.RECURRENCE
    patches = rng.normal(size=(4000, n + m - 1))  # the error of a link is the sum of the m patches in view
    recurring = np.stack([patches[:, k : k + m].sum(axis=1) for k in range(n)], axis=1) / m**0.5
    fresh = rng.normal(size=(4000, n))
    independent = 1 - recurrence * share
    walks = (recurrence * share) ** 0.5 * recurring.sum(axis=1) + independent**0.5 * fresh.sum(axis=1)
    link = Link(0, 3, np.eye(4), np.eye(6) * 1e-6, 1 - 1 / m, 200, floor_share=share)
    (inflated,) = link_selection.inflate_for_shared_noise([link])
    assert inflated.shared_by == pytest.approx(walks.var() / n, rel=0.08)
    np.testing.assert_allclose(inflated.own_cov, link.cov)


def test_the_floor_share_is_the_variance_that_image_noise_does_not_explain():
    def share(residual, n_points):
        return link_selection.floor_share(Motion(np.eye(4), np.eye(6), n_points, residual))

    assert share(2.0, 400) == pytest.approx(0.75)
    assert share(1.05, 400) == 0 and share(1.06, 400) > 0  # two standard errors of 400 residuals: 0.056
    assert share(1.2, 30) == 0 and share(0.9, 400) == 0


def test_noise_alone_has_a_floor_share_in_2_percent_of_the_links():
    """The limit is two standard errors of the median, exceeded with probability 2.3 % if it were normally distributed.

    Tolerance: 3 sigma of the fraction of 4000 links are 0.7 %; the median of 200 points is slightly skewed.
    """
    sizes = np.linalg.norm(np.random.default_rng(0).standard_normal((4000, 200, 3)), axis=2)
    residuals = np.median(sizes, axis=1) / np.sqrt(chi2.ppf(0.5, 3))
    shares = [link_selection.floor_share(Motion(np.eye(4), np.eye(6), 200, r)) for r in residuals]
    assert np.mean(np.array(shares) > 0) == pytest.approx(0.023, abs=0.009)


def test_links_from_a_place_where_the_vehicle_kept_station_have_a_finite_covariance():
    link = Link(0, 1, np.eye(4), np.eye(6) * 1e-6, 1.0, 200, floor_share=0.5)
    (inflated,) = link_selection.inflate_for_shared_noise([link])
    assert inflated.shared_by < 10


def test_pressure_corrects_height_only_weighted_by_its_noise():
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([1.0, 2.0, 3.0]))
    believed = PoseFilter(pose, RIG, SensorNoise(0.01, 0.003, 0.01))
    believed.cov = np.diag([1e-8] * 3 + [1e-4] * 3)
    after, _ = fuse_pressure_ahrs(pose, believed.cov, believed.aiding(0.1), 3.02, np.full(3, np.nan))
    np.testing.assert_allclose(after[:3, 3], [1.0, 2.0, 3.01], atol=1e-6)  # equal variances: half way


def test_a_correction_beyond_both_uncertainties_is_rejected():
    believed = PoseFilter(np.eye(4), RIG, SensorNoise(0.01, 0.003, 0.01))
    believed.cov = np.eye(6) * 1e-6
    measured, cov = geometry.exp(np.array([0, 0, 0, 0.5, 0, 0])), np.eye(6) * 1e-6
    assert believed.correct_pose(measured, cov, motion_cov=np.eye(6)) is None
    np.testing.assert_array_equal(believed.world_from_camera, np.eye(4))


def test_f2m_reduces_the_covariance_of_the_motion_since_the_mosaic_was_built_only():
    rng = np.random.default_rng(5)
    old, since, noise = (a @ a.T / 6 * 1e-6 for a in rng.standard_normal((3, 6, 6)))
    errors, claimed = [], np.zeros((6, 6))
    draws = (rng.multivariate_normal(np.zeros(6), c, 4000) for c in (old, since, noise))
    for before, added, read in zip(*draws, strict=True):
        believed = PoseFilter(geometry.exp(before + added), RIG, SensorNoise(0.01, 0.003, 0.01))
        believed.cov = old + since
        if believed.correct_pose(geometry.exp(before + read), noise, since) is not None:
            errors.append(geometry.log(believed.world_from_camera))
            claimed = believed.cov
    sizes = np.linalg.eigvals(np.linalg.solve(claimed, np.cov(np.transpose(errors))))
    assert np.all(np.abs(sizes - 1) < 0.15)


def test_f2m_without_prior_knowledge_is_a_kalman_update():
    rng = np.random.default_rng(6)
    prior, noise = (a @ a.T * 1e-6 for a in rng.standard_normal((2, 6, 6)))
    believed = PoseFilter(np.eye(4), RIG, SensorNoise(0.01, 0.003, 0.01))
    believed.cov = prior
    assert believed.correct_pose(np.eye(4), noise, motion_cov=prior * 9) is not None
    np.testing.assert_allclose(np.linalg.inv(believed.cov), np.linalg.inv(prior) + np.linalg.inv(noise), rtol=1e-6)


def test_interpolation_passes_through_the_keyframes_and_keeps_frame_to_frame_motion_between():
    rng = np.random.default_rng(0)
    steps, f2f = rng.normal(size=(31, 6)) * 0.01, [np.eye(4)]
    for step in steps[1:]:
        f2f.append(f2f[-1] @ geometry.exp(step))
    f2f, variances = np.array(f2f), rng.uniform(1e-8, 1e-6, (31, 6))
    rows = np.array([0, 10, 25])
    keys = np.array([f2f[r] @ geometry.exp(rng.normal(size=6) * 0.02) for r in rows])
    path = interpolate_between_keyframes(steps, variances, rows, keys)
    np.testing.assert_allclose(path[rows], keys, atol=1e-9)
    np.testing.assert_allclose(interpolate_between_keyframes(steps, variances, rows, f2f[rows]), f2f, atol=1e-9)
    np.testing.assert_allclose(geometry.inverse(path[25]) @ path[30], geometry.inverse(f2f[25]) @ f2f[30], atol=1e-9)


def test_the_misclosure_between_keyframes_is_the_least_squares_correction_of_the_steps():
    """No other corrections that close the chain have a smaller weighted sum of squares (1e-4 of it is second order)."""
    rng = np.random.default_rng(3)
    steps, variances = rng.normal(size=(6, 6)) * 0.2, rng.uniform(1e-7, 1e-5, (6, 6))
    chain = functools.reduce(np.matmul, [geometry.exp(step) for step in steps[1:]])
    keys = np.array([np.eye(4), chain @ geometry.exp(rng.normal(size=6) * 1e-3)])
    path = interpolate_between_keyframes(steps, variances, np.array([0, 5]), keys)

    def closed(corrections):
        motions = [geometry.exp(s) @ geometry.exp(e) for s, e in zip(steps[1:], corrections, strict=True)]
        return geometry.log(geometry.inverse(functools.reduce(np.matmul, motions)) @ keys[1])

    found = np.array([
        geometry.log(geometry.exp(-step) @ geometry.inverse(a) @ b)
        for step, a, b in zip(steps[1:], path[:-1], path[1:], strict=True)
    ])  # fmt: skip
    np.testing.assert_allclose(closed(found), 0, atol=1e-12)
    constraint = np.array([closed(found + d.reshape(5, 6)) for d in np.eye(30) * 1e-6]).T / 1e-6
    weighted, root = found / np.sqrt(variances[1:]), np.sqrt(variances[1:]).ravel()
    free = scipy.linalg.null_space(constraint * root)
    assert np.abs(free.T @ weighted.ravel()).max() < 3e-3 * np.linalg.norm(weighted)


LINK_COV = np.diag([0.002**2] * 3 + [0.01**2] * 3)


class Script:
    """Scripted measurements: motions between given poses, exact or noisy; every frame is a keyframe."""

    runs_in_background = True

    def __init__(self, poses, blind=(), correction=None, rng=None):
        self.poses, self.blind, self.correction, self.rng = poses, blind, correction, rng
        self.row, self.stereo_observations, self.discarded = -1, [], set()

    def track_frame(self, frame):
        self.row = frame.index
        last = self.poses[max(self.row - 1, 0)]
        return Motion(geometry.inverse(last) @ self.poses[self.row], np.eye(6) * 1e-4, 100, 1.0), "ok"

    def observe_stereo(self, frame, row):
        return over_flat_floor(row, 0.0, 0.0).points

    def tracking_cov(self):
        return None if self.row == 0 else np.eye(6) * (0.001 * self.row) ** 2

    def restart_tracking(self, velocity=None):
        pass

    def register_with_mosaic(self, world_from_camera):
        return None if self.correction is None else Registration(self.correction, 0)

    def add_to_mosaic(self, number, world_from_camera):
        pass

    def rebuild_mosaic(self, keys):
        pass

    def epipolar_error(self):
        return None

    def discard(self, numbers):
        self.discarded |= set(numbers)

    def measure_motions(self, node, others):
        assert self.discarded.isdisjoint(k.number for k in others)
        true = [geometry.inverse(self.poses[k.number]) @ self.poses[node.number] for k in others]
        if self.rng is not None:
            true = [t @ geometry.exp(e) for t, e in zip(true, self.rng.normal(0, 1e-3, (len(true), 6)), strict=True)]
        return [None if node.number in self.blind else Motion(t, LINK_COV, 200, 1.0) for t in true]


class Stumbling(Script):
    """F2F fails at one frame: its motion is wrong by 30 degrees and 0.1 m; then it finds the points of the keyframe."""

    def __init__(self, poses, lost):
        super().__init__(poses)
        self.lost, self.believed = lost, poses[0]

    def track_frame(self, frame):
        motion, status = super().track_frame(frame)
        before, self.believed = self.believed, self.poses[self.row]
        if self.row != self.lost:
            step = geometry.inverse(before) @ self.believed
            return motion._replace(a_from_b=step, cov=np.diag([1e-4**2] * 3 + [3e-4**2] * 3)), status
        self.believed = self.believed @ geometry.exp(np.array([0.0, 0.0, np.deg2rad(30), 0.1, 0.0, 0.0]))
        return constant_velocity_motion(geometry.inverse(before) @ self.believed), "too few points matched"

    def restart_tracking(self, velocity=None):
        self.believed = self.poses[self.row]

    def measure_motions(self, node, others):
        return [Motion(geometry.inverse(self.poses[k.row]) @ self.poses[node.row], LINK_COV, 200, 1.0) for k in others]


@pytest.mark.parametrize("lost", [4, 9, 10])  # between two keyframes, just before one, at one
def test_a_failed_step_between_keyframes_takes_the_misclosure(lost):
    poses = [scene.down_camera(0.01 * k, 0.0, 2.4) for k in range(21)]
    image = np.zeros((1, 1, 3), np.uint8)
    navigator = Navigator(RIG, EstimatorSettings(), poses[0], SensorNoise(), Stumbling(poses, lost))
    for k in range(len(poses)):
        navigator.update(Frame(k, k / 30, image, image, keyframe=k % 10 == 0))
    result = navigator.finish()
    online, final = (
        np.linalg.norm(path.positions - np.array(poses)[:, :3, 3], axis=1) for path in (result.online, result.final)
    )
    assert lost % 10 == 0 or online[lost] > 0.09
    assert np.delete(online, lost).max() < 1e-3
    assert np.delete(final, lost).max() < 1e-3
    assert final[lost] < 0.06  # half of the wrong step: the next one has the same variance


@pytest.mark.parametrize("autocorrelation", [0.3, 0.9])
def test_over_texture_that_repeats_the_final_path_is_the_online_one(autocorrelation):
    camera = Script(line(0.3 * np.arange(8)), rng=np.random.default_rng(2))
    camera.stereo_observations = [StereoObservation(k, 200, 0.5, repetition=autocorrelation) for k in range(8)]
    result = navigated(camera, [1] * 8).finish()
    apart_m = np.abs(result.final.positions - result.online.positions).max()
    assert apart_m == 0 if autocorrelation > 0.5 else apart_m > 1e-6


def navigated(camera, tracks, readings=None, **settings):
    """Returns a navigator that has processed the poses in these tracks (n,), each aligned at its end."""
    noise, image = SensorNoise(0.01, 0.003, 0.01), np.zeros((1, 1, 3), np.uint8)
    navigator = Navigator(RIG, EstimatorSettings(**settings), camera.poses[0], noise, camera)
    for k, track in enumerate(tracks):
        navigator.update(Frame(k, k / 30, image, image, readings or Readings(), keyframe=True), track)
        if k + 1 == len(tracks) or tracks[k + 1] != track:
            navigator.align_track(track)
    return navigator


def line(xs):
    return [scene.down_camera(x, 0.0, 2.4) for x in xs]


def test_a_late_loop_closure_is_linked_to_the_reference_position():
    poses = line([0, 0.3, 0.6, 0.9, 5.0, 5.3, 10.0, 10.3, 5.1, 5.4, 0.1])
    tracks = [1, 1, 1, 1, 2, 2, 3, 3, 4, 4, 5]
    links = navigated(Script(poses), tracks, window_tracks=1).finish().links
    assert 0 in {link.i for link in links if link.j == 10}
    assert 5 not in {link.i for link in links if link.j == 8}  # in view, but older than the window


def test_keyframes_outside_the_window_are_discarded():
    """All but the first four; `Script` asserts that no motion from them is measured."""
    camera, tracks = Script(line(np.zeros(24))), np.repeat(np.arange(1, 9), 3).tolist()
    navigated(camera, tracks, window_tracks=2)
    assert camera.discarded == set(range(4, 15))  # tracks 2 to 5 of 8, but keyframe 3


def test_when_a_link_is_measured_the_covariance_of_its_prediction_is_known():
    smallest = []

    class Watched(Script):
        def measure_motions(self, node, others):
            smallest.extend(np.linalg.eigvalsh(node.motion_cov(other))[0] for other in others)
            return super().measure_motions(node, others)

    result = navigated(Watched(line(0.3 * np.arange(8))), [1] * 4 + [2] * 4).finish()
    assert len(smallest) >= 7 and min(smallest) > 0
    assert 1 <= result.quality.independent_errors <= 7


def test_frame_to_frame_motion_bridges_a_failed_link():
    """Keyframe 3 cannot be matched: one link bridges it, and the F2F motion includes the DVL."""
    poses = line(0.3 * np.arange(6))
    forward = Readings(dvl_mps=np.array([9.0, 0.0, 0.0]))
    navigator = navigated(Script(poses, blind=[3]), [1] * 6, forward)
    result = navigator.finish()
    bridge = [link for link in result.links if link.j == 3]
    assert [(link.i, link.n_points) for link in bridge] == [(2, 0)]
    np.testing.assert_allclose(bridge[0].i_from_j, geometry.inverse(poses[2]) @ poses[3], atol=1e-9)
    np.testing.assert_allclose(result.final.world_from_camera, poses, atol=1e-6)
    missing = [node.dvl_displacement is None for node in navigator.network.nodes]
    assert missing == [True, False, False, True, False, False]
    assert result.quality.nodes_bridged == 1


class Isolated(Script):
    """No link of keyframe 3 can be measured; records the keyframes of the map."""

    def measure_motions(self, node, others):
        motions = super().measure_motions(node, others)
        return [None if 3 in (node.number, k.number) else m for k, m in zip(others, motions, strict=True)]

    def build_map(self, result, grid, step_cov, progress):
        self.mapped, self.steps = result.keyframe_rows.tolist(), step_cov
        shape = grid.rows, grid.cols
        return ElevationMap(grid, np.zeros(shape), np.zeros(shape), np.zeros((*shape, 3), np.uint8))


def test_a_keyframe_without_a_measured_link_is_not_in_the_map():
    camera = Isolated(line(0.1 * np.arange(6)))
    navigator = navigated(camera, [1] * 6)
    result = navigator.finish()
    assert result.unlinked.tolist() == [False, False, False, True, False, False]
    navigator.build_map(result)
    assert camera.mapped == [0, 1, 2, 4, 5]
    np.testing.assert_allclose(camera.steps[3], result.step_cov[3] + result.step_cov[4])
    assert "keyframes_unlinked" in {finding.check for finding in check_survey(result, RIG)}
    assert self_check_metrics(result)["keyframes_unlinked"] == 1
    sigma_m = np.sqrt(np.trace(result.node_cov[:, 3:, 3:], axis1=1, axis2=2))
    assert sigma_m[3] > max(sigma_m[2], sigma_m[4])  # it keeps its own covariance


def test_keyframes_that_follow_an_unlinked_node_are_unlinked_too_and_none_is_where_no_link_exists():
    camera = Isolated(line(0.1 * np.arange(9)))
    result = navigated(camera, [1] * 9, node_stride=3).finish()
    assert np.flatnonzero(result.unlinked).tolist() == [3, 4, 5]
    assert not replace(result, links=Links()).unlinked.any()


def test_the_quality_reports_the_uncertainty_of_frames_relative_to_their_keyframe():
    """Nodes are every other keyframe; the tracker claims k mm per axis just before keyframe k, 1 to 5."""
    result = navigated(Script(line(0.3 * np.arange(6))), [1] * 6, node_stride=2).finish()
    assert result.quality.frame_sigma_m == pytest.approx(np.percentile(np.sqrt(3) * 1e-3 * np.arange(1, 6), 90))


def test_only_the_newest_keyframe_keeps_its_points():
    assert all(key.points is None for key in navigated(Script(line(np.zeros(4))), [1] * 4).network.keyframes[:-1])


def test_after_alignment_the_online_covariance_is_that_of_the_last_node():
    turned = [
        pose @ geometry.exp(np.array([0.02, -0.05, 0.1, 0, 0, 0]) * k) for k, pose in enumerate(line(np.zeros(7)))
    ]
    chain_only = {"use_f2m": False, "max_links": 4}
    navigator = navigated(Script(turned[:6]), [1] * 6, **chain_only)
    aligned = navigator.finish().node_cov[-1]
    np.testing.assert_allclose(navigator.filter.cov, aligned, rtol=1e-4, atol=1e-12)
    navigator.vision.poses = turned
    navigator.update(Frame(6, 0.2, np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1, 3), np.uint8), keyframe=True), 2)
    carry = geometry.adjoint(geometry.inverse(turned[5]) @ turned[6])
    before = np.linalg.inv(carry) @ aligned @ np.linalg.inv(carry).T
    np.testing.assert_allclose(navigator.filter.cov, before + LINK_COV, rtol=1e-4, atol=1e-12)


def test_a_track_without_keyframes_does_not_repeat_the_correction_of_the_online_pose():
    """The current frame is the last keyframe, so the online pose is that of the keyframe after every alignment."""
    poses = [scene.down_camera(0.1 * (k % 3), 0.0, 2.4) for k in range(9)]
    navigator = navigated(Script(poses, rng=np.random.default_rng(2)), [1] * 9, use_f2m=False)
    last = navigator.network.keyframes[-1]
    assert np.abs(last.world_from_camera - navigator.log.online.array[-1]).max() > 1e-4
    np.testing.assert_allclose(navigator.filter.world_from_camera, last.world_from_camera, atol=1e-12)
    navigator.align_track(2)
    np.testing.assert_allclose(navigator.filter.world_from_camera, last.world_from_camera, atol=1e-12)


def test_resampling_error_of_the_mosaic_bounds_the_f2m_covariance():
    """0.5 mrad and 1 mm; the standard deviation of the chain is 2 mrad and 1 cm."""
    sure = Motion(np.eye(4), np.eye(6) * 1e-16, 4000, 1.0)
    covs = [navigated(Script(line(np.zeros(n)), correction=sure), [1] * n, use_ga=False).filter.cov for n in (1, 4)]
    sigma = np.sqrt(np.diag(covs[1] - covs[0]))
    np.testing.assert_allclose(sigma, [5e-4] * 3 + [1e-3] * 3, rtol=0.05)


def test_a_distant_mismatch_does_not_widen_the_mosaic_window(diver):
    node, _, _ = diver.keyframe(scene.down_camera(-1, 0, ALTITUDE_M))
    wild = node.points.xyz.copy()
    wild[0] *= 100
    window_m = stereo_vision.half_window_m(node.points._replace(xyz=wild), RIG)
    assert window_m == pytest.approx(stereo_vision.half_window_m(node.points, RIG), rel=0.05)
    assert window_m > ALTITUDE_M * RIG.width_px / RIG.focal_px / 2


@pytest.mark.parametrize("stride", [1, 2])
def test_nodes_older_than_the_window_are_fixed(stride):
    """Regression: they moved with fixed nodes, a little with every loop; the last alignment began 8 sigma off."""
    poses = [scene.down_camera(0.0, 0.1 * (k % 3), 2.4, (0.01 * k, 0.02, 0.1 * (k % 3))) for k in range(18)]
    camera = Script(poses, rng=np.random.default_rng(1))
    navigator = navigated(camera, [1 + k // 3 for k in range(18)], window_tracks=1, node_stride=stride)
    moved = np.abs(navigator.network.history.after_ga[-1] - navigator.network.history.before_ga[-1]).max(axis=1)
    assert np.all(moved[:12] < 1e-14)
    assert np.all(moved[13:] > 1e-9)


def test_rotations_stay_orthogonal_after_many_alignments():
    """Poses at the start are in every window: without orthogonalisation 34 alignments scale them by 1.003."""
    poses = [scene.down_camera(0.0, 0.1 * (k % 3), 2.4, (0.01 * k, 0.02, 0.1 * (k % 3))) for k in range(120)]
    navigator = navigated(Script(poses, rng=np.random.default_rng(1)), [1 + k // 3 for k in range(120)])
    for key in navigator.network.keyframes:
        rotation = key.world_from_camera[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
