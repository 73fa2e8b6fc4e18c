"""Degraded surveys in studies, holes of the map in the search, and completeness with every map statistic."""

import re

import numpy as np
import pytest
from study_surveys import STUDY, fly, study_of
from test_study_report import analyse
from test_study_tuning import TUNING

from twin.judge.map_error import with_completeness
from twin.studies import flight, sentences
from twin.studies.progress import survey_line
from twin.studies.report import summary, write_report
from twin.studies.surveys import surveys
from twin.tuning import tuning_report
from twin.tuning.candidates import CandidateSurveys
from twin.tuning.rounds import TuningResult

REASON = "the stereo residuals are 3.1 px"


def half_degraded(survey):
    row = fly(survey)
    return row | {"status": "degraded", "reason": REASON} if survey.sample < 6 else row


@pytest.fixture
def study(tmp_path):
    return study_of(tmp_path, STUDY)


def test_a_degraded_survey_counts_and_does_not_pass(study, tmp_path):
    analysis = analyse(study, tmp_path, half_degraded)
    assert analysis.evaluated.all() and not analysis.passed[:6].any()
    assert analysis.pass_probability.value == analysis.passed.sum() / 12
    assert not analysis.included("map.le90_m")[:6].any()
    counts = summary(analysis, {})
    assert counts["degraded"] == 6
    assert counts["surveys"] == sum(counts[name] for name in ("complete", "degraded", "aborted", "refused", "failed"))


def test_the_report_of_a_study_names_the_reason_of_degraded_surveys(study, tmp_path, monkeypatch):
    analysis = analyse(study, tmp_path, half_degraded)
    assert {r.reason for r in analysis.failure_reasons if r.status == "degraded"} == {"the stereo residuals are … px"}
    monkeypatch.setattr("twin.studies.study_figures.draw_all", lambda *_: {}, raising=False)
    write_report(analysis, tmp_path / "study.html")
    assert re.search(r">degraded</td><td[^>]*>6</td>", (tmp_path / "study.html").read_text())


@pytest.mark.parametrize(
    ("status", "reason", "expected"),
    [
        ("degraded", REASON, "degraded"),
        ("aborted", "vision lost at 3 s", "aborted"),
        ("aborted", "interrupted", "failed"),
        ("aborted", "interrupted; map skipped", "failed"),
        ("aborted", "vision lost at 3 s; map skipped", "failed"),
        ("aborted", "[Errno 28] No space left on device", "failed"),
        ("complete", "", "complete"),
    ],
)
def test_the_row_of_a_survey_has_its_status(study, tmp_path, monkeypatch, status, reason, expected):
    metrics = {"status": status, "reason": reason, "warning": "One.", "warnings": ["One."], "map": {"le90_m": 0.01}}

    def run(scenario, folder, outputs):
        folder.mkdir(parents=True)
        return type("Result", (), {"metrics": metrics})

    monkeypatch.setattr("twin.survey.run", run)
    row = flight.fly(next(surveys(study.model_copy(update={"keep": "none"}), tmp_path)))
    assert (row["status"], row["reason"], row["warning"], row["map.le90_m"]) == (expected, reason, "One.", 0.01)
    assert flight.has_passed(row) == (expected == "complete")
    assert survey_line(row).startswith(f"sample 0, seed {row['seed']}: {expected}")


def test_a_sentence_as_a_warning_ends_with_one_full_stop(study, tmp_path):
    warned = analyse(study, tmp_path, lambda s: fly(s) | {"warning": "The surrogate extrapolates: too turbid."})
    assert sentences.headline(warned).endswith("12 of 12 surveys: The surrogate extrapolates: too turbid.")


def test_every_map_statistic_of_a_study_is_reported_with_completeness(study, tmp_path):
    assert with_completeness(["map.le90_area_m", "timing.wall_s", "map.le90_m", "map.rmse_m"]) == [
        "map.le90_area_m", "map.completeness_area", "timing.wall_s", "map.le90_m", "map.completeness", "map.rmse_m",
    ]  # fmt: skip
    analysis = analyse(study, tmp_path, lambda s: fly(s) | {"map.completeness": 0.97})
    assert analysis.metrics == ["map.le90_m", "map.completeness"]


def evaluated(folder, changes):
    """Returns study and candidate of a search that minimises LE90 over the asked area, with changed rows."""
    old = 'objectives = ["timing.simulated_s", "map.le90_m", "risk"]'
    study = study_of(folder, TUNING, (old, 'objectives = ["map.le90_area_m"]'), ("samples = 2", "samples = 5"))
    flown = CandidateSurveys(study, folder, ())
    values = {"plan.altitude_m": 1.6, "estimate.node_stride": 1}
    for survey, change in zip(flown.surveys(0, values), changes, strict=True):
        flown.add(flight.row_of(survey, "complete", "") | change)
    return study, flown.evaluate(0, values)


@pytest.mark.parametrize(("n_holed", "expected"), [(0, 0.03), (1, 0.04), (2, 0.05), (3, 1e9), (5, 1e9)])
def test_a_map_with_too_many_holes_is_infinitely_bad_in_the_search(tmp_path, n_holed, expected):
    """The median of 0.01 to 0.05 with the smallest values replaced by infinity."""
    errors = [None if k < n_holed else 0.01 * (k + 1) for k in range(5)]
    _, candidate = evaluated(tmp_path, [{"map.le90_area_m": error} for error in errors])
    assert candidate.objectives == (pytest.approx(expected),)
    assert candidate.has_metrics == (n_holed < 3)


def test_the_plans_of_a_search_are_listed_with_the_completeness(tmp_path):
    changes = [{"map.le90_area_m": 0.01, "map.completeness_area": 0.95 + 0.01 * k} for k in range(5)]
    study, candidate = evaluated(tmp_path, changes)
    assert candidate.completeness == (("map.completeness_area", pytest.approx(0.97)),)
    result = TuningResult(study, [candidate], [candidate], [], None, candidate, None, "", None, False, False, False, {})
    tuning_report.write_tuning_report(result, tmp_path)
    assert "<th>mapped part of the asked area</th>" in (tmp_path / "tuning.html").read_text()


def test_completeness_is_unknown_without_a_completed_survey(tmp_path):
    _, candidate = evaluated(tmp_path, [{"status": "degraded"}] * 5)
    assert np.isnan(candidate.completeness[0][1]) and candidate.objectives == (1e9,)
