"""A study file's faults are told with file, line, value and what is allowed, all at once, before anything is flown."""

import pytest
from study_surveys import STUDY, study_of

from twin.errors import ScenarioError
from twin.scenario.file import load_scenario
from twin.study.study_file import load_study
from twin.study.surveys import check_samples, surveys

TURBIDITY = "water.turbidity = { log_uniform = [1.0, 40.0] }"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("samples = 12", "sample = 12", "16: sampling.sample: unknown key (did you mean samples?)"),
        ("samples = 12", "", "14: sampling.samples: missing (allowed: a number of samples)"),
        ("samples = 12", "samples = 0", "16: sampling.samples: 0: not allowed (allowed: greater than or equal to 1)"),
        ('"lhs"', '"sobol"', "16: sampling.samples: 12: Sobol points come in powers of 2 (allowed: as 16)"),
        ('"lhs"', '"latin"', "15: sampling.method: 'latin': not allowed (allowed: 'random', 'lhs', 'sobol', 'salt"),
        ("[1.0, 40.0]", "[40.0, 1.0]", "7: vary.water.turbidity: not allowed (allowed: above 0, low below high)"),
        (
            "log_uniform",
            "lognormal",
            "7: vary.water.turbidity.lognormal: [1.0, 40.0]: not allowed (allowed: one of unif",
        ),
        ("[1.0, 40.0]", '["a", 40.0]', "7: vary.water.turbidity.log_uniform.0: 'a': not allowed (allowed: a number)"),
        (TURBIDITY, "seed = { choice = [1, 2] }", "7: vary.seed: the seed is not varied (allowed: sampling.seeds)"),
        ('["water.jerlov", "sun', '["plan.altitude_m", "sun', "11: together.0.keys: is given by vary.plan.altitude_m"),
        ('["III", 0.0]', '["III"]', "12: together.0.rows: row 1 is 1 long (allowed: 2, a value a key)"),
        ('"map.le90_m" = 0.02', '"map.le90" = 0.02', "20: require.map.le90: no such metric, did you mean map.le90_m?"),
        ("probability = 0.8", "probability = 8", "19: require.probability: 8: not allowed (allowed: 0 to 1)"),
        ("probability = 0.8", "", "3: seek: no probability is required (allowed: require.probability)"),
        ('seek = "water.turbidity"', 'seek = "water.jerlov"', "3: seek: 'water.jerlov' does not vary as a number"),
        ('show = ["map.le90_m"]', 'show = ["map.beauty"]', "4: show: map.beauty: no such metric"),
        ('"quickstart"', '"nowhere"', "2: scenario: nowhere: no such scenario"),
    ],
)
def test_a_fault_is_told_with_its_line(tmp_path, old, new, said):
    with pytest.raises(ScenarioError) as error:
        study_of(tmp_path, STUDY, (old, new))
    assert any(line.startswith(f"{tmp_path / 'study.toml'}:{said}") for line in error.value.lines), error.value.lines


def test_all_faults_are_told_at_once(tmp_path):
    with pytest.raises(ScenarioError) as error:
        study_of(tmp_path, STUDY, ('"lhs"', '"sobol"'), ('"map.le90_m" = 0.02', '"map.le90" = 0.02'))
    assert len(error.value.lines) == 2


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[1.6, 2.4]", "[-1.6, 2.4]", "8: vary.plan.altitude_m: -"),
        ("plan.altitude_m = {", "plan.altitude = {", "8: vary.plan.altitude: unknown key (did you mean altitude_m?)"),
        ('["III", 0.0]', '["murky", 0.0]', "11: together.0.keys: water.jerlov: 'murky': not allowed"),
    ],
)
def test_a_fault_of_samples_is_told_once_where_the_study_gives_the_key(tmp_path, old, new, said):
    with pytest.raises(ScenarioError) as error:
        check_samples(study_of(tmp_path, STUDY, (old, new)))
    (line,) = error.value.lines
    assert line.startswith(f"{tmp_path / 'study.toml'}:{said}"), line
    assert "in sample" in line


def test_a_name_that_is_no_study_is_answered_with_those_there_are():
    with pytest.raises(ScenarioError, match="nothing: no such study .*turbidity"):
        load_study("nothing")


def test_surveys_are_the_scenario_with_what_is_set_varied_and_required(tmp_path):
    study = study_of(tmp_path, STUDY, ("[vary]", "[set]\nplan.tracks = 2\n[vary]"), ("samples = 12", "samples = 3"))
    base = load_scenario("quickstart")
    for survey in surveys(study, tmp_path):
        varied = survey.values["water.turbidity"], survey.values["plan.altitude_m"]
        assert (survey.scenario.water.turbidity, survey.scenario.plan.altitude_m) == varied
        assert survey.scenario.plan.tracks == 2
        assert survey.scenario.require == {"map.le90_m": 0.02}
        assert survey.scenario.rig == base.rig
        assert survey.scenario_hash == survey.scenario.fingerprint()


def test_relative_files_are_relative_to_the_study(tmp_path):
    (tmp_path / "mine.toml").write_text('name = "mine"\n')
    study = study_of(
        tmp_path, STUDY, ('"quickstart"', '"mine.toml"'), ("[vary]", '[set]\nterrain.height_file = "a.tif"\n[vary]')
    )
    survey = next(surveys(study, tmp_path))
    assert survey.scenario.name == "mine"
    assert survey.scenario.terrain.height_file == str(tmp_path / "a.tif")
