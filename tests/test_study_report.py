"""The report answers its question first, and says no more than the surveys allow."""

import numpy as np
import pyarrow as pa
import pytest
from study_surveys import LOST, STUDY, fail, fly, study_of

from twin.study import findings, report, wording
from twin.study.findings import Findings
from twin.study.ledger import Ledger
from twin.study.surveys import keys, surveys


def found_of(study, folder, function=fly):
    """The findings of a study flown here and now."""
    ledger = Ledger(folder)
    for survey in surveys(study, folder):
        ledger.add(function(survey))
    return Findings(ledger.table(set(keys(study))), study)


@pytest.fixture
def study(tmp_path):
    return study_of(tmp_path, STUDY, ("samples = 12", "samples = 64"))


@pytest.fixture
def found(study, tmp_path):
    return found_of(study, tmp_path)


def test_the_first_sentence_tells_how_far_the_sought_key_may_go(study, found):
    first = wording.headline(study, found).partition("). ")[0]
    assert first.startswith("At least 80 % of surveys pass where water.turbidity is at most ")
    limit, rising = found.sought
    assert not rising
    assert 17 < limit.value < 25  # 0.001 turbidity x altitude / 2 m = 0.02, of altitudes from 1.6 to 2.4 m
    assert limit.low <= limit.value <= limit.high


def test_the_share_that_passes_is_counted_over_what_ended(study, found, tmp_path):
    murky = [turbidity > 25 for turbidity in found.rows["vary.water.turbidity"].to_pylist()]
    assert (found.status == "aborted").tolist() == murky
    assert found.share.value == found.passed.mean()
    assert f"{found.passed.sum()} of 64 ended complete" in wording.headline(study, found)


def test_surveys_that_failed_do_not_count(tmp_path):
    study = study_of(tmp_path)
    half = found_of(study, tmp_path, lambda survey: fail(survey) if survey.sample % 2 else fly(survey))
    assert half.ended.sum() == 6
    assert half.share.value == half.passed[half.ended].mean()
    assert "6 more failed by the machine or the program and do not count" in wording.headline(study, half)


def test_surveys_to_beware_of_are_counted_and_one_is_told(tmp_path):
    study = study_of(tmp_path)
    said = found_of(study, tmp_path, lambda s: fly(s) | {"warning": "surrogate: too murky" if s.sample < 3 else ""})
    assert wording.headline(study, said).endswith("Beware in 3 of 12: surrogate: too murky.")


def test_where_nothing_is_to_beware_of_nothing_is_said(study, found):
    assert "Beware" not in wording.headline(study, found)


def test_where_all_failed_nothing_is_said(tmp_path):
    study = study_of(tmp_path)
    assert wording.headline(study, found_of(study, tmp_path, fail)).startswith("No survey ended")


def test_the_limits_side_tells_what_is_kept_by_most(found):
    (level,) = found.levels
    values = found.numbers("map.le90_m")[found.complete]
    assert level.bound.value == pytest.approx(np.percentile(values, 95))
    assert level.limit == 0.02


def test_of_figures_that_are_better_the_higher_the_limits_side_is_the_low_one(tmp_path):
    study = study_of(tmp_path, STUDY, ('show = ["map.le90_m"]', 'show = ["map.completeness"]'))
    shares = np.random.default_rng(0).uniform(0.9, 1.0, 12)
    found = found_of(study, tmp_path, lambda s: fly(s) | {"map.completeness": shares[s.sample]})
    level = next(level for level in found.levels if level.name == "map.completeness")
    assert level.bound.value == pytest.approx(np.percentile(shares[found.complete], 5))


def test_a_survey_that_broke_off_has_not_passed_whatever_it_kept_and_its_map_does_not_count(tmp_path):
    study = study_of(tmp_path)

    def broken(survey):
        row = fly(survey)
        return row | {"status": "aborted"} if survey.sample < 6 else row

    for name in ("whole", "broken"):
        (tmp_path / name).mkdir()
    whole, found = found_of(study, tmp_path / "whole"), found_of(study, tmp_path / "broken", broken)
    assert whole.passed[:6].any()
    assert not found.passed[:6].any()
    assert found.levels[0].surveys == whole.complete[6:].sum()


def test_what_matters_most_comes_first(found):
    order = [influence.key for influence in found.influences]
    assert order[0] == "water.turbidity"
    by_key = {influence.key: influence for influence in found.influences}
    assert by_key["water.turbidity"].correlation.low > 0.8
    assert by_key["water.jerlov"].explained < 0.2
    assert np.isnan(by_key["water.jerlov"].correlation.value)  # a text has no rank


