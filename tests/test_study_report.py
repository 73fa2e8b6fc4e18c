"""The report begins with its result, and its statistics include the right surveys."""

import pickle
from unittest.mock import Mock

import numpy as np
import pyarrow as pa
import pytest
from study_surveys import LOST, STUDY, fail, fly, study_of

from twin import survey as survey_module
from twin.errors import ScenarioError, UnmodelledError
from twin.studies import flight, sentences
from twin.studies.analysis import StudyAnalysis, mask_numbers
from twin.studies.flight import row_of
from twin.studies.report import summary as summary_of
from twin.studies.report import write_report
from twin.studies.results_log import ResultsLog
from twin.studies.statistics import wilson_interval
from twin.studies.surveys import survey_keys, surveys


def analyse(study, folder, function=fly):
    """Returns the analysis of a study flown in this process."""
    log = ResultsLog(folder)
    for survey in surveys(study, folder):
        log.add(function(survey))
    return StudyAnalysis(log.table(set(survey_keys(study))), study)


@pytest.fixture
def study(tmp_path):
    return study_of(tmp_path, STUDY, ("samples = 12", "samples = 64"))


@pytest.fixture
def analysis(study, tmp_path):
    return analyse(study, tmp_path)


def test_the_first_sentences_state_up_to_where_the_seek_key_passes(tmp_path):
    study = study_of(tmp_path, STUDY, ("samples = 12", "samples = 200"))
    analysis = analyse(study, tmp_path)
    first, second, *_ = sentences.headline(analysis).split(". ")
    assert first.startswith("The estimated limit of turbidity, below which 80 % pass, is 1")
    assert " (95 % interval: 1" in first
    assert second.startswith("At least 80 % of surveys pass at turbidity 1 to ")
    passes, *_, fails = analysis.answers["water.turbidity"]
    assert (passes.verdict, fails.verdict) == ("passes", "fails")
    assert 10 < passes.high < 20 < fails.high  # 0.001 turbidity x altitude / 2 m = 0.02 m, for altitudes 1.6 to 2.4 m
    assert fails.low > passes.high


def test_the_first_screen_answers_in_one_sentence_of_everyday_words(study, analysis):
    answer, *others = sentences.paragraphs(analysis)
    target = "height error on 90 % of the mapped cells (LE90) at most 2.0 cm"
    assert answer.text.endswith(f". {analysis.passed.sum()} of 64 simulated surveys reached the target: {target}.")
    titles = ["How sure is it?", "Why did surveys not pass?", "What changes it most?", "What does it assume?"]
    assert [paragraph.title for paragraph in others] == [*titles, "What does it say nothing about?"]
    assert sum(int(item.split()[0]) for item in others[1].items) == 64 - analysis.passed.sum()
    share = analysis.pass_probability
    numbers = f"about {100 * share.value:.0f} (between {100 * share.low:.0f} and {100 * share.high:.0f}) pass"
    assert others[0].items[0].startswith(f"Of 100 such surveys, {numbers}: the pass probability is ")
    ranges = (
        "turbidity 1 to 40; height above the reference plane 1.6 to 2.4 m; water type (Jerlov) IB, III; daylight 0 to"
    )
    assert f"Values beyond those that were varied: {ranges} 20 lx." in others[4].items[0]


def test_what_changes_the_result_most_is_told_by_the_surveys_at_its_ends(study, analysis):
    largest = analysis.influences[0]
    assert largest.key == "water.turbidity" and [end.passed for end in largest.ends] == [1.0, 0.0]
    turbidity = np.sort(analysis.numbers("vary.water.turbidity"))
    median = np.median(analysis.numbers("map.le90_m")[analysis.numbers("vary.water.turbidity") <= turbidity[6]])
    assert largest.ends[0].median == pytest.approx(median, rel=0.2) and largest.ends[1].median is None  # all aborted
    line = sentences.paragraphs(analysis)[3].items[0]
    assert line.startswith("Turbidity: at 1.0") and "100 % pass, median height error on 90 % of the mapped" in line
    assert line.endswith(" 0 % pass.")


