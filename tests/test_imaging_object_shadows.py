"""Shadows of objects against the exact shadow of a ball on level ground, and the light on the ball itself."""

from __future__ import annotations

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import StereoRig
from twin.imaging.light.shadows import Shadows
from twin.imaging.scene.mesh_raster import ObjectView
from twin.imaging.scene.object_shadows import MAP_PX, ObjectShadows
from twin.imaging.scene.object_view import Objects, draw_over_floor
from twin.terrains.objects.coloured_mesh import mesh_of
from twin.terrains.objects.placed_object import PlacedObject, model_of
from twin.terrains.objects.primitives import sphere

W, H, FOCAL = 160, 120, 150.0
RIG = StereoRig(W, H, FOCAL, 0.15, 30.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)))
HEIGHT_M, RADIUS_M, CENTRE = 1.6, 0.12, np.array([0.05, -0.1, 0.3])  # of the camera; of the ball above the floor z = 0
POSE = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, HEIGHT_M]))
SUN = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])


def ball() -> Objects:
    pose = np.diag([RADIUS_M] * 3 + [1.0])
    pose[:3, 3] = CENTRE - [0, 0, RADIUS_M]  # models stand on their lowest point
    return Objects([PlacedObject(model_of(mesh_of(*sphere(), (1, 1, 1))), pose, RADIUS_M, 0)])


def image() -> tuple[np.ndarray, ObjectView, np.ndarray]:
    """Returns depth, view and points (H, W, 3) in the world of the ball above the floor z = 0."""
    albedo, depth = np.zeros((H, W, 3), np.uint8), np.full((H, W), HEIGHT_M, np.float32)
    view = draw_over_floor(ball(), RIG, albedo, depth, POSE, 0.0)
    u, v = np.meshgrid(np.arange(W) - RIG.cx_px, np.arange(H) - RIG.cy_px)
    points = np.stack([u * depth / FOCAL, v * depth / FOCAL, depth], axis=-1).reshape(-1, 3)
    return depth, view, geometry.transform(POSE, points).reshape(H, W, 3)


def hidden_by_ball(points: np.ndarray, to_light: np.ndarray) -> np.ndarray:
    """Returns the least distance (n,) of the rays from points to the light, minus the radius of the ball."""
    length = np.linalg.norm(to_light, axis=-1, keepdims=True)
    along = to_light / length
    reach = np.clip(np.einsum("...i,...i->...", CENTRE - points, along), 0, length[..., 0])
    return np.linalg.norm(points + reach[..., None] * along - CENTRE, axis=-1) - RADIUS_M


@pytest.mark.parametrize("lamp", [None, [0.5, 0.35, 0.05], [-0.3, 0.2, 0.4]])
def test_the_shadow_of_a_ball_is_exact_to_a_pixel_of_the_map(lamp):
    """The sun, a lamp beside the camera and a lamp below it; a pixel of the image spans 11 mm of the floor."""
    depth, view, points = image()
    lamps = np.zeros((0, 3)) if lamp is None else np.array([lamp])  # in the axes of the camera
    lit = np.ones((1, H, W), np.uint8)
    casting = ObjectShadows(ball(), RIG, [lamps, lamps], SUN if lamp is None else None)
    casting.darken(lit, depth, view, POSE, (0, 0.0))
    to_light = np.broadcast_to(SUN * 100, points.shape) if lamp is None else geometry.transform(POSE, lamps)[0] - points
    beyond, floor = hidden_by_ball(points, to_light), view.label == 0
    pixel_m = MAP_PX * HEIGHT_M / FOCAL
    assert (beyond[floor] < -pixel_m).sum() > 100
    assert (lit[0][floor & (beyond < -pixel_m)] == 0).all() and (lit[0][floor & (beyond > pixel_m)] == 1).all()


def test_the_ball_is_lit_on_the_side_that_faces_the_light():
    """Where the cosine of incidence is 0.3 or more no point shadows itself, and the far side is dark."""
    depth, view, points = image()
    lit, none = np.ones((1, H, W), np.uint8), np.zeros((0, 3))
    ObjectShadows(ball(), RIG, [none, none], SUN).darken(lit, depth, view, POSE, (0, 0.0))
    cosine, on_ball = (points - CENTRE) @ SUN / RADIUS_M, view.label > 0
    assert (on_ball & (cosine > 0.3)).sum() > 150
    assert lit[0][on_ball & (cosine > 0.3)].all() and not lit[0][on_ball & (cosine < -0.05)].any()


def test_the_slope_of_the_floor_below_an_object_does_not_darken_it():
    """Facets of a floor that faces away from the sun are dark, but not the ball above them."""

    class Step:
        height_m = np.tile(np.where(np.arange(41) > 20, -0.2, 0.0).astype(np.float32), (41, 1))  # falls at x 0 to 0.1
        spacing_m, west_m, south_m = 0.1, -2.0, -2.0

    depth, view, _ = image()
    low_sun, none = np.array([-0.9, 0.0, np.sqrt(1 - 0.81)]), np.zeros((0, 3))
    casting = Shadows(Step(), RIG, [none, none], low_sun)
    alone, labelled = casting.lit(depth, POSE, 0)[0], casting.lit(depth, POSE, 0, view.label)[0]
    assert not alone[view.label > 0].all() and labelled[view.label > 0].all()
    assert (labelled[view.label == 0] == alone[view.label == 0]).all()
