"""Navigation sensors against closed forms, dense Kalman updates and finite differences."""

import numpy as np
import pytest
from scipy.stats import chi2

from twin.core import geometry
from twin.core.links import Link
from twin.core.records import BeaconDetection, Displacement, Readings, SensorNoise, StereoRig
from twin.estimate.alignment import align
from twin.estimate.navigation import aiding
from twin.estimate.navigation.dvl import DvlIntegrator, body_displacement, fuse_displacement, fuse_dvl
from twin.estimate.navigation.kalman import SENSORS
from twin.estimate.navigation.pose_filter import PoseFilter, fuse_pressure_ahrs, readings_as_arrays
from twin.estimate.vision.stereo import Keyframe
from twin.estimate.vision.two_view_motion import Motion

MOUNT = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0.075, -0.15]))
RIG = StereoRig(320, 240, 277.0, 0.15, 30.0, MOUNT)
BEACONS = ((0.3, 0.2, 0.1), (-0.4, 0.3, 0.0), (0.2, -0.5, 0.3), (-0.3, -0.2, 0.2))
NOISE = SensorNoise(0.01, 0.003, 0.01, dvl_mps=0.005, dvl_scale=0.002, usbl_m=0.3, beacon_px=0.2, beacons_m=BEACONS)
POSE = geometry.pose(geometry.rotation_from_rpy(0.04, -0.03, 0.5) @ MOUNT[:3, :3], np.array([0.1, -0.1, 2.2]))


def numeric(function, at, step=1e-6):
    return np.column_stack([(function(at + d) - function(at - d)) / (2 * step) for d in np.eye(len(at)) * step])


def keyframes(poses, readings=None, displacements=None):
    n = len(poses)
    rows = zip(poses, readings or [Readings()] * n, displacements or [None] * n, strict=True)
    return [Keyframe(k, k, 1, pose.copy(), None, r, dvl_displacement=d) for k, (pose, r, d) in enumerate(rows)]


def pixels_of(pose):
    return RIG.project(geometry.transform(geometry.inverse(pose), np.array(BEACONS)))


def sightings_of(pixels):
    return tuple(BeaconDetection(k, (float(u), float(v))) for k, (u, v) in enumerate(pixels))


def dense_update(cov, jacobian, noise_cov, residual):
    """Returns mean and covariance of a Kalman update in information form, which shares no formula with the filter."""
    information = np.linalg.inv(noise_cov)
    after = np.linalg.inv(np.linalg.inv(cov) + jacobian.T @ information @ jacobian)
    return after @ jacobian.T @ information @ residual, after


def some_cov(rng, size=1e-3):
    root = rng.normal(size=(6, 6)) * size
    return root @ root.T + np.eye(6) * (0.3 * size) ** 2


def test_fusion_of_an_acoustic_fix_is_a_kalman_update():
    pose_filter, cov = PoseFilter(POSE, RIG, NOISE), some_cov(np.random.default_rng(0), 0.1)
    pose_filter.cov = cov
    fix = POSE[:3, 3] + [0.2, -0.1, 0.3]
    jacobian = numeric(lambda m: (POSE @ geometry.exp(m))[:3, 3], np.zeros(6))
    moved, after = dense_update(cov, jacobian, np.eye(3) * 0.3**2, fix - POSE[:3, 3])
    pose_filter.fuse_position_fixes(Readings(usbl_m=fix))
    np.testing.assert_allclose(geometry.log(geometry.inverse(POSE) @ pose_filter.world_from_camera), moved, atol=1e-8)
    np.testing.assert_allclose(pose_filter.cov, after, atol=1e-8)


def test_fusion_of_a_beacon_is_a_kalman_update():
    pose_filter, cov = PoseFilter(POSE, RIG, NOISE), some_cov(np.random.default_rng(1))
    pose_filter.cov = cov
    pixel = pixels_of(POSE)[2] + [0.4, -0.3]
    jacobian = numeric(lambda m: pixels_of(POSE @ geometry.exp(m))[2], np.zeros(6))
    moved, after = dense_update(cov, jacobian, np.eye(2) * 0.2**2, pixel - pixels_of(POSE)[2])
    pose_filter.fuse_position_fixes(Readings(beacons=(BeaconDetection(2, tuple(pixel)),)))
    np.testing.assert_allclose(geometry.log(geometry.inverse(POSE) @ pose_filter.world_from_camera), moved, atol=1e-9)
    np.testing.assert_allclose(pose_filter.cov, after, rtol=1e-5, atol=1e-12)


