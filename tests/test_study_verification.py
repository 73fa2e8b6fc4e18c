"""A plan is recommended only if rendered surveys show its pass probability; if they fail, they improve the search."""

import json
import math
import re

import numpy as np
import pyarrow.parquet as pq
import pytest
from study_surveys import SerialEngine, study_of

from twin.app import study_command
from twin.errors import ScenarioError
from twin.scenario.file import load_scenario
from twin.studies.distribution import Distribution
from twin.studies.flight import row_of
from twin.studies.progress import StudyProgress
from twin.studies.runner import Fleet
from twin.studies.statistics import exact_interval
from twin.tuning import candidates, tuning_report
from twin.tuning.candidates import cost_index, tuning_config
from twin.tuning.correction import NO_CORRECTION, PlanRatio, correction_at, metric_ratio
from twin.tuning.rounds import tune
from twin.tuning.verification import Verification

TUNING = """
scenario = "reef"

[set]
imaging.fidelity = "surrogate"

[vary]
water.turbidity = { uniform = [5.0, 6.0] }

[sampling]
method = "lhs"
samples = 2

[tune]
objectives = ["timing.simulated_s", "map.le90_m"]
trials = 24
batch = 6
verify = 6

[tune.search]
plan.altitude_m = { uniform = [1.0, 3.0] }
plan.speed_mps = { uniform = [0.2, 0.4] }

[require]
probability = 0.5
"map.le90_m" = 0.01
"""
TINY = """
scenario = "reef"
keep = "none"

[set]
imaging.fidelity = "surrogate"
plan.area_m = [1.2, 0.8]
plan.tracks = 1
control.hold_s = 0.5
rig.frame_rate_hz = 10

[tune]
objectives = ["timing.simulated_s"]
trials = 4
batch = 4
confirm = 2
plans = 1
rounds = 0
keep = "report"

[tune.search]
plan.overlap_along = { uniform = [0.8, 0.95] }
plan.speed_mps = { uniform = [0.2, 0.4] }

[require]
probability = 0.5
"map.le90_m" = 0.02
"""
SURROGATE_LIMIT_M, RENDERED_LIMIT_M = 2.5, 1.8  # altitude up to which the error meets its limit


def flown(survey, error_m, status="complete", warning=""):
    """Returns the row of a survey whose duration falls with altitude."""
    return row_of(survey, status, "") | {
        "timing.simulated_s": 60 / survey.values["plan.altitude_m"],
        "timing.survey_s": 30.0,
        "map.le90_m": error_m,
        "map.stereo_error_m": 0.004 if is_rendered(survey) else 0.1,
        "map.pose_error_m": 0.003,
        "require.map.le90_m.passed": error_m <= 0.01,
        "warning": warning,
    }


def is_rendered(survey):
    return survey.scenario.imaging.fidelity == "rendered"


def optimistic(survey):
    """Flies a survey whose surrogate is right at low altitude and too optimistic at high altitude."""
    altitude_m = survey.values["plan.altitude_m"]
    limit_m = RENDERED_LIMIT_M if is_rendered(survey) else SURROGATE_LIMIT_M
    warning = "" if is_rendered(survey) else f"the surrogate extrapolates to {altitude_m:.2f} m"
    return flown(survey, 0.01 * (altitude_m / limit_m) ** 4, warning=warning)


def hopeless(survey):
    return flown(survey, 0.02 if is_rendered(survey) else 0.008)


def degraded(survey):
    return flown(survey, 0.005, "degraded" if is_rendered(survey) else "complete")


def search(study, folder, function=optimistic, engine=None, resume=False):
    return tune(study, folder, resume, Fleet(engine or SerialEngine(), StudyProgress(), function))


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verified")
    study = study_of(folder, TUNING)
    return study, search(study, folder / "out"), folder / "out"


