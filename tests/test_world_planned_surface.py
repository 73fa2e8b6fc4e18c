"""Plans over objects: the surface of floor and objects, and the forecast against rays cast on a box."""

import dataclasses

import numpy as np
import pytest

from twin import terrains
from twin.core.height_field import RAY_COLUMNS, image_overlap, ray_grid
from twin.core.timing import Stopwatch
from twin.scenario.file import load_scenario
from twin.surrogate import error_model_file
from twin.surrogate.surrogate_world import SurrogateWorld
from twin.terrains import Terrain, TextureSource
from twin.terrains.objects.coloured_mesh import mesh_of
from twin.terrains.objects.placed_object import PlacedObject, model_of
from twin.terrains.objects.primitives import box
from twin.world.floor_forecast import forecast_over_floor, planned_surface
from twin.world.mission import prepare
from twin.world.planning import floor_of
from twin.world.top_surface import FINE_M

LEVEL = Terrain(np.zeros((141, 181), np.float32), 0.05, -4.5, -3.5, np.zeros((2, 2, 3), np.uint8), 4.5)
LOW, HIGH = np.array([-0.423, -0.311, 0.0]), np.array([0.197, 0.209, 0.35])  #: corners of the crate


def placed(mesh, low):
    """Returns a mesh as an object whose bounding box has its lowest corner at `low`."""
    model = model_of(mesh)
    pose = np.eye(4)
    pose[:3, 3] = low - model.low_m
    return PlacedObject(model, pose, 1.0, 0)


def crate():
    return placed(mesh_of(*box(tuple(HIGH - LOW), (1, 1, 1)), (1, 1, 1)), LOW)


def mission_over(terrain, monkeypatch, *overrides, objects=()):
    monkeypatch.setattr("twin.world.mission.load_terrain", lambda _: terrain)
    small = ["terrain.texture_px_m=0.2", "plan.area_m=[1.0, 0.8]", "plan.altitude_m=2.0", "plan.tracks=1"]
    return dataclasses.replace(prepare(load_scenario("reef", [*small, *overrides])), objects=tuple(objects))


def cast_on_crate(origin, direction):
    """Returns the depth (n,) at which rays first meet the crate or the plane z = 0 (slab method, Kay & Kajiya 1986)."""
    with np.errstate(divide="ignore"):
        entry, leave = np.sort(np.stack([(LOW - origin) / direction, (HIGH - origin) / direction]), axis=0)
    first, last = entry.max(axis=-1), leave.min(axis=-1)
    return np.where(first <= last, first, -origin[..., 2] / direction[..., 2])


def rays_of(mission, pose):
    pixels = ray_grid(mission.rig, RAY_COLUMNS)
    rays = np.column_stack([mission.rig.normalised(pixels), np.ones(len(pixels))])
    return rays @ pose[:3, :3].T


def test_depths_and_clearance_over_a_crate_are_those_of_rays_cast_on_a_box(monkeypatch):
    forecast = forecast_over_floor(mission := mission_over(LEVEL, monkeypatch, objects=[crate()]))
    poses = forecast.keyframes.world_from_camera
    origin = np.repeat(poses[:, None, :3, 3], forecast.depth_m.shape[1], axis=1)
    direction = np.stack([rays_of(mission, pose) for pose in poses])
    true = cast_on_crate(origin, direction)
    # A node on the crate and the next node beside it span its side, so rays near a side or an edge are left out: their
    # depths change if the ray is displaced by the distance of two nodes.
    steps = [np.array([x, y, 0.0]) for x in (-FINE_M, FINE_M) for y in (-FINE_M, FINE_M)]
    displaced = [cast_on_crate(origin + step, direction) for step in steps]
    plain = np.ptp([true, *displaced], axis=0) < 1e-9
    assert plain.mean() > 0.9 and (true[plain] < 1.7).mean() > 0.02
    np.testing.assert_allclose(forecast.depth_m[plain], true[plain], atol=1e-6)
    np.testing.assert_allclose(forecast.clearance_m, true.min(axis=1), atol=1e-6)
    assert forecast.clearance_m.min() == pytest.approx(1.65, abs=1e-6)


