"""Recorded readings as aiding: signs, units, times and the start, in closed form and without images."""

import numpy as np
import pytest
from recorded_datasets import RIG

from twin.core import geometry
from twin.core.records import Trajectory
from twin.core.settings import EstimatorSettings
from twin.datasets.readings import RecordedReadings, SensorSeries
from twin.recordings.recorded_aiding import Aiding

START_S, RATE_HZ = 5.0, 10.0  # time of the first frame in the clock of the data set, rate of frames and readings
BODY_FROM_LEFT = geometry.pose(geometry.rotation_from_rpy(np.pi, 0.1, 0.7), np.array([0.2, 0.1, -0.3]))
LEFT_FROM_RECTIFIED = geometry.pose(geometry.so3_exp(np.array([0.01, -0.02, 0.03])), np.zeros(3))
BODY_FROM_CAMERA = BODY_FROM_LEFT @ LEFT_FROM_RECTIFIED
LOWER_M = 30.0  # the recorded heights are lower than those of the world


def path(n=5):
    """Returns poses (n, 4, 4) of the rectified camera that moves and tilts in a world whose z axis points up."""
    turns = [geometry.rotation_from_rpy(np.pi + 0.2 - 0.03 * k, -0.1 + 0.05 * k, 0.4 + 0.1 * k) for k in range(n)]
    return np.array([geometry.pose(turn, np.array([0.1 * k, 0.2, 1.5 + 0.04 * k])) for k, turn in enumerate(turns)])


def timed(values, *sigmas):
    return SensorSeries(START_S + np.arange(len(values)) / RATE_HZ, np.array(values, float), np.array(sigmas))


def exact(monkeypatch, **chosen):
    """Returns an Aiding with exact readings of `path` by the chosen sensors, whose visual motions are exact too."""
    bodies = path() @ geometry.inverse(BODY_FROM_CAMERA)
    every = {
        "attitude": timed([geometry.rpy_from_rotation(body[:3, :3]) for body in bodies], 0.01, 0.02, 0.03),
        "vertical": timed(bodies[:, 2, :3], 0.05),
        "height": timed(path()[:, 2, 3:] - LOWER_M, 0.004),
    }
    given = RecordedReadings(BODY_FROM_LEFT, **{name: every[name] for name in chosen})
    aiding = Aiding(given, LEFT_FROM_RECTIFIED, START_S, RATE_HZ)
    moved = np.linalg.inv(path()[0]) @ path()
    motions = [(motion, aiding.at(k / RATE_HZ)) for k, motion in enumerate(moved)]
    monkeypatch.setattr(Aiding, "_first_motions", lambda *_: motions)
    return aiding


def opening(pose):
    return (), RIG, EstimatorSettings(), pose


def test_the_start_and_the_heights_follow_from_exact_readings(monkeypatch):
    aiding = exact(monkeypatch, attitude=True, height=True)
    assert aiding.used == ["pressure", "attitude"]
    np.testing.assert_allclose(aiding.body_from_camera, BODY_FROM_CAMERA)
    start = aiding.start(*opening(geometry.pose(np.eye(3), np.array([9.0, 9.0, 1.5]))))
    np.testing.assert_allclose(start.world_from_camera[:3, :3], path()[0][:3, :3], atol=1e-9)
    np.testing.assert_allclose(start.world_from_camera[:3, 3], [0, 0, 1.5])
    heights = [aiding.at(k / RATE_HZ).pressure_z_m for k in range(5)]
    np.testing.assert_allclose(heights, path()[:, 2, 3], atol=1e-9)


def test_a_start_from_verticals_is_level_and_keeps_the_heading_over_the_plane(monkeypatch):
    """The plane is tilted against the horizontal by a rotation about a horizontal axis, so no heading is lost."""
    aiding = exact(monkeypatch, vertical=True)
    tilt = geometry.so3_exp(np.array([0.15, -0.1, 0.0]))
    start = aiding.start(*opening(geometry.pose(tilt @ path()[0][:3, :3], np.array([0, 0, 2.0]))))
    np.testing.assert_allclose(start.world_from_camera[:3, :3], path()[0][:3, :3], atol=1e-9)
    assert start.world_from_camera[2, 3] == 2.0