def test_the_recommended_plan_passed_rendered_and_is_the_cheapest_that_did(searched):
    _, result, _ = searched
    altitude_m = result.recommended.values["plan.altitude_m"]
    assert 0.8 * RENDERED_LIMIT_M < altitude_m <= RENDERED_LIMIT_M
    assert result.verifications[0].surrogate.values["plan.altitude_m"] > RENDERED_LIMIT_M  # the surrogate's choice
    assert not result.verifications[0].shown and result.verifications[0].surveys == 3
    chosen = result.verification(result.recommended)
    assert (chosen.n_passed, chosen.surveys, chosen.probability) == (6, 6, exact_interval(6, 6))
    shown = [v.surrogate.objectives[0] for v in result.verifications if v.shown]
    assert result.recommended.objectives[0] == min(shown)


def quick_when_rendered(survey):
    """Flies a survey that always passes, is more accurate at low altitude and takes half as long when rendered."""
    row = flown(survey, 0.003 * survey.values["plan.altitude_m"])
    return row | {"timing.simulated_s": row["timing.simulated_s"] * (0.5 if is_rendered(survey) else 1.0)}


def test_a_plan_that_is_more_expensive_than_a_verified_one_is_not_flown_rendered(tmp_path):
    """The correction halves the costs near the verified plan: half the cost of a plan is less than its full cost."""
    result = search(study_of(tmp_path, TUNING), tmp_path / "out", quick_when_rendered)
    costs_s = [verification.surrogate.objectives[0] for verification in result.verifications]
    assert costs_s and max(costs_s) == costs_s[0]


def test_no_cheaper_plan_of_the_final_front_is_left_untried(searched):
    """A cheaper plan of the corrected front would have been flown next, unless the number of plans was reached."""
    study, result, _ = searched
    config = tuning_config(study)
    cheaper = [c for c in result.candidates if c.shortfall <= 0 and c.objectives[0] < result.recommended.objectives[0]]
    in_round = [v.search_round for v in result.verifications]
    assert not cheaper or in_round.count(max(in_round)) == config.plans


def test_the_table_distinguishes_rendered_from_surrogate_surveys(searched):
    _, result, folder = searched
    table = pq.read_table(folder / "results.parquet").to_pylist()
    rendered = [row for row in table if row["fidelity"] == "rendered"]
    assert len(rendered) == sum(v.surveys for v in result.verifications) + result.start.surveys
    assert {row["fidelity"] for row in table} == {"rendered", "surrogate"}
    seeds = {row["seed"] for row in rendered}
    assert len(seeds) == 6 and not seeds & {row["seed"] for row in table if row["fidelity"] == "surrogate"}


def test_both_figures_and_all_warnings_reach_headline_page_scenario_and_json(searched):
    _, result, folder = searched
    headline = tuning_report.headline(result)
    target = "height error on 90 % of the mapped cells (LE90) at most 1.0 cm"
    assert (
        f"6 of 6 simulated surveys with rendered images reached the target: {target}; with 95 %"
        in headline.splitlines()[0]
    )
    assert "; with 95 % confidence at least 54.1 % pass, 50 % required." in headline.splitlines()[0]
    limits = headline.partition("What limits it, and what reduces that? ")[2]
    assert limits.startswith("Noise of the stereo matching (contrast, ") and "stated as 4.0 mm, 64 % of the" in limits
    assert "Errors of the camera poses, stated as 3.0 mm, 36 % of the variance. Less with more sidelap" in limits
    assert f"if it reaches its end, no check of the estimators fails, and it keeps the target: {target}." in headline
    assert "only turbidity 5 to 6 was varied. Beyond that" in headline
    median = result.verification(result.recommended).medians["map.le90_m"]
    assert f"{1e3 * median[1]:.1f} mm ({1e3 * median[0]:.1f} mm)" in headline.replace("1.0 cm", "10.0 mm")
    tuning_report.write_tuning_report(result, folder)
    warnings = tuning_report.warnings(result)
    assert any("the surrogate extrapolates to" in text for text in warnings)
    assert any(
        "the surrogate is wrong about the height error on 90 % of the mapped cells (LE90)" in text for text in warnings
    )
    summary = tuning_report.summary(result)
    assert json.loads(json.dumps(summary, allow_nan=False))["warnings"] == warnings
    assert summary["recommended"]["shown"]
    page, scenario = (folder / "tuning.html").read_text(), (folder / "recommended.toml").read_text()
    for text in warnings:
        assert f"# Warning: {text}" in scenario
    assert page.count("<b>Warning:</b>") == len(warnings)
    assert "Plans with rendered surveys" in page
    assert page.index("starting plan") < page.index("mapped cells (LE90) (3 of 3)") < page.index("<img")
    assert '<span title="plan.altitude_m">height above the reference plane</span>' in page
    keys = re.sub(r"<code>.*?</code>|<pre>.*?</pre>|title=\".*?\"|data:image.*?\"", "", page, flags=re.DOTALL)
    assert "plan.altitude_m" not in keys and "map.le90_m" not in keys  # in words


