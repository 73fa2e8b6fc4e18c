"""The IMU against MuJoCo's own sensors, against the motion that its readings integrate to, and its noise statistics."""

import numpy as np
import pytest
from physics_world import IDLE, STILL, vehicle

from twin.core import geometry
from twin.errors import ScenarioError, TwinError
from twin.scenario.file import load_scenario
from twin.scenario.model import ImuConfig, VehicleConfig
from twin.scenes.gl import mujoco
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.simulate.mujoco_vehicle import MujocoVehicle
from twin.simulate.sea import steady_current
from twin.simulate.sensors import InertialSensor
from twin.world.mission import motion_rate_hz, prepare

RATE_HZ = 120.0
EXACT = {
    "gyroscope_noise_density": 0, "gyroscope_random_walk": 0, "gyroscope_bias_sigma_radps": 0,
    "accelerometer_noise_density": 0, "accelerometer_random_walk": 0, "accelerometer_bias_sigma_mps2": 0,
}  # fmt: skip
UP = np.array([0.0, 0.0, 9.81])


def sensor(start, rate_hz=None, motion_rate_hz=RATE_HZ, seed=0, **noise):
    """Returns an IMU without noise except for the given keys."""
    settings = ImuConfig(rate_hz=rate_hz, **(EXACT | noise))
    return InertialSensor(settings, motion_rate_hz, np.asarray(start, float), np.random.default_rng(seed))


def flown(rov, seconds, command=lambda t: IDLE):
    """Returns the exact readings of a flight, and poses (n, 4, 4) and twists (n, 6) at their times."""
    imu = sensor(rov.inertial)
    poses, twists = [rov.world_from_body], [rov.twist_body]

    def add(values):
        imu.add(values)
        poses.append(rov.world_from_body)
        twists.append(rov.twist_body)

    rov.after_timestep = add
    for k in range(round(seconds * 30)):
        rov.step(command(k / 30), 1 / 30)
    return imu.read(), np.array(poses), np.array(twists)