def test_the_uncertainty_of_a_start_has_the_axes_of_the_sensor(monkeypatch):
    rotation = path()[0][:3, :3]
    start = exact(monkeypatch, attitude=True, height=True).start(*opening(np.eye(4)))
    variances = BODY_FROM_CAMERA[:3, :3].T @ np.diag([0.02**2, 0.02**2, 0.03**2]) @ BODY_FROM_CAMERA[:3, :3]
    np.testing.assert_allclose(start.cov[:3, :3], np.diag(np.diag(variances)) / 5, rtol=1e-9)  # of five readings
    np.testing.assert_allclose(start.prior_cov[:3, :3], 0.1**2 * np.eye(3), atol=1e-12)
    world = rotation @ start.prior_cov[3:, 3:] @ rotation.T
    np.testing.assert_allclose(np.diag(world), [1e-12, 1e-12, 1.0], rtol=1e-3)
    level = exact(monkeypatch, vertical=True).start(*opening(np.eye(4)))
    turned = level.world_from_camera[:3, :3]
    for cov, tilt in ((level.cov, 0.05), (level.prior_cov, 0.1)):  # heading and height define the world
        in_world = turned @ cov[:3, :3] @ turned.T
        np.testing.assert_allclose(in_world, np.diag([tilt**2, tilt**2, 1e-12]), atol=1e-13)
    assert np.trace(level.prior_cov[3:, 3:]) < 1e-11


def test_the_noise_of_the_estimators_is_that_of_the_readings(monkeypatch):
    noise = exact(monkeypatch, attitude=True, height=True).noise
    assert (noise.pressure_m, noise.attitude_rad, noise.heading_rad) == (0.004, 0.02, 0.03)
    assert exact(monkeypatch, vertical=True).noise.up_rad == 0.05


@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_residuals_are_zero_on_the_true_path_and_count_standard_deviations(monkeypatch, late_s):
    aiding = exact(monkeypatch, attitude=True, height=True)
    aiding.start(*opening(geometry.pose(np.eye(3), np.array([0, 0, 1.5]))))
    times_s, moved = np.arange(4) / RATE_HZ, path()[:4].copy()
    found = aiding.residuals(Trajectory(times_s + late_s, moved))
    if late_s:  # the path rises by 4 cm per frame, of a standard deviation of 4 mm
        assert found["pressure"] == pytest.approx(10, rel=1e-6) and found["attitude"] > 2
        return
    assert max(found.values()) < 1e-6
    moved[:, 2, 3] -= 0.008
    turn = BODY_FROM_CAMERA[:3, :3].T @ geometry.so3_exp(np.array([0, 0, 0.09])) @ BODY_FROM_CAMERA[:3, :3]
    moved[:, :3, :3] = moved[:, :3, :3] @ turn  # by three standard deviations about the z axis of the body
    found = aiding.residuals(Trajectory(times_s, moved))
    assert found["pressure"] == pytest.approx(2) and found["attitude"] == pytest.approx(3 / 3**0.5)


def test_the_residual_of_verticals_is_in_standard_deviations():
    """Tilts of one standard deviation about both horizontal axes: 1."""
    sigma, tilt = 0.01, geometry.so3_exp(np.array([0.01, 0.01, 0.0]))
    up = SensorSeries(np.array([5.0, 5.1]), np.tile(tilt[2], (2, 1)), np.array([sigma]))
    aiding = Aiding(RecordedReadings(np.eye(4), vertical=up), np.eye(4), 5.0, 10.0)
    level = Trajectory(np.array([0.0, 0.1]), np.tile(np.eye(4), (2, 1, 1)))
    assert aiding.residuals(level)["vertical"] == pytest.approx(1.0, rel=1e-3)


