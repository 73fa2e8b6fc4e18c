"""CRS, vertical unit and direction of a measured DEM, and limits on its size, which are read from the header."""

import re
import resource
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from twin import terrains
from twin.core.georeference import Georeference
from twin.errors import TwinError
from twin.terrains import Terrain

HEIGHTS = np.array([[-2.0, -3.0, -4.0], [-1.5, -2.0, -3.0], [-1.0, -1.0, -2.0]], np.float32)
UTM = "EPSG:32755"  # WGS 84 / UTM zone 55S
DEPTH_CRS = "EPSG:32755+5831"  # with instantaneous water level depth, positive down [m]
FEET_CRS = "EPSG:2222+6360"  # Arizona East in feet, with NAVD88 height in US survey feet


def write(file, values, crs=UTM, spacing=0.5, description=None, unit=None, tags=None, file_tags=None):
    rows, cols = values.shape
    with rasterio.open(
        file, "w", driver="GTiff", count=1, height=rows, width=cols, dtype=values.dtype, crs=crs,
        transform=from_origin(400_000.0, 8_200_000.0, spacing, spacing),
    ) as target:  # fmt: skip
        target.write(values[None])
        if description:
            target.set_band_description(1, description)
        if unit:
            target.units = (unit,)
        target.update_tags(1, **tags or {})
        target.update_tags(**file_tags or {})
    return file


def load(file, z=None) -> Terrain:
    return terrains.load(file, terrains.TextureSource(0.1), 0.5, 3.0, 0, z)


def test_the_georeference_is_the_centre_of_the_raster_and_its_lowest_point(tmp_path):
    terrain = load(write(tmp_path / "dem.tif", HEIGHTS))
    origin = terrain.georeference
    assert (origin.easting, origin.northing, origin.elevation_m) == (400_000.75, 8_199_999.25, -4.0)
    assert rasterio.crs.CRS.from_wkt(origin.crs_wkt).to_epsg() == 32755 and origin.vertical_datum == ""
    with rasterio.open(tmp_path / "dem.tif") as source:
        east, north = source.xy(0, 2)  # the north-eastern cell
    x, y = origin.to_scene(east, north)
    assert (x, y) == (terrain.east_m, terrain.north_m)
    assert terrain.height_at(x, y) + origin.elevation_m == -4.0
    assert origin.from_scene(x, y) == (east, north)


def test_horizontal_feet_scale_the_scene_about_its_origin():
    origin = Georeference(1000.0, 2000.0, metres_per_unit=0.3048)
    assert origin.to_scene(1010.0, 1990.0) == pytest.approx((3.048, -3.048))
    assert origin.from_scene(3.048, -3.048) == pytest.approx((1010.0, 1990.0))


@pytest.mark.parametrize(
    "written",
    [
        {"crs": DEPTH_CRS},
        {"tags": {"positive": "down"}},
        {"tags": {"standard_name": "sea_floor_depth_below_mean_sea_level"}},
        {"description": "depth"},
        {"tags": {"long_name": "Water depth (m)"}},
    ],
)
def test_depths_that_a_file_declares_give_the_floor_of_their_negative(tmp_path, written):
    up = load(write(tmp_path / "up.tif", HEIGHTS))
    down = load(write(tmp_path / "down.tif", -HEIGHTS, **written))
    np.testing.assert_array_equal(down.height_m, up.height_m)
    np.testing.assert_array_equal(down.texture, up.texture)
    assert down.georeference.elevation_m == up.georeference.elevation_m == -4.0
    assert rasterio.crs.CRS.from_wkt(down.georeference.crs_wkt).to_epsg() == 32755  # no depth axis: outputs are z up


@pytest.mark.parametrize(("z", "sign"), [("up", 1), ("down", -1)])
def test_terrain_z_overrides_what_the_file_declares(tmp_path, z, sign):
    file = write(tmp_path / "dem.tif", -HEIGHTS, crs=DEPTH_CRS)
    np.testing.assert_array_equal(load(file, z).height_m, load(write(tmp_path / "b.tif", -sign * HEIGHTS - 5)).height_m)


