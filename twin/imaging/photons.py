"""From light to electrons: what a lens brings to a pixel, how many photons that is, and how many of them count.

Light has three bands here, each told by the luminance [cd/m2] of the white light that it is a part of: a white floor
under 1000 lx shows 1000 / pi in every band. White is taken as light of even energy (CIE illuminant E), a band as the
100 nm around the wavelength that water is told for. One lux then brings, each second on each square metre of a band,

    photons = width lambda / (h c Km Y),    Y = integral of V(lambda) dlambda

with Km = 683 lm/W, the luminous efficacy at 555 nm, and V the luminous efficiency of the eye (CIE 1924; 106.857 nm).
Not the efficacy at each band's own wavelength: that is right for three lasers, by which a white floor would be violet.

On the axis of a lens of f-number N, focused far, the light falls on the sensor with the illuminance

    E = pi L / (4 n^2 N^2)

where L / n^2, not L, is what a ray keeps as it passes from water (index n) through a port into the camera's air. Off
the axis less arrives: by cos^4 of the angle of view by nature, by another power in a lens that mends it or shades more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core.records import StereoRig
from twin.scenario.model import SensorConfig

Array = NDArray[np.float64]

PLANCK_J_S, LIGHT_M_S = 6.62607015e-34, 299792458.0
LUMENS_PER_WATT = 683.0
EYE_NM = 106.857  # the integral of V
BAND_NM = (650.0, 550.0, 450.0)  # of R, G, B, as in the table of water
BAND_WIDTH_NM = 100.0


def photons_per_lux() -> Array:
    """Photons of white light of one lux on a square metre in a second, for R, G, B (3,) [1/(lx m2 s)]."""
    watts_per_m2 = BAND_WIDTH_NM / (LUMENS_PER_WATT * EYE_NM)
    return watts_per_m2 * np.array(BAND_NM) * 1e-9 / (PLANCK_J_S * LIGHT_M_S)


def electrons_per_cd(sensor: SensorConfig, water_index: float) -> Array:
    """Electrons that a pixel on the axis collects in a second by 1 cd/m2, for R, G, B (3,) [1/s]."""
    lux = np.pi / (4 * (water_index * sensor.f_number) ** 2)
    return lux * photons_per_lux() * (sensor.pixel_um * 1e-6) ** 2 * np.array(sensor.quantum_efficiency)


def vignetting(rig: StereoRig, power: float) -> NDArray[np.float32]:
    """Share of the light on the axis that a pixel gets (H, W): a power of the cosine of its angle of view."""
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px
    y = (np.arange(rig.height_px) - rig.cy_px) / rig.focal_px
    return ((1 + x**2 + y[:, None] ** 2) ** (-power / 2)).astype(np.float32)
