"""Rendered surveys that check a surrogate study: which ones are flown, and when they agree."""

from itertools import islice

import numpy as np
import pytest
from study_surveys import study_of

from twin.engines.worker import Outcome
from twin.studies.analysis import StudyAnalysis
from twin.studies.flight import row_of
from twin.studies.progress import StudyProgress
from twin.studies.rendered_check import FOLDER, RenderedCheck, check, nearest_surveys, summary
from twin.studies.results_log import ResultsLog
from twin.studies.runner import Fleet
from twin.studies.surveys import refusals, surveys

STUDY = """
scenario = "reef"

[set]
imaging.fidelity = "surrogate"

[vary]
water.turbidity = { log_uniform = [1.0, 4.0] }

[sampling]
method = "random"
samples = 12

[require]
"map.le90_m" = 0.02
"map.completeness" = 0.9
"""
ERRORS_M = (0.001, 0.019, 0.05, 0.0205, 0.03, np.inf, 0.0195, 0.01, 0.0225, 0.04, 0.018, 0.021)


def row_with(survey, error_m, completeness=0.99, status="complete"):
    """Returns the row of a survey with a map of this LE90 and completeness."""
    row = row_of(survey, status, "") | {"map.le90_m": error_m, "map.completeness": completeness}
    for name, limit, met in (("map.le90_m", 0.02, error_m <= 0.02), ("map.completeness", 0.9, completeness >= 0.9)):
        row |= {f"require.{name}.limit": limit, f"require.{name}.passed": met}
    return row


def analysed(folder, completeness=(0.99,) * 12, statuses=("complete",) * 12):
    """Returns a study and its analysis: survey k has the error `ERRORS_M[k]` and these completenesses and statuses."""
    study, log = study_of(folder, STUDY), ResultsLog(folder)
    for survey, *values in zip(surveys(study, folder), ERRORS_M, completeness, statuses, strict=True):
        log.add(row_with(survey, *values))
    return study, StudyAnalysis(log.table(), study)


def test_the_surveys_closest_to_the_limits_are_flown(tmp_path):
    """At an LE90 of 19, 20.5, 19.5, 22.5, 18 and 21 mm; the limit is 20 mm."""
    _, analysis = analysed(tmp_path)
    assert nearest_surveys(analysis, 2).tolist() == [3, 6]  # equally close: in the order of the table
    assert set(nearest_surveys(analysis, 6).tolist()) == {1, 3, 6, 8, 10, 11}
    assert 5 not in nearest_surveys(analysis, 100)  # an infinite error is not close to any limit


def test_the_worst_metric_counts_and_a_lower_limit_is_missed_from_below(tmp_path):
    """Survey 0 is close to the limit of completeness alone; surveys 2, 5 and 6 miss it clearly."""
    completeness = [0.99] * 12
    completeness[0], completeness[2], completeness[5], completeness[6] = 0.9005, 0.5, 0.5, 0.5
    statuses = ["complete"] * 12
    statuses[3] = "failed"
    _, analysis = analysed(tmp_path, completeness, statuses)
    assert nearest_surveys(analysis, 3).tolist() == [0, 11, 1]


def test_a_metric_that_can_be_negative_is_as_close_to_its_limit_as_its_size(tmp_path):
    text = STUDY.replace('"map.le90_m" = 0.02', '"map.bias_m" = 0.02')
    study, log = study_of(tmp_path, text), ResultsLog(tmp_path)
    biases_m = [-0.05, -0.021, -0.019, 0.0, 0.004, 0.03, *[0.0] * 6]
    for survey, bias_m in zip(surveys(study, tmp_path), biases_m, strict=True):
        row = row_of(survey, "complete", "") | {"map.bias_m": bias_m, "map.completeness": 0.99}
        required = {"require.map.bias_m.limit": 0.02, "require.map.bias_m.passed": abs(bias_m) <= 0.02}
        log.add(row | required | {"require.map.completeness.limit": 0.9, "require.map.completeness.passed": True})
    analysis = StudyAnalysis(log.table(), study)
    assert {biases_m[k] for k in nearest_surveys(analysis, 2)} == {-0.021, -0.019}


class Calls:
    """Engine that calls a function in place of the one that flies surveys, and counts the calls."""

    def __init__(self, row_of_survey):
        self.row_of_survey, self.flown = row_of_survey, []

    def run_many(self, function, tasks, limits):
        for survey in tasks:
            self.flown.append(survey)
            yield Outcome(survey, self.row_of_survey(survey), "", 1)


