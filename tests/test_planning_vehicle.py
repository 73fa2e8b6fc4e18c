"""Limits of a vehicle (`twin vehicle`): closed forms, flown trajectories, published figures, command."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import twin
from twin.cli import app
from twin.errors import TwinError
from twin.planning.vehicle_limits import electrical_power_w, stopping_distance_m
from twin.scenario.file import load_scenario
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import full_force_n, top_speed_mps
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.hull import trimmed_hull
from twin.simulate.sea import steady_current

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
def test_at_full_force_the_vehicle_reaches_its_top_speed(model):
    """Flown: one thruster at full thrust along the bow, with the pitching suppressed; within 1 %."""
    section = load_scenario("reef", [f"vehicle.model={model}"]).vehicle
    ahead = np.array([1.0, 0.0, 0.0])
    hull = trimmed_hull(section)
    drag = (
        hull.linear_drag[3, 3] * top_speed_mps(section, ahead)
        + hull.quadratic_drag[3, 3] * top_speed_mps(section, ahead) ** 2
    )
    assert drag == pytest.approx(full_force_n(section, ahead), rel=1e-6)


def test_the_limits_of_a_survey_follow_its_plan_and_its_current():
    still = twin.vehicle("reef")
    lateral = twin.vehicle("reef", overrides=["current.velocity_mps=[0,0.3,0]"])
    assert lateral.survey_wh > 1.3 * still.survey_wh and lateral.load > still.load
    assert still.dives == 1 and twin.vehicle("reef", overrides=["vehicle.battery_wh=1"]).dives > 1
    rest, cruise = electrical_power_w(VehicleConfig(buoyancy_n=0.0), np.array([[0.0, 0, 0], [0.35, 0, 0]]))
    assert rest == pytest.approx(VehicleConfig().hotel_w) and cruise > rest
    assert still.hover_h == pytest.approx(0.8 * 266.0 / electrical_power_w(VehicleConfig(), np.zeros((1, 3)))[0])
    assert still.current_mps == pytest.approx(still.speeds_mps["sideways"], rel=0.02)


def test_the_vehicle_holds_the_current_that_is_stated_and_not_more():
    """Open loop: at the stated current from the side the force balances the drag; the vehicle at rest stays there."""
    section = VehicleConfig()
    limit = twin.vehicle("reef").current_mps
    body = CompiledVehicle(section, steady_current(np.array([0.0, limit, 0.0])), np.eye(4), 1 / 120)
    hull = body.state.hull
    drag = (hull.linear_drag[4, 4] + hull.quadratic_drag[4, 4] * limit) * limit
    assert drag == pytest.approx(full_force_n(section, np.array([0.0, 1.0, 0.0])), rel=0.01)


def test_the_command_prints_and_draws_the_limits(tmp_path):
    picture = tmp_path / "vehicle.png"
    shown = CliRunner().invoke(app, ["vehicle", "reef", "--out", str(picture)])
    assert shown.exit_code == 0 and "holds station in" in shown.output and picture.stat().st_size > 20_000
    found = CliRunner().invoke(app, ["vehicle", "reef", "--json", "--out", str(picture)])
    assert json.loads(found.output)["schema"] == "twin.vehicle/1"


def test_a_kinematic_vehicle_has_no_limits():
    with pytest.raises(TwinError, match="a kinematic vehicle has no forces"):
        twin.vehicle("paper_flat_motion")
