"""Maps on disk: a round trip keeps every bit and the place; the mesh stands upright."""

import numpy as np
import pytest
import rasterio
import trimesh

from twin.core.records import ElevationMap, MapGrid
from twin.exchange import geotiff, mesh
from twin.report.run_folder import read_raster

GRID = MapGrid(-3.1, 4.7, 0.02, 30, 40)


@pytest.fixture
def found():
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(*GRID.centres())
    height = (0.5 * x - 0.2 * y).astype(np.float32)
    height[:3, :4] = np.nan
    sigma = np.where(np.isnan(height), np.nan, 0.01).astype(np.float32)
    return ElevationMap(GRID, height, sigma, rng.integers(1, 255, (30, 40, 3), dtype=np.uint8))


def test_a_map_comes_back_bit_by_bit_and_in_place(found, tmp_path):
    geotiff.write_map(tmp_path, found)
    height, sigma, mosaic = (read_raster(tmp_path / f"{name}.tif") for name in ("dem", "dem_sigma", "mosaic"))
    assert height.grid == sigma.grid == mosaic.grid == GRID
    np.testing.assert_array_equal(height.values, found.height_m)
    np.testing.assert_array_equal(sigma.values, found.sigma_m)
    np.testing.assert_array_equal(mosaic.values, found.mosaic)


def test_other_tools_find_each_cell_where_it_lies(found, tmp_path):
    geotiff.write_map(tmp_path, found)
    with rasterio.open(tmp_path / "dem.tif") as file:
        assert file.dtypes == ("float32",) and np.isnan(file.nodata) and "metre" in file.crs.to_wkt()
        x, y = -2.5, 4.3
        assert next(file.sample([(x, y)]))[0] == pytest.approx(0.5 * x - 0.2 * y, abs=0.7 * 0.02)
        assert file.bounds.top == pytest.approx(4.7) and file.bounds.left == pytest.approx(-3.1)
    with rasterio.open(tmp_path / "mosaic.tif") as file:
        np.testing.assert_array_equal(np.moveaxis(file.read(), 0, 2), found.mosaic)


@pytest.mark.parametrize("steps", [(0.1, 0.05, 0.05, -0.1), (0.1, 0, 0, -0.2), (0.1, 0, 0, 0.1)])
def test_rotated_grids_and_oblong_cells_are_refused(steps, tmp_path):
    a, b, d, e = steps
    shape = {"driver": "GTiff", "width": 3, "height": 3, "count": 1, "dtype": "float32"}
    with rasterio.open(tmp_path / "turned.tif", "w", **shape, transform=rasterio.Affine(a, b, 0, d, e, 0)) as file:
        file.write(np.zeros((1, 3, 3), np.float32))
    with pytest.raises(ValueError, match="rotated"):
        read_raster(tmp_path / "turned.tif")


def test_the_mesh_is_y_up_and_faces_up(found, tmp_path):
    mesh.write_glb(tmp_path / "mesh.glb", found)
    read = trimesh.load(tmp_path / "mesh.glb", force="mesh")
    east, up, south = read.vertices.T
    np.testing.assert_allclose(up, 0.5 * east + 0.2 * south, atol=1e-5)  # south = -north
    assert -south.max() > 4.05 and -south.min() < 4.7  # y of the map, the sign undone
    assert (read.face_normals[:, 1] > 0).all()
    assert len(read.vertices) == np.isfinite(found.height_m).sum()


def test_the_mesh_carries_the_mosaic(found):
    made = mesh.surface(found)
    first = np.flatnonzero(np.isfinite(found.height_m).ravel())[0]
    np.testing.assert_array_equal(made.visual.vertex_colors[0, :3], found.mosaic.reshape(-1, 3)[first])


def test_a_large_map_is_thinned_and_an_empty_one_is_no_error(found, tmp_path):
    assert len(mesh.surface(found, max_vertices=300).vertices) <= 300
    found.height_m[:] = np.nan
    mesh.write_glb(tmp_path / "empty.glb", found)
    assert (tmp_path / "empty.glb").stat().st_size > 0
