"""Plants that sway in the current: direction, size and period of the deflection, and plants that bend into the view."""

from __future__ import annotations

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import StereoRig
from twin.imaging.scene import object_view
from twin.imaging.scene.mesh_raster import NEAR_M, Projection, view_planes
from twin.imaging.scene.object_view import Objects, draw_over_floor, largest_displacement_m, swayed
from twin.terrains.objects.placed_object import PlacedObject, model_of
from twin.terrains.objects.shapes import build_shape

#: A narrow view, so that a plane of its frustum is nearly vertical.
RIG = StereoRig(64, 48, 600.0, 0.15, 30.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)))
KELP = model_of(build_shape("kelp", None, np.random.default_rng(1)), sways=True)
PLANT = KELP.levels[0].mesh
CURRENT = np.array([0.3, -0.4, 0.1])  #: its horizontal speed, 0.5 m/s, gives half of the largest lean


def plant(heading_rad: float = 0.0, scale: float = 2.0, x_m: float = 0.0) -> PlacedObject:
    pose = np.eye(4)
    pose[:3, :3] = scale * geometry.so3_exp(np.array([0.0, 0.0, heading_rad]))
    pose[0, 3] = x_m
    return PlacedObject(KELP, pose, scale, 0)


def moved(item: PlacedObject, current_mps: np.ndarray, time_s: float) -> np.ndarray:
    """Returns the displacements (n, 3) of the vertices in the world [m]."""
    change = swayed(PLANT, item, current_mps, time_s).vertices_m - PLANT.vertices_m
    return change @ item.world_from_object[:3, :3].T


def test_a_plant_stands_still_without_a_horizontal_current() -> None:
    assert swayed(PLANT, plant(), np.array([0.0, 0.0, 0.5]), 3.0) is PLANT
    assert largest_displacement_m(plant(), np.zeros(3)) == 0.0


@pytest.mark.parametrize("heading_rad", (0.0, 2.1))
def test_a_plant_leans_with_the_current_whatever_its_heading(heading_rad: float) -> None:
    change = moved(plant(heading_rad), CURRENT, 0.7)
    along, across = change[:, :2] @ [0.6, -0.8], change[:, :2] @ [0.8, 0.6]
    assert np.abs(across).max() < 1e-5 and (along > -1e-6).all() and (change[:, 2] < 1e-6).all()
    holdfast = PLANT.vertices_m[:, 2] < 0.01 * KELP.high_m[2]
    assert holdfast.any() and np.abs(change[holdfast]).max() < 1e-3


def test_the_mean_deflection_of_the_tip_is_half_the_largest_at_half_a_metre_per_second() -> None:
    """Over one period of the eddies, width / (Strouhal number times speed), the oscillation averages to zero."""
    item, tip = plant(), PLANT.vertices_m[:, 2].argmax()
    width_m = item.scale * (KELP.high_m - KELP.low_m)[:2].max()
    period_s = width_m / (object_view.STROUHAL * 0.5)
    along = np.array([moved(item, CURRENT, t)[tip, :2] @ [0.6, -0.8] for t in np.arange(8) / 8 * period_s])
    height_m = item.scale * KELP.high_m[2]
    assert along.mean() == pytest.approx(object_view.LARGEST_LEAN / 2 * height_m, rel=1e-4)
    assert np.ptp(along) == pytest.approx(2 * object_view.OSCILLATION * along.mean(), rel=0.1)
    np.testing.assert_allclose(moved(item, CURRENT, 1.0), moved(item, CURRENT, 1.0 + period_s), atol=1e-5)


@pytest.mark.parametrize("speed", (0.2, 1.0, 5.0))
def test_the_largest_displacement_bounds_that_of_every_vertex(speed: float) -> None:
    period_s = 2.0 * (KELP.high_m - KELP.low_m)[:2].max() / (object_view.STROUHAL * 0.5 * speed)
    times_s = np.arange(30) / 30 * period_s
    most = max(np.linalg.norm(moved(plant(), CURRENT * speed, t), axis=1).max() for t in times_s)
    bound = largest_displacement_m(plant(), CURRENT * speed)
    assert 0.97 * bound < most < bound * (1 + 1e-5)


def test_the_bound_holds_for_a_plant_on_a_slope() -> None:
    """The axis of the plant points 40 deg against the current, so the tip also moves with the current as it sinks."""
    current_mps, item = np.array([5.0, 0.0, 0.0]), plant()
    tilted = item.world_from_object @ geometry.pose(geometry.so3_exp(np.array([0.0, -0.7, 0.0])), np.zeros(3))
    item = item._replace(world_from_object=tilted)
    period_s = 2.0 * (KELP.high_m - KELP.low_m)[:2].max() / (object_view.STROUHAL * 5.0)
    most = max(np.linalg.norm(moved(item, current_mps, t), axis=1).max() for t in np.arange(30) / 30 * period_s)
    bound = largest_displacement_m(item, current_mps)
    assert 0.97 * bound < most < bound * (1 + 1e-5)


def test_a_plant_that_bends_into_the_view_is_drawn() -> None:
    """The bounding sphere of the upright plant lies left of the view; the current bends its tip into the view."""
    camera = geometry.pose(geometry.rotations_of_down_camera(np.array(0.0)), np.array([0.0, 0.0, 12.0]))
    current = np.array([5.0, 0.0, 0.0])
    aft = view_planes(Projection(RIG.focal_px, RIG.cx_px, RIG.cy_px, NEAR_M, True), (48, 64))[3]
    normal, offset = aft[:3], aft[3]
    centre = geometry.inverse(camera) @ np.append(plant().centre_m, 1.0)
    outside_m = normal @ centre[:3] + offset + plant().radius_m
    item = plant(x_m=-outside_m / np.hypot(*normal[:2]) - 0.02)
    width_m = item.scale * (KELP.high_m - KELP.low_m)[:2].max()
    time_s = 0.75 * width_m / (object_view.STROUHAL * 5.0)  # the tip is farthest downstream

    def drawn(current_mps: np.ndarray) -> int:
        albedo, depth = np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 12.0, np.float32)
        view = draw_over_floor(Objects([item], current_mps), RIG, albedo, depth, camera, time_s)
        return int((view.label > 0).sum())

    assert drawn(np.zeros(3)) == 0 and drawn(current) > 0
