"""The gate of the surrogate: it passes for equal surveys and fails for surveys that differ."""

import numpy as np
import pytest
from study_surveys import study_of

from twin.errors import ScenarioError
from twin.studies.agreement import HEADER, agreement, table, values_of_pairs
from twin.studies.analysis import StudyAnalysis
from twin.studies.flight import row_of
from twin.studies.report import summary, write_agreement
from twin.studies.results_log import ResultsLog
from twin.studies.surveys import surveys

GATE = """
scenario = "reef"
compare = ["map.le90_m", "map.le90_area_m"]

[vary]
imaging.fidelity = { grid = ["rendered", "surrogate"] }
water.turbidity = { log_uniform = [1.0, 4.0] }

[sampling]
method = "random"
samples = 40
paired = false

[require]
"map.le90_m" = 0.02
"""


def analyse(folder, surrogate_factor=1.0, holes=(), **statuses):
    """Returns the analysis of pairs whose errors are 1 cm times turbidity, times a factor with the surrogate."""
    study, log = study_of(folder, GATE), ResultsLog(folder)
    for survey in surveys(study, folder):
        fidelity = survey.values["imaging.fidelity"]
        error_m = 0.01 * survey.values["water.turbidity"] * (surrogate_factor if fidelity == "surrogate" else 1.0)
        passed = {"require.map.le90_m.limit": 0.02, "require.map.le90_m.passed": error_m <= 0.02}
        area_m = None if survey.sample // 2 in holes else error_m
        status = statuses.get(fidelity, "complete")
        log.add(row_of(survey, status, "") | {"map.le90_m": error_m, "map.le90_area_m": area_m} | passed)
    return StudyAnalysis(log.table(), study)


def test_equal_surveys_agree(tmp_path):
    result = agreement(analyse(tmp_path))
    assert result.agrees and result.pairs == 40
    assert result.verdicts.value == 1
    for metric in result.metrics:
        assert tuple(metric.ratio) == (1, 1, 1)
        assert metric.p_value == 1


def test_errors_of_half_the_size_do_not_agree(tmp_path):
    result = agreement(analyse(tmp_path, 0.5))
    assert not any((result.agrees, result.verdicts_agree, *(metric.agrees for metric in result.metrics)))
    assert result.only_surrogate > 0 == result.only_rendered
    for metric in result.metrics:
        assert metric.ratio.value == pytest.approx(0.5)
        assert metric.ratio.low == metric.ratio.high == metric.ratio.value  # every pair has this ratio


def test_medians_within_a_fifth_agree_in_both_directions(tmp_path):
    for factor, agrees in ((1.19, True), (1 / 1.19, True), (1.21, False), (1 / 1.21, False)):
        folder = tmp_path / f"{factor:.3f}"
        folder.mkdir()
        assert [metric.agrees for metric in agreement(analyse(folder, factor)).metrics] == [agrees] * 2


def test_a_map_with_holes_has_an_infinite_error_and_stays_in_the_comparison(tmp_path):
    some = analyse(tmp_path, holes=range(10))
    assert np.isinf(values_of_pairs(some, "map.le90_area_m")[0]).sum() == 10
    assert agreement(some).agrees
    all_holes = tmp_path / "all"
    all_holes.mkdir()
    metric = agreement(analyse(all_holes, holes=range(40))).metrics[1]
    assert np.isinf(metric.rendered) and metric.ratio.value == 1


def test_values_are_compared_only_if_both_surveys_reached_their_end(tmp_path):
    result = agreement(analyse(tmp_path, rendered="aborted"))
    assert [metric.pairs for metric in result.metrics] == [0, 0]
    assert not result.agrees
    assert result.only_surrogate > 0 == result.only_rendered


def test_the_document_has_the_verdict_the_command_and_the_figure(tmp_path):
    analysis = analyse(tmp_path, 0.5)
    write_agreement(analysis, tmp_path)
    text = (tmp_path / "agreement.md").read_text()
    assert "FAIL: 40 pairs" in text and "`twin study study` flies 40 pairs" in text
    sampling = analysis.study.sampling.model_copy(update={"seeds": 2})
    analysis.study = analysis.study.model_copy(update={"sampling": sampling})
    write_agreement(analysis, tmp_path)
    assert "`twin study study` flies 80 pairs" in (tmp_path / "agreement.md").read_text()
    assert all(" | ".join(row) in text for row in (HEADER, *table(agreement(analysis))))
    assert (tmp_path / "agreement.png").read_bytes().startswith(b"\x89PNG")
    assert summary(analysis, {})["agreement"]["metrics"]["map.le90_m"]["agrees"] is False


def test_metrics_are_compared_only_between_both_fidelities(tmp_path):
    with pytest.raises(ScenarioError, match="compare: needs surveys of both fidelities"):
        study_of(tmp_path, GATE, ('["rendered", "surrogate"]', '["surrogate"]'))


def test_a_metric_that_can_be_negative_has_no_ratio_and_is_refused(tmp_path):
    signed = ('compare = ["map.le90_m", ', 'compare = ["map.bias_m", "orthomosaic.bias_east_m", ')
    with pytest.raises(ScenarioError, match=r"compare: map.bias_m can be negative.*\n.*orthomosaic.bias_east_m can be"):
        study_of(tmp_path, GATE, signed)


def test_a_study_without_compare_has_no_agreement(tmp_path):
    analysis = analyse(tmp_path)
    analysis.study = analysis.study.model_copy(update={"compare": ()})
    assert agreement(analysis) is None


def test_a_study_without_a_result_has_no_agreement(tmp_path):
    assert agreement(StudyAnalysis(ResultsLog(tmp_path).table(), study_of(tmp_path, GATE))) is None


def test_fidelities_that_are_no_names_are_refused(tmp_path):
    both = '["rendered", "surrogate"]'
    with pytest.raises(ScenarioError, match="needs surveys of both fidelities"):
        study_of(tmp_path, GATE, (both, f"[{both}, {{ b = 1 }}]"))


def test_a_search_that_varies_the_fidelity_is_refused(tmp_path):
    tuned = (
        '[tune]\nobjectives = ["map.le90_m"]\n[tune.search]\nplan.altitude_m = { uniform = [1.5, 3.0] }\n\n[require]'
    )
    with pytest.raises(ScenarioError, match="imaging.fidelity varies, but plans are verified with rendered images"):
        study_of(tmp_path, GATE, ("[require]", tuned))
