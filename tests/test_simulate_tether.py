"""Tether: closed forms of its drag, its pull where it is caught, the same in both simulations, and surveys with it."""

import numpy as np
import physics_world
import pytest

from twin import survey
from twin.core import geometry
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError
from twin.scenario.file import load_scenario
from twin.scenario.model import TetherConfig, VehicleConfig
from twin.simulate.autopilot import steady_thrusts_n
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.mujoco_vehicle import MujocoVehicle
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import steady_current
from twin.simulate.tether import add_tether, steady_pulls, tether_of
from twin.world.mission import prepare
from twin.world.rendered_world import RenderedWorld

LENGTH_M, AT = 30.0, np.array([0.5, -0.3, 2.0])
CONFIG = TetherConfig(length_m=LENGTH_M)
PER_M = 1025 * 1.2 * 0.0076 / 2


def pull(current=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), rotation=None, tether=None):
    """Returns the wrench (6,) of a tether on a vehicle whose attachment is below its upper end."""
    rotation, wrench = np.eye(3) if rotation is None else rotation, np.zeros(6)
    attachment = rotation @ CONFIG.attachment_m
    line = tether_of(CONFIG, AT + attachment) if tether is None else tether
    moving = np.array([*velocity, 0.0, 0.0, 0.0])
    add_tether(wrench, line, steady_current(np.array(current)), 0.0, rotation, AT, moving)
    return wrench


def test_half_of_the_drag_in_a_current_pulls_at_the_vehicle():
    wrench = pull(current=(0.3, -0.4, 0.0))
    np.testing.assert_allclose(wrench[3:], PER_M * 0.5 * LENGTH_M / 2 * np.array([0.3, -0.4, 0.0]), rtol=1e-9)
    np.testing.assert_allclose(wrench[:3], np.cross(CONFIG.attachment_m, wrench[3:]), rtol=1e-9)


def test_a_quarter_of_the_drag_at_its_speed_brakes_a_vehicle_in_still_water():
    wrench = pull(velocity=(0.5, 0.0, 0.0))
    assert wrench[3] == pytest.approx(-PER_M * 0.5**2 * LENGTH_M / 4, rel=0.02)
    assert pull(velocity=(0.0, 0.0, 0.4))[5] == pytest.approx(0.0, abs=1e-9)  # along the line


def test_the_wrench_is_in_the_axes_of_the_body():
    turned = geometry.so3_exp(np.array([0.0, 0.0, np.pi / 2]))
    level, rotated = pull(current=(0.3, 0.0, 0.0)), pull(current=(0.3, 0.0, 0.0), rotation=turned)
    np.testing.assert_allclose(rotated[3:], turned.T @ level[3:], atol=1e-9)


def test_a_line_that_is_caught_pulls_only_beyond_its_slack():
    line = tether_of(TetherConfig(length_m=LENGTH_M, drag_coefficient=0.0), AT)
    for away_m, newton in ((0.4, 0.0), (0.7, 40.0)):
        line.snag[:] = 1.0, *(AT + CONFIG.attachment_m - [away_m, 0.0, 0.0]), 0.5
        np.testing.assert_allclose(pull(tether=line)[3:], [-newton, 0.0, 0.0], atol=1e-9)


def test_both_simulations_feel_the_same_tether():
    model, start = physics_world.bare_model(), geometry.pose(np.eye(3), np.array([0.0, 0.0, 2.0]))
    sea, vehicle = steady_current(np.array([0.2, 0.1, 0.0])), VehicleConfig()
    lines = [tether_of(CONFIG, start[:3, 3]) for _ in range(2)]
    for line in lines:
        line.snag[:] = 1.0, 0.0, 0.0, 2.0, 0.05
    both = (
        MujocoVehicle(model, vehicle, sea, start, lines[0]),
        CompiledVehicle(vehicle, sea, start, model.opt.timestep, tether=lines[1]),
    )
    command = np.array([0.3, 0.2, 0.25, 0.3, 0.05, 0.0, -0.05, 0.1])
    for _ in range(60):
        for one in both:
            one.step(command, 1 / 30)
    np.testing.assert_allclose(both[0].world_from_body, both[1].world_from_body, atol=1e-9)


