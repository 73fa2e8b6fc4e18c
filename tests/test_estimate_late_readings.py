"""Late and rare readings: fused at their time, given to the next node, and bridged by vision."""

from dataclasses import fields, replace

import numpy as np
import pytest
import seafloor_scene as scene
from scipy.stats import chi2

from twin.core import geometry
from twin.core.records import Frame, ImuErrorModel, ImuReadings, Readings, SensorNoise, StereoRig
from twin.estimate import Navigator
from twin.estimate.late_readings import ReadingsBetweenNodes, motion_since
from twin.estimate.navigation.dvl import DvlIntegrator, fuse_dvl
from twin.estimate.navigation.pose_filter import PoseFilter
from twin.estimate.trajectory import PoseLog
from twin.estimate.vision.inertial_filter import InertialFilter
from twin.estimate.vision.stereo import Keyframe
from twin.estimate.vision.two_view_motion import Motion

MOUNT = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0.075, -0.15]))
RIG = StereoRig(320, 240, 277.0, 0.15, 10.0, MOUNT)
NOISE = SensorNoise(0.01, 0.003, 0.01, usbl_m=0.3)
START = geometry.pose(geometry.rotation_from_rpy(0.04, -0.03, 0.5) @ MOUNT[:3, :3], np.array([0.1, -0.1, 2.2]))
STEP = np.array([0.004, -0.006, 0.01, 0.01, -0.05, 0.02])
COV = np.diag([2e-7, 1e-7, 3e-7, 4e-6, 2e-6, 3e-6])


def some_readings(pose):
    body = pose[:3, :3] @ MOUNT[:3, :3].T
    return {
        "pressure": Readings(pressure_z_m=pose[2, 3] + 0.012),
        "ahrs": Readings(ahrs_rpy_rad=geometry.rpy_from_rotation(body) + [0.002, -0.004, 0.008]),
        "usbl": Readings(usbl_m=pose[:3, 3] + [0.2, -0.3, 0.1]),
    }


def flown(n, noise=NOISE, at=None, readings=None):
    """Returns a filter and the log of n frames; the readings are fused in time, at a frame."""
    found, log = PoseFilter(START.copy(), RIG, noise), PoseLog()
    found.cov = np.diag([1e-5] * 3 + [0.05] * 3)
    for k in range(n):
        if k:
            found.advance(Motion(geometry.exp(STEP), COV, 100, 0.1), Readings(), 0.1)
        if k == at:
            height_m, rpy = readings.pressure_z_m, readings.ahrs_rpy_rad
            found.advance(
                Motion(np.eye(4), np.zeros((6, 6)), 100, 0.1), Readings(height_m, rpy), 0.1
            )  # no motion, so that only the readings count
            found.fuse_position_fixes(readings)
        log.append(k / 10, np.eye(4), found.world_from_camera.copy(), STEP if k else np.zeros(6), np.diag(COV))
    return found, log


@pytest.mark.parametrize("sensor", ("pressure", "ahrs", "usbl"))
def test_a_late_reading_has_the_effect_that_it_would_have_had_in_time(sensor):
    readings = some_readings(flown(4)[0].world_from_camera)[sensor]
    in_time, _ = flown(9, at=3, readings=readings)
    late, log = flown(9)
    kept = late.fuse_earlier(readings, *motion_since(log, 0.3))
    assert all(getattr(kept, part.name) is getattr(readings, part.name) for part in fields(readings))
    assert late.gates.counts[:, 1].sum() == 0
    # the linearisation differs by the correction: up to 0.3 m or 0.01 rad, times rotations of the path of 0.1 rad
    np.testing.assert_allclose(late.world_from_camera, in_time.world_from_camera, atol=1e-7)
    np.testing.assert_allclose(late.cov, in_time.cov, atol=1e-9)
    assert np.abs(late.world_from_camera - flown(9)[0].world_from_camera).max() > 1e-3  # it did have an effect


