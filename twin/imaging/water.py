"""What water does to light: absorption, scattering, and the direction light is scattered to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.config import Water

Array = NDArray[np.float64]

#: Absorption a and scattering b of Jerlov's water types for R, G, B [1/m] (the table of the Stonefish simulator).
JERLOV_PER_M: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "clear": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "I": ((0.4601, 0.0620, 0.0176), (0.0008, 0.0017, 0.0042)),
    "IA": ((0.4612, 0.0622, 0.0223), (0.0021, 0.0035, 0.0068)),
    "IB": ((0.4612, 0.0623, 0.0239), (0.0431, 0.0536, 0.0700)),
    "II": ((0.4622, 0.0622, 0.0247), (0.2498, 0.3580, 0.5236)),
    "III": ((0.4651, 0.0646, 0.0411), (0.6834, 0.9800, 1.4325)),
    "1C": ((0.4803, 0.0760, 0.1198), (0.2538, 0.3650, 0.5340)),
    "3C": ((0.4840, 0.0820, 0.1821), (0.7406, 1.0600, 1.5586)),
    "5C": ((0.5204, 0.1170, 0.3467), (0.9285, 1.3300, 1.9417)),
    "7C": ((0.5782, 0.1950, 0.6202), (1.6392, 2.3500, 3.4266)),
    "9C": ((0.6207, 0.3480, 1.0553), (2.1720, 3.1200, 4.5610)),
}

#: Mean cosine of scattering in sea water, for the phase function of Henyey and Greenstein.
FORWARDNESS = 0.924


class Medium(NamedTuple):
    """Inherent optical properties for R, G, B: absorption (3,) and scattering (3,) [1/m]."""

    absorption_per_m: Array
    scattering_per_m: Array

    @property
    def attenuation_per_m(self) -> Array:
        """Beam attenuation c = a + b (3,) [1/m].

        All scattered light counts as lost from the beam. In truth most of it goes on close to its old direction
        and comes back as blur, so that the brightness of far floors is underrated in turbid water.
        """
        return self.absorption_per_m + self.scattering_per_m


def medium(water: Water) -> Medium:
    """The water of a scenario; `turbidity` multiplies its scattering."""
    absorption, scattering = JERLOV_PER_M[water.jerlov]
    return Medium(np.array(absorption), np.array(scattering) * water.turbidity)


def phase_function(cos_angle: Array) -> Array:
    """Share of scattered light per solid angle [1/sr] by Henyey & Greenstein (1941); integrates to 1 over the sphere.

    Args:
        cos_angle: cosine of the angle between the light before and after; 1 goes straight on.
    """
    g = FORWARDNESS
    return (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cos_angle) ** 1.5)
