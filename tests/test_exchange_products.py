"""Exported maps: other programs read cells, points and triangles back at the right place with the right colours."""

import resource
from contextlib import contextmanager
from dataclasses import replace

import exported_run as made
import laspy
import numpy as np
import pytest
import rasterio
import trimesh
from exported_run import GRID

from twin.core import geometry
from twin.core.georeference import Georeference
from twin.core.ortho_tiles import OrthoTile
from twin.core.records import MapGrid
from twin.errors import TwinError
from twin.exchange import geotiff
from twin.exports.formats import FORMATS
from twin.report.run_folder import read_raster

UTM = geotiff.georeference_in("EPSG:32633", (412345.25, 4512345.75, -31.5))
PLACES = [None, UTM]


@pytest.fixture
def run(tmp_path):
    return made.contents(tmp_path, orthomosaic=made.write_orthomosaic(tmp_path / "mosaic.tif"))


def export(name, contents, folder):
    """Returns the files of a format by name."""
    folder.mkdir()
    return {path.name: path for path in FORMATS[name].write(contents, folder)}


def cells_of(place):
    """Returns the known points (n, 3) of the map in the CRS, their colours and their standard deviations."""
    given = made.elevation()
    known = np.isfinite(given.height_m)
    x, y = np.meshgrid(*GRID.centres())
    points = np.column_stack([x[known], y[known], given.height_m[known].astype(float)])
    shift = [0, 0, 0] if place is None else [place.easting, place.northing, place.elevation_m]
    return points + shift, given.mosaic[known], given.sigma_m[known]


@pytest.mark.parametrize("place", PLACES, ids=["local", "UTM"])
def test_elevation_and_orthomosaic_are_cloud_optimised_and_coincide(run, place, tmp_path):
    error = np.full((GRID.rows, GRID.cols), 0.002, np.float32)
    files = export("cog", replace(run, georeference=place, error_m=error), tmp_path / "out")
    assert set(files) == {"dem.tif", "dem_sigma.tif", "dem_error.tif", "orthomosaic.tif"}
    points, _, _ = cells_of(place)
    with rasterio.open(files["dem.tif"]) as dem, rasterio.open(files["orthomosaic.tif"]) as ortho:
        for file in (dem, ortho):
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG" and file.block_shapes[0][1] == 512
            assert file.crs == (geotiff.LOCAL_METRES if place is None else "EPSG:32633")
        np.testing.assert_allclose(dem.bounds, ortho.bounds, atol=1e-6)
        assert [value[0] for value in dem.sample(points[:, :2])] == pytest.approx(points[:, 2], abs=1e-6)
        west, north = dem.bounds.left, dem.bounds.top
        corners = [(west + 0.01, north - 0.01), (west + 2.1, north - 0.01), (west + 0.01, north - 1.4)]
        red, *others = (value[:3] for value in ortho.sample(corners))
        assert red[0] == 255 and all(other[0] == 40 for other in others)
        assert others[0][1] > 200 and others[1][2] < 30  # green in the east, no blue in the south
        assert next(ortho.sample([(dem.bounds.right - 0.01, dem.bounds.bottom + 0.01)]))[3] == 0
    with rasterio.open(files["dem_error.tif"]) as file:
        assert file.read(1) == pytest.approx(0.002) and "true" in file.descriptions[0]


def test_a_large_map_has_overviews_and_reads_back_in_scene_coordinates(tmp_path):
    grid = replace(GRID, rows=700, cols=600)
    height = np.random.default_rng(0).normal(size=(700, 600)).astype(np.float32)
    large = replace(made.elevation(), grid=grid, height_m=height, sigma_m=height, mosaic=np.zeros((700, 600, 3), "u1"))
    files = export("cog", made.contents(tmp_path, elevation=large, georeference=UTM), tmp_path / "out")
    with rasterio.open(files["dem.tif"]) as file:
        assert file.overviews(1) and np.isnan(file.nodata)
    read = read_raster(files["dem.tif"])
    assert read.grid == grid
    np.testing.assert_allclose(read.values, height, atol=1e-9)
    assert files["orthomosaic.tif"].is_file()  # the colours of the cells


