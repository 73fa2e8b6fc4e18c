"""Confidence intervals and Sobol indices agree with closed forms and scipy, and intervals have their coverage."""

import numpy as np
import pytest
from scipy import stats

from twin.studies import statistics
from twin.studies.surveys import design_points


@pytest.mark.parametrize(("passed", "count"), [(0, 10), (3, 10), (10, 10), (86, 100), (1, 1)])
def test_wilsons_interval_equals_that_of_scipy(passed, count):
    reference = stats.binomtest(passed, count).proportion_ci(0.95, method="wilson")
    estimate = statistics.wilson_interval(passed, count)
    assert estimate.value == passed / count
    np.testing.assert_allclose(estimate[1:3], reference, atol=1e-12)


def test_without_surveys_the_interval_is_0_to_1():
    assert statistics.wilson_interval(0, 0)[1:3] == (0.0, 1.0)


def test_identical_surveys_of_a_cluster_count_as_one():
    passed = np.repeat([1, 1, 0, 1, 0, 0, 1, 1], 25)
    estimate = statistics.clustered_proportion(passed, np.repeat(np.arange(8), 25))
    # the variance between clusters is estimated with k/(k-1), so that the effective number is 7 instead of 8
    np.testing.assert_allclose(estimate, statistics.wilson_interval(5, 8), rtol=0.1)


def test_the_effective_number_is_that_of_the_unbiased_variance_of_the_means_of_clusters():
    fractions = np.array([0.8, 0.6, 0.4, 0.2])
    passed = np.concatenate([np.arange(25) < 25 * fraction for fraction in fractions])
    expected = 0.5 * 0.5 / (fractions.var(ddof=1) / 4)
    assert statistics.effective_number(passed, np.repeat(np.arange(4), 25)) == pytest.approx(expected)


def test_trials_of_unknown_outcome_count_as_failures_at_the_lower_and_as_successes_at_the_upper_bound():
    found = statistics.clustered_proportion([1, 1, 1, 0, 0, 0], np.arange(6), unknown=[0, 0, 0, 0, 1, 1])
    assert (found.value, found.most) == (3 / 6, 5 / 6)
    assert found[1:3] == (statistics.wilson_interval(3, 6).low, statistics.wilson_interval(5, 6).high)
    assert statistics.wilson_interval(3, 4, unknown=2) == found
    assert statistics.wilson_interval(0, 0, unknown=3) == (0.0, 0.0, 1.0, 1.0)


def test_unknown_values_may_be_anything_in_the_interval_of_a_median():
    values, clusters = np.arange(40.0), np.arange(40)
    few, many = (
        statistics.bootstrap_with_unknown(values, statistics.median, clusters, np.arange(40, 40 + n)) for n in (10, 50)
    )
    known = statistics.bootstrap_interval(values, statistics.median)
    assert few.value == known.value and few.low < known.low < known.high < few.high
    assert few.low < 15 and few.high > 24  # the medians with all ten below, and above, the known values
    assert many[1:] == (-np.inf, np.inf)


def test_uncorrelated_surveys_of_a_cluster_count_individually():
    rng = np.random.default_rng(3)
    passed, clusters = rng.random(2000) < 0.7, np.repeat(np.arange(200), 10)
    estimate = statistics.clustered_proportion(passed, clusters)
    independent = statistics.wilson_interval(passed.sum(), 2000)
    # with 200 clusters, the standard error of the variance is 10 %
    assert estimate.high - estimate.low == pytest.approx(independent.high - independent.low, rel=0.15)


def test_the_bootstrap_interval_of_a_median_has_the_asymptotic_width():
    values = np.random.default_rng(0).standard_normal(400)
    estimate = statistics.bootstrap_interval(values, statistics.median)
    sigma = np.sqrt(np.pi / 2 / 400)  # of the median of a normal sample, asymptotically
    assert estimate.value == np.median(values)
    assert estimate.high - estimate.low == pytest.approx(
        2 * 1.96 * sigma, rel=0.3
    )  # the interval depends on the density near the median, known to 20 to 30 %


def test_the_bootstrap_resamples_whole_clusters():
    cluster_means = np.random.default_rng(0).standard_normal(40)
    values, clusters = np.repeat(cluster_means, 50), np.repeat(np.arange(40), 50)
    clustered, independent = (statistics.bootstrap_interval(values, statistics.median, c) for c in (clusters, None))
    assert (clustered.high - clustered.low) > 3 * (independent.high - independent.low)


