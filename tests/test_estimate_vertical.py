"""Direction of the vertical from an IMU: exact for exact readings, consistent over many random vehicles."""

import numpy as np
import pytest
from scipy.stats import chi2

from twin.core import geometry
from twin.core.records import GRAVITY_MPS2, ImuErrorModel, ImuReadings
from twin.estimate.navigation.vertical import _filtered, verticals

NOISE = ImuErrorModel(1.7e-4, 2e-5, 2e-3, 0.0, 0.0, 0.0)  # ADIS16448, as in EuRoC
RATE_HZ = 50.0


def simulated(seed, seconds=30.0, acceleration_mps2=0.1, bias_radps=0.02, noise=NOISE):
    """Returns readings of a vehicle that turns about all axes, and the vertical (n, 3) in its axes.

    Accelerations are Ornstein-Uhlenbeck processes with a correlation time of 1 s.
    """
    rng, n, step_s = np.random.default_rng(seed), int(seconds * RATE_HZ), 1 / RATE_HZ
    t = np.arange(n) * step_s
    rates = sum(
        rng.normal(size=3) * 0.1 * np.sin(2 * np.pi * f * t + p)[:, None] for f, p in rng.uniform(0.05, 0.5, (4, 2))
    )
    acceleration, keep = np.zeros((n, 3)), np.exp(-step_s)
    acceleration[0] = rng.normal(size=3)
    for k in range(1, n):
        acceleration[k] = keep * acceleration[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=3)
    acceleration *= acceleration_mps2
    rotation, up, forces = geometry.rotation_from_rpy(*rng.normal(size=3) * 0.3), np.empty((n, 3)), np.empty((n, 3))
    for k in range(n):
        if k:
            rotation = rotation @ geometry.so3_exp((rates[k - 1] + rates[k]) / 2 * step_s)
        up[k], forces[k] = rotation[2], rotation.T @ (acceleration[k] + [0, 0, GRAVITY_MPS2])
    bias = bias_radps * rng.normal(size=3)
    bias = bias + np.cumsum(rng.normal(size=(n, 3)), axis=0) * noise.rate_walk * np.sqrt(step_s)
    white = rng.normal(size=(2, n, 3)) * np.sqrt(RATE_HZ)
    return ImuReadings(t, rates + bias + noise.rate_density * white[0], forces + noise.force_density * white[1]), up


def errors(found, up):
    """Returns the angles (n,) between directions [rad]."""
    return np.linalg.norm(np.cross(found, up), axis=1)


def test_exact_readings_of_a_vehicle_without_acceleration_give_the_vertical():
    readings, up = simulated(0, acceleration_mps2=0.0, bias_radps=0.0, noise=ImuErrorModel(*[0.0] * 6))
    found, _ = verticals(readings, NOISE)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    assert errors(found, up).max() < 1e-4


def test_the_bias_of_the_gyroscope_is_estimated():
    """A bias of 3 degrees per second and axis, 2.6 standard deviations, would turn the vertical by 90 degrees."""
    readings, up = simulated(1, acceleration_mps2=0.0, bias_radps=0.0, noise=ImuErrorModel(*[0.0] * 6))
    found, _ = verticals(readings._replace(rates_radps=readings.rates_radps + np.deg2rad([3, -3, 3])), NOISE)
    assert np.rad2deg(errors(found, up)).max() < 1.0


@pytest.mark.long
def test_the_standard_deviation_is_consistent_with_the_errors():
    """Errors at three times, each over 200 vehicles: chi-square with 2 degrees of freedom per vehicle.

    At the ends the mean of the first second enters twice, as the start and as readings; 6 % of the information there.
    """
    rows, trials, found = [0, 700, 1499], 200, []
    for seed in range(trials):
        readings, up = simulated(seed)
        directions, sigma = verticals(readings, NOISE)
        found.append((errors(directions, up)[rows] / sigma[rows]) ** 2)
    nees = np.mean(found, axis=0)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 2 * trials) / trials
    assert (low < nees).all() and (nees < 1.1 * high).all()


def test_readings_are_better_together_than_alone():
    """The specific force of one moment errs by the acceleration: 0.1 m/s2 are 10 mrad about each axis."""
    readings, up = simulated(3)
    alone = readings.specific_forces_mps2 / np.linalg.norm(readings.specific_forces_mps2, axis=1, keepdims=True)
    assert errors(verticals(readings, NOISE)[0], up).std() < 0.5 * errors(alone, up).std()


def test_over_a_gap_the_standard_deviation_grows_with_the_unknown_rotation():
    readings, up = simulated(4)
    kept = (readings.times_s < 10) | (readings.times_s > 12)
    found, sigma = verticals(ImuReadings(*(values[kept] for values in readings)), NOISE)
    whole = verticals(readings, NOISE)[1]
    assert sigma[500] > 1.1 * whole[500] and sigma[0] == pytest.approx(whole[0], rel=0.3)
    assert (errors(found, up[kept]) < 4 * sigma).all()


def test_a_reading_stands_for_the_time_since_the_one_before_it():
    """After 5 s, only every tenth reading is kept: the noise is that of accelerations, which has not changed.

    The uncertainty grows by up to 22 % only, as fewer gyroscope readings are interpolated; were all readings given the
    mean interval, it would be 14 % too small in the first half and 81 % too large in the second.
    """
    readings, _ = simulated(2, seconds=10.0)
    kept = (readings.times_s < 5) | (np.arange(len(readings.times_s)) % 10 == 0)
    sigma = verticals(ImuReadings(*(values[kept] for values in readings)), NOISE)[1]
    ratio = sigma / verticals(readings, NOISE)[1][kept]
    assert ratio.min() > 0.98 and ratio.max() < 1.3


@pytest.mark.parametrize("interval_s", [0.05, 0.5])
def test_the_first_reading_stands_for_a_mean_interval(interval_s):
    """Closed form: the information of the start and of one specific force with the noise density over the interval."""
    density2, start = 0.02, (2 * 0.1 / GRAVITY_MPS2) ** 2 + 0.02**2
    upward = np.tile([0.0, 0.0, GRAVITY_MPS2], (3, 1))
    _, variance = _filtered(np.arange(3) * interval_s, np.zeros((3, 3)), upward, 1e-8, 1e-10, density2)
    assert variance[0] == pytest.approx(1 / (1 / start + GRAVITY_MPS2**2 * interval_s / density2), rel=1e-9)


def test_one_reading_is_its_own_vertical():
    force = np.array([[3.0, -1.0, 9.0]])
    found, sigma = verticals(ImuReadings(np.zeros(1), np.zeros((1, 3)), force), NOISE)
    np.testing.assert_allclose(found[0], force[0] / np.linalg.norm(force), atol=1e-9)
    assert sigma[0] > 0.005
