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
        left, depth_left, gain = self._see(world_from_left, 0, None)
        if not stereo:
            return Shot(left, None, depth_left, None)
        right, depth_right, _ = self._see(world_from_left @ self._left_from_right, 1, gain)
        return Shot(left, right, depth_left, depth_right)

    def _see(self, world_from_eye: Array, eye: int, gain: float | None) -> tuple[Image, Depth, float]:
        """Image and true depth of an eye, and the gain it was exposed with: metered here, or that of the other eye."""
        with self._watch("render"):
            albedo, depth = self._renderer.render(world_from_eye)
        with self._watch("optics"):
            light = self._optics.radiance(albedo, depth, eye)
            gain = self._exposure.gain(light) if gain is None else gain
            return expose(light, gain, self._imaging, self._rngs[eye]), depth, gain
