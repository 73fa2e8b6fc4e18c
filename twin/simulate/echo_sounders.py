"""Beams that the true floor, with its objects, reflects: altimeter, bottom lock of the Doppler velocity log (DVL)."""

import numpy as np

from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_ray, nearest_echo_m
from twin.scenario.model import NavigationConfig

_LEAST_BEAMS = 3  # of the DVL, which determine a velocity


class Altimeter:
    """Echo sounder at the left camera that looks along its optical axis: it returns the nearest echo in its beam."""

    def __init__(self, settings: NavigationConfig, floor: HeightField, rng: np.random.Generator):
        self._settings, self.floor, self._rng = settings, floor, rng

    def read(self, world_from_camera: Array) -> float | None:
        """Returns the distance to the floor [m]; None outside the range of the sensor."""
        number = float(self._rng.standard_normal())
        distance_m = nearest_echo_m(self.floor, world_from_camera, self._settings.altimeter_beam_deg)
        distance_m *= 1 + self._settings.altimeter_sigma * number
        nearest_m, farthest_m = self._settings.altimeter_range_m
        return distance_m if nearest_m <= distance_m <= farthest_m else None


class BottomLock:
    """Bottom lock of a DVL at the origin of the body: four beams around its downward axis (Janus configuration)."""

    def __init__(self, range_m: tuple[float, float], beam_deg: float, floor: HeightField):
        self._range_m, self.floor = range_m, floor
        azimuths, tilt = np.deg2rad([45.0, 135.0, 225.0, 315.0]), np.deg2rad(beam_deg)
        across = np.sin(tilt) * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
        self._beams = np.column_stack([across, np.full(4, -np.cos(tilt))])

    def holds(self, world_from_body: Array) -> bool:
        """Returns whether enough beams return an echo at a true pose (4, 4)."""
        directions, (x, y, z) = self._beams @ world_from_body[:3, :3].T, world_from_body[:3, 3]
        lengths_m = np.array([cast_ray(self.floor, x, y, z, *direction) for direction in directions])
        nearest_m, farthest_m = self._range_m
        return int(((nearest_m <= lengths_m) & (lengths_m <= farthest_m)).sum()) >= _LEAST_BEAMS
