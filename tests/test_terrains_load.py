"""Terrains from files: orientation, units, filled holes, and errors for invalid files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.crs import CRS
from rasterio.transform import from_origin

from twin import terrains
from twin.errors import TwinError
from twin.terrains import Terrain

#: row 0 = north; the north-east corner is the highest, the south-west corner the lowest
HEIGHTS = np.array([[2.0, 3.0, 4.0], [1.5, 2.0, 3.0], [1.0, 1.0, 2.0]], np.float32)


def write_tiff(file: Path, bands: np.ndarray, crs: str | None = None, spacing: float = 0.5, **profile: object) -> Path:
    bands = bands if bands.ndim == 3 else bands[None]
    count, height, width = bands.shape
    with rasterio.open(
        file, "w", driver="GTiff", count=count, height=height, width=width, dtype=bands.dtype, crs=crs,
        transform=from_origin(100.0, 200.0, spacing, spacing), **profile,
    ) as target:  # fmt: skip
        target.write(bands)
    return file


def load(file: Path, texture: Path | None = None, texture_px_m: float = 0.1) -> Terrain:
    return terrains.load(file, terrains.TextureSource(texture_px_m, texture), 0.5, 3.0, 0)


def write_png(file: Path, image: np.ndarray) -> Path:
    cv2.imwrite(str(file), image)
    return file


def write_npy(file: Path, array: np.ndarray) -> Path:
    np.save(file, array)
    return file


@pytest.mark.parametrize("form", ("tif", "npy", "png", "asc", "xyz"))
def test_every_format_gives_the_same_floor_north_up_and_centred(tmp_path: Path, form: str) -> None:
    file = tmp_path / f"dem.{form}"
    if form == "tif":
        write_tiff(file, HEIGHTS)
    elif form == "npy":
        write_npy(file, HEIGHTS)
    elif form == "asc":
        lines = ["ncols 3", "nrows 3", "xllcorner 100", "yllcorner 198.5", "cellsize 0.5", "NODATA_value -9999"]
        file.write_text("\n".join([*lines, *(" ".join(map(str, row)) for row in HEIGHTS)]))
    elif form == "xyz":
        east, north = np.meshgrid(100.25 + 0.5 * np.arange(3), 199.75 - 0.5 * np.arange(3))
        np.savetxt(file, np.column_stack([east.ravel(), north.ravel(), HEIGHTS.ravel()]), "%.3f")
    else:
        write_png(file, np.rint((HEIGHTS - 1) / 3 * 65535).astype(np.uint16))
    terrain = load(file)
    assert terrain.height_at([0.5, -0.5, 0.0], [0.5, -0.5, 0.0]) == pytest.approx([3.0, 0.0, 1.0], abs=3 / 65535)
    assert terrain.size_m == pytest.approx((1.0, 1.0)) and terrain.lowest_m == 0.0
    assert terrain.texture.shape == (10, 10, 3) and terrain.n_filled == 0
    if form in ("asc", "xyz"):
        assert terrain.georeference == load(write_tiff(tmp_path / "dem.tif", HEIGHTS)).georeference


def test_a_grid_as_text_has_the_crs_of_the_prj_file_beside_it(tmp_path: Path) -> None:
    crs = CRS.from_epsg(32755)
    (tmp_path / "dem.asc").write_text("ncols 2\nnrows 2\nxllcorner 5e5\nyllcorner 8e6\ncellsize 1\n-1 -2\n-3 -4\n")
    (tmp_path / "dem.prj").write_text(crs.to_wkt("WKT1_ESRI"))
    origin = load(tmp_path / "dem.asc").georeference
    assert origin is not None and origin.crs_wkt is not None
    assert CRS.from_wkt(origin.crs_wkt).to_epsg() == 32755 and origin.easting == 500_001.0


def test_holes_are_filled_with_the_nearest_height_and_counted(tmp_path: Path) -> None:
    holed = HEIGHTS.copy()
    holed[0, 0], holed[2, 2] = -9999.0, np.nan
    terrain = load(write_tiff(tmp_path / "dem.tif", holed, nodata=-9999.0))
    assert terrain.n_filled == 2
    assert np.isfinite(terrain.height_m).all() and terrain.highest_m == 3.0
    assert terrain.height_at(-0.5, 0.5) in (0.5, 2.0)  # 1.5 or 3.0, minus the lowest height 1.0


def test_the_texture_image_is_tiled_from_the_north_west_corner(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (4, 3, 3), dtype=np.uint8)
    texture = write_png(tmp_path / "tile.png", image[..., ::-1])
    terrain = load(write_npy(tmp_path / "dem.npy", HEIGHTS), texture, 0.1)
    assert np.array_equal(terrain.texture, np.tile(image, (3, 4, 1))[:10, :10])


def test_feet_are_converted_to_metres(tmp_path: Path) -> None:
    written = {"crs": "EPSG:2222", "spacing": 10.0}  # Arizona East, international feet
    file = write_tiff(tmp_path / "dem.tif", HEIGHTS - 5, **written)
    with pytest.raises(TwinError, match=r"a CRS in units of 0.3048 m, and no unit of its heights .*-units ft dem.tif"):
        load(file)
    with rasterio.open(file, "r+") as target:
        target.units = ("ft",)
    terrain = load(file)
    assert (terrain.spacing_m, terrain.highest_m) == pytest.approx((3.048, 3 * 0.3048))


BAD = [
    ("no file", lambda p: p / "none.tif", "no such file"),
    ("garbage", lambda p: _bytes(p / "dem.tif"), "cannot be read"),
    ("garbage png", lambda p: _bytes(p / "dem.png"), "cannot be read"),
    ("empty png", lambda p: _bytes(p / "dem.png", b""), "cannot be read"),
    ("garbage npy", lambda p: _bytes(p / "dem.npy"), "cannot be read"),
    ("8-bit TIFF", lambda p: write_tiff(p / "dem.tif", HEIGHTS.astype(np.uint8)), "is an image, not heights"),
    ("RGB TIFF", lambda p: write_tiff(p / "dem.tif", np.ones((3, 4, 4), np.uint16)), "is an image, not heights"),
    ("8-bit PNG", lambda p: write_png(p / "dem.png", HEIGHTS.astype(np.uint8)), "is an image, not heights"),
    ("RGB PNG", lambda p: write_png(p / "dem.png", np.ones((4, 4, 3), np.uint16)), "is an image, not heights"),
    ("JPEG", lambda p: write_png(p / "dem.jpg", HEIGHTS.astype(np.uint8)), "is not a height file"),
    ("3-D array", lambda p: write_npy(p / "dem.npy", np.ones((3, 3, 3))), "contains no heights"),
    ("text array", lambda p: write_npy(p / "dem.npy", np.array([["a", "b"]])), "contains no heights"),
    ("all NaN", lambda p: write_npy(p / "dem.npy", np.full((3, 3), np.nan)), "no valid height"),
    ("all nodata", lambda p: write_tiff(p / "dem.tif", np.full((3, 3), -1.0), nodata=-1.0), "no valid height"),
    ("1 row", lambda p: write_npy(p / "dem.npy", HEIGHTS[:1]), "1 row(s) and 3 column(s)"),
    ("1 column", lambda p: write_tiff(p / "dem.tif", HEIGHTS[:, :1]), "3 row(s) and 1 column(s)"),
    ("scattered XYZ", lambda p: _bytes(p / "dem.xyz", b"0 0 1\n1.3 0.2 2\n0.1 1.4 3\n2 2 4\n"), "cannot be read: "),
    ("LAZ", lambda p: _bytes(p / "dem.laz", b"LASF"), "is not read as .laz"),
    ("NetCDF", lambda p: _bytes(p / "dem.nc", b"CDF"), "is not read as .nc"),
    ("degrees", lambda p: write_tiff(p / "dem.tif", HEIGHTS, crs="EPSG:4326"), "is in degrees"),
]


def _bytes(file: Path, content: bytes = b"not a raster") -> Path:
    file.write_bytes(content)
    return file


@pytest.mark.parametrize(("make", "problem"), [(b[1], b[2]) for b in BAD], ids=[b[0] for b in BAD])
def test_an_invalid_height_file_is_rejected_with_a_one_line_message(tmp_path: Path, make: object, problem: str) -> None:
    with pytest.raises(TwinError) as caught:
        load(make(tmp_path))  # pyright: ignore[reportCallIssue]
    assert caught.value.field == "terrain.height_file"
    assert problem in caught.value.problem and "\n" not in str(caught.value) and caught.value.allowed


@pytest.mark.parametrize(
    ("name", "problem"), [("none.png", "no such file"), ("dem.npy", "is not a file of the format")]
)
def test_an_invalid_texture_file_is_rejected(tmp_path: Path, name: str, problem: str) -> None:
    file = write_npy(tmp_path / "dem.npy", HEIGHTS)
    with pytest.raises(TwinError, match=problem) as caught:
        load(file, tmp_path / name)
    assert caught.value.field == "terrain.texture_file"


def test_the_horseshoe_reef_has_its_measured_relief(outside_data) -> None:
    terrain = load(outside_data("horseshoe_reef_dem.tif"), outside_data("gravel.png"), 0.0025)
    assert terrain.height_m.shape == (800, 800) and terrain.spacing_m == pytest.approx(0.01)
    assert terrain.highest_m == pytest.approx(-2.584359 + 3.9536424, abs=1e-5)  # minimum and maximum by gdalinfo
    assert terrain.texture.shape == (3196, 3196, 3)
