"""Image formation: total radiance that reaches a camera, with shadows, forward scatter and marine snow if enabled."""

from collections.abc import Sequence
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from twin.core.records import Array, Depth, Image, Radiance, StereoRig
from twin.imaging.camera.lens_psf import defocus_of
from twin.imaging.camera.shutter import ExposureMotion
from twin.imaging.light.caustics import Caustics
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.lamp_halos import LampHalos
from twin.imaging.light.optics import Optics, SceneView, WaterSurface, calm_surface
from twin.imaging.light.shadows import Shadows, direction_to_casting_sun
from twin.imaging.scene.facets import Facets, Heights
from twin.imaging.scene.materials import material_of
from twin.imaging.scene.mesh_raster import NO_OBJECTS, ObjectView
from twin.imaging.scene.object_shadows import ObjectShadows, heights_with
from twin.imaging.scene.object_view import Objects, draw_over_floor
from twin.imaging.snow import MarineSnow
from twin.scenario.model import Scenario


class StampedPose(NamedTuple):
    """Pose of the left camera, world_from_left (4, 4), and its time since the start of the survey [s]."""

    world_from_left: Array
    time_s: float


class RenderedView(NamedTuple):
    albedo: Image  # (H, W, 3) albedo of floor and objects, 255 = white
    depth: Depth  # (H, W) depth along the optical axis [m]; inf where there is no floor
    camera: int  # 0 left, 1 right
    pose: StampedPose
    objects: ObjectView | None = None  # objects drawn into `albedo` and `depth`; None: the image shows the floor alone


class RadianceComponents(NamedTuple):
    """Illuminance of the floor, and components of the light that reaches a camera, per band; (H, W, 3) float32 each."""

    # by lamps and daylight [lx]; NaN without floor, and where the water transmits too little light to compute it
    floor_lx: Radiance
    direct: Radiance  # light from the floor that was not scattered on its path to the camera [cd/m2]
    forward: Radiance | None  # light from the floor that was scattered on its path [cd/m2]; None: not modelled
    backscatter: Radiance  # light of lamps and daylight that the water scatters into the camera [cd/m2]
    snow: Radiance | None  # change by marine snow [cd/m2], negative where it hides light; None if it is disabled
    total: Radiance  # sum of direct, forward, backscatter and snow [cd/m2]


