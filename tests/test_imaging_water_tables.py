"""Water tables: values of the sources, missing values, integration over the bands, spectra of the light, provenance."""

import subprocess
import sys

import jerlov
import numpy as np
import pytest

from twin.errors import ScenarioError, TwinError
from twin.imaging.light import spectra
from twin.imaging.light.illumination import illumination_of
from twin.imaging.light.spectra import (
    CENTRE_NM,
    NM,
    WIDTH_NM,
    band_weights,
    effective_per_m,
    provenance_of,
    sensitivity,
    spectrum_of,
    water_spectrum,
)
from twin.imaging.light.water import Medium, clarity, downwelling_per_m, medium
from twin.scenario.file import load_scenario
from twin.scenario.model import WaterConfig
from twin.scenario.water_sources import WATER_SOURCES

pytestmark = pytest.mark.filterwarnings("ignore:.*flagged values")

WATERS = [(source, name) for source, table in WATER_SOURCES.items() for name in table.types]
#: Absorption and scattering [1/m] at 680, 550 and 441 nm: table of the Stonefish simulator, another transcription of
#: Solonenko & Mobley.
STONEFISH_PER_M = {
    "I": ((0.4601, 0.0620, 0.0176), (0.0008, 0.0017, 0.0042)),
    "IA": ((0.4612, 0.0622, 0.0223), (0.0021, 0.0035, 0.0068)),
    "IB": ((0.4612, 0.0623, 0.0239), (0.0431, 0.0536, 0.0700)),
    "II": ((0.4622, 0.0622, 0.0247), (0.2498, 0.3580, 0.5236)),
    "III": ((0.4651, 0.0646, 0.0411), (0.6834, 0.9800, 1.4325)),
    "1C": ((0.4803, 0.0760, 0.1198), (0.2538, 0.3650, 0.5340)),
    "9C": ((0.6207, 0.3480, 1.0553), (2.1720, 3.1200, 4.5610)),
}


def at(nm, spectrum):
    return np.interp(nm, NM, spectrum)


def test_the_scenario_knows_the_types_of_each_source():
    assert {name: table.types for name, table in WATER_SOURCES.items()} == {
        name: jerlov.SOURCES[name].water_types for name in WATER_SOURCES
    }


@pytest.mark.parametrize(("source", "name"), WATERS)
def test_spectra_agree_with_their_source_at_the_band_centres(source, name):
    water, found = jerlov.water(name, source=source), water_spectrum(name, source)
    given = np.isfinite(water.a(np.array(CENTRE_NM)))
    assert given.all() or (source, name) == ("solonenko2015", "5C")  # no absorption at 600 nm in print
    np.testing.assert_allclose(at(CENTRE_NM, found[0])[given], water.a(np.array(CENTRE_NM))[given], 1e-9)
    np.testing.assert_allclose(at(CENTRE_NM, found[1]), water.b(np.array(CENTRE_NM)), 1e-9)


@pytest.mark.parametrize("name", STONEFISH_PER_M)
def test_the_tables_agree_with_another_transcription(name):
    water = water_spectrum(name)
    absorption, scattering = STONEFISH_PER_M[name]
    np.testing.assert_allclose(at((680, 550, 441), water[0]), absorption, rtol=0.015)
    np.testing.assert_allclose(at((680, 550, 441), water[1]), scattering, rtol=0.05)


@pytest.mark.parametrize(("name", "first_nm"), [("3C", 675.0), ("5C", 600.0)])
def test_missing_absorption_lies_between_neighbouring_types_and_near_the_other_source(name, first_nm):
    end = first_nm <= NM
    found, clearer, murkier = (water_spectrum(other)[0][end] for other in (name, "1C", "7C"))
    assert (clearer < found).all() and (found < murkier).all()
    last, below, above = (at(first_nm - 25, water_spectrum(other)[0]) for other in (name, "1C", "7C"))
    np.testing.assert_allclose((found - clearer) / (murkier - clearer), (last - below) / (above - below), rtol=1e-9)
    assert (found > jerlov.pure_water_absorption(NM[end])).all()
    np.testing.assert_allclose(found, water_spectrum(name, "williamson2022")[0][end], rtol=0.16)


def test_the_rule_for_missing_absorption_predicts_the_printed_values_of_3c():
    nm = np.arange(575.0, 651.0, 25.0)
    printed, clearer, murkier = (jerlov.water(name, source="solonenko2015").a(nm) for name in ("3C", "1C", "7C"))
    predicted = spectra._filled(np.where(nm > 575.0, np.nan, printed), clearer, murkier)
    np.testing.assert_allclose(predicted, printed, rtol=0.005)


