"""Phase functions: normalisation, published moments, closed forms, and samples that follow the table."""

import numpy as np
import pytest
from scipy.integrate import quad

from twin.imaging.light.phase_function import CELLS, Scatterer, molecular_scattering_per_m, phase_of, table_of
from twin.imaging.light.water import scatterers
from twin.imaging.reference.directions import density_at, sample_angle, sample_cosine
from twin.scenario.model import WaterConfig

SCATTERERS = {
    "molecular": Scatterer(molecular_share=1.0),
    "petzold": Scatterer(),
    "henyey_greenstein": Scatterer("henyey_greenstein", 0.0, (0.924,)),
    "fournier_forand": Scatterer("fournier_forand", 0.0, (1.10, 3.5835)),
}


def mean_cosine_of(table):
    cosine = 1 - 2 * np.linspace(0.0, 1.0, len(table.cumulative)) ** 4
    return float((np.diff(table.cumulative) * (cosine[1:] + cosine[:-1]) / 2).sum())


@pytest.mark.parametrize("name", SCATTERERS)
def test_a_phase_function_integrates_to_one(name):
    """By quadrature over the logarithm of the angle, from 1e-9 deg: the share below is 3e-7 of Petzold's function."""
    cuts = np.log(np.deg2rad([1e-9, 1e-5, 1e-3, 0.1, 1, 5, 20, 60, 180]))

    def light(log_angle):
        angle = np.exp(log_angle)
        return 2 * np.pi * np.sin(angle) * angle * float(phase_of(SCATTERERS[name], np.array(angle)))

    parts = [quad(light, *pair, limit=100, epsrel=1e-5)[0] for pair in zip(cuts, cuts[1:], strict=False)]
    assert sum(parts) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "mean_cosine", "backscatter"),
    [
        ("molecular", 0.0, 0.5),
        ("petzold", 0.924, 0.0183),  # Mobley et al. 1993, Mobley 1994 p. 111
        ("fournier_forand", None, 0.0183),  # Mobley et al. 2002: n = 1.10 and slope 3.5835 fit Petzold's fraction
        ("henyey_greenstein", 0.924, (1 - 0.924) / (2 * 0.924) * ((1 + 0.924) / np.sqrt(1 + 0.924**2) - 1)),
    ],
)
def test_mean_cosine_and_backscatter_fraction_are_the_published_ones(name, mean_cosine, backscatter):
    table = table_of(SCATTERERS[name])
    backward = np.linspace(0.0, 1.0, len(table.cumulative)) ** 4 >= 0.5  # the cells beyond 90 deg
    assert 1 - table.cumulative[backward][0] == pytest.approx(backscatter, rel=0.01)
    if mean_cosine is not None:
        assert mean_cosine_of(table) == pytest.approx(mean_cosine, abs=5e-4)


def test_a_mixture_has_the_weighted_mean_cosine():
    mixed, particles = (mean_cosine_of(table_of(Scatterer(molecular_share=share))) for share in (0.3, 0.0))
    assert mixed == pytest.approx(0.7 * particles, abs=1e-5)


def test_molecules_scatter_all_light_of_the_clearest_water_and_little_of_turbid_water():
    """Morel (1974) gives 0.00193 /m at 550 nm for sea water (Mobley 1994, Table 3.8)."""
    assert molecular_scattering_per_m(np.array(550.0)) == pytest.approx(0.00193, rel=0.02)
    settings = WaterConfig(phase_function="sea")
    clearest, turbid = (mean_cosine_of(table_of(scatterers(settings, np.full(3, b))[1])) for b in (0.001, 0.98))
    assert clearest == pytest.approx(0, abs=1e-6)
    assert turbid == pytest.approx((1 - 0.00215 / 0.98) * 0.92417, abs=1e-4)  # 0.00215 /m at 535 nm


@pytest.mark.parametrize("name", SCATTERERS)
def test_sampled_angles_follow_the_table(name):
    """Kolmogorov-Smirnov: the largest difference of 5000 samples exceeds 1.95 / sqrt(n) with probability 0.001."""
    table, rng, n = table_of(SCATTERERS[name]), np.random.default_rng(1), 5000
    cosines = np.sort([sample_cosine(table.cumulative, rng) for _ in range(n)])[::-1]
    expected = np.interp(((1 - cosines) / 2) ** 0.25, np.linspace(0, 1, CELLS + 1), table.cumulative)
    assert np.abs(expected - (np.arange(n) + 0.5) / n).max() < 1.95 / np.sqrt(n)
    angles = np.sort([sample_angle(table.cumulative_angle, rng) for _ in range(n)])
    edges = 2 * np.arcsin(np.linspace(0, 1, CELLS + 1) ** 2)
    expected = np.interp(angles, edges, table.cumulative_angle)
    assert np.abs(expected - (np.arange(n) + 0.5) / n).max() < 1.95 / np.sqrt(n)


def test_the_table_returns_the_formula_at_measured_angles():
    table = table_of(Scatterer())
    angles = np.deg2rad([0.2, 1.0, 10.0, 45.0, 90.0, 135.0, 178.0])
    found = [density_at(table.density_per_sr, np.cos(angle)) for angle in angles]
    np.testing.assert_allclose(found, phase_of(Scatterer(), angles), rtol=0.02)  # a cell is 0.8 % wide at 0.1 deg
