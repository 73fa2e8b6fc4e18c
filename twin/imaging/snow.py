"""Marine snow: small white particles that drift with the current through the light of the lamps.

The particles fill a periodic box around the left camera: when the vehicle moves, a particle that leaves the box on one
side re-enters on the opposite side. Both cameras and consecutive frames therefore show the same particles. A particle
of diameter D at depth z is a Lambertian disc with an image area of pi/4 (f D / z)^2. Two blurs spread its light: one
pixel due to the lens, and f A / z due to defocus (a lens with an aperture of diameter A, focused at infinity).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import StereoRig
from twin.imaging.lamps import LightSources, beam_share
from twin.imaging.optics import LAMP_RADIUS_M, Depth, Radiance
from twin.imaging.water import Medium
from twin.scenario.model import SnowConfig

Array = NDArray[np.float64]

BOX_M = 5.0  # side of the periodic box; along each world axis, snow is visible up to half a side from the left camera
NEAREST_M = 0.1  # smallest depth of a particle: the port is in front of the camera
APERTURE_M = 0.004  # diameter of the lens aperture
PIXEL_BLUR_PX = 1.0


class VisibleParticles(NamedTuple):
    """Particles in view of a camera: column and row (n, 2) [px], depth (n,) [m], radiance per band (n, 3) [cd/m2]."""

    pixel: Array
    depth_m: Array
    radiance: Array


class MarineSnow:
    """Marine snow particles of one survey.

    Args:
        snow: density, size and albedo of the particles.
        current_mps: (3,) velocity of the particles in the world.
        rig: the rendered cameras.
        water: optical properties of the water.
        light_sources: lamps and daylight in the axes of the left and of the right camera.
        rng: random stream of the particle positions.
    """

    def __init__(
        self,
        snow: SnowConfig,
        current_mps: Array,
        rig: StereoRig,
        water: Medium,
        light_sources: list[LightSources],
        rng: np.random.Generator,
    ):
        self._start_m = rng.uniform(0, BOX_M, (round(snow.density_per_m3 * BOX_M**3), 3))
        self._snow, self._current_mps, self._rig, self._water = snow, current_mps, rig, water
        self._light_sources = light_sources

    def positions(self, centre_m: Array, time_s: float) -> Array:
        """Returns the particle positions (n, 3) in the world [m], in the box around a centre (3,)."""
        low = centre_m - BOX_M / 2
        return low + np.mod(self._start_m + self._current_mps * time_s - low, BOX_M)

    def visible_particles(self, world_from_left: Array, camera: int, time_s: float) -> VisibleParticles:
        """Returns the particles in view of a camera (0 left, 1 right) with their radiance.

        Args:
            world_from_left: (4, 4) pose of the left camera.
            camera: 0 left, 1 right.
            time_s: time since the start of the survey.
        """
        world_from_camera = world_from_left @ (self._rig.left_from_right if camera else np.eye(4))
        world_m = self.positions(world_from_left[:3, 3], time_s)
        points = geometry.transform(geometry.inverse(world_from_camera), world_m)
        points = points[points[:, 2] > NEAREST_M]
        pixel = self._rig.project(points)
        margin = np.max(_width_px(self._rig.focal_px, self._snow.diameter_m, NEAREST_M))
        size = np.array([self._rig.width_px, self._rig.height_px])
        inside = np.all((pixel > -margin) & (pixel < size + margin), axis=1)
        points = points[inside]
        return VisibleParticles(pixel[inside], points[:, 2].copy(), self._radiance(points, self._light_sources[camera]))

    def draw(self, light: Radiance, depth: Depth, world_from_left: Array, camera: int, time_s: float) -> None:
        """Draws the particles in front of the floor into the radiance `light` (H, W, 3) of a camera, in place."""
        particles = self.visible_particles(world_from_left, camera, time_s)
        width_px = _width_px(self._rig.focal_px, self._snow.diameter_m, particles.depth_m)
        cover_px2 = np.pi / 4 * (self._rig.focal_px * self._snow.diameter_m / particles.depth_m) ** 2
        _draw(light, depth, particles.pixel, particles.depth_m, particles.radiance, width_px, cover_px2)

    def _radiance(self, points: Array, sources: LightSources) -> Array:
        """Returns the radiance (n, 3) per colour band [cd/m2] of particles at `points` (n, 3) in camera axes [m]."""
        range_m = np.linalg.norm(points, axis=1)[:, None]
        attenuation = self._water.attenuation_per_m
        day = sources.daylight
        lux = day.illuminance_lx * np.exp(-day.attenuation_per_m * points[:, 2:]) * np.exp(-attenuation * range_m)
        for position, axis, intensity, colour, beam in zip(*sources[:5], strict=True):
            from_lamp = points - position
            distance = np.maximum(np.linalg.norm(from_lamp, axis=1), LAMP_RADIUS_M)[:, None]
            share = colour * beam_share((from_lamp / distance) @ axis, beam)[:, None]
            lux = lux + intensity * share / distance**2 * np.exp(-attenuation * (distance + range_m))
        return self._snow.albedo / np.pi * lux


def _width_px(focal_px: float, diameter_m: float, depth_m: Array | float) -> Array:
    """Returns the diameter of a particle's image [px], including blur."""
    return np.sqrt((focal_px / np.asarray(depth_m)) ** 2 * (diameter_m**2 + APERTURE_M**2) + PIXEL_BLUR_PX**2)


@njit(cache=True, nogil=True)
def _draw(light, depth, pixel, z, radiance, width, cover):
    """Draws each particle into `light` as a disc with a soft rim, except where the floor is nearer."""
    rows, cols = depth.shape
    for k in range(z.size):
        radius = 0.5 * width[k] + 0.5
        u0, u1 = int(np.ceil(pixel[k, 0] - radius)), int(np.floor(pixel[k, 0] + radius))
        v0, v1 = int(np.ceil(pixel[k, 1] - radius)), int(np.floor(pixel[k, 1] + radius))
        total = 0.0
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                total += _rim(radius, u - pixel[k, 0], v - pixel[k, 1])
        if total <= 0:
            continue
        for v in range(max(v0, 0), min(v1 + 1, rows)):
            for u in range(max(u0, 0), min(u1 + 1, cols)):
                if depth[v, u] < z[k]:
                    continue
                share = min(cover[k] * _rim(radius, u - pixel[k, 0], v - pixel[k, 1]) / total, 1.0)
                for c in range(3):
                    light[v, u, c] += np.float32(share * (radiance[k, c] - light[v, u, c]))


@njit(cache=True, nogil=True, inline="always")
def _rim(radius, du, dv):
    """Returns the coverage of a pixel at offset (du, dv) from the centre of a disc, falling from 1 to 0 at its rim."""
    return min(max(radius - np.sqrt(du * du + dv * dv), 0.0), 1.0)