def test_a_beacon_behind_the_camera_is_ignored():
    above = geometry.pose(MOUNT[:3, :3], np.array([0.3, 0.2, -1.0]))
    pose_filter = PoseFilter(above, RIG, NOISE)
    pose_filter.fuse_position_fixes(Readings(beacons=(BeaconDetection(0, (100.0, 100.0)),)))
    np.testing.assert_array_equal(pose_filter.world_from_camera, above)


def test_the_jacobian_of_the_body_displacement_agrees_with_finite_differences():
    motion = geometry.exp(np.array([0.02, -0.05, 0.3, 0.2, -0.4, 0.1]))
    displacement, by_motion = body_displacement(motion, MOUNT)
    body = MOUNT @ motion @ geometry.inverse(MOUNT)
    np.testing.assert_allclose(displacement, body[:3, 3], atol=1e-12)
    expected = numeric(lambda m: body_displacement(motion @ geometry.exp(m), MOUNT)[0], np.zeros(6))
    np.testing.assert_allclose(by_motion, expected, atol=1e-8)


def test_fusion_of_a_frame_motion_with_a_displacement_is_a_kalman_update():
    rng = np.random.default_rng(2)
    motion = Motion(geometry.exp(np.array([0.01, 0, 0.02, 0.01, -0.02, 0])), some_cov(rng), 100, 1.0)
    step_cov = np.diag([1e-6, 2e-6, 3e-6])
    expected = body_displacement(motion.a_from_b, MOUNT)[0]
    step = expected + [1e-3, -2e-3, 5e-4]
    jacobian = numeric(lambda m: body_displacement(motion.a_from_b @ geometry.exp(m), MOUNT)[0], np.zeros(6))
    moved, after = dense_update(motion.cov, jacobian, step_cov, step - expected)
    gates = PoseFilter(POSE, RIG, NOISE).gates
    fused, cov, _ = fuse_displacement(motion.a_from_b, motion.cov, step, step_cov, MOUNT, gates)
    np.testing.assert_allclose(geometry.log(geometry.inverse(motion.a_from_b) @ fused), moved, atol=1e-9)
    np.testing.assert_allclose(cov, after, atol=1e-11)


def fuse(dvl, motion, velocity):
    """Returns the motion of a frame fused with a velocity (None: no reading)."""
    reading = np.full(3, np.nan) if velocity is None else velocity
    gates = PoseFilter(POSE, RIG, NOISE).gates
    fused, cov, *_ = fuse_dvl(dvl.state, dvl.model(1 / RIG.frame_rate_hz), motion.a_from_b, motion.cov, reading, gates)
    return motion._replace(a_from_b=fused, cov=cov)


def sea_path(n):
    """Returns poses (n, 4, 4) of a body that surges, sways and turns, and its exact velocities (n, 3) in the body."""
    t = np.arange(n) / RIG.frame_rate_hz
    yaw, speed = 0.3 * np.sin(1.5 * t), 0.4 + 0.1 * np.sin(2 * t)
    velocity = np.column_stack([speed, 0.1 * np.cos(t), 0.05 * np.sin(t)])
    # positions are integrated in steps a hundred times finer
    fine = np.arange((n - 1) * 100 + 1) / RIG.frame_rate_hz / 100
    turns = np.array([geometry.rotation_from_rpy(0.0, 0.0, a) for a in 0.3 * np.sin(1.5 * fine)])
    world = np.einsum(
        "nij,nj->ni", turns, np.column_stack([0.4 + 0.1 * np.sin(2 * fine), 0.1 * np.cos(fine), 0.05 * np.sin(fine)])
    )
    path = np.concatenate([np.zeros((1, 3)), np.cumsum((world[1:] + world[:-1]) / 2, axis=0)]) * (fine[1] - fine[0])
    poses = [geometry.pose(geometry.rotation_from_rpy(0.0, 0.0, a), p) for a, p in zip(yaw, path[::100], strict=True)]
    return np.array(poses), velocity


