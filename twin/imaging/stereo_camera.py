"""Simulated stereo camera: renders the floor and computes light in the water, exposure and noise of each image."""

import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.records import Array, Depth, Exposure, Image, Radiance
from twin.core.threads import in_pair
from twin.core.timing import StageTimer
from twin.imaging.camera.lens_psf import LensPsf
from twin.imaging.camera.photo_sensor import PhotoSensor, Sensor, sensor_of
from twin.imaging.camera.pixels import Raw
from twin.imaging.camera.sensor import ExposureSetting
from twin.imaging.camera.shutter import ExposureMotion, integrate
from twin.imaging.camera.true_cameras import TrueCameras, make_true_cameras
from twin.imaging.image_formation import ImageFormation, RadianceComponents, RenderedView, StampedPose
from twin.imaging.scene.mesh_raster import ObjectView
from twin.scenario.model import Scenario

if TYPE_CHECKING:
    from twin.imaging.scene.renderer import Renderer


AT_REST: Array = np.zeros(6)


class StereoCapture(NamedTuple):
    """One exposure: images (H, W, 3), and true depths (H, W) [m]; the right ones are None without stereo."""

    left: Image
    right: Image | None
    depth_left: Depth
    depth_right: Depth | None
    exposure: Exposure


class DecomposedImage(NamedTuple):
    """A left image without noise, with the intermediate results of its computation."""

    albedo: Image  # (H, W, 3) uint8 albedo of floor and objects, 255 = white
    depth: Depth  # (H, W) depth along the optical axis [m]; inf where there is no floor
    components: RadianceComponents  # direct signal, backscatter and other components of the radiance
    setting: ExposureSetting  # exposure, metered on this image
    noise_free: Image  # (H, W, 3) image without noise
    raw: Raw | None  # digital numbers of the physical sensor, with the noise of the next capture; None: plain sensor
    linear: bool  # whether the image is proportional to the radiance: linear tone curve, white balance for white light
    objects: ObjectView | None = None  # normals and labels (H, W) of the objects in the image; None without objects