def test_rank_correlation_is_spearmans_and_its_interval_has_95_percent_coverage():
    rng, rho = np.random.default_rng(1), 0.6
    truth = 6 / np.pi * np.arcsin(rho / 2)  # Spearman's correlation of a bivariate normal
    covered = 0
    for _ in range(200):
        x, y = rng.multivariate_normal([0, 0], [[1, rho], [rho, 1]], 60).T
        estimate = statistics.rank_correlation(x, y)
        assert estimate.value == pytest.approx(stats.spearmanr(x, y).statistic)
        covered += estimate.low <= truth <= estimate.high
    assert 0.95 - 3 * np.sqrt(0.95 * 0.05 / 200) < covered / 200  # three standard errors


def test_sobol_indices_of_the_ishigami_function_equal_its_closed_form():
    x = np.pi * (2 * design_points("saltelli", 1024, 3, 0) - 1)
    y = np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    estimate = statistics.sobol_indices(y, 3)
    first, total = (0.3139, 0.4424, 0.0), (0.5576, 0.4424, 0.2437)  # Ishigami & Homma 1990
    for index, s, t in zip(estimate, first, total, strict=True):
        assert index.first.low <= s <= index.first.high
        assert index.total.low <= t <= index.total.high
        assert abs(index.total.value - t) < 0.03


def test_sobol_indices_are_those_of_scipy_and_their_bounds_the_same_each_time():
    """The bounds once depended on the state of numpy's global generator."""
    y = np.random.default_rng(0).standard_normal((4, 1, 16)).cumsum(axis=0)
    once, again = (statistics.sobol_indices(y.ravel(), 2) for _ in range(2))
    assert once == again
    reference = stats.sobol_indices(func={"f_A": y[0], "f_B": y[1], "f_AB": y[2:]}, n=16)
    for order, values in (("first", reference.first_order), ("total", reference.total_order)):
        np.testing.assert_allclose([getattr(index, order).value for index in once], np.ravel(values))


def test_explained_variance_of_a_sum_is_the_fraction_of_each_term():
    rng = np.random.default_rng(2)
    x, z = rng.random(4000), rng.random(4000)
    groups = statistics.group_indices(x)
    assert statistics.explained_variance(groups, x) == pytest.approx(0.99, abs=0.003)  # variance within ten bins: 1/100
    assert statistics.explained_variance(groups, z) < 0.005
    assert statistics.explained_variance(groups, x + z) == pytest.approx(0.5, abs=0.03)
    assert statistics.explained_variance(groups, (x - 0.5) ** 2) > 0.9  # no monotone trend, but explained


def test_an_interval_of_equal_values_is_undefined_instead_of_zero_width():
    assert np.isnan(statistics.bootstrap_interval(np.full(20, 3.0), statistics.median)[1:]).all()


@pytest.mark.parametrize(("passed", "n", "required"), [(30, 32, 0.9), (1, 1, 0.9), (7, 8, 0.8), (12, 20, 0.7)])
def test_the_stated_number_of_further_surveys_decides_at_the_same_fraction(passed, n, required):
    record = np.arange(n) < passed
    more = statistics.surveys_to_decide(record, np.arange(n), required)
    fraction = passed / n
    assert statistics.wilson_interval(passed, n).low < required < statistics.wilson_interval(passed, n).high
    before, after = (statistics.wilson_interval(fraction * m, m) for m in (n + more - 1, n + more))
    assert before.low < required < before.high
    assert not after.low < required < after.high


@pytest.mark.parametrize(("passed", "required"), [([1, 0], 0.5), ([1, 1], 1.0), ([], 0.9)])
def test_no_number_of_surveys_decides_at_the_required_fraction_or_for_certainty(passed, required):
    assert statistics.surveys_to_decide(passed, np.arange(len(passed)), required) == np.inf


@pytest.mark.parametrize(("passed", "clusters"), [([1], [0]), ([0] * 6, range(6)), ([1] * 6, [0] * 6), ([], [])])
def test_the_interval_of_a_proportion_never_has_zero_width(passed, clusters):
    interval = statistics.clustered_proportion(passed, list(clusters))
    assert interval.high - interval.low > 0.1
