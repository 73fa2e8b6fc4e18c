"""A search finds the plan that is best of those that pass, says how sure that is, and does not depend on its course."""

import pyarrow.parquet as pq
import pytest
import study_surveys
from study_surveys import Here, study_of

from twin.errors import ScenarioError, TwinError
from twin.scenario.file import load_scenario
from twin.study import tuning_report
from twin.study.flight import row_of
from twin.study.progress import Progress
from twin.study.statistics import wilson
from twin.study.tuning import Candidate, Flights, best, plan_of, tune

TUNING = """
scenario = "quickstart"

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
HIGHEST_M = 2.0  # from which no survey misses its limit, in the murkiest water


def fly(survey):
    """The higher, the faster and the less accurate: by the cube of altitude."""
    turbidity, altitude_m = survey.values["water.turbidity"], survey.values["plan.altitude_m"]
    error_m = 0.01 * turbidity / 6 * (altitude_m / HIGHEST_M) ** 3
    return row_of(survey, "complete", "") | {
        "timing.simulated_s": 60 / altitude_m,
        "map.le90_m": error_m,
        "require.map.le90_m.passed": error_m <= 0.01,
    }


def lose(survey):
    return row_of(survey, "aborted", study_surveys.LOST)


def search(study, folder, engine=None, resume=False, function=fly):
    return tune(study, folder, resume, engine or Here(), Progress(), function)


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuning")
    study = study_of(folder, TUNING)
    return study, search(study, folder / "out"), folder / "out"


def test_the_fastest_plan_that_still_passes_is_found(searched):
    _, tuned, _ = searched
    altitude_m = tuned.recommended.values["plan.altitude_m"]
    assert 0.93 * HIGHEST_M < altitude_m < 1.015 * HIGHEST_M  # the murkiest of eight: 5.75 to 6
    assert tuned.recommended.share == wilson(8, 8)


def test_the_recommended_plan_was_flown_afresh_in_other_water_with_other_seeds(searched):
    study, tuned, folder = searched
    table = pq.read_table(folder / "results.parquet")
    fresh = [seed > 1000 for seed in table["seed"].to_pylist()]
    assert sum(fresh) == 8 * len(tuned.finalists)
    first = set(table.filter([not f for f in fresh])["vary.water.turbidity"].to_pylist())
    assert len(first) == 2  # every plan in the same water
    assert not first & set(table.filter(fresh)["vary.water.turbidity"].to_pylist())


def test_its_scenario_reads_back_with_the_values_chosen(searched):
    study, tuned, folder = searched
    imaging = tuned.scenario.imaging.model_copy(update={"fidelity": "surrogate"})
    guessed = tuned._replace(scenario=tuned.scenario.model_copy(update={"imaging": imaging}))
    tuning_report.write_all(study, plan_of(study), guessed, folder)
    scenario = load_scenario(folder / "recommended.toml")
    assert scenario.model_dump() == tuned.scenario.model_dump()  # rendered
    assert scenario.plan.altitude_m == tuned.recommended.values["plan.altitude_m"]
    assert scenario.estimate.node_stride == tuned.recommended.values["estimate.node_stride"]
    assert scenario.water == load_scenario("quickstart").water
    page = (folder / "tuning.html").read_text()
    assert page.index("Fly plan.altitude_m = ") < page.index("<img")
    assert (folder / "pareto.png").stat().st_size > 5000


def test_a_search_that_was_interrupted_ends_with_the_same_candidates(searched, tmp_path):
    study, whole, _ = searched
    stopped = search(study, tmp_path / "out", Here(stop_before=15))
    assert stopped.interrupted
    assert stopped.recommended is None
    again = search(study, tmp_path / "out", resume=True)
    assert again.candidates == whole.candidates
    assert again.finalists == whole.finalists


@pytest.fixture
def judged(tmp_path):
    """A plan's two surveys, judged after these rows came back."""
    study = study_of(tmp_path, TUNING, ("samples = 2", "samples = 5"))
    values = {"plan.altitude_m": 1.6, "estimate.node_stride": 1}

    def judge(*changes):
        flights = Flights(study, plan_of(study), tmp_path, ())
        for survey, change in zip(flights.surveys(0, values), changes, strict=True):
            flights.keep(fly(survey) | change)
        again = [survey.key for survey in flights.missing({0: values})]
        return flights.judge(0, values), again

    return judge


