"""Spectra of the light: white LED lamps and daylight (CIE illuminants)."""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twin.imaging.light.bands import NM
from twin.imaging.light.jerlov_package import jerlov_package

Array = NDArray[np.float64]
Light = Literal["led", "daylight"]

#: Relative power of CIE illuminant LED-B5, a phosphor-converted blue LED of 6598 K, from 400 to 700 nm in steps of 5 nm
#: (CIE 015:2018, table 12).
LED_B5 = (
    0.07, 0.16, 0.35, 0.78, 1.67, 3.3, 5.94, 9.92, 16.15, 25.15, 32.34, 31.18,
    23.46, 16.39, 12.08, 9.08, 7.21, 6.48, 6.49, 7.05, 8.1, 9.45, 10.88, 12.22,
    13.38, 14.29, 14.98, 15.48, 15.81, 16.01, 16.1, 16.13, 16.1, 15.98, 15.77, 15.5,
    15.15, 14.76, 14.31, 13.79, 13.22, 12.59, 11.91, 11.2, 10.47, 9.73, 9.0, 8.27,
    7.57, 6.9, 6.25, 5.65, 5.08, 4.55, 4.06, 3.61, 3.22, 2.86, 2.54, 2.26,
    2.0,
)  # fmt: skip


@cache
def spectrum_of(light: Light) -> Array:
    """Returns the relative power (n,) of a light at `bands.NM`, interpolated linearly between the tabulated values.

    Args:
        light: "led": CIE illuminant LED-B5; "daylight": CIE illuminant D65.

    Raises:
        TwinError: the package `jerlov`, which has the table of D65, is not installed.
    """
    nm, power = (np.arange(400.0, 701.0, 5.0), LED_B5) if light == "led" else jerlov_package().d65()
    spectrum = np.interp(NM, nm, power)
    spectrum.setflags(write=False)
    return spectrum