def test_the_pass_probability_includes_aborted_surveys(study, analysis):
    turbid = [turbidity > 25 for turbidity in analysis.rows["vary.water.turbidity"].to_pylist()]
    assert (analysis.status == "aborted").tolist() == turbid
    assert analysis.pass_probability.value == analysis.passed.mean()
    assert f"{analysis.passed.sum()} of 64 simulated surveys reached" in sentences.headline(analysis)


def test_failed_surveys_are_unknown_results(tmp_path):
    study = study_of(tmp_path)
    half = analyse(study, tmp_path, lambda survey: fail(survey) if survey.sample % 2 else fly(survey))
    assert half.evaluated.sum() == 6
    n_passed = int(half.passed.sum())
    assert half.pass_probability == wilson_interval(n_passed, 6, unknown=6)
    failed = "6 surveys failed because of the computer or the program, so their results are unknown"
    assert failed in sentences.headline(half)


def refused_by_the_surrogate(survey):
    """Flies a survey; at a turbidity above 8, the surrogate refuses it."""
    if survey.values["water.turbidity"] <= 8:
        return fly(survey)
    return row_of(survey, "refused", "study.toml:5: imaging.fidelity: too turbid") | {"unmodelled": True}


def test_surveys_that_only_the_surrogate_refuses_are_unknown_in_the_pass_probability(study, tmp_path):
    found = analyse(study, tmp_path, refused_by_the_surrogate)
    n_unknown = int((found.numbers("vary.water.turbidity") > 8).sum())
    n_known = 64 - n_unknown
    assert found.unmodelled.sum() == n_unknown > 20
    assert found.pass_probability == wilson_interval(n_known, n_known, unknown=n_unknown)
    assert found.requirement_missed
    text = sentences.headline(found)
    assert f"samples ({n_unknown} surveys) are unknown, because the surrogate cannot simulate them" in text
    assert "The required 80 % is not decided" in text and "cannot be flown" not in text
    assert summary_of(found, {})["unmodelled"] == n_unknown
    (last,) = [answer for answer in found.answers["water.turbidity"] if answer.unknown]
    assert (last.verdict, last.unknown) == ("undecided", n_unknown) and last.surveys >= n_unknown
    (metric,) = found.metric_summaries
    assert metric.bound.high == np.inf and np.isfinite(metric.bound.low)  # 44 % of the values are unknown
    assert f"{100 * n_known / 64:.1f} % to 100 %" in text
    assert f"{n_unknown} of them unknown" in sentences.answer_lines(found)[0]
    write_report(found, tmp_path / "study.html")
    assert f"{n_unknown} unknown" in (tmp_path / "study.html").read_text()


def test_the_row_of_a_survey_states_that_only_the_surrogate_refuses_it(study, tmp_path, monkeypatch):
    for error, unmodelled in ((UnmodelledError(["too rough"]), True), (ScenarioError(["too small"]), None)):
        monkeypatch.setattr(survey_module, "run", Mock(side_effect=error))
        row = flight.fly(next(surveys(study, tmp_path)))
        assert (row["status"], row.get("unmodelled")) == ("refused", unmodelled)
        assert type(pickle.loads(pickle.dumps(error))) is type(error)


def test_a_single_failed_survey_is_singular(tmp_path):
    study = study_of(tmp_path)
    rest = analyse(study, tmp_path, lambda survey: fail(survey) if survey.sample == 3 else fly(survey))
    headline = sentences.headline(rest)
    failed = (
        "1 survey failed because of the computer or the program, so its result is unknown; --resume flies it again."
    )
    assert failed in headline


def test_warnings_of_repeated_surveys_count_once(tmp_path):
    """Eight of the twelve surveys are in water that is listed twice, so four repeat others."""
    grid = (
        ("{ log_uniform = [1.0, 40.0] }", "{ grid = [2.0, 2.0, 3.0] }"),
        ('method = "lhs"\nsamples = 12', 'method = "grid"\nseeds = 1'),
    )
    study = study_of(tmp_path, STUDY, *grid, ("{ uniform = [1.6, 2.4] }", "{ grid = [1.8, 2.2] }"))
    warned = analyse(study, tmp_path, lambda survey: fly(survey) | {"warning": "too turbid"})
    assert (len(warned.rows), warned.duplicate.sum(), warned.warning_counts) == (12, 4, {"too turbid": 8})
    assert sentences.headline(warned).endswith("Warnings: in 8 of 8 surveys: too turbid.")


