"""How well the floor can be matched: the least deviation that noise leaves to the place of a patch.

The image of a level floor at some depth is made by the project's own light and sensor from the scenario's own texture.
With g the gradient of the grey image along a row and s the noise, a patch of p x p pixels in two images can be placed
no better than c = sqrt(2) s / (p rms(g)) pixels, the bound of Cramer and Rao for a shift.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

import terrains
from twin.config import Scenario
from twin.geometry import BODY_FROM_DOWN_CAMERA, Array, pose
from twin.imaging.light import Light, Moment
from twin.imaging.photo_sensor import sensor_of
from twin.records import Image, StereoRig

_DEPTHS = 6


class Conditions:
    """The bound c of a survey as a function of depth, over all depths that the plan can meet.

    Attributes:
        table: depths (m,) [m] and the bound at each (m,) [px].
        bounds_px: least and greatest bound.
    """

    def __init__(self, scenario: Scenario, terrain: terrains.Terrain):
        nearest = max(scenario.plan.altitude_m - terrain.highest_m, 0.3)
        depths_m = np.geomspace(0.8 * nearest, 1.2 * (scenario.plan.altitude_m - terrain.lowest_m), _DEPTHS)
        self.table = depths_m, bounds_px(scenario, terrain, depths_m)
        self.bounds_px = float(self.table[1].min()), float(self.table[1].max())

    def bound_px(self, depth_m: float) -> float:
        """The bound at a depth [m]."""
        return float(np.interp(depth_m, *self.table))


def bounds_px(scenario: Scenario, terrain: terrains.Terrain, depths_m: Array) -> Array:
    """The bound c [px] at depths (n,) [m]."""
    imaging = scenario.imaging.model_copy(update={"shadows": False})
    scenario = scenario.model_copy(
        update={"imaging": imaging, "snow": scenario.snow.model_copy(update={"density_per_m3": 0.0})}
    )
    rig, rng = scenario.believed_rig(), np.random.default_rng(0)
    light = Light(scenario, terrain, rng)
    texture, texel_m = _texture(scenario, terrain, float(max(depths_m)) * rig.width_px / rig.focal_px)
    return np.array([_bound_px(scenario, rig, light, _albedo(texture, texel_m, rig, z), z, rng) for z in depths_m])


def _bound_px(scenario: Scenario, rig: StereoRig, light: Light, albedo: Image, depth_m: float, rng) -> float:
    depth = np.full(albedo.shape[:2], depth_m, np.float32)
    world_from_left = pose(BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, scenario.plan.altitude_m]))
    radiance = light.radiance(albedo, depth, 0, Moment(world_from_left, 0.0))
    sensor = sensor_of(scenario, rig)
    setting = sensor.meter(radiance)
    signal = _gray(np.minimum(255 * setting.gain * radiance, 255).astype(np.float32))
    first, second = (_gray(sensor.image(radiance, setting, rng).astype(np.float32)) for _ in range(2))
    noise = float((first - second).std()) / np.sqrt(2)
    gradient = float(np.sqrt(np.mean(np.diff(signal, axis=1) ** 2)))
    return np.sqrt(2) * noise / (scenario.estimate.patch_px * max(gradient, 1e-6))


def _gray(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """As the estimators see it: grey, its finest detail smoothed."""
    return np.asarray(cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (3, 3), 0.5), np.float32)


def _texture(scenario: Scenario, terrain: terrains.Terrain, extent_m: float) -> tuple[Image, float]:
    """A piece of the floor's texture, at least so wide where there is as much; and the size of its texels [m]."""
    t = scenario.terrain
    if t.kind == "file":
        return terrain.texture, terrain.texture_px_m
    extent_m = float(min(max(extent_m, 4 * t.grid_m), *t.size_m))
    piece = terrains.generate(
        t.kind, (extent_m, extent_m), t.relief_m, t.base_m, t.grid_m, t.texture_px_m, scenario.seed
    )
    return piece.texture, piece.texture_px_m


def _albedo(texture: Image, texel_m: float, rig: StereoRig, depth_m: float) -> Image:
    """The middle of the texture as the camera sees it, (height_px, width_px, 3)."""
    texels_per_px = depth_m / rig.focal_px / texel_m
    height, width = texture.shape[:2]
    rows, cols = (min(round(n * texels_per_px), most) for n, most in ((rig.height_px, height), (rig.width_px, width)))
    rows, cols = max(rows, 2), max(cols, 2)
    top, left = (height - rows) // 2, (width - cols) // 2
    way = cv2.INTER_AREA if texels_per_px > 1 else cv2.INTER_LINEAR
    piece = texture[top : top + rows, left : left + cols]
    return np.asarray(cv2.resize(piece, (rig.width_px, rig.height_px), interpolation=way), np.uint8)
