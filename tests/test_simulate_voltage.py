"""Thrust and power of a vehicle at a stated supply voltage, against the maker's data of the T200."""

import csv

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import twin
from twin.errors import ScenarioError
from twin.planning.vehicle_limits import rows
from twin.scenario.file import load_scenario
from twin.simulate.autopilot import commanded_thrusts_n, steady_thrusts_n, top_speed_mps
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.energy import electrical_power_w
from twin.simulate.sea import steady_current

AHEAD = np.array([1.0, 0.0, 0.0])
INSTALLED = 0.75  # thrust of a thruster in the vehicle / its thrust alone, see scenes/vehicles/bluerov2.toml


def at_voltage(voltage_v):
    return load_scenario("reef", ["vehicle.model=bluerov2", f"vehicle.voltage_v={voltage_v}"]).vehicle


def maker(file):
    """Returns commands, thrusts [N] and powers [W] of the maker's table."""
    with open(file) as stream:
        table = np.array(
            [[float(row[key]) for key in ("pwm_us", "thrust_N", "power_W")] for row in csv.DictReader(stream)]
        )
    return (table[:, 0] - 1500) / 400, table[:, 1], table[:, 2]


def test_at_fourteen_volts_the_vehicle_moves_as_with_its_table_without_a_voltage():
    """The table without a voltage is the maker's at 14 V; 2 s of random commands, within rounding."""
    section, bodies = load_scenario("reef", ["vehicle.model=bluerov2"]).vehicle, []
    for vehicle in (section, at_voltage(14)):
        body, rng = CompiledVehicle(vehicle, steady_current(np.zeros(3)), np.eye(4), 1 / 120), np.random.default_rng(1)
        for _ in range(20):
            body.step(rng.uniform(-1, 1, 6), 0.1)
        bodies.append(body)
    assert bodies[0].world_from_body.tobytes() != np.eye(4).tobytes()
    np.testing.assert_allclose(bodies[0].world_from_body, bodies[1].world_from_body, atol=1e-9)


@pytest.mark.parametrize("voltage_v", [10, 12, 14, 16, 18, 20])
def test_thrust_and_power_are_those_of_the_makers_table(voltage_v, outside_data):
    """At commands 0.1 apart, to 0.01 N; between them the maker's thrusts scatter by up to 0.7 N about their trend.

    Power: the mean of the five rows of the nearest thrusts; the table is linear between them, so up to 12 % above.
    """
    vehicle, (command, thrust_n, power_w) = at_voltage(voltage_v), maker(outside_data(f"t200/t200_{voltage_v}V.csv"))
    found = np.array([commanded_thrusts_n(vehicle, np.full(6, u))[0] for u in command])
    np.testing.assert_allclose(found, INSTALLED * thrust_n, atol=0.7)
    np.testing.assert_allclose(found[:100:10], INSTALLED * thrust_n[:100:10], atol=0.005)
    velocity = 0.6 * top_speed_mps(vehicle, AHEAD) * AHEAD
    thrusts = steady_thrusts_n(vehicle, velocity[None])[0]
    expected = [power_w[np.abs(INSTALLED * thrust_n - n).argsort()[:5]].mean() for n in thrusts]
    power = electrical_power_w(vehicle, velocity[None])[0]
    assert power == pytest.approx(vehicle.hotel_w + sum(expected), rel=0.12)


def test_between_two_voltages_the_thrust_at_a_command_is_bilinear():
    """Against SciPy's interpolation on a grid of commands and voltages, of those commands that both tables have."""
    low, high = (np.array(curve.table) for curve in at_voltage(15).thrust_curves[2:4])
    shared = sorted({*low[:, 0]} & {*high[:, 0]})
    grid = np.array([[dict(zip(t[:, 0], t[:, 1], strict=True))[u] for u in shared] for t in (low, high)])
    expected = RegularGridInterpolator(([14.0, 16.0], shared), grid)
    command = np.array([u for u in np.linspace(-1, 1, 81) if abs(u) >= 0.1])
    for voltage_v in (14.5, 15.9):
        vehicle = at_voltage(voltage_v)
        found = [commanded_thrusts_n(vehicle, np.full(6, u))[0] for u in command]
        np.testing.assert_allclose(found, expected([(voltage_v, u) for u in command]), atol=1e-12)


def test_without_linear_drag_the_top_speed_grows_as_the_root_of_the_thrust():
    low, high = at_voltage(12.5), at_voltage(17)
    ratio = np.divide(*(min(np.abs(commanded_thrusts_n(v, np.array([-1.0, 1.0])))) for v in (high, low)))
    assert ratio > 1.3
    assert top_speed_mps(high, AHEAD) / top_speed_mps(low, AHEAD) == pytest.approx(np.sqrt(ratio), rel=1e-9)


@pytest.mark.long
def test_the_limits_of_a_vehicle_state_the_voltage():
    stated, default = (
        twin.vehicle("reef", overrides=["vehicle.model=bluerov2", *more]) for more in (["vehicle.voltage_v=16"], [])
    )
    assert ("supply voltage", "16 V") in rows(stated) and stated.voltage_v == 16.0
    assert default.voltage_v is None and "supply voltage" not in dict(rows(default))
    assert stated.speeds_mps["forwards"] > default.speeds_mps["forwards"]


CURVE = "{ voltage_v = %g, table = [[-1.0, %g, 9.0], [0.0, 0.0, 0.0], [1.0, 5.0, 9.0]] }"
BAD = [
    ("voltage_v = 15.0", "vehicle.voltage_v: 15.0: .*of thrust_curves.*: .."),
    ('model = "bluerov2"\nvoltage_v = 9.9', r"vehicle.voltage_v: 9.9: .*10.0, 12.0, 14.0, 16.0, 18.0, 20.0"),
    ('model = "bluerov2"\nvoltage_v = 20.1', "vehicle.voltage_v: 20.1: "),
    (f"thrust_curves = [{CURVE % (12, -4)}, {CURVE % (10, -4)}]\nvoltage_v = 11.0", "voltage_v: 11.0: .*increase"),
    (f"thrust_curves = [{CURVE % (12, -4)}, {CURVE % (12, -4)}]\nvoltage_v = 12.0", "voltage_v: 12.0: .*increase"),
    (f"thrust_curves = [{CURVE % (12, 4)}]", "vehicle.thrust_curves.0.table: .*from command -1"),
    ("thrust_curves = [{ voltage_v = 12.0, table = [] }]", "vehicle.thrust_curves.0.table: .*from command -1"),
    ("thrust_curves = [{ voltage_v = 12.0, table = [[0.0, 0.0, -1.0]] }]", "thrust_curves.0.table.0.2: -1.0"),
]  # fmt: skip


@pytest.mark.parametrize(("lines", "message"), BAD)
def test_a_voltage_without_curves_and_a_wrong_curve_are_errors(tmp_path, lines, message):
    (tmp_path / "scene.toml").write_text(f'extends = "reef"\n[vehicle]\n{lines}\n')
    with pytest.raises(ScenarioError, match=message):
        load_scenario(tmp_path / "scene.toml")
