"""Intervals and indices agree with closed forms, with scipy, and with how often they hold."""

import numpy as np
import pytest
from scipy import stats

from twin.study import statistics
from twin.study.design import points


@pytest.mark.parametrize(("passed", "count"), [(0, 10), (3, 10), (10, 10), (86, 100), (1, 1)])
def test_wilsons_interval_is_that_of_scipy(passed, count):
    oracle = stats.binomtest(passed, count).proportion_ci(0.95, method="wilson")
    found = statistics.wilson(passed, count)
    assert found.value == passed / count
    np.testing.assert_allclose(found[1:], oracle, atol=1e-12)


def test_without_surveys_nothing_is_known_of_the_share():
    assert statistics.wilson(0, 0)[1:] == (0.0, 1.0)


def test_surveys_that_repeat_one_another_count_once():
    passed = np.repeat([1, 1, 0, 1, 0, 0, 1, 1], 25)
    found = statistics.share(passed, np.repeat(np.arange(8), 25))
    np.testing.assert_allclose(found, statistics.wilson(5, 8), rtol=0.1)  # design effect with k/(k-1): 7/8 of 8


def test_surveys_that_do_not_resemble_count_each():
    rng = np.random.default_rng(3)
    passed, units = rng.random(2000) < 0.7, np.repeat(np.arange(200), 10)
    found, free = statistics.share(passed, units), statistics.wilson(passed.sum(), 2000)
    assert found.high - found.low == pytest.approx(free.high - free.low, rel=0.15)  # 200 units: variance known to 10 %


def test_the_bootstrap_of_a_median_has_the_spread_of_theory():
    values = np.random.default_rng(0).standard_normal(400)
    found = statistics.bootstrap(values, statistics.median)
    sigma = np.sqrt(np.pi / 2 / 400)  # of the median of a normal sample, asymptotically
    assert found.value == np.median(values)
    assert found.high - found.low == pytest.approx(2 * 1.96 * sigma, rel=0.3)  # density at one median: 20 to 30 %


def test_the_bootstrap_draws_whole_units():
    unit_means = np.random.default_rng(0).standard_normal(40)
    values, units = np.repeat(unit_means, 50), np.repeat(np.arange(40), 50)
    whole, free = (statistics.bootstrap(values, statistics.median, u) for u in (units, None))
    assert (whole.high - whole.low) > 3 * (free.high - free.low)


def test_rank_correlation_is_spearmans_and_its_interval_holds_the_truth_as_often_as_it_says():
    rng, rho = np.random.default_rng(1), 0.6
    truth = 6 / np.pi * np.arcsin(rho / 2)  # Spearman's of a normal pair
    held = 0
    for _ in range(200):
        x, y = rng.multivariate_normal([0, 0], [[1, rho], [rho, 1]], 60).T
        found = statistics.rank_correlation(x, y)
        assert found.value == pytest.approx(stats.spearmanr(x, y).statistic)
        held += found.low <= truth <= found.high
    assert 0.95 - 3 * np.sqrt(0.95 * 0.05 / 200) < held / 200  # three standard errors


def test_sobol_indices_are_those_of_ishigamis_function():
    x = np.pi * (2 * points("saltelli", 1024, 3, 0) - 1)
    y = np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    found = statistics.sobol_indices(y, 3)
    first, total = (0.3139, 0.4424, 0.0), (0.5576, 0.4424, 0.2437)  # Ishigami & Homma 1990
    for index, s, t in zip(found, first, total, strict=True):
        assert index.first.low <= s <= index.first.high
        assert index.total.low <= t <= index.total.high
        assert abs(index.total.value - t) < 0.03


def test_what_a_key_explains_is_its_share_of_the_variance():
    rng = np.random.default_rng(2)
    x, z = rng.random(4000), rng.random(4000)
    groups = statistics.groups_of(x)
    assert statistics.explained(groups, x) == pytest.approx(0.99, abs=0.003)  # ten bins leave 1/100
    assert statistics.explained(groups, z) < 0.005
    assert statistics.explained(groups, x + z) == pytest.approx(0.5, abs=0.03)
    assert statistics.explained(groups, (x - 0.5) ** 2) > 0.9  # no trend, all the same explained


@pytest.mark.parametrize("rising", [False, True])
def test_a_clean_threshold_lies_halfway_between_the_last_good_and_the_first_bad(rising):
    x = np.arange(20.0)
    found = statistics.threshold(x, (x > 12) == rising, 0.9, rising, x)
    assert found.value == 12.5
    assert found.low <= 12.5 <= found.high


def test_a_threshold_is_found_where_the_probability_crosses(monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 200)
    rng, off, held = np.random.default_rng(0), [], 0
    for _ in range(25):
        x = rng.uniform(0, 10, 300)
        found = statistics.threshold(x, rng.random(300) < 1 / (1 + np.exp(2 * (x - 6))), 0.8, False, np.arange(300))
        truth = 6 - np.log(0.8 / 0.2) / 2
        off.append(found.value - truth)
        held += found.low <= truth <= found.high
    assert abs(np.mean(off)) < 3 * 0.3 / 5  # one estimate is off by 0.3
    assert held >= 18  # of 25: an interval of 95 % that holds in 91 %, as the bootstrap of such a fit does, and chance


def test_a_threshold_beyond_what_was_flown_is_infinite():
    x = np.arange(10.0)
    assert statistics.threshold(x, x > -1, 0.5, False, x).value == np.inf
    assert statistics.threshold(x, x < -1, 0.5, False, x).value == -np.inf


def test_how_often_above_is_the_share_of_pairs():
    assert statistics.how_often_above([2, 3], [1, 2]) == (0.5 + 1 + 1 + 1) / 4
