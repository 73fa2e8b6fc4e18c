"""Sensors: noise variance, exposure lag, independent random streams; plain and physical sensor in a stereo camera."""

import types

import numpy as np
import pytest

from twin.core import geometry, threads
from twin.core.timing import Stopwatch
from twin.imaging.camera.photo_sensor import sensor_of
from twin.imaging.camera.sensor import AutoExposure, ExposureSetting, _mean, expose
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import illumination_of
from twin.imaging.stereo_camera import AT_REST, StereoCamera
from twin.scenario.model import ImagingConfig, Scenario

PHYSICAL = {"bits": 12, "bayer": True, "readout_ms": 10.0}


def test_noise_variance_is_linear_in_the_signal():
    imaging = ImagingConfig(noise_sd=0.02, shot_noise=0.05)
    for signal in (0.2, 0.4, 0.7):
        light = np.full((300, 400, 3), signal * 50, np.float32)
        image = expose(light, 1 / 50, imaging, np.random.default_rng(3)) / 255
        expected = 0.02**2 + 0.05**2 * signal + 1 / 12 / 255**2  # rounding to 8 bits
        # 360,000 numbers: the standard error of a variance is 0.24 %
        assert image.var() == pytest.approx(expected, rel=0.01)
        assert image.mean() == pytest.approx(signal, abs=4 * np.sqrt(expected / image.size))


def test_noise_is_normal_and_white():
    imaging = ImagingConfig(noise_sd=0.1, shot_noise=0.0)
    image = expose(np.full((300, 400, 3), 0.5, np.float32), 1.0, imaging, np.random.default_rng(4)) / 255 - 0.5
    z = image.ravel() / image.std()
    assert np.mean(z**4) == pytest.approx(3.0, abs=0.05)  # 360,000 numbers: standard error 0.016
    assert abs(np.mean(z[1:] * z[:-1])) < 0.01 and abs(np.mean(image[1:] * image[:-1]) / image.var()) < 0.01


def test_bright_light_saturates_without_overflow():
    imaging = ImagingConfig(noise_sd=0.3)
    light = np.linspace(0, 5, 3000, dtype=np.float32).reshape(-1, 10, 3)
    image = expose(light, 1.0, imaging, np.random.default_rng(0))
    assert (image[-30:] == 255).all() and image[0].min() < 80


def test_images_are_reproducible_from_the_random_stream():
    light = np.random.default_rng(0).uniform(0, 1, (48, 64, 3)).astype(np.float32)
    a, b, c = (expose(light, 1.0, ImagingConfig(), np.random.default_rng(k)) for k in (1, 1, 2))
    assert (a == b).all() and (a != c).any()


@pytest.mark.parametrize("sensor", [None, PHYSICAL])
def test_noise_does_not_depend_on_the_number_of_threads(monkeypatch, sensor):
    scenario = small(sensor, {"image_width_px": 90, "image_height_px": 130})
    light = np.random.default_rng(0).uniform(0, 60, (130, 90, 3)).astype(np.float32)
    images = []
    for processors in (1, 2):
        monkeypatch.setattr(threads, "_n_processors", lambda n=processors: n)
        images.append(sensor_of(scenario).image(light, ExposureSetting(0.01, 0.01, 2.0), np.random.default_rng(1)))
    np.testing.assert_array_equal(*images)


def test_two_streams_give_independent_noise():
    imaging, light = ImagingConfig(noise_sd=0.1, shot_noise=0.0), np.full((300, 400, 3), 0.5, np.float32)
    one, two = (expose(light, 1.0, imaging, rng) / 255 - 0.5 for rng in np.random.default_rng(5).spawn(2))
    assert abs(np.mean(one * two)) < 5 * one.std() * two.std() / np.sqrt(one.size)


def test_exposure_meters_the_first_frame_then_follows_with_its_lag():
    exposure = AutoExposure(0.45, frame_rate_hz=30.0)
    dim, bright = (np.full((4, 4, 3), x, np.float32) for x in (10.0, 40.0))
    assert exposure.gain(dim) == pytest.approx(0.045)
    assert exposure.gain(bright) == pytest.approx(0.045)  # the change affects the next frames only
    gains = [exposure.gain(bright) for _ in range(15)]
    assert all(a > b for a, b in zip(gains, gains[1:], strict=False))
    # after the lag of 0.5 s (15 frames) 1/e of the change remains, in logarithm
    assert np.log(gains[-1] / 0.01125) / np.log(4) == pytest.approx(np.exp(-1), abs=1e-6)