def test_a_numpy_file_with_depths_is_read_with_terrain_z(tmp_path):
    np.save(tmp_path / "site.npy", -HEIGHTS)
    np.save(tmp_path / "elevation.npy", HEIGHTS)
    down = load(tmp_path / "site.npy", "down")
    np.testing.assert_array_equal(down.height_m, load(tmp_path / "elevation.npy").height_m)
    assert down.georeference is None


@pytest.mark.parametrize(
    ("name", "values", "written"),
    [
        ("site_depth.tif", -HEIGHTS, {}),
        ("Soundings.tif", -HEIGHTS, {}),
        ("dem.tif", -HEIGHTS, {"description": "grid of depth values"}),
        ("dem.tif", 2.5 + HEIGHTS, {"description": "depth"}),  # values of both signs
        ("dem.tif", -HEIGHTS, {"file_tags": {"TIFFTAG_IMAGEDESCRIPTION": "Depth below chart datum"}}),
        ("dem.tif", HEIGHTS, {"tags": {"positive": "down"}}),  # negative depths that increase downwards
    ],
)
def test_an_unclear_direction_is_an_error_that_asks_for_terrain_z(tmp_path, name, values, written):
    file = write(tmp_path / name, values, **written)
    with pytest.raises(TwinError, match="missing") as caught:
        load(file)
    assert caught.value.field == "terrain.z" and caught.value.allowed == '"up" for elevations, "down" for depths'
    assert load(file, "up").highest_m == load(file, "down").highest_m == 3.0


@pytest.mark.parametrize("written", [{"description": "depth"}, {"crs": UTM}, {"description": "elevation"}])
def test_negative_values_are_elevations(tmp_path, written):
    assert load(write(tmp_path / "depth.tif", HEIGHTS, **written)).height_at(0.5, 0.5) == 0.0


@pytest.mark.parametrize(("sign", "hole"), [(-1, -np.inf), (1, np.inf), (-1, np.nan)])
def test_a_hole_does_not_determine_the_direction_of_the_values(tmp_path, sign, hole):
    """Positive values of a band "depth" increase downwards, negative ones upwards, whatever value a hole has."""
    values = sign * HEIGHTS
    values[2, 2] = hole
    terrain = load(write(tmp_path / "dem.tif", values, description="depth"))
    assert terrain.n_filled == 1 and terrain.height_at(0.5, 0.5) == 0.0


@pytest.mark.parametrize(
    ("written", "metre"),
    [
        ({"unit": "ft"}, 0.3048),
        ({"unit": "US survey foot"}, 1200 / 3937),
        ({"tags": {"units": "cm"}}, 0.01),
        ({"crs": FEET_CRS}, 1200 / 3937),
        ({"crs": FEET_CRS, "unit": "metre"}, 1.0),
        ({"crs": DEPTH_CRS, "unit": "fathoms"}, -1.8288),
        ({}, 1.0),
    ],
)
def test_vertical_units_are_converted_to_metres(tmp_path, written, metre):
    values = HEIGHTS if metre > 0 else -HEIGHTS
    terrain = load(write(tmp_path / "dem.tif", values, **written))
    assert terrain.highest_m == pytest.approx(3.0 * abs(metre))
    assert terrain.georeference.elevation_m == pytest.approx(-4.0 * abs(metre))


def test_an_unknown_vertical_unit_is_an_error(tmp_path):
    with pytest.raises(TwinError, match="unknown unit 'cubit'"):
        load(write(tmp_path / "dem.tif", HEIGHTS, unit="cubit"))


