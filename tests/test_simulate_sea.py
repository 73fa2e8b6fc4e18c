"""Motion of the water: statistics of gusts and waves, closed forms, gradients, and trajectories in it (DOP853)."""

import sys

import numpy as np
import pytest
from physics_world import bare_model
from scipy.integrate import solve_ivp
from scipy.signal import welch
from test_simulate_hydrodynamics import coupled, dense_acceleration, dense_fins

from twin.core import geometry
from twin.errors import TwinError
from twin.scenario.file import load_scenario
from twin.scenario.model import CurrentConfig, Scenario, VehicleConfig, WavesConfig
from twin.scenario.model_files import built_in
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.hull import physics_timestep_s, trimmed_hull
from twin.simulate.mujoco_vehicle import MujocoVehicle
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import flow_at, gust_series, make_sea, mean_current_mps
from twin.simulate.thrusters import steady_thrust_n
from twin.simulate.waves import jonswap, peak_radps, wavenumbers

HERE = np.array([1.0, 2.0, 1.5])
SEA = Scenario(
    current=CurrentConfig(velocity_mps=(0.2, 0.1, 0.0), profile="log", gust_mps=0.1, gust_time_s=5, tide_mps=(0.1, 0)),
    waves=WavesConfig(height_m=0.8, period_s=6, depth_m=10, direction_deg=30),
)


def sea_of(scenario=SEA, seed=0):
    return make_sea(scenario, np.random.default_rng(seed))


def velocities(sea, times_s, position=HERE):
    return np.array([flow_at(sea, t, position)[0] for t in times_s])


def test_rate_and_gradient_of_the_flow_are_the_derivatives_of_its_velocity():
    sea, time_s, h = sea_of(), 12.3456, 1e-5
    flow = flow_at(sea, time_s, HERE)
    later, earlier = (flow_at(sea, time_s + sign * h, HERE)[0] for sign in (1, -1))
    np.testing.assert_allclose(flow[1], (later - earlier) / (2 * h), atol=1e-7)
    for j, step in enumerate(h * np.eye(3)):
        difference = flow_at(sea, time_s, HERE + step)[0] - flow_at(sea, time_s, HERE - step)[0]
        np.testing.assert_allclose(flow[2:, j], difference / (2 * h), atol=1e-7)


def test_gusts_have_the_covariance_of_a_gauss_markov_process():
    """Mean over 16 realisations of an hour; at lag 0 its standard deviation is 1.3 % (320 correlation times each)."""
    lags, times, found = np.array([0.0, 1.0, 5.0, 15.0]), np.arange(0, 3600, 3.0), []
    for seed in range(16):
        sea = sea_of(Scenario(current=CurrentConfig(gust_mps=0.1, gust_time_s=5.0)), seed)
        here = velocities(sea, times)
        found.append([(here * velocities(sea, times + lag)).mean(axis=0) for lag in lags])
    expected = 0.1**2 * np.exp(-lags / 5.0)[:, None] * [1, 1, 0.25]
    np.testing.assert_allclose(np.mean(found, axis=0), expected, atol=0.05 * 0.1**2)


def test_the_spectrum_of_gusts_is_that_of_a_gauss_markov_process_within_ten_percent():
    """S(f) = 4 sigma^2 T / (1 + (2 pi f T)^2), one-sided; at 10 Hz, as the flow does not depend on the timestep."""
    sigma, time_s, found = 0.1, 5.0, []
    for seed in range(16):
        sea = sea_of(Scenario(current=CurrentConfig(gust_mps=sigma, gust_time_s=time_s)), seed)
        f, power = welch(velocities(sea, np.arange(0, 600, 0.1))[:, 0], 10.0, nperseg=2000)
        found.append(power)
    expected = 4 * sigma**2 * time_s / (1 + (2 * np.pi * f * time_s) ** 2)
    for low, high in ((0.02, 0.05), (0.05, 0.2), (0.2, 0.5), (0.5, 1.0)):
        band = (f >= low) & (f < high)
        assert np.mean(found, axis=0)[band].sum() == pytest.approx(expected[band].sum(), rel=0.1)