def test_if_no_plan_passes_rendered_nothing_is_recommended_after_the_stated_rounds(tmp_path):
    study = study_of(tmp_path, TUNING)
    result = search(study, tmp_path / "out", hopeless)
    assert result.recommended is None
    assert {v.search_round for v in result.verifications} <= {0, 1, 2}
    assert 1 <= len(result.verifications) <= 9
    headline = tuning_report.headline(result)
    assert "at most 1.0 cm; 0 of " in headline and result.unproven is None
    assert "widen [tune.search] towards lower altitude" in headline
    assert tuning_report.summary(result)["recommended"] is None


def test_a_degraded_survey_does_not_pass(tmp_path):
    assert search(study_of(tmp_path, TUNING), tmp_path / "out", degraded).recommended is None


def test_further_rounds_search_where_the_corrected_surrogate_expects_plans_to_pass(tmp_path):
    """The first search knows plans above the rendered limit only; a further round goes below it."""

    def surrogate_fails_low(survey):  # the only plans that pass with the surrogate are far too high at first
        altitude_m = survey.values["plan.altitude_m"]
        limit_m = 1.7 if is_rendered(survey) else 2.9
        return flown(survey, 0.01 * (altitude_m / limit_m) ** 3)

    study = study_of(tmp_path, TUNING, ("trials = 24", "trials = 6\nplans = 1\nrounds = 8"))
    result = search(study, tmp_path / "out", surrogate_fails_low)
    rounds = [v.search_round for v in result.verifications]
    assert rounds == sorted(rounds) and max(rounds) > 0
    assert result.recommended.values["plan.altitude_m"] <= 1.7
    assert len({c.number for c in result.candidates}) == len(result.candidates) == 6 + 6 * max(rounds)


@pytest.mark.parametrize("stop_before", [30, 60, 75])
def test_an_interrupted_verification_ends_with_the_same_plans(searched, tmp_path, stop_before):
    study, whole, _ = searched
    engine, again = SerialEngine(stop_before), SerialEngine()
    stopped = search(study, tmp_path / "out", engine=engine)
    assert stopped.interrupted and stopped.recommended is None
    result = search(study, tmp_path / "out", engine=again, resume=True)
    assert result == whole
    assert not set(engine.flown) & set(again.flown)


