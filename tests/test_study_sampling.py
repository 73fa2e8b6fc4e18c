"""Samples follow their distributions and fill the space; their seeds are paired; more samples extend fewer ones."""

import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc
from study_surveys import STUDY, study_of

from twin.studies.distribution import Distribution
from twin.studies.runner import refusal_notice
from twin.studies.surveys import design_points, samples, seeds_of_sample

PROBABILITIES = (np.arange(2000) + 0.5) / 2000


@pytest.mark.parametrize(
    ("parameters", "reference"),
    [
        ({"uniform": (2.0, 5.0)}, stats.uniform(2.0, 3.0)),
        ({"log_uniform": (0.5, 40.0)}, stats.loguniform(0.5, 40.0)),
        ({"normal": (3.0, 0.2)}, stats.norm(3.0, 0.2)),
        ({"truncated_normal": (1.0, 0.5, 0.8, 1.2)}, stats.truncnorm(-0.4, 0.4, loc=1.0, scale=0.5)),
    ],
)
def test_quantiles_are_those_of_the_distribution(parameters, reference):
    values = np.array(Distribution(**parameters).quantiles(PROBABILITIES))
    np.testing.assert_allclose(reference.cdf(values), PROBABILITIES, atol=1e-9)


@pytest.mark.parametrize("parameters", [{"normal": (0.0, 1.0)}, {"truncated_normal": (0.0, 1.0, -1.0, 1.0)}])
def test_quantiles_are_finite_at_0_and_1(parameters):
    assert np.isfinite(Distribution(**parameters).quantiles(np.array([0.0, 1.0]))).all()


def test_all_choices_have_equal_probability():
    assert (
        Distribution(choice=("a", "b", "c", "d")).quantiles(PROBABILITIES)
        == ["a"] * 500 + ["b"] * 500 + ["c"] * 500 + ["d"] * 500
    )


def test_a_latin_hypercube_has_one_point_in_every_stratum_of_every_axis():
    strata = np.sort(np.floor(design_points("lhs", 50, 3, seed=4) * 50).astype(int), axis=0)
    assert (strata == np.arange(50)[:, None]).all()


def test_sobol_points_have_one_point_in_every_elementary_interval():
    cells = np.floor(design_points("sobol", 64, 2, seed=4) * 8).astype(int)
    assert len(np.unique(cells, axis=0)) == 64  # a (0, 2)-net: one point in each of the 8 x 8 cells, scrambled or not


def test_sobol_and_lhs_have_a_lower_discrepancy_than_random_points():
    discrepancy = {method: qmc.discrepancy(design_points(method, 128, 3, 0)) for method in ("random", "lhs", "sobol")}
    assert discrepancy["sobol"] < discrepancy["lhs"] < discrepancy["random"]


@pytest.mark.parametrize("method", ["random", "sobol"])
def test_more_samples_begin_with_those_of_fewer(method):
    np.testing.assert_array_equal(design_points(method, 64, 3, 7)[:16], design_points(method, 16, 3, 7))


def test_each_block_of_saltellis_design_takes_one_column_of_b():
    a, b, *mixed = design_points("saltelli", 8, 3, 0).reshape(5, 8, 3)
    for k, block in enumerate(mixed):
        others = np.arange(3) != k
        np.testing.assert_array_equal(block[:, k], b[:, k])
        np.testing.assert_array_equal(block[:, others], a[:, others])
    assert np.abs(a - b).min() > 0


def test_joint_values_stay_in_their_rows_and_all_rows_have_equal_probability(tmp_path):
    values_of_samples = [sample.values for sample in samples(study_of(tmp_path))]
    pairs = [(values["water.jerlov"], values["sun.illuminance_lx"]) for values in values_of_samples]
    assert sorted(pairs) == [("IB", 20.0)] * 6 + [("III", 0.0)] * 6


def test_a_grid_is_combined_with_every_design_point(tmp_path):
    grid = "plan.tracks = { grid = [1, 2, 3] }\nplan.altitude_m = { grid = [1.8, 2.0] }"
    all_samples = list(samples(study_of(tmp_path, STUDY, ("plan.altitude_m = { uniform = [1.6, 2.4] }", grid))))
    assert [sample.number for sample in all_samples] == list(range(72))
    for point in range(12):
        cells = [sample.values for sample in all_samples if sample.point == point]
        assert {(v["plan.tracks"], v["plan.altitude_m"]) for v in cells} == {
            (t, a) for t in (1, 2, 3) for a in (1.8, 2)
        }
        assert len({v["water.turbidity"] for v in cells}) == 1


@pytest.mark.parametrize("method", ["random", "saltelli"])
@pytest.mark.parametrize("vary", ["", "[vary]\nwater.turbidity = { uniform = [1.0, 2.0] }"])
def test_the_number_of_planned_surveys_is_that_of_the_surveys(method, vary, tmp_path):
    text = f'scenario = "reef"\n{vary}\n[sampling]\nmethod = "{method}"\nseeds = 3\nsamples = {4 if vary else 1}'
    study = study_of(tmp_path, text)
    assert study.n_surveys == 3 * len(list(samples(study)))


def test_a_single_refused_sample_is_reported_in_the_singular():
    assert refusal_notice({4: "too low"}) == "1 sample cannot be flown and is left out: sample 4: too low"
    expected = "2 samples cannot be flown and are left out, e.g. sample 4: too low"
    assert refusal_notice({7: "too high", 4: "too low"}) == expected


def test_samples_share_their_seeds_unless_paired_is_false(tmp_path):
    many = ("samples = 12", "samples = 12\nseeds = 3\nseed = 5")
    paired, unpaired = (
        study_of(tmp_path, STUDY, many),
        study_of(tmp_path, STUDY, (many[0], many[1] + "\npaired = false")),
    )
    assert {tuple(seeds_of_sample(paired, sample)) for sample in samples(paired)} == {(5, 6, 7)}
    seeds = [seed for sample in samples(unpaired) for seed in seeds_of_sample(unpaired, sample)]
    assert len(set(seeds)) == 36
