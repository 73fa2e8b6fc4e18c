"""A search finds the best feasible plan, confirms it with new seeds, and does not depend on interruptions."""

import re

import optuna
import pyarrow.parquet as pq
import pytest
import study_surveys
from study_surveys import SerialEngine, study_of

from twin.errors import ScenarioError, TwinError
from twin.scenario.file import find_scene, load_scenario
from twin.studies.flight import row_of
from twin.studies.progress import StudyProgress
from twin.studies.runner import Fleet
from twin.studies.statistics import wilson_interval
from twin.studies.surveys import refusals
from twin.tuning import tuning_report
from twin.tuning.candidates import Candidate, CandidateSurveys, confirmation_of, pareto_front, tuning_config
from twin.tuning.rounds import tune

TUNING = """
scenario = "reef"

[vary]
water.turbidity = { uniform = [4.0, 6.0] }

[sampling]
method = "lhs"
samples = 2

[tune]
objectives = ["timing.simulated_s", "map.le90_m", "risk"]
trials = 24
batch = 6

[tune.search]
plan.altitude_m = { uniform = [1.5, 3.0] }
estimate.node_stride = { choice = [1, 2] }

[require]
probability = 0.9
"map.le90_m" = 0.01
"""
HIGHEST_M = 2.0  # altitude up to which all surveys meet the limit, in the most turbid water


def fly(survey):
    """Returns a row whose duration falls with altitude, and whose error grows with its cube."""
    turbidity, altitude_m = survey.values["water.turbidity"], survey.values["plan.altitude_m"]
    error_m = 0.01 * turbidity / 6 * (altitude_m / HIGHEST_M) ** 3
    return row_of(survey, "complete", "") | {
        "timing.simulated_s": 60 / altitude_m,
        "map.le90_m": error_m,
        "require.map.le90_m.passed": error_m <= 0.01,
    }


def abort(survey):
    return row_of(survey, "aborted", study_surveys.LOST)


def search(study, folder, engine=None, resume=False, function=fly):
    return tune(study, folder, resume, Fleet(engine or SerialEngine(), StudyProgress(), function))


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuning")
    study = study_of(folder, TUNING)
    return study, search(study, folder / "out"), folder / "out"


def test_the_recommended_plan_is_the_fastest_feasible_one(searched):
    _, result, _ = searched
    altitude_m = result.recommended.values["plan.altitude_m"]
    assert 0.93 * HIGHEST_M < altitude_m < 1.015 * HIGHEST_M  # largest turbidity of eight samples: 5.75 to 6
    assert result.recommended.pass_probability == wilson_interval(8, 8)


def test_the_recommended_plan_is_confirmed_with_new_samples_and_seeds(searched):
    study, result, folder = searched
    table = pq.read_table(folder / "results.parquet")
    fresh = [1000 < seed < 2_000_000 for seed in table["seed"].to_pylist()]
    assert sum(fresh) == 8 * (len(result.finalists) + 1)  # and those of the starting plan
    first = set(table.filter([seed < 1000 for seed in table["seed"].to_pylist()])["vary.water.turbidity"].to_pylist())
    assert len(first) == 2  # all plans have the same conditions
    assert not first & set(table.filter(fresh)["vary.water.turbidity"].to_pylist())


def test_the_recommended_scenario_reads_back_with_the_chosen_values(searched):
    study, result, folder = searched
    imaging = result.scenario.imaging.model_copy(update={"fidelity": "surrogate"})
    by_surrogate = result._replace(scenario=result.scenario.model_copy(update={"imaging": imaging}))
    tuning_report.write_tuning_report(by_surrogate, folder)
    scenario = load_scenario(folder / "recommended.toml")
    assert scenario.model_dump() == result.scenario.model_dump()  # rendered
    assert scenario.plan.altitude_m == result.recommended.values["plan.altitude_m"]
    assert scenario.estimate.node_stride == result.recommended.values["estimate.node_stride"]
    assert scenario.water == load_scenario("reef").water
    page = (folder / "tuning.html").read_text()
    flown = r"Fly 1\.9\d m above the reference plane z = 0 \(1\.[34]\d m to 1\.[78]\d m above the floor\) at 0\.35 m/s"
    assert re.search(flown, page)
    assert page.index("In the scenario: <code>plan.altitude_m</code> = 1.9") < page.index("<img")
    assert (folder / "pareto.png").stat().st_size > 5000


