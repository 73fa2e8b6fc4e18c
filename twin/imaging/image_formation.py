"""Image formation: total radiance that reaches a camera, with shadows, forward scatter and marine snow if enabled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image, StereoRig
from twin.imaging.camera.lens_psf import defocus_of
from twin.imaging.camera.shutter import ExposureMotion
from twin.imaging.light.caustics import Caustics
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.optics import Depth, FloorView, Optics, Radiance, WaterSurface, calm_surface
from twin.imaging.light.shadows import Shadows, direction_to_casting_sun
from twin.imaging.scene.facets import Facets, Heights
from twin.imaging.scene.materials import material_of
from twin.imaging.scene.mesh_raster import ObjectView
from twin.imaging.scene.object_shadows import ObjectShadows
from twin.imaging.scene.object_view import ObjectRenderer, Objects
from twin.imaging.snow import MarineSnow
from twin.scenario.model import Scenario

Array = NDArray[np.float64]


class StampedPose(NamedTuple):
    """Pose of the left camera, world_from_left (4, 4), and its time since the start of the survey [s]."""

    world_from_left: Array
    time_s: float


class RadianceComponents(NamedTuple):
    """Illuminance of the floor, and components of the light that reaches a camera; (H, W, 3) float32 each.

    All are given per colour band in photometric units.
    """

    # illuminance of the floor by lamps and daylight [lx]; NaN where there is no floor, and where the water transmits
    # too little light from the floor to the camera to compute it
    floor_lx: Radiance
    direct: Radiance  # light from the floor that was not scattered on its path to the camera [cd/m2]
    # light from the floor that was scattered on its path to the camera [cd/m2]; None unless the water scatters and
    # `imaging.scattering` is full
    forward: Radiance | None
    backscatter: Radiance  # light of lamps and daylight that the water scatters into the camera [cd/m2]
    # change of the radiance by marine snow [cd/m2], negative where particles are darker than the light that they hide;
    # None if marine snow is disabled
    snow: Radiance | None
    total: Radiance  # sum of direct, forward, backscatter and snow [cd/m2]


class ImageFormation:
    """Model of the light that reaches each camera of the stereo camera, given albedo and depth of the floor.

    Args:
        floor: heights with facets and, with `imaging.shadows`, shadows; None = a smooth floor without any shadows.
        rig: the rendered cameras; None = the believed rig.
    """

    def __init__(
        self,
        scenario: Scenario,
        illumination: Illumination,
        floor: Heights | None,
        snow_rng: np.random.Generator,
        rig: StereoRig | None = None,
        objects: Objects | None = None,
    ):
        rig = scenario.believed_rig() if rig is None else rig
        imaging, snow, (water, daylight) = scenario.imaging, scenario.snow, illumination
        current_mps = np.array(scenario.current.velocity_mps)
        self._rig, self._material = rig, material_of(scenario.terrain)
        self._objects = None if objects is None else ObjectRenderer(objects, rig)
        self._facets = None if floor is None else Facets(floor)
        self._optics = Optics(rig, illumination, scenario.lamps)
        sources = self._optics.light_sources
        self._reference_depth_m, self._daylight_on = daylight.reference_depth_m, bool(daylight.surface_lx.any())
        waves = bool(daylight.focused_share)
        self._caustics = Caustics(illumination, scenario.sun.wind_mps, scenario.seed) if waves else None
        to_sun = direction_to_casting_sun(daylight)
        positions_m = [source.position_m for source in sources]
        shaded = floor if imaging.shadows else None
        self._shadows = None if shaded is None else Shadows(shaded, rig, positions_m, to_sun)
        casting = objects if imaging.shadows else None
        self._object_shadows = None if casting is None else ObjectShadows(casting, rig, positions_m, to_sun)
        snows = snow.density_per_m3 > 0
        particles = snow, current_mps, rig, water, self._optics.lamp_light, snow_rng
        self._snow = MarineSnow(*particles, defocus_of(scenario, rig)) if snows else None

    def draw_objects(self, albedo: Image, depth: Depth, camera: int, pose: StampedPose) -> ObjectView | None:
        """Draws the objects into albedo and depth of the floor in place; returns their view, None without objects.

        The arguments are those of `radiance`.
        """
        if self._objects is None:
            return None
        return self._objects.draw(albedo, depth, self._world_from_camera(camera, pose), pose.time_s)

    def radiance(
        self, albedo: Image, depth: Depth, camera: int, pose: StampedPose, objects: ObjectView | None = None
    ) -> Radiance:
        """Returns the light (H, W, 3) that reaches a camera, per colour band in photometric units [cd/m2].

        Args:
            albedo: (H, W, 3) uint8 albedo of floor and objects, 255 = white.
            depth: (H, W) float32 depth along the optical axis [m]; inf where there is no floor.
            camera: 0 left, 1 right.
            objects: those drawn into `albedo` and `depth`; None: the image shows the floor alone.
        """
        light = self.radiance_without_snow(albedo, depth, camera, pose, objects)
        self.add_snow(light, depth, camera, pose)
        return light

    def radiance_without_snow(
        self, albedo: Image, depth: Depth, camera: int, pose: StampedPose, objects: ObjectView | None = None
    ) -> Radiance:
        """Returns the light (H, W, 3) of floor and water [cd/m2]; the arguments are those of `radiance`."""
        return self._optics.radiance(albedo, depth, camera, *self._surroundings(depth, camera, pose, objects))

    def add_snow(
        self, light: Radiance, depth: Depth, camera: int, pose: StampedPose, motion: ExposureMotion | None = None
    ) -> None:
        """Draws marine snow, if enabled, into `light` (H, W, 3) in place, as streaks along the camera's `motion`."""
        if self._snow is not None:
            self._snow.draw(light, depth, pose.world_from_left, camera, pose.time_s, motion)

    def components(
        self, albedo: Image, depth: Depth, camera: int, pose: StampedPose, objects: ObjectView | None = None
    ) -> RadianceComponents:
        """Returns the components of the light that reaches a camera; the arguments are those of `radiance`."""
        around, snow = self._surroundings(depth, camera, pose, objects), None
        direct, forward, backscatter = self._optics.parts(albedo, depth, camera, *around)
        if self._snow is not None:
            before = direct + backscatter if forward is None else direct + backscatter + forward
            snow = before.copy()
            self.add_snow(snow, depth, camera, pose)
            snow -= before
        total = self.radiance(albedo, depth, camera, pose, objects)
        floor_lx = self._optics.floor_lx(depth, camera, *around)
        return RadianceComponents(floor_lx, direct, forward, backscatter, snow, total)

    def _surroundings(
        self, depth: Depth, camera: int, pose: StampedPose, objects: ObjectView | None
    ) -> tuple[FloorView, WaterSurface | None]:
        """Returns facets, shadows and material of the floor with the objects, and the water surface, for a camera."""
        world_from_camera, lit, surface = self._world_from_camera(camera, pose), None, None
        facets = None if self._facets is None else self._facets.seen_from(world_from_camera)
        if self._shadows is not None:
            lit = self._shadows.lit(depth, world_from_camera, camera, None if objects is None else objects.label)
            if objects is not None and self._object_shadows is not None:
                self._object_shadows.darken(lit, depth, objects, world_from_camera, (camera, pose.time_s))
        if self._daylight_on:
            surface = calm_surface(world_from_camera, self._reference_depth_m)
            if self._caustics is not None:
                surface.from_camera[:2] *= self._caustics.cells_per_m
                surface = surface._replace(caustics=self._caustics.closed_pattern(pose.time_s))
        return FloorView(facets, lit, self._material, objects), surface

    def _world_from_camera(self, camera: int, pose: StampedPose) -> Array:
        return pose.world_from_left @ (self._rig.left_from_right if camera else np.eye(4))
