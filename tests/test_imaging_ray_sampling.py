"""Sampling along the rays of the true pixels: port, lens and rolling shutter together, against per-row ray casting."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from twin.core import geometry
from twin.imaging.camera.ray_sampling import RowMotion, sample_rays
from twin.imaging.camera.shutter import ExposureMotion
from twin.imaging.camera.true_cameras import make_true_cameras
from twin.scenario.model import Scenario

FLAT = {"kind": "flat", "thickness_m": 0.012, "distance_m": 0.03}
CAMERAS = make_true_cameras(
    Scenario.model_validate(
        {"rig": {"image_width_px": 320, "image_height_px": 240}, "port": FLAT, "lens": {"k1": -0.1, "p1": 0.002}}
    )
)
assert CAMERAS.sampling is not None
POSITIONS, PARALLAX = CAMERAS.sampling[0]
RIG, READOUT_S = CAMERAS.rendered_rig, 0.02
N_RAW = CAMERAS.raw_rig.height_px
ROWS = range(3, N_RAW, 26)
#: A floor n . x = 1 in the axes of the camera at mid-exposure; its slope is 31 deg.
FLOOR_PER_M = np.array([0.25, -0.15, 0.5])
TWISTS = [*np.eye(6), np.array([0.4, -0.6, 0.8, 0.7, -0.5, 0.6])]


def then_of(twist, v):
    """Returns the pose, in the axes of the camera at mid-exposure, that a camera has when it exposes row v."""
    return geometry.exp(twist * READOUT_S * (v / (N_RAW - 1) - 0.5))


def depth_of(floor_per_m):
    """Returns the depth (H, W) of a plane n . x = 1 in the rendered image."""
    u, v = np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px))
    x, y = (u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px
    return (1 / (floor_per_m[0] * x + floor_per_m[1] * y + floor_per_m[2])).astype(np.float32)


def floor_points(depth):
    """Returns the points (H, W, 3) of the floor in the rendered image, in the axes of its camera."""
    u, v = np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px))
    return np.stack([(u - RIG.cx_px) / RIG.focal_px, (v - RIG.cy_px) / RIG.focal_px, u**0], -1) * depth[..., None]


def texture(points):
    """Returns radiance (..., 3) painted on the floor, smooth over a few pixels."""
    light = 5 + np.sin(30 * points[..., 0] + 8 * points[..., 1]) + np.cos(25 * points[..., 1] - 5 * points[..., 0])
    return np.repeat(light[..., None], 3, -1).astype(np.float32)


def met_px(depth, positions, parallax, motion=None):
    """Returns where rays meet the floor (h, w, 2) [px]: the spline of an image of columns and rows is exact."""
    v, u = np.indices(depth.shape, np.float32)
    met = sample_rays(np.stack([u, v, v], -1), depth, positions, parallax, motion)
    return np.ascontiguousarray(met[..., :2])


def row_motion(twist):
    return RowMotion(twist, READOUT_S, RIG.focal_px, (RIG.cx_px, RIG.cy_px))


@pytest.mark.parametrize("twist", TWISTS)
def test_rays_of_a_rolling_shutter_meet_the_floor_where_ray_casting_finds_it(twist):
    """Refraction and distortion of each row by the camera model, moved by its exact pose; exact intersection."""
    depth = depth_of(FLOOR_PER_M)
    found, at_rest = (met_px(depth, POSITIONS, PARALLAX, motion) for motion in (row_motion(twist), None))
    farthest_px = 0.0
    for v in ROWS:
        pixels = np.column_stack([np.arange(CAMERAS.raw_rig.width_px), np.full(CAMERAS.raw_rig.width_px, v)])
        border = (np.array([CAMERAS.raw_rig.width_px, N_RAW]) - [320, 240]) // 2
        origin, direction = CAMERAS.models[0].rays((pixels - border).astype(float))
        pose = then_of(twist, v)
        origin, direction = geometry.transform(pose, origin), direction @ pose[:3, :3].T
        along = (1 - origin @ FLOOR_PER_M) / (direction @ FLOOR_PER_M)
        expected = RIG.project(origin + along[:, None] * direction)
        # single precision at 320 px is 3e-5; the iteration ends at a few percent of 0.01 px
        np.testing.assert_allclose(found[v], expected, atol=1e-3)
        farthest_px = max(farthest_px, np.abs(expected - at_rest[v]).max())
    assert farthest_px > 0.8  # the motion is not negligible: 0.01 s at 1 m/s and 2 m, or at 1 rad/s


@pytest.mark.parametrize("twist", [TWISTS[3], TWISTS[2], TWISTS[-1]])
def test_rows_equal_those_of_images_rendered_from_the_poses_of_the_rows(twist):
    depth = depth_of(FLOOR_PER_M)
    light, of_rendered_s = texture(floor_points(depth)), READOUT_S * (RIG.height_px - 1) / (N_RAW - 1)
    motion = ExposureMotion(twist, 0.0, of_rendered_s)
    rolled, still = CAMERAS.sample(light, depth, 0, motion=motion), CAMERAS.sample(light, depth, 0)
    for v in ROWS:
        middle_from_then = then_of(twist, v)
        floor_then = middle_from_then[:3, :3].T @ FLOOR_PER_M / (1 - FLOOR_PER_M @ middle_from_then[:3, 3])
        depth_then = depth_of(floor_then)
        light_then = texture(geometry.transform(middle_from_then, floor_points(depth_then).reshape(-1, 3)))
        expected = CAMERAS.sample(light_then.reshape(light.shape), depth_then, 0)
        # the splines of both images blur patterns of 40 px by the same amount, at other positions between the pixels
        np.testing.assert_allclose(rolled[v, 4:-4], expected[v, 4:-4], atol=2e-3)
    assert np.abs(rolled - still).max() > 0.1


def test_without_motion_rays_are_sampled_at_their_intersections():
    depth = depth_of(FLOOR_PER_M)
    light = np.random.default_rng(0).random((*depth.shape, 3), np.float32)
    expected = sample_rays(light, depth, met_px(depth, POSITIONS, PARALLAX))
    for motion in (None, row_motion(np.zeros(6))):
        found = sample_rays(light, depth, POSITIONS, PARALLAX, motion)
        # positions are rounded by 1e-4 px; rows at the border cross it
        np.testing.assert_allclose(found[4:-4], expected[4:-4], atol=1e-3)


def test_sampling_equals_the_interpolating_spline_of_scipy_without_negative_light():
    rng = np.random.default_rng(1)
    light, at = rng.random((20, 30, 3), np.float32), rng.uniform(1, (28, 18), (9, 11, 2)).astype(np.float32)
    exact = [map_coordinates(band, at.astype(float)[..., ::-1].transpose(2, 0, 1), order=3, mode="mirror")
             for band in light.astype(float).transpose(2, 0, 1)]  # fmt: skip
    expected = np.maximum(np.stack(exact, -1), 0.0)
    assert (expected == 0).any()
    np.testing.assert_allclose(sample_rays(light, light[..., 0] + 1, at), expected, atol=1e-4)


def test_sampling_at_the_pixels_adds_no_blur():
    light = np.random.default_rng(2).random((20, 30, 3), np.float32)
    v, u = np.mgrid[2:18, 2:28].astype(np.float32)
    found = sample_rays(light, light[..., 0] + 1, np.stack([u, v], -1))
    np.testing.assert_allclose(found, light[2:18, 2:28], atol=3e-5)
