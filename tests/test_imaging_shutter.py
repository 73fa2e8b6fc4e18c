"""Shutter: flow of a rigid motion, length of the blur, row delays, and conservation of light."""

import numpy as np
import pytest

from twin.core import geometry
from twin.imaging.camera.shutter import ExposureMotion, integrate

H, W, FOCAL = 90, 120, 110.0
V, U = np.mgrid[:H, :W].astype(float)
X, Y = (U - (W - 1) / 2) / FOCAL, (V - (H - 1) / 2) / FOCAL
FLOOR = np.full((H, W), 2.0, np.float32)


def blur_by_motion(light, depth, focal_px, twist, exposure_s):
    return integrate(light, depth, focal_px, ExposureMotion(twist, exposure_s, 0.0))


def apply_rolling_shutter(light, depth, focal_px, twist, readout_s):
    return integrate(light, depth, focal_px, ExposureMotion(twist, 0.0, readout_s))


def bands(light):
    return np.repeat(light[..., None], 3, 2).astype(np.float32)


def spot(u=60.0, v=45.0, sigma_px=2.0):
    return bands(np.exp(-((U - u) ** 2 + (V - v) ** 2) / (2 * sigma_px**2)))


def moments(light):
    """Returns the centroid (2,) [px] and the covariance (2, 2) [px2] of the light."""
    share = light[..., 0].astype(float) / light[..., 0].sum(dtype=float)
    centre = np.array([(share * U).sum(), (share * V).sum()])
    offset = np.stack([U - centre[0], V - centre[1]])
    return centre, np.einsum("ihw,jhw,hw->ij", offset, offset, share)


def sideways(path_px, depth_m=2.0, exposure_s=0.01):
    """Returns the twist of a camera for which a floor moves along a path (columns, rows) in the image [px]."""
    across = -np.array(path_px) * depth_m / (FOCAL * exposure_s)
    return np.array([0, 0, 0, *across, 0.0])


@pytest.mark.parametrize("length_px", [0.3, 0.9, 1.1, 2.0, 2.9, 7.3, 20.0])
@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 45.0, 90.0, 155.0])
def test_the_blur_length_is_speed_exposure_focal_length_over_depth(length_px, angle_deg):
    direction = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    twist = sideways(length_px * direction)
    assert np.linalg.norm(twist) * 0.01 * FOCAL / 2.0 == pytest.approx(length_px)
    before, after = moments(spot()), moments(blur_by_motion(spot(), FLOOR, FOCAL, twist, 0.01))
    # a uniform path adds length^2 / 12 to the variance along it, and nothing across
    grown = after[1] - before[1]
    assert np.sqrt(12 * direction @ grown @ direction) == pytest.approx(length_px, rel=0.01)
    across = np.array([-direction[1], direction[0]])
    assert abs(across @ grown @ across) < 0.002 and np.abs(after[0] - before[0]).max() < 1e-4


def test_the_kernel_of_a_short_path_has_the_moments_of_a_uniform_path():
    light, path = np.ones((H, W, 3), np.float32), (1.8, -1.3)  # on a background: light is cut off at 0
    light[45, 60] += 1.0
    share = blur_by_motion(light, FLOOR, FOCAL, sideways(path), 0.01)[..., 0] - 1.0
    u, v = U - 60, V - 45
    for power, moment in (((2, 0), 1 / 12), ((0, 2), 1 / 12), ((1, 1), 1 / 12), ((2, 2), 1 / 80)):
        expected = moment * path[0] ** power[0] * path[1] ** power[1]
        assert (share * u ** power[0] * v ** power[1]).sum() == pytest.approx(expected, abs=1e-5)


def test_the_blur_is_the_mean_of_the_images_along_the_path():
    rng = np.random.default_rng(1)
    frequencies = rng.uniform(-0.9, 0.9, (30, 2))  # waves of seven pixels and longer [rad/px]
    phases = rng.uniform(0, 2 * np.pi, 30)

    def waves(shares=1.0):
        along = np.multiply.outer(frequencies[:, 0], U) + np.multiply.outer(frequencies[:, 1], V)
        return 10 + (shares * np.cos(along + phases[:, None, None]).T).T.sum(axis=0) / np.sqrt(30)

    for path in ([0.8, 0.3], [1.7, -1.1], [2.5, 6.0]):
        # mean of a wave over a uniform path centred on the pixel
        mean = waves(np.sinc(frequencies @ path / (2 * np.pi)))
        blurred = blur_by_motion(bands(waves()), FLOOR, FOCAL, sideways(path), 0.01)[..., 1]
        inside = np.s_[8:-8, 8:-8]
        lost = np.std(mean[inside] - waves()[inside])
        # for waves of w rad/px the samples lose w^2 / 12 less
        assert np.std(blurred[inside] - mean[inside]) < 0.08 * lost