def test_an_interrupted_search_ends_with_the_same_candidates(searched, tmp_path):
    study, whole, _ = searched
    stopped = search(study, tmp_path / "out", SerialEngine(stop_before=15))
    assert stopped.interrupted
    assert stopped.recommended is None
    again = search(study, tmp_path / "out", resume=True)
    assert again.candidates == whole.candidates
    assert again.finalists == whole.finalists


class Killed(BaseException):
    """Stands for the end of the process."""


def test_a_search_killed_while_it_chooses_a_batch_ends_with_the_same_candidates(searched, tmp_path, monkeypatch):
    study, whole, _ = searched
    asked, ask = [], optuna.Study.ask

    def ask_until_killed(self, *arguments):
        if len(asked) == 8:  # the third candidate of the second batch
            raise Killed
        asked.append(ask(self, *arguments))
        return asked[-1]

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(optuna.Study, "ask", ask_until_killed)
        search(study, tmp_path / "out")
    (tmp_path / "out" / "optuna.journal.lock").symlink_to("optuna.journal of a folder that was moved")
    assert search(study, tmp_path / "out", resume=True).candidates == whole.candidates


@pytest.fixture
def evaluate(tmp_path):
    """Returns a function that evaluates a plan of five surveys whose rows have the given changes."""
    study = study_of(tmp_path, TUNING, ("samples = 2", "samples = 5"))
    values = {"plan.altitude_m": 1.6, "estimate.node_stride": 1}

    def evaluate_plan(*changes):
        candidate_surveys = CandidateSurveys(study, tmp_path, ())
        for survey, change in zip(candidate_surveys.surveys(0, values), changes, strict=True):
            candidate_surveys.add(fly(survey) | change)
        again = [survey.key for survey in candidate_surveys.missing({0: values})]
        return candidate_surveys.evaluate(0, values), again

    return evaluate_plan


def test_a_plan_without_sampled_keys_is_confirmed_with_as_many_different_surveys(tmp_path):
    text = TUNING.replace("water.turbidity = { uniform = [4.0, 6.0] }", "").replace("samples = 2", "samples = 1")
    study = study_of(tmp_path, text)
    confirmation = CandidateSurveys(confirmation_of(study), tmp_path, ())
    surveys = list(confirmation.surveys(0, {"plan.altitude_m": 2.0, "estimate.node_stride": 1}))
    assert len({survey.scenario_hash for survey in surveys}) == len(surveys) == 4  # tune.confirm


def test_a_parameter_with_one_value_does_not_repeat_surveys_in_the_confirmation(tmp_path):
    text = TUNING.replace("{ uniform = [4.0, 6.0] }", "{ choice = [5.0] }").replace("samples = 2", "samples = 3")
    study = study_of(tmp_path, text)
    values = {"plan.altitude_m": 1.6, "estimate.node_stride": 1}
    searched = CandidateSurveys(study, tmp_path, ())
    for survey in searched.surveys(0, values):
        searched.add(fly(survey))
    assert searched.evaluate(0, values).pass_probability == wilson_interval(1, 1)  # three times the same survey
    confirmation = CandidateSurveys(confirmation_of(study), tmp_path, ())
    for survey in confirmation.surveys(0, values):
        confirmation.add(fly(survey))
    assert confirmation.evaluate(0, values).pass_probability == wilson_interval(12, 12)  # tune.confirm is 4


