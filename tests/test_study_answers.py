"""Ranges reported as passing do pass: on curves that are not monotonic, at the boundary, and with few surveys."""

import numpy as np
import pytest

from twin.studies.answers import (
    Answer,
    PassRecord,
    answers_of_ranges,
    answers_of_values,
    limit_of_key,
    monotone_pieces,
    regress,
)
from twin.studies.sentences import answer_sentences
from twin.studies.statistics import Proportion, wilson_interval


def answers(x, passed, required=0.9):
    record = PassRecord(np.asarray(passed, bool), np.arange(len(x)), required, np.zeros(len(x), bool))
    return answers_of_ranges(regress(np.asarray(x, float), record))


def with_unknown(passed, unknown, x=None, required=0.9):
    x = np.arange(float(len(passed))) if x is None else x
    return answers_of_ranges(regress(x, PassRecord(passed, np.arange(len(x)), required, unknown)))


def of_verdict(found, verdict):
    return [answer for answer in found if answer.verdict == verdict]


def test_two_separate_ranges_that_pass_are_both_found():
    x = np.linspace(1.0, 3.0, 600)
    passes = ((x >= 1.6) & (x <= 1.9)) | (x >= 2.5)
    found = answers(x, passes)
    margin_m = 12 * (x[1] - x[0])  # 11 passes in a row show 90 %: 22 ln(1 / 0.9) > 2.27
    low, high = of_verdict(found, "passes")
    np.testing.assert_allclose([low.low, low.high, high.low, high.high], [1.6, 1.9, 2.5, 3.0], atol=margin_m)
    assert low.low >= 1.6 and low.high <= 1.9 and high.low >= 2.5
    assert len(of_verdict(found, "fails")) == 2
    assert not any(passes[(x >= a.low) & (x <= a.high)].mean() >= 0.9 for a in of_verdict(found, "fails"))


def test_a_narrow_range_that_fails_is_not_covered_by_its_neighbours():
    x = np.linspace(0.0, 1.0, 2000)
    hole = (x > 0.5) & (x < 0.56)  # 6 %: pooled with both sides, 94 % pass
    found = of_verdict(answers(x, ~hole), "passes")
    assert len(found) == 2
    assert found[0].high <= 0.5 and found[1].low >= 0.56


@pytest.mark.parametrize(("fraction", "verdict"), [(0.89, "passes"), (0.95, "fails")])
def test_at_a_constant_pass_probability_a_wrong_range_is_rare(fraction, verdict):
    rng, wrong = np.random.default_rng(0), 0
    for _ in range(40):
        x = rng.random(100)
        wrong += bool(of_verdict(answers(x, rng.random(100) < fraction), verdict))
    assert wrong <= 4  # 2.5 % per study: four or fewer of 40 in 99.7 % of cases


@pytest.mark.parametrize("isolated", [[], [0.9]])
def test_passes_next_to_a_range_that_fails_are_not_said_to_fail(isolated):
    """Bins of 12 would mix 11 surveys that pass with 12 that fail."""
    x = np.concatenate([np.linspace(0.1, 0.8, 12), np.linspace(0.84, 1.89, 11), np.linspace(1.95, 7.5, 12)])
    passed = (x < 1.9) & ~np.isin(x, isolated)
    found = answers(x, passed)
    assert [answer.verdict for answer in found] == ["undecided", "fails"]
    assert (found[0].surveys, found[1].surveys, found[1].low) == (23, 12, 1.95)
    easier = answers(x, x < 1.9, required=0.8)
    assert [answer.verdict for answer in easier] == ["passes", "undecided", "fails"]
    assert easier[1].surveys == 5  # 6 passes in a row show 80 %: 12 ln(1 / 0.8) > 2.27


def test_failures_next_to_a_range_that_passes_are_not_said_to_pass():
    x = np.arange(46.0)
    (passes,) = of_verdict(answers(x, x < 29, required=0.5), "passes")
    assert passes.high == 27  # 2 passes in a row show 50 %: 4 ln 2 > 2.27


def test_a_key_without_influence_rarely_has_a_limit():
    rng, found = np.random.default_rng(1), []
    for fraction in (0.3, 0.7, 0.95):
        for _ in range(40):
            found.append(bool(monotone_pieces(rng.random(120), rng.random(120) < fraction)))
    assert np.sum(found) <= 13  # 5 % are 6 of 120; 13 are exceeded with a probability of 0.3 %


def test_unknown_results_widen_the_interval_to_both_sides():
    (found,) = with_unknown(np.arange(60) < 40, np.arange(60) >= 50, x=np.ones(60))
    assert (found.surveys, found.unknown) == (60, 10)
    assert (found.probability.value, found.probability.most) == (40 / 60, 50 / 60)
    assert found.probability.low == wilson_interval(40, 60).low
    assert found.probability.high == wilson_interval(50, 60).high