@pytest.mark.parametrize(("verify", "flown"), [(0, 0), (4, 4)])
def test_a_plan_that_too_few_rendered_surveys_show_is_not_recommended_but_named(tmp_path, verify, flown):
    study = study_of(tmp_path, TUNING, ("verify = 6", f"verify = {verify}"))
    result = search(study, tmp_path / "out", flown_well)
    assert result.recommended is None and result.unproven is not None
    assert sum(v.surveys for v in result.verifications) == flown
    headline = tuning_report.headline(result)
    assert headline.startswith(
        "No plan is recommended: none is shown to reach the target in 50 % of rendered surveys: "
    )
    assert "at most 1.0 cm. The closest one: Fly " in headline
    assert ("4 of 4 rendered surveys passed" in headline and "lower bound 39.8 %" in headline) == (flown > 0)
    assert ("6 are needed if none fails" in headline) == (flown > 0)
    if flown:
        tuning_report.write_tuning_report(result, tmp_path / "out")
        assert not (tmp_path / "out" / "recommended.toml").exists()
        assert load_scenario(tmp_path / "out" / "candidate.toml").plan.altitude_m
        assert "no plan is shown to pass" in (tmp_path / "out" / "tuning.html").read_text()


def flown_well(survey):
    return flown(survey, 0.004)


def test_the_plan_is_compared_with_the_starting_plan_and_the_next_cheaper_one_that_failed(searched):
    _, result, _ = searched
    names = [row.name for row in tuning_report.compared_plans(result)]
    assert names == ["starting plan", "recommended", "next cheaper, not shown"]
    start, failed = result.start, result.failed_cheaper
    assert start.surveys == 3 and start.surrogate.values["plan.altitude_m"] == load_scenario("reef").plan.altitude_m
    assert failed.surrogate.objectives[0] < result.recommended.objectives[0]
    assert failed.why_not() == "requirement not met: map.le90_m (3 of 3)"


@pytest.mark.parametrize(("rate", "most"), [(0.9, 0.07), (0.85, 0.01)])
def test_a_plan_below_the_required_probability_is_rarely_shown(rate, most):
    """Looked at after 3, 6, 12, ... surveys: three looks can show 90 %, each wrongly in at most 2.5 % of plans."""
    rng, shown = np.random.default_rng(0), 0
    plan = Verification(None, 0.9, 70, 0, 0, 0, {}, None, 0, {}, {})
    for _ in range(1000):
        passed, found = np.cumsum(rng.random(70) < rate), plan
        while (n := found.next_surveys()) > found.surveys:
            found = found._replace(surveys=n, n_passed=int(passed[n - 1]))
        shown += found.shown
    assert shown / 1000 <= most + 3 * np.sqrt(most / 1000)


def test_the_budget_ends_a_search_with_what_was_flown_and_resume_continues_it(tmp_path, monkeypatch):
    """The clock advances by one second per rendered survey."""
    study, clock = study_of(tmp_path, TUNING), [0.0]
    monkeypatch.setattr("time.time", lambda: clock[0])

    def ticking(survey):
        clock[0] += is_rendered(survey)
        return flown_well(survey)

    result = tune(study, tmp_path / "out", False, Fleet(SerialEngine(), StudyProgress(), ticking, end_s=4.0))
    assert result.out_of_time and result.recommended is None and not result.interrupted
    assert result.verification(result.unproven).surveys == 4
    assert "The budget was used up; --resume continues." in tuning_report.headline(result)
    resumed = tune(study, tmp_path / "out", True, Fleet(SerialEngine(), StudyProgress(), ticking))
    assert resumed.recommended.values == result.unproven.values and not resumed.out_of_time


@pytest.mark.parametrize(("given", "kept"), [("", "metrics"), ('keep = "report"\n', "report")])
def test_the_expected_time_is_printed_before_and_the_run_folders_are_kept_on_request(tmp_path, capsys, given, kept):
    kept_of = []

    def fly(survey):
        kept_of.extend([survey.keep] if is_rendered(survey) else [])
        return optimistic(survey)

    study = study_of(tmp_path, TUNING, ("verify = 6", f"{given}verify = 6"))
    search(study, tmp_path / "out", fly)
    lines = capsys.readouterr().err.splitlines()
    assert "rendered: 6 surveys show that 50 % pass, if none fails" in lines[0] and "(a rough estimate)" in lines[0]
    assert "0 of 3 rendered surveys passed; 50 % is not shown" in lines[1]
    assert "(as measured)" in lines[2]
    assert set(kept_of) == {kept}


