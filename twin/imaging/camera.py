"""The stereo camera: a pose in, two images out."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.config import Scenario
from twin.imaging.optics import Optics
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


class StereoCamera:
    """Two eyes that share one auto-exposure; noise of the left eye does not depend on whether the right one is used."""

    def __init__(
        self,
        renderer: Renderer,
        scenario: Scenario,
        left_rng: np.random.Generator,
        right_rng: np.random.Generator,
        watch: Callable[[str], AbstractContextManager[None]],
    ):
        rig = scenario.believed_rig()
        self._renderer, self._imaging, self._watch = renderer, scenario.imaging, watch
        self._left_from_right = rig.left_from_right
        self._optics = Optics(rig, scenario.water, scenario.lamps, scenario.sun)
        self._exposure = Exposure(scenario.imaging.gray_level, rig.frame_rate_hz)
        self._rngs = (left_rng, right_rng)

    def shoot(self, world_from_left: Array, stereo: bool) -> Shot:
        """Images of the left eye and, where `stereo`, of the right one at the same instant."""
        light, depth_left = self._see(world_from_left, 0)
        gain = self._exposure.gain(light)
        left = self._expose(light, gain, 0)
        if not stereo:
            return Shot(left, None, depth_left, None)
        light, depth_right = self._see(world_from_left @ self._left_from_right, 1)
        return Shot(left, self._expose(light, gain, 1), depth_left, depth_right)

    def _see(self, world_from_eye: Array, eye: int) -> tuple[NDArray[np.float32], Depth]:
        with self._watch("render"):
            albedo, depth = self._renderer.render(world_from_eye)
        with self._watch("optics"):
            return self._optics.radiance(albedo, depth, eye), depth

    def _expose(self, light: NDArray[np.float32], gain: float, eye: int) -> Image:
        with self._watch("optics"):
            return expose(light, gain, self._imaging, self._rngs[eye])
