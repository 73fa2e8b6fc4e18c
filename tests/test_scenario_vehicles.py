"""Vehicles as files: published numbers with their sources, what they can do, and errors with place and value."""

import numpy as np
import pytest

from twin import survey
from twin.errors import ScenarioError
from twin.scenario.file import load_scenario, read_toml
from twin.scenario.model import VehicleConfig
from twin.scenario.model_files import built_in
from twin.simulate.autopilot import top_speed_mps
from twin.simulate.parameters import parameters_of
from twin.world.mission import prepare

SMALL = [
    "terrain.size_m=[5.0, 4.0]", "plan.area_m=[1.0, 0.5]", "plan.tracks=1", "control.hold_s=1", "rig.model=ideal",
    "imaging.fidelity=surrogate", "imaging.extrapolate=true", "navigation.aiding=[]",
]  # fmt: skip


def vehicle(name):
    return load_scenario("reef", [f"vehicle.model={name}"]).vehicle


@pytest.mark.parametrize("name", built_in("vehicles"))
def test_every_number_of_a_vehicle_has_a_source(name):
    tree, _ = read_toml(built_in("vehicles")[name])
    named = {key.strip() for keys in tree["sources"] for key in keys.split(",")}
    assert named == set(tree["vehicle"]) and vehicle(name).title == tree["title"]


def test_the_default_vehicle_is_that_of_its_file():
    assert vehicle("bluerov2_heavy") == VehicleConfig()


@pytest.mark.parametrize(
    ("name", "speed_mps"), [("bluerov2_heavy", 0.74), ("bluerov2_heavy_wu", 2.1), ("bluerov2", 1.5)]
)
def test_the_top_speed_is_that_of_the_published_coefficients(name, speed_mps):
    """Under the thrust of four vectored thrusters; the maker states 1.0 to 1.5 m/s for the BlueROV2."""
    assert top_speed_mps(vehicle(name), np.array([1.0, 0.0, 0.0])) == pytest.approx(speed_mps, rel=0.03)


def test_eight_thrusters_control_all_six_degrees_of_freedom_and_six_all_but_pitch():
    heavy, standard = (parameters_of(vehicle(name)).thrust_configuration for name in ("bluerov2_heavy", "bluerov2"))
    assert np.linalg.matrix_rank(heavy) == 6 and np.linalg.matrix_rank(standard) == 5
    np.testing.assert_allclose(standard[4], 0.0, atol=1e-12)  # moments about the axis to the left
    # lever arm of each horizontal thruster in yaw: (0.156 + 0.111) / sqrt(2)
    np.testing.assert_allclose(np.abs(heavy[5, :4]), (0.156 + 0.111) * np.sqrt(0.5))


@pytest.mark.parametrize("name", sorted({*built_in("vehicles")} - {"auv"}))  # it needs more room: test_world_auv.py
@pytest.mark.long
def test_every_vehicle_follows_a_plan(tmp_path, name):
    overrides = [*SMALL, f"vehicle.model={name}"]
    metrics = survey.run(load_scenario("reef", overrides), tmp_path / name).metrics
    assert metrics["status"] == "complete" and metrics["control"]["cross_track_rmse_m"] < 0.03


def test_keys_of_a_scenario_change_single_values_of_a_vehicle(tmp_path):
    (tmp_path / "mine.toml").write_text('extends = "reef"\n[vehicle]\nmodel = "bluerov2"\nmass_kg = 12.0\n')
    mine = load_scenario(tmp_path / "mine.toml").vehicle
    assert mine.mass_kg == 12.0 and mine.model_copy(update={"mass_kg": 10.0}) == vehicle("bluerov2")


def test_a_vehicle_that_cannot_move_along_all_axes_is_refused():
    horizontal = [{"position_m": (0, y, 0), "direction": (1, 0, 0)} for y in (-0.1, 0.1)]
    scenario = load_scenario("reef")
    lame = scenario.model_copy(update={"vehicle": VehicleConfig.model_validate({"thrusters": horizontal})})
    with pytest.raises(ScenarioError, match=r"vehicle.thrusters: 2 thrusters cannot push along all axes"):
        prepare(lame)


ERRORS = [
    ('model = "bluerov"', r"scene.toml:3: vehicle.model: 'bluerov': no such vehicle .*bluerov2_heavy"),
    ("mass_kg = -1.0", r"scene.toml:3: vehicle.mass_kg: -1.0: not allowed \(allowed: greater than 0.1\)"),
    ("thrust_coefficients = []", r"scene.toml:3: vehicle.thrust_coefficients: .*thrust above 0"),
    ("thrusters = []", r"scene.toml:3: vehicle.thrusters: "),
    ("thrust_table = [[-1.0, -20.0], [0.5, 10.0]]", r"scene.toml:3: vehicle.thrust_table: .*from command -1"),
    ("thruster_lag = [[1.0], [0.1, -1.0]]", r"scene.toml:3: vehicle.thruster_lag: .*gain of 1"),
    ("thruster_lag = [[-1.0], [0.1, -1.0]]", r"scene.toml:3: vehicle.thruster_lag: .*stable"),
    ("thrusters = [{ position_m = [0, 0, 0], direction = [0, 0, 0] }]", r"vehicle.thrusters.0.direction: .*not zero"),
]


@pytest.mark.parametrize(("line", "message"), ERRORS)
def test_a_wrong_vehicle_is_an_error_with_its_line(tmp_path, line, message):
    (tmp_path / "scene.toml").write_text(f'extends = "reef"\n[vehicle]\n{line}\n')
    with pytest.raises(ScenarioError, match=message):
        load_scenario(tmp_path / "scene.toml")