def integrate(poses, velocity, noise, motion_cov, rng=None):
    """Returns the displacement by the DVL over a path, with visual motion of this covariance."""
    dvl = DvlIntegrator(RIG, noise)
    fuse(dvl, Motion(np.eye(4), np.eye(6) * 1e-12, 100, 0.0), velocity[0])
    dvl.displacement_at_node(0)
    root = np.linalg.cholesky(motion_cov)
    for a, b, v in zip(poses, poses[1:], velocity[1:], strict=False):
        true = geometry.inverse(a @ MOUNT) @ b @ MOUNT
        measured = true if rng is None else true @ geometry.exp(root @ rng.normal(size=6))
        fuse(dvl, Motion(measured, motion_cov, 100, 0.0), v)
    return dvl.displacement_at_node(1)


def test_velocities_integrate_to_the_displacement_along_a_curved_path():
    poses, velocity = sea_path(61)
    displacement = integrate(poses, velocity, NOISE, np.diag([1e-12] * 3 + [1.0] * 3))
    # error of the trapezoidal rule: dt^2 / 12 times the change of acceleration, here below 1 m/s^2: 2e-4 m
    true_m = (geometry.inverse(poses[0]) @ poses[-1])[:3, 3]
    np.testing.assert_allclose(displacement.displacement_m, true_m, atol=2e-4)
    assert np.linalg.norm(displacement.displacement_m) > 0.7


def test_the_covariance_of_a_displacement_is_consistent_with_its_errors():
    poses, velocity = sea_path(31)
    true, motion_cov, rng = geometry.inverse(poses[0]) @ poses[-1], np.diag([1e-4**2] * 3 + [1e-2**2] * 3), None
    nees, n = [], 600
    for seed in range(n):
        rng = np.random.default_rng(seed)
        noisy = velocity + rng.normal(size=velocity.shape) * NOISE.dvl_mps
        displacement = integrate(poses, noisy, NOISE, motion_cov, rng)
        error = displacement.displacement_m - true[:3, 3]
        nees.append(error @ np.linalg.solve(displacement.cov, error))
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 3 * n) / n
    # The covariance is conservative: it applies the final attitude error to the whole path (three times its true share
    # of the variance, here 2 %), and the noise of the first and last reading in full instead of half (1 of 31 frames).
    assert 0.94 * low < np.mean(nees) < high


def test_the_scale_error_accumulates_along_a_straight_path():
    velocity = np.tile([0.3, 0.0, 0.0], (31, 1))
    scale_only = SensorNoise(0.01, 0.003, 0.01, dvl_mps=1e-9, dvl_scale=0.01)
    dvl, blind = DvlIntegrator(RIG, scale_only), np.eye(6)
    blind[:3, :3] *= 1e-16
    fuse(dvl, Motion(np.eye(4), blind, 0, 0.0), velocity[0])
    dvl.displacement_at_node(0)
    variance = 0.0
    for v in velocity[1:]:
        fused = fuse(dvl, Motion(np.eye(4), blind, 0, 0.0), v)
        variance += (MOUNT[:3, :3] @ fused.cov[3:, 3:] @ MOUNT[:3, :3].T)[0, 0]
    assert np.sqrt(variance) == pytest.approx(0.01 * 0.3, rel=1e-4)  # a second at 0.3 m/s


def test_without_velocity_readings_the_motion_is_unchanged_and_there_is_no_displacement():
    dvl, motion = DvlIntegrator(RIG, NOISE), Motion(geometry.exp(np.full(6, 0.001)), np.eye(6) * 1e-6, 100, 1.0)
    dvl.displacement_at_node(0)
    unaided = fuse(dvl, motion, None)
    np.testing.assert_array_equal(unaided.a_from_b, motion.a_from_b)
    np.testing.assert_array_equal(unaided.cov, motion.cov)
    assert dvl.displacement_at_node(1) is None
    fuse(dvl, motion, np.zeros(3))
    dvl.displacement_at_node(2)
    fuse(dvl, motion, np.zeros(3))
    assert dvl.displacement_at_node(3) is not None
    fuse(dvl, motion, None)
    assert dvl.displacement_at_node(4) is None  # one reading is missing


def test_where_vision_fails_the_dvl_determines_the_motion():
    velocity = np.array([0.3, -0.1, 0.05])
    dvl, blind = DvlIntegrator(RIG, NOISE), Motion(np.eye(4), np.diag([1e-10] * 3 + [1e-2] * 3), 0, np.inf)
    fuse(dvl, blind, velocity)
    fused = fuse(dvl, blind, velocity)
    np.testing.assert_allclose(body_displacement(fused.a_from_b, MOUNT)[0], velocity / 30, atol=1e-5)