def test_an_orthomosaic_of_a_georeferenced_run_keeps_its_crs(tmp_path):
    feet = Georeference(1000.0, 2000.0, -5.0, rasterio.crs.CRS.from_epsg(2263).to_wkt(), 1200 / 3937)
    source = made.write_orthomosaic(tmp_path / "mosaic.tif", feet)
    files = export("cog", made.contents(tmp_path, orthomosaic=source, georeference=feet), tmp_path / "out")
    with rasterio.open(files["dem.tif"]) as dem, rasterio.open(files["orthomosaic.tif"]) as ortho:
        assert dem.crs == ortho.crs == "EPSG:2263"
        np.testing.assert_allclose(dem.bounds, ortho.bounds, atol=1e-6)
        assert dem.bounds.left == pytest.approx(1000 - 1.0 * 3937 / 1200)


def test_a_tilted_map_has_no_raster_in_a_crs(tmp_path):
    tilted = replace(made.elevation(), map_from_world=geometry.exp(np.array([0.8, 0, 0, 0, 0, 0])))
    with pytest.raises(TwinError, match="--to cog: the map is tilted"):
        export("cog", made.contents(tmp_path, elevation=tilted, georeference=UTM), tmp_path / "out")
    assert export("cog", made.contents(tmp_path, elevation=tilted), tmp_path / "local")


@pytest.mark.parametrize("place", PLACES, ids=["local", "UTM"])
def test_trimesh_reads_the_points_of_the_ply_file(run, place, tmp_path):
    (path,) = export("ply", replace(run, georeference=place), tmp_path / "out").values()
    points, colours, sigma_m = cells_of(place)
    read = trimesh.load(path)
    np.testing.assert_allclose(read.vertices, points, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(read.colors)[:, :3], colours)
    np.testing.assert_array_equal(read.metadata["_ply_raw"]["vertex"]["data"]["sigma"].ravel(), sigma_m)