def test_a_range_of_unknown_results_is_neither_said_to_pass_nor_to_fail():
    x = np.arange(120)
    found = with_unknown(x < 60, x >= 60)
    assert [(a.verdict, a.unknown) for a in found] == [("passes", 0), ("undecided", 60)]
    assert found[0].surveys == 50  # 11 known passes are next to the unknown results
    assert found[1].more_surveys == np.inf
    found = with_unknown(np.zeros(120, bool), x >= 60)
    assert [(a.verdict, a.surveys) for a in found] == [("fails", 60), ("undecided", 60)]


def test_nothing_is_claimed_where_the_direction_depends_on_the_unknown_results():
    """Passes, then 55 %, then unknown: with these as passes, the fraction seems to rise from a small value."""
    rng = np.random.default_rng(0)
    x = np.arange(240.0)
    passed = (x < 10) | (rng.random(240) < 0.55)
    found = with_unknown(passed & (x < 180), x >= 180, x=x, required=0.8)
    assert not [a for a in of_verdict(found, "fails") if a.low < 10]


def test_one_survey_decides_nothing_and_states_how_many_would():
    (found,) = answers([2.0], [True])
    assert (found.verdict, found.label, found.surveys) == ("undecided", "2", 1)
    assert found.more_surveys == 34  # 35 of 35 are needed for a lower bound of 90 %


def test_a_required_probability_of_1_is_never_shown_but_can_be_refuted():
    x = np.arange(300.0)
    (found,) = answers(x, np.ones(300), required=1.0)
    assert (found.verdict, found.more_surveys) == ("undecided", np.inf)
    assert of_verdict(answers(x, x < 150, required=1.0), "fails")


def test_listed_values_are_judged_one_by_one():
    names = np.array(["IB"] * 40 + ["II"] * 40 + ["III"] * 4)
    passed = np.array([True] * 40 + [False] * 40 + [True] * 4)
    found = answers_of_values(names, PassRecord(passed, np.arange(84), 0.9))
    assert [(a.label, a.verdict) for a in found] == [("IB", "passes"), ("II", "fails"), ("III", "undecided")]
    numbers = answers_of_values(np.repeat([0.5, 2.0], 42), PassRecord(passed, np.arange(84), 0.9))
    assert [(a.low, a.high, a.label) for a in numbers] == [(0.5, 0.5, "0.5"), (2.0, 2.0, "2")]


def test_surveys_of_one_sample_count_less_than_independent_ones():
    x, passed = np.repeat(np.linspace(0, 1, 10), 10), np.ones(100, bool)
    independent = answers_of_ranges(regress(x, PassRecord(passed, np.arange(100), 0.9)))
    clustered = answers_of_ranges(regress(x, PassRecord(passed, np.repeat(np.arange(10), 10), 0.9)))
    assert [a.verdict for a in independent] == ["passes"]
    assert [a.verdict for a in clustered] == ["undecided"]
    assert clustered[0].more_surveys == 246  # 34.6 samples instead of 10


def test_equal_values_have_the_same_verdict():
    rng = np.random.default_rng(0)
    x = rng.integers(0, 40, 500).astype(float)
    found = answers(x, rng.random(500) < np.where(x < 20, 0.99, 0.1))
    assert [a.verdict for a in found] == ["passes", "fails"]
    assert all(one.high < other.low for one, other in zip(found, found[1:], strict=False))
    assert sum(a.surveys for a in found) == 500


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_limit_has_the_direction_of_the_key(sign):
    x = sign * np.arange(100.0)
    found = regress(x, PassRecord(np.arange(100) < 60, np.arange(100), 0.9))
    limit = limit_of_key(found, answers_of_ranges(found))
    assert limit is not None
    assert (limit.value, limit.rises) == (sign * 59.5, sign < 0)
    assert sorted((limit.low, limit.high)) == sorted((sign * 49, sign * 60))


@pytest.mark.parametrize(("verdict", "text"), [("fails", "No value of speed is shown at"), ("undecided", "has enough")])
def test_more_surveys_are_only_asked_for_where_they_could_decide(verdict, text):
    probability = Proportion(0.5, 0.4, 0.6, 0.5)
    answer = Answer(verdict, "0.3 to 0.5", 0.3, 0.5, 12, probability, 30.0)
    sentence = answer_sentences("plan.speed_mps", [answer], 0.9)
    assert text in sentence and ("more" in sentence) == (verdict == "undecided")