def test_rendered_surveys_have_scenario_and_seed_of_their_surrogate_surveys_and_are_reused(tmp_path):
    study, analysis = analysed(tmp_path)
    engine = Calls(lambda survey: row_with(survey, 0.0199))
    checked = check(analysis, 6, tmp_path, Fleet(engine, StudyProgress()))
    originals = {survey.key: survey for survey in surveys(study, tmp_path)}
    for survey in engine.flown:
        assert survey.scenario.imaging.fidelity == "rendered"
        assert survey.folder.is_relative_to(tmp_path / FOLDER)
        original = originals[survey.key].scenario
        assert survey.scenario.model_copy(update={"imaging": original.imaging}) == original
    assert checked.rendered.tolist() == [True] * 6
    assert int(checked.surrogate.sum()) == 3  # errors of 19, 19.5 and 18 mm
    assert summary(checked)["same_verdict"] == 3
    again = Calls(lambda survey: row_with(survey, 0.0199))
    assert check(analysis, 6, tmp_path, Fleet(again, StudyProgress())).rendered.all()
    assert again.flown == []


def test_a_study_with_refused_samples_is_checked(tmp_path):
    """About half of the altitudes are negative, so that the scenarios of these samples are not valid."""
    text = STUDY.replace("water.turbidity = { log_uniform = [1.0, 4.0] }", "plan.altitude_m = { uniform = [-2, 2] }")
    study, log = study_of(tmp_path, text), ResultsLog(tmp_path)
    refused = refusals(study)
    assert 0 < len(refused) < 12
    for survey in surveys(study, tmp_path, without=refused):
        log.add(row_with(survey, 0.019))
    engine = Calls(lambda survey: row_with(survey, 0.0199))
    checked = check(StudyAnalysis(log.table(), study), 12, tmp_path, Fleet(engine, StudyProgress()))
    assert len(checked.rendered) == len(engine.flown) == 12 - len(refused)


def test_a_check_whose_rendered_surveys_all_failed_says_so(tmp_path):
    study, analysis = analysed(tmp_path)
    engine = Calls(lambda survey: row_of(survey, "failed", "disk full"))
    checked = check(analysis, 6, tmp_path, Fleet(engine, StudyProgress()))
    assert checked.exit_status == 1 and "6 rendered surveys were refused or failed" in checked.sentence()


class Interrupted(Calls):
    """Engine in which Ctrl-C is pressed after two surveys."""

    def run_many(self, function, tasks, limits):
        yield from islice(super().run_many(function, tasks, limits), 2)
        raise KeyboardInterrupt


def test_an_interrupted_check_is_marked_as_incomplete_with_the_exit_status_of_ctrl_c(tmp_path):
    study, analysis = analysed(tmp_path)
    engine = Interrupted(lambda survey: row_with(survey, 0.0199))
    checked = check(analysis, 6, tmp_path, Fleet(engine, StudyProgress()))
    assert len(checked.rendered) == 2 and checked.exit_status == 130
    assert summary(checked)["interrupted"] and "interrupted and is incomplete" in checked.sentence()
    again = Calls(lambda survey: row_with(survey, 0.0199))
    finished = check(analysis, 6, tmp_path, Fleet(again, StudyProgress()))
    assert len(again.flown) == 4 and not finished.interrupted and "incomplete" not in finished.sentence()


def test_a_study_without_limits_has_nothing_to_check_and_does_not_fail(tmp_path):
    study, log = study_of(tmp_path, STUDY[: STUDY.index("[require]")]), ResultsLog(tmp_path)
    for survey in surveys(study, tmp_path):
        log.add(row_of(survey, "complete", "") | {"map.le90_m": 0.01})
    checked = check(StudyAnalysis(log.table(), study), 6, tmp_path, Fleet(Calls(None), StudyProgress()))
    assert checked.exit_status == 0 and "the study has no limit" in checked.sentence()


@pytest.mark.parametrize(
    ("rendered", "surrogate", "agrees"), [(6, 6, True), (6, 8, True), (6, 11, False), (1, 6, False)]
)
def test_the_surrogate_agrees_if_its_pass_rate_lies_in_the_interval_of_the_rendered_one(rendered, surrogate, agrees):
    """Wilson intervals of 6 and of 1 of 12: 25 to 75 % and 1 to 35 %."""
    checked = RenderedCheck(np.arange(12) < rendered, np.arange(12) < surrogate)
    assert checked.agrees is agrees
    assert ("does not agree" in checked.sentence()) is not agrees


def test_without_surveys_near_the_limits_nothing_agrees():
    checked = RenderedCheck(np.zeros(0, bool), np.zeros(0, bool))
    assert not checked.agrees and checked.exit_status == 1 and "No survey" in checked.sentence()


def test_a_study_without_a_result_has_no_survey_to_check(tmp_path):
    assert len(nearest_surveys(StudyAnalysis(ResultsLog(tmp_path).table(), study_of(tmp_path, STUDY)), 5)) == 0