@pytest.mark.parametrize("waves", [
    WavesConfig(height_m=1.0, period_s=6, depth_m=10), WavesConfig(wind_mps=8.0, fetch_m=20_000, depth_m=10),
])  # fmt: skip
def test_the_spectrum_of_the_orbital_velocity_follows_from_that_of_the_waves(waves):
    """Within 10 % in bands of the spectrum, at a height of 1.5 m, by the transfer function of linear theory."""
    found = []
    for seed in range(40):
        series = velocities(sea_of(Scenario(waves=waves), seed), np.arange(0, 400, 0.25))[:, 0]
        f, power = welch(series, 4.0, nperseg=800)
        found.append(power)
    omega = 2 * np.pi * f[1:]
    k = wavenumbers(omega, waves.depth_m)
    transfer = omega * np.cosh(np.minimum(k * HERE[2], 300)) / np.sinh(np.minimum(k * waves.depth_m, 300))
    expected = 2 * np.pi * jonswap(waves, omega) * transfer**2
    peak = peak_radps(waves) / (2 * np.pi)
    for low, high in ((0.75, 0.95), (0.95, 1.05), (1.05, 1.6)):
        band = (f[1:] >= low * peak) & (f[1:] < high * peak)
        assert np.mean(found, axis=0)[1:][band].sum() == pytest.approx(expected[band].sum(), rel=0.1)


@pytest.mark.parametrize(("waves", "height_m", "period_s"), [
    (WavesConfig(height_m=1.0, period_s=6, depth_m=10), 1.0, 6.0),
    (WavesConfig(wind_mps=10.0, fetch_m=50_000, depth_m=100), 1.14, 4.95),
    # fully developed (Shore Protection Manual 1984): g H / U^2 = 0.2433, g T / U = 8.134
    (WavesConfig(wind_mps=5.0, fetch_m=1e6, depth_m=100), 0.2433 * 25 / 9.81, 8.134 * 5 / 9.81),
])  # fmt: skip
def test_the_components_have_the_variance_of_the_significant_height(waves, height_m, period_s):
    components = sea_of(Scenario(waves=waves)).waves.components
    variance = (0.5 * (components[:, 0] / components[:, 1]) ** 2).sum()
    assert 4 * np.sqrt(variance) == pytest.approx(height_m, rel=0.05)
    assert 2 * np.pi / peak_radps(waves) == pytest.approx(period_s, rel=0.01)


@pytest.mark.parametrize(("keys", "problem"), [
    ({"height_m": 1.0}, "waves.depth_m: missing"),
    ({"wind_mps": 8.0, "depth_m": 10}, "waves.fetch_m: missing"),
    ({"wind_mps": 8.0, "fetch_m": 1e4, "height_m": 1.0, "depth_m": 10}, "given twice"),
    ({"height_m": 4.0, "depth_m": 5.0}, "waves of 4 m break in a depth of 5 m"),
])  # fmt: skip
def test_waves_that_cannot_be_are_refused(keys, problem):
    scenario = Scenario(waves=WavesConfig(**keys))
    for rng in (None, np.random.default_rng(0)):  # checked before the flight, without random numbers, too
        with pytest.raises(TwinError, match=problem):
            make_sea(scenario, rng)


def test_wavenumbers_solve_the_dispersion_relation_from_shallow_to_deep_water():
    omega = np.geomspace(0.1, 20, 50)
    k = wavenumbers(omega, 5.0)
    np.testing.assert_allclose(9.81 * k * np.tanh(5.0 * k), omega**2, rtol=1e-12)


def test_the_flow_of_waves_is_free_of_divergence_and_rotation_and_has_no_vertical_part_at_the_floor():
    sea = sea_of(SEA.model_copy(update={"current": CurrentConfig()}))
    gradient = flow_at(sea, 7.0, HERE)[2:]
    np.testing.assert_allclose(gradient, gradient.T, atol=1e-15)
    assert abs(np.trace(gradient)) < 1e-15
    assert abs(flow_at(sea, 7.0, np.array([1.0, 2.0, 0.0]))[0, 2]) < 1e-15


