"""Map files: values and georeference survive a round trip; the mesh has the right axes, colours and triangles."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
import trimesh

from twin.core import geometry
from twin.core.height_field import grid_triangles, raster_triangles
from twin.core.records import ElevationMap, MapGrid
from twin.errors import TwinError
from twin.exchange import geotiff, mesh
from twin.report.run_folder import read_raster

GRID = MapGrid(-3.1, 4.7, 0.02, 30, 40)


@pytest.fixture
def elevation():
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(*GRID.centres())
    height = (0.5 * x - 0.2 * y).astype(np.float32)
    height[:3, :4] = np.nan
    sigma = np.where(np.isnan(height), np.nan, 0.01).astype(np.float32)
    return ElevationMap(GRID, height, sigma, rng.integers(1, 255, (30, 40, 3), dtype=np.uint8))


def test_a_written_map_is_read_back_bit_identically(elevation, tmp_path):
    geotiff.write_map(tmp_path, elevation)
    height, sigma, mosaic = (read_raster(tmp_path / f"{name}.tif") for name in ("dem", "dem_sigma", "mosaic"))
    assert height.grid == sigma.grid == mosaic.grid == GRID
    np.testing.assert_array_equal(height.values, elevation.height_m)
    np.testing.assert_array_equal(sigma.values, elevation.sigma_m)
    np.testing.assert_array_equal(mosaic.values, elevation.mosaic)


def test_other_tools_read_each_cell_at_its_position(elevation, tmp_path):
    geotiff.write_map(tmp_path, elevation)
    with rasterio.open(tmp_path / "dem.tif") as file:
        assert file.dtypes == ("float32",) and np.isnan(file.nodata) and "metre" in file.crs.to_wkt()
        x, y = -2.5, 4.3
        assert next(file.sample([(x, y)]))[0] == pytest.approx(0.5 * x - 0.2 * y, abs=0.7 * 0.02)
        assert file.bounds.top == pytest.approx(4.7) and file.bounds.left == pytest.approx(-3.1)
    with rasterio.open(tmp_path / "mosaic.tif") as file:
        np.testing.assert_array_equal(np.moveaxis(file.read(), 0, 2), elevation.mosaic)


@pytest.mark.parametrize("steps", [(0.1, 0.05, 0.05, -0.1), (0.1, 0, 0, -0.2), (0.1, 0, 0, 0.1)])
def test_rotated_rasters_and_cells_that_are_not_square_are_rejected(steps, tmp_path):
    a, b, d, e = steps
    shape = {"driver": "GTiff", "width": 3, "height": 3, "count": 1, "dtype": "float32"}
    with rasterio.open(tmp_path / "rotated.tif", "w", **shape, transform=rasterio.Affine(a, b, 0, d, e, 0)) as file:
        file.write(np.zeros((1, 3, 3), np.float32))
    with pytest.raises(TwinError, match="rotated"):
        read_raster(tmp_path / "rotated.tif")


def test_the_mesh_is_y_up_and_its_triangles_face_upwards(elevation, tmp_path):
    mesh.write_glb(tmp_path / "mesh.glb", elevation)
    read = trimesh.load(tmp_path / "mesh.glb", force="mesh")
    east, up, south = read.vertices.T
    np.testing.assert_allclose(up, 0.5 * east + 0.2 * south, atol=1e-5)  # south = -north
    assert -south.max() > 4.05 and -south.min() < 4.7  # y of the map with opposite sign
    assert (read.face_normals[:, 1] > 0).all()
    assert len(read.vertices) == np.isfinite(elevation.height_m).sum()


def test_the_mesh_has_the_colours_of_the_mosaic(elevation):
    surface = mesh.map_mesh(elevation)
    first = np.flatnonzero(np.isfinite(elevation.height_m).ravel())[0]
    np.testing.assert_array_equal(surface.visual.vertex_colors[0, :3], elevation.mosaic.reshape(-1, 3)[first])


def test_the_mesh_of_a_tilted_rig_is_in_the_world(elevation, tmp_path):
    pose = geometry.pose(geometry.so3_exp(np.array([np.deg2rad(60), 0, 0])), np.array([0.3, -0.2, 1.0]))
    mesh.write_glb(tmp_path / "mesh.glb", replace(elevation, map_from_world=pose))
    vertices = np.asarray(trimesh.load(tmp_path / "mesh.glb", force="mesh").vertices)
    x, y, z = geometry.transform(pose, np.column_stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]])).T
    np.testing.assert_allclose(z, 0.5 * x - 0.2 * y, atol=1e-5)


def test_a_large_map_is_subsampled_and_an_empty_one_gives_an_empty_scene(elevation, tmp_path):
    assert len(mesh.map_mesh(elevation, max_vertices=300).vertices) <= 300
    elevation.height_m[:] = np.nan
    mesh.write_glb(tmp_path / "empty.glb", elevation)
    assert (tmp_path / "empty.glb").stat().st_size > 0


def test_grid_cells_are_split_from_south_west_to_north_east_and_face_upwards():
    np.testing.assert_array_equal(grid_triangles(np.array([[0, 1], [2, 3]])), [[0, 1, 3], [0, 3, 2]])
    x, y = np.meshgrid(np.arange(5), np.arange(4))
    points = np.stack([x, y], axis=-1).reshape(-1, 2)
    a, b, c = np.moveaxis(points[grid_triangles(np.arange(20).reshape(4, 5))], 1, 0)
    doubled_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    np.testing.assert_array_equal(doubled_area, np.ones(2 * 3 * 4))


def test_raster_triangles_leave_out_cells_without_data():
    valid = np.ones((3, 4), bool)
    valid[0, 0] = False  # the north-west corner belongs to one triangle
    triangles = raster_triangles(valid)
    assert len(triangles) == 2 * 2 * 3 - 1 and not (triangles == 0).any()
