"""Samples follow their distributions, fill the space, pair their seeds, and do not depend on how many are drawn."""

import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc
from study_surveys import STUDY, study_of

from twin.study.design import points, samples, seeds
from twin.study.spread import Spread

SHARES = (np.arange(2000) + 0.5) / 2000


@pytest.mark.parametrize(
    ("spread", "law"),
    [
        ({"uniform": (2.0, 5.0)}, stats.uniform(2.0, 3.0)),
        ({"log_uniform": (0.5, 40.0)}, stats.loguniform(0.5, 40.0)),
        ({"normal": (3.0, 0.2)}, stats.norm(3.0, 0.2)),
        ({"truncated_normal": (1.0, 0.5, 0.8, 1.2)}, stats.truncnorm(-0.4, 0.4, loc=1.0, scale=0.5)),
    ],
)
def test_values_below_a_share_are_those_of_the_distribution(spread, law):
    values = np.array(Spread(**spread).at(SHARES))
    np.testing.assert_allclose(law.cdf(values), SHARES, atol=1e-9)


@pytest.mark.parametrize("spread", [{"normal": (0.0, 1.0)}, {"truncated_normal": (0.0, 1.0, -1.0, 1.0)}])
def test_the_ends_of_the_unit_interval_have_finite_values(spread):
    assert np.isfinite(Spread(**spread).at(np.array([0.0, 1.0]))).all()


def test_each_choice_comes_as_often_as_any_other():
    assert Spread(choice=("a", "b", "c", "d")).at(SHARES) == ["a"] * 500 + ["b"] * 500 + ["c"] * 500 + ["d"] * 500


def test_a_latin_hypercube_has_one_point_in_every_stratum_of_every_axis():
    strata = np.sort(np.floor(points("lhs", 50, 3, seed=4) * 50).astype(int), axis=0)
    assert (strata == np.arange(50)[:, None]).all()


def test_sobol_points_put_one_in_every_elementary_interval():
    cells = np.floor(points("sobol", 64, 2, seed=4) * 8).astype(int)
    assert len(np.unique(cells, axis=0)) == 64  # a (0, 2)-net: one point in each of the 8 x 8 cells, scrambled or not


def test_space_is_filled_better_than_by_chance():
    discrepancy = {method: qmc.discrepancy(points(method, 128, 3, 0)) for method in ("random", "lhs", "sobol")}
    assert discrepancy["sobol"] < discrepancy["lhs"] < discrepancy["random"]


@pytest.mark.parametrize("method", ["random", "sobol"])
def test_more_samples_begin_with_those_of_fewer(method):
    np.testing.assert_array_equal(points(method, 64, 3, 7)[:16], points(method, 16, 3, 7))


def test_saltellis_design_exchanges_one_column_at_a_time():
    a, b, *mixed = points("saltelli", 8, 3, 0).reshape(5, 8, 3)
    for k, block in enumerate(mixed):
        others = np.arange(3) != k
        np.testing.assert_array_equal(block[:, k], b[:, k])
        np.testing.assert_array_equal(block[:, others], a[:, others])
    assert np.abs(a - b).min() > 0


def test_keys_of_a_table_keep_together_and_every_row_comes_as_often(tmp_path):
    drawn = [sample.values for sample in samples(study_of(tmp_path))]
    pairs = [(values["water.jerlov"], values["sun.illuminance_lx"]) for values in drawn]
    assert sorted(pairs) == [("IB", 20.0)] * 6 + [("III", 0.0)] * 6


def test_a_grid_is_gone_through_with_every_draw(tmp_path):
    grid = "plan.tracks = { grid = [1, 2, 3] }\nplan.altitude_m = { grid = [1.8, 2.0] }"
    drawn = list(samples(study_of(tmp_path, STUDY, ("plan.altitude_m = { uniform = [1.6, 2.4] }", grid))))
    assert [sample.number for sample in drawn] == list(range(72))
    for draw in range(12):
        cells = [sample.values for sample in drawn if sample.draw == draw]
        assert {(v["plan.tracks"], v["plan.altitude_m"]) for v in cells} == {
            (t, a) for t in (1, 2, 3) for a in (1.8, 2)
        }
        assert len({v["water.turbidity"] for v in cells}) == 1


def test_settings_share_their_seeds_unless_they_are_told_not_to(tmp_path):
    many = ("samples = 12", "samples = 12\nseeds = 3\nseed = 5")
    paired, apart = study_of(tmp_path, STUDY, many), study_of(tmp_path, STUDY, (many[0], many[1] + "\npaired = false"))
    assert {tuple(seeds(paired, sample)) for sample in samples(paired)} == {(5, 6, 7)}
    drawn = [seed for sample in samples(apart) for seed in seeds(apart, sample)]
    assert len(set(drawn)) == 36