@pytest.mark.parametrize(("source", "name"), WATERS)
def test_absorption_is_not_below_that_of_pure_water(source, name):
    """Within 3 %: the sources use other values for pure water at 575 nm, and 25 nm apart."""
    centres = np.array(CENTRE_NM)
    pure = jerlov.pure_water_absorption(centres)
    assert (at(centres, water_spectrum(name, source)[0]) > 0.97 * pure).all()


def test_scattering_of_the_sources_differs_as_documented():
    names = WATER_SOURCES["williamson2022"].types
    first, second = ([at(550, water_spectrum(name, s)[1]) for name in names] for s in WATER_SOURCES)
    np.testing.assert_allclose(np.divide(second, first), [2.3, 0.49, 0.29, 1.2, 0.61, 0.89], rtol=0.03)


@pytest.mark.parametrize("name", WATER_SOURCES["solonenko2015"].types)
def test_kd_is_within_15_percent_of_jerlov_where_the_source_is(name):
    """At the band centres, for a sun 30 deg from the zenith, 22 deg in the water.

    The source is Kd computed from its a and b with HydroLight (Solonenko & Mobley 2015, tables 4 to 8).
    """
    nm = np.array(CENTRE_NM)
    water = jerlov.water(name, source="solonenko2015")
    measured = jerlov.water(name, source="jerlov1976").kd(nm)
    close = np.abs(water.kd_hydrolight(nm) / measured - 1) < 0.15
    spectra = (at(nm, values) for values in water_spectrum(name))
    found = downwelling_per_m(Medium(*spectra), np.sqrt(1 - (0.5 / 1.339) ** 2))
    np.testing.assert_allclose(found[close], measured[close], rtol=0.15)


def test_types_are_ordered_by_green_attenuation():
    attenuation = [sum(medium(WaterConfig(jerlov=name))[:2])[1] for name in WATER_SOURCES["solonenko2015"].types]
    ocean, coast = attenuation[:5], attenuation[5:]
    assert ocean == sorted(ocean) and coast == sorted(coast)


def test_bands_are_gaussians_between_400_and_700_nm():
    assert NM[0] == 400.0 and NM[-1] == 700.0
    for centre, width, band in zip(CENTRE_NM, WIDTH_NM, sensitivity(), strict=True):
        np.testing.assert_allclose(at((centre, centre + 1.17741 * width), band), (1.0, 0.5), rtol=2e-3)
    np.testing.assert_allclose(band_weights().sum(1), 1.0)
    np.testing.assert_allclose(band_weights(1 / NM), sensitivity() / sensitivity().sum(1, keepdims=True))  # photons
    blue_light = np.exp(-((NM - 450.0) ** 2) / 50.0)
    np.testing.assert_allclose(band_weights(blue_light) @ NM, 450.0, atol=5.0)


def test_the_effective_absorption_of_a_wide_band_falls_with_the_path():
    """Light at the strongly absorbed wavelengths is lost first; the limit of a short path is the mean."""
    per_m, weights = water_spectrum("II")[0], band_weights(spectrum_of("led"))
    paths = (0.0, 1e-4, 1.0, 4.0, 16.0, 1e4)
    red = [effective_per_m(per_m, weights, path)[0] for path in paths]
    assert red[1] == pytest.approx(red[0], rel=1e-4) and (np.diff(red[1:]) < 0).all()
    assert np.exp(-4.0 * red[3]) == pytest.approx(weights[0] @ np.exp(-4.0 * per_m))
    assert red[5] == pytest.approx(per_m.min(), rel=0.1)
    assert medium(WaterConfig(jerlov="II"), path_m=4.0)[0][0] == pytest.approx(red[3])


def test_a_scenario_takes_absorption_over_twice_the_altitude_under_its_light():
    lit = load_scenario("reef", ["plan.altitude_m=1.5", "water.jerlov=II"])
    sunny = load_scenario("reef", ["plan.altitude_m=1.5", "water.jerlov=II", "lamps=[]", "sun.illuminance_lx=9"])
    for scenario, light in ((lit, "led"), (sunny, "daylight")):
        want = medium(scenario.water, path_m=3.0, light=light)[0]
        np.testing.assert_array_equal(illumination_of(scenario).water.absorption_per_m, want)
    deep = load_scenario("reef", ["water.jerlov=II", "sun.illuminance_lx=9", "sun.depth_m=20.0"])
    daylight = illumination_of(deep).daylight
    mean_cosine = daylight.source.mean_cosine
    want = downwelling_per_m(medium(deep.water, path_m=20.0 / mean_cosine, light="daylight"), mean_cosine)
    np.testing.assert_array_equal(daylight.attenuation_per_m, want)


