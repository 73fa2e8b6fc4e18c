"""Radiometry of lens and pixel: photons, electrons and vignetting for a given luminance.

Light has three bands. Each band is given as the luminance [cd/m2] of the white light that it is a part of: a white
floor under 1000 lx has 1000 / pi cd/m2 in every band. White is equal-energy light (CIE illuminant E); a band is the 100
nm around the wavelength for which the water properties are given. One lux then yields, per second and square metre of a
band,

    photons = width lambda / (h c Km Y),    Y = integral of V(lambda) dlambda

with Km = 683 lm/W, the luminous efficacy at 555 nm, and V the photopic luminous efficiency function (CIE 1924;
Y = 106.857 nm). It would be wrong to use the efficacy at the wavelength of each band: that describes the light of
three lasers, under which a white floor looks violet.

On the axis of a lens of f-number N, focused at infinity, the illuminance of the sensor is

    E = pi L / (4 n^2 N^2)

because L / n^2 is the radiance that remains where a ray passes from water (index n) through a port into the air of the
camera. Off the axis the illuminance falls with the fourth power of the cosine of the angle of view, or with another
power for a lens that corrects this or vignettes more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core.records import StereoRig
from twin.scenario.model import SensorConfig

Array = NDArray[np.float64]

PLANCK_J_S, LIGHT_M_S = 6.62607015e-34, 299792458.0
LUMENS_PER_WATT = 683.0
LUMINOUS_EFFICIENCY_NM = 106.857  # integral of V over wavelength
BAND_NM = (650.0, 550.0, 450.0)  # of R, G, B, as in the table of water types
BAND_WIDTH_NM = 100.0


def photons_per_lux() -> Array:
    """Returns the photons per square metre and second of white light at 1 lx, for R, G, B (3,) [1/(lx m2 s)]."""
    watts_per_m2 = BAND_WIDTH_NM / (LUMENS_PER_WATT * LUMINOUS_EFFICIENCY_NM)
    return watts_per_m2 * np.array(BAND_NM) * 1e-9 / (PLANCK_J_S * LIGHT_M_S)


def electrons_per_cd(sensor: SensorConfig, water_index: float) -> Array:
    """Returns the electrons that a pixel on the axis collects per second at 1 cd/m2, for R, G, B (3,) [1/s]."""
    lux = np.pi / (4 * (water_index * sensor.f_number) ** 2)
    return lux * photons_per_lux() * (sensor.pixel_um * 1e-6) ** 2 * np.array(sensor.quantum_efficiency)


def vignetting(rig: StereoRig, power: float) -> NDArray[np.float32]:
    """Returns the illuminance of each pixel (H, W) relative to the axis: a power of the cosine of its angle of view."""
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px
    y = (np.arange(rig.height_px) - rig.cy_px) / rig.focal_px
    return ((1 + x**2 + y[:, None] ** 2) ** (-power / 2)).astype(np.float32)