def test_plans_outside_the_fit_of_the_surrogate_are_not_recommended_and_are_reported(tmp_path):
    """The surrogate refuses altitudes above 2 m, where it would be right."""
    reason = "imaging.fidelity: the error model does not hold for {:.2f} m (allowed: up to 2 m, or --extrapolate)"

    def refusing(survey):
        altitude_m = survey.values["plan.altitude_m"]
        if altitude_m > 2 and not is_rendered(survey):
            return row_of(survey, "refused", reason.format(altitude_m))
        return flown(survey, 0.005)

    study = study_of(tmp_path, TUNING)
    result = search(study, tmp_path / "out", refusing)
    n_refused = sum(c.values["plan.altitude_m"] > 2 for c in result.candidates)
    assert n_refused and list(result.refused.values()) == [n_refused]
    assert result.recommended.values["plan.altitude_m"] <= 2
    (text,) = (text for text in tuning_report.warnings(result) if "could not be flown" in text)
    assert text.startswith(f"{n_refused} of {len(result.candidates)} plans") and "--extrapolate" in text


def test_a_plan_whose_scenario_is_not_valid_is_refused_and_not_flown(tmp_path, monkeypatch):
    """Altitudes above 2 m are invalid, as if by their combination with another key: the bounds are checked before."""
    scenario_of_sample = candidates.scenario_of_sample

    def valid_up_to_2_m(study, base, sample):
        if sample.values["plan.altitude_m"] > 2:
            raise ScenarioError(["study.toml:20: tune.search.plan.altitude_m: not allowed"])
        return scenario_of_sample(study, base, sample)

    monkeypatch.setattr(candidates, "scenario_of_sample", valid_up_to_2_m)
    study, values = study_of(tmp_path, TUNING), {"plan.altitude_m": 2.5, "plan.speed_mps": 0.3}
    surveys = candidates.CandidateSurveys(study, tmp_path, ())
    assert list(surveys.missing({0: values})) == []
    assert {score.status for score in surveys.scores(0, values)} == {"refused"}
    assert surveys.evaluate(0, values).pass_probability.value == 0.0
    assert len(list(surveys.missing({1: values | {"plan.altitude_m": 1.5}}))) == 2


def test_the_command_line_overrides_the_number_of_rendered_surveys(tmp_path, monkeypatch, capsys):
    study_of(tmp_path, TUNING)
    used = []

    def fake(study, *_):
        used.append(study.tune.verify)
        raise KeyboardInterrupt

    monkeypatch.setattr(study_command.rounds, "tune", fake)
    with pytest.raises(KeyboardInterrupt):
        study_command.tune(str(tmp_path / "study.toml"), study_command.StudyOptions(tmp_path / "out", 1, verify=0))
    assert used == [0]


SEARCH = {"a": Distribution(uniform=(0.0, 4.0)), "b": Distribution(log_uniform=(1.0, 100.0))}


def test_the_correction_is_close_to_the_ratio_of_a_flown_plan_and_vanishes_far_away():
    plan = PlanRatio({"a": 0.0, "b": 1.0}, {"map.le90_m": 9.0}, 1.0)
    at, near, far = (
        correction_at(SEARCH, [plan], {"a": a, "b": b}).factors["map.le90_m"] for a, b in ((0, 1), (0.4, 1.5), (4, 100))
    )
    weight = 1 / (1 + math.exp(-2.0))
    assert at == pytest.approx(9.0**weight)
    assert at > near > far
    assert far == pytest.approx(1.0, abs=1e-6)
    assert correction_at(SEARCH, [], plan.values) is NO_CORRECTION