def test_the_mean_current_has_the_stated_profile():
    for profile, factor in (("uniform", 1.0), ("power", 2 ** (1 / 7)), ("log", np.log(4 / 0.05) / np.log(2 / 0.05))):
        current = CurrentConfig(velocity_mps=(0.2, -0.1, 0.0), profile=profile)
        sea = sea_of(Scenario(current=current))
        np.testing.assert_allclose(mean_current_mps(sea, 4.0), factor * np.array([0.2, -0.1, 0]), rtol=1e-3)
    assert not mean_current_mps(sea, 0.04).any()


def test_a_current_file_is_interpolated_over_time_and_height(tmp_path):
    file = tmp_path / "current.csv"
    rows = [f"{t},{z},{0.1 * t + 0.2 * z},{-0.1 * z}" for t in (0, 10) for z in (0, 2)]
    file.write_text("time_s,height_m,east_mps,north_mps\n" + "\n".join(rows))
    sea = sea_of(Scenario(current=CurrentConfig(file=str(file))))
    flow = flow_at(sea, 4.0, np.array([0.0, 0.0, 0.5]))
    np.testing.assert_allclose(flow[0], [0.5, -0.05, 0], atol=1e-15)
    np.testing.assert_allclose(flow[1], [0.1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(flow[2:, 2], [0.2, -0.1, 0], atol=1e-15)


@pytest.mark.parametrize(("text", "problem"), [
    ("time_s,height_m,east_mps\n0,0,1\n", "has no column north_mps"),
    ("time_s,height_m,east_mps,north_mps\n0,0,1,nan\n", "no number in row 2"),
    ("time_s,height_m,east_mps,north_mps\n0,0,1,x\n", "cannot be read"),
    ("time_s,height_m,east_mps,north_mps\n0,0,1,1\n0,1,1,1\n1,0,1,1\n", "has 3 velocities for 2 times and 2 heights"),
    ("time_s,height_m,east_mps,north_mps\n", "has 0 velocities"),
    ("", "cannot be read"),
])  # fmt: skip
def test_a_damaged_current_file_is_refused(tmp_path, text, problem):
    file = tmp_path / "current.csv"
    file.write_text(text)
    with pytest.raises(TwinError, match=problem):
        make_sea(Scenario(current=CurrentConfig(file=str(file))))


def test_a_netcdf_file_without_its_packages_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(TwinError, match=r"current.file: needs the package xarray.*seabed-twin\[ocean\]"):
        make_sea(Scenario(current=CurrentConfig(file=str(tmp_path / "current.nc"))))


def test_a_neutral_vehicle_without_thrust_follows_an_accelerating_uniform_current():
    """A body of the density of water moves with the water, whatever its added mass."""
    scenario = Scenario(current=CurrentConfig(tide_mps=(0.3, 0.0), tide_period_h=0.11, tide_phase_deg=-90))
    vehicle = VehicleConfig(buoyancy_n=0.0, centre_of_buoyancy_m=(0, 0, 0), drag_factor=0.05)
    body = CompiledVehicle(vehicle, sea_of(scenario), np.eye(4), 1 / 120)
    body.step(np.zeros(8), 60.0)
    expected = flow_at(sea_of(scenario), 60.0, np.zeros(3))[0]
    assert expected[0] > 0.2
    np.testing.assert_allclose(body.twist_body[3:], expected, atol=1e-4)


def integrated(section, sea, start, commands, period_s):
    """Returns pose and twist after all commands by SciPy's DOP853, with dense matrices and all lags as equations."""
    hull, rov = trimmed_hull(section), parameters_of(section)
    most_rad, lag_s = (np.array([getattr(fin, key) for fin in section.fins]) for key in ("max_deg", "lag_s"))
    most_rad = np.radians(most_rad)
    numerator, denominator = rov.thruster_lag
    order, n = len(denominator) - 1, rov.thrust_configuration.shape[1]
    configuration = np.roll(rov.thrust_configuration, 3, axis=0)

    def rates(time_s, state, steady_n, commanded_rad):
        w, x, y, z = quaternion = state[3:7] / np.linalg.norm(state[3:7])
        rotation, twist, lag = geometry.rotation_from_wxyz(quaternion), state[7:13], state[13 : 13 + order * n]
        lag, angles_rad = lag.reshape(order, n), state[13 + order * n :]
        p, q, r = twist[:3]
        turning = [-x * p - y * q - z * r, w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p]
        wrench = configuration @ (numerator @ lag[-len(numerator) :])
        flow = flow_at(sea, time_s, state[:3])
        wrench = wrench + dense_fins(section, angles_rad, twist - np.append(np.zeros(3), rotation.T @ flow[0]))
        acceleration = dense_acceleration(hull, rotation, twist, flow, wrench)
        lagging = np.vstack([steady_n - denominator[1:] @ lag, lag[:-1]])
        moving = [rotation @ twist[3:], 0.5 * np.array(turning), acceleration, lagging.ravel()]
        return np.concatenate([*moving, (commanded_rad - angles_rad) / lag_s])

    at_rest = np.zeros(6 + order * n + len(section.fins))
    state = np.concatenate([start[:3, 3], geometry.quaternion_wxyz(start[:3, :3]), at_rest])
    for k, command in enumerate(commands):
        steady_n = steady_thrust_n(command[:n], rov.thrust_coefficients, rov.thrust_table)
        commanded_rad = np.zeros(len(section.fins))
        commanded_rad[most_rad > 0] = command[n:] * most_rad[most_rad > 0]
        span = k * period_s, (k + 1) * period_s
        found = solve_ivp(rates, span, state, "DOP853", args=(steady_n, commanded_rad), rtol=1e-8, atol=1e-8)
        state = found.y[:, -1]
    rotation = geometry.rotation_from_wxyz(state[3:7] / np.linalg.norm(state[3:7]))
    return geometry.pose(rotation, state[:3]), state[7:13]


@pytest.mark.long
@pytest.mark.parametrize("model", [*built_in("vehicles"), "coupled"])
def test_trajectories_agree_with_an_independent_integration(model):
    """Random thrust and angles of fins in a sheared, gusty, wavy current, 30 or 20 s: within 1 mm and 0.1 deg."""
    if model == "coupled":
        section = coupled(np.random.default_rng(3))
    else:
        section = load_scenario("quickstart", [f"vehicle.model={model}"]).vehicle
    start = geometry.pose(geometry.rotation_from_rpy(0.05, -0.02, 0.5), np.array([0.0, 0.0, 2.0]))
    n = 60 if model in ("bluerov2", "coupled") else 40
    commands = np.random.default_rng(1).uniform(-0.35, 0.35, (n, section.n_commands))
    if section.is_steered_by_fins:
        commands[:, 0] = np.abs(commands[:, 0])  # ahead, so that the fins act
    body = CompiledVehicle(section, sea_of(), start, physics_timestep_s(30.0, section))
    for command in commands:
        body.step(command, 0.5)
    pose, _ = integrated(section, sea_of(), start, commands, 0.5)
    found = geometry.log(geometry.inverse(pose) @ body.world_from_body)
    assert np.linalg.norm(pose[:3, 3] - start[:3, 3]) > 2
    assert np.linalg.norm(found[3:]) < 1e-3
    assert np.rad2deg(np.linalg.norm(found[:3])) < 0.1


def test_mujoco_and_the_compiled_loop_move_alike_in_a_moving_sea():
    compiled = CompiledVehicle(VehicleConfig(), sea_of(), np.eye(4), 1 / 120)
    mujoco = MujocoVehicle(bare_model(), VehicleConfig(), sea_of(), np.eye(4))
    for command in np.random.default_rng(2).uniform(-0.4, 0.4, (60, 8)):
        for body in (compiled, mujoco):
            body.step(command, 0.5)
    np.testing.assert_allclose(compiled.world_from_body, mujoco.world_from_body, atol=1e-8)


def test_gusts_may_be_vertical_only():
    current = CurrentConfig(gust_vertical_mps=0.3)
    gusts = gust_series(current, np.random.default_rng(1))
    assert not current.is_still and gusts[:, 2].std() == pytest.approx(0.3, rel=0.1) and not gusts[:, :2].any()


def test_other_columns_of_a_current_file_may_be_text(tmp_path):
    file = tmp_path / "current.csv"
    file.write_text("time_s,quality,height_m,east_mps,north_mps\n0,good,0,0.1,0.2\n")
    assert velocities(sea_of(Scenario(current=CurrentConfig(file=str(file)))), [0.0])[0] == pytest.approx([0.1, 0.2, 0])
