"""Lens distortion: OpenCV's model, rectified to 0.01 px, applied before the sensor; no change without distortion."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from twin.core.resample import EXACT, interpolate
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError, TwinError
from twin.imaging.camera.lens import Distortion, distort, fold, undistort
from twin.imaging.camera.ray_sampling import sample_rays
from twin.imaging.camera.true_cameras import make_true_cameras
from twin.imaging.image_formation import ImageFormation
from twin.imaging.light.illumination import illumination_of
from twin.imaging.stereo_camera import StereoCamera
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario
from twin.world.mission import prepare

WIDE = {"k1": -0.28, "k2": 0.09, "k3": -0.012, "p1": 0.0012, "p2": -0.0008}
STRONG = [WIDE, {"k1": 0.2}, {"k1": -0.2}, {"p1": 0.01, "p2": -0.01}]


def scenario(**sections) -> Scenario:
    return Scenario.model_validate({"rig": {"image_width_px": 320, "image_height_px": 240}} | sections)


def tangents_of_image() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 25), np.linspace(-0.45, 0.45, 19))
    return np.stack([x, y], axis=-1)


def pattern(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Returns radiance (..., 3): a sum of waves with wavelengths of 9 px and more."""
    waves = [(0.61, 0.23, 0.4), (-0.2, 0.55, 1.9), (0.31, -0.44, 0.7), (0.09, 0.12, 2.2)]
    value = 10 + sum(np.sin(a * u + b * v + c) for a, b, c in waves)
    return np.repeat(value[..., None], 3, axis=-1).astype(np.float32)


def shift_px(image: np.ndarray, ideal: np.ndarray) -> np.ndarray:
    """Returns the least-squares shift (2,) of an image relative to another of the same content [px]."""
    rows, columns = np.gradient(ideal.astype(float), axis=(0, 1))
    gradient = np.stack([columns.ravel(), rows.ravel()], axis=1)
    return -np.linalg.lstsq(gradient, (image.astype(float) - ideal).ravel(), rcond=None)[0]


@pytest.mark.parametrize("lens", STRONG)
def test_distortion_agrees_with_opencv(lens):
    points = tangents_of_image().reshape(-1, 2)
    rays = np.column_stack([points, np.ones(len(points))])
    order = np.array([lens.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), order)
    np.testing.assert_allclose(distort(points, Distortion(**lens)), expected[:, 0], atol=1e-14)


@settings(max_examples=60, deadline=None)
@given(
    k=st.tuples(st.floats(-0.2, 0.3), st.floats(-0.05, 0.1), st.floats(-0.02, 0.05)),
    p=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
)
def test_undistort_inverts_distort(k, p):
    lens = Distortion(*k, *p)
    tangents = tangents_of_image()
    if fold(lens) > 1.1:  # the corner is at 0.75; tangential distortion folds slightly earlier
        np.testing.assert_allclose(undistort(distort(tangents, lens), lens), tangents, atol=1e-9)


@pytest.mark.parametrize("k", [(-0.4, 0.0, 0.0), (-0.3, -0.1, 0.0), (-0.1, -0.2, -0.05), (0.1, -0.2, 0.02)])
def test_the_fold_is_the_first_maximum_of_the_distorted_radius(k):
    r = np.linspace(0.0, 3.0, 300001)
    distorted = r * (1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6)
    assert fold(Distortion(*k)) == pytest.approx(r[np.argmax(np.diff(distorted) < 0)], abs=2e-5)


def test_coordinates_beyond_the_fold_are_nan():
    """With k1 = -0.4 no ray is imaged beyond r (1 + k1 r^2) at r^2 = -1 / (3 k1)."""
    lens = Distortion(k1=-0.4)
    edge = np.sqrt(1 / 1.2)
    assert fold(lens) == pytest.approx(edge)
    most = edge * (1 - 0.4 * edge**2)
    distorted = np.array([[0.99 * most, 0.0], [1.01 * most, 0.0], [3.0, 0.0]])
    assert np.isfinite(undistort(distorted, lens)).all(axis=1).tolist() == [True, False, False]