@pytest.mark.filterwarnings("error")  # scipy warns if a Sobol design has another number of points
@pytest.mark.parametrize(("method", "n_search"), [("sobol", 2), ("saltelli", 6), ("lhs", 2)])
@pytest.mark.parametrize("factor", [3, 4])
def test_a_plan_is_confirmed_with_a_multiple_of_the_surveys_of_the_search(method, n_search, factor, tmp_path):
    text = TUNING.replace('"lhs"', f'"{method}"').replace("trials = 24", f"confirm = {factor}")
    study = study_of(tmp_path, text)
    searched = CandidateSurveys(study, tmp_path, ())
    assert searched.n_surveys == n_search
    confirmation = CandidateSurveys(confirmation_of(study), tmp_path, ())
    surveys = list(confirmation.surveys(0, {"plan.altitude_m": 2.0, "estimate.node_stride": 1}))
    assert len({survey.scenario_hash for survey in surveys}) >= 2 * factor
    assert len(surveys) == factor * n_search


def test_a_survey_that_only_the_surrogate_refuses_may_pass_at_the_upper_bound(evaluate):
    refused = {"status": "refused", "map.le90_m": None, "require.map.le90_m.passed": None}
    known, _ = evaluate({}, {}, refused, {}, {})
    assert known.pass_probability == wilson_interval(4, 5)
    unknown, _ = evaluate({}, {}, refused | {"unmodelled": True}, {}, {})
    assert unknown.pass_probability == (0.8, wilson_interval(4, 5).low, 1.0, 1.0)
    assert unknown.shortfall == known.shortfall and unknown.least_shortfall == pytest.approx(-0.1)
    assert unknown.objectives[1] > known.objectives[1]  # an unknown error counts as infinite in the median


def test_failed_surveys_are_not_counted_and_flown_again(evaluate):
    failed = {"status": "failed", "map.le90_m": 1.0, "require.map.le90_m.passed": False}
    candidate, again = evaluate({}, failed, {}, {}, {})
    assert candidate.pass_probability == wilson_interval(4, 4)
    assert candidate.objectives[2] == 0.0  # risk
    assert len(again) == 1


def test_an_objective_is_the_median_over_completed_surveys(evaluate):
    errors = [{"map.le90_m": 0.001 * k} for k in (1, 2, 3, 9)]
    candidate, again = evaluate(*errors, {"status": "aborted", "map.le90_m": 1.0})
    assert candidate.objectives[1] == pytest.approx(0.0025)
    assert again == []


def test_a_plan_without_a_completed_survey_has_the_penalty_in_every_objective(evaluate):
    candidate, _ = evaluate(*5 * [{"status": "aborted"}])
    assert not candidate.has_metrics
    assert candidate.objectives[:2] == (1e9, 1e9)


def test_the_penalty_is_negative_for_a_metric_of_which_more_is_better(tmp_path):
    study = study_of(tmp_path, TUNING, ('"map.le90_m", "risk"', '"map.completeness", "risk"'))
    candidate_surveys = CandidateSurveys(study, tmp_path, ())
    values = {"plan.altitude_m": 1.6, "estimate.node_stride": 1}
    for survey in candidate_surveys.surveys(0, values):
        candidate_surveys.add(abort(survey))
    assert candidate_surveys.evaluate(0, values).objectives[:2] == (1e9, -1e9)


def test_no_plan_is_recommended_if_none_is_feasible(searched, tmp_path):
    study, *_ = searched
    result = search(study, tmp_path / "out", function=abort)
    assert (result.recommended, result.scenario, result.finalists) == (None, None, [])
    assert tuning_report.headline(result).startswith(
        "No plan is recommended: none reached the target in 90 % of surveys"
    )
    assert "24 plans were searched." in tuning_report.headline(result)
    tuning_report.write_tuning_report(result, tmp_path / "out")
    assert not (tmp_path / "out" / "recommended.toml").exists()


def test_a_folder_of_another_search_is_rejected(searched, tmp_path):
    study, _, folder = searched
    other = study_of(tmp_path, TUNING, ("[1.5, 3.0]", "[1.5, 2.5]"))
    with pytest.raises(TwinError, match="--resume: .* contains another search"):
        search(other, folder, resume=True)