FIXED = 1e-12  # variance of quantities that are fixed in a graph


def camera_at(x):
    return geometry.pose(MOUNT[:3, :3], np.array([x, 0.0, 2.0]))


def test_alignment_with_displacements_of_one_scale_error_agrees_with_dense_least_squares():
    """On a line, with link noise of 1 mm and displacement noise of 1 mm: generalised least squares in x."""
    n, step, link_m, dvl_m = 30, 0.3, 1e-3, 1e-3
    noise = SensorNoise(0.01, 0.003, 0.01, dvl_scale=0.01)
    rng = np.random.default_rng(0)
    by_link, by_dvl = step + rng.normal(size=n) * link_m, 1.008 * step + rng.normal(size=n) * dvl_m
    cov = np.diag([FIXED] * 3 + [link_m**2] * 3)
    links = [
        Link(k, k + 1, geometry.inverse(camera_at(0)) @ camera_at(d), cov, 1.0, 100) for k, d in enumerate(by_link)
    ]
    displacements = [None]
    displacements += [Displacement(k, np.array([d, 0, 0]), np.eye(3) * dvl_m**2) for k, d in enumerate(by_dvl)]
    start = [camera_at(x) for x in np.concatenate([[0], np.cumsum(by_link)])]
    aligned = align(keyframes(start, displacements=displacements), links, {0: np.eye(6) * FIXED}, RIG, noise)

    # unknowns: steps (n,) and scale; (1 + s) d = by_dvl is linearised at the mean step, second order 1e-5 of a step
    rows = np.vstack([np.eye(n, n + 1), np.eye(n, n + 1), np.eye(1, n + 1, n)])
    rows[n : 2 * n, n] = step
    weight = np.diag(np.concatenate([np.full(n, link_m), np.full(n, dvl_m), [noise.dvl_scale]]) ** -2.0)
    observed = np.concatenate([by_link, by_dvl, [0.0]])
    after = np.linalg.inv(rows.T @ weight @ rows)
    steps = (after @ rows.T @ weight @ observed)[:n]
    np.testing.assert_allclose(aligned.poses[1:, 0, 3], np.cumsum(steps), atol=5e-4)
    summed = np.tril(np.ones((n, n)))
    variance = np.diag(summed @ after[:n, :n] @ summed.T)
    world = np.array([p[:3, :3] @ c[3:, 3:] @ p[:3, :3].T for p, c in zip(aligned.poses, aligned.covs, strict=True)])
    np.testing.assert_allclose(world[1:, 0, 0], variance, rtol=0.03)
    # without the scale parameter the error would be 0.8 % of 9 m, 72 mm
    assert abs(aligned.poses[-1, 0, 3] - n * step) < 4 * np.sqrt(variance[-1])


def test_exact_displacements_give_the_true_poses_of_a_turning_vehicle():
    rng = np.random.default_rng(4)
    poses = [
        camera_at(0) @ geometry.exp(np.array([0.02 * k, -0.05 * k, 0.1 * k, 0.1 * k, -0.3 * k, 0])) for k in range(6)
    ]
    motions = [geometry.inverse(a) @ b for a, b in zip(poses, poses[1:], strict=False)]
    displacements = [None]
    displacements += [Displacement(k, body_displacement(m, MOUNT)[0], np.eye(3) * 1e-8) for k, m in enumerate(motions)]
    cov = np.diag([1e-10] * 3 + [1.0] * 3)  # the links constrain the attitude only
    links = [
        Link(k, k + 1, m @ geometry.exp(np.array([0, 0, 0, 0.1, 0.1, 0.1])), cov, 1.0, 100)
        for k, m in enumerate(motions)
    ]
    start = [poses[0]] + [p @ geometry.exp(rng.normal(size=6) * 1e-3) for p in poses[1:]]
    exact_scale = SensorNoise(0.01, 0.003, 0.01, dvl_scale=1e-9)
    aligned = align(keyframes(start, displacements=displacements), links, {0: np.eye(6) * FIXED}, RIG, exact_scale)
    # second-order error of corrections of 1 mrad and 1 mm: 0.3 m * (1e-3)^2 / 2 per link
    np.testing.assert_allclose(aligned.poses, poses, atol=5e-6)