@pytest.mark.parametrize("lens", STRONG)
def test_a_known_lens_is_rectified_to_a_hundredth_of_a_pixel(lens):
    """Sampling and rectification in sequence map each pixel of the frame to itself."""
    cameras = make_true_cameras(scenario(lens=lens))
    at = cameras.rectification.astype(float)
    back = [map_coordinates(cameras.sampling[0].positions[..., k], [at[..., 1], at[..., 0]], order=1) for k in (0, 1)]
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    # error of linear interpolation: 1/8 of the curvature
    assert np.abs(np.array(back) - [u + cameras.margin_px[0], v + cameras.margin_px[1]]).max() < 0.01


@pytest.mark.long
@pytest.mark.parametrize("lens", STRONG)
def test_a_frame_of_a_known_lens_equals_that_of_a_pinhole(lens):
    cameras = make_true_cameras(scenario(lens=lens))
    u, v = np.meshgrid(np.arange(cameras.rendered_rig.width_px), np.arange(cameras.rendered_rig.height_px))
    raw = cameras.sample(pattern(u - cameras.margin_px[0], v - cameras.margin_px[1]), np.ones(u.shape, np.float32), 0)
    frame = cameras.rectify(np.rint(raw * 15).astype(np.uint8))
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    ideal = 15 * pattern(u, v)
    assert frame.shape == ideal.shape
    # Waves of 9 px lose 8 % by the pixel response, which causes no shift; each quantization to 8 bits adds 0.3 levels.
    assert np.abs(shift_px(frame, ideal)).max() < 0.001
    assert np.abs(frame - ideal).mean() < 1.5


def test_an_error_of_k1_shifts_the_frame_by_the_expected_amount():
    """With an error e of k1 a point at tangent r is imaged f e r^3 (1 + k1 ...) farther out."""
    cameras = make_true_cameras(scenario(lens={"k1": -0.1}, calibration_error={"k1_error": 0.01}))
    rig = scenario().believed_rig()
    points = np.array([[0.5, 0.0, 1.0], [0.3, 0.4, 1.0], [0.0, 0.0, 1.0]])
    off = cameras.project(points) - rig.project(points)
    r2 = np.array([0.25, 0.25, 0.0])
    # distorted to x + d; the believed lens undistorts that to x + d / (slope of r - 0.11 r^3)
    expected = rig.focal_px * points[:, :2] * (0.01 * r2 / (1 - 0.33 * r2))[:, None]
    np.testing.assert_allclose(off, expected, atol=0.02)  # second order: 3 k r d^2 f < 0.01 px
    assert np.abs(off[:2]).max() > 0.3


def test_without_distortion_images_are_passed_through():
    cameras = make_true_cameras(scenario(calibration_error={"baseline_error": 0.1}))
    light, image = np.ones((240, 320, 3), np.float32), np.ones((240, 320, 3), np.uint8)
    assert cameras.sample(light, light[..., 0], 1) is light
    assert cameras.rectify(image) is image and cameras.crop(image) is image
    rig, believed = make_true_cameras(scenario()).rendered_rig, scenario().believed_rig()
    assert (rig.width_px, rig.focal_px, rig.baseline_m) == (believed.width_px, believed.focal_px, believed.baseline_m)


class GreyFloor:
    """Renderer of a uniform plane at a depth of 2 m."""

    def __init__(self, rig):
        self.shape = rig.height_px, rig.width_px

    def render(self, world_from_camera):
        return np.full((*self.shape, 3), 120, np.uint8), np.full(self.shape, 2.0, np.float32)