SHORT = ["imaging.fidelity=surrogate", "plan.tracks=1", "plan.area_m=[3.0,1.6]", "tether.length_m=25.0"]


def test_a_survey_with_a_tether_in_a_current_keeps_to_its_path(tmp_path):
    found = survey.run(
        load_scenario("reef", [*SHORT, "current.velocity_mps=[0.1,0.1,0.0]"]), tmp_path / "run", outputs=None
    )
    assert found.status == "complete" and found.metrics["control"]["cross_track_rmse_m"] < 0.03


def test_the_thrusters_have_to_give_what_the_tether_takes():
    """Half of the drag of the line in a current; a quarter of it at its speed: the weights 1 - s and (1 - s)^3."""
    vehicle, still, yaw = VehicleConfig(), np.zeros((1, 3)), np.array([0.0])
    line = tether_of(TetherConfig(length_m=LENGTH_M, attachment_m=(0.0, 0.0, 0.0)), np.zeros(3))
    ahead, to_force = np.array([0.3, 0.0, 0.0]), parameters_of(vehicle).thrust_configuration[0]
    for current, velocity, share in ((-ahead, still, 1 / 2), (0 * ahead, still + ahead, 1 / 4)):
        through = velocity - current
        pulls = steady_pulls(line, current, still, yaw, velocity)
        more = steady_thrusts_n(vehicle, through, pulls) - steady_thrusts_n(vehicle, through)
        assert more[0] @ to_force == pytest.approx(share * PER_M * LENGTH_M * 0.3**2, rel=0.02)  # six segments


@pytest.mark.long
def test_a_current_that_the_vehicle_holds_without_a_tether_may_be_too_strong_with_it():
    current, place = ["current.velocity_mps=[-0.47,0.0,0.0]", "plan.speed_mps=0.1"], "tether.length_m=100.0"
    prepare(load_scenario("reef", current))
    with pytest.raises(ScenarioError, match="hold station against it with its tether") as refused:
        prepare(load_scenario("reef", [*current, place]))
    limit = float(str(refused.value).split("up to ")[1].split()[0])
    prepare(load_scenario("reef", [f"current.velocity_mps=[{-0.8 * limit},0.0,0.0]", "plan.speed_mps=0.02", place]))
    with pytest.raises(ScenarioError, match="0.35: too fast for the thrusters with its tether"):
        prepare(load_scenario("reef", ["tether.length_m=900.0"]))


def test_a_tether_is_slack_where_it_is_caught():
    caught = 'faults=[{part="tether",type="stuck",start_s=0.0,size=0.1}]'
    still = ["current.velocity_mps=[0,0,0]", "tether.length_m=20.0", caught]
    with RenderedWorld(prepare(load_scenario("reef", [*SHORT, *still])), Stopwatch()) as world:
        attached = geometry.transform(world.vehicle.world_from_body, world.vehicle.tether.attachment_m)
        world.faults.at(0.0, np.zeros(3))
        world.act(np.zeros(len(world.vehicle.thrusters.factors)))
        snag = world.vehicle.tether.snag.copy()
    assert snag[0] == 1.0 and np.linalg.norm(snag[1:4] - attached) < 1e-9


def test_a_caught_tether_is_no_complete_survey(tmp_path):
    caught = 'faults=[{part="tether",type="stuck",start_s=4.0,size=0.5}]'
    found = survey.run(load_scenario("reef", [*SHORT, caught]), tmp_path / "run", outputs=None)
    assert found.status != "complete" and "tether stuck" in " ".join(found.metrics["warnings"])


@pytest.mark.parametrize(("overrides", "line"), [
    (['faults=[{part="tether",type="stuck",start_s=4.0}]'], "needs a tether"),
    (["tether.length_m=20.0", 'faults=[{part="tether",type="off",start_s=4.0}]'], "off: not simulated for tether"),
])  # fmt: skip
def test_a_tether_that_cannot_be_caught_is_refused(overrides, line):
    with pytest.raises(ScenarioError, match=line):
        prepare(load_scenario("reef", ["imaging.fidelity=surrogate", *overrides]))
