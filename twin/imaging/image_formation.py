"""Image formation: total radiance that reaches a camera, with shadows, forward scatter and marine snow if enabled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image, StereoRig
from twin.imaging.caustics import CELLS, TILE_M, Caustics
from twin.imaging.forward_scatter import ForwardScatter
from twin.imaging.illumination import Illumination
from twin.imaging.optics import Depth, Lit, Optics, Radiance, WaterSurface
from twin.imaging.shadows import Heights, Shadows
from twin.imaging.snow import MarineSnow
from twin.scenario.model import Scenario

Array = NDArray[np.float64]


class StampedPose(NamedTuple):
    """Pose of the left camera, world_from_left (4, 4), and its time since the start of the survey [s]."""

    world_from_left: Array
    time_s: float


class RadianceComponents(NamedTuple):
    """Components of the light that reaches a camera, per colour band in photometric units; (H, W, 3) float32 each.

    Args:
        floor_lx: illuminance of the floor by lamps and daylight [lx]; NaN where the water transmits too little light
            from the floor to the camera to compute it.
        direct: light from the floor that was not scattered on its path to the camera [cd/m2].
        forward: light from the floor that was scattered by small angles [cd/m2]; None if forward scatter is disabled.
        backscatter: light of lamps and daylight that the water scatters into the camera [cd/m2].
        snow: change of the radiance by marine snow [cd/m2], negative where particles are darker than what they hide;
            None if marine snow is disabled.
        total: sum of direct, forward, backscatter and snow [cd/m2].
    """

    floor_lx: Radiance
    direct: Radiance
    forward: Radiance | None
    backscatter: Radiance
    snow: Radiance | None
    total: Radiance


class ImageFormation:
    """Model of the light that reaches each camera of the stereo camera, given albedo and depth of the floor.

    Args:
        scenario: settings of lamps, marine snow and current, and which effects are enabled.
        illumination: optical properties of the water, and daylight.
        floor: heights of the floor, which casts shadows.
        snow_rng: random stream of the particle positions.
        rig: the rendered cameras; None = the believed rig.
    """

    def __init__(
        self,
        scenario: Scenario,
        illumination: Illumination,
        floor: Heights,
        snow_rng: np.random.Generator,
        rig: StereoRig | None = None,
    ):
        rig = scenario.believed_rig() if rig is None else rig
        imaging, snow, (water, daylight) = scenario.imaging, scenario.snow, illumination
        current_mps = np.array(scenario.current.velocity_mps)
        self._rig = rig
        self._optics = Optics(rig, illumination, scenario.lamps)
        sources = self._optics.light_sources
        self._reference_depth_m = daylight.reference_depth_m
        self._caustics = Caustics(illumination, scenario.seed) if daylight.focused_share else None
        self._shadows = Shadows(floor, rig, [source.position_m for source in sources]) if imaging.shadows else None
        self._forward = ForwardScatter(rig, water) if imaging.forward_scatter else None
        self._direct = np.empty((rig.height_px, rig.width_px, 3), np.float32) if imaging.forward_scatter else None
        snows = snow.density_per_m3 > 0
        self._snow = MarineSnow(snow, current_mps, rig, water, sources, snow_rng) if snows else None

    def radiance(self, albedo: Image, depth: Depth, camera: int, pose: StampedPose) -> Radiance:
        """Returns the light (H, W, 3) that reaches a camera, per colour band in photometric units [cd/m2].

        Args:
            albedo: (H, W, 3) uint8 albedo of the floor, 255 = white.
            depth: (H, W) depth along the optical axis [m]; inf where there is no floor.
            camera: 0 left, 1 right.
            pose: pose of the left camera, and time since the start of the survey.
        """
        lit, surface = self._lit(depth, camera, pose), self._water_surface(camera, pose)
        if self._forward is None:
            light = self._optics.radiance(albedo, depth, camera, lit, surface)
        else:
            direct, light = self._optics.split(albedo, depth, camera, lit, surface, self._direct)
            self._forward.add(direct, depth, light)
        if self._snow is not None:
            self._snow.draw(light, depth, pose.world_from_left, camera, pose.time_s)
        return light

    def components(self, albedo: Image, depth: Depth, camera: int, pose: StampedPose) -> RadianceComponents:
        """Returns the components of the light that reaches a camera; the arguments are those of `radiance`."""
        lit, surface = self._lit(depth, camera, pose), self._water_surface(camera, pose)
        direct, backscatter = self._optics.split(albedo, depth, camera, lit, surface)
        forward = None if self._forward is None else self._forward.spread(direct, depth)
        snow = None
        if self._snow is not None:
            before = direct + backscatter if forward is None else direct + backscatter + forward
            snow = before.copy()
            self._snow.draw(snow, depth, pose.world_from_left, camera, pose.time_s)
            snow -= before
        total = self.radiance(albedo, depth, camera, pose)
        floor_lx = self._optics.floor_lx(depth, camera, lit, surface)
        return RadianceComponents(floor_lx, direct, forward, backscatter, snow, total)

    def _lit(self, depth: Depth, camera: int, pose: StampedPose) -> Lit | None:
        if self._shadows is None:
            return None
        return self._shadows.lit(depth, self._world_from_camera(camera, pose), camera)

    def _water_surface(self, camera: int, pose: StampedPose) -> WaterSurface | None:
        """Returns the water surface above a camera; None if the scenario has no surface, so daylight is uniform."""
        if not self._reference_depth_m:
            return None
        east, north, up = self._world_from_camera(camera, pose)[:3]
        from_camera = np.array([east, north, -up])
        from_camera[:2] *= CELLS / TILE_M
        from_camera[2, 3] += self._reference_depth_m
        if self._caustics is None:
            return WaterSurface(None, from_camera)
        return WaterSurface(np.pad(self._caustics.pattern(pose.time_s), (0, 1), mode="wrap"), from_camera)

    def _world_from_camera(self, camera: int, pose: StampedPose) -> Array:
        return pose.world_from_left @ (self._rig.left_from_right if camera else np.eye(4))
