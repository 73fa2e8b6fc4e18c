"""Water tables: values of the sources, band integration, missing values and provenance."""

import numpy as np
import pytest

from twin.errors import TwinError
from twin.imaging import water_tables
from twin.imaging.water import JERLOV_PER_M
from twin.imaging.water_tables import NM, SOURCES, band_coefficients, band_weights

jerlov = pytest.importorskip("jerlov")
pytestmark = pytest.mark.filterwarnings("ignore:.*flagged values")


@pytest.mark.parametrize("name", [name for name in JERLOV_PER_M if name not in ("clear", "3C", "5C", "7C")])
def test_the_tables_agree_with_the_rgb_table_at_its_true_wavelengths(name):
    """The RGB table of `water` fits Solonenko & Mobley at 680, 550 and 441 nm, though it names 650 and 450."""
    water = jerlov.water(name, source="solonenko2015")
    absorption, scattering = JERLOV_PER_M[name]
    np.testing.assert_allclose([water.a(nm) for nm in (680, 550, 441)], absorption, rtol=0.015)
    np.testing.assert_allclose([water.b(nm) for nm in (680, 550, 441)], scattering, rtol=0.05)


def test_sources_differ_as_stated():
    names = "IB", "II", "III", "1C", "3C"
    first, second = ([jerlov.water(name, source=source).b(550) for name in names] for source in SOURCES)
    np.testing.assert_allclose(np.divide(second, first), [2.3, 0.49, 0.29, 1.2, 0.61], rtol=0.03)


def test_a_band_of_one_wavelength_is_the_table_and_a_wide_band_its_mean(monkeypatch):
    water = jerlov.water("II", source="solonenko2015")
    monkeypatch.setattr(water_tables, "BAND_SHAPES_NM", ((600.0, 0.1), (550.0, 0.1), (450.0, 0.1)))
    narrow = band_coefficients("II")
    np.testing.assert_allclose(narrow.absorption_per_m, [water.a(nm) for nm in (600, 550, 450)], rtol=1e-9)
    monkeypatch.setattr(water_tables, "BAND_SHAPES_NM", ((550.0, 1e6),) * 3)
    np.testing.assert_allclose(band_coefficients("II").scattering_per_m, np.mean(water.b(NM)), rtol=1e-6)


def test_the_effective_absorption_of_a_wide_band_falls_with_the_path():
    """Light at the strongly absorbed wavelengths is lost first; the limit of a short path is the mean."""
    paths = (0.0, 1e-4, 1.0, 4.0, 16.0)
    red = [band_coefficients("II", path_m=path).absorption_per_m[0] for path in paths]
    assert red[1] == pytest.approx(red[0], rel=1e-4) and (np.diff(red[1:]) < 0).all()
    weights = band_weights()[0] @ np.exp(-4.0 * jerlov.water("II", source="solonenko2015").a(NM))
    assert red[3] == pytest.approx(-np.log(weights) / 4.0)


def test_light_of_one_wavelength_gives_its_coefficients():
    light = (NM == 530).astype(float)
    found = band_coefficients("1C", "williamson2022", light=light)
    np.testing.assert_allclose(found.absorption_per_m, jerlov.water("1C").a(530), rtol=1e-9)


def test_provenance_names_source_and_doubts():
    assert "10.1364/AO.54.005392" in band_coefficients("II").provenance
    assert "flagged" in band_coefficients("I").provenance


@pytest.mark.parametrize(
    ("water_type", "source", "field"),
    [
        ("II", "mobley", "water.source"),
        ("5C", "solonenko2015", "water.jerlov"),
        ("9C", "williamson2022", "water.jerlov"),
        ("X", "solonenko2015", "water.jerlov"),
    ],
)
def test_unknown_waters_are_refused(water_type, source, field):
    with pytest.raises(TwinError, match=field):
        band_coefficients(water_type, source)