def test_displacement_residuals_are_invariant_to_a_common_motion_of_both_nodes():
    poses = [camera_at(0), camera_at(0.3) @ geometry.exp(np.array([0.02, -0.05, 0.1, 0, 0, 0]))]
    displacements = [None, Displacement(0, np.array([0.301, 0.002, -0.001]), np.eye(3) * 1e-6)]
    common = geometry.exp(np.array([0.5, -0.3, 1.0, 3.0, -2.0, 1.0]))
    factors = aiding.displacement_factors(keyframes(poses, displacements=displacements), RIG)
    start, moved = (
        factors.residuals((geometry.inverse(a) @ b)[None], np.zeros(1))
        for a, b in (poses, [common @ pose for pose in poses])
    )
    assert np.linalg.norm(start) > 1e-3
    np.testing.assert_allclose(moved, start, atol=1e-12)


@pytest.mark.parametrize("scale", [0.0, 0.05])
def test_jacobians_of_displacement_factors_agree_with_finite_differences(scale):
    motion = geometry.exp(np.array([0.02, -0.05, 0.3, 0.2, -0.4, 0.1]))
    displacements = [None, Displacement(0, np.array([0.3, 0.0, 0.0]), np.eye(3) * 1e-6)]
    factors = aiding.displacement_factors(keyframes([POSE, POSE @ motion], displacements=displacements), RIG)
    shared = np.array([scale, 0.3])  # the second parameter is of no effect
    by_j = factors.jacobians(motion[None], shared, factors.residuals(motion[None], shared))
    by_motion = numeric(lambda m: factors.residuals((motion @ geometry.exp(m))[None], shared)[0], np.zeros(6))
    np.testing.assert_allclose(by_j[0], by_motion, atol=1e-8)
    by_shared = numeric(lambda s: factors.residuals(motion[None], shared + s)[0], np.zeros(2))
    np.testing.assert_allclose(factors.by_shared(motion[None], slice(None), 2)[0], by_shared, atol=1e-8)


def outliers():
    """Returns the readings of each sensor at POSE but for a gross error, by name."""
    angles = geometry.rpy_from_rotation((POSE @ geometry.inverse(MOUNT))[:3, :3])
    wrong_pixel = tuple(BeaconDetection(0, (float(u) + 20, float(v))) for u, v in pixels_of(POSE)[:1])
    return {
        "pressure": Readings(pressure_z_m=POSE[2, 3] + 0.3),
        "ahrs": Readings(ahrs_rpy_rad=angles + [0, 0, 0.3]),
        "usbl": Readings(usbl_m=POSE[:3, 3] + [3, 0, 0]),
        "beacons": Readings(beacons=wrong_pixel),
        "vertical": Readings(up=tilted_up([0.5, 0, 0])),
    }


def fused_with(pose_filter, readings):
    """Fuses the readings of one frame at rest; returns those that were used."""
    before, aiding = pose_filter.rejected, pose_filter.aiding(0.1)
    height, angles, _ = readings_as_arrays(readings)
    pose_filter.world_from_camera, pose_filter.cov = fuse_pressure_ahrs(
        pose_filter.world_from_camera, pose_filter.cov, aiding, height, angles
    )
    pose_filter.fuse_vertical(readings)
    return pose_filter.fuse_position_fixes(pose_filter.without_rejected(readings, before))


@pytest.mark.parametrize("sensor", ["pressure", "ahrs", "usbl", "beacons", "vertical"])
def test_a_reading_beyond_its_gate_changes_nothing_and_is_no_factor(sensor):
    pose_filter = PoseFilter(POSE, RIG, NOISE)
    pose_filter.cov = np.diag([0.03**2] * 3 + [0.01**2] * 3) if sensor == "vertical" else np.eye(6) * 1e-6
    cov = pose_filter.cov
    used = fused_with(pose_filter, outliers()[sensor])
    np.testing.assert_array_equal(pose_filter.world_from_camera, POSE)
    np.testing.assert_array_equal(pose_filter.cov, cov)
    assert pose_filter.rejected.tolist() == [name == sensor for name in SENSORS]
    assert all(not len(factors.pose_index) for factors in aiding.unary_factors(keyframes([POSE], [used]), RIG, NOISE))


