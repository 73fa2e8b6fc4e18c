"""Optical properties of the water and daylight in the water, computed once per scenario."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.errors import TwinError
from twin.imaging.water import Medium, downwelling_per_m, medium
from twin.scenario.model import Scenario, SunConfig

Array = NDArray[np.float64]


class Daylight(NamedTuple):
    """Daylight from the zenith in the bands R, G, B.

    Args:
        surface_lx: (3,) illuminance just below the water surface, or on the floor if there is no surface.
        illuminance_lx: (3,) illuminance on a horizontal plane at the planned altitude.
        attenuation_per_m: (3,) diffuse attenuation with depth, Kd; 0 where there is no surface.
        reference_depth_m: depth of the reference plane z = 0 below the surface; 0 where there is no surface.
        camera_depth_m: depth of the cameras below the surface at the planned altitude; 0 where there is no surface.
        focused_share: fraction of the daylight that the surface waves focus into caustics.
    """

    surface_lx: Array
    illuminance_lx: Array
    attenuation_per_m: Array
    reference_depth_m: float
    camera_depth_m: float
    focused_share: float


class Illumination(NamedTuple):
    """Optical properties of the water, and daylight in the water."""

    water: Medium
    daylight: Daylight


def illumination_of(scenario: Scenario) -> Illumination:
    """Returns the optical properties of a scenario's water, and the daylight in the water.

    Raises:
        TwinError: the water is incomplete or its spectrum cannot be read, the planned altitude is above the surface, or
            caustics are requested without a surface.
    """
    water = medium(scenario.water)
    return Illumination(water, daylight_at(scenario.sun, water, scenario.plan.altitude_m))


def daylight_at(sun: SunConfig, water: Medium, altitude_m: float) -> Daylight:
    """Returns the daylight for cameras at `altitude_m` above the reference plane, attenuated by the water above them.

    Raises:
        TwinError: the altitude is above the surface, or caustics are requested without a surface.
    """
    surface_lx = np.full(3, sun.illuminance_lx)
    if not sun.depth_m:
        if sun.caustics:
            raise TwinError("sun.caustics", f"{sun.caustics:g}: there is no surface", "0, or set sun.depth_m")
        return Daylight(surface_lx, surface_lx, np.zeros(3), 0.0, 0.0, 0.0)
    if altitude_m >= sun.depth_m:
        raise TwinError(
            "sun.depth_m", f"{sun.depth_m:g}: the cameras are above the surface", f"more than {altitude_m:g}"
        )
    per_m, camera_depth_m = downwelling_per_m(water), sun.depth_m - altitude_m
    illuminance_lx = sun.illuminance_lx * np.exp(-per_m * camera_depth_m)
    return Daylight(surface_lx, illuminance_lx, per_m, sun.depth_m, camera_depth_m, sun.caustics)
