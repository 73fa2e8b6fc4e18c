"""Absorption and scattering of Jerlov's water types in the bands of a camera, from published tables with provenance.

The tables are those of the package `jerlov`. Two sources give a and b: Solonenko & Mobley (2015) by inversion of the
diffuse attenuation (without a in red for 3C and 5C, which are refused), Williamson & Hollins (2022) from measurements.
They differ: at 550 nm, b of the second is 2.3 (IB), 0.49 (II), 0.29 (III), 1.2 (1C) and 0.61 (3C) times b of the first.

A band coefficient is weighted with the sensitivity of the camera times the spectrum of the light. Absorption changes so
steeply in red that the band does not decay as one exponential. The effective coefficient over a path L is
-ln(integral w exp(-a L)) / L, with w the normalised weight; for L = 0 it is the mean.
"""

from __future__ import annotations

import importlib
import warnings
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.errors import TwinError

Array = NDArray[np.float64]
WaterSource = Literal["solonenko2015", "williamson2022"]
SOURCES: tuple[WaterSource, ...] = ("solonenko2015", "williamson2022")

NM: Array = np.arange(400.0, 701.0, 5.0)  # both sources cover it; a camera with an infrared filter sees no more
#: Centre and standard deviation [nm] of the bands R, G, B: Gaussians of the width of usual colour filters, not the
#: measured curves of one camera.
BAND_SHAPES_NM = ((600.0, 30.0), (535.0, 38.0), (460.0, 30.0))
LEAST_KNOWN = 0.98  # smallest share of the weight of a band for which the source has values


class BandCoefficients(NamedTuple):
    """Optical properties of one water type in the bands R, G, B.

    Args:
        absorption_per_m: (3,) absorption coefficient a [1/m].
        scattering_per_m: (3,) scattering coefficient b [1/m].
        provenance: citation, DOI and known doubts about these values.
    """

    absorption_per_m: Array
    scattering_per_m: Array
    provenance: str


def band_weights(light: Array | None = None) -> Array:
    """Returns the weights (3, n) of the wavelengths `NM` in the bands R, G, B; each row has the sum 1.

    Args:
        light: (n,) spectrum of the light at `NM`, of any scale; None = equal at all wavelengths.
    """
    centre, width = np.array(BAND_SHAPES_NM).T[..., None]
    weights = np.exp(-0.5 * ((NM - centre) / width) ** 2) * (1.0 if light is None else light)
    return weights / weights.sum(1, keepdims=True)


def band_coefficients(
    water_type: str, source: WaterSource = "solonenko2015", path_m: float = 0.0, light: Array | None = None
) -> BandCoefficients:
    """Returns absorption and scattering of a Jerlov type in the bands R, G, B.

    Args:
        water_type: I to 9C; `williamson2022` has IB, II, III, 1C, 3C and 5C.
        source: key in `SOURCES`.
        path_m: length of the path from lamp to camera over which the absorption of a band is effective [m].
        light: spectrum of the light, see `band_weights`.
    Raises:
        TwinError: the source is unknown or does not have this type, or too many of its values are missing.
    """
    if source not in SOURCES:
        raise TwinError("water.source", f"{source}: unknown", ", ".join(SOURCES))
    tables, doubts = _tables(), []
    known = tables.SOURCES[source]
    if water_type not in known.water_types:
        raise TwinError("water.jerlov", f"{water_type}: not in {source}", ", ".join(known.water_types))
    water = tables.water(water_type, source=source)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        spectra = [np.asarray(spectrum(NM), np.float64) for spectrum in (water.a, water.b)]
        doubts = [str(warning.message) for warning in caught]
    weights = band_weights(light)
    absorption, scattering = (
        _effective(weights, spectrum, path) for spectrum, path in zip(spectra, (path_m, 0.0), strict=True)
    )
    text = f"{known.citation}, doi {known.doi}; package jerlov {tables.__version__}. " + " ".join(dict.fromkeys(doubts))
    return BandCoefficients(absorption, scattering, text.strip())


def _effective(weights: Array, per_m: Array, path_m: float) -> Array:
    """Returns the effective coefficient (3,) over a path; values that the source lacks are left out."""
    known = np.isfinite(per_m)
    shares = weights[:, known].sum(1)
    if shares.min() < LEAST_KNOWN:
        raise TwinError("water.jerlov", f"the source has values for {shares.min():.0%} of a band", f"{LEAST_KNOWN:.0%}")
    weights = weights[:, known] / shares[:, None]
    if not path_m:
        return weights @ per_m[known]
    return -np.log(weights @ np.exp(-per_m[known] * path_m)) / path_m


def _tables() -> Any:
    """Returns the package `jerlov`, loaded when it is needed."""
    try:
        return importlib.import_module("jerlov")
    except ModuleNotFoundError:
        raise TwinError("water.source", "the package jerlov is not installed", "pip install jerlov") from None