def series(rate_hz, values, sigma):
    return SensorSeries(np.arange(len(values)) / rate_hz + 5.0, np.array(values, float), np.full(len(values[0]), sigma))


def test_velocities_are_interpolated_and_their_noise_is_that_of_a_frame():
    """At 5 Hz, 3 frames at 15 Hz share a reading: their sum has the variance of 3 independent errors 3^0.5 larger."""
    velocity = series(5.0, [[0, 0, 0], [0.2, 0, 0], [0.2, 0, 0]], 0.01)
    aiding = Aiding(RecordedReadings(np.eye(4), velocity=velocity), np.eye(4), 5.0, 15.0)
    np.testing.assert_allclose(aiding.at(0.1).dvl_mps, [0.1, 0, 0])
    assert aiding.at(0.5).dvl_mps is None and aiding.at(0.1).pressure_z_m is None
    assert aiding.noise.dvl_mps == pytest.approx(0.01 * 3**0.5)
    gapped = series(5.0, [[0.1, 0, 0]] * 5, 0.01)
    gapped = Aiding(
        RecordedReadings(np.eye(4), velocity=gapped._replace(times_s=np.array([5, 5.2, 5.4, 5.6, 6.6]))),
        np.eye(4),
        5.0,
        15.0,
    )
    assert gapped.at(0.5).dvl_mps is not None and gapped.at(1.0).dvl_mps is None
    assert gapped.at(0.6).dvl_mps is not None and gapped.at(1.6).dvl_mps is not None  # at the ends of the gap


def test_an_attitude_belongs_to_the_frame_within_ten_milliseconds():
    attitude = series(10.0, [[0, 0, 0.1], [0, 0, 0.2]], 0.01)
    aiding = Aiding(RecordedReadings(np.eye(4), attitude=attitude), np.eye(4), 5.0, 15.0)
    assert aiding.at(0.009).ahrs_rpy_rad[2] == 0.1 and aiding.at(0.011).ahrs_rpy_rad is None


@pytest.mark.parametrize(
    ("attitude_s", "height_s", "known", "used"),
    [
        (0.0, 0.0, None, ["pressure", "attitude"]),
        (20.0, 0.0, None, []),
        (0.0, 20.0, None, ["attitude"]),
        (20.0, 0.0, np.eye(4), ["pressure", "attitude"]),
        (0.0, 20.0, np.eye(4), ["attitude"]),
    ],
)
def test_readings_that_no_first_frame_has_are_not_used_later(monkeypatch, attitude_s, height_s, known, used):
    """Heights of -30 m in a world whose start is at 1.5 m would otherwise be fused as they are."""
    attitude, height = series(10.0, [[0.0, 0.0, 0.0]] * 300, 0.01), series(10.0, [[-30.0]] * 300, 0.01)
    attitude = attitude._replace(times_s=attitude.times_s + attitude_s)
    height = height._replace(times_s=height.times_s + height_s)
    aiding = Aiding(RecordedReadings(np.eye(4), height=height, attitude=attitude), np.eye(4), 5.0, 10.0)
    at_start = geometry.pose(np.eye(3), np.array([0.0, 0.0, 1.5]))
    monkeypatch.setattr(Aiding, "_first_motions", lambda self, *_: [(np.eye(4), self.at(k / 10)) for k in range(60)])
    start = aiding.start((), RIG, EstimatorSettings(), at_start, known)
    assert aiding.used == used and len(aiding.notes) == 2 - len(used)
    assert (start is None) == (not used)
    later = aiding.at(25.0)
    assert (later.pressure_z_m is None) == ("pressure" not in used)
    assert (later.ahrs_rpy_rad is None) == ("attitude" not in used)
    if "pressure" in used:
        assert later.pressure_z_m == pytest.approx(1.5 if known is None else 0.0)