def test_a_plan_that_was_not_completed_lowers_the_pass_fraction_near_it():
    plan = PlanRatio({"a": 0.0, "b": 1.0}, {}, 0.0)
    assert correction_at(SEARCH, [plan], plan.values).pass_factor < 0.15
    assert correction_at(SEARCH, [plan], {"a": 4.0, "b": 100.0}).pass_factor > 0.999


@pytest.mark.parametrize(
    ("metric", "rendered", "surrogate", "ratio"),
    [
        ("map.le90_m", 0.03, 0.01, 3.0),
        ("map.completeness", 0.4, 0.8, 0.5),
        ("map.le90_m", None, 0.01, 10.0),
        ("map.completeness", None, 0.8, 0.1),
        ("map.le90_m", math.inf, 0.01, 10.0),
        ("map.le90_m", 5.0, 0.01, 100.0),
        ("map.le90_m", 0.03, None, 1.0),
        ("map.bias_m", -0.01, 0.01, 1.0),
    ],
)
def test_the_ratio_of_a_metric_is_limited_and_bad_where_the_rendered_value_is_missing(
    metric, rendered, surrogate, ratio
):
    assert metric_ratio(metric, rendered, surrogate) == pytest.approx(ratio)


@pytest.mark.parametrize(
    ("objectives", "cost"),
    [
        ('["map.le90_m", "timing.simulated_s"]', "timing.simulated_s"),
        ('["timing.simulated_s", "map.le90_m"]', "timing.simulated_s"),
        ('["map.le90_m", "risk"]', "map.le90_m"),
    ],
)
def test_the_cost_is_the_first_duration_or_else_the_first_objective(tmp_path, objectives, cost):
    config = tuning_config(study_of(tmp_path, TUNING, ('["timing.simulated_s", "map.le90_m"]', objectives)))
    assert config.objectives[cost_index(config)] == cost


@pytest.mark.long
def test_a_tuned_plan_of_a_tiny_survey_is_verified_by_rendered_surveys(tmp_path):
    (tmp_path / "study.toml").write_text(TINY)
    options = study_command.StudyOptions(tmp_path / "out", jobs=2)
    assert study_command.tune(str(tmp_path / "study.toml"), options) == 0
    rows = pq.read_table(tmp_path / "out" / "results.parquet").to_pylist()
    rendered = [row for row in rows if row["fidelity"] == "rendered"]
    assert [(row["status"], row["require.map.le90_m.passed"]) for row in rendered[-1:]] == [("complete", True)]
    assert "6 of 6 rendered surveys passed" in (tmp_path / "out" / "tuning.html").read_text()
    folders = [folder for folder in (tmp_path / "out" / "runs").iterdir() if (folder / "report.html").is_file()]
    assert len(folders) == len(rendered)


def test_cheaper_plans_that_the_surrogate_rejects_are_tried_until_one_does_not_pass(tmp_path):
    """The surrogate is too pessimistic; without these plans, the recommendation would stay at its limit of 1.8 m."""

    def pessimistic(survey):
        limit_m = SURROGATE_LIMIT_M if is_rendered(survey) else RENDERED_LIMIT_M
        return flown(survey, 0.01 * (survey.values["plan.altitude_m"] / limit_m) ** 4)

    study = study_of(tmp_path, TUNING, ("verify = 6", "verify = 6\nplans = 20"))
    result = search(study, tmp_path / "out", pessimistic)
    altitude_m = result.recommended.values["plan.altitude_m"]
    assert RENDERED_LIMIT_M < altitude_m <= SURROGATE_LIMIT_M
    (rejected,) = (v.surrogate.values["plan.altitude_m"] for v in result.verifications if not v.shown)
    assert rejected > SURROGATE_LIMIT_M
    between = [c for c in result.candidates if altitude_m < c.values["plan.altitude_m"] < rejected]
    found = np.array([c.objectives for c in result.candidates])
    assert all((found < c.objectives).all(axis=1).any() for c in between)  # others are better in both objectives