def test_exposure_is_metered_on_the_brightest_channel():
    green = np.zeros((4, 4, 3), np.float32)
    green[..., 1] = 10.0
    assert AutoExposure(0.45, 30.0).gain(green) == pytest.approx(0.045)


def test_exposure_lets_few_highlights_saturate():
    rng = np.random.default_rng(6)
    light = rng.uniform(0.5, 1.5, (240, 320, 3)).astype(np.float32)
    light[100:140, 100:160] *= 6  # a bright spot on 3 % of the image
    gain = AutoExposure(0.45, 30.0).gain(light)
    assert np.mean(gain * light > 1) < 0.004
    assert gain > 0.9 / np.quantile(light, 0.998)
    light[100:140, 100:160] /= 6
    assert AutoExposure(0.45, 30.0).gain(light) == pytest.approx(0.45, rel=0.01)  # no highlights: the mean level


class FlatFloor:
    """Renderer of a random texture at a depth of 2 m."""

    def render(self, world_from_camera):
        rng = np.random.default_rng(int(1000 * world_from_camera[0, 3]))
        return rng.integers(50, 200, (48, 64, 3), dtype=np.uint8), np.full((48, 64), 2.0, np.float32)


FLAT = types.SimpleNamespace(height_m=np.zeros((9, 9), np.float32), spacing_m=1.0, west_m=-4.0, south_m=-4.0)


DOWN = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))
MOVING = np.array([0.1, -0.2, 0.3, 0.5, -0.3, 0.1])  # of the body [rad/s, m/s]


def small(sensor=None, size=None):
    return Scenario.model_validate(
        {
            "rig": size or {"image_width_px": 64, "image_height_px": 48},
            "lamps": [{"position_m": (0.2, 0.3, 0.0)}],
            "sensor": sensor,
        }
    )


def camera_of(scenario):
    left, right = np.random.default_rng(7).spawn(2)
    light = ImageFormation(scenario, illumination_of(scenario), FLAT, left)
    return StereoCamera(FlatFloor(), light, scenario, left, right, Stopwatch())


def captures(stereo, sensor=None, twist=AT_REST):
    camera = camera_of(small(sensor))
    poses = [DOWN + np.array([[0, 0, 0, 0.01 * k]] + [[0] * 4] * 3) for k in range(5)]
    return [camera.capture(pose, flag, twist) for pose, flag in zip(poses, stereo, strict=True)]


@pytest.mark.parametrize("sensor", [None, PHYSICAL])
def test_stereo_pairs_do_not_depend_on_the_number_of_processors(monkeypatch, sensor):
    """To the last bit: with two processors, both images are computed at the same time."""
    pairs = []
    for processors in (1, 2):
        monkeypatch.setattr(threads, "_n_processors", lambda n=processors: n)
        pairs.append(captures([True] * 5, sensor, MOVING))
    for one, two in zip(*pairs, strict=True):
        np.testing.assert_array_equal(one.left, two.left)
        np.testing.assert_array_equal(one.right, two.right)
        assert one.exposure == two.exposure


@pytest.mark.parametrize("sensor", [None, PHYSICAL])
def test_left_images_do_not_depend_on_the_use_of_the_right_camera(sensor):
    flags = [False] * 5, [True] * 5, [True, False, False, True, False]
    alone, both, some = (captures(stereo, sensor, MOVING) for stereo in flags)
    for a, b, c in zip(alone, both, some, strict=True):
        assert a.right is None and a.depth_right is None and b.right is not None
        np.testing.assert_array_equal(a.left, b.left)
        np.testing.assert_array_equal(a.left, c.left)


def test_frames_after_the_first_meter_the_light_of_their_left_image():
    """The first frame is exposed for its own light at rest, the others for that of the frames before."""
    camera = camera_of(small(PHYSICAL))
    sensor, exposed, metered = camera._sensor, [], []
    image, meter = sensor.image, sensor.meter
    sensor.image = lambda light, setting, rng: exposed.append(light) or image(light, setting, rng)
    sensor.meter = lambda light: metered.append(light) or meter(light)
    for _ in range(3):
        camera.capture(DOWN, False, MOVING)
    assert len(metered) == len(exposed) == 3 and metered[1] is exposed[1] and metered[2] is exposed[2]
    assert metered[0] is not exposed[0]
    np.testing.assert_allclose(metered[0].mean(axis=(0, 1)), exposed[0].mean(axis=(0, 1)), rtol=0.05)