def test_noise_is_added_before_the_rectification():
    """Interpolation between pixels reduces noise: at the centre of four its variance is (sum of w^2)^2 = 0.6."""
    sections = {"lens": {"k1": 0.1}, "sun": {"illuminance_lx": 500.0}, "imaging": {"noise_sd": 0.03, "shot_noise": 0.0}}
    here = scenario(**sections, water={"jerlov": "clear"})
    cameras = make_true_cameras(here)
    left, right = np.random.default_rng(1).spawn(2)
    light = ImageFormation(here, illumination_of(here), None, left, cameras.rendered_rig)
    camera = StereoCamera(GreyFloor(cameras.rendered_rig), light, here, left, right, Stopwatch())
    frame = camera.capture(np.diag([1.0, -1.0, -1.0, 1.0]), stereo=False).left[..., 1].astype(float)  # looks down
    assert frame.shape == (240, 320)
    part = cameras.rectification - np.floor(cameras.rectification)
    between = (np.abs(part - 0.5) < 0.15).all(axis=-1)
    on_pixel = (np.minimum(part, 1 - part) < 0.15).all(axis=-1)
    assert between.sum() > 3000 and on_pixel.sum() > 3000
    assert frame[on_pixel].std() > 0.9 * 0.03 * 255
    assert frame[between].std() < 0.82 * 0.03 * 255


def test_sampling_preserves_uniform_light_and_linear_gradients():
    """At 10 px from the border, which the prefilter mirrors: a gradient breaks there, with an effect of 0.27^10."""
    u, v = np.meshgrid(np.arange(50.0), np.arange(40.0))
    light = np.stack([np.full(u.shape, 7.0), 3 * u + v, 100 - u], axis=-1).astype(np.float32)
    positions = np.random.default_rng(0).uniform((10, 10), (39, 29), (12, 9, 2)).astype(np.float32)
    sampled, (x, y) = sample_rays(light, np.ones(light.shape[:2], np.float32), positions), np.moveaxis(positions, -1, 0)
    np.testing.assert_allclose(sampled, np.stack([np.full(x.shape, 7.0), 3 * x + y, 100 - x], axis=-1), rtol=1e-5)


def test_interpolation_is_exact_at_pixels_and_agrees_with_scipy():
    image = np.random.default_rng(0).integers(80, 160, (40, 50, 3), np.uint8)
    u, v = np.meshgrid(np.arange(50), np.arange(40))
    again = interpolate(image, np.stack([u, v], -1).astype(np.float32))
    np.testing.assert_array_equal(again[1:-1, 1:-1], image[1:-1, 1:-1])
    x, y = np.random.default_rng(1).uniform((1, 1), (48, 38), (1, 500, 2)).transpose(2, 0, 1)
    got = interpolate(image, np.stack([x, y], -1).astype(np.float32))[0, :, 1]
    exact = map_coordinates(image[..., 1].astype(float), [y[0], x[0]], order=3, mode="mirror")
    assert np.abs(got - exact).max() < 1.01  # half a level of its own and half a level of the pixel before
    assert np.abs(np.cumsum(got - exact)).max() < 0.51 + 500 * EXACT


BAD_LENSES = [
    ("k1 = 3.0", "lens.k1: 3.0: not allowed (allowed: less than or equal to 2)"),
    ('p1 = "a"', "lens.p1: 'a': not allowed (allowed: a number)"),
    ("k4 = 0.1", "lens.k4: unknown key (allowed: k1, k2, k3, p1, p2, diffraction, blur_px, lateral_colour, focus_m)"),
    ("p1 = 0.2", "lens.p1: the lens folds the image back within the sensor (allowed: less distortion)"),
    ("k1 = -1.2", "lens.k1: the believed lens folds the image back within the frame (allowed: less distortion)"),
]


@pytest.mark.parametrize(("line", "message"), BAD_LENSES)
def test_an_invalid_lens_is_rejected_with_file_and_line(tmp_path, line, message):
    file = tmp_path / "bad.toml"
    file.write_text(f'extends = "{load_scenario("reef").source.path}"\n[lens]\n{line}\n')
    with pytest.raises(ScenarioError) as error:
        prepare(load_scenario(file))
    assert error.value.lines == [f"{file}:3: {message}"]


def test_a_lens_that_spreads_the_frame_over_a_huge_sensor_is_refused():
    wide = {"image_width_px": 320, "image_height_px": 240, "hfov_deg": 120.0}
    with pytest.raises(TwinError, match="lens.k1: the sensor needs a border of 172.. px .*less distortion"):
        make_true_cameras(scenario(rig=wide, lens={"k2": 5.0}))
