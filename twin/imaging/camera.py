"""Simulated stereo camera: renders the floor and computes light in the water, exposure and noise of each image."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Image
from twin.core.timing import StageTimer
from twin.imaging.image_formation import ImageFormation, RadianceComponents, StampedPose
from twin.imaging.photo_sensor import PhotoSensor, sensor_of
from twin.imaging.pixels import Raw
from twin.imaging.sensor import ExposureSetting
from twin.imaging.true_cameras import TrueCameras, make_true_cameras
from twin.scenario.model import Scenario

if TYPE_CHECKING:
    from twin.imaging.renderer import Renderer

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

AT_REST: Array = np.zeros(6)


class StereoCapture(NamedTuple):
    """One exposure of the stereo camera: images (H, W, 3) uint8 RGB, and true depths (H, W) [m] for the evaluation.

    The right image and its depth are None if only the left camera was used.
    """

    left: Image
    right: Image | None
    depth_left: Depth
    depth_right: Depth | None


class DecomposedImage(NamedTuple):
    """A left image without noise, with the intermediate results of its computation.

    Args:
        albedo: (H, W, 3) uint8 albedo of the floor, 255 = white.
        depth: (H, W) depth along the optical axis [m].
        components: direct signal, backscatter and other components of the radiance.
        setting: exposure, metered on this image.
        noise_free: (H, W, 3) image without noise.
        raw: digital numbers of the physical sensor, including the noise that the next capture will have; (H, W) with a
            Bayer filter, otherwise (H, W, 3); None for the plain sensor.
    """

    albedo: Image
    depth: Depth
    components: RadianceComponents
    setting: ExposureSetting
    noise_free: Image
    raw: Raw | None

    @property
    def gain(self) -> float:
        """Image signal per unit of radiance on the optical axis [1 / (cd/m2)]; the image saturates at a signal of 1."""
        return self.setting.gain


class StereoCamera:
    """Stereo camera: both cameras share one auto-exposure; their noise is independent.

    Args:
        renderer: renderer of albedo and depth of the floor.
        image_formation: model of the radiance that reaches the cameras through the water.
        scenario: settings of the cameras and the sensor.
        left_rng, right_rng: random streams of the image noise.
        stopwatch: timer of the stages "render" and "optics".
        true_cameras: geometry of the true cameras; None = as defined by the scenario.
    """

    def __init__(
        self,
        renderer: Renderer,
        image_formation: ImageFormation,
        scenario: Scenario,
        left_rng: np.random.Generator,
        right_rng: np.random.Generator,
        stopwatch: StageTimer,
        true_cameras: TrueCameras | None = None,
    ):
        self._cameras = make_true_cameras(scenario) if true_cameras is None else true_cameras
        rig = self._cameras.rendered_rig
        self._renderer, self._image_formation = renderer, image_formation
        self._scenario, self._stopwatch = scenario, stopwatch
        self._left_from_right, self._frame_rate_hz = rig.left_from_right, rig.frame_rate_hz
        body_from_cameras = rig.body_from_camera, rig.body_from_camera @ rig.left_from_right
        self._camera_from_body_twist = [geometry.adjoint(geometry.inverse(pose)) for pose in body_from_cameras]
        self._sensor = sensor_of(scenario, self._cameras.raw_rig)
        self._rngs = (left_rng, right_rng)
        self._n_captures = 0

    def capture(self, world_from_left: Array, stereo: bool, twist_body: Array = AT_REST) -> StereoCapture:
        """Returns the image of the left camera and, if `stereo`, the simultaneous image of the right camera.

        Each call advances the time by one frame.

        Args:
            world_from_left: (4, 4) pose of the left camera at mid-exposure.
            stereo: whether the right camera is used too.
            twist_body: (6,) true [angular, linear] velocity of the body in its own axes [rad/s, m/s].
        """
        pose = StampedPose(world_from_left, self._n_captures / self._frame_rate_hz)
        self._n_captures += 1
        left, depth_left, setting = self._expose(pose, 0, twist_body, None)
        if not stereo:
            return StereoCapture(left, None, depth_left, None)
        right, depth_right, _ = self._expose(pose, 1, twist_body, setting)
        return StereoCapture(left, right, depth_left, depth_right)

    def twist_of_camera(self, camera: int, twist_body: Array) -> Array:
        """Returns the [angular, linear] velocity (6,) of a camera (0 left, 1 right) in its own axes [rad/s, m/s]."""
        return self._camera_from_body_twist[camera] @ twist_body

    def decompose(self, world_from_left: Array) -> DecomposedImage:
        """Returns the left image at a pose and time 0 with intermediate results; has no effect on later captures."""
        albedo, depth = self._renderer.render(world_from_left)
        components = self._image_formation.components(albedo, depth, 0, StampedPose(world_from_left, 0.0))
        cameras = self._cameras
        sensor = sensor_of(self._scenario, cameras.raw_rig)
        light = cameras.sample(components.total, depth, 0)
        setting = sensor.meter(light)
        noise_free = cameras.rectify(sensor.image(light, setting, None))
        next_rng = copy.deepcopy(self._rngs[0])
        raw = sensor.raw(light, setting, next_rng) if isinstance(sensor, PhotoSensor) else None
        cropped = {name: cameras.crop(part) for name, part in components._asdict().items() if part is not None}
        components = components._replace(**cropped)
        return DecomposedImage(cameras.crop(albedo), cameras.crop(depth), components, setting, noise_free, raw)

    def _expose(
        self, pose: StampedPose, camera: int, twist_body: Array, setting: ExposureSetting | None
    ) -> tuple[Image, Depth, ExposureSetting]:
        """Returns image, true depth and exposure of one camera; meters the exposure if `setting` is None."""
        world_from_camera = pose.world_from_left @ self._left_from_right if camera else pose.world_from_left
        with self._stopwatch("render"):
            albedo, depth = self._renderer.render(world_from_camera)
        with self._stopwatch("optics"):
            light = self._image_formation.radiance(albedo, depth, camera, pose)
            raw = None
            if setting is None:
                raw = self._cameras.sample(light, depth, camera)
                setting = self._sensor.meter(raw)
            integrated = self._sensor.integrate(light, depth, self.twist_of_camera(camera, twist_body), setting)
            raw = self._cameras.sample(integrated, depth, camera) if raw is None or integrated is not light else raw
            image = self._cameras.rectify(self._sensor.image(raw, setting, self._rngs[camera]))
            return image, self._cameras.crop(depth), setting