@pytest.mark.parametrize("sensor", [None, PHYSICAL | {"white_balance": "grey_world"}])
def test_the_exposure_of_the_next_frame_is_known_before_it_is_metered(sensor):
    scenario, rng = small(sensor), np.random.default_rng(3)
    model = sensor_of(scenario)
    assert model.setting is None
    for k in range(4):
        known, light = model.setting, rng.gamma(2, 20 * (k + 1), (48, 64, 3)).astype(np.float32)
        setting = model.meter(light)
        assert known is None if k == 0 else known == setting


def test_the_plain_sensor_ignores_motion():
    scenario = small()
    light = ImageFormation(scenario, illumination_of(scenario), FLAT, None)
    renderer, exposure = FlatFloor(), AutoExposure(0.45, 30.0)
    rng = np.random.default_rng(7).spawn(2)[0]
    for k, capture in enumerate(captures([False] * 5, None, MOVING)):
        pose = StampedPose(DOWN + np.array([[0, 0, 0, 0.01 * k]] + [[0] * 4] * 3), k / 30)
        radiance = light.radiance(RenderedView(*renderer.render(pose.world_from_left), 0, pose))
        np.testing.assert_array_equal(capture.left, expose(radiance, exposure.gain(radiance), scenario.imaging, rng))


def test_motion_affects_images_only_with_exposure_or_readout_time():
    still = PHYSICAL | {"motion_blur": False, "readout_ms": 0.0}
    for sensor, same in ((still, True), (PHYSICAL, False), (still | {"motion_blur": True}, False)):
        rest, moving = (captures([True] * 5, sensor, twist)[1] for twist in (AT_REST, 3 * MOVING))
        assert (rest.left == moving.left).all() == (rest.right == moving.right).all() == same


def test_the_twist_of_each_camera_follows_from_that_of_the_body():
    stereo, rig, step_s = camera_of(small()), small().believed_rig(), 1e-6
    for camera, body_from_camera in enumerate((rig.body_from_camera, rig.body_from_camera @ rig.left_from_right)):
        moved = geometry.inverse(body_from_camera) @ geometry.exp(MOVING * step_s) @ body_from_camera
        np.testing.assert_allclose(stereo.twist_of_camera(camera, MOVING), geometry.log(moved) / step_s, atol=1e-6)


def test_both_cameras_have_the_same_exposure():
    camera = camera_of(small(PHYSICAL))
    settings, expose_image = [], camera._sensor.image
    camera._sensor.image = lambda light, setting, rng: settings.append(setting) or expose_image(light, setting, rng)
    for _ in range(3):
        camera.capture(DOWN, True)
    assert settings[0::2] == settings[1::2] and all(setting.exposure_s > 0 for setting in settings)


@pytest.mark.parametrize("sensor", [None, PHYSICAL])
def test_the_right_image_differs_from_the_left_one(sensor):
    capture = captures([True] * 5, sensor)[0]
    assert capture.right.shape == capture.left.shape and (capture.right != capture.left).mean() > 0.5


def test_metering_equals_numpys_mean_to_the_last_bit():
    light = np.random.default_rng(0).gamma(2, 20, (63, 85, 3)).astype(np.float32)
    want = light.mean(axis=0, dtype=np.float64).mean(axis=0)
    np.testing.assert_array_equal(_mean(light.reshape(63, -1)), want)


@pytest.mark.parametrize("sensor", [None, PHYSICAL])
def test_images_of_the_right_camera_between_keyframes_have_a_noise_of_their_own(sensor):
    """The same view: images with independent noise are equal at a tenth of the pixels."""
    camera = camera_of(small(sensor))
    right, other = camera.capture(DOWN, True).right, camera.capture(DOWN, True).right
    again = camera_of(small(sensor))
    again.capture(DOWN, True)
    again.capture(DOWN, False)
    apart = again.right_apart(DOWN)
    for first in (right, other):
        assert np.mean(apart == first) < 0.4


def test_a_pair_apart_does_not_change_the_exposure_of_the_right_camera():
    camera = camera_of(small(PHYSICAL))
    for k in range(3):
        camera.capture(DOWN + np.array([[0, 0, 0, 0.05 * k]] + [[0] * 4] * 3), True)
    before = camera._last_setting
    camera.capture_apart(DOWN)
    assert camera._last_setting is before