@pytest.mark.parametrize("sensor", ["pressure", "ahrs", "usbl"])
def test_a_sensor_that_contradicts_the_pose_for_long_is_believed_if_motions_were_predicted(sensor):
    """It agrees with itself, so the pose is taken to be wrong: the pose moves to the readings, which then pass."""
    pose_filter, k = PoseFilter(POSE, RIG, NOISE), SENSORS.index(sensor)
    pose_filter.cov = np.eye(6) * 1e-6
    for _ in range(20):
        pose_filter.gates.add_prediction()
    readings, residual = outliers()[sensor], {"pressure": 0.3, "ahrs": 0.3, "usbl": 3.0}[sensor]
    for _ in range(400):
        fused_with(pose_filter, readings)
    assert 0 < pose_filter.rejected[k] < 400 and pose_filter.gates.counts[k, [0, 2, 3]].tolist() == [0, 1, 1]
    moved = geometry.log(geometry.inverse(POSE) @ pose_filter.world_from_camera)
    assert max(np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])) == pytest.approx(residual, rel=0.02)


@pytest.mark.parametrize("sensor", ["pressure", "ahrs", "usbl"])
def test_a_sensor_that_contradicts_measured_motions_is_disputed_but_never_believed(sensor):
    pose_filter, k = PoseFilter(POSE, RIG, NOISE), SENSORS.index(sensor)
    pose_filter.cov = np.eye(6) * 1e-6
    for _ in range(400):
        fused_with(pose_filter, outliers()[sensor])
    assert pose_filter.rejected[k] == 400 and pose_filter.gates.counts[k, 3] == 0
    assert pose_filter.gates.counts[k, 2] > 0
    np.testing.assert_array_equal(pose_filter.world_from_camera, POSE)


def test_a_sensor_that_contradicts_itself_is_never_believed():
    pose_filter, rng = PoseFilter(POSE, RIG, NOISE), np.random.default_rng(0)
    for offset in rng.choice([-1, 1], 1000) * rng.uniform(0.3, 3.0, 1000):
        fused_with(pose_filter, Readings(pressure_z_m=POSE[2, 3] + offset))
    assert pose_filter.gates.counts[0, 1:4].tolist() == [1000, 0, 0]
    np.testing.assert_array_equal(pose_filter.world_from_camera, POSE)


def test_a_velocity_that_contradicts_vision_is_no_part_of_a_displacement_until_it_lasts():
    """It is compared at every second frame, as it is not averaged with the reading before a rejected one."""
    velocity, gates = np.array([0.3, 0.0, 0.0]), PoseFilter(POSE, RIG, NOISE).gates
    dvl, model = DvlIntegrator(RIG, NOISE), DvlIntegrator(RIG, NOISE).model(1 / RIG.frame_rate_hz)
    motion = geometry.inverse(MOUNT) @ geometry.pose(np.eye(3), velocity / RIG.frame_rate_hz) @ MOUNT
    cov = np.eye(6) * 1e-8
    fuse_dvl(dvl.state, model, motion, cov, velocity, gates)
    dvl.displacement_at_node(0)
    wrong = velocity + [1.0, 0.0, 0.0]
    fused, fused_cov, *_ = fuse_dvl(dvl.state, model, motion, cov, wrong, gates)
    np.testing.assert_array_equal(fused, motion)
    np.testing.assert_array_equal(fused_cov, cov)
    assert dvl.displacement_at_node(1) is None
    for _ in range(14):
        fuse_dvl(dvl.state, model, motion, cov, wrong, gates)
    assert gates.counts[2].tolist()[1:4] == [8, 0, 0]
    for _ in range(60):
        gates.add_prediction()
        fused, *_ = fuse_dvl(dvl.state, model, motion, cov, wrong, gates)
    assert gates.counts[2, 3] > 0
    np.testing.assert_allclose(body_displacement(fused, MOUNT)[0], wrong / RIG.frame_rate_hz, rtol=0.05, atol=1e-4)


def tilted_up(tilt):
    """Returns the vertical in the body at POSE, turned by a rotation vector (3,) in body axes [rad]."""
    return geometry.so3_exp(np.array(tilt)) @ (POSE @ geometry.inverse(MOUNT))[2, :3]


@pytest.mark.parametrize("kind", ["height", "attitude", "position", "beacon", "vertical"])
def test_jacobians_of_unary_factors_agree_with_finite_differences(kind):
    readings = Readings(2.3, np.array([0.05, -0.02, 0.45]), usbl_m=np.array([0.2, 0.0, 2.0]),
                        beacons=sightings_of(pixels_of(POSE))[:1], up=tilted_up([0.05, -0.02, 0.4]))  # fmt: skip
    order = ["height", "attitude", "position", "beacon", "vertical"]
    factors = aiding.unary_factors(keyframes([POSE], [readings]), RIG, NOISE)[order.index(kind)]
    jacobians = factors.jacobians(POSE[None], factors.residuals(POSE[None]))
    expected = numeric(lambda m: factors.residuals((POSE @ geometry.exp(m))[None])[0], np.zeros(6))
    np.testing.assert_allclose(jacobians[0], expected, rtol=1e-6, atol=1e-7)


