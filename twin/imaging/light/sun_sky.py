"""Sun and sky above a level water surface: refracted direction of the sun, and radiance of the sky under water.

A ray from the zenith angle t continues at w with sin t = n sin w (Snell), so the sky appears within 48 deg of the
zenith. A uniform sky of radiance L has there n^2 T(t) L, T being the Fresnel transmittance (Mobley 1994, section 4.2).
"""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.scenario.model import SEA_WATER_INDEX

CRITICAL_COSINE = float(np.sqrt(1 - 1 / SEA_WATER_INDEX**2))  # cosine of the edge of the cone in which the sky appears


class SunSky(NamedTuple):
    """Daylight just below the surface, for an illuminance of 1 lx on the horizontal plane."""

    to_sun: tuple[float, float, float] = (0.0, 0.0, 1.0)  # (3,) unit direction to the refracted sun, east, north, up
    sky_share: float = 0.0  # share of the illuminance that is light of the sky; the rest is the beam of the sun

    @property
    def sun_cosine(self) -> float:
        return self.to_sun[2]

    @property
    def beam_lx(self) -> float:
        """Illuminance by the beam on a plane that faces the refracted sun [lx]."""
        return (1 - self.sky_share) / self.sun_cosine

    @property
    def mean_cosine(self) -> float:
        """Mean cosine of the zenith angle of all light just below the surface: illuminance / scalar illuminance."""
        return 1 / (self.beam_lx + self.sky_share * _SKY_SCALAR)


def direction_to_sun(elevation_deg: float, azimuth_deg: float) -> tuple[float, float, float]:
    """Returns the direction (east, north, up) to the sun under water; azimuths are counter-clockwise from x (east)."""
    sine = np.cos(np.deg2rad(elevation_deg)) / SEA_WATER_INDEX if elevation_deg < 90 else 0.0
    east, north = sine * np.cos(np.deg2rad(azimuth_deg)), sine * np.sin(np.deg2rad(azimuth_deg))
    return float(east), float(north), float(np.sqrt(1 - sine**2))


def sky_radiance(cosine: Array) -> Array:
    """Returns the radiance [cd/m2] under water of a uniform sky of 1 lx at a cosine of the zenith angle."""
    return _transmitted(cosine) / _SKY_LX


def _transmitted(cosine: Array) -> Array:
    """Returns the Fresnel transmittance from air to water at the cosine of the angle in water."""
    under = np.asarray(cosine, np.float64)
    above = np.sqrt(np.maximum(1 - SEA_WATER_INDEX**2 * (1 - under**2), 0.0))
    inside = (under > 0) & (above > 0)
    under = np.where(inside, under, 1.0)
    across = (above - SEA_WATER_INDEX * under) / (above + SEA_WATER_INDEX * under)
    along = (SEA_WATER_INDEX * above - under) / (SEA_WATER_INDEX * above + under)
    return np.where(inside, 1 - (across**2 + along**2) / 2, 0.0)


def _sky_moments() -> tuple[float, float]:
    """Returns the illuminance by a sky, and the ratio of its scalar illuminance to this illuminance."""
    # the nodes are those of the cosine in air, which removes the root at the edge of the cone
    x, w = np.polynomial.legendre.leggauss(64)
    above = (x + 1) / 2
    under = np.sqrt(1 - (1 - above**2) / SEA_WATER_INDEX**2)
    # 2 pi under d(under) = 2 pi above d(above) / n^2
    light = _transmitted(under) * np.pi * w * above / SEA_WATER_INDEX**2
    return float(light.sum()), float((light / under).sum() / light.sum())


_SKY_LX, _SKY_SCALAR = _sky_moments()
