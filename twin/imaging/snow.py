"""Marine snow: small white particles that drift with the current through the light of the lamps.

They fill a box around the left camera that repeats itself: a particle that leaves it on one side, as the vehicle moves
on, comes back on the other. So they are the same in both cameras and from frame to frame. A particle of diameter D at
depth z is a Lambertian disc that covers pi/4 (f D / z)^2 of the image, whatever it is blurred to: by one pixel of the
lens and, as the lens is focused far off, by its pupil A to f A / z.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import StereoRig
from twin.imaging.lamps import Lights, beam_share
from twin.imaging.optics import LAMP_RADIUS_M, Depth, Radiance
from twin.imaging.water import Medium
from twin.scenario.model import SnowConfig

Array = NDArray[np.float64]

BOX_M = 5.0  # side of the box that repeats itself; half of it is how far snow is seen
NEAREST_M = 0.1  # from an eye, in front of its port
PUPIL_M = 0.004  # of the lens
PIXEL_BLUR_PX = 1.0


class Flakes(NamedTuple):
    """Particles in front of an eye: column and row (n, 2) [px], depth (n,) [m], radiance (n, 3) [cd/m2]."""

    pixel: Array
    depth_m: Array
    radiance: Array


class Snow:
    """The particles of one survey.

    Args:
        current_mps: (3,) that carries them.
        lights: of the left and of the right camera.
        rng: stream that places them.
    """

    def __init__(
        self,
        snow: SnowConfig,
        current_mps: Array,
        rig: StereoRig,
        water: Medium,
        lights: list[Lights],
        rng: np.random.Generator,
    ):
        self._start_m = rng.uniform(0, BOX_M, (round(snow.density_per_m3 * BOX_M**3), 3))
        self._snow, self._current_mps, self._rig, self._water, self._lights = snow, current_mps, rig, water, lights

    def positions(self, centre_m: Array, time_s: float) -> Array:
        """(n, 3) where the particles are in the world [m], in the box around a centre."""
        low = centre_m - BOX_M / 2
        return low + np.mod(self._start_m + self._current_mps * time_s - low, BOX_M)

    def flakes(self, world_from_left: Array, eye: int, time_s: float) -> Flakes:
        """The particles that an eye has before it, lit."""
        world_from_eye = world_from_left @ (self._rig.left_from_right if eye else np.eye(4))
        world_m = self.positions(world_from_left[:3, 3], time_s)
        points = geometry.transform(geometry.inverse(world_from_eye), world_m)
        points = points[points[:, 2] > NEAREST_M]
        pixel = self._rig.project(points)
        margin = np.max(_width_px(self._rig.focal_px, self._snow.diameter_m, NEAREST_M))
        size = np.array([self._rig.width_px, self._rig.height_px])
        inside = np.all((pixel > -margin) & (pixel < size + margin), axis=1)
        return Flakes(pixel[inside], points[inside, 2], self._radiance(points[inside], self._lights[eye]))

    def draw(self, light: Radiance, depth: Depth, world_from_left: Array, eye: int, time_s: float) -> None:
        """Adds the particles to the light (H, W, 3) of an eye, before the floor."""
        flakes = self.flakes(world_from_left, eye, time_s)
        width_px = _width_px(self._rig.focal_px, self._snow.diameter_m, flakes.depth_m)
        cover_px2 = np.pi / 4 * (self._rig.focal_px * self._snow.diameter_m / flakes.depth_m) ** 2
        _draw(light, depth, flakes.pixel, flakes.depth_m, flakes.radiance, width_px, cover_px2)

    def _radiance(self, points: Array, lights: Lights) -> Array:
        """(n, 3) radiance of particles at (n, 3) in the eye: inverse square, both ways through the water."""
        range_m = np.linalg.norm(points, axis=1)[:, None]
        lost = self._water.attenuation_per_m
        day = lights.daylight
        lux = day.eye_lx * np.exp(-day.per_m * points[:, 2:]) * np.exp(-lost * range_m)
        for position, axis, intensity, colour, beam in zip(*lights[:5], strict=True):
            way = points - position
            distance = np.maximum(np.linalg.norm(way, axis=1), LAMP_RADIUS_M)[:, None]
            share = colour * beam_share((way / distance) @ axis, beam)[:, None]
            lux = lux + intensity * share / distance**2 * np.exp(-lost * (distance + range_m))
        return self._snow.albedo / np.pi * lux


def _width_px(focal_px: float, diameter_m: float, depth_m: Array | float) -> Array:
    """Diameter of the disc that a particle is seen as [px]."""
    return np.sqrt((focal_px / np.asarray(depth_m)) ** 2 * (diameter_m**2 + PUPIL_M**2) + PIXEL_BLUR_PX**2)


@njit(cache=True, nogil=True)
def _draw(light, depth, pixel, z, radiance, width, cover):
    """Every particle as a disc with a soft rim, which hides what it covers."""
    rows, cols = depth.shape
    for k in range(z.size):
        reach = 0.5 * width[k] + 0.5
        u0, u1 = int(np.ceil(pixel[k, 0] - reach)), int(np.floor(pixel[k, 0] + reach))
        v0, v1 = int(np.ceil(pixel[k, 1] - reach)), int(np.floor(pixel[k, 1] + reach))
        total = 0.0
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                total += _rim(reach, u - pixel[k, 0], v - pixel[k, 1])
        if total <= 0:
            continue
        for v in range(max(v0, 0), min(v1 + 1, rows)):
            for u in range(max(u0, 0), min(u1 + 1, cols)):
                if depth[v, u] < z[k]:
                    continue
                share = min(cover[k] * _rim(reach, u - pixel[k, 0], v - pixel[k, 1]) / total, 1.0)
                for c in range(3):
                    light[v, u, c] += np.float32(share * (radiance[k, c] - light[v, u, c]))


@njit(cache=True, nogil=True, inline="always")
def _rim(reach, du, dv):
    return min(max(reach - np.sqrt(du * du + dv * dv), 0.0), 1.0)
