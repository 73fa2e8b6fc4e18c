"""Surveys of a vehicle that is steered by fins: path of arcs, autopilot, refusals, and complete surveys."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from twin import survey
from twin.controllers.curves import u_turn
from twin.core import geometry
from twin.core.records import Estimate
from twin.core.settings import braking_factor
from twin.errors import ScenarioError
from twin.planning.summary import summarise
from twin.planning.vehicle_limits import rows, vehicle_limits
from twin.scenario.file import load_scenario
from twin.session.mission_actions import MissionActions
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.hull import physics_timestep_s
from twin.simulate.sea import make_sea
from twin.world.mission import prepare
from twin.world.pace import FULL
from twin.world.pilot import make_pilot

QUICK = ["imaging.fidelity=surrogate", "terrain.grid_m=0.2", "plan.overlap_reference=plane", "rig.model=ideal"]


@functools.cache
def auv(*sets):
    return prepare(load_scenario("auv", [*QUICK, *sets]))


def planned(mission):
    """Returns the references at all frames, with those between tracks."""
    parts = [
        sequence.reference
        for track in mission.tracks
        for sequence in (mission.planned_frames(track), *(mission.station_keeping_frames(track, k) for k in range(2)))
    ]
    return [np.concatenate([np.asarray(part[k]) for part in parts]) for k in range(4)]


def flown(mission, rng=None):
    """Returns the deviations (n, 3) from the path along, across and up [m], with the true motion known to the pilot."""
    rate_hz, camera, pilot = mission.rig.frame_rate_hz, mission.rig.body_from_camera, make_pilot(mission)
    to_camera, found = geometry.adjoint(geometry.inverse(camera)), []
    body = CompiledVehicle(
        mission.scenario.vehicle, make_sea(mission.scenario, rng), mission.start_of_body,
        physics_timestep_s(rate_hz, mission.scenario.vehicle), start_velocity_mps=mission.start_velocity_mps,
    )  # fmt: skip
    for position, velocity, yaw, acceleration in zip(*planned(mission), strict=True):
        reference = mission.plan.reference(1, 0.0)._replace(
            position=position, velocity=velocity, yaw=yaw, acceleration=acceleration
        )
        pose = body.world_from_body @ camera
        found.append(geometry.rotation_from_rpy(0.0, 0.0, float(yaw)).T @ (pose[:3, 3] - position))
        estimate = Estimate(0.0, pose, pose, to_camera @ body.twist_body, 0.0, "ok")
        body.step(pilot(estimate, reference), 1 / rate_hz)
    return np.array(found)


@pytest.mark.parametrize("across_m", [0.3, -0.6, 5.0, 20.0, -20.0])
def test_a_turn_ends_abreast_of_its_start_and_keeps_its_radius(across_m):
    curve = u_turn((1.0, 2.0, 3.0), 0.4, across_m, 3.5, 1.2)
    ends, times_s = curve.points()[[0, -1]], np.linspace(0, curve.profile.duration_s, 2000)
    left = np.array([-np.sin(0.4), np.cos(0.4), 0.0])
    np.testing.assert_allclose(ends[1] - ends[0], across_m * left, atol=1e-6)
    found = curve.at(times_s)
    np.testing.assert_allclose(found.yaw[-1] - 0.4, np.copysign(np.pi, across_m), atol=1e-9)
    assert np.linalg.norm(found.acceleration, axis=1).max() <= 1.2**2 / 3.5 * (1 + 1e-9)
    for value, rate in ((found.position, found.velocity), (found.velocity, found.acceleration)):
        np.testing.assert_allclose(np.gradient(value, times_s, axis=0)[2:-2], rate[2:-2], atol=2e-3)


def test_the_path_is_one_smooth_curve_over_all_tracks_at_constant_speed():
    mission = auv()
    position, velocity, yaw, _ = planned(mission)
    steps, rate_hz = np.diff(position, axis=0) * mission.rig.frame_rate_hz, mission.rig.frame_rate_hz
    assert mission.plan.n_tracks == 2 and len(position) == mission.n_frames
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 1.2, rtol=2e-3)
    np.testing.assert_allclose((velocity[1:] + velocity[:-1]) / 2, steps, atol=5e-3)
    assert np.abs(np.diff(np.unwrap(yaw))).max() * rate_hz < 1.2 / mission.plan.request.turn_radius_m * 1.001
    np.testing.assert_allclose(velocity[:, :2], 1.2 * np.column_stack([np.cos(yaw), np.sin(yaw)]), atol=1e-9)
    area = mission.plan.area
    for v in (-0.6, -0.2, 0.2, 0.6):  # every leg is flown along its whole length
        u = position[np.abs(position[:, 1] - v) < 1e-3, 0]
        assert u.min() <= -area.size_m[0] / 2 and u.max() >= area.size_m[0] / 2


def test_legs_are_numbered_without_the_turns():
    from twin.judge.swaths import swath_numbers

    mission = auv()
    position, _, yaw, _ = planned(mission)
    track = np.ones(len(yaw), np.int64)
    numbers = swath_numbers(position, yaw, track, {"pattern": "lawnmower"} | mission.plan.swath_notes)
    assert set(numbers) == {-1, 0, 1, 2, 3}
    for number, v in enumerate((-0.6, -0.2, 0.2, 0.6)):
        np.testing.assert_allclose(position[numbers == number, 1], v, atol=0.01)


@pytest.mark.parametrize(
    ("sets", "across_m"),
    [
        (("current.velocity_mps=[0.1,0.25,0]", "plan.area_m=[3.0,0.8]"), 0.25),
        pytest.param((), 0.1, marks=pytest.mark.long),
        pytest.param(("control.latency=0.2",), 0.15, marks=pytest.mark.long),
    ],
)
def test_the_autopilot_keeps_the_path_in_a_current_and_with_latency(sets, across_m):
    found = flown(auv("plan.tracks=1", *sets))
    assert np.sqrt((found[:, 1] ** 2).mean()) < across_m and np.abs(found[:, 2]).max() < 0.06
    assert np.abs(found[:, 0]).max() < 0.5


@pytest.mark.long
def test_the_autopilot_does_not_know_drag_added_mass_and_buoyancy():
    wrong = ("vehicle.drag_factor=1.4", "vehicle.added_mass_factor=0.8", "vehicle.buoyancy_n=2.0")
    found = flown(auv("plan.tracks=1", *wrong))
    assert np.sqrt((found[:, 1] ** 2).mean()) < 0.15 and np.abs(found[:, 2]).max() < 0.15


def test_without_vision_the_vehicle_goes_on_and_its_estimators_know_it():
    actions, mission = MissionActions(auv()), auv()
    pose = np.eye(4)
    lost = Estimate(0.0, pose, pose, np.zeros(6), 0.0, "too_few_points")
    assert all(actions(lost) == FULL for _ in range(300))
    assert not mission.scenario.estimator_settings().stops_if_blind
    assert braking_factor(3.0, 0.1, stops=False) == 1.0 and braking_factor(3.0, 0.1) < 1.0


@pytest.mark.long
def test_the_limits_name_minimum_speed_and_turning_radius_in_place_of_hovering():
    limits = vehicle_limits(auv())
    names = dict(rows(limits))
    assert "it cannot hover" in names["minimum speed"] and "at full rudder" in names["turning radius"]
    assert "holds station in" not in names and "at rest" not in names["endurance"]
    assert limits.minimum_speed_mps == 0.55 and 0.1 <= limits.latency_s < 1.0
    assert limits.full_rudder_radius_m < 2.2 < limits.turning_radius_m


REFUSED = [
    ("[plan]\nturns = 'reverse'", r"a.toml:3: plan.turns: 'reverse': .*neither reverse nor turn on the spot"),
    ("[plan]\nspeed_mps = 0.4", r"a.toml:3: plan.speed_mps: 0.4: too slow for the fins .*at least 0.55"),
    ("[plan]\nspeed_mps = 2.0\n[vehicle]\ndrag_factor = 2.0", r"a.toml:3: plan.speed_mps: 2: too fast"),
    ("[plan]\npattern = 'loops'", r"a.toml:3: plan.pattern: 'loops': .*bow first"),
    ("[plan]\ncross_lines = 2", r"a.toml:3: plan.cross_lines: cannot be flown"),
    (
        "[vehicle]\nthrusters = [{ position_m = [0, 0, 0], direction = [0, 1, 0] }]",
        r"vehicle.fins: .*movable fins only with thrusters that all push forwards",
    ),
    ("[plan]\nheight = 'floor'", r"a.toml:3: plan.height: cannot be flown"),
    ("[plan]\nfill_gaps = true", r"a.toml:3: plan.fill_gaps: cannot be flown"),
    ("[control]\nhold_s = 3.0", r"a.toml:3: control.hold_s: has no effect"),
    ("[control]\nheight = 'map'", r"a.toml:3: control.height: has no effect"),
    ("[vehicle]\nbuoyancy_n = 20.0", r"auv.toml:[0-9]+: plan.speed_mps: 1.2: too slow for the fins .*at least 1.8"),
    ("[current]\nvelocity_mps = [-1.4, 0.0, 0.0]", r"a.toml:3: current.velocity_mps: 1.40 m/s: .*through the water"),
    ("[[tasks]]\nname = 'a'\nposition_m = [0, 0]\nsize_m = [1, 1]\naltitude_m = 1.5", r"tasks.0: cannot be flown"),
    ("[terrain]\nsize_m = [20.0, 7.0]", r"plan.area_m: the path leaves the terrain"),
]


@pytest.mark.parametrize(("text", "message"), REFUSED)
def test_what_the_vehicle_cannot_fly_is_refused_with_its_line(tmp_path, text, message):
    (tmp_path / "a.toml").write_text(f'extends = "auv"\n{text}\n')
    with pytest.raises(ScenarioError, match=message):
        prepare(load_scenario(tmp_path / "a.toml", QUICK))


def test_arcs_need_fins_and_fins_that_can_turn():
    with pytest.raises(ScenarioError, match="plan.turns: 'arcs': the vehicle is not steered by fins"):
        prepare(load_scenario("reef", [*QUICK, "plan.turns=arcs"]))
    scenario = load_scenario("auv", QUICK)
    rudders = [fin for fin in scenario.vehicle.fins if fin.max_deg == 0 or fin.lift_direction_deg == 90]
    lame = scenario.model_copy(update={"vehicle": scenario.vehicle.model_copy(update={"fins": rudders})})
    with pytest.raises(ScenarioError, match="vehicle.fins: cannot turn the vehicle at 1.2 m/s within 100 m"):
        prepare(lame)
    elevators = [fin for fin in scenario.vehicle.fins if fin.max_deg == 0 or fin.lift_direction_deg == 0]
    lame = scenario.model_copy(update={"vehicle": scenario.vehicle.model_copy(update={"fins": elevators})})
    with pytest.raises(ScenarioError, match="vehicle.fins: cannot"):
        prepare(lame)


@pytest.mark.long
@pytest.mark.parametrize(
    "sets",
    [
        ("imaging.fidelity=surrogate",),
        ("plan.tracks=1", "plan.area_m=[2.0,0.8]", "rig.frame_rate_hz=15", "plan.overlap_along=0.75"),
    ],
)
def test_surveys_by_the_surrogate_and_rendered_are_complete(tmp_path, sets):
    metrics = survey.run(load_scenario("auv", sets), tmp_path / "run", outputs=()).metrics
    assert metrics["status"] == "complete"
    assert metrics["trajectory"]["final"]["ate_rmse_m"] < 0.04 and metrics["control"]["cross_track_rmse_m"] < 0.12


def test_the_start_points_along_the_velocity_through_the_mean_current():
    mission = auv("plan.tracks=1", "current.velocity_mps=[0.1,0.25,0]")
    yaw = geometry.rpy_from_rotation(mission.start_of_body[:3, :3])[2]
    assert yaw == pytest.approx(np.arctan2(-0.25, 1.1))
    assert auv().start_velocity_mps == pytest.approx([1.2, 0.0, 0.0])
    assert replace(mission, scenario=auv().scenario).start_of_body[1, 0] == pytest.approx(0.0)


def test_the_plan_of_a_vehicle_that_never_holds_has_no_station_keeping():
    assert summarise(auv()).hold_s == 0.0