def test_what_failed_says_nothing_of_a_plan_and_is_flown_again(judged):
    failed = {"status": "failed", "map.le90_m": 1.0, "require.map.le90_m.passed": False}
    candidate, again = judged({}, failed, {}, {}, {})
    assert candidate.share == wilson(4, 4)
    assert candidate.objectives[2] == 0.0  # risk
    assert len(again) == 1


def test_an_objective_is_the_median_of_what_was_complete(judged):
    errors = [{"map.le90_m": 0.001 * k} for k in (1, 2, 3, 9)]
    candidate, again = judged(*errors, {"status": "aborted", "map.le90_m": 1.0})
    assert candidate.objectives[1] == pytest.approx(0.0025)
    assert again == []


def test_a_plan_without_a_complete_survey_is_the_worst_in_every_objective(judged):
    candidate, _ = judged(*5 * [{"status": "aborted"}])
    assert not candidate.has_result
    assert candidate.objectives[:2] == (1e9, 1e9)


def test_where_more_is_better_the_worst_is_far_below(tmp_path):
    study = study_of(tmp_path, TUNING, ('"map.le90_m", "risk"', '"map.completeness", "risk"'))
    flights = Flights(study, plan_of(study), tmp_path, ())
    values = {"plan.altitude_m": 1.6, "estimate.node_stride": 1}
    for survey in flights.surveys(0, values):
        flights.keep(lose(survey))
    assert flights.judge(0, values).objectives[:2] == (1e9, -1e9)


def test_where_no_plan_passes_none_is_recommended(searched, tmp_path):
    study, *_ = searched
    tuned = search(study, tmp_path / "out", function=lose)
    assert (tuned.recommended, tuned.scenario, tuned.finalists) == (None, None, [])
    assert tuning_report.headline(study, plan_of(study), tuned).startswith(
        "No plan is recommended: 24 plans were tried"
    )
    tuning_report.write_all(study, plan_of(study), tuned, tmp_path / "out")
    assert not (tmp_path / "out" / "recommended.toml").exists()


def test_a_folder_of_another_search_is_refused(searched, tmp_path):
    study, _, folder = searched
    other = study_of(tmp_path, TUNING, ("[1.5, 3.0]", "[1.5, 2.5]"))
    with pytest.raises(TwinError, match="--resume: .* holds another search"):
        search(other, folder, resume=True)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[1.5, 3.0]", "[-1.5, 3.0]", "17: tune.search.plan.altitude_m: -1.5: not allowed"),
        ("uniform = [1.5, 3.0]", "normal = [2.0, 0.1]", "17: tune.search.plan.altitude_m: normal has no ends"),
        ('"risk"]', '"luck"]', "12: tune.objectives: luck: no such metric"),
        ("plan.altitude_m =", "water.turbidity =", "17: tune.search.water.turbidity: is given by vary.water.turbidity"),
    ],
)
def test_a_fault_of_the_search_is_told_with_its_line(tmp_path, old, new, said):
    with pytest.raises(ScenarioError) as error:
        search(study_of(tmp_path, TUNING, (old, new)), tmp_path / "out")
    assert any(line.startswith(f"{tmp_path / 'study.toml'}:{said}") for line in error.value.lines), error.value.lines


def test_a_study_without_a_search_is_refused(tmp_path):
    with pytest.raises(TwinError, match=r"there is no section \[tune\]"):
        search(study_of(tmp_path), tmp_path / "out")


def test_the_front_holds_what_no_other_beats_and_passes(tmp_path):
    def candidate(number, time_s, error_m, lack=0.0):
        return Candidate(number, {}, (time_s, error_m, 0.0), wilson(1, 1), lack)

    tried = [
        candidate(0, 10.0, 0.02),
        candidate(1, 12.0, 0.01),
        candidate(2, 12.0, 0.02),  # beaten by both
        candidate(3, 5.0, 0.001, lack=0.1),  # too risky
    ]
    assert [c.number for c in best(tried, plan_of(study_of(tmp_path, TUNING)))] == [0, 1]
