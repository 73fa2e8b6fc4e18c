"""Restoration: the albedo of the floor from an image, without the effects of lamps, daylight and water.

It inverts the model of `optics` with the believed calibration, lamps and water, and the estimated floor. With rho the
albedo, W the light of a white floor attenuated by absorption, u = exp(-b r), k the share without blur, F the scattered
light of the floor and B the backscatter, L = rho W u + F(rho W) + B. The first estimate is that of a uniform albedo,
rho = (L - B) / (W u + F(W)), corrected by

    rho <- (L - B - (F(rho W) - (k - u) rho W)) / (k W).

With single scattering, rho = (L - B) / W. Snow, caustics, shadows of objects, blur of lens and motion, and saturation
are not corrected; the floor is taken to be Lambertian.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core import geometry, height_field
from twin.core.records import Array, Depth, ElevationMap, Exposure, Image, Radiance, StereoRig
from twin.errors import TwinError
from twin.imaging.camera.photons import vignetting
from twin.imaging.camera.tone import linear_of
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.lamp_halos import LampHalos
from twin.imaging.light.optics import Optics, SceneView, calm_surface
from twin.imaging.light.shadows import Shadows, direction_to_casting_sun
from twin.imaging.scene.facets import Facets
from twin.scenario.model import Scenario
from twin.terrains.load import fill_holes

DEPTH_STEP_PX = 4  # spacing of the pixels whose depth is computed; light depends on depth smoothly
STEPS = 2  # number of corrections of the blur
_DARK = 1e-6  # pixels whose light of a white floor, relative to the brightest pixel, is below this get the albedo 0


class Restoration:
    """Restoration of the images of the left camera of a survey, from an estimated map with at least one height."""

    def __init__(self, scenario: Scenario, illumination: Illumination, rig: StereoRig, elevation: ElevationMap):
        self._rig, self._optics = rig, Optics(rig, illumination, scenario.lamps)
        self._floor = floor = estimated_floor(elevation)
        self._facets = Facets(floor)
        sources = self._optics.light_sources
        self._shadows = self._halos = None
        if scenario.imaging.shadows:
            to_sun = direction_to_casting_sun(illumination.daylight)
            if to_sun is not None:
                to_sun = elevation.map_from_world[:3, :3] @ to_sun
            positions_m = [source.position_m for source in sources]
            self._shadows = Shadows(floor, rig, positions_m, to_sun)
            self._halos = LampHalos(floor, sources, illumination.water)
        self._signal = linear_signal(scenario)
        sensor = scenario.sensor
        power = 0.0 if sensor is None or sensor.shading_correction else sensor.vignetting_power
        self._vignetting = vignetting(rig, power)[..., None]
        self._sunny = bool(illumination.daylight.surface_lx.any())
        self._reference_depth_m = illumination.daylight.reference_depth_m
        self._world_from_map = geometry.inverse(elevation.map_from_world)

    def __call__(self, image: Image, exposure: Exposure | None, map_from_camera: Array) -> Radiance:
        """Returns the albedo (H, W, 3) of the floor in a left image, 255 = white. Raises TwinError without exposure."""
        if exposure is None:
            raise TwinError("map.restore", "the exposures of the images are not known", "frames with an exposure")
        radiance = (self._signal[image] / (self._vignetting * np.array(exposure))).astype(np.float32)
        depth = self._depth(map_from_camera)
        return np.float32(255) * self._albedo(radiance, depth, map_from_camera)

    def _albedo(self, radiance: Radiance, depth: Depth, map_from_camera: Array) -> Radiance:
        """Returns the albedo (H, W, 3), 1 = white, of a floor at this depth in an image of this radiance."""
        scene = SceneView(self._facets.seen_from(map_from_camera))
        if self._shadows is not None and self._halos is not None:
            lit = self._shadows.lit(depth, map_from_camera, 0)
            self._halos.hide(lit, depth, self._rig.focal_px, map_from_camera, 0)
            scene = scene._replace(lit=lit)
        if self._sunny:
            surface = calm_surface(self._world_from_map @ map_from_camera, self._reference_depth_m)
            scene = scene._replace(surface=surface)
        white = self._optics.white_floor(depth, 0, scene)
        light = np.maximum(radiance - white.backscatter, 0)
        dark = white.floor < _DARK * white.floor.max()
        divisor = np.where(dark, np.float32(np.inf), white.floor)
        if white.spread is None:
            return (light / divisor).astype(np.float32)
        whole = divisor * white.unscattered + white.spread(white.floor, np.ones((1, 1, 3), np.float32))
        albedo = (light / whole).astype(np.float32)
        for _ in range(STEPS):
            floor_light = (albedo * white.floor).astype(np.float32)
            blurred = white.spread(floor_light, albedo) - white.core * floor_light
            sharp = np.maximum(light - blurred, 0) / (divisor * (white.unscattered + white.core))
            albedo = sharp.astype(np.float32)
        return albedo

    def _depth(self, map_from_camera: Array) -> Depth:
        """Returns the depth (H, W) of the estimated floor [m].

        Outside the map, it is that of a plane fitted to the depth inside, but at most the largest depth inside.
        """
        rig = self._rig
        columns = max(2, rig.width_px // DEPTH_STEP_PX)
        pixels = height_field.ray_grid(rig, columns)
        depth = height_field.cast_pixels(self._floor, map_from_camera[None], rig, pixels)[0]
        terms, per_m = np.column_stack([pixels, np.ones(len(pixels))]), 1 / depth
        known = per_m > 0
        if known.sum() < 3:  # too few rays meet the map to fit a plane; these colours are not used
            known, per_m = np.ones_like(known), np.full_like(per_m, 1 / rig.focal_px)
        plane = np.linalg.lstsq(terms[known], per_m[known], rcond=None)[0]
        per_m = np.where(known, per_m, np.maximum(terms @ plane, per_m[known].min()))
        coarse = per_m.reshape(-1, columns).astype(np.float32)
        return 1 / cv2.resize(coarse, (rig.width_px, rig.height_px), interpolation=cv2.INTER_LINEAR)


def estimated_floor(elevation: ElevationMap) -> height_field.HeightField:
    """Returns the heights of a map, not smoothed, as this tilts facets; a hole has the height of the nearest cell."""
    height = fill_holes(elevation.height_m.astype(np.float64))
    return height_field.map_height_field(height.astype(np.float32), elevation.grid)


def linear_signal(scenario: Scenario) -> NDArray[np.float32]:
    """Returns the linear signal (256,) of each level of an image, 1 at full scale."""
    curve = "linear" if scenario.sensor is None else scenario.sensor.tone_curve
    return np.array([linear_of(level / 255, curve) for level in range(256)], np.float32)