def test_what_failures_share_is_told(found):
    assert found.contrasts[0].key == "water.turbidity"
    assert found.contrasts[0].above > 0.95
    reasons = {reason.reason: reason.surveys for reason in found.reasons}
    assert reasons[findings.general(LOST)] == (found.status == "aborted").sum()
    assert reasons["missed map.le90_m"] == (found.complete & ~found.passed).sum()
    counts = [reason.surveys for reason in found.reasons]
    assert counts == sorted(counts, reverse=True)


def test_reasons_that_differ_in_numbers_only_count_together():
    assert findings.general("vision lost at 2.0 s: too few") == findings.general("vision lost at 13.25 s: too few")
    assert findings.general("missed map.le90_m") == "missed map.le90_m"


def test_a_saltelli_design_gives_sobol_indices_and_a_hole_in_it_none(tmp_path):
    changes = ('"lhs"', '"saltelli"'), ("samples = 12", "samples = 64"), ("40.0]", "20.0]")
    study = study_of(tmp_path, STUDY, *changes)
    found = found_of(study, tmp_path)
    indices = found.sobol["map.le90_m"]
    assert list(indices) == ["water.turbidity", "plan.altitude_m", "water.jerlov + sun.illuminance_lx"]
    assert indices["water.turbidity"].total.value > 0.8
    assert indices["water.jerlov + sun.illuminance_lx"].total.high < 0.05
    status = pa.array(["aborted"] + found.rows["status"].to_pylist()[1:])
    holed = found.rows.set_column(found.rows.column_names.index("status"), "status", status)
    assert Findings(holed, study).sobol == {}


def test_sobol_indices_are_of_the_means_over_seeds(tmp_path):
    """Two seeds double every sum; means and so the indices of a law without noise stay."""
    changes = (('"lhs"', '"saltelli"'), ("samples = 12", "samples = 64"), ("40.0]", "20.0]"))

    def quiet(survey):
        row = fly(survey)
        return row | {"map.le90_m": 0.001 * survey.values["water.turbidity"]}

    def means(*more):
        folder = tmp_path / str(len(more))
        folder.mkdir()
        return found_of(study_of(folder, STUDY, *changes, *more), folder, quiet)._mean_of_samples("map.le90_m")

    np.testing.assert_allclose(means(("samples = 64", "samples = 64\nseeds = 2")), means())


def test_the_page_holds_the_answer_the_numbers_and_no_link_to_elsewhere(tmp_path):
    study = study_of(tmp_path, STUDY.replace("seek", 'question = "How <murky> may it be?"\nseek', 1))
    found = found_of(study, tmp_path)
    report.write_report(study, found, tmp_path / "study.html")
    page = (tmp_path / "study.html").read_text()
    assert "How &lt;murky&gt; may it be?" in page
    assert page.index("of surveys pass where water.turbidity is at most") < page.index("<img")
    for title in ("Who passes", "How far off surveys are", "What matters", "did not pass have in common", "The study"):
        assert title in page
    assert page.count('src="data:image/png;base64,') == 5
    assert "http://" not in page and "https://" not in page


def test_the_summary_has_plain_numbers_only(found):
    import json

    summary = findings.summary(found, {"name": "study"})
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["surveys"] == summary["complete"] + summary["aborted"] + summary["refused"] + summary["failed"]


def test_what_cameras_saw_counts_for_surveys_that_broke_off_and_missing_contrast_is_not_shown(tmp_path):
    shown = 'show = ["map.le90_m", "vision.points_median", "vision.contrast_median"]'
    study = study_of(tmp_path, STUDY, ('show = ["map.le90_m"]', shown), ("samples = 12", "samples = 40"))

    def see(survey):
        points = 400.0 if survey.values["water.turbidity"] < 25 else 3.0
        return fly(survey) | {"vision.points_median": points, "vision.contrast_median": None}

    found = found_of(study, tmp_path, see)
    aborted = found.status == "aborted"
    assert aborted.any()
    assert found.counted("vision.points_median").all()
    assert not found.counted("map.le90_m")[aborted].any()
    assert found.metrics == ["map.le90_m", "vision.points_median"]
    rising = {f.metric: f.correlation.value for f in found.influences if f.key == "water.turbidity"}
    assert rising["vision.points_median"] < -0.5 < 0.5 < rising["map.le90_m"]