class ImageFormation:
    """Model of the light that reaches each rendered camera (`rig` None: as believed); `floor` None: smooth."""

    def __init__(
        self, scenario: Scenario, illumination: Illumination, floor: Heights | None, snow_rng: np.random.Generator,
        rig: StereoRig | None = None, objects: Objects | None = None,
    ):  # fmt: skip
        rig = scenario.believed_rig() if rig is None else rig
        imaging, snow, (water, daylight) = scenario.imaging, scenario.snow, illumination
        current_mps = np.array(scenario.current.velocity_mps)
        self._rig, self._material = rig, material_of(scenario.terrain)
        self._objects = objects
        self._facets = None if floor is None else Facets(floor)
        lamps = [(lamp.model_copy(update={"intensity_cd": 0.0}), lamp) for lamp in scenario.lamps]  # dark or lit
        self._optics_of = cache(
            lambda lit: Optics(rig, illumination, [one[on] for one, on in zip(lamps, lit, strict=True)])
        )
        self._optics = self._optics_of((True,) * len(scenario.lamps))
        sources = self._optics.light_sources
        self._reference_depth_m, self._daylight_on = daylight.reference_depth_m, bool(daylight.surface_lx.any())
        waves = bool(daylight.focused_share)
        self._caustics = Caustics(illumination, scenario.sun.wind_mps, scenario.seed) if waves else None
        to_sun = direction_to_casting_sun(daylight)
        positions_m = [source.position_m for source in sources]
        shaded = floor if imaging.shadows else None
        casting = objects if imaging.shadows else None
        tops_m = None if casting is None or shaded is None else heights_with(casting, shaded)
        self._shadows = None if shaded is None else Shadows(shaded, rig, positions_m, to_sun)
        self._halos = None if shaded is None else LampHalos(shaded, sources, water, tops_m)
        self._object_shadows = None if casting is None else ObjectShadows(casting, rig, positions_m, to_sun)
        snows = snow.density_per_m3 > 0
        particles = snow, current_mps, rig, self._optics.lamp_light, snow_rng
        height_m = scenario.plan.altitude_m
        self._snow = MarineSnow(*particles, defocus_of(scenario, rig), height_m) if snows else None

    def light_lamps(self, lit: Sequence[bool]) -> None:
        """Switches the lamps (n) on or off for the following images."""
        self._optics = self._optics_of(tuple(lit))
        if self._snow is not None:
            self._snow.lamp_light = self._optics.lamp_light

    def view_of(self, floor: tuple[Image, Depth], camera: int, pose: StampedPose) -> RenderedView:
        """Returns the view of a camera; draws the objects, if any, into albedo and depth of the floor in place."""
        world_from_camera, objects = self._world_from_camera(camera, pose), None
        if self._objects is not None:
            objects = draw_over_floor(self._objects, self._rig, *floor, world_from_camera, pose.time_s)
        return RenderedView(*floor, camera, pose, objects)

    def radiance(self, view: RenderedView) -> Radiance:
        """Returns the light (H, W, 3) that reaches a camera [cd/m2]."""
        light = self.radiance_without_snow(view)
        self.add_snow(light, view)
        return light

    def radiance_without_snow(self, view: RenderedView) -> Radiance:
        """Returns the light (H, W, 3) of floor and water [cd/m2]."""
        return self._optics.radiance(*view[:3], self._scene(view))

    def add_snow(self, light: Radiance, view: RenderedView, motion: ExposureMotion | None = None) -> None:
        """Draws marine snow, if enabled, into `light` (H, W, 3) in place, as streaks along the camera's `motion`."""
        if self._snow is not None:
            _, depth, camera, pose, _ = view
            surface = self._surface(self._world_from_camera(camera, pose), pose.time_s) if self._daylight_on else None
            veil = partial(self._optics.veil, camera, surface)
            self._snow.draw(light, depth, pose.world_from_left, camera, pose.time_s, motion, veil)

    def components(self, view: RenderedView) -> RadianceComponents:
        """Returns the light of `radiance` by its components."""
        scene, snow = self._scene(view), None
        direct, forward, backscatter = self._optics.parts(*view[:3], scene)
        if self._snow is not None:
            before = direct + backscatter if forward is None else direct + backscatter + forward
            snow = before.copy()
            self.add_snow(snow, view)
            snow -= before
        return RadianceComponents(self.floor_lx(view), direct, forward, backscatter, snow, self.radiance(view))

    def floor_lx(self, view: RenderedView) -> Radiance:
        return self._optics.floor_lx(view.depth, view.camera, self._scene(view))

    def direct(self, view: RenderedView) -> Radiance:
        return self._optics.direct(*view[:3], self._scene(view))

    def _scene(self, view: RenderedView) -> SceneView:
        _, depth, camera, pose, objects = view
        world_from_camera = self._world_from_camera(camera, pose)
        scene = SceneView(material=self._material, objects=objects or NO_OBJECTS)
        if self._facets is not None:
            scene = scene._replace(facets=self._facets.seen_from(world_from_camera))
        if self._shadows is not None:
            lit = self._shadows.lit(depth, world_from_camera, camera, None if objects is None else objects.label)
            if objects is not None and self._object_shadows is not None:
                self._object_shadows.darken(lit, depth, objects, world_from_camera, (camera, pose.time_s))
            if self._halos is not None:
                self._halos.hide(lit, depth, self._rig.focal_px, world_from_camera, camera)
            scene = scene._replace(lit=lit)
        return scene._replace(surface=self._surface(world_from_camera, pose.time_s)) if self._daylight_on else scene

    def _surface(self, world_from_camera: Array, time_s: float) -> WaterSurface:
        surface = calm_surface(world_from_camera, self._reference_depth_m)
        if self._caustics is None:
            return surface
        surface.from_camera[:2] *= self._caustics.cells_per_m
        return surface._replace(caustics=self._caustics.closed_pattern(time_s))

    def _world_from_camera(self, camera: int, pose: StampedPose) -> Array:
        return pose.world_from_left @ (self._rig.left_from_right if camera else np.eye(4))
