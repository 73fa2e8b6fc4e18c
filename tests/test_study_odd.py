"""Odd studies end with the right exit status and the right answer."""

import odd_studies
import pytest

from twin.studies import runner
from twin.studies.report import summary


@pytest.fixture(autouse=True)
def _no_report(monkeypatch):
    """Leaves out the report, which takes longer than everything else."""
    monkeypatch.setattr(runner, "write_report", lambda analysis, page: None)


@pytest.mark.parametrize(
    ("name", "status", "expected"),
    [
        ("all refused", 2, ["not allowed (allowed: greater than 0) in sample 0 and 239 more"]),
        ("no survey can be planned", 2, ["No survey could be evaluated. 8 samples (8 surveys) cannot be flown"]),
        (
            "half refused",
            0,
            ["120 of 120 simulated surveys", "120 samples (120 surveys) cannot be flown and are not counted"],
        ),
        (
            "non-monotonic",
            1,
            [
                "The required 90 % is not met.",
                "pass at height above the reference plane 1.64 to 1.86 and 2.54 to 3 m; fewer pass at 1 to 1.6",
            ],
        ),
        ("one sample", 0, ["(95 % confidence interval: 20.7 % to 100 %)", "not decided with 1 survey (about 34 more"]),
        ("zero passes", 1, ["0 % (95 % confidence interval: 0 % to 24.2 %)", "fewer pass at 1.08 to 2.89 m."]),
        (
            "all pass",
            0,
            ["(95 % confidence interval: 98.4 % to 100 %)", "height above the reference plane 1.01 to 2.99 m."],
        ),
        ("constant parameter", 0, ["height above the reference plane has one value only."]),
        ("categorical parameter", 1, ["pass at water type (Jerlov) IB; fewer pass at II and III."]),
        (
            "duplicated values",
            0,
            ["80 of 80", "40 surveys repeat others (same scenario, same seed) and are not counted"],
        ),
        ("interrupted", 130, ["The study is not finished: 235 surveys not flown yet", "not decided with 5 surveys"]),
    ],
)
def test_an_odd_study_is_answered_correctly(tmp_path, name, status, expected):
    found, lines = odd_studies.answer_of(name, tmp_path)
    text = " ".join(lines)
    assert found == status
    for sentence in expected:
        assert sentence in text


def test_refused_samples_are_listed_with_their_values_and_reasons(tmp_path):
    analysis = odd_studies.run("half refused", tmp_path).analysis
    listed = summary(analysis, {})["refused_samples"]
    assert len(listed) == 120
    assert all(sample["values"]["plan.altitude_m"] <= 0 and "not allowed" in sample["reason"] for sample in listed)
    (reason,) = analysis.refusal_reasons
    assert (reason.status, reason.surveys) == ("refused", 120)
    assert analysis.failure_reasons == []
    assert analysis.pass_probability.value == 1.0


def test_a_range_that_passes_in_the_summary_has_passing_surveys_only(tmp_path):
    analysis = odd_studies.run("non-monotonic", tmp_path).analysis
    altitude_m = analysis.numbers("vary.plan.altitude_m")
    ranges = summary(analysis, {})["answers"]["plan.altitude_m"]
    assert [r["verdict"] for r in ranges].count("passes") == 2
    for found in ranges:
        inside = (altitude_m >= found["low"]) & (altitude_m <= found["high"])
        assert inside.sum() == found["surveys"]
        assert analysis.passed[inside].mean() == pytest.approx(found["probability"]["value"])