def turning(t):
    """Returns thruster commands (8,) that turn the vehicle about all axes while it moves."""
    phase = np.arange(8)
    return 0.35 * np.sin(0.9 * t + phase) + 0.15 * np.array([1, -1, 1, -1, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def flight():
    return flown(vehicle(buoyancy_n=1.0), 20.0, turning)


def test_a_body_at_rest_measures_gravity_upwards_and_no_rates():
    readings, _, _ = flown(vehicle(), 1.0)
    np.testing.assert_allclose(readings.times_s, np.arange(121) / 120)
    np.testing.assert_allclose(readings.rates_radps, 0.0, atol=1e-12)
    np.testing.assert_allclose(readings.specific_forces_mps2, np.tile(UP, (121, 1)), atol=1e-12)


def test_a_tilted_body_measures_gravity_along_the_vertical_in_its_axes():
    """Roll to starboard (about x, forward) lifts the left side: the specific force has a component to the left."""
    rolled = vehicle(geometry.pose(geometry.rotation_from_rpy(0.3, 0.0, 1.0), np.zeros(3)))
    np.testing.assert_allclose(rolled.inertial[3:], 9.81 * np.array([0, np.sin(0.3), np.cos(0.3)]), atol=1e-12)


def test_the_specific_force_and_the_rates_are_those_of_the_sensors_of_mujoco():
    spec = mujoco.MjSpec()
    spec.option.timestep = 1 / RATE_HZ
    body = spec.worldbody.add_body(name="vehicle")
    body.add_freejoint()
    body.mass, body.inertia = VehicleConfig().mass_kg, np.array(VehicleConfig().inertia_kgm2)
    body.explicitinertial = True
    body.add_site(name="imu")
    for name, kind in (("gyro", mujoco.mjtSensor.mjSENS_GYRO), ("force", mujoco.mjtSensor.mjSENS_ACCELEROMETER)):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
    rov = MujocoVehicle(spec.compile(), VehicleConfig(), steady_current(STILL), np.eye(4))
    readings = []

    def compare(values):
        readings.append((values, rov._data.sensordata.copy()))

    rov.after_timestep = compare
    for k in range(60):
        rov.step(turning(k / 30), 1 / 30)
    ours, theirs = np.array(readings).transpose(1, 0, 2)
    ours, before, after = ours[:-1], theirs[:-1], theirs[1:]
    assert np.abs(ours[:, :3]).max() > 0.3 and np.abs(ours[:, 3:] - UP).max() > 0.3
    # MuJoCo's accelerometer refers to the start of a timestep; its gyroscope, here, to half a timestep before the pose,
    # so that the mean of two of its values deviates by (1/240 s)^2 / 2 times the second derivative of the rate
    np.testing.assert_allclose(ours[:, 3:], after[:, 3:], atol=1e-9)
    np.testing.assert_allclose(ours[12:, :3], (before + after)[12:, :3] / 2, atol=0.002)  # not where the thrust starts


def test_the_rates_integrate_to_the_true_change_of_attitude(flight):
    readings, poses, _ = flight
    rotation = poses[0, :3, :3]
    middle = (readings.rates_radps[:-1] + readings.rates_radps[1:]) / 2
    for rate, duration_s in zip(middle, np.diff(readings.times_s), strict=True):
        rotation = rotation @ geometry.so3_exp(rate * duration_s)
    assert np.linalg.norm(middle, axis=1).sum() / RATE_HZ > 2.0  # radians turned about all axes
    error_rad = np.linalg.norm(geometry.so3_log(np.ascontiguousarray(rotation.T @ poses[-1, :3, :3])))
    assert np.rad2deg(error_rad) < 0.05


def test_the_specific_forces_integrate_to_the_true_velocity_and_position(flight):
    """Strapdown integration with the true attitude; the error of the trapezoidal rule is of second order in 1/120 s."""
    readings, poses, twists = flight
    acceleration = np.einsum("nij,nj->ni", poses[:, :3, :3], readings.specific_forces_mps2) - UP
    velocity = np.einsum("nij,nj->ni", poses[:, :3, :3], twists[:, 3:])
    step_s = np.diff(readings.times_s)[:, None]
    found = np.cumsum((acceleration[:-1] + acceleration[1:]) / 2 * step_s, axis=0)
    assert np.abs(velocity).max() > 0.2
    np.testing.assert_allclose(found, velocity[1:] - velocity[0], atol=1e-3)
    moved = np.cumsum((velocity[:-1] + velocity[1:]) / 2 * step_s, axis=0)
    np.testing.assert_allclose(moved, poses[1:, :3, 3] - poses[0, :3, 3], atol=1e-3)


def test_forces_of_a_kinematic_vehicle_add_up_to_its_velocity():
    carrier = KinematicVehicle(geometry.pose(geometry.rotation_from_rpy(0, 0, 0.7), np.zeros(3)))
    imu = sensor(carrier.inertial, motion_rate_hz=30.0)
    carrier.after_timestep = imu.add
    for k in range(30):
        carrier.step(np.array([0.2 * np.sin(k / 5), 0.1, 0.0]), 1 / 30)
    readings = imu.read()
    np.testing.assert_array_equal(readings.rates_radps, 0.0)
    np.testing.assert_allclose(readings.specific_forces_mps2[:, 2], 9.81)
    np.testing.assert_allclose(
        (readings.specific_forces_mps2[1:] - UP).sum(axis=0) / 30, carrier.twist_body[3:], atol=1e-12
    )


@pytest.mark.parametrize("rate_hz", [30.0, 100.0, 120.0])
def test_the_standard_deviation_of_a_reading_is_the_density_times_the_root_of_the_rate(rate_hz):
    n, densities = 30_000, (2e-3, 5e-2)
    imu = sensor([0, 0, 0, 0, 0, 9.81], rate_hz, gyroscope_noise_density=densities[0],
                 accelerometer_noise_density=densities[1])  # fmt: skip
    for _ in range(round(n * RATE_HZ / rate_hz)):
        imu.add(np.array([0, 0, 0, 0, 0, 9.81]))
    readings = imu.read()
    assert np.diff(readings.times_s) == pytest.approx(1 / rate_hz)
    for values, density in ((readings.rates_radps, 2e-3), (readings.specific_forces_mps2 - UP, 5e-2)):
        # 4 standard errors of a standard deviation, a mean and a correlation
        assert np.abs(values.std(axis=0) / (density * np.sqrt(rate_hz)) - 1).max() < 4 / np.sqrt(2 * n)
        assert np.abs(values.mean(axis=0)).max() < 4 * density * np.sqrt(rate_hz / n)
        assert abs(np.corrcoef(values[:-1, 0], values[1:, 0])[0, 1]) < 4 / np.sqrt(n)


def test_the_bias_starts_with_its_standard_deviation_and_walks_by_its_density():
    """The variance of the change of a random walk over a time t is w^2 t: the Allan deviation w sqrt(t / 3)."""
    settings = {"gyroscope_bias_sigma_radps": 0.01, "gyroscope_random_walk": 3e-4,
                "accelerometer_bias_sigma_mps2": 0.2, "accelerometer_random_walk": 4e-3}  # fmt: skip
    n_sensors, n = 300, 1200
    starts, ends = [], []
    for seed in range(n_sensors):
        imu = sensor([0, 0, 0, 0, 0, 9.81], seed=seed, **settings)
        imu._true = [np.array([0, 0, 0, 0, 0, 9.81])] * (n + 1)
        readings = imu.read()
        values = np.hstack([readings.rates_radps, readings.specific_forces_mps2 - UP])
        starts.append(values[0])
        ends.append(values[-1] - values[0])
    limit = 4 / np.sqrt(2 * n_sensors * 3)
    for part, sigma, walk in ((slice(0, 3), 0.01, 3e-4), (slice(3, 6), 0.2, 4e-3)):
        assert abs(np.std(np.array(starts)[:, part]) / sigma - 1) < limit
        assert abs(np.std(np.array(ends)[:, part]) / (walk * np.sqrt(n / RATE_HZ)) - 1) < limit


def test_readings_between_the_timesteps_are_interpolated_and_do_not_depend_on_how_often_they_are_read():
    slope = np.array([0.1, -0.2, 0.3, 1.0, 2.0, -3.0])

    def readings(every, **noise):
        imu, found = sensor(np.zeros(6), 100.0, seed=4, **noise), []
        for k in range(1, 241):
            imu.add(slope * k / RATE_HZ)
            if k % every == 0:
                found.append(np.column_stack(imu.read()))
        return np.vstack(found)

    exact = readings(4)
    np.testing.assert_allclose(exact[:, 0], np.arange(201) / 100)
    np.testing.assert_allclose(exact[:, 1:], np.outer(exact[:, 0], slope), atol=1e-12)
    noise = {"gyroscope_noise_density": 1e-3, "accelerometer_random_walk": 0.1}
    np.testing.assert_allclose(readings(4, **noise), readings(240, **noise), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("frame_rate_hz", "dynamics", "rate_hz"),
    [(30, "rigid", 120), (25, "rigid", 125), (7, "rigid", 126), (30, "kinematic", 30)],
)
def test_the_rate_is_by_default_and_at_most_that_of_the_simulated_motion(frame_rate_hz, dynamics, rate_hz):
    overrides = [f"rig.frame_rate_hz={frame_rate_hz}", f'vehicle.dynamics="{dynamics}"', "imaging.fidelity=surrogate"]
    scenario = load_scenario("reef", [*overrides, f"imu.rate_hz={rate_hz + 0.5}"])
    assert motion_rate_hz(scenario) == pytest.approx(rate_hz, rel=1e-12)
    with pytest.raises(TwinError, match=r"imu.rate_hz: .*: above .* \(allowed: up to "):
        sensor(np.zeros(6), rate_hz + 0.5, motion_rate_hz(scenario))
    assert len(sensor(np.zeros(6), rate_hz, motion_rate_hz(scenario)).read().times_s) == 1


def test_a_rate_above_that_of_the_physics_is_refused_before_the_flight():
    scenario = load_scenario("reef", ["imaging.fidelity=surrogate", "imu.rate_hz=200"])
    with pytest.raises(ScenarioError, match=r"--set: imu.rate_hz: 200: above .* \(allowed: up to 120 with this"):
        prepare(scenario)
