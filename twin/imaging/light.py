"""All light that reaches an eye: floor, veil, and what is on of shadows, forward scatter and marine snow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image, StereoRig
from twin.imaging.caustics import CELLS, TILE_M, Caustics
from twin.imaging.forward_scatter import ForwardScatter
from twin.imaging.lamps import daylight_at, lights_of_eye
from twin.imaging.optics import Depth, Lit, Optics, Overhead, Radiance
from twin.imaging.shadows import Heights, Shadows
from twin.imaging.snow import Snow
from twin.imaging.water import medium
from twin.scenario.model import Scenario

Array = NDArray[np.float64]


class Moment(NamedTuple):
    """Where the left camera is, world_from_left (4, 4), and since when the survey lasts [s]."""

    world_from_left: Array
    time_s: float


class Layers(NamedTuple):
    """The light that reaches an eye by its origin, each (H, W, 3) float32.

    Args:
        floor_lx: illuminance of the floor by lamps and sun; NaN where the water is too thick to tell.
        direct: radiance of the floor that was not scattered on its way to the eye [cd/m2].
        forward: radiance of the floor that was scattered forward [cd/m2]; None where that is switched off.
        veil: radiance of light that the water scattered to the eye [cd/m2].
        snow: change of radiance by particles [cd/m2]; None where there are none.
        total: all that reaches the eye [cd/m2].
    """

    floor_lx: Radiance
    direct: Radiance
    forward: Radiance | None
    veil: Radiance
    snow: Radiance | None
    total: Radiance


class Light:
    """Turns albedo and depth of each eye (0 left, 1 right) into radiance [cd/m2] for R, G, B.

    Args:
        floor: throws the shadows.
        snow_rng: stream that places the particles.
        rig: what is rendered, where that is not the believed rig.
    """

    def __init__(self, scenario: Scenario, floor: Heights, snow_rng: np.random.Generator, rig: StereoRig | None = None):
        rig = scenario.believed_rig() if rig is None else rig
        imaging, water = scenario.imaging, medium(scenario.water)
        sun, altitude_m = scenario.sun, scenario.plan.altitude_m
        daylight = daylight_at(sun, water, altitude_m)
        lights = [lights_of_eye(rig, scenario.lamps, daylight, eye) for eye in (0, 1)]
        current_mps = np.array(scenario.current.velocity_mps)
        self._rig = rig
        self._optics = Optics(rig, scenario.water, scenario.lamps, sun, altitude_m)
        self._depth_m = sun.depth_m
        self._caustics = Caustics(sun.depth_m, sun.caustics, water, scenario.seed) if sun.caustics else None
        self._shadows = Shadows(floor, rig, [x.position_m for x in lights]) if imaging.shadows else None
        self._forward = ForwardScatter(rig, water) if imaging.forward_scatter else None
        self._direct = np.empty((rig.height_px, rig.width_px, 3), np.float32) if imaging.forward_scatter else None
        snows = scenario.snow.density_per_m3 > 0
        self._snow = Snow(scenario.snow, current_mps, rig, water, lights, snow_rng) if snows else None

    def radiance(self, albedo: Image, depth: Depth, eye: int, moment: Moment) -> Radiance:
        """Light that reaches an eye (H, W, 3).

        Args:
            albedo: (H, W, 3) uint8, 255 = white.
            depth: (H, W) along the optical axis [m]; inf where there is no floor.
        """
        lit, overhead = self._lit(depth, eye, moment), self._overhead(eye, moment)
        if self._forward is None:
            light = self._optics.radiance(albedo, depth, eye, lit, overhead)
        else:
            direct, light = self._optics.split(albedo, depth, eye, lit, overhead, self._direct)
            self._forward.add(direct, depth, light)
        if self._snow is not None:
            self._snow.draw(light, depth, moment.world_from_left, eye, moment.time_s)
        return light

    def layers(self, albedo: Image, depth: Depth, eye: int, moment: Moment) -> Layers:
        """The same light taken apart."""
        lit, overhead = self._lit(depth, eye, moment), self._overhead(eye, moment)
        direct, veil = self._optics.split(albedo, depth, eye, lit, overhead)
        forward = None if self._forward is None else self._forward.spread(direct, depth)
        snow = None
        if self._snow is not None:
            before = direct + veil if forward is None else direct + veil + forward
            snow = before.copy()
            self._snow.draw(snow, depth, moment.world_from_left, eye, moment.time_s)
            snow -= before
        total = self.radiance(albedo, depth, eye, moment)
        return Layers(self._optics.floor_lx(depth, eye, lit, overhead), direct, forward, veil, snow, total)

    def _lit(self, depth: Depth, eye: int, moment: Moment) -> Lit | None:
        return None if self._shadows is None else self._shadows.lit(depth, self._world_from_eye(eye, moment), eye)

    def _overhead(self, eye: int, moment: Moment) -> Overhead | None:
        """The surface above an eye; None where daylight is even."""
        if not self._depth_m:
            return None
        east, north, up = self._world_from_eye(eye, moment)[:3]
        ground = np.array([east, north, -up])
        ground[:2] *= CELLS / TILE_M
        ground[2, 3] += self._depth_m
        waves = None if self._caustics is None else np.pad(self._caustics.pattern(moment.time_s), (0, 1), mode="wrap")
        return Overhead(waves, ground)

    def _world_from_eye(self, eye: int, moment: Moment) -> Array:
        return moment.world_from_left @ (self._rig.left_from_right if eye else np.eye(4))
