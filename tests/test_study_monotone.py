"""Limits of keys and maps of the passing region: intervals contain the truth, also if the surrogate refuses some."""

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.special import expit, logit

from twin.studies.answers import PassRecord, answers_of_ranges, limit_of_key, regress
from twin.studies.monotone import falling_curve, isotonic_table, passing_map
from twin.studies.statistics import clustered_proportion, exact_interval, trials_to_show


def record(passed, required, unknown=None):
    unknown = np.zeros(len(passed), bool) if unknown is None else unknown
    return PassRecord(passed, np.arange(len(passed)), required, unknown)


def limit_and_answers(x, results):
    regression = regress(x, results)
    answers = answers_of_ranges(regression)
    return limit_of_key(regression, answers), answers


LONG = [(n, width, required) for n in (120, 400) for width in (0.03, 0.2) for required in (0.8, 0.9)]


@pytest.mark.parametrize(
    ("n", "width", "required", "repetitions"),
    [(120, 0.08, 0.9, 150), (60, 0.08, 0.5, 150), *(pytest.param(*law, 300, marks=pytest.mark.long) for law in LONG)],
)
def test_the_interval_of_a_limit_contains_that_of_a_logistic_law(n, width, required, repetitions):
    """At least 90 % of nominal 95 % intervals: three standard errors below 95 % are 90 to 91 %."""
    rng, truth, covered, known = np.random.default_rng(n), 0.5 - width * logit(required), 0, 0
    for _ in range(repetitions):
        x = rng.random(n)
        limit, _ = limit_and_answers(x, record(rng.random(n) < expit((0.5 - x) / width), required))
        known += limit is not None
        covered += limit is not None and limit.low <= truth <= limit.high
    assert known > 0.7 * repetitions and covered >= 0.9 * known


@pytest.mark.parametrize(("begin", "refused"), [(0.4, (0.3, 0.95)), (0.2, (0.95, 0.3))])
@pytest.mark.parametrize("law", [lambda x: expit((0.5 - x) / 0.08), lambda x: np.where(x < 0.5, 0.97, 0.2)])
def test_refusals_that_depend_on_the_key_do_not_bias_a_claim(law, begin, refused):
    """The surrogate refuses most surveys at large x that would fail, or most that would pass."""
    rng, required, wrong, biased, inside = np.random.default_rng(0), 0.8, 0, [], 0
    truth = optimize.root_scalar(lambda x: law(x) - required, bracket=(0, 1)).root
    mean = law(np.linspace(0, 1, 10001)).mean()
    for _ in range(40):
        x = rng.random(200)
        passed = rng.random(200) < law(x)
        unknown = (x > begin) & (rng.random(200) < np.where(passed, *refused))
        results = record(passed & ~unknown, required, unknown)
        biased.append(passed[~unknown].mean() - mean)
        proportion = clustered_proportion(results.passed, results.clusters, unknown)
        inside += proportion.low <= mean <= proportion.high
        limit, answers = limit_and_answers(x, results)
        wrong += limit is not None and not limit.low <= truth <= limit.high
        for answer in answers:
            wrong += answer.verdict == "passes" and answer.high > truth
            wrong += answer.verdict == "fails" and answer.low < truth
    assert abs(np.mean(biased)) > 0.1  # what the known results alone would claim
    assert inside >= 37 and wrong <= 5


@pytest.mark.parametrize(("k", "required"), [(4, 0.7), (2, 0.4), (5, 0.9)])
def test_the_likelihood_ratio_is_that_of_the_constrained_regression(k, required):
    """Against a general optimiser, with the pass probability at value number k fixed."""
    x, passed = np.arange(8.0), np.array([1, 1, 0, 1, 1, 0, 0, 1], bool)
    curve = falling_curve(np.repeat(x, 6), np.tile(passed, 6), np.arange(48), rises=False)

    def deviance(p):
        p = np.clip(p, 1e-9, 1 - 1e-9)
        return -2 * np.sum(curve.passes * np.log(p) + (curve.n - curve.passes) * np.log(1 - p))

    falling = optimize.LinearConstraint(np.eye(8)[:-1] - np.eye(8)[1:], 0, np.inf)
    bounds = [(0.01, 0.99)] * 8
    free, fixed = (
        optimize.minimize(
            deviance, np.linspace(0.95, 0.35, 8), bounds=limits, constraints=falling, method="SLSQP",
            options={"maxiter": 2000, "ftol": 1e-12},
        ).fun
        for limits in (bounds, [*bounds[:k], (required, required), *bounds[k + 1 :]])
    )  # fmt: skip
    assert fixed - free > 0.1 and curve.deviance_at(k, required) == pytest.approx(fixed - free, abs=0.02)


