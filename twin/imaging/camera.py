"""The stereo camera: a pose in, two images out."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Image
from twin.imaging.light import Layers, Light, Moment
from twin.imaging.photo_sensor import PhotoSensor, sensor_of
from twin.imaging.pixels import Raw
from twin.imaging.sensor import Setting
from twin.imaging.true_cameras import View, make_view
from twin.scenario.model import Scenario

if TYPE_CHECKING:
    from twin.imaging.renderer import Renderer

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

AT_REST: Array = np.zeros(6)


class Shot(NamedTuple):
    """What one release of the shutter gives: images (H, W, 3) uint8 RGB, and true depth (H, W) [m] for the judge."""

    left: Image
    right: Image | None
    depth_left: Depth
    depth_right: Depth | None


class Anatomy(NamedTuple):
    """The left image taken apart.

    Args:
        albedo: (H, W, 3) uint8.
        depth: (H, W) along the optical axis [m].
        layers: the light by its origin.
        setting: how it was exposed, metered on this image.
        clean: the image without noise.
        raw: digital numbers of a physical sensor, with the noise of the next shot: (H, W) behind a Bayer filter, else
            (H, W, 3); None of a plain one.
    """

    albedo: Image
    depth: Depth
    layers: Layers
    setting: Setting
    clean: Image
    raw: Raw | None

    @property
    def gain(self) -> float:
        """Signal per radiance on the axis [1 / (cd/m2)]; a signal of 1 saturates."""
        return self.setting.gain


class StereoCamera:
    """Two cameras that share one auto-exposure; the noise of the left one is independent of the right one."""

    def __init__(
        self,
        renderer: Renderer,
        light: Light,
        scenario: Scenario,
        left_rng: np.random.Generator,
        right_rng: np.random.Generator,
        watch: Callable[[str], AbstractContextManager[None]],
        view: View | None = None,
    ):
        self._view = make_view(scenario) if view is None else view
        rig = self._view.rig
        self._renderer, self._light, self._scenario, self._watch = renderer, light, scenario, watch
        self._left_from_right, self._frame_rate_hz = rig.left_from_right, rig.frame_rate_hz
        eyes = rig.body_from_camera, rig.body_from_camera @ rig.left_from_right
        self._eye_from_body_twist = [geometry.adjoint(geometry.inverse(body_from_eye)) for body_from_eye in eyes]
        self._sensor = sensor_of(scenario, self._view.sensor)
        self._rngs = (left_rng, right_rng)
        self._shots = 0

    def shoot(self, world_from_left: Array, stereo: bool, twist_body: Array = AT_REST) -> Shot:
        """Images of the left camera and, where `stereo`, of the right one at the same instant.

        Args:
            twist_body: (6,) true [angular, linear] velocity in the body [rad/s, m/s].
        """
        moment = Moment(world_from_left, self._shots / self._frame_rate_hz)
        self._shots += 1
        left, depth_left, setting = self._see(moment, 0, twist_body, None)
        if not stereo:
            return Shot(left, None, depth_left, None)
        right, depth_right, _ = self._see(moment, 1, twist_body, setting)
        return Shot(left, right, depth_left, depth_right)

    def twist_of_eye(self, eye: int, twist_body: Array) -> Array:
        """(6,) [angular, linear] velocity of an eye (0 left, 1 right) in its own axes [rad/s, m/s]."""
        return self._eye_from_body_twist[eye] @ twist_body

    def dissect(self, world_from_left: Array) -> Anatomy:
        """What the left image would consist of, as the first of a survey; changes nothing of the camera."""
        albedo, depth = self._renderer.render(world_from_left)
        layers = self._light.layers(albedo, depth, 0, Moment(world_from_left, 0.0))
        sensor, view = sensor_of(self._scenario, self._view.sensor), self._view
        light = view.raw(layers.total, depth, 0)
        setting = sensor.meter(light)
        clean = view.frame(sensor.image(light, setting, None))
        next_rng = copy.deepcopy(self._rngs[0])
        raw = sensor.raw(light, setting, next_rng) if isinstance(sensor, PhotoSensor) else None
        layers = layers._replace(**{k: view.crop(layer) for k, layer in layers._asdict().items() if layer is not None})
        return Anatomy(view.crop(albedo), view.crop(depth), layers, setting, clean, raw)

    def _see(
        self, moment: Moment, eye: int, twist_body: Array, setting: Setting | None
    ) -> tuple[Image, Depth, Setting]:
        """Image and true depth of an eye, and how it was exposed: as metered here, or as the other eye."""
        world_from_eye = moment.world_from_left @ self._left_from_right if eye else moment.world_from_left
        with self._watch("render"):
            albedo, depth = self._renderer.render(world_from_eye)
        with self._watch("optics"):
            light = self._light.radiance(albedo, depth, eye, moment)
            raw = None
            if setting is None:
                raw = self._view.raw(light, depth, eye)
                setting = self._sensor.meter(raw)
            moved = self._sensor.gather(light, depth, self.twist_of_eye(eye, twist_body), setting)
            raw = self._view.raw(moved, depth, eye) if raw is None or moved is not light else raw
            image = self._view.frame(self._sensor.image(raw, setting, self._rngs[eye]))
            return image, self._view.crop(depth), setting
