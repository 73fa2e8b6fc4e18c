"""The scene model has the mass of the vehicle and the floor of the terrain."""

from __future__ import annotations

import numpy as np
import pytest

from twin import terrains
from twin.core import geometry
from twin.scenes.builder import MAX_TILES, TILE_CELLS, SceneModel, build, tile_cells
from twin.scenes.gl import mujoco
from twin.terrains import TextureSource


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    terrain = terrains.generate("reef", (6.0, 3.7), 0.5, 0.2, 0.05, TextureSource(0.02), 3)
    return build(terrain, 0.004, 13.5, (0.26, 0.23, 0.37))


def data_at(scene: SceneModel, position: np.ndarray, rotation: np.ndarray) -> mujoco.MjData:
    """Returns MuJoCo data with the vehicle at a pose, after forward kinematics."""
    data = mujoco.MjData(scene.model)
    data.qpos[:3], data.qpos[3:7] = position, geometry.quaternion_wxyz(rotation)
    mujoco.mj_forward(scene.model, data)
    return data


def test_the_vehicle_has_the_given_mass_and_inertia_and_falls_freely(scene: SceneModel) -> None:
    model, body = scene.model, scene.model.body("vehicle").id
    assert model.body_mass[body] == 13.5 and model.body_mass.sum() == 13.5
    assert model.body_inertia[body] == pytest.approx([0.26, 0.23, 0.37])
    assert model.body_ipos[body] == pytest.approx(np.zeros(3))
    assert model.body_iquat[body] == pytest.approx([1, 0, 0, 0])
    data = data_at(scene, np.zeros(3), np.eye(3))  # inside the floor, which has no contact
    assert data.ncon == 0 and data.qacc[:3] == pytest.approx([0, 0, -9.81]) and model.opt.timestep == 0.004


def test_tiles_cover_the_floor_without_gap_or_overlap(scene: SceneModel) -> None:
    areas = np.prod((scene.tile_high_m - scene.tile_low_m)[:, :2], axis=1)
    assert areas.sum() == pytest.approx(np.prod(scene.terrain.size_m))
    assert scene.tile_low_m.min(axis=0) == pytest.approx([-3.0, scene.terrain.south_m, 0.2])
    assert len(areas) == 6  # 120 x 74 cells in tiles of 48 x 48


def test_mujoco_rays_hit_the_floor_at_the_height_of_the_terrain(scene: SceneModel) -> None:
    data = data_at(scene, np.array([0, 0, 50.0]), np.eye(3))
    rng = np.random.default_rng(0)
    low, high = np.array([-3.0, scene.terrain.south_m]) + 1e-6, np.array([3.0, scene.terrain.north_m]) - 1e-6
    points = rng.uniform(low, high, (300, 2))
    down, geom = np.array([0, 0, -1.0]), np.zeros(1, np.int32)
    hits = [3 - mujoco.mj_ray(scene.model, data, np.array([*p, 3.0]), down, None, 1, -1, geom, None) for p in points]
    # vertices are in single precision, in the axes of their mesh: an error of 1e-7 times 3 m, times the slope
    assert np.array(hits) == pytest.approx(scene.terrain.height_at(*points.T), abs=5e-6)


@pytest.mark.parametrize("n", (1, 48, 800, 4000, 30000))
def test_the_number_of_tiles_stays_within_the_limit_of_mujoco(n: int) -> None:
    cells = tile_cells(n, n)
    assert cells >= TILE_CELLS and (-(-n // cells)) ** 2 <= MAX_TILES
