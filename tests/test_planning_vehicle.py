"""Limits of a vehicle (`twin vehicle`): closed forms, flown trajectories, published figures, command."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import twin
from twin.cli import app
from twin.controllers.tracking import control_thrusters
from twin.errors import TwinError
from twin.planning.vehicle_limits import electrical_power_w, largest_current_mps, stopping_distance_m
from twin.scenario.file import load_scenario
from twin.scenario.model import TetherConfig, VehicleConfig
from twin.simulate.autopilot import full_force_n, nominal_controller, top_speed_mps
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.hull import trimmed_hull
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import steady_current
from twin.simulate.tether import tether_of
from twin.simulate.thrusters import steady_thrust_n
from twin.world.mission import prepare

#: Power and thrust of a T200 at 14 V at a tenth, a quarter, half and all of its thrust (Blue Robotics, 2019).
T200 = ((4.5, 8.4), (11.2, 32.2), (22.2, 99.4), (44.4, 284.1))


def test_the_power_of_thrusters_is_that_of_the_makers_table():
    for thrust_n, power_w in T200:
        assert VehicleConfig().power_coefficient * thrust_n**1.5 == pytest.approx(power_w, rel=0.15)


def test_without_linear_drag_coasting_is_logarithmic():
    """m v' = -q v^2: the distance from v to v / 10 is m / q ln 10."""
    section = load_scenario("reef", ["vehicle.model=bluerov2"]).vehicle
    hull = trimmed_hull(section)
    mass_kg, q = hull.inertia[3] + hull.added_inertia[3, 3], hull.quadratic_drag[3, 3]
    assert stopping_distance_m(section, 0.5, 0.0, 0.05) == pytest.approx(mass_kg / q * np.log(10), rel=1e-5)
    assert stopping_distance_m(section, 0.5, 40.0, 0.0) < 0.5 * mass_kg * 0.25 / 40.0


@pytest.mark.parametrize("model", ["bluerov2_heavy", "bluerov2_heavy_wu", "bluerov2"])
def test_flown_at_full_thrust_the_vehicle_reaches_its_top_speed(model):
    """All horizontal thrusters push forwards with the thrust of the limit; a large inertia suppresses the pitching."""
    section = load_scenario("reef", [f"vehicle.model={model}"]).vehicle
    ahead, rov = np.array([1.0, 0.0, 0.0]), parameters_of(section)
    body = CompiledVehicle(section, steady_current(np.zeros(3)), np.eye(4), 1 / 120)
    body.state = body.state._replace(hull=body.state.hull._replace(inertia=np.array([1e9] * 3 + [section.mass_kg] * 3)))
    horizontal = rov.thrust_configuration[0] > 0.1
    per_thruster_n = full_force_n(section, ahead) / rov.thrust_configuration[0, horizontal].sum()
    command = np.linspace(0, 1, 10_001)
    thrust_n = steady_thrust_n(command, rov.thrust_coefficients, rov.thrust_table)
    body.step(horizontal * command[np.argmax(thrust_n >= per_thruster_n * (1 - 1e-6))], 60.0)
    assert body.twist_body[3] == pytest.approx(top_speed_mps(section, ahead), rel=0.01)


@pytest.mark.long
def test_the_limits_of_a_survey_follow_its_plan_and_its_current():
    still = twin.vehicle("reef")
    lateral = twin.vehicle("reef", overrides=["current.velocity_mps=[0,0.3,0]"])
    assert lateral.survey_wh > 1.3 * still.survey_wh and lateral.load > still.load
    assert still.controller == "built in"
    assert still.dives == 1 and twin.vehicle("reef", overrides=["vehicle.battery_wh=1"]).dives > 1
    rest, cruise = electrical_power_w(VehicleConfig(buoyancy_n=0.0), np.array([[0.0, 0, 0], [0.35, 0, 0]]))
    assert rest == pytest.approx(VehicleConfig().hotel_w) and cruise > rest
    assert still.hover_h == pytest.approx(0.8 * 266.0 / electrical_power_w(VehicleConfig(), np.zeros((1, 3)))[0])
    assert still.current_mps == pytest.approx(still.speeds_mps["sideways"], rel=0.02)


@pytest.mark.parametrize(("share", "holds"), [(0.9, True), (1.15, False)])
def test_the_vehicle_holds_the_current_that_is_stated_and_not_more(share, holds):
    """Flown by the controller with the true motion known, in a current from the side."""
    section, limit = VehicleConfig(), twin.vehicle("reef").current_mps
    body = CompiledVehicle(section, steady_current(np.array([0.0, share * limit, 0.0])), np.eye(4), 1 / 120)
    assert holds_its_place(body, section) == holds


def holds_its_place(body, section):
    """Returns whether the controller keeps a vehicle within 0.1 m for 30 s."""
    controller = nominal_controller(section, 1.2, 30.0)
    for _ in range(30 * 30):
        pose, twist, still = body.world_from_body, body.twist_body, np.zeros(3)
        body.step(control_thrusters(controller, pose, twist, still, still, still, 0.0), 1 / 30)
    return np.linalg.norm(body.world_from_body[:3, 3]) < 0.1


@pytest.mark.long
@pytest.mark.parametrize(("share", "holds"), [(0.93, True), (1.1, False)])
def test_the_vehicle_with_a_tether_holds_the_current_that_is_stated_and_not_more(share, holds):
    """As above, with a tether of 50 m, in a current from the side; the limit is that of the worst direction."""
    section, line = VehicleConfig(), tether_of(TetherConfig(length_m=50.0), np.zeros(3))
    free, limit = (largest_current_mps(prepare(load_scenario("reef", [f"tether.length_m={m}"]))) for m in (0.0, 50.0))
    assert limit < 0.8 * free
    sea = steady_current(np.array([0.0, share * limit, 0.0]))
    body = CompiledVehicle(section, sea, np.eye(4), 1 / 120, tether=line)
    assert holds_its_place(body, section) == holds


@pytest.mark.long
def test_a_controller_that_fails_has_no_limits():
    plugin = "control.plugin=test_planning_vehicle:NoCommand"
    with pytest.raises(TwinError, match="vehicle: control.plugin test_planning_vehicle:NoCommand: command returned"):
        twin.vehicle(load_scenario("reef", [plugin], allow_plugins=True))


class NoCommand:
    def __init__(self, setup):
        pass

    def command(self, estimate, reference):
        return np.zeros(3)


def test_the_command_prints_and_draws_the_limits(tmp_path):
    picture = tmp_path / "vehicle.png"
    shown = CliRunner().invoke(app, ["vehicle", "reef", "--out", str(picture)])
    assert shown.exit_code == 0 and "holds station in" in shown.output and picture.stat().st_size > 20_000
    found = CliRunner().invoke(app, ["vehicle", "reef", "--json", "--out", str(picture)])
    assert json.loads(found.output)["schema"] == "twin.vehicle/1"


def test_a_kinematic_vehicle_has_no_limits():
    with pytest.raises(TwinError, match="a kinematic vehicle has no forces"):
        twin.vehicle("paper_flat_motion")
