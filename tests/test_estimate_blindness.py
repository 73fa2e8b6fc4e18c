"""Blind frames: tracking that finds its points again measures the whole motion since, whatever was predicted."""

from types import SimpleNamespace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.links import Link
from twin.core.records import Frame, Readings, SensorNoise, StereoRig
from twin.estimate.pipeline import Navigator, _Blindness
from twin.estimate.vision.f2f import constant_velocity_motion
from twin.estimate.vision.two_view_motion import Motion

MOUNT = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.075, -0.15]))
RIG = StereoRig(320, 240, 277.0, 0.15, 10.0, MOUNT)
RATE_HZ, N, BLIND = 10.0, 60, range(20, 40)
NOISE = SensorNoise()


class ScriptedVision:
    """Vision that tracks one reference: where blind, it predicts from a velocity; then it sees the pose again."""

    def __init__(self, poses, blind=BLIND):
        self.poses, self.k, self.believed, self.blind = poses, -1, poses[0], blind

    def track_frame(self, frame):
        self.k += 1
        if self.k == 0:
            return Motion(np.eye(4), np.eye(6) * 1e-12, 0, 0.0), "ok"
        before = self.believed
        if self.k in self.blind:
            step = geometry.exp(np.array([0.0, 0.0, 0.004, 0.05, 0.0, 0.0]))  # not the true motion
            self.believed = before @ step
            return constant_velocity_motion(step), "too few points matched"
        self.believed = self.poses[self.k]
        return Motion(geometry.inverse(before) @ self.believed, np.eye(6) * 1e-6, 100, 0.0), "ok"

    def __getattr__(self, name):
        return lambda *_, **__: None


def path():
    """Returns true poses (n, 4, 4): a turn while moving, which the prediction does not know."""
    steps = [np.array([0.0, 0.0, 0.01 if k in BLIND else 0.0, 0.03, 0.01, 0.0]) for k in range(N)]
    poses = [geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))]
    for step in steps[1:]:
        poses.append(poses[-1] @ geometry.exp(step))
    return np.array(poses)


@pytest.fixture
def flown():
    poses, rng = path(), np.random.default_rng(0)
    vision = ScriptedVision(poses)
    navigator = Navigator(RIG, start=poses[0], vision=vision, readings_noise=NOISE)
    estimates, image = [], np.zeros((RIG.height_px, RIG.width_px, 3), np.uint8)
    for k, pose in enumerate(poses):
        body = pose @ geometry.inverse(RIG.body_from_camera)
        angles = geometry.rpy_from_rotation(body[:3, :3]) + NOISE.attitude_sigmas_rad * rng.standard_normal(3)
        readings = Readings(pose[2, 3] + NOISE.pressure_m * rng.standard_normal(), angles)
        estimates.append(navigator.update(Frame(k, k / RATE_HZ, image, None, readings, False)))
    return poses, estimates, navigator


def test_after_blindness_the_pose_is_that_before_it_and_the_measured_motion(flown):
    poses, estimates, _ = flown
    online = np.array([one.world_from_camera for one in estimates])
    sizes = np.linalg.norm(online[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert sizes[BLIND.stop - 1] > 0.1
    assert sizes[BLIND.stop :].max() < 0.02
    sigmas = np.array([one.sigma_m for one in estimates])
    assert sigmas[BLIND.stop - 1] > 0.05 and sigmas[BLIND.stop] < 0.01
    assert (sizes[BLIND.stop :] < 4 * sigmas[BLIND.stop :]).all()


def test_the_first_velocity_after_blindness_is_the_mean_since_and_no_jump(flown):
    _, estimates, _ = flown
    speed = np.linalg.norm(estimates[BLIND.stop].camera_velocity[3:])
    assert speed == pytest.approx(0.03 * RATE_HZ, rel=0.15)


def test_the_steps_between_are_closed_on_the_measured_motion(flown):
    """Their product is the measured motion, and the path between does not jump at its end."""
    poses, _, navigator = flown
    steps = navigator.log.steps.array
    product = np.eye(4)
    for step in steps[BLIND.start : BLIND.stop + 1]:
        product = product @ geometry.exp(step)
    expected = geometry.inverse(poses[BLIND.start - 1]) @ poses[BLIND.stop]
    np.testing.assert_allclose(product, expected, atol=1e-8)
    assert np.linalg.norm(steps[BLIND.start : BLIND.stop + 1, 3:], axis=1).max() < 0.06
    assert navigator.log.n_lost == len(BLIND)


def test_a_dvl_measures_the_first_blind_frame_after_a_seen_one():
    """Else the noise of the pressure sensor determines its height, as a prediction is far less certain."""
    poses, rng = path(), np.random.default_rng(1)
    blind = [k for k in range(20, 40) if k % 3]
    navigator = Navigator(RIG, start=poses[0], vision=ScriptedVision(poses, blind), readings_noise=NOISE)
    image, errors = np.zeros((RIG.height_px, RIG.width_px, 3), np.uint8), []
    bodies = poses @ geometry.inverse(RIG.body_from_camera)
    for k, pose in enumerate(poses):
        step = geometry.log(geometry.inverse(bodies[max(k - 1, 0)]) @ bodies[max(k, 1)])
        pressure_m = pose[2, 3] + NOISE.pressure_m * rng.standard_normal()
        readings = Readings(pressure_m, dvl_mps=step[3:] * RATE_HZ + NOISE.dvl_mps * rng.standard_normal(3))
        found = navigator.update(Frame(k, k / RATE_HZ, image, None, readings, False)).world_from_camera
        errors.append(found[:3, 3] - pose[:3, 3])
    height_m = np.abs(np.array(errors)[blind, 2])
    assert height_m.max() < 0.5 * NOISE.pressure_m


@pytest.mark.parametrize(("motion_sigma_m", "node_sigma_m", "kept"), [(0.05, 5e-4, 0.0), (1e-4, 0.05, 1.0)])
def test_a_link_after_blindness_keeps_only_the_correction_of_the_last_node(motion_sigma_m, node_sigma_m, kept):
    """Readings have corrected the pose by 20 mm: the error of the motion since the node, or that of the node."""
    start, wrong, true = np.eye(4), np.array([0, 0, 0, 0.48, 0, 0.0]), np.array([0, 0, 0, 0.5, 0, 0.0])
    navigator = Navigator(RIG, start=start, vision=ScriptedVision(path()), readings_noise=NOISE)
    navigator.network.nodes.append(SimpleNamespace(world_from_camera=start))
    pose = navigator.filter
    pose.since_node, pose.since_node_cov = geometry.exp(wrong), np.eye(6) * motion_sigma_m**2
    pose.cov_at_node, pose.world_from_camera = np.eye(6) * node_sigma_m**2, geometry.exp(true)
    navigator._blind = _Blindness(pose.state, range(3, 5), np.eye(4))
    node = SimpleNamespace(world_from_camera=None)
    link = Link(0, 1, geometry.exp(true), np.eye(6) * 1e-8, 0.5, 100)
    navigator._follow_chain(node, link)
    assert node.world_from_camera[0, 3] == pytest.approx(0.5 + kept * 0.02, abs=1e-3)