def test_a_search_is_not_continued_with_an_edited_scenario_file(tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text(f'extends = "{find_scene("reef")}"\n')
    study = study_of(tmp_path, TUNING, ('"reef"', '"scene.toml"'))
    stopped = search(study, tmp_path / "out", SerialEngine(stop_before=15))
    assert stopped.interrupted
    file.write_text(f'extends = "{find_scene("reef")}"\n[control]\nhold_s = 0.37\n')
    with pytest.raises(TwinError, match=r"--resume: .* another scenario: .*scene\.toml was changed"):
        search(study, tmp_path / "out", resume=True)


def test_a_search_is_not_continued_if_a_file_of_another_sample_has_changed(tmp_path):
    for name, value in (("a", 0.1), ("b", 0.2)):
        (tmp_path / f"{name}.csv").write_text(f"time_s,height_m,east_mps,north_mps\n0,0,{value},0\n")
    files = f'current.file = {{ grid = ["{tmp_path / "a.csv"}", "{tmp_path / "b.csv"}"] }}\n'
    study = study_of(tmp_path, TUNING, ("[vary]\n", f"[vary]\n{files}"))
    assert search(study, tmp_path / "out", SerialEngine(stop_before=15)).interrupted
    (tmp_path / "b.csv").write_text("time_s,height_m,east_mps,north_mps\n0,0,0.25,0\n")
    with pytest.raises(TwinError, match=r"--resume: the file .*b\.csv has changed"):
        search(study, tmp_path / "out", resume=True)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[1.5, 3.0]", "[-1.5, 3.0]", "17: tune.search.plan.altitude_m: -1.5: not allowed"),
        ("uniform = [1.5, 3.0]", "normal = [2.0, 0.1]", "17: tune.search.plan.altitude_m: normal cannot be searched"),
        ('"risk"]', '"luck"]', "12: tune.objectives: luck: no such metric"),
        ('"risk"]', '"map.bias_m"]', "12: tune.objectives: map.bias_m can be negative"),
        (
            "plan.altitude_m = { uniform = [1.5, 3.0]",
            "plan.tracks = { uniform = [2, 6]",
            "17: tune.search.plan.tracks: ",
        ),
        (
            "plan.altitude_m =",
            "water.turbidity =",
            "17: tune.search.water.turbidity: is already given by vary.water.turbidity",
        ),
    ],
)
def test_an_error_of_the_search_is_reported_with_its_line(tmp_path, old, new, message):
    with pytest.raises(ScenarioError) as error:
        search(study_of(tmp_path, TUNING, (old, new)), tmp_path / "out")
    assert any(line.startswith(f"{tmp_path / 'study.toml'}:{message}") for line in error.value.lines), error.value.lines


def test_a_search_starts_although_its_first_sample_is_refused(tmp_path):
    changes = ("uniform = [4.0, 6.0]", "grid = [-4.0, 6.0]"), ('method = "lhs"\nsamples = 2', "seeds = 1")
    study = study_of(tmp_path, TUNING, *changes)
    assert list(refusals(study)) == [0]
    CandidateSurveys(study, tmp_path, ()).check_bounds()
    with pytest.raises(ScenarioError, match=r"plan.altitude_m: -1.5: not allowed"):
        other = study_of(tmp_path, TUNING, *changes, ("[1.5, 3.0]", "[-1.5, 3.0]"))
        CandidateSurveys(other, tmp_path, ()).check_bounds()


def test_a_study_without_a_search_is_rejected(tmp_path):
    with pytest.raises(TwinError, match=r"has no section \[tune\]"):
        search(study_of(tmp_path), tmp_path / "out")


def test_the_pareto_front_has_the_feasible_non_dominated_plans(tmp_path):
    def candidate(number, time_s, error_m, shortfall=0.0):
        return Candidate(number, {}, (time_s, error_m, 0.0), wilson_interval(1, 1), shortfall)

    candidates = [
        candidate(0, 10.0, 0.02),
        candidate(1, 12.0, 0.01),
        candidate(2, 12.0, 0.02),  # dominated by both
        candidate(3, 5.0, 0.001, shortfall=0.1),  # infeasible
    ]
    assert [c.number for c in pareto_front(candidates, tuning_config(study_of(tmp_path, TUNING)))] == [0, 1]