def test_identical_surveys_of_a_sample_show_no_more_than_one():
    rng = np.random.default_rng(0)
    x = rng.random(60)
    passed = rng.random(60) < expit((0.5 - x) / 0.1)
    single = falling_curve(x, passed, np.arange(60), rises=False)
    repeated = falling_curve(np.repeat(x, 10), np.repeat(passed, 10), np.repeat(np.arange(60), 10), rises=False)
    assert repeated.design_effect == pytest.approx(10)
    assert repeated.shown(0.6) == single.shown(0.6) != (0, 60)


def test_more_passes_only_raise_what_is_shown():
    """So that the bounds with all unknown results failed, and passed, are those over every possible outcome."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        x, passed = rng.random(80), rng.random(80) < 0.6
        more = passed | (rng.random(80) < 0.3)
        lower, higher = (falling_curve(x, y, np.arange(80), rises=False).shown(0.6) for y in (passed, more))
        assert lower[0] <= higher[0] and lower[1] <= higher[1]


@pytest.mark.parametrize("seed", range(1, 5))
def test_the_table_is_the_least_squares_fit_that_falls_along_both_keys(seed):
    rng = np.random.default_rng(seed)
    target, weights = rng.random((4, 3)), rng.integers(1, 9, (4, 3)).astype(float)

    def loss(values):
        return float(np.sum(weights * (values.reshape(4, 3) - target) ** 2))

    cells = np.arange(12).reshape(4, 3)
    pairs = [
        *zip(cells[:-1].ravel(), cells[1:].ravel(), strict=True),
        *zip(cells[:, :-1].ravel(), cells[:, 1:].ravel(), strict=True),
    ]
    rows = np.array([np.eye(12)[i] - np.eye(12)[j] for i, j in pairs])
    best = optimize.minimize(loss, np.zeros(12), constraints=optimize.LinearConstraint(rows, 0, np.inf), method="SLSQP")
    np.testing.assert_allclose(isotonic_table(target, weights, sweeps=500).ravel(), best.x, atol=1e-3)
    np.testing.assert_allclose(isotonic_table(target, weights).ravel(), best.x, atol=0.02)


def test_a_few_surveys_show_nothing_in_a_map():
    x, passed = np.random.default_rng(0).random((2, 16)), np.ones(16)
    for results in ((passed, passed), (0 * passed, 0 * passed)):
        assert not passing_map(("a", "b"), x, (False, False), results).verdicts(0.9 if results[0].any() else 0.1).any()


def test_the_map_of_two_keys_is_rarely_wrong_and_finds_the_region():
    rng, required, wrong, found, n_cells = np.random.default_rng(1), 0.8, 0, 0, 0
    for _ in range(5):
        x = rng.random((2, 400))
        passed = (rng.random(400) < expit((1.0 - x[0] - (1 - x[1])) / 0.08)).astype(float)
        verdicts = passing_map(("a", "b"), x, (False, True), (passed, passed))
        shown = verdicts.verdicts(required)
        middle = [(edges[1:] + edges[:-1]) / 2 for edges in verdicts.edges]
        truth = expit((middle[1][None, :] - middle[0][:, None]) / 0.08)
        wrong += np.sum((shown == 1) & (truth < required)) + np.sum((shown == -1) & (truth >= required))
        found, n_cells = found + np.sum(shown != 0), n_cells + shown.size
    assert found > 0.6 * n_cells and wrong <= 0.025 * n_cells


@pytest.mark.parametrize(
    ("required", "failures", "needed"), [(0.9, 0, 36), (0.5, 0, 6), (0.9, 1, 54), (0.9, 2, 70), (0.95, 0, 72)]
)
def test_the_number_of_trials_is_the_smallest_whose_exact_lower_bound_reaches_the_required_one(
    required, failures, needed
):
    assert trials_to_show(required, failures) == needed
    for n, enough in ((needed, True), (needed - 1, False)):
        low = stats.binomtest(n - failures, n).proportion_ci(0.95, method="exact").low
        assert (low >= required) is enough
        assert exact_interval(n - failures, n).low == pytest.approx(low, abs=1e-9)


def test_without_failures_the_number_has_a_closed_form():
    for required in (0.2, 0.5, 0.8, 0.9, 0.99):
        assert trials_to_show(required, 0) == np.ceil(np.log(0.025) / np.log(required))
    assert trials_to_show(1.0, 0) == np.inf
