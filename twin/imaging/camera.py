"""Simulated stereo camera: renders the floor and computes light in the water, exposure and noise of each image."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Exposure, Image
from twin.core.timing import StageTimer
from twin.imaging.image_formation import ImageFormation, RadianceComponents, StampedPose
from twin.imaging.lens_psf import LensPsf
from twin.imaging.photo_sensor import PhotoSensor, Sensor, sensor_of
from twin.imaging.pixels import Raw
from twin.imaging.sensor import ExposureSetting, Radiance
from twin.imaging.shutter import ExposureMotion, integrate
from twin.imaging.true_cameras import TrueCameras, make_true_cameras
from twin.scenario.model import Scenario

if TYPE_CHECKING:
    from twin.imaging.renderer import Renderer

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

AT_REST: Array = np.zeros(6)
METERED_PX = 4  # where raw images are sampled from rendered ones, every n-th pixel along each axis is metered


class StereoCapture(NamedTuple):
    """One exposure of the stereo camera: images (H, W, 3) uint8 RGB, and true depths (H, W) [m] for the evaluation.

    The right image and its depth are None if only the left camera was used. `exposure` is that of both images, as the
    cameras report it (`Frame.exposure`).
    """

    left: Image
    right: Image | None
    depth_left: Depth
    depth_right: Depth | None
    exposure: Exposure


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
        linear: whether the image is proportional to the radiance: linear tone curve, white balance for white light.
    """

    albedo: Image
    depth: Depth
    components: RadianceComponents
    setting: ExposureSetting
    noise_free: Image
    raw: Raw | None
    linear: bool

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
    Raises:
        TwinError: `true_cameras` is None and the scenario's cameras are invalid, see `make_true_cameras`.
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
        self._sensor, self._psf = sensor_of(scenario, self._cameras.raw_rig), LensPsf(scenario, rig)
        self._focal_px, self._linear = rig.focal_px, scenario.delivers_linear_images
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
        exposure = self._sensor.signal_per_cd(setting)
        if not stereo:
            return StereoCapture(left, None, depth_left, None, exposure)
        right, depth_right, _ = self._expose(pose, 1, twist_body, setting)
        return StereoCapture(left, right, depth_left, depth_right, exposure)

    def twist_of_camera(self, camera: int, twist_body: Array) -> Array:
        """Returns the [angular, linear] velocity (6,) of a camera (0 left, 1 right) in its own axes [rad/s, m/s]."""
        return self._camera_from_body_twist[camera] @ twist_body

    def decompose(self, world_from_left: Array, twist_body: Array = AT_REST) -> DecomposedImage:
        """Returns the left image at a pose and time 0 with intermediate results; has no effect on later captures.

        Args:
            world_from_left: (4, 4) pose of the left camera at mid-exposure.
            twist_body: (6,) true [angular, linear] velocity of the body in its own axes [rad/s, m/s]; affects the
                image and the digital numbers, not the components.
        """
        albedo, depth = self._renderer.render(world_from_left)
        pose = StampedPose(world_from_left, 0.0)
        objects = self._image_formation.draw_objects(albedo, depth, 0, pose)
        components = self._image_formation.components(albedo, depth, 0, pose, objects)
        cameras = self._cameras
        sensor = sensor_of(self._scenario, cameras.raw_rig)
        floor = self._image_formation.radiance_without_snow(albedo, depth, 0, pose, objects)
        setting = self._meter(sensor, components.total, depth)
        motion = sensor.motion(self.twist_of_camera(0, twist_body), setting, len(depth))
        light = self._through_lens(floor, depth, 0, pose, motion)
        noise_free = cameras.rectify(sensor.image(light, setting, None))
        next_rng = copy.deepcopy(self._rngs[0])
        raw = sensor.raw(light, setting, next_rng) if isinstance(sensor, PhotoSensor) else None
        cropped = {name: cameras.crop(part) for name, part in components._asdict().items() if part is not None}
        components = components._replace(**cropped)
        return DecomposedImage(
            cameras.crop(albedo), cameras.crop(depth), components, setting, noise_free, raw, self._linear
        )

    def _expose(
        self, pose: StampedPose, camera: int, twist_body: Array, setting: ExposureSetting | None
    ) -> tuple[Image, Depth, ExposureSetting]:
        """Returns image, true depth and exposure of one camera; meters the exposure if `setting` is None."""
        world_from_camera = pose.world_from_left @ self._left_from_right if camera else pose.world_from_left
        with self._stopwatch("render"):
            albedo, depth = self._renderer.render(world_from_camera)
            objects = self._image_formation.draw_objects(albedo, depth, camera, pose)
        with self._stopwatch("optics"):
            floor = self._image_formation.radiance_without_snow(albedo, depth, camera, pose, objects)
            at_rest = None
            if setting is None:
                at_rest = self._with_snow(floor, depth, pose)
                setting = self._meter(self._sensor, at_rest, depth)
            motion = self._sensor.motion(self.twist_of_camera(camera, twist_body), setting, len(depth))
            raw = self._through_lens(floor, depth, camera, pose, motion, at_rest)
            image = self._cameras.rectify(self._sensor.image(raw, setting, self._rngs[camera]))
            return image, self._cameras.crop(depth), setting

    def _with_snow(self, floor: Radiance, depth: Depth, pose: StampedPose) -> Radiance:
        """Returns the light in the left camera without motion blur: `floor`, or a copy of it with marine snow."""
        if not self._image_formation.snows:
            return floor
        light = floor.copy()
        self._image_formation.add_snow(light, depth, 0, pose)
        return light

    def _meter(self, sensor: Sensor, light: Radiance, depth: Depth) -> ExposureSetting:
        """Returns the exposure metered on the light (H, W, 3) in the left camera at rest."""
        every_px = 1 if self._cameras.sampling is None else METERED_PX
        return sensor.meter(self._cameras.sample(light, depth, 0, every_px), every_px)

    def _through_lens(
        self,
        floor: Radiance,
        depth: Depth,
        camera: int,
        pose: StampedPose,
        motion: ExposureMotion | None,
        at_rest: Radiance | None = None,
    ) -> Radiance:
        """Returns the radiance (h, w, 3) at the raw pixels, given the light of floor and water, which may be changed.

        Depth of field and motion blur depend on depth; marine snow, which has other depths and velocities, is drawn
        with its own blur afterwards. `at_rest` is the light with marine snow in a camera at rest, if it is known.
        """
        light = self._psf.out_of_focus(floor, depth)
        if motion is not None:
            motion = motion._replace(rolls_later=self._cameras.sampling is not None)
            light = integrate(light, depth, self._focal_px, motion)
        if light is floor and motion is None and at_rest is not None:
            light = at_rest
        else:
            self._image_formation.add_snow(light, depth, camera, pose, motion)
        return self._cameras.sample(self._psf.transfer(light), depth, camera, motion=motion)
