"""Claims on F2F, F2M, the network and the pose filter, on ray-cast floors that share no code with the renderer."""

import numpy as np
import pytest
import seafloor_scene as scene

from twin import geometry
from twin.estimate import matching, network, stereo
from twin.estimate.f2f import FrameToFrame
from twin.estimate.key_points import ImageSpool, KeyPoint
from twin.estimate.mosaic import Mosaic
from twin.estimate.pose_filter import PoseFilter
from twin.estimate.trajectory import interpolate_between_keys
from twin.records import Link, Readings, SensorNoise

PATCH_PX = 11
RIG = scene.small_rig(320, 240, 50.0, 0.3048)
ALTITUDE_M = 3.353


def hills(seed=1):
    nodes = np.linspace(-8, 8, 161)
    x, y = np.meshgrid(nodes, nodes)
    height = 1.0 + 0.5 * np.sin(1.3 * x + 0.5) * np.cos(1.1 * y) + 0.2 * np.sin(2.9 * x) * np.sin(3.3 * y)
    return scene.Seafloor(height, 0.1, -8.0, -8.0, scene.smooth_texture(seed, 1024, 2.0), 0.008)


def colour(gray):
    return np.repeat(gray[..., None], 3, axis=2)


class Diver:
    """Takes stereo pairs over the hills and makes key points of them."""

    def __init__(self, folder, seed=0):
        self.floor, self.rng, self.spool = hills(), np.random.default_rng(seed), ImageSpool(folder)
        self.count = 0

    def frame(self, pose):
        (left, depth), (right, _) = (
            scene.look(self.floor, RIG, p, samples=1) for p in (pose, pose @ RIG.left_from_right)
        )
        return *(colour(scene.digitise(image, self.rng, 2.0)) for image in (left, right)), depth

    def key_point(self, pose, believed=None):
        left, right, depth = self.frame(pose)
        pair = matching.normalise(left), matching.normalise(right)
        dense_px = (RIG.focal_px * RIG.baseline_m / depth).astype(np.float32)
        points = stereo.points_of_pair(*pair, dense_px, RIG, 300, PATCH_PX)
        self.spool.put(self.count, left, right, pair)
        key = KeyPoint(self.count, self.count, 1, pose if believed is None else believed, points, Readings())
        self.count += 1
        return key, pair[0], depth


@pytest.fixture()
def diver(tmp_path):
    return Diver(tmp_path)


def error_of(true, estimated):
    return geometry.log(geometry.inverse(true) @ estimated)


def test_normalised_images_do_not_depend_on_an_even_lamp_gain():
    image = colour(
        scene.digitise(scene.look(hills(), RIG, scene.down_camera(0, 0, ALTITUDE_M))[0], np.random.default_rng(0), 0)
    )
    half = (image * 0.5).astype(np.uint8)
    difference = matching.normalise(image).astype(float) - matching.normalise(half)
    assert np.median(np.abs(difference)) < 3  # of 36 grey levels of contrast; the rest is rounding of the darker image


def test_stereo_points_are_unbiased_and_their_noise_is_told(diver):
    key, _, depth = diver.key_point(scene.down_camera(-1, 0, ALTITUDE_M))
    columns, rows = np.round(key.points.pixels).astype(int).T
    error_px = key.points.measured[:, 2] * RIG.focal_px - RIG.focal_px * RIG.baseline_m / depth[rows, columns]
    assert len(error_px) > 150
    assert abs(np.mean(error_px)) < 0.03
    sigma_px = np.sqrt(np.median(key.points.cov[:, 2, 2])) * RIG.focal_px
    assert sigma_px < np.std(error_px) < 4 * sigma_px  # relief in the patch comes on top


def test_frame_to_frame_drifts_by_millimetres_over_fifteen_frames(diver):
    pose = scene.down_camera(-1, 0, ALTITUDE_M)
    key, image, _ = diver.key_point(pose)
    f2f = FrameToFrame(RIG, PATCH_PX)
    f2f.step(image)
    f2f.restart(image, key.points)
    estimated, true = pose, pose
    for _ in range(15):
        true = true @ geometry.exp(np.array([0.001, 0.002, -0.001, 0.001, -0.02, 0.0]))
        motion, status = f2f.step(matching.normalise(diver.frame(true)[0]))
        assert status == "ok"
        estimated = estimated @ motion.a_from_b
    assert np.linalg.norm(error_of(true, estimated)[3:]) < 0.01