def test_heights_have_the_scale_and_the_offset_of_their_band(tmp_path):
    up = load(write(tmp_path / "up.tif", HEIGHTS)).height_m
    for scale, offset in ((0.5, 1.0), (-1.0, -3.0)):
        file = write(tmp_path / f"{scale}.tif", ((HEIGHTS - offset) / scale).astype(np.int16 if scale > 0 else float))
        with rasterio.open(file, "r+") as target:
            target.scales, target.offsets = (scale,), (offset,)
        scaled = load(file)
        np.testing.assert_array_equal(scaled.height_m, up)
        assert scaled.georeference.elevation_m == -4.0
    with rasterio.open(file, "r+") as target:
        target.scales = (0.0,)
    with pytest.raises(TwinError, match="band scale 0 and offset -3"):
        load(file)


@pytest.mark.parametrize("marker", [-9999.0, 9999.0, -32768.0, 1e20, -3.4e38])
def test_a_value_of_holes_that_is_not_declared_is_named_with_its_number_of_cells(tmp_path, marker):
    values = np.tile(HEIGHTS, (3, 3))
    values[2:4, 3:6] = marker
    with pytest.raises(TwinError, match=re.escape(f"has the value {marker:g} in 6 cells")) as caught:
        load(write(tmp_path / "dem.tif", values))
    assert caught.value.allowed == f"gdal_edit.py -a_nodata {np.float32(marker):g} dem.tif"
    np.save(tmp_path / "dem.npy", values)
    with pytest.raises(TwinError, match=re.escape(f"has the value {marker:g} in 6 cells")):
        load(tmp_path / "dem.npy")


def test_two_undeclared_values_of_holes_do_not_hide_each_other(tmp_path):
    values = np.tile(HEIGHTS, (2, 2))
    values[0, 0], values[0, 1] = -32768.0, -9999.0
    with pytest.raises(TwinError, match="the value -32768 in 1 cells"):
        load(write(tmp_path / "dem.tif", values))


def test_heights_near_a_usual_value_of_holes_and_two_levels_are_heights(tmp_path):
    assert load(write(tmp_path / "trench.tif", HEIGHTS - 9997)).highest_m == 3.0
    assert load(write(tmp_path / "step.tif", np.where(HEIGHTS < -2, -90, -1).astype(np.float32))).highest_m == 89.0


@pytest.mark.parametrize(("values", "crs"), [(-HEIGHTS, UTM), (20 - HEIGHTS, None)])
def test_positive_values_without_a_direction_ask_for_terrain_z(tmp_path, values, crs):
    with pytest.raises(TwinError, match="all positive, does not state whether") as caught:
        load(write(tmp_path / "dem.tif", values, crs=crs))
    assert caught.value.field == "terrain.z"
    named = write(tmp_path / "named.tif", values, crs=crs, description="elevation_m")
    np.testing.assert_array_equal(load(named).height_m, load(named, "up").height_m)


@pytest.mark.parametrize(
    ("crs", "north", "scale"), [("EPSG:3857", -5_621_521.0, "0.707"), ("EPSG:3395", 1_900_000.0, "0.957")]
)
def test_a_grid_whose_metres_are_not_metres_on_the_ground_is_refused_with_its_scale(tmp_path, crs, north, scale):
    file = write(tmp_path / "dem.tif", HEIGHTS, crs=crs)
    with rasterio.open(file, "r+") as target:
        target.transform = from_origin(16_000_000.0, north, 0.5, 0.5)
    with pytest.raises(TwinError, match=f"with the ground scale {scale}") as caught:
        load(file)
    assert "gdalwarp -t_srs EPSG:32" in caught.value.allowed


def test_a_rotation_below_a_millionth_of_a_cell_is_none(tmp_path):
    file = write(tmp_path / "dem.tif", HEIGHTS)
    for skew, read in ((1e-12, True), (1e-3, False)):
        with rasterio.open(file, "r+") as target:
            target.transform = rasterio.Affine(0.5, skew, 400_000.0, 0.0, -0.5, 8_200_000.0)
        if read:
            assert load(file).spacing_m == 0.5
        else:
            with pytest.raises(TwinError, match="is rotated"):
                load(file)