def test_warnings_are_counted_and_the_first_one_is_shown(tmp_path):
    study = study_of(tmp_path)
    warned = analyse(study, tmp_path, lambda s: fly(s) | {"warning": "surrogate: too turbid" if s.sample < 3 else ""})
    assert sentences.headline(warned).endswith("Warnings: in 3 of 12 surveys: surrogate: too turbid.")


def test_without_warnings_the_headline_has_none(study, analysis):
    assert "Warning" not in sentences.headline(analysis)


def test_if_all_surveys_failed_there_is_no_result(tmp_path):
    study = study_of(tmp_path)
    assert sentences.headline(analyse(study, tmp_path, fail)).startswith("No survey could be evaluated.")


def test_the_bound_of_an_error_is_its_95th_percentile(analysis):
    (metric,) = analysis.metric_summaries
    values = analysis.numbers("map.le90_m")[analysis.complete]
    assert metric.bound.value == pytest.approx(np.percentile(values, 95))
    assert metric.limit == 0.02


def test_the_bound_of_a_metric_of_which_more_is_better_is_its_5th_percentile(tmp_path):
    study = study_of(tmp_path, STUDY, ('show = ["map.le90_m"]', 'show = ["map.completeness"]'))
    completeness = np.random.default_rng(0).uniform(0.9, 1.0, 12)
    analysis = analyse(study, tmp_path, lambda s: fly(s) | {"map.completeness": completeness[s.sample]})
    metric = next(metric for metric in analysis.metric_summaries if metric.name == "map.completeness")
    assert metric.bound.value == pytest.approx(np.percentile(completeness[analysis.complete], 5))


def test_an_aborted_survey_has_not_passed_and_its_map_error_is_not_included(tmp_path):
    study = study_of(tmp_path)

    def half_aborted(survey):
        row = fly(survey)
        return row | {"status": "aborted"} if survey.sample < 6 else row

    for name in ("whole", "aborted"):
        (tmp_path / name).mkdir()
    whole, analysis = analyse(study, tmp_path / "whole"), analyse(study, tmp_path / "aborted", half_aborted)
    assert whole.passed[:6].any()
    assert not analysis.passed[:6].any()
    assert analysis.metric_summaries[0].surveys == whole.complete[6:].sum()


def test_the_strongest_sensitivity_comes_first(analysis):
    order = [sensitivity.key for sensitivity in analysis.sensitivities]
    assert order[0] == "water.turbidity"
    by_key = {sensitivity.key: sensitivity for sensitivity in analysis.sensitivities}
    assert by_key["water.turbidity"].correlation.low > 0.8
    assert by_key["water.jerlov"].explained < 0.2
    assert np.isnan(by_key["water.jerlov"].correlation.value)  # text has no rank


def test_failure_reasons_describe_the_surveys_that_did_not_pass(analysis):
    reasons = {reason.reason: reason.surveys for reason in analysis.failure_reasons}
    assert reasons[mask_numbers(LOST)] == (analysis.status == "aborted").sum()
    assert reasons["requirement not met: map.le90_m"] == (analysis.complete & ~analysis.passed).sum()
    counts = [reason.surveys for reason in analysis.failure_reasons]
    assert counts == sorted(counts, reverse=True)


def test_reasons_that_differ_only_in_numbers_are_counted_together():
    assert mask_numbers("vision lost at 2.0 s: too few") == mask_numbers("vision lost at 13.25 s: too few")
    assert mask_numbers("requirement not met: map.le90_m") == "requirement not met: map.le90_m"