@pytest.mark.parametrize("place", PLACES, ids=["local", "UTM"])
def test_laspy_reads_the_points_of_the_laz_file(run, place, tmp_path):
    (path,) = export("laz", replace(run, georeference=place), tmp_path / "out").values()
    points, colours, sigma_m = cells_of(place)
    with laspy.open(path) as file:
        assert file.header.are_points_compressed and str(file.header.version) == "1.4"
        assert [
            vlr.record_id for vlr in file.header.vlrs if "WKT" in type(vlr).__name__.upper() or vlr.record_id == 2112
        ]
        wkt = next(vlr.string for vlr in file.header.vlrs if vlr.record_id == 2112)
        read = file.read()
    np.testing.assert_allclose(read.xyz, points, atol=1e-6)
    np.testing.assert_array_equal(np.column_stack([read.red, read.green, read.blue]) // 257, colours)
    np.testing.assert_array_equal(read.sigma, sigma_m)
    assert (np.asarray(read.return_number) == 1).all() and (np.asarray(read.number_of_returns) == 1).all()
    assert rasterio.crs.CRS.from_wkt(wkt) == (geotiff.LOCAL_METRES if place is None else "EPSG:32633")


def test_a_wide_point_cloud_has_coarser_coordinates(tmp_path):
    wide = replace(made.elevation(), grid=replace(GRID, cell_m=100.0))
    (path,) = export("laz", made.contents(tmp_path, elevation=wide), tmp_path / "out").values()
    read = laspy.read(path)
    assert read.header.scales[0] == pytest.approx(1e-5)
    assert read.x.max() == pytest.approx(GRID.west_m + 43.5 * 100, abs=1e-5)


def sampled(texture, uv):
    """Returns the colours (n, 3) of an image at texture coordinates with the origin in its lower left corner."""
    pixels = np.asarray(texture.convert("RGB"))
    rows = np.floor((1 - uv[:, 1]) * pixels.shape[0]).astype(int)
    cols = np.floor(uv[:, 0] * pixels.shape[1]).astype(int)
    return pixels[rows.clip(0, pixels.shape[0] - 1), cols.clip(0, pixels.shape[1] - 1)].astype(int)


@pytest.mark.parametrize("name", ["glb", "obj"])
@pytest.mark.parametrize("texture", ["orthomosaic", "cells"])
def test_trimesh_reads_the_mesh_with_its_texture(run, name, texture, tmp_path):
    given = run if texture == "orthomosaic" else replace(run, orthomosaic=None)
    files = export(name, replace(given, georeference=UTM), tmp_path / "out")
    assert set(files) == ({"map.glb"} if name == "glb" else {"map.obj", "map.mtl", "map.png"})
    read = trimesh.load(files[f"map.{name}"], force="mesh", process=False)
    x, y, z = read.vertices.T if name == "obj" else (read.vertices * [1, 1, -1]).T[[0, 2, 1]]
    np.testing.assert_allclose(z, made.height_at(x, y), atol=1e-5)
    assert (read.face_normals[:, 2 if name == "obj" else 1] > 0).all()
    assert len(z) == GRID.rows * GRID.cols - 1
    material = read.visual.material
    image = material.baseColorTexture if name == "glb" else material.image
    difference = sampled(image, np.asarray(read.visual.uv)) - made.colours(x, y)
    assert np.abs(difference).max() <= 4  # a vertex at a corner of four pixels: half a pixel is 1.25 and 1.9 levels


@pytest.mark.parametrize(("rows", "cols", "shape"), [(3, 100, (1, 20, 3)), (100, 3, (20, 1, 3))])
def test_the_texture_of_a_very_long_orthomosaic_has_one_pixel_across(rows, cols, shape, tmp_path):
    grid = MapGrid(0.0, 0.0, 0.1, rows, cols)
    with geotiff.OrthomosaicFile(tmp_path / "mosaic.tif", grid) as file:
        file.write(OrthoTile(grid, 0, 0, np.full((rows, cols, 4), [90, 60, 30, 255], np.uint8)))
    reduced, texture = geotiff.read_mosaic(tmp_path / "mosaic.tif", most_side_px=20)
    assert texture.shape == shape and (texture == [90, 60, 30]).all()
    assert (reduced.rows, reduced.cols, reduced.cell_m) == (*shape[:2], pytest.approx(0.5))


def test_the_mesh_states_where_its_origin_lies(run, tmp_path):
    files = export("glb", replace(run, georeference=UTM), tmp_path / "glb")
    extras = trimesh.load(files["map.glb"]).metadata
    assert float(extras["SCENE_ORIGIN_EASTING"]) == 412345.25 and "UTM zone 33N" in extras["CRS"]
    text = export("obj", replace(run, georeference=UTM), tmp_path / "obj")["map.obj"].read_text()
    assert "# SCENE_ORIGIN_NORTHING: 4512345.75" in text


def test_a_foot_is_the_unit_of_a_crs_in_feet():
    assert geotiff.georeference_in("EPSG:2263", (0.0, 0.0, 0.0)).metres_per_unit == pytest.approx(1200 / 3937)


@contextmanager
def disk_for(n_bytes):
    """Lets files grow to this size only, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def write_orthomosaic(file, grid, rgba):
    with geotiff.OrthomosaicFile(file, grid) as written:
        written.write(OrthoTile(grid, 0, 0, rgba))


@pytest.mark.parametrize("side", [20, 300, 700])
@pytest.mark.parametrize("kind", ["orthomosaic", "layer", "masks", "mosaic"])
def test_a_file_that_a_full_disk_cuts_anywhere_is_an_error_and_is_removed(kind, side, tmp_path):
    rng, grid = np.random.default_rng(1), MapGrid(0, 0, 0.01, side, side)
    rgba = rng.integers(0, 256, (side, side, 4), np.uint8)
    write = {
        "orthomosaic": lambda file: write_orthomosaic(file, grid, rgba),
        "layer": lambda file: geotiff.write_layer(file, rgba[..., 0] / np.float32(7), grid, "height"),
        "masks": lambda file: geotiff.write_masks(file, {"one": rgba[..., 0], "two": rgba[..., 1]}, grid),
        "mosaic": lambda file: geotiff.write_mosaic(file, rgba[..., :3], grid),
    }[kind]
    file = tmp_path / "a.tif"
    write(file)
    size = file.stat().st_size
    with disk_for(size):
        write(file)
    for missing in (1, 100, 5000, 20_000, 60_000, size // 2):
        if missing < size:
            with pytest.raises(OSError), disk_for(size - missing):
                write(file)
            assert not file.exists(), missing


def test_an_orthomosaic_that_may_exceed_four_gigabytes_has_large_offsets(tmp_path):
    for side, start in ((1000, b"II*\0"), (24000, b"II+\0")):
        with geotiff.OrthomosaicFile(tmp_path / "a.tif", MapGrid(0, 24, 0.001, side, side)):
            pass
        assert (tmp_path / "a.tif").read_bytes()[:4] == start


def test_a_damaged_file_is_replaced(tmp_path):
    grid, file = MapGrid(0, 1, 0.1, 300, 300), tmp_path / "a.tif"
    rgba = np.random.default_rng(1).integers(0, 256, (300, 300, 4), np.uint8)
    write_orthomosaic(file, grid, rgba)
    file.write_bytes(file.read_bytes()[:-5000])
    write_orthomosaic(file, grid, rgba)
    assert geotiff.read_mosaic(file).values.shape == (300, 300, 3)