@pytest.mark.parametrize(("mask", "marked"), [(255, True), (1, False), (255, False)])
def test_an_alpha_band_beside_the_heights_marks_holes(tmp_path, mask, marked):
    alpha = np.full(HEIGHTS.shape, mask, np.float32)
    alpha[0, 2] = 0
    profile = {"driver": "GTiff", "count": 2, "height": 3, "width": 3, "dtype": "float32", "crs": UTM}
    profile["transform"] = from_origin(400_000.0, 8_200_000.0, 0.5, 0.5)
    with rasterio.open(tmp_path / "dem.tif", "w", **profile) as target:
        target.write(np.stack([HEIGHTS, alpha]))
        if marked:
            target.colorinterp = [rasterio.enums.ColorInterp.gray, rasterio.enums.ColorInterp.alpha]
    terrain = load(tmp_path / "dem.tif")
    assert terrain.n_filled == 1 and terrain.highest_m == 2.0  # without the hole, -4 to -1


def test_two_bands_of_heights_are_refused(tmp_path):
    profile = {"driver": "GTiff", "count": 2, "height": 3, "width": 3, "dtype": "float32"}
    with rasterio.open(tmp_path / "dem.tif", "w", **profile) as target:
        target.write(np.stack([HEIGHTS, HEIGHTS]))
    with pytest.raises(TwinError, match="second band that is not a mask"):
        load(tmp_path / "dem.tif")


def test_a_grid_in_degrees_names_the_projection_to_use(tmp_path):
    rows, cols = HEIGHTS.shape
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", count=1, height=rows, width=cols, dtype="float32", crs="EPSG:4326",
        transform=from_origin(145.5, -14.6, 1e-5, 1e-5),
    ) as target:  # fmt: skip
        target.write(HEIGHTS[None])
    with pytest.raises(TwinError, match="is in degrees") as caught:
        load(tmp_path / "dem.tif")
    assert "gdalwarp -t_srs EPSG:32755" in caught.value.allowed


def huge_tiff(file: Path, n=30_000) -> Path:
    """Writes a GeoTIFF of n x n heights without blocks on disk."""
    with rasterio.open(
        file, "w", driver="GTiff", count=1, height=n, width=n, dtype="float32", tiled=True, sparse_ok=True, crs=UTM,
        transform=from_origin(0, 0, 0.1, 0.1),
    ):  # fmt: skip
        pass
    return file


def huge_png(file: Path, n=30_000, depth=16) -> Path:
    """Writes the header of a PNG of n x n grey pixels; there are no pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", n, n, depth, 0, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    return file


def huge_npy(file: Path, n=30_000) -> Path:
    """Writes a sparse .npy file of n x n heights."""
    np.lib.format.open_memmap(file, "w+", np.float32, (n, n)).flush()
    return file


@pytest.mark.parametrize(("make", "name"), [(huge_tiff, "a.tif"), (huge_png, "a.png"), (huge_npy, "a.npy")])
def test_too_many_heights_are_rejected_from_the_header(tmp_path, make, name):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(TwinError) as caught:
        load(make(tmp_path / name))
    assert str(caught.value) == (
        f"terrain.height_file: '{name}' has 30000 x 30000 heights (allowed: at most 6000000 heights)"
    )
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


def test_too_large_a_texture_is_rejected_from_the_header(tmp_path):
    np.save(tmp_path / "dem.npy", HEIGHTS)
    texture = huge_png(tmp_path / "t.png", depth=8)
    with pytest.raises(TwinError, match="'t.png' has 30000 x 30000 pixels") as caught:
        terrains.load(tmp_path / "dem.npy", terrains.TextureSource(0.1, texture), 0.5, 3.0, 0)
    assert caught.value.field == "terrain.texture_file"


def test_heights_in_millimetres_are_as_far_apart_as_in_metres(tmp_path):
    """A plate of 150 mm on a level floor: no value of holes."""
    values = np.full((20, 20), -3000, np.int16)
    values[4:7, 4:7] = -2850
    heights = load(write(tmp_path / "mm.tif", values, unit="mm"), "up").height_m
    assert np.ptp(heights) == pytest.approx(0.15, abs=1e-6)
