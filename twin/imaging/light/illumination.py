"""Optical properties of the water and daylight in the water, computed once per scenario."""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.errors import TwinError
from twin.imaging.light.sun_sky import SunSky, direction_to_sun
from twin.imaging.light.water import Medium, downwelling_per_m, medium
from twin.scenario.model import Scenario, SunConfig


class Daylight(NamedTuple):
    """Daylight in the bands R, G, B."""

    surface_lx: Array  # (3,) illuminance just below the water surface, or on the floor if there is no surface
    illuminance_lx: Array  # (3,) illuminance on a horizontal plane at the planned altitude
    attenuation_per_m: Array  # (3,) diffuse attenuation with depth, Kd [1/m]; 0 where there is no surface
    reference_depth_m: float  # depth of the reference plane z = 0 below the surface; 0 where there is no surface
    camera_depth_m: float  # depth of the cameras below the surface at the planned altitude; 0 where there is no surface
    focused_share: float  # fraction of the daylight that the surface waves focus into caustics
    source: SunSky  # direction to the sun under water, and share of the sky in the illuminance
    water: Medium  # optical properties of the water, for daylight on the path from the surface and for its backscatter
    camera_loss_per_m: Array  # (3,) attenuation coefficient of daylight on the way from the floor to the camera [1/m]


class Illumination(NamedTuple):
    """Optical properties of the water, and daylight in the water."""

    water: Medium
    daylight: Daylight


def illumination_of(scenario: Scenario) -> Illumination:
    """Returns the optical properties of a scenario's water, and the daylight in the water.

    The absorption of a band is the effective one (`spectra`) for the light and its path: twice the planned altitude for
    lamps and for the blur, the slant path from the surface to the reference plane for daylight. The loss of daylight
    between floor and camera makes the transmission of the whole path exact.

    Raises TwinError where the water is invalid (see `medium`), or as `daylight_at`.
    """
    altitude_m, sun, scattering = scenario.plan.altitude_m, scenario.sun, scenario.imaging.scattering
    water = water_to_floor_and_back(scenario)
    down_m = sun.depth_m / _source(sun).mean_cosine
    above = medium(scenario.water, scattering, path_m=down_m or altitude_m, light="daylight")
    if not down_m:
        return Illumination(water, daylight_at(sun, above, altitude_m))
    whole = medium(scenario.water, scattering, path_m=down_m + altitude_m, light="daylight").absorption_per_m
    from_floor = (whole * (down_m + altitude_m) - above.absorption_per_m * down_m) / altitude_m
    return Illumination(water, daylight_at(sun, above, altitude_m, from_floor))


def water_to_floor_and_back(scenario: Scenario) -> Medium:
    """Returns the water for the path from planned altitude to floor and back, for LED lamps or else daylight."""
    light = "led" if any(lamp.intensity_cd for lamp in scenario.lamps) else "daylight"
    return medium(scenario.water, scenario.imaging.scattering, path_m=2 * scenario.plan.altitude_m, light=light)


def _source(sun: SunConfig) -> SunSky:
    return SunSky(direction_to_sun(sun.elevation_deg, sun.azimuth_deg), sun.sky_share)


def daylight_at(
    sun: SunConfig, water: Medium, altitude_m: float, absorption_from_floor_per_m: Array | None = None
) -> Daylight:
    """Returns the daylight for cameras at `altitude_m` above the reference plane, attenuated by the water above them.

    Raises TwinError where the altitude is not below the surface, or caustics are requested without a surface.
    """
    surface_lx = np.full(3, sun.illuminance_lx)
    source = _source(sun)
    absorption = water.absorption_per_m if absorption_from_floor_per_m is None else absorption_from_floor_per_m
    of_water = source, water, water._replace(absorption_per_m=absorption).camera_loss_per_m
    if not sun.depth_m:
        if sun.caustics:
            raise TwinError("sun.caustics", f"{sun.caustics:g}: there is no surface", "0, or set sun.depth_m")
        return Daylight(surface_lx, surface_lx, np.zeros(3), 0.0, 0.0, 0.0, *of_water)
    if altitude_m >= sun.depth_m:
        reason = f"{sun.depth_m:g}: the cameras are above the surface"
        raise TwinError("sun.depth_m", reason, f"more than {altitude_m:g}")
    per_m, camera_depth_m = downwelling_per_m(water, source.mean_cosine), sun.depth_m - altitude_m
    illuminance_lx = sun.illuminance_lx * np.exp(-per_m * camera_depth_m)
    return Daylight(surface_lx, illuminance_lx, per_m, sun.depth_m, camera_depth_m, sun.caustics, *of_water)
