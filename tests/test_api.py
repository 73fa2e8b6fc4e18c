"""The functions of the package `twin`, as people write them in a notebook or a script."""

import importlib.metadata

import numpy as np
import pytest
from pydantic import ValidationError

import twin
from twin.errors import ScenarioError, TwinError

SMALL = {"area_m": np.array([0.8, 0.6]), "tracks": np.int64(1)}
FAST = {"fidelity": "surrogate"}


def test_the_package_lists_its_functions_and_version():
    assert {"run", "plan", "look", "load_run", "compare", "export", "study", "tune", "replay"} <= set(dir(twin))
    assert all(hasattr(twin, name) for name in dir(twin))
    assert twin.__version__ == importlib.metadata.version("seabed-twin")


@pytest.mark.parametrize(
    "values",
    [
        {"plan": {"tracks": 1, "area_m": (1.0, np.float32(0.5))}, "seed": np.uint32(3)},
        {"overrides": {"plan.tracks": np.int32(1), "plan.area_m": np.array([1.0, 0.5]), "seed": 3}},
        {"overrides": ["plan.tracks=1", "plan.area_m=[1.0,0.5]", "seed=3"]},
    ],
)
def test_values_are_set_by_sections_by_dotted_keys_or_by_strings(values):
    scenario = twin.load_scenario("reef", **values)
    assert (scenario.plan.tracks, scenario.plan.area_m, scenario.seed) == (1, (1.0, 0.5), 3)


def test_a_list_of_tables_and_a_requirement_can_be_set():
    pipe = {"shape": "pipe", "position_m": [0.2, 0.1], "size_m": 0.3}
    scenario = twin.load_scenario("reef", objects=[pipe], require={"map.le90_m": 0.05})
    assert (scenario.objects[0].shape, scenario.require) == ("pipe", {"map.le90_m": 0.05})


def test_a_wrong_value_is_one_line_with_the_key():
    with pytest.raises(ScenarioError, match=r"plan\.altitude_m"):
        twin.load_scenario("reef", plan={"altitude_m": -1})
    with pytest.raises(TwinError, match="keys are set already"):
        twin.plan(twin.load_scenario("reef"), seed=2)


def test_an_empty_section_is_that_of_the_defaults():
    assert twin.load_scenario("reef").imu is None
    assert twin.load_scenario("reef", imu={}).imu is not None and twin.load_scenario("reef", imu=None).imu is None


@pytest.mark.parametrize("value", [{1}, object(), [None]])
def test_a_value_that_no_file_can_have_is_one_line_with_the_key(value):
    with pytest.raises(ScenarioError, match=r"plan\.polygon: Unable to convert .*allowed: a value of TOML"):
        twin.load_scenario("reef", plan={"polygon": value})


def test_a_changed_copy_of_a_scenario_is_validated():
    scenario = twin.load_scenario("reef")
    assert scenario.model_copy(update={"seed": 7}).seed == 7 and scenario.seed != 7
    assert scenario.model_copy(update={"seed": 7}).source == scenario.source
    with pytest.raises(ValidationError, match="unknown"):
        scenario.model_copy(update={"unknown": 1})
    with pytest.raises(ValidationError):
        scenario.plan.model_copy(update={"altitude_m": -1.0})


@pytest.mark.long
def test_a_survey_returns_its_arrays_and_a_second_one_gets_its_own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = (twin.run("reef", plan=SMALL, imaging=FAST, seed=seed) for seed in (1, 2))
    assert first.folder != second.folder and first.status == "complete"
    with pytest.raises(TwinError, match="is not empty"):
        twin.run("reef", first.folder, plan=SMALL, imaging=FAST)
    table = first.to_dataframe()
    rmse_m = float(np.sqrt(np.mean(np.square(table["error_m"]))))
    assert rmse_m == pytest.approx(first.metrics["trajectory"]["final"]["ate_rmse_m"], rel=1e-3)
    assert first.maps["dem"].values.shape == first.maps["dem_sigma"].values.shape
    assert "seed 1: complete" in first._repr_html_() and "mm" in first._repr_html_()
    again = twin.load_run(first.folder)
    assert again.metrics == first.metrics and np.array_equal(again.errors_m, first.errors_m)
    assert twin.compare(first, second.folder)["runs"]
    assert twin.export(first, "tum")["tum"]
    (first.folder / "trajectory_truth.tum").unlink()
    unknown = twin.load_run(first.folder)
    assert list(unknown.to_dataframe()) == ["time_s", *(f"{name}_{a}_m" for name in ("online", "final") for a in "xyz")]
    with pytest.raises(TwinError, match="has no final or no true trajectory"):
        _ = unknown.errors_m


def test_a_plan_is_summarised_and_drawn(tmp_path):
    plan = twin.plan("reef", tmp_path / "plan.png", plan=SMALL)
    assert plan.meets_requirements and (tmp_path / "plan.png").stat().st_size > 1000


def test_a_missing_value_in_a_table_is_the_default_and_a_scenario_is_no_run():
    scenario = twin.load_scenario("reef", lamps=[{"position_m": [0.2, 0.3, 0.0], "tilt_deg": None}])
    assert len(scenario.lamps) == 1
    with pytest.raises(TwinError, match="run: is a Scenario"):
        twin.export(scenario, "csv")