def test_only_a_complete_saltelli_design_gives_sobol_indices(tmp_path):
    changes = ('"lhs"', '"saltelli"'), ("samples = 12", "samples = 64"), ("40.0]", "20.0]")
    study = study_of(tmp_path, STUDY, *changes)
    analysis = analyse(study, tmp_path)
    indices = analysis.sobol["map.le90_m"]
    assert list(indices) == ["water.turbidity", "plan.altitude_m", "water.jerlov + sun.illuminance_lx"]
    assert indices["water.turbidity"].total.value > 0.8
    assert indices["water.jerlov + sun.illuminance_lx"].total.high < 0.05
    status = pa.array(["aborted"] + analysis.rows["status"].to_pylist()[1:])
    incomplete = analysis.rows.set_column(analysis.rows.column_names.index("status"), "status", status)
    assert StudyAnalysis(incomplete, study).sobol == {}


def test_sobol_indices_use_the_means_over_seeds(tmp_path):
    """Without noise, a second seed does not change the means."""
    changes = (('"lhs"', '"saltelli"'), ("samples = 12", "samples = 64"), ("40.0]", "20.0]"))

    def without_noise(survey):
        row = fly(survey)
        return row | {"map.le90_m": 0.001 * survey.values["water.turbidity"]}

    def means(*more):
        folder = tmp_path / str(len(more))
        folder.mkdir()
        return analyse(study_of(folder, STUDY, *changes, *more), folder, without_noise)._mean_of_samples("map.le90_m")

    np.testing.assert_allclose(means(("samples = 64", "samples = 64\nseeds = 2")), means())


def test_the_page_is_self_contained_and_begins_with_the_result(tmp_path):
    study = study_of(tmp_path, STUDY.replace("seek", 'question = "How <turbid> may it be?"\nseek', 1))
    analysis = analyse(study, tmp_path)
    write_report(analysis, tmp_path / "study.html")
    page = (tmp_path / "study.html").read_text()
    assert "How &lt;turbid&gt; may it be?" in page
    assert page.index("of surveys pass") < page.index("surveys reached the target") < page.index("<main>")
    titles = (
        "Pass probability by what was varied",
        "Where the required fraction of surveys passes",
        "Metrics of the surveys",
        "Sensitivity",
        "Surveys that did not pass",
        "The study",
    )
    for title in titles:
        assert title in page
    assert page.count('src="data:image/png;base64,') == 5
    assert "http://" not in page and "https://" not in page


def test_the_summary_is_valid_json(analysis):
    import json

    summary = summary_of(analysis, {"name": "study"})
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["surveys"] == summary["complete"] + summary["aborted"] + summary["refused"] + summary["failed"]


def test_image_quality_includes_aborted_surveys_and_a_metric_without_values_is_not_shown(tmp_path):
    shown = 'show = ["map.le90_m", "vision.points_median", "vision.contrast_median"]'
    study = study_of(tmp_path, STUDY, ('show = ["map.le90_m"]', shown), ("samples = 12", "samples = 40"))

    def with_points(survey):
        points = 400.0 if survey.values["water.turbidity"] < 25 else 3.0
        return fly(survey) | {"vision.points_median": points, "vision.contrast_median": None}

    analysis = analyse(study, tmp_path, with_points)
    aborted = analysis.status == "aborted"
    assert aborted.any()
    assert analysis.included("vision.points_median").all()
    assert not analysis.included("map.le90_m")[aborted].any()
    assert analysis.metrics == ["map.le90_m", "vision.points_median"]
    correlations = {s.metric: s.correlation.value for s in analysis.sensitivities if s.key == "water.turbidity"}
    assert correlations["vision.points_median"] < -0.5 < 0.5 < correlations["map.le90_m"]


def test_the_bound_of_a_metric_that_can_be_negative_is_that_of_its_size(tmp_path):
    study = study_of(tmp_path, STUDY, ('show = ["map.le90_m"]', 'show = ["map.bias_m"]'))
    biases_m = np.random.default_rng(0).uniform(-0.055, -0.05, 12)
    analysis = analyse(study, tmp_path, lambda s: fly(s) | {"map.bias_m": biases_m[s.sample]})
    metric = next(metric for metric in analysis.metric_summaries if metric.name == "map.bias_m")
    assert (
        metric.bound.value == pytest.approx(np.percentile(-biases_m[analysis.complete], 95)) and metric.median.value < 0
    )
