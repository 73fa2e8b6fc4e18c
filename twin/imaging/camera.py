"""The stereo camera: a pose in, two images out."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.config import Scenario
from twin.imaging.light import Layers, Light, Moment
from twin.imaging.sensor import Exposure, expose
from twin.records import Image

if TYPE_CHECKING:
    from twin.imaging.renderer import Renderer

Array = NDArray[np.float64]
Depth = NDArray[np.float32]


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
        gain: signal per radiance, metered on this image; a signal of 1 saturates.
        clean: the image without noise.
    """

    albedo: Image
    depth: Depth
    layers: Layers
    gain: float
    clean: Image


class StereoCamera:
    """Two eyes that share one auto-exposure; noise of the left eye does not depend on whether the right one is used."""

    def __init__(
        self,
        renderer: Renderer,
        light: Light,
        scenario: Scenario,
        left_rng: np.random.Generator,
        right_rng: np.random.Generator,
        watch: Callable[[str], AbstractContextManager[None]],
    ):
        rig = scenario.believed_rig()
        self._renderer, self._light, self._imaging, self._watch = renderer, light, scenario.imaging, watch
        self._left_from_right, self._frame_rate_hz = rig.left_from_right, rig.frame_rate_hz
        self._exposure = Exposure(scenario.imaging.gray_level, rig.frame_rate_hz)
        self._rngs = (left_rng, right_rng)
        self._shots = 0

    def shoot(self, world_from_left: Array, stereo: bool) -> Shot:
        """Images of the left eye and, where `stereo`, of the right one at the same instant."""
        moment = Moment(world_from_left, self._shots / self._frame_rate_hz)
        self._shots += 1
        left, depth_left, gain = self._see(moment, 0, None)
        if not stereo:
            return Shot(left, None, depth_left, None)
        right, depth_right, _ = self._see(moment, 1, gain)
        return Shot(left, right, depth_left, depth_right)

    def dissect(self, world_from_left: Array) -> Anatomy:
        """What the left image would consist of, as the first of a survey; changes nothing of the camera."""
        albedo, depth = self._renderer.render(world_from_left)
        layers = self._light.layers(albedo, depth, 0, Moment(world_from_left, 0.0))
        gain = Exposure(self._imaging.gray_level, self._frame_rate_hz).gain(layers.total)
        noiseless = self._imaging.model_copy(update={"noise_sd": 0.0, "shot_noise": 0.0})
        clean = expose(layers.total, gain, noiseless, np.random.default_rng(0))
        return Anatomy(albedo, depth, layers, gain, clean)

    def _see(self, moment: Moment, eye: int, gain: float | None) -> tuple[Image, Depth, float]:
        """Image and true depth of an eye, and the gain it was exposed with: metered here, or that of the other eye."""
        world_from_eye = moment.world_from_left @ self._left_from_right if eye else moment.world_from_left
        with self._watch("render"):
            albedo, depth = self._renderer.render(world_from_eye)
        with self._watch("optics"):
            light = self._light.radiance(albedo, depth, eye, moment)
            gain = self._exposure.gain(light) if gain is None else gain
            return expose(light, gain, self._imaging, self._rngs[eye]), depth, gain