class StereoCamera:
    """Stereo camera: both cameras share one auto-exposure; their noise is independent."""

    def __init__(
        self, renderer: "Renderer", image_formation: ImageFormation, scenario: Scenario, left_rng: np.random.Generator,
        right_rng: np.random.Generator, stopwatch: StageTimer, true_cameras: TrueCameras | None = None,
    ):  # fmt: skip
        self._cameras = make_true_cameras(scenario) if true_cameras is None else true_cameras
        rig = self._cameras.rendered_rig
        self._renderer, self._image_formation = renderer, image_formation
        self._scenario, self._stopwatch = scenario, stopwatch
        self._left_from_right, self._frame_rate_hz = rig.left_from_right, rig.frame_rate_hz
        body_from_cameras = rig.body_from_camera, rig.body_from_camera @ rig.left_from_right
        self._camera_from_body_twist = [geometry.adjoint(geometry.inverse(pose)) for pose in body_from_cameras]
        self._sensor, self.psf = sensor_of(scenario, self._cameras.raw_rig), LensPsf(scenario, rig)
        self._focal_px, self._linear = rig.focal_px, scenario.delivers_linear_images
        self._rngs, self._rng_apart = (left_rng, right_rng), right_rng.spawn(1)[0]
        self._n_captures, self._last_setting = 0, self._sensor.setting

    def capture(self, world_from_left: Array, stereo: bool, twist_body: Array = AT_REST) -> StereoCapture:
        """Returns the image of the left camera and, if `stereo`, of the right one; advances the time by one frame.

        The pose (4, 4) and the true [angular, linear] velocity of the body (6,) are those at mid-exposure.
        """
        pose = StampedPose(world_from_left, self._n_captures / self._frame_rate_hz)
        self._n_captures += 1
        views = [self._render(pose, camera) for camera in ((0, 1) if stereo else (0,))]
        with self._stopwatch("optics"):
            setting = self._sensor.setting
            metered = setting is not None
            if setting is None:  # metered on the first left image at rest
                setting = self._meter(self._sensor, self._image_formation.radiance(views[0]), views[0].depth)

            def expose(view: RenderedView) -> tuple[Image, Radiance]:
                light = self._at_raw_pixels(view, self._sensor, twist_body, setting)
                return self._cameras.rectify(self._sensor.image(light, setting, self._rngs[view.camera])), light

            if stereo:
                (left, light), (right, _) = in_pair(lambda: expose(views[0]), lambda: expose(views[1]))
            else:
                (left, light), right = expose(views[0]), None
            if metered:
                self._sensor.meter(light)
            depths = [self._cameras.crop(view.depth) for view in views]
        self._last_setting = setting
        exposure = self._sensor.signal_per_cd(setting)
        return StereoCapture(left, right, depths[0], depths[1] if stereo else None, exposure)

    def right_apart(self, world_from_left: Array, twist_body: Array = AT_REST) -> Image:
        """Returns the right image (H, W, 3) at the time and exposure of the last capture, with a noise of its own."""
        view = self._render(StampedPose(world_from_left, (self._n_captures - 1) / self._frame_rate_hz), 1)
        with self._stopwatch("optics"):
            assert self._last_setting is not None
            light = self._at_raw_pixels(view, self._sensor, twist_body, self._last_setting)
            return self._cameras.rectify(self._sensor.image(light, self._last_setting, self._rng_apart))

    def capture_apart(self, world_from_left: Array, twist_body: Array = AT_REST) -> tuple[Image, Image]:
        """Returns both images (H, W, 3) at the time of the last capture, with the noise of the next."""
        kept = self._sensor, self._rngs, self._n_captures, self._last_setting
        self._sensor, self._rngs = copy.deepcopy(kept[:2])
        self._n_captures = max(self._n_captures - 1, 0)
        try:
            captured = self.capture(world_from_left, True, twist_body)
        finally:
            self._sensor, self._rngs, self._n_captures, self._last_setting = kept
        assert captured.right is not None
        return captured.left, captured.right

    def twist_of_camera(self, camera: int, twist_body: Array) -> Array:
        """Returns the [angular, linear] velocity (6,) of a camera (0 left, 1 right) in its own axes [rad/s, m/s]."""
        return self._camera_from_body_twist[camera] @ twist_body

    def decompose(self, world_from_left: Array, twist_body: Array = AT_REST, time_s: float = 0.0) -> DecomposedImage:
        """Returns the left image with intermediate results, the components at rest; no effect on later captures."""
        cameras, sensor = self._cameras, sensor_of(self._scenario, self._cameras.raw_rig)
        view = self._render(StampedPose(world_from_left, time_s), 0)
        components = self._image_formation.components(view)
        setting = self._meter(sensor, components.total, view.depth)
        light = self._at_raw_pixels(view, sensor, twist_body, setting)
        noise_free = cameras.rectify(sensor.image(light, setting, None))
        raw = sensor.raw(light, setting, copy.deepcopy(self._rngs[0])) if isinstance(sensor, PhotoSensor) else None
        cropped = {name: cameras.crop(part) for name, part in components._asdict().items() if part is not None}
        objects = None if view.objects is None else ObjectView(*(cameras.crop(layer) for layer in view.objects))
        return DecomposedImage(
            cameras.crop(view.albedo), cameras.crop(view.depth), components._replace(**cropped), setting, noise_free,
            raw, self._linear, objects,
        )  # fmt: skip

    def _render(self, pose: StampedPose, camera: int) -> RenderedView:
        world_from_camera = pose.world_from_left @ self._left_from_right if camera else pose.world_from_left
        with self._stopwatch("render"):
            return self._image_formation.view_of(self._renderer.render(world_from_camera), camera, pose)

    def _meter(self, sensor: Sensor, light: Radiance, depth: Depth) -> ExposureSetting:
        return sensor.meter(self._cameras.sample(light, depth, 0))

    def _at_raw_pixels(
        self, view: RenderedView, sensor: Sensor, twist_body: Array, setting: ExposureSetting
    ) -> Radiance:
        """Returns the radiance (h, w, 3) at the raw pixels of a moving camera."""
        motion = sensor.motion(self.twist_of_camera(view.camera, twist_body), setting, len(view.depth))
        if motion is not None:
            motion = motion._replace(rolls_later=self._cameras.sampling is not None)
        light = self._image_formation.radiance_without_snow(view)
        light = light_after_lens(self._image_formation, self.psf, view, light, self._focal_px, motion)
        return self._cameras.sample(light, view.depth, view.camera, motion=motion)


def light_after_lens(
    formation: ImageFormation, psf: LensPsf, view: RenderedView, light: Radiance, focal_px: float,
    motion: ExposureMotion | None, snow: bool = True,
) -> Radiance:  # fmt: skip
    """Returns the light (H, W, 3) of a view, given without snow (may be overwritten), behind a moving camera's lens.

    Marine snow, which has other depths and velocities, is drawn with its own blur after lens and motion.
    """
    light = psf.out_of_focus(light, view.depth)
    if motion is not None:
        light = integrate(light, view.depth, focal_px, motion)
    if snow:
        formation.add_snow(light, view, motion)
    return psf.transfer(light)