def test_a_displacement_from_a_node_outside_the_window_is_ignored():
    displacements = [None, Displacement(7, np.full(3, 9.0), np.eye(3) * 1e-6)]
    link = Link(0, 1, geometry.inverse(camera_at(0)) @ camera_at(0.3), np.eye(6) * 1e-6, 1.0, 100)
    nodes = keyframes([camera_at(0), camera_at(0.3)], displacements=displacements)
    aligned = align(nodes, [link], {0: np.eye(6) * FIXED}, RIG, NOISE)
    np.testing.assert_allclose(aligned.poses[1], camera_at(0.3), atol=1e-9)


def test_acoustic_fixes_of_a_rigid_chain_shift_it_to_the_weighted_mean():
    """With a weak prior and nearly exact links, the shift is the weighted mean of prior and fixes."""
    fixes = np.array([[0.3, 0.1, 2.2], [0.6, -0.2, 1.9], [0.5, 0.3, 2.3]])
    poses = [camera_at(x) for x in (0.0, 0.3, 0.6)]
    links = [
        Link(k, k + 1, geometry.inverse(camera_at(0)) @ camera_at(0.3), np.eye(6) * 1e-8, 1.0, 100) for k in range(2)
    ]
    prior = np.diag([1e-8] * 3 + [0.2**2] * 3)
    readings = [Readings(usbl_m=fix) for fix in fixes]
    aligned = align(keyframes(poses, readings), links, {0: prior}, RIG, NOISE)
    variance = 1 / (1 / 0.2**2 + 3 / 0.3**2)
    shift = variance * (fixes - np.array(poses)[:, :3, 3]).sum(axis=0) / 0.3**2
    np.testing.assert_allclose(aligned.poses[:, :3, 3] - np.array(poses)[:, :3, 3], np.tile(shift, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(aligned.covs[0][3:, 3:], np.eye(3) * variance, rtol=1e-3, atol=1e-6)


def test_four_beacons_resect_the_camera_with_the_covariance_of_a_resection():
    wide = {0: np.eye(6) * 1e2}
    readings = Readings(beacons=sightings_of(pixels_of(POSE)))
    key = keyframes([POSE @ geometry.exp(np.array([0.03, -0.02, 0.05, 0.1, -0.1, 0.15]))], [readings])
    aligned = align(key, [], wide, RIG, NOISE)
    jacobian = numeric(lambda m: pixels_of(POSE @ geometry.exp(m)).ravel(), np.zeros(6))
    expected = np.linalg.inv(jacobian.T @ jacobian) * NOISE.beacon_px**2
    np.testing.assert_allclose(aligned.poses[0], POSE, atol=1e-5)
    # the information of the prior is small but not zero
    np.testing.assert_allclose(aligned.covs[0], expected, atol=0.02 * np.abs(expected).max())


def test_filter_and_alignment_agree_on_the_same_beacons():
    rng = np.random.default_rng(3)
    cov = some_cov(rng)
    readings = Readings(beacons=sightings_of(pixels_of(POSE) + rng.normal(size=(4, 2)) * 0.2))
    pose_filter = PoseFilter(POSE, RIG, NOISE)
    pose_filter.cov = cov
    pose_filter.fuse_position_fixes(readings)
    aligned = align(keyframes([POSE], [readings]), [], {0: cov}, RIG, NOISE)
    # corrections of 1 mm and 1 mrad: the two linearisations differ by second-order terms
    np.testing.assert_allclose(pose_filter.world_from_camera, aligned.poses[0], atol=2e-5)
    np.testing.assert_allclose(pose_filter.cov, aligned.covs[0], atol=0.02 * np.abs(pose_filter.cov).max())


def test_the_residual_of_a_vertical_is_the_sine_of_its_angle_and_does_not_depend_on_heading():
    factors = aiding.unary_factors(keyframes([POSE], [Readings(up=tilted_up([0.03, 0.0, 0.0]))]), RIG, NOISE)[4]
    turned = geometry.pose(geometry.rotation_from_rpy(0.0, 0.0, 2.0), np.zeros(3)) @ POSE
    axis = (POSE @ geometry.inverse(MOUNT))[2, :3]
    sine = np.linalg.norm(np.cross(tilted_up([0.03, 0.0, 0.0]), axis))
    for pose in (POSE, turned):
        assert np.linalg.norm(factors.residuals(pose[None])[0]) == pytest.approx(sine, rel=1e-9)
    exact = aiding.unary_factors(keyframes([POSE], [Readings(up=tilted_up([0.0, 0.0, 0.0]))]), RIG, NOISE)[4]
    np.testing.assert_allclose(exact.residuals(turned[None]), 0, atol=1e-12)


@pytest.mark.long
def test_the_alignment_of_a_chain_with_a_biased_accelerometer_is_consistent():
    """The bias is in every reading: 20 of them give the tilt of the chain with the standard deviation of one.

    NEES of the two components of the tilt over 400 biases: chi-square with 2 degrees of freedom each.
    """
    noise, n, rng = SensorNoise(up_rad=0.02), 20, np.random.default_rng(5)
    poses = [geometry.pose(MOUNT[:3, :3], np.array([0.3 * k, 0.0, 2.0])) for k in range(n)]
    links = [
        Link(k, k + 1, geometry.inverse(a) @ b, np.eye(6) * 1e-8, 1.0, 100)
        for k, (a, b) in enumerate(zip(poses, poses[1:], strict=False))
    ]
    loose = np.diag([0.5**2] * 3 + [FIXED] * 3)
    nees, trials = [], 400
    for _ in range(trials):
        tilt = rng.normal(size=2) * noise.up_rad
        up = geometry.so3_exp(np.array([*tilt, 0.0]))[:, 2]
        aligned = align(keyframes(poses, [Readings(up=up)] * n), links, {0: loose}, RIG, noise)
        p = aligned.poses[0][2, :3]  # the vertical in the camera; its true value is that of poses[0]
        across = np.stack([poses[0][0, :3], poses[0][1, :3]])
        by_error = across @ geometry.skew(p)
        nees.append(across @ p @ np.linalg.solve(by_error @ aligned.covs[0][:3, :3] @ by_error.T, across @ p))
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 2 * trials) / trials
    assert low < np.mean(nees) < high


def test_however_many_verticals_are_fused_their_common_error_remains():
    pose_filter, up = PoseFilter(POSE, RIG, NOISE), tilted_up([0.0, 0.0, 0.0])
    pose_filter.cov = np.diag([0.1**2] * 3 + [1e-4] * 3)
    heading = pose_filter.cov[:3, :3] @ POSE[2, :3]
    for _ in range(500):
        pose_filter.fuse_vertical(Readings(up=up))
    by_error = np.stack([POSE[0, :3], POSE[1, :3]]) @ geometry.skew(POSE[2, :3])
    np.testing.assert_allclose(
        by_error @ pose_filter.cov[:3, :3] @ by_error.T, np.eye(2) * NOISE.up_rad**2, rtol=1e-6, atol=1e-12
    )
    np.testing.assert_allclose(pose_filter.cov[:3, :3] @ POSE[2, :3], heading, atol=1e-12)  # free
    np.testing.assert_allclose(pose_filter.world_from_camera, POSE, atol=1e-12)


def test_fusion_of_a_vertical_turns_a_tilted_pose_to_it():
    """The error is reduced by the gain 1 - s^2 / S = 1 - (0.02 / 0.1)^2, up to the second order of 0.03 rad."""
    tilted = POSE @ geometry.exp(np.array([0.03, 0.0, 0.0, 0, 0, 0]))
    pose_filter = PoseFilter(tilted, RIG, SensorNoise(up_rad=0.02))
    pose_filter.cov = np.diag([0.1**2] * 3 + [1e-4] * 3)
    pose_filter.fuse_vertical(Readings(up=tilted_up([0.0, 0.0, 0.0])))
    left = np.linalg.norm(np.cross(pose_filter.world_from_camera[2, :3], POSE[2, :3]))
    before = np.linalg.norm(np.cross(tilted[2, :3], POSE[2, :3]))
    assert left == pytest.approx(0.04 * before, rel=0.02)
    unread = PoseFilter(tilted, RIG, NOISE)
    unread.fuse_vertical(Readings())
    np.testing.assert_array_equal(unread.world_from_camera, tilted)
