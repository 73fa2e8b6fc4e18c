"""GeoTIFF files of maps. Row 0 is the northernmost row; the nodata value of float layers is NaN.

Without a georeference, files are in scene coordinates [m]. With one (that of a measured DEM, or given by the user),
they are in its coordinate reference system (CRS), with elevations above its vertical datum [m], and tags hold the scene
origin, from which `scene_placement` computes scene coordinates.
"""

import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioIOError
from rasterio.transform import Affine
from rasterio.warp import transform

from twin.core.georeference import Georeference
from twin.core.ortho_tiles import OrthoTile
from twin.core.records import ElevationMap, Image, MapGrid
from twin.core.user_files import open_raster
from twin.errors import TwinError

Layer = NDArray[np.float32]

#: Local coordinate system: metres east and north of the scene origin.
LOCAL_METRES = CRS.from_wkt(
    'LOCAL_CS["local metres",UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)
MOST_CELLS = 100_000_000  #: of a map that is read as a whole
MAX_MOSAIC_PX = 16_000_000  #: of an orthomosaic that is read reduced

_ORIGIN_TAGS = ("SCENE_ORIGIN_EASTING", "SCENE_ORIGIN_NORTHING", "SCENE_ORIGIN_ELEVATION_M")
_UNIT_TAG = "SCENE_METRES_PER_UNIT"
_DATUM_TAG = "VERTICAL_DATUM"
_UNKNOWN_DATUM = "same as the source DEM"  # tag of a vertical datum that the source does not name
_ELEVATION_TAG = {"QUANTITY": "elevation"}  # tag of bands whose values include the elevation of the scene origin
_LARGEST_COORDINATE = 1e8  # largest coordinate of the origin of a scene, in the unit of its CRS
_DECIMALS = 6  # decimals of scene coordinates [m]; CRS coordinates have up to seven digits before the decimal point
_LEAST_CELLS = 10_000_000  # of a map that may be larger than its file


class Raster(NamedTuple):
    """A raster in scene coordinates: its cells, and values (rows, cols) with NaN for no data or (rows, cols, 3) RGB."""

    grid: MapGrid
    values: NDArray[Any]


def write_map(
    folder: Path, elevation_map: ElevationMap, georeference: Georeference | None = None, mosaic: bool = True
) -> None:
    """Writes dem.tif, dem_sigma.tif and dem_repeatability.tif to a folder and, if `mosaic` is true, mosaic.tif."""
    grid = elevation_map.grid
    write_elevations(folder / "dem.tif", elevation_map.height_m, grid, "elevation [m]", georeference)
    write_layer(folder / "dem_sigma.tif", elevation_map.sigma_m, grid, "standard deviation [m]", georeference)
    repeatability = "standard deviation between two surveys [m]"
    write_layer(folder / "dem_repeatability.tif", elevation_map.repeatability_m, grid, repeatability, georeference)
    if mosaic:
        write_mosaic(folder / "mosaic.tif", elevation_map.mosaic, grid, georeference)


def write_elevations(
    path: Path, height_m: Layer, grid: MapGrid, description: str, georeference: Georeference | None = None
) -> None:
    """Writes heights (rows, cols) [m], NaN where unknown: as float32 above z = 0, or as elevations in the datum."""
    # elevations are float64: float32 would round those of sites below about 1 km to steps of 0.1 mm
    if georeference is None:
        return write_layer(path, height_m, grid, description)
    elevations = height_m.astype(np.float64) + georeference.elevation_m
    _write(path, elevations[None], grid, georeference, (description,), _ELEVATION_TAG, nodata=np.nan, predictor=3)


def write_layer(
    path: Path, values: Layer, grid: MapGrid, description: str, georeference: Georeference | None = None
) -> None:
    _write(path, values[None].astype(np.float32), grid, georeference, (description,), nodata=np.nan, predictor=3)


def write_masks(
    path: Path, masks: dict[str, NDArray[Any]], grid: MapGrid, georeference: Georeference | None = None
) -> None:
    """Writes layers (rows, cols) of integers or Booleans as uint16, one band each; the keys describe the bands."""
    _write(path, np.array(list(masks.values())).astype(np.uint16), grid, georeference, tuple(masks))


def write_mosaic(path: Path, mosaic: Image, grid: MapGrid, georeference: Georeference | None = None) -> None:
    _write(path, np.moveaxis(mosaic, 2, 0), grid, georeference, nodata=0, photometric="RGB", predictor=2)


def _write(
    path: Path, bands: NDArray[Any], grid: MapGrid, georeference: Georeference | None,
    descriptions: tuple[str, ...] = (), tags: Mapping[str, str] | None = None, **options: Any,
) -> None:  # fmt: skip
    """Writes bands (n, rows, cols), one by one if they have descriptions and tags; `options` are those of rasterio."""
    with _created(path, profile(grid, len(bands), str(bands.dtype), georeference) | options) as file:
        if not descriptions:
            file.write(bands)
        for band, description in enumerate(descriptions, start=1):
            file.write(bands[band - 1], band)
            file.set_band_description(band, description)
            file.update_tags(band, **(tags or {}))
        file.update_tags(**placement_tags(georeference))


@contextmanager
def _created(path: Path, layout: dict[str, Any]) -> Iterator[Any]:
    """Opens a GeoTIFF to write in place of any other file; removes it after an exception."""
    path.unlink(missing_ok=True)  # GDAL replaces no damaged file
    try:
        with rasterio.open(path, "w", **layout) as file:
            yield file
        check_written(path)
    except BaseException as error:
        path.unlink(missing_ok=True)
        if isinstance(error, RasterioIOError) and error.__cause__ is not None:
            raise OSError(errno.EIO, str(error.__cause__), str(path)) from error  # it refers to its cause only
        raise


def check_written(path: Path) -> None:
    """Raises OSError if a file that was written is cut: on a full disk, GDAL ignores that the last writes failed."""
    whole = False
    with suppress(RasterioIOError), rasterio.open(path, driver="GTiff") as file:
        (rows, cols), n_bytes = file.block_shapes[0], path.stat().st_size
        blocks = product(file.indexes, range(-(-file.width // cols)), range(-(-file.height // rows)))
        kinds = "OFFSET", "SIZE"
        items = ([file.get_tag_item(f"BLOCK_{k}_{c}_{r}", "TIFF", band) for k in kinds] for band, c, r in blocks)
        whole = all(start and size and int(start) + int(size) <= n_bytes for start, size in items)
    if not whole:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


class OrthomosaicFile(ExitStack):
    """GeoTIFF of an orthomosaic (RGBA), written by tiles; a context manager, which removes it after an exception."""

    def __init__(self, path: Path, grid: MapGrid, georeference: Georeference | None = None):
        super().__init__()
        tiles = {"tiled": True, "blockxsize": 256, "blockysize": 256, "bigtiff": "IF_SAFER"}
        colours = {"predictor": 2, "zlevel": 9, "interleave": "band", "photometric": "RGB", "alpha": "unspecified"}
        self._file = self.enter_context(_created(path, profile(grid, 4, "uint8", georeference) | tiles | colours))
        self._file.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        self._file.update_tags(**placement_tags(georeference))

    def write(self, tile: OrthoTile) -> None:
        rows, cols = tile.rgba.shape[:2]
        window = (tile.row, tile.row + rows), (tile.col, tile.col + cols)
        self._file.write(np.moveaxis(tile.rgba, 2, 0), window=window)


def scene_placement(source: rasterio.DatasetReader) -> tuple[MapGrid, float]:
    """Returns the grid of an open raster in scene coordinates, and the offset [m] to subtract from its values.

    The offset is the elevation of the scene origin if its tags say that values are elevations, otherwise 0. Raises
    ValueError if the raster is rotated, its cells are not square, or its tags are damaged.
    """
    t = source.transform
    if t.b or t.d or t.a <= 0 or not np.isclose(t.a, -t.e, rtol=1e-6):
        raise ValueError("the raster is rotated or its cells are not square")
    origin = _origin(source)
    if origin is None:
        return MapGrid(t.c, t.f, t.a, source.height, source.width), 0.0
    west, north = (round(float(value), _DECIMALS) for value in origin.to_scene(t.c, t.f))
    cell_m = round(t.a * origin.metres_per_unit, 2 * _DECIMALS)
    elevations = _ELEVATION_TAG.items() <= source.tags(1).items()
    return MapGrid(west, north, cell_m, source.height, source.width), origin.elevation_m if elevations else 0.0


def _origin(source: rasterio.DatasetReader) -> Georeference | None:
    """Returns the position of the scene by the tags of an open raster; None without them."""
    tags, crs = source.tags(), source.crs
    if any(name not in tags for name in (*_ORIGIN_TAGS, _UNIT_TAG)):
        return None
    easting, northing, elevation_m = (float(tags[name]) for name in _ORIGIN_TAGS)
    unit_m, datum = float(tags[_UNIT_TAG]), tags.get(_DATUM_TAG, _UNKNOWN_DATUM)
    datum = "" if datum == _UNKNOWN_DATUM else datum
    return Georeference(easting, northing, elevation_m, None if crs is None else crs.to_wkt(), unit_m, datum)


def read_georeference(path: Path) -> Georeference | None:
    """Returns the position of the scene in the CRS of a map file, None without one; raises TwinError if damaged."""
    with open_raster(path, "", "a map file, written by `twin run`") as source:
        return _origin(source)


def read_raster(file: Path) -> Raster:
    """Reads a GeoTIFF; in one band, cells without data become NaN, and elevations become heights in the scene.

    Raises TwinError if the file is not a readable GeoTIFF or has more than MOST_CELLS cells, the raster is rotated, its
    cells are not square, or its tags are damaged.
    """
    with open_raster(file) as source:
        n_cells, n_bytes = source.width * source.height, file.stat().st_size
        if n_cells > min(MOST_CELLS, _LEAST_CELLS + 1000 * n_bytes):  # DEFLATE compresses to a thousandth at most
            raise ValueError(f"{source.width} x {source.height} cells in {n_bytes} bytes, at most {MOST_CELLS}")
        grid, elevation_m = scene_placement(source)
        bands = source.read(masked=source.count == 1)
    if len(bands) == 1:
        return Raster(grid, bands[0].astype(float).filled(np.nan) - elevation_m)
    return Raster(grid, np.moveaxis(bands[:3], 0, 2))


def read_mosaic(file: Path, most_side_px: int | None = None) -> Raster:
    """Reads the RGB values of an orthomosaic, averaged to at most `MAX_MOSAIC_PX` pixels, or `most_side_px` per side.

    Rows and columns at the south and east edges that do not fill a reduced pixel are left out. Raises TwinError as
    `read_raster` does.
    """
    with open_raster(file) as source:
        grid, _ = scene_placement(source)
        width, height = source.width, source.height
        excess = max(width, height) / most_side_px if most_side_px else np.sqrt(width * height / MAX_MOSAIC_PX)
        step = int(np.ceil(excess))
        rows, cols = max(1, height // step), max(1, width // step)
        whole = (0, min(rows * step, height)), (0, min(cols * step, width))
        bands = source.read((1, 2, 3), window=whole, out_shape=(3, rows, cols), resampling=Resampling.average)
    cells = MapGrid(grid.west_m, grid.north_m, grid.cell_m * step, rows, cols)
    return Raster(cells, np.moveaxis(bands, 0, 2))


def georeference_in(crs: str, origin: tuple[float, float, float]) -> Georeference:
    """Returns the georeference of a scene whose origin is at (easting, northing, elevation [m]) in a projected CRS.

    `crs` is `EPSG:CODE`, WKT or PROJ text; its unit may be any unit of length. Raises TwinError if the CRS is unknown
    or not projected, or the origin is outside the area in which it is defined.
    """
    try:
        known = CRS.from_user_input(crs)
    except ValueError as error:
        raise TwinError("--crs", f"{crs[:60]!r} is not a CRS: {error}", "such as EPSG:32633") from None
    if not known.is_projected:
        raise TwinError("--crs", f"{crs[:60]!r} is not a projected CRS", "a CRS with eastings and northings")
    if max(map(abs, origin)) > _LARGEST_COORDINATE or not _is_on_earth(known, origin):
        raise TwinError("--origin", f"{origin[0]:g}, {origin[1]:g} is outside the CRS", "E,N or E,N,H in the CRS")
    return Georeference(*origin, crs_wkt=known.to_wkt(), metres_per_unit=float(known.linear_units_factor[1]))


def _is_on_earth(crs: CRS, origin: tuple[float, float, float]) -> bool:
    try:
        (longitude,), (latitude,) = transform(crs, CRS.from_epsg(4326), [origin[0]], [origin[1]])[:2]
    except Exception:  # rasterio raises errors of GDAL, which it does not export
        return False
    return bool(np.isfinite([longitude, latitude]).all())


def crs_of(georeference: Georeference | None) -> CRS:
    """Returns the CRS of a georeference; `LOCAL_METRES` if there is no georeference or its CRS is not known."""
    wkt = None if georeference is None else georeference.crs_wkt
    return LOCAL_METRES if wkt is None else CRS.from_wkt(wkt)


def profile(grid: MapGrid, bands: int, dtype: str, georeference: Georeference | None) -> dict[str, Any]:
    origin = georeference or Georeference(0.0, 0.0)
    west, north = (float(value) for value in origin.from_scene(grid.west_m, grid.north_m))
    cell = grid.cell_m / origin.metres_per_unit
    return {
        "driver": "GTiff",
        "width": grid.cols,
        "height": grid.rows,
        "count": bands,
        "dtype": dtype,
        "crs": crs_of(origin),
        "transform": Affine(cell, 0, west, 0, -cell, north),
        "compress": "deflate",
    }


def placement_tags(georeference: Georeference | None) -> dict[str, str]:
    """Returns the tags that hold the scene origin, the unit and the vertical datum; empty without a georeference."""
    if georeference is None:
        return {}
    origin = (georeference.easting, georeference.northing, georeference.elevation_m)
    tags = {name: repr(value) for name, value in zip(_ORIGIN_TAGS, origin, strict=True)}
    datum = georeference.vertical_datum or _UNKNOWN_DATUM
    return tags | {_UNIT_TAG: repr(georeference.metres_per_unit), _DATUM_TAG: datum}
