"""Texture from an orthophoto: a GeoTIFF with its own coordinate reference system (CRS), resolution and extent."""

from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, Resampling
from rasterio.transform import Affine, array_bounds
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform_bounds

from twin.core.georeference import Georeference
from twin.core.records import Image
from twin.core.user_files import open_raster
from twin.errors import TwinError
from twin.terrains.file_header import ORTHOPHOTO_FIELD, check_count, eight_bits

Bounds = tuple[float, float, float, float]  #: west, south, east, north in a CRS

_FORMATS = "GeoTIFF with one grey band, or three of colour, of 8 or 16 bits; an alpha band or mask is respected"
_NO_PALETTE = "a GeoTIFF with bands of colour: gdal_translate -expand rgb writes one"
_COLOURS = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
_MOST_SAMPLED = 2048  #: rows and columns of an orthophoto from which its greatest value is found
_MAX_SHARP = 16  #: a very large orthophoto may be this many times finer than the texels along each axis, no more


def lay_orthophoto(
    texture: Image, file: Path, extent_m: tuple[float, float], georeference: Georeference | None
) -> NDArray[np.bool_]:
    """Replaces the texture of a floor by an orthophoto where it has valid pixels; returns whether it covers each texel.

    It is transformed to the CRS of the DEM; without a CRS, it is taken to be in that one. If more than 1.5 of its
    pixels fit along the side of a texel, they are averaged over the texel, else interpolated. The texture (rows, cols,
    3), row 0 = north, is changed in place; the centre of its extent along x and y is the origin of the scene.

    Raises TwinError if the DEM has no coordinates (`georeference` None), or no CRS although the orthophoto has one; or
    the orthophoto is missing, invalid or too large, has no coordinates, or does not overlap the DEM.
    """
    if georeference is None:
        raise _error(file, "cannot be placed: the DEM has no coordinates",
                     "terrain.texture_file, or a GeoTIFF with coordinates as terrain.height_file")  # fmt: skip
    rows, cols = texture.shape[:2]
    west, north = georeference.from_scene(-extent_m[0] / 2, extent_m[1] / 2)
    width, height = (
        extent / georeference.metres_per_unit / n for extent, n in zip(extent_m, (cols, rows), strict=True)
    )
    grid = Affine(width, 0.0, float(west), 0.0, -height, float(north))  # easting and northing of (column, row)
    with open_raster(file, ORTHOPHOTO_FIELD, _FORMATS) as source:
        if source.transform.is_identity:
            raise _error(file, "has no coordinates",
                         "a GeoTIFF with coordinates; terrain.texture_file for a plain image")  # fmt: skip
        colour, covered = _read(source, file, grid, (rows, cols), georeference)
    texture[covered] = colour[covered]
    return covered


def _error(file: Path, problem: str, allowed: str) -> TwinError:
    return TwinError(ORTHOPHOTO_FIELD, f"{file.name!r} {problem}", allowed)


def _read(
    source: rasterio.DatasetReader, file: Path, grid: Affine, shape: tuple[int, int], georeference: Georeference
) -> tuple[Image, NDArray[np.bool_]]:
    bands = _colour_bands(source, file)
    floor_crs = CRS.from_wkt(georeference.crs_wkt) if georeference.crs_wkt else None
    if source.crs is not None and floor_crs is None:
        name = source.crs.to_string() if source.crs.to_epsg() else "a CRS of its own"
        raise _error(file, f"is in {name}, but the DEM names no CRS",
                     "a DEM with a CRS, or an orthophoto without one in the coordinates of the DEM")  # fmt: skip
    target = floor_crs or CRS.from_epsg(3857)  # without any CRS: both are taken to be in this one
    bounds = _bounds(source, target)
    _check_overlap(file, bounds, array_bounds(*shape, grid))
    finer = grid.a / ((bounds[2] - bounds[0]) / source.width)  # pixels along the side of a texel
    if finer > _MAX_SHARP:
        check_count(source.width, source.height, file, ORTHOPHOTO_FIELD)
    with WarpedVRT(
        source, src_crs=source.crs or target, crs=target, transform=grid, width=shape[1], height=shape[0],
        resampling=Resampling.average if finer > 1.5 else Resampling.bilinear,
        add_alpha=ColorInterp.alpha not in source.colorinterp,
    ) as warped:  # fmt: skip
        values, covered = warped.read(bands), warped.dataset_mask() > 0
    if values.dtype == np.uint16:
        values = eight_bits(values, _brightest(source, bands))
    colour = np.moveaxis(values.astype(np.uint8), 0, 2)
    return np.ascontiguousarray(np.broadcast_to(colour, (*shape, 3))), covered


def _brightest(source: rasterio.DatasetReader, bands: list[int]) -> int:
    """Returns the greatest value by the stated bits (NBITS), else the 99.9th percentile of a sample (bad pixels)."""
    if bits := source.tags(bands[0], ns="IMAGE_STRUCTURE").get("NBITS"):
        return 2 ** int(bits) - 1
    shape = (len(bands), min(source.height, _MOST_SAMPLED), min(source.width, _MOST_SAMPLED))
    values = source.read(bands, out_shape=shape, masked=True).compressed()  # without nodata
    return int(np.percentile(values, 99.9)) if values.size else 0


def _colour_bands(source: rasterio.DatasetReader, file: Path) -> list[int]:
    """Returns the number of the grey band, or those of red, green and blue (in file order if not marked), from 1."""
    if ColorInterp.palette in source.colorinterp:
        raise _error(file, "has a palette in place of colours", _NO_PALETTE)
    kind_of = {k: interp for k, interp in enumerate(source.colorinterp, 1) if interp != ColorInterp.alpha}
    kinds = {source.dtypes[k - 1] for k in kind_of}
    if not kinds <= {"uint8", "uint16"} or len(kinds) != 1 or len(kind_of) not in (1, 3):
        found = f"{source.count} band(s) of {', '.join(sorted(set(source.dtypes)))}"
        raise _error(file, f"is not an orthophoto: {found}", _FORMATS)
    if set(kind_of.values()) == set(_COLOURS):
        return sorted(kind_of, key=lambda k: _COLOURS.index(kind_of[k]))
    return list(kind_of)


def _check_overlap(file: Path, bounds: Bounds, floor: Bounds) -> None:
    west, south, east, north = bounds
    if not (west < floor[2] and east > floor[0] and south < floor[3] and north > floor[1]):
        raise _error(
            file, f"does not overlap the DEM: it covers E {west:.1f} to {east:.1f}, N {south:.1f} to {north:.1f}",
            f"one that overlaps E {floor[0]:.1f} to {floor[2]:.1f}, N {floor[1]:.1f} to {floor[3]:.1f}",
        )  # fmt: skip


def _bounds(source: rasterio.DatasetReader, target: CRS) -> Bounds:
    """Returns west, south, east and north of an orthophoto in the target CRS; its rows may run either way."""
    left, bottom, right, top = source.bounds
    west, east = sorted((left, right))
    south, north = sorted((bottom, top))
    return transform_bounds(source.crs or target, target, west, south, east, north)