def test_the_overlap_over_a_crate_is_the_share_of_points_that_both_cameras_see(monkeypatch):
    mission = mission_over(LEVEL, monkeypatch, objects=[crate()])
    first, second = np.eye(4), np.eye(4)
    first[:3, :3] = second[:3, :3] = np.diag([1.0, -1.0, -1.0])
    first[:3, 3], second[:3, 3] = (-0.55, 0.1, 1.0), (0.1, 0.1, 1.0)
    direction = rays_of(mission, first)
    points = first[:3, 3] + cast_on_crate(first[:3, 3], direction)[:, None] * direction
    seen = cast_on_crate(second[:3, 3], points - second[:3, 3]) > 1 - 1e-6
    local = (points - second[:3, 3]) @ second[:3, :3]
    px = local[:, :2] / local[:, 2:] * mission.rig.focal_px
    inside = (np.abs(px) < [mission.rig.width_px / 2, mission.rig.height_px / 2]).all(axis=1)
    true = (seen & inside).mean()
    assert (inside & ~seen).mean() > 0.02  # the crate hides floor and its far side from the second camera
    found = [image_overlap(floor_of(t), first, second, mission.rig)[0] for t in (planned_surface(mission), LEVEL)]
    # of 24 columns; cells at a border count wholly or not at all in `true`, by their share in `found`
    assert found[0] == pytest.approx(true, abs=0.02)
    assert abs(found[1] - true) > 0.04


def test_beside_the_objects_the_surface_is_that_of_the_floor(monkeypatch):
    reef = terrains.generate("reef", (9.0, 7.0), 0.4, 0.0, 0.05, TextureSource(0.2), 5)
    surface = planned_surface(mission := mission_over(reef, monkeypatch, objects=[crate()]))
    x, y = np.random.default_rng(0).uniform([-4.5, -3.5], [4.5, 3.5], (20_000, 2)).T
    beside = (x < LOW[0] - FINE_M) | (x > HIGH[0] + FINE_M) | (y < LOW[1] - FINE_M) | (y > HIGH[1] + FINE_M)
    heights = [t.height_at(x, y) for t in (surface, reef)]
    np.testing.assert_allclose(heights[0][beside], heights[1][beside], atol=1e-6)
    assert (heights[0] - heights[1]).max() > 0.1
    assert surface.size_m == pytest.approx(mission.terrain.size_m) and surface.spacing_m == pytest.approx(FINE_M)


def test_a_large_terrain_keeps_to_the_limit_of_nodes(monkeypatch):
    mission = mission_over(LEVEL, monkeypatch, objects=[crate()])
    monkeypatch.setattr("twin.world.top_surface.MAX_NODES", 4 * LEVEL.height_m.size)
    assert planned_surface(mission).spacing_m == pytest.approx(0.025)


def test_without_objects_or_by_the_surrogate_the_surface_is_the_terrain_of_the_mission(monkeypatch):
    for mission in (
        mission_over(LEVEL, monkeypatch),
        mission_over(LEVEL, monkeypatch, "imaging.fidelity=surrogate", objects=[crate()]),
    ):
        assert planned_surface(mission) is mission.terrain


def test_a_surrogate_survey_warns_that_it_leaves_objects_out(monkeypatch):
    given = ("imaging.fidelity=surrogate", "imaging.extrapolate=true")
    for objects in ((), (crate(),)):
        mission = mission_over(LEVEL, monkeypatch, *given, objects=objects)
        with SurrogateWorld(mission, Stopwatch(), error_model_file.load()) as world:
            assert any("does not simulate [[objects]]" in w for w in world.warnings) == bool(objects)