def test_fusing_a_late_reading_as_if_it_were_new_would_be_wrong():
    readings = some_readings(flown(4)[0].world_from_camera)["usbl"]
    in_time, _ = flown(9, at=3, readings=readings)
    wrong, _ = flown(9, at=8, readings=readings)
    assert np.abs(wrong.world_from_camera - in_time.world_from_camera).max() > 0.05


def test_the_motion_since_a_time_between_frames_is_a_part_of_a_step():
    _, log = flown(5)
    for share in (0.0, 0.25, 1.0):
        motion, cov = motion_since(log, 0.2 + 0.1 * share)
        expected = geometry.exp((1 - share) * STEP) @ geometry.exp(STEP)
        np.testing.assert_allclose(motion, expected, atol=1e-12)
        assert np.trace(cov) == pytest.approx((2 - share) * np.trace(COV), rel=0.05)
    assert np.array_equal(motion_since(log, -1.0)[0], motion_since(log, 0.0)[0])
    assert np.array_equal(motion_since(log, 9.0)[0], np.eye(4))


def node_at(row, log, readings=None):
    return Keyframe(row, row, 1, log.online.array[row].copy(), None, readings or Readings())


FIELDS = {"pressure": "pressure_z_m", "ahrs": "ahrs_rpy_rad", "usbl": "usbl_m"}


@pytest.mark.parametrize(("sensor", "name"), FIELDS.items())
def test_a_node_without_a_reading_gets_the_last_one_moved_along_the_path(sensor, name):
    _, log = flown(9)
    poses = log.online.array
    nodes, between = [node_at(2, log), node_at(6, log)], ReadingsBetweenNodes(RIG, NOISE)
    for row in (3, 5, 7):
        between.keep(row / 10, some_readings(poses[row])[sensor])
        between.give_to_nodes(nodes, log)
    assert getattr(nodes[0].readings, name) is None
    expected = getattr(some_readings(poses[6])[sensor], name)
    # small angles of an AHRS error do not commute with the rotation in between: 0.01 rad times 0.01 rad
    np.testing.assert_allclose(getattr(nodes[1].readings, name), expected, atol=2e-4 if sensor == "ahrs" else 1e-9)


def test_a_node_keeps_its_own_reading_and_takes_none_across_an_unmeasured_motion():
    _, log = flown(9)
    nodes, between = [node_at(4, log, Readings(pressure_z_m=2.0))], ReadingsBetweenNodes(RIG, NOISE)
    between.keep(0.3, Readings(pressure_z_m=1.0))
    between.give_to_nodes(nodes, log)
    assert nodes[0].readings.pressure_z_m == 2.0
    log.variances.array[6] = np.diag(COV) + 0.01
    nodes.append(node_at(7, log))
    between.keep(0.5, Readings(pressure_z_m=1.0))
    between.give_to_nodes(nodes, log)
    assert nodes[1].readings.pressure_z_m is None


def wavy(n, rate_hz):
    """Returns poses (n, 4, 4) of a body that surges and sways, and its exact velocities (n, 3)."""
    t = np.arange(n) / rate_hz
    velocity = np.column_stack([0.4 + 0.1 * np.sin(t), 0.1 * np.cos(t), 0.05 * np.sin(t)])
    path = np.column_stack([0.4 * t + 0.1 * (1 - np.cos(t)), 0.1 * np.sin(t), 0.05 * (1 - np.cos(t))])
    return [geometry.pose(np.eye(3), p) for p in path], velocity