def test_motion_blur_conserves_light():
    for path in ([0.7, 0.2], [3.0, -1.0], [-5.0, 14.0]):
        blurred = blur_by_motion(spot(), FLOOR, FOCAL, sideways(path), 0.01)
        assert blurred.sum(dtype=float) == pytest.approx(spot().sum(dtype=float), rel=1e-5)
    relief = np.random.default_rng(2).uniform(1, 4, (H, W)).astype(np.float32)
    relief[:20] = np.inf
    uniform = np.full((H, W, 3), 7.5, np.float32)
    twist = np.array([0.5, -0.8, 2.0, 1.0, 0.3, -0.7])
    np.testing.assert_allclose(blur_by_motion(uniform, relief, FOCAL, twist, 0.02), uniform, rtol=2e-6)
    np.testing.assert_allclose(apply_rolling_shutter(uniform, relief, FOCAL, twist, 0.02), uniform, rtol=2e-6)


def test_a_camera_at_rest_has_no_blur():
    light = np.random.default_rng(3).uniform(0, 9, (H, W, 3)).astype(np.float32)
    np.testing.assert_array_equal(blur_by_motion(light, FLOOR, FOCAL, np.zeros(6), 0.1), light)
    np.testing.assert_array_equal(apply_rolling_shutter(light, FLOOR, FOCAL, np.zeros(6), 0.1), light)


def test_blur_keeps_light_between_zero_and_its_maximum():
    light = np.zeros((H, W, 3), np.float32)
    light[45, 60] = 1.0
    for path in ([0.6, 0.6], [1.0, 0.3], [4.0, 3.0]):
        blurred = blur_by_motion(light, FLOOR, FOCAL, sideways(path), 0.01)
        assert blurred.min() >= 0 and blurred.max() <= 1


@pytest.mark.parametrize("axis", range(6))
def test_each_row_of_a_rolling_shutter_shows_the_scene_at_its_time(axis):
    twist, readout_s = np.zeros(6), 0.02
    twist[axis] = 1.2
    depth = (2.0 + 0.3 * X - 0.2 * Y).astype(np.float32)

    def pattern(u, v):
        return 10 + np.cos(0.21 * u + 0.05 * v) + np.sin(0.17 * v - 0.08 * u)

    rolled = apply_rolling_shutter(bands(pattern(U, V)), depth, FOCAL, twist, readout_s)[..., 0]
    # position in the mid-exposure image of the floor that each row sees at its time
    delay_s = readout_s * (V[:, 0] / (H - 1) - 0.5)
    for v in range(6, H - 6, 7):
        middle_from_then = geometry.exp(twist * delay_s[v])
        points = geometry.transform(middle_from_then, np.stack([X[v], Y[v], np.ones(W)], 1) * depth[v][:, None])
        u, w = points[:, 0] / points[:, 2] * FOCAL + (W - 1) / 2, points[:, 1] / points[:, 2] * FOCAL + (H - 1) / 2
        # first order: over a flow of up to 1.3 px, direction and depth change by a few percent
        np.testing.assert_allclose(rolled[v, 8:-8], pattern(u, w)[8:-8], atol=0.012)


def test_a_rolling_shutter_shears_a_moving_image():
    readout_s, speed_mps = 0.03, 1.5
    line = bands(np.exp(-((U - 60.0) ** 2) / (2 * 2.0**2)))
    rolled = apply_rolling_shutter(line, FLOOR, FOCAL, np.array([0, 0, 0, speed_mps, 0, 0]), readout_s)[..., 0]
    centre = (rolled * U).sum(axis=1) / rolled.sum(axis=1)
    path_px = FOCAL * speed_mps * readout_s / 2.0
    # for a camera moving to the right, lower rows are read later and are displaced to the left
    assert centre[0] - centre[-1] == pytest.approx(path_px, rel=1e-3)
    np.testing.assert_allclose(centre, np.linspace(60 + path_px / 2, 60 - path_px / 2, H), atol=0.01)


def test_the_blur_depends_on_depth_and_rotation():
    depth = np.where(U < W / 2, 1.0, 3.0).astype(np.float32)
    light = spot(30.0) + spot(90.0)
    blurred = blur_by_motion(light, depth, FOCAL, np.array([0, 0, 0, 0, -3.0, 0]), 0.02)
    halves = [np.where((U < W / 2)[..., None] == side, blurred, 0) for side in (True, False)]
    for half, depth_m in zip(halves, (1.0, 3.0), strict=True):
        path_px = FOCAL * 3.0 * 0.02 / depth_m
        assert np.sqrt(12 * (moments(half)[1][1, 1] - 4.0)) == pytest.approx(path_px, rel=0.02)
    # rotation about the optical axis blurs in circles: zero at the centre, angle times radius elsewhere
    rotated = blur_by_motion(spot(20.0), FLOOR, FOCAL, np.array([0, 0, 10.0, 0, 0, 0]), 0.02)
    assert np.sqrt(12 * (moments(rotated)[1][1, 1] - 4.0)) == pytest.approx(0.2 * 39.5, rel=0.03)
