"""How well the floor can be matched: the least deviation that noise leaves to the place of a patch.

The image of a level floor at some depth is made by the project's own light and sensor from the scenario's own texture.
With g the gradient of the grey image along a row and s the noise, a patch of p x p pixels in two images can be placed
no better than c = sqrt(2) s / (p rms(g)) pixels, the bound of Cramer and Rao for a shift.

And how far the floor under a patch lies out of the plane that it is matched as: from another place, that makes it seem
to have moved.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

import terrains
from twin.core.geometry import BODY_FROM_DOWN_CAMERA, Array, pose
from twin.core.records import Image, StereoRig
from twin.imaging.camera import Depth
from twin.imaging.light import Light, Moment
from twin.imaging.photo_sensor import sensor_of
from twin.scenario.model import Scenario

_DEPTHS = 6
_PATCHES = 300  # of the floor, looked at for how uneven it is
_SAMPLES = 9  # along either side of one


class Conditions:
    """The bound c of a survey, and how uneven its floor is, by depth, over all depths that the plan can meet.

    Attributes:
        depths_m: (m,).
        bounds_px: (m,) bound there.
        unevenness_px: (m,) how far the floor under a patch, seen from there, lies out of its plane.
        lamp_share: how much of the light is the lamps', which move along.
    """

    def __init__(self, scenario: Scenario, terrain: terrains.Terrain):
        nearest = max(scenario.plan.altitude_m - terrain.highest_m, 0.3)
        self.depths_m = np.geomspace(0.8 * nearest, 1.2 * (scenario.plan.altitude_m - terrain.lowest_m), _DEPTHS)
        self.bounds_px = bounds_px(scenario, terrain, self.depths_m)
        self.unevenness_px = unevenness_px(scenario, terrain, self.depths_m)
        self.lamp_share = lamp_share(scenario, terrain)

    def bound_px(self, depth_m: float) -> float:
        """The bound at a depth [m]."""
        return float(np.interp(depth_m, self.depths_m, self.bounds_px))

    def uneven_px(self, depth_m: float) -> float:
        """How uneven the floor is from a depth [m]."""
        return float(np.interp(depth_m, self.depths_m, self.unevenness_px))


def bounds_px(scenario: Scenario, terrain: terrains.Terrain, depths_m: Array) -> Array:
    """The bound c [px] at depths (n,) [m]."""
    scenario = _plain(scenario)
    rig, rng = scenario.believed_rig(), np.random.default_rng(0)
    light = Light(scenario, terrain, rng)
    texture, texel_m = _texture(scenario, terrain, float(max(depths_m)) * rig.width_px / rig.focal_px)
    return np.array([_bound_px(scenario, rig, light, _albedo(texture, texel_m, rig, z), z, rng) for z in depths_m])


def lamp_share(scenario: Scenario, terrain: terrains.Terrain) -> float:
    """Share of the light that a level floor at the planned altitude sends back which is the lamps', from 0 to 1."""
    if not scenario.lamps or scenario.sun.illuminance_lx == 0:
        return float(bool(scenario.lamps))
    sunlit, both = (_sent_back(s, terrain) for s in (scenario.model_copy(update={"lamps": ()}), scenario))
    return 1 - sunlit / max(both, np.finfo(float).tiny)


def _sent_back(scenario: Scenario, terrain: terrains.Terrain) -> float:
    """Mean radiance of a white floor at the planned altitude less that of a black one [cd/m2]."""
    light = Light(_plain(scenario), terrain, np.random.default_rng(0))
    depth, moment = _level_floor(scenario, scenario.plan.altitude_m)
    white, black = (light.radiance(np.full((*depth.shape, 3), level, np.uint8), depth, 0, moment) for level in (255, 0))
    return float(np.mean(white - black))


def _level_floor(scenario: Scenario, depth_m: float) -> tuple[Depth, Moment]:
    """A level floor as the camera sees it from the planned altitude."""
    rig, altitude_m = scenario.believed_rig(), scenario.plan.altitude_m
    world_from_left = pose(BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, altitude_m]))
    return np.full((rig.height_px, rig.width_px), depth_m, np.float32), Moment(world_from_left, 0.0)


def _plain(scenario: Scenario) -> Scenario:
    """The scenario without what the surrogate knows nothing of."""
    imaging = scenario.imaging.model_copy(update={"shadows": False})
    snow = scenario.snow.model_copy(update={"density_per_m3": 0.0})
    return scenario.model_copy(update={"imaging": imaging, "snow": snow})


def unevenness_px(scenario: Scenario, terrain: terrains.Terrain, depths_m: Array) -> Array:
    """Deviation of the floor under a patch from its plane, seen from depths (n,) [m], all over the planned area.

    In pixels that it moves against the plane, for every depth that the camera moves sideways: f rms(z) / depth.
    """
    focal_px, patch_px = scenario.believed_rig().focal_px, scenario.estimate.patch_px
    side = np.linspace(-0.5, 0.5, _SAMPLES)
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    plane = np.column_stack([np.ones_like(x), x, y])
    apart = np.eye(len(x)) - plane @ np.linalg.pinv(plane)
    rng = np.random.default_rng(0)
    centres = (rng.random((_PATCHES, 1, 2)) - 0.5) * scenario.plan.area_m
    found = []
    for depth_m in depths_m:
        at = centres + np.column_stack([x, y]) * (patch_px * depth_m / focal_px)
        height_m = terrain.height_at(at[..., 0], at[..., 1])
        found.append(focal_px * np.sqrt(np.nanmean((height_m @ apart) ** 2)) / depth_m)
    return np.array(found)


def _bound_px(scenario: Scenario, rig: StereoRig, light: Light, albedo: Image, depth_m: float, rng) -> float:
    depth, moment = _level_floor(scenario, depth_m)
    radiance = light.radiance(albedo, depth, 0, moment)
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