def test_the_led_has_the_chromaticity_that_the_cie_publishes():
    """LED-B5: x = 0.3118, y = 0.3236 (CIE 015:2018); 0.3 % of its light is outside of the tabulated 400 to 700 nm."""
    nm, cmf = jerlov.cie_1931_cmf()
    xyz = np.array([np.interp(NM, nm, curve) @ spectrum_of("led") for curve in cmf.T])
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), [0.3118, 0.3236], atol=1e-3)


def test_the_source_is_named():
    assert provenance_of(WaterConfig(jerlov="II", source="williamson2022")) == (
        "Jerlov II (Williamson & Hollins 2022), turbidity 1; b at 550 nm is 2 times as large in Solonenko & Mobley 2015"
    )
    assert provenance_of(WaterConfig(jerlov="9C")) == "Jerlov 9C (Solonenko & Mobley 2015), turbidity 1"
    assert provenance_of(WaterConfig(jerlov="clear")) == "clear, turbidity 1"
    # a visibility replaces the scattering of the source
    assert provenance_of(WaterConfig(visibility_m=6)) == "Jerlov IB (Solonenko & Mobley 2015), visibility 6 m"


@pytest.mark.parametrize("jerlov", ["I", "IB", "3C"])
def test_a_water_has_the_visibility_that_is_asked_of_it(jerlov):
    water = WaterConfig(jerlov=jerlov, visibility_m=6.0)
    c = medium(water, light="daylight").attenuation_per_m[1]
    assert 4.8 / c == pytest.approx(6.0) and clarity(water).visibility_m == pytest.approx(6.0)
    # the absorption is that of the Jerlov type
    np.testing.assert_array_equal(medium(water).absorption_per_m, medium(WaterConfig(jerlov=jerlov)).absorption_per_m)
    assert clarity(WaterConfig(jerlov=jerlov, visibility_m=3.0)).secchi_m < clarity(water).secchi_m < 12


def test_the_clarity_of_oceanic_waters_is_that_of_the_field():
    """Secchi depths of the clearest and of coastal water: 40 to 60 m (Jerlov 1976), 1 to 5 m in 5C to 9C."""
    assert 35 < clarity(WaterConfig(jerlov="I")).secchi_m < 80
    assert 1 < clarity(WaterConfig(jerlov="9C")).secchi_m < 6
    assert clarity(WaterConfig(jerlov="clear")) == (np.inf, np.inf)
    assert str(clarity(WaterConfig(jerlov="clear"))) == "unlimited visibility"


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"jerlov": "9C", "visibility_m": 150}, r"150 m, but absorption alone leaves less .allowed: at most [\d.]+ m"),
        ({"visibility_m": 6, "turbidity": 2}, "given twice .allowed: one of them"),
        ({"jerlov": "clear", "visibility_m": 6}, "a water that does not scatter"),
    ],
)
def test_a_visibility_that_is_impossible_is_refused(keys, problem):
    with pytest.raises(TwinError, match="water.visibility_m: .*" + problem):
        medium(WaterConfig(**keys))


@pytest.mark.parametrize(
    ("name", "source", "field"),
    [
        ("II", "mobley", "water.source"),
        ("9C", "williamson2022", "water.jerlov"),
        ("X", "solonenko2015", "water.jerlov"),
    ],
)
def test_unknown_waters_are_rejected(name, source, field):
    with pytest.raises(TwinError, match=field):
        water_spectrum(name, source)


def test_a_type_that_the_source_does_not_have_is_rejected_when_the_scenario_is_loaded():
    allowed = r"allowed: clear, IB, II, III, 1C, 3C, 5C with source = williamson2022"
    with pytest.raises(ScenarioError, match=rf"water\.jerlov: '7C': not allowed \({allowed}\)"):
        load_scenario("reef", ["water.source=williamson2022", "water.jerlov=7C"])
    assert load_scenario("reef", ["water.source=williamson2022", "water.jerlov=5C"]).water.jerlov == "5C"


def test_the_tables_load_without_data_frames_and_colour_libraries():
    code = (
        "import sys; from twin.imaging.light.spectra import water_spectrum; water_spectrum('II'); "
        "sys.exit(bool({'pandas', 'colour', 'matplotlib'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
