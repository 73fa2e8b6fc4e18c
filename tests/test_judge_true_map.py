"""True heights at the cells of a map in another frame: undo of a rigid motion, closed forms, what is not known."""

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import ElevationMap, MapGrid
from twin.judge.recorded import TrueMap, recorded_map_metrics, true_heights

GRID = MapGrid(-1.0, 1.2, 0.04, 55, 50)


def floor(x, y):
    """Returns heights without symmetry, with slopes up to 0.5."""
    return 0.3 * x - 0.1 * y + 0.05 * np.sin(3 * x + 2 * y) + 0.4


def true_map(cell_m=0.01, half_m=2.5):
    """Returns the floor on a fine grid; bilinear interpolation errs by cell^2 / 8 times the curvature, 8e-6 m."""
    n = round(2 * half_m / cell_m)
    grid = MapGrid(-half_m, half_m, cell_m, n, n)
    return TrueMap(grid, floor(*np.meshgrid(*grid.centres())))


def surface_in(map_from_true):
    """Returns the heights of the floor (rows, cols) along z of another frame, by bisection of its equation."""
    x, y = np.meshgrid(*GRID.centres())
    low, high = np.full(x.shape, -3.0), np.full(x.shape, 3.0)
    true_from_map = geometry.inverse(map_from_true)
    for _ in range(60):
        middle = (low + high) / 2
        points = geometry.transform(true_from_map, np.stack([x, y, middle], -1).reshape(-1, 3))
        above = (points[:, 2] > floor(points[:, 0], points[:, 1])).reshape(x.shape)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return (low + high) / 2


def mapped(height_m, map_from_world=None):
    """Returns a map with heights (rows, cols) and a sigma of 1 cm."""
    height = np.asarray(height_m, np.float32)
    sigma = np.full(height.shape, 0.01, np.float32)
    pose = np.eye(4) if map_from_world is None else map_from_world
    return ElevationMap(GRID, height, sigma, np.zeros((*height.shape, 3), np.uint8), pose)


@pytest.mark.parametrize("tilt_rad", [0.0, 0.05, 0.4])
def test_a_rigid_motion_of_the_map_is_undone(tilt_rad):
    """A perfect map in a frame that is turned, tilted and shifted has no error after the alignment that undoes it."""
    world_from_true = geometry.exp(np.array([tilt_rad, 0.3 * tilt_rad, 0.7, 0.2, -0.1, 0.5]))
    map_from_world = geometry.exp(np.array([0.02, -0.01, 0.1, 0.1, 0.0, -0.2]))
    exact = surface_in(map_from_world @ world_from_true)
    rough = exact + np.random.default_rng(0).normal(size=exact.shape) * 0.02  # the start must not matter
    rough[10:20, 10:20] = np.nan
    found = true_heights(mapped(rough, map_from_world), true_map(), geometry.inverse(world_from_true))
    np.testing.assert_allclose(found, exact, atol=5e-5)


def test_errors_are_those_of_the_cells_with_an_estimated_and_a_true_height():
    exact = floor(*np.meshgrid(*GRID.centres()))
    error = np.where(np.arange(exact.size).reshape(exact.shape) % 20 == 0, -0.2, 0.01)
    estimate = mapped(exact + error)
    estimate.height_m[:5] = np.nan
    wide = true_map()
    wide.height_m[:, wide.grid.centres()[0] > 0.5] = np.nan
    heights = true_heights(estimate, wide, np.eye(4))
    assert np.isnan(heights[:, -12:]).all() and np.isfinite(heights[:5, :30]).all()
    found = recorded_map_metrics(estimate, heights)
    assert found["le90_m"] == pytest.approx(0.01, abs=1e-4) and found["max_m"] == pytest.approx(0.2, abs=1e-4)
    assert found["gross_share"] == pytest.approx(0.05, abs=0.01)
    assert found["bias_m"] == pytest.approx(0.01 - 0.21 * found["gross_share"], abs=1e-4)
    unknown = {name for name, value in found.items() if value is None}
    assert {"completeness", "completeness_area", "le90_area_m", "floor_le90_m", "objects_le90_m"} <= unknown
    assert len(unknown) == 9


def test_a_map_of_a_wall_and_a_map_outside_the_true_heights_have_no_errors():
    level = mapped(np.zeros((GRID.rows, GRID.cols)))
    assert true_heights(level, true_map(), geometry.exp(np.array([1.2, 0, 0, 0, 0, 0]))) is None
    far = true_heights(level, true_map(), geometry.pose(np.eye(3), np.array([50.0, 0, 0])))
    assert np.isnan(far).all() and recorded_map_metrics(level, far)["le90_m"] is None
