"""Conditions of a study: the sea trial adds only what study and scenario leave open, and pages name what is ideal."""

import pytest

from twin.scenario.file import read_tree
from twin.studies.conditions import condition_lines, in_sea_trial
from twin.studies.study_file import load_study
from twin.studies.surveys import samples, scenario_of_sample
from twin.tuning.candidates import rendered_of

SEARCH = """
[tune]
objectives = ["timing.simulated_s"]
search.plan.altitude_m = { uniform = [1.8, 2.2] }
"""


def study_of(folder, text):
    (folder / "study.toml").write_text('scenario = "reef"\n' + text)
    return load_study(folder / "study.toml")


def scenarios(study):
    tree = read_tree(study.scenario_file)
    return [scenario_of_sample(study, tree, sample) for sample in samples(study)]


def test_the_rendered_surveys_of_a_plan_are_flown_in_the_sea_trial(tmp_path):
    study = study_of(tmp_path, "[sampling]\nsamples = 40\n[vary]\nwater.turbidity = { uniform = [1.0, 2.0] }" + SEARCH)
    flown = scenarios(rendered_of(study))
    assert all(one.imaging.fidelity == "rendered" for one in flown)
    assert all(one.calibration_error.rotation_sigma_deg == 0.035 for one in flown)
    assert len({one.current.velocity_mps for one in flown}) > 3
    assert len({one.snow.density_per_m3 for one in flown}) > 3
    # the search itself is in calm and clear water
    assert {one.snow.density_per_m3 for one in scenarios(study)} == {0.0}


def test_conditions_that_the_study_or_its_scenario_sets_stay(tmp_path):
    (tmp_path / "own.toml").write_text('extends = "reef"\n[snow]\ndensity_per_m3 = 7.0\n')
    given = "sea_trial = true\n[set]\ncurrent.velocity_mps = [0.01, 0.0, 0.0]\n[sampling]\nsamples = 8\n"
    study = study_of(tmp_path, given).model_copy(update={"scenario": "own.toml"})
    flown = scenarios(in_sea_trial(study))
    assert {one.current.velocity_mps for one in flown} == {(0.01, 0.0, 0.0)}
    assert {one.snow.density_per_m3 for one in flown} == {7.0}


def test_a_study_without_sampled_keys_is_flown_in_one_condition(tmp_path):
    study = study_of(tmp_path, '[sampling]\nmethod = "grid"\n[vary]\nwater.turbidity = { grid = [1.0, 2.0] }' + SEARCH)
    flown = scenarios(in_sea_trial(study))
    assert len(flown) == 2 and {one.snow.density_per_m3 for one in flown} == {50.0}


@pytest.mark.parametrize(
    ("line", "sentence"),
    [("", "not in the conditions"), ("sea_trial = true\n", "All surveys are"), (SEARCH, "that verify a plan")],
)
def test_pages_name_rig_idealisations_and_sea_trial(tmp_path, line, sentence):
    lines = condition_lines(study_of(tmp_path, line))
    assert lines[0] == "Cameras: machine-vision pair, dome ports."
    ideal = [text for text in lines if "no marine snow" in text]
    assert len(ideal) == (line != "sea_trial = true\n")
    assert all(text.startswith("In the search: ") == (line == SEARCH) for text in ideal)
    assert sentence in lines[-1] and ("marine snow 0 to 200 per m3" in lines[-1]) == bool(line)