def test_frame_to_frame_says_so_when_it_sees_nothing(diver):
    key, image, _ = diver.key_point(scene.down_camera(0, 0, ALTITUDE_M))
    f2f = FrameToFrame(RIG, PATCH_PX)
    f2f.step(image)
    f2f.restart(image, key.points)
    motion, status = f2f.step(np.full_like(image, 128))
    assert status == "too few points matched"
    assert np.sqrt(motion.cov[3, 3]) >= 0.01  # a covariance that admits it


def test_registration_with_the_mosaic_is_unbiased_to_a_millimetre_in_six_degrees(diver):
    cell_m = ALTITUDE_M / RIG.focal_px
    mosaic = Mosaic(cell_m, diver.spool.folder / "mosaic")
    mosaic.cells.most_tiles = 4  # so few that tiles come back from the disk
    for x in np.arange(-1.0, 0.3, 0.3):
        pose = scene.down_camera(x, 0, ALTITUDE_M)
        _, image, depth = diver.key_point(pose)
        mosaic.add(image, depth.astype(np.float32), pose, RIG)
    errors = []
    for _ in range(10):
        rpy = tuple(diver.rng.normal(size=3) * 0.02)
        pose = scene.down_camera(0.3, diver.rng.uniform(-0.5, 0.5), ALTITUDE_M + diver.rng.uniform(-0.05, 0.05), rpy)
        image = matching.normalise(diver.frame(pose)[0])
        predicted = pose @ geometry.exp(diver.rng.normal(size=6) * [0.003, 0.003, 0.003, 0.01, 0.01, 0.01])
        correction = mosaic.register(image, predicted, 1.9, RIG)
        assert correction is not None
        errors.append(error_of(pose, predicted @ correction.a_from_b))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 1e-3)
    assert np.all(np.std(errors, axis=0) < 1.5e-3)


def test_an_empty_mosaic_gives_no_position(diver, tmp_path):
    _, image, _ = diver.key_point(scene.down_camera(0, 0, ALTITUDE_M))
    assert Mosaic(0.01, tmp_path).register(image, scene.down_camera(0, 0, ALTITUDE_M), 1.9, RIG) is None


@pytest.mark.parametrize(
    "step", [[0, 0, 0, 0, -0.3, 0], [0.01, -0.02, 0.03, 0.3, -0.5, 0.03], [0, 0, 0.2, 0.5, 0.2, 0]]
)
def test_pair_motion_is_right_to_millimetres_though_matching_starts_a_centimetre_off(diver, step):
    pose = scene.down_camera(-1, 0, ALTITUDE_M)
    earlier, _, _ = diver.key_point(pose)
    true = geometry.exp(np.array(step, float))
    start = diver.rng.normal(size=6) * [0.003, 0.003, 0.003, 0.01, 0.01, 0.01]
    node, _, _ = diver.key_point(pose @ true, believed=pose @ true @ geometry.exp(start))
    matcher = network.PairMatch(RIG, diver.spool, PATCH_PX)
    matched = matcher.flows(node, [earlier])[0]
    assert matched is not None
    found = matcher.motion(node, earlier, matched)
    assert found is not None
    assert np.linalg.norm(error_of(true, found.a_from_b)[3:]) < 6e-3
    assert np.linalg.norm(error_of(true, found.a_from_b)[:3]) < 3e-3
    link = network.to_link(node, earlier, 0.8, found)
    assert link.closed_form is not None
    # within the same bounds, which the predicted pose (11 mm and 6 mrad off) is not
    assert np.linalg.norm(error_of(true, link.closed_form)[3:]) < 6e-3
    assert np.linalg.norm(error_of(true, link.closed_form)[:3]) < 3e-3
    assert not np.allclose(link.closed_form, link.i_from_j, atol=1e-6)


