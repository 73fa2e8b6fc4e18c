"""Spectra of absorption and scattering of Jerlov's water types, from published tables with provenance.

The tables are those of the package `jerlov`, interpolated linearly between their wavelengths (25 nm apart in the first
source, 1 nm in the second). Solonenko & Mobley (2015) derived a and b from the diffuse attenuation that Jerlov
measured, Williamson & Hollins (2022) measured a and b. The two sources differ: at 550 nm, b of the second is 2.3 (IB),
0.49 (II), 0.29 (III), 1.2 (1C), 0.61 (3C) and 0.89 (5C) times b of the first.

In the printed table of Solonenko & Mobley, the rows of 3C from 675 nm and of 5C from 600 nm are those of other
wavelengths. There the absorption is interpolated: it lies between those of types 1C and 7C, in the same proportion as
at the last wavelength with a value. This rule predicts the printed values of 3C from 600 to 650 nm within 0.5 %.
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.errors import TwinError
from twin.imaging.light.bands import NM
from twin.imaging.light.jerlov_package import jerlov_package
from twin.scenario.model import WaterConfig
from twin.scenario.water_sources import WATER_SOURCES, WaterSourceName

Array = NDArray[np.float64]

_CLEARER, _MURKIER = "1C", "7C"  # types between which missing absorption is interpolated
_COMPARED_NM = 550.0  # wavelength at which the scattering of the sources is compared


class WaterSpectrum(NamedTuple):
    """Optical properties of one water at the wavelengths `bands.NM`.

    Args:
        absorption_per_m: (n,) absorption coefficient a [1/m].
        scattering_per_m: (n,) scattering coefficient b [1/m].
        provenance: citation, DOI, version of the package, and known doubts about these values.
    """

    absorption_per_m: Array
    scattering_per_m: Array
    provenance: str


@cache
def water_spectrum(water_type: str, source: WaterSourceName = "solonenko2015") -> WaterSpectrum:
    """Returns absorption and scattering of a Jerlov type.

    Args:
        water_type: a type of the source, see `WATER_SOURCES`.
        source: key in `WATER_SOURCES`.

    Raises:
        TwinError: the source is unknown or does not have this type, or the package `jerlov` is not installed.
    """
    if source not in WATER_SOURCES:
        raise TwinError("water.source", f"{source}: unknown", ", ".join(WATER_SOURCES))
    if water_type not in WATER_SOURCES[source].types:
        raise TwinError("water.jerlov", f"{water_type}: not in {source}", ", ".join(WATER_SOURCES[source].types))
    package = jerlov_package()
    water = package.water(water_type, source=source)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nm, absorption, scattering = water.wavelengths, water.a(water.wavelengths), np.asarray(water.b(NM))
    notes = [str(warning.message) for warning in caught]
    if not np.isfinite(absorption).all():
        first_nm = nm[np.isnan(absorption)][0]
        notes.append(f"a from {first_nm:g} nm is interpolated between types {_CLEARER} and {_MURKIER}.")
        absorption = _filled(absorption, *(package.water(name, source=source).a(nm) for name in (_CLEARER, _MURKIER)))
    absorption = np.interp(NM, nm, absorption)
    for values in (absorption, scattering):
        values.setflags(write=False)
    known = package.SOURCES[source]
    text = " ".join([f"{known.citation}, doi {known.doi}; package jerlov {package.__version__}.", *notes])
    return WaterSpectrum(absorption, scattering, text)


def _filled(values: Array, clearer: Array, murkier: Array) -> Array:
    """Returns a spectrum (n,) with its missing end interpolated between those of two other types.

    The end lies between the other spectra in the same proportion as the last value that is given.
    """
    missing = np.isnan(values)
    last = int(np.argmax(missing)) - 1
    proportion = (values[last] - clearer[last]) / (murkier[last] - clearer[last])
    return np.where(missing, clearer + proportion * (murkier - clearer), values)


def provenance_of(water: WaterConfig) -> str:
    """Returns the name and the source of a scenario's water as text.

    If another source has the same Jerlov type, the text also compares the scattering coefficients b of both sources.

    Raises:
        TwinError: see `water_spectrum`.
    """
    if not water.is_jerlov_type:
        return water.label
    here = _scattering_at(_COMPARED_NM, water.jerlov, water.source)
    others = [
        f"{_scattering_at(_COMPARED_NM, water.jerlov, name) / here:.2g} times as large in {other.citation}"
        for name, other in WATER_SOURCES.items()
        if name != water.source and water.jerlov in other.types
    ]
    return f"{water.label}; b at {_COMPARED_NM:g} nm is {others[0]}" if others else water.label


def _scattering_at(nm: float, water_type: str, source: WaterSourceName) -> float:
    """Returns the scattering coefficient of a water type at one wavelength [1/m]."""
    return float(np.interp(nm, NM, water_spectrum(water_type, source).scattering_per_m))