def integrated(every, seed, visual_m, n=31):
    """Returns error and covariance of the displacement over a path, and errors and covariances of the pose after it."""
    noise = SensorNoise(dvl_mps=0.005, dvl_scale=1e-6, dvl_interval_s=0.0 if every == 1 else every / 10)
    poses, velocity = wavy(n, 10.0)
    cov, rng = np.diag([1e-5**2] * 3 + [visual_m**2] * 3), np.random.default_rng(seed)
    found = PoseFilter(poses[0] @ MOUNT, RIG, noise)
    found.cov = np.eye(6) * 1e-12
    found.advance(Motion(np.eye(4), cov * 1e-6, 100, 0.1), Readings(dvl_mps=velocity[0]), 0.1)
    found.start_from_node(0)
    for k in range(1, n):
        true = geometry.inverse(poses[k - 1] @ MOUNT) @ poses[k] @ MOUNT
        seen = true @ geometry.exp(np.sqrt(np.diag(cov)) * rng.normal(size=6))
        reading = velocity[k] + 0.005 * rng.normal(size=3) if k % every == 0 else None
        found.advance(Motion(seen, cov, 100, 0.1), Readings(dvl_mps=reading), 0.1)
    true = poses[0] @ MOUNT
    error = geometry.log(geometry.inverse(found.world_from_camera) @ poses[-1] @ MOUNT)[3:]
    since = geometry.log(geometry.inverse(true @ found.since_node) @ poses[-1] @ MOUNT)[3:]
    np.testing.assert_allclose(since, error, atol=1e-5)
    measured = found.start_from_node(1)
    return error, found.cov[3:, 3:], measured, (geometry.inverse(poses[0]) @ poses[-1])[:3, 3]


@pytest.mark.parametrize("every", (1, 2, 3))
def test_a_slow_dvl_reduces_the_error_of_vision_and_its_covariance_is_consistent(every):
    found = [integrated(every, seed, 0.02) for seed in range(120)]
    errors, displaced = np.array([f[0] for f in found]), np.array([f[2].displacement_m - f[3] for f in found])
    n = 3 * len(found)
    # vision alone: 0.02 m times the root of 30 frames is 0.11 m; the DVL: 0.005 m/s times 0.1 s times `every` times the
    # root of 30 / `every` intervals
    assert errors.std() < 1.3 * 0.0005 * np.sqrt(30 * every)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], n) / n
    for values, covs in ((errors, [f[1] for f in found]), (displaced, [f[2].cov for f in found])):
        nees = np.mean([e @ np.linalg.solve(c, e) / 3 for e, c in zip(values, covs, strict=True)])
        # conservative: each reading has half weight in two intervals, whose errors count as independent; and the
        # margin for the change of acceleration between readings, up to 0.4 of a reading's noise at 0.3 s
        assert 0.6 * low < nees < high, every


def test_a_node_between_two_readings_has_a_displacement_that_vision_completes():
    poses, velocity = wavy(15, 10.0)
    noise, cov = SensorNoise(dvl_mps=0.005, dvl_scale=1e-6, dvl_interval_s=0.4), np.diag([1e-5**2] * 3 + [0.001**2] * 3)
    found, node_rows, last = PoseFilter(poses[0] @ MOUNT, RIG, noise), (0, 6, 14), 0
    for k in range(15):
        true = np.eye(4) if k == 0 else geometry.inverse(poses[k - 1] @ MOUNT) @ poses[k] @ MOUNT
        reading = velocity[k] if k % 4 == 0 else None
        found.advance(Motion(true, cov, 100, 0.1), Readings(dvl_mps=reading), 0.1)
        if k in node_rows:
            measured = found.start_from_node(k)
            if k:
                expected = (geometry.inverse(poses[last]) @ poses[k])[:3, 3]
                np.testing.assert_allclose(measured.displacement_m, expected, atol=1e-3)  # trapezoidal rule over 0.4 s
                assert 1e-6 < np.trace(measured.cov) / 3 < 1e-4
            last = k


def test_a_slow_dvl_that_misses_more_than_one_reading_is_incomplete():
    dvl, motion = DvlIntegrator(RIG, SensorNoise(dvl_interval_s=0.2)), Motion(geometry.exp(STEP), COV, 100, 0.1)
    gates = PoseFilter(START, RIG, NOISE).gates

    def step(reading):
        velocity = np.full(3, np.nan) if reading is None else np.array(reading)
        fuse_dvl(dvl.state, dvl.model(0.1), motion.a_from_b, motion.cov, velocity, gates)

    step([0.0, 0.0, 0.0])
    dvl.displacement_at_node(0)
    for k in range(1, 9):
        step(None)
        assert dvl.state.complete[0] == (k < 5), k


