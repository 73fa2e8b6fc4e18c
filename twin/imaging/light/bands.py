"""Bands R, G, B of the cameras: sensitivities, weights under a light, and coefficients of a band.

The sensitivity of a band, in electrons per photon relative to its largest value, is a Gaussian of the width of usual
colour filters, cut at 400 and 700 nm as by filters for ultraviolet and infrared light; it is not the measured curve of
one camera. A coefficient of a band is the mean over the wavelengths, weighted with the sensitivity times the photons of
the light. Absorption in the red band changes so steeply with wavelength that the light of this band does not decay as
one exponential. The effective coefficient over a path L is

    -ln(sum w exp(-a L)) / L,    w: normalised weights, a: coefficient at each wavelength,

which makes the light at the end of the path exact; for L = 0 it is the mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Wavelengths of all spectra [nm], in steps of 1 nm.
NM: Array = np.arange(400.0, 701.0)
NM.setflags(write=False)
#: Centres and standard deviations of the bands R, G, B [nm].
CENTRE_NM = (600.0, 535.0, 460.0)
WIDTH_NM = (30.0, 38.0, 30.0)


def sensitivity() -> Array:
    """Returns the sensitivities (3, n) of the bands R, G, B at `NM`, relative to the largest; 1 at the centres."""
    centre, width = np.array(CENTRE_NM)[:, None], np.array(WIDTH_NM)[:, None]
    return np.exp(-0.5 * ((NM - centre) / width) ** 2)


def band_weights(light: Array | None = None) -> Array:
    """Returns the weights (3, n) of the wavelengths `NM` in the bands R, G, B; each row has the sum 1.

    Args:
        light: (n,) power of the light per wavelength at `NM`, of any scale; None: equal at all wavelengths.
    """
    photons = NM if light is None else NM * light
    weights = sensitivity() * photons
    return weights / weights.sum(1, keepdims=True)


def effective_per_m(per_m: Array, weights: Array, path_m: float = 0.0) -> Array:
    """Returns the effective coefficients (3,) of the bands over a path [1/m].

    Args:
        per_m: (n,) coefficient at `NM` [1/m].
        weights: (3, n) from `band_weights`.
        path_m: length of the path [m]; 0: mean coefficient.
    """
    if not path_m:
        return weights @ per_m
    least = per_m.min()  # keeps the exponentials of long paths above 0
    return least - np.log(weights @ np.exp(-(per_m - least) * path_m)) / path_m
