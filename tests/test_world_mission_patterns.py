"""Surveys other than the lawnmower of the ROV: loops and the paper's level motion; every scene can be planned."""

from pathlib import Path

import numpy as np
import pytest

from twin import scenes, survey
from twin.core.records import Trajectory
from twin.errors import ScenarioError, SurveyAborted, TwinError
from twin.scenario.file import load_scenario
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.world.mission import prepare
from twin.world.path_checks import check_speed

pytestmark = pytest.mark.long

SCENES = sorted(Path(scenes.__file__).parent.glob("*.toml"))
SMALL = [
    "terrain.size_m=[6.0, 6.0]",
    "rig.image_width_px=192",
    "rig.image_height_px=144",
    "rig.frame_rate_hz=15",  # half as much to render
    "plan.altitude_m=1.8",
    "control.hold_s=0.4",
    "navigation.aiding=[]",
]
LOOPS = [*SMALL, "plan.pattern=loops", "plan.area_m=[1.6, 1.6]", "plan.speed_mps=0.25", "plan.tracks=2"]
FLAT = [*SMALL, "vehicle.dynamics=kinematic", "plan.area_m=[0.8, 0.5]"]


def flown(settings, folder, outputs):
    """Flies a survey; its report has the tracks only, because all figures take longer than the flight."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin.report.survey_page.draw_all", lambda *_: {"tracks": "data:,"})
        patch.setattr("twin.report.survey_page.surface_picture", lambda *_: None)
        return survey.run(load_scenario("reef", settings), folder, outputs=outputs)


@pytest.fixture(scope="module")
def looped(tmp_path_factory):
    return flown(LOOPS, tmp_path_factory.mktemp("looped"), ("report",))


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    return flown(FLAT, tmp_path_factory.mktemp("flat"), ())


def edges(folder):
    lines = (folder / "posegraph.g2o").read_text().splitlines()
    return np.array([line.split()[1:3] for line in lines if line.startswith("EDGE")], dtype=int)


def test_loops_are_flown_and_mapped_by_vision(looped):
    m = looped.metrics
    assert m["status"] == "complete"
    assert m["trajectory"]["final"]["ate_rmse_m"] < 0.01
    assert m["control"]["cross_track_rmse_m"] < 0.05
    assert m["map"]["completeness"] > 0.9
    # neighbours are at most (1 - 0.8) of the shorter side apart, over a floor up to a third nearer than the plane
    assert m["overlap"]["across_p05"] > 1 - 0.2 * 1.5
    assert [row["track"] for row in m["tracks"]] == [1, 2]
    assert all(row["farthest_error_m"] < 0.01 for row in m["tracks"])
    assert "<th>RMSE at far end</th>" in (looped.folder / "report.html").read_text()


def test_a_loop_is_linked_with_its_own_start_and_with_the_loop_before(looped):
    mission = prepare(load_scenario("reef", LOOPS))
    n_first = sum(step.keyframe for step in mission.planned_frames(1))
    i, j = edges(looped.folder).T
    assert ((j < n_first) & (j > n_first - 4) & (i < 4)).any()  # closure
    assert ((i < n_first) & (j >= n_first)).sum() > n_first  # neighbours all around


def test_the_kinematic_vehicle_moves_in_a_plane_without_rotation_and_the_survey_is_complete(flat):
    assert flat.status == "complete"
    path = Trajectory.load(flat.folder / "trajectory_truth.tum")
    rotations = path.world_from_camera[:, :3, :3]
    np.testing.assert_allclose(rotations, np.broadcast_to(rotations[0], rotations.shape), atol=1e-8)
    np.testing.assert_allclose(path.positions[:, 2], 1.8, atol=1e-8)
    assert np.ptp(path.positions[:, 0]) == pytest.approx(0.8, abs=0.02)
    assert flat.metrics["trajectory"]["final"]["ate_rmse_m"] < 0.01
    assert flat.metrics["control"]["cross_track_rmse_m"] < 0.01


def test_a_kinematic_vehicle_has_the_commanded_horizontal_velocity():
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # bow to the north
    carrier = KinematicVehicle(pose)
    for _ in range(30):
        carrier.step(np.array([0.3, 0.6, 9.0]), 1 / 30)
    np.testing.assert_allclose(carrier.world_from_body[:3, 3], [0.3, 0.6, 0.0], atol=1e-12)
    np.testing.assert_allclose(carrier.world_from_body[:3, :3], pose[:3, :3])
    np.testing.assert_allclose(carrier.twist_body, [0, 0, 0, 0.6, -0.3, 0], atol=1e-12)
    assert carrier.time_s == pytest.approx(1)
    with pytest.raises(SurveyAborted, match=r"not finite at 1\.000 s"):
        carrier.step(np.array([np.nan, 0, 0]), 1 / 30)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["plan.area_m=[2.0, 1.0]"], "--set: plan.area_m: 2 x 1 m: loops need a square area (allowed: the disc"),
        (["plan.area_m=[7.0, 7.0]"], "--set: plan.area_m: 7 x 7 m is larger than the terrain (allowed: up to 6.00 x"),
        (["plan.altitude_m=0.7"], "--set: plan.altitude_m: 0.7: the cameras come within "),
        (
            ["plan.cross_rise_m=0.5"],
            "--set: plan.cross_rise_m: has no effect without cross lines (allowed: 0, or plan.cross_lines above 0",
        ),
        (
            ["vehicle.dynamics=kinematic", "current.velocity_mps=[0.1, 0.0, 0.0]"],
            "--set: current.velocity_mps: has no effect on a kinematic vehicle "
            '(allowed: zero, or vehicle.dynamics = "rigid")',
        ),
    ],
)
def test_an_impossible_plan_is_rejected_with_its_key(overrides, message):
    with pytest.raises(ScenarioError) as refused:
        prepare(load_scenario("reef", [*LOOPS, *overrides]))
    assert message in str(refused.value)


def test_the_speed_limit_of_loops_is_that_of_the_slowest_direction_at_the_speed_that_is_flown():
    mission = prepare(load_scenario("reef", [*LOOPS, "plan.speed_mps=0.7"]))
    assert mission.plan.speed_mps < 0.3  # of loops with a diameter of 0.8 m
    with pytest.raises(TwinError, match=r"0.7: too fast for the thrusters \(allowed: up to 0.63\)"):
        check_speed(mission.scenario.vehicle, mission.scenario.plan, 0.7)


def test_the_speed_limit_is_that_of_the_bow_and_a_kinematic_vehicle_has_none():
    lawnmower = [*SMALL, "plan.area_m=[2.0, 1.0]"]
    prepare(load_scenario("reef", [*lawnmower, "plan.speed_mps=0.7"]))
    prepare(load_scenario("reef", [*lawnmower, "plan.speed_mps=1.0", "vehicle.dynamics=kinematic"]))


@pytest.mark.parametrize("file", SCENES, ids=lambda file: file.stem)
def test_every_scene_has_a_description_and_can_be_planned(file, outside_data):
    assert file.read_text().startswith("# ")
    scenario = load_scenario(file.stem, ["terrain.texture_px_m=0.2"])  # the plan needs no fine texture
    if scenario.terrain.height_file:
        outside_data(Path(scenario.terrain.height_file).name)
    assert scenario.name == file.stem
    assert prepare(scenario).n_frames > 1000