def flown_with_fixes(far_off=(), every=3):
    """Returns errors of the final path in y [m] and the number of rejected fixes; `far_off`: frames of wrong ones."""
    rig, floor, rng = (
        replace(scene.small_rig(160, 120), frame_rate_hz=10.0),
        scene.plane(0.05, 0.03),
        np.random.default_rng(0),
    )
    noise = SensorNoise(usbl_m=0.02)
    with Navigator(rig, readings_noise=noise, start=scene.down_camera(0, 0, 2.0)) as navigator:
        for k in range(10):
            pair = scene.stereo_pair(floor, rig, scene.down_camera(0.05 * k, 0, 2.0), rng)[:2]
            left, right = (np.repeat(image[..., None], 3, axis=2) for image in pair)
            fix = np.array([0.05 * k, 10.0 * (k in far_off), 2.0]) if k % every == 0 or k in far_off else None
            navigator.update(Frame(k, k / 10, left, right, Readings(usbl_m=fix), keyframe=k % 3 == 0))
        result = navigator.finish()
    return np.abs(result.final.positions[:, 1]).max(), result.quality.readings_rejected["usbl"]


@pytest.mark.parametrize("far_off", [(6, 9), (5,)])
def test_a_rejected_position_fix_is_in_no_alignment(far_off):
    """Neither of keyframes (6, 9) nor of a frame between keyframes (5)."""
    error_m, n_rejected = flown_with_fixes(far_off)
    assert n_rejected == len(far_off) and error_m < 5e-3


def test_a_frame_that_is_ignored_changes_nothing():
    rig, left = scene.small_rig(160, 120), np.zeros((50, 160, 3), np.uint8)
    with Navigator(rig, readings_noise=SensorNoise(usbl_m=0.1), start=scene.down_camera(0, 0, 2.0)) as navigator:
        navigator.update(Frame(0, 0.0, np.zeros((120, 160, 3), np.uint8), None))
        navigator.filter.cov = np.eye(6) * 0.01
        before = navigator.filter.world_from_camera.copy()
        late = ((0.0, Readings(usbl_m=np.array([0.2, 0.0, 2.0]))),)
        with pytest.raises(ValueError, match="the image has 160 x 50 px"):
            navigator.update(Frame(1, 0.1, left, None, Readings(late=late)))
        np.testing.assert_array_equal(navigator.filter.world_from_camera, before)
        np.testing.assert_array_equal(navigator.filter.cov, np.eye(6) * 0.01)


def test_another_scale_of_the_images_keeps_the_inertial_filter(monkeypatch):
    monkeypatch.setattr("twin.estimate.vision.stereo.choose_binning", lambda *_: 2)
    rig, imu = scene.small_rig(160, 120), ImuErrorModel(1.7e-4, 2e-5, 2e-3, 3e-3, 1e-3, 1e-2)
    pair = scene.stereo_pair(scene.plane(0.05, 0.03), rig, scene.down_camera(0, 0, 2.0), np.random.default_rng(0))[:2]
    left, right = (np.repeat(image[..., None], 3, axis=2) for image in pair)
    reading = ImuReadings(np.zeros(1), np.zeros((1, 3)), np.array([[0.0, 0.0, 9.81]]))
    with Navigator(rig, readings_noise=SensorNoise(imu=imu)) as navigator:
        navigator.update(Frame(0, 0.0, left[:, ::-1].copy(), None, Readings(imu=reading)))
        navigator.update(Frame(1, 0.1, left, right))  # no reading
        assert navigator.vision.binning == 2 and isinstance(navigator.vision.f2f.filter, InertialFilter)
