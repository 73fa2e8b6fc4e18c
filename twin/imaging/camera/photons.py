"""Radiometry of lens and pixel: photons and electrons per unit of luminance, and vignetting.

The radiance of a band is given as the luminance [cd/m2] of equal-energy white light (CIE illuminant E) with this
radiance in the band. One lux of white light yields in a band, per second and square metre,

    photons = integral of S lambda / (h c Km Y) over wavelength,    Y = integral of V over wavelength

with S the sensitivity relative to its largest value, Km = 683 lm/W, and V the photopic luminous efficiency function
(CIE 1924; Y = 106.857 nm). On the axis of a lens of f-number N, focused at infinity, the illuminance of the sensor is

    E = pi L / (4 n^2 N^2)

with L the radiance in water of index n. Off the axis it decreases as a power (four by default) of the cosine.
"""

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, StereoRig
from twin.imaging.light.spectra import NM, sensitivity
from twin.scenario.model import SensorConfig

PLANCK_J_S, LIGHT_M_S = 6.62607015e-34, 299792458.0
LUMENS_PER_WATT = 683.0
LUMINOUS_EFFICIENCY_NM = 106.857  # integral of V over wavelength


def photons_per_lux() -> Array:
    """Returns the photons of white light, weighted with the sensitivity of R, G, B (3,) [1/(lx m2 s)]."""
    watts_per_nm = 1 / (LUMENS_PER_WATT * LUMINOUS_EFFICIENCY_NM)  # per square metre
    return watts_per_nm * (sensitivity() * NM).sum(1) * 1e-9 / (PLANCK_J_S * LIGHT_M_S)  # in steps of 1 nm


def electrons_per_cd(sensor: SensorConfig, water_index: float) -> Array:
    """Returns the number of electrons per second in a pixel on the axis at 1 cd/m2, for R, G, B (3,) [1/s]."""
    lux = np.pi / (4 * (water_index * sensor.f_number) ** 2)
    return lux * photons_per_lux() * (sensor.pixel_um * 1e-6) ** 2 * np.array(sensor.quantum_efficiency)


def vignetting(rig: StereoRig, power: float) -> NDArray[np.float32]:
    """Returns the illuminance (H, W) relative to the axis: the cosine of the field angle, raised to `power`."""
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px
    y = (np.arange(rig.height_px) - rig.cy_px) / rig.focal_px
    return ((1 + x**2 + y[:, None] ** 2) ** (-power / 2)).astype(np.float32)
