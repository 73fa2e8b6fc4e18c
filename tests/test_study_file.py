"""All errors of a study file are reported with file, line, value and what is allowed, before anything is flown."""

import pytest
from study_surveys import STUDY, study_of

from twin.errors import ScenarioError
from twin.scenario.file import load_scenario
from twin.studies.study_file import load_study
from twin.studies.surveys import refusals, surveys

TURBIDITY = "water.turbidity = { log_uniform = [1.0, 40.0] }"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("samples = 12", "sample = 12", "16: sampling.sample: unknown key (did you mean samples?)"),
        ("samples = 12", "", "14: sampling.samples: missing (allowed: a number of samples)"),
        ("samples = 12", "samples = 0", "16: sampling.samples: 0: not allowed (allowed: greater than or equal to 1)"),
        ('"lhs"', '"sobol"', "16: sampling.samples: 12 is not a power of 2 (allowed: a power of 2, e.g. 16)"),
        ('"lhs"', '"latin"', "15: sampling.method: 'latin': not allowed (allowed: 'random', 'lhs', 'sobol', 'salt"),
        ("[1.0, 40.0]", "[40.0, 1.0]", "7: vary.water.turbidity: not allowed (allowed: 0 < low < high)"),
        (
            "log_uniform",
            "lognormal",
            "7: vary.water.turbidity.lognormal: [1.0, 40.0]: not allowed (allowed: one of unif",
        ),
        ("[1.0, 40.0]", '["a", 40.0]', "7: vary.water.turbidity.log_uniform.0: 'a': not allowed (allowed: a number)"),
        (
            "[1.0, 40.0]",
            '["1.0", 40.0]',
            "7: vary.water.turbidity.log_uniform.0: '1.0': not allowed (allowed: a number",
        ),
        (TURBIDITY, "seed = { choice = [1, 2] }", "7: vary.seed: the seed cannot be set or varied here"),
        (
            '["water.jerlov", "sun',
            '["plan.altitude_m", "sun',
            "11: together.0.keys: is already given by vary.plan.altitude_m",
        ),
        ('["III", 0.0]', '["III"]', "12: together.0.rows: row 1 has 1 values (allowed: 2, one per key)"),
        (
            '"map.le90_m" = 0.02',
            '"map.le90" = 0.02',
            "20: require.map.le90: no such metric, did you mean map.le90_m",
        ),
        ("probability = 0.8", "probability = 8", "19: require.probability: 8: not allowed (allowed: 0 to 1)"),
        ("probability = 0.8", "", "3: seek: needs a required pass probability (allowed: require.probability)"),
        ('seek = "water.turbidity"', 'seek = "water.jerlov"', "3: seek: 'water.jerlov' is not a varied numeric key"),
        ('show = ["map.le90_m"]', 'show = ["map.beauty"]', "4: show: map.beauty: no such metric"),
        ('"reef"', '"nowhere"', "2: scenario: nowhere: no such scenario"),
    ],
)
def test_an_error_is_reported_with_its_line(tmp_path, old, new, message):
    with pytest.raises(ScenarioError) as error:
        study_of(tmp_path, STUDY, (old, new))
    assert any(line.startswith(f"{tmp_path / 'study.toml'}:{message}") for line in error.value.lines), error.value.lines


def test_all_errors_are_reported_together(tmp_path):
    with pytest.raises(ScenarioError) as error:
        study_of(tmp_path, STUDY, ('"lhs"', '"sobol"'), ('"map.le90_m" = 0.02', '"map.le90" = 0.02'))
    assert len(error.value.lines) == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[1.6, 2.4]", "[-2.4, -1.6]", "8: vary.plan.altitude_m: -"),
        ("plan.altitude_m = {", "plan.altitude = {", "8: vary.plan.altitude: unknown key (did you mean altitude_m?)"),
    ],
)
def test_an_error_of_all_samples_is_reported_once_at_the_line_that_gives_the_key(tmp_path, old, new, message):
    with pytest.raises(ScenarioError) as error:
        refusals(study_of(tmp_path, STUDY, (old, new)))
    line, conclusion = error.value.lines
    assert conclusion.endswith("none of the 12 samples can be flown; nothing was flown")
    assert line.startswith(f"{tmp_path / 'study.toml'}:{message}"), line
    assert "in sample" in line


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[1.6, 2.4]", "[-1.6, 2.4]", "8: vary.plan.altitude_m: -"),
        ('["III", 0.0]', '["murky", 0.0]', "11: together.0.keys: water.jerlov: 'murky': not allowed"),
    ],
)
def test_an_error_of_some_samples_refuses_these_samples_at_the_line_that_gives_the_key(tmp_path, old, new, message):
    study = study_of(tmp_path, STUDY, (old, new))
    refused = refusals(study)
    assert 0 < len(refused) < 12
    for number, reason in refused.items():
        assert reason.startswith(f"{tmp_path / 'study.toml'}:{message}"), reason
        assert reason.endswith(f"in sample {number}")
    flown = {survey.sample for survey in surveys(study, tmp_path, without=refused)}
    assert flown == set(range(12)) - set(refused)


def test_an_unknown_study_name_is_reported_with_the_known_names():
    with pytest.raises(ScenarioError, match="nothing: no such study .*turbidity"):
        load_study("nothing")


def test_surveys_have_the_values_that_the_study_sets_varies_and_requires(tmp_path):
    study = study_of(tmp_path, STUDY, ("[vary]", "[set]\nplan.tracks = 2\n[vary]"), ("samples = 12", "samples = 3"))
    base = load_scenario("reef")
    for survey in surveys(study, tmp_path):
        varied = survey.values["water.turbidity"], survey.values["plan.altitude_m"]
        assert (survey.scenario.water.turbidity, survey.scenario.plan.altitude_m) == varied
        assert survey.scenario.plan.tracks == 2
        assert survey.scenario.require == {"map.le90_m": 0.02}
        assert survey.scenario.rig == base.rig
        assert survey.scenario_hash == survey.scenario.fingerprint()


def test_file_names_are_relative_to_the_study_file(tmp_path):
    (tmp_path / "mine.toml").write_text('name = "mine"\n')
    study = study_of(
        tmp_path, STUDY, ('"reef"', '"mine.toml"'), ("[vary]", '[set]\nterrain.height_file = "a.tif"\n[vary]')
    )
    survey = next(surveys(study, tmp_path))
    assert survey.scenario.name == "mine"
    assert survey.scenario.terrain.height_file == str(tmp_path / "a.tif")