def test_overlap_is_of_the_true_footprint_and_falls_with_relief(diver):
    pose = scene.down_camera(-1, 0, ALTITUDE_M)
    node, _, _ = diver.key_point(pose)
    same, _, _ = diver.key_point(pose)
    beside, _, _ = diver.key_point(scene.down_camera(-1, 0.6, ALTITUDE_M))
    far, _, _ = diver.key_point(scene.down_camera(-1, 3.0, ALTITUDE_M))
    assert network.overlap(node, same, RIG, PATCH_PX) == 1.0
    flat = 1 - 0.6 / (ALTITUDE_M * RIG.width_px / RIG.focal_px)
    assert 0.4 < network.overlap(node, beside, RIG, PATCH_PX) < flat
    assert network.overlap(node, far, RIG, PATCH_PX) == 0.0


def test_links_join_neighbours_on_the_swath_and_on_the_next_one(diver):
    first = [diver.key_point(scene.down_camera(x, 0.0, ALTITUDE_M))[0] for x in np.arange(-1.5, 1.6, 0.3)]
    second = [diver.key_point(scene.down_camera(x, 0.6, ALTITUDE_M))[0] for x in np.arange(1.5, 0.2, -0.3)]
    node, earlier = second[-1], first + second[:-1]
    chosen = {k.number for k, _ in network.choose_links(node, earlier, RIG, 0.45, 7, PATCH_PX)}
    assert {second[-2].number, second[-3].number} <= chosen
    assert chosen & {k.number for k in first}
    assert len(chosen) <= 7


def test_links_of_one_node_together_know_no_more_than_its_own_stereo_noise_lets_them():
    link = Link(0, 3, np.eye(4), np.eye(6) * 1e-6, 0.8, 200)
    links = network.share_noise([link, link._replace(i=1), link._replace(i=2)])
    together = np.linalg.inv(sum(np.linalg.inv(shared.cov) for shared in links))
    np.testing.assert_allclose(together, link.cov)
    for shared in links:
        np.testing.assert_allclose(shared.own_cov, link.cov)


def test_pressure_corrects_height_alone_and_by_the_weight_of_its_noise():
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([1.0, 2.0, 3.0]))
    believed = PoseFilter(pose, RIG, SensorNoise(0.01, 0.003, 0.01))
    believed.cov = np.diag([1e-8] * 3 + [1e-4] * 3)
    believed.aid(Readings(pressure_z_m=3.02))
    np.testing.assert_allclose(
        believed.world_from_camera[:3, 3], [1.0, 2.0, 3.01], atol=1e-6
    )  # equal variances: half way


def test_a_correction_beyond_both_uncertainties_is_refused():
    believed = PoseFilter(np.eye(4), RIG, SensorNoise(0.01, 0.003, 0.01))
    believed.cov = np.eye(6) * 1e-6
    assert not believed.correct_pose(geometry.exp(np.array([0, 0, 0, 0.5, 0, 0])), np.eye(6) * 1e-6)
    np.testing.assert_array_equal(believed.world_from_camera, np.eye(4))


def test_interpolation_meets_the_key_points_and_keeps_frame_to_frame_motion_between():
    rng = np.random.default_rng(0)
    f2f = [np.eye(4)]
    for _ in range(30):
        f2f.append(f2f[-1] @ geometry.exp(rng.normal(size=6) * 0.01))
    f2f = np.array(f2f)
    rows = np.array([0, 10, 25])
    keys = np.array([f2f[r] @ geometry.exp(rng.normal(size=6) * 0.02) for r in rows])
    path = interpolate_between_keys(f2f, rows, keys)
    np.testing.assert_allclose(path[rows], keys, atol=1e-9)
    np.testing.assert_allclose(interpolate_between_keys(f2f, rows, f2f[rows]), f2f, atol=1e-9)
    np.testing.assert_allclose(geometry.inverse(path[25]) @ path[30], geometry.inverse(f2f[25]) @ f2f[30], atol=1e-9)
