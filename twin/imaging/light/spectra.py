"""Spectra of light and water, and their means over the bands R, G, B of the cameras.

The sensitivity of a band is a Gaussian of the width of usual colour filters, cut at 400 and 700 nm. A coefficient of a
band is the mean weighted with the sensitivity times the photons of the light; over a path L the effective one is
-ln(sum w exp(-a L)) / L, with normalised weights w, which makes the light at the end of the path exact.

The tables of water are those of the package `jerlov`, interpolated linearly. Solonenko & Mobley (2015) derived a and b
from Jerlov's diffuse attenuation, Williamson & Hollins (2022) measured them; at 550 nm their b differ by factors of
0.29 to 2.3. The printed rows of 3C from 675 nm and 5C from 600 nm of the former are those of other wavelengths; there
the absorption lies between those of 1C and 7C as at the last wavelength with a value (within 0.5 % for 3C).
"""

import importlib
import warnings
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from twin.core.geometry import Array
from twin.errors import TwinError
from twin.scenario.model import WaterConfig
from twin.scenario.water_sources import WATER_SOURCES, WaterSourceName

#: Wavelengths of all spectra [nm], in steps of 1 nm.
NM: Array = np.arange(400.0, 701.0)
NM.setflags(write=False)
#: Centres and standard deviations of the bands R, G, B [nm].
CENTRE_NM = (600.0, 535.0, 460.0)
WIDTH_NM = (30.0, 38.0, 30.0)
_LED_B5 = Path(__file__).parent / "led_b5.csv"


def sensitivity() -> Array:
    """Returns the sensitivities (3, n) of the bands R, G, B at `NM`, relative to the largest; 1 at the centres."""
    centre, width = np.array(CENTRE_NM)[:, None], np.array(WIDTH_NM)[:, None]
    return np.exp(-0.5 * ((NM - centre) / width) ** 2)


def band_weights(light: Array | None = None) -> Array:
    """Returns the weights (3, n) of `NM` in the bands, each row of sum 1, for the power of a light (None: equal)."""
    photons = NM if light is None else NM * light
    weights = sensitivity() * photons
    return weights / weights.sum(1, keepdims=True)


def effective_per_m(per_m: Array, weights: Array, path_m: float = 0.0) -> Array:
    """Returns the effective coefficients (3,) of the bands over a path [1/m]; for `path_m` = 0 their mean."""
    if not path_m:
        return weights @ per_m
    least = per_m.min()  # keeps the exponentials of long paths above 0
    return least - np.log(weights @ np.exp(-(per_m - least) * path_m)) / path_m


def jerlov_package() -> Any:
    """Returns the package `jerlov`, imported on demand, as clear water does not need it; TwinError if missing."""
    try:
        return importlib.import_module("jerlov")
    except ModuleNotFoundError:
        raise TwinError("water.source", "the package jerlov is not installed", "pip install jerlov") from None


Light = Literal["led", "daylight"]


@cache
def spectrum_of(light: Light) -> Array:
    """Returns the relative power (n,) at `NM` of CIE illuminant LED-B5 ("led") or D65 ("daylight")."""
    nm, power = np.loadtxt(_LED_B5, delimiter=",", unpack=True) if light == "led" else jerlov_package().d65()
    spectrum = np.interp(NM, nm, power)
    spectrum.setflags(write=False)
    return spectrum


_CLEARER, _MURKIER = "1C", "7C"  # types between which missing absorption is interpolated
_COMPARED_NM = 550.0  # wavelength at which the scattering of the sources is compared


@cache
def water_spectrum(water_type: str, source: WaterSourceName = "solonenko2015") -> tuple[Array, Array]:
    """Returns absorption and scattering of a Jerlov type at the wavelengths `NM`, (n,) each [1/m].

    Raises TwinError where the source is unknown or does not have this type, or the package `jerlov` is not installed.
    """
    if source not in WATER_SOURCES:
        raise TwinError("water.source", f"{source}: unknown", ", ".join(WATER_SOURCES))
    if water_type not in WATER_SOURCES[source].types:
        raise TwinError("water.jerlov", f"{water_type}: not in {source}", ", ".join(WATER_SOURCES[source].types))
    package = jerlov_package()
    water = package.water(water_type, source=source)
    with warnings.catch_warnings():  # about values that the package flags, see above
        warnings.simplefilter("ignore")
        nm, absorption, scattering = water.wavelengths, water.a(water.wavelengths), np.asarray(water.b(NM))
    if not np.isfinite(absorption).all():
        absorption = _filled(absorption, *(package.water(name, source=source).a(nm) for name in (_CLEARER, _MURKIER)))
    absorption = np.interp(NM, nm, absorption)
    for values in (absorption, scattering):
        values.setflags(write=False)
    return absorption, scattering


def _filled(values: Array, clearer: Array, murkier: Array) -> Array:
    """Returns a spectrum (n,) with its missing end interpolated between those of two other types."""
    missing = np.isnan(values)
    last = int(np.argmax(missing)) - 1
    proportion = (values[last] - clearer[last]) / (murkier[last] - clearer[last])
    return np.where(missing, clearer + proportion * (murkier - clearer), values)


def provenance_of(water: WaterConfig) -> str:
    """Returns the name and the source of a scenario's water as text.

    If another source has the same Jerlov type, the text also compares the scattering coefficients b of both sources,
    unless a visibility determines the scattering.
    """
    if not water.is_jerlov_type or water.visibility_m is not None:
        return water.label
    here = _scattering_at(_COMPARED_NM, water.jerlov, water.source)
    others = [
        f"{_scattering_at(_COMPARED_NM, water.jerlov, name) / here:.2g} times as large in {other.citation}"
        for name, other in WATER_SOURCES.items()
        if name != water.source and water.jerlov in other.types
    ]
    return f"{water.label}; b at {_COMPARED_NM:g} nm is {others[0]}" if others else water.label


def _scattering_at(nm: float, water_type: str, source: WaterSourceName) -> float:
    return float(np.interp(nm, NM, water_spectrum(water_type, source)[1]))
