"""Refraction by flat ports, as the estimators know it from the calibration: which pinhole position a point would have.

Behind a flat port, a ray at the angle w to the axis in water, a in air and g in the glass meets the axis at d tan(a) /
tan(w) + t tan(g) / tan(w) in front of the outer face, for a port of thickness t at the distance d from the pupil. The
crossing moves towards the camera as w increases: by s(w) from that of rays near the axis, where the centre of
projection is. A point at the depth Z is therefore seen at tan(w) = (X / Z) / (1 + s / Z), and images that are exact at
a depth Z0 show it at 1 + s (1 / Z0 - 1 / Z) times its pinhole position.
"""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array


class FlatPort(NamedTuple):
    """Flat ports of a stereo rig, whose images are rectified exactly for points at one depth."""

    distance_m: float  #: from the entrance pupil to the inner face
    thickness_m: float
    glass_index: float
    water_index: float
    rectified_m: float  #: depth at which images are exact

    def crossing_shift_m(self, radius: Array) -> Array:
        """Returns s [m], at least 0, of rays with the tangents `radius` to the axis in water."""
        sine2 = radius**2 / (1 + radius**2)
        shift = np.zeros_like(sine2)
        for thickness_m, index in ((self.distance_m, 1.0), (self.thickness_m, self.glass_index)):
            ratio = self.water_index / index
            per_tangent = ratio * np.sqrt((1 - sine2) / np.maximum(1 - ratio**2 * sine2, 1e-6))
            shift += thickness_m * (per_tangent - ratio)
        return shift

    def pinhole_positions(self, normalised: Array, depth_m: Array) -> Array:
        """Returns the normalised pinhole positions (..., 2) of points (...) seen at `normalised` (..., 2)."""
        shift_m = self.crossing_shift_m(np.hypot(normalised[..., 0], normalised[..., 1]))
        return normalised * (1 + shift_m * (1 / depth_m - 1 / self.rectified_m))[..., None]
