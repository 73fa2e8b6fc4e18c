"""Texture from an orthophoto: a GeoTIFF with its own coordinate reference system (CRS), resolution and extent."""

from __future__ import annotations

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
from twin.core.raster_files import open_raster
from twin.errors import TwinError
from twin.terrains.file_header import ORTHOPHOTO_FIELD, check_texel_count, eight_bits

_FORMATS = "GeoTIFF with one grey band, or three of colour, of 8 or 16 bits; an alpha band or mask is respected"
_NO_PALETTE = "a GeoTIFF with bands of colour: gdal_translate -expand rgb writes one"
_COLOURS = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
_MOST_SAMPLED = 2048  #: rows and columns of an orthophoto from which its greatest value is found
_MAX_SHARP = 16  #: a very large orthophoto may be this many times finer than the texels along each axis, no more


def lay_orthophoto(
    texture: NDArray[np.uint8], file: Path, extent_m: tuple[float, float], georeference: Georeference | None
) -> NDArray[np.bool_]:
    """Replaces the texture of a floor by an orthophoto wherever the orthophoto has valid pixels.

    The orthophoto is transformed to the CRS of the DEM. An orthophoto without a CRS is taken to be in that of the DEM.
    If more than 1.5 of its pixels fit along the side of a texel, they are averaged over the texel, else interpolated.

    Args:
        texture: (rows, cols, 3) uint8 RGB, row 0 = north, changed in place.
        extent_m: extent of the floor along x and y; its centre is the origin of the scene.
        georeference: position of the scene in the CRS of the DEM; None if the DEM has no coordinates.
    Returns:
        Whether the orthophoto covers each texel (rows, cols).
    Raises:
        TwinError: the DEM has no coordinates, or no CRS although the orthophoto has one; or the orthophoto is missing,
            invalid or too large, has no coordinates, or does not overlap the DEM.
    """
    if georeference is None:
        raise TwinError(ORTHOPHOTO_FIELD, f"{file.name!r} cannot be placed: the DEM has no coordinates",
                        "terrain.texture_file, or a GeoTIFF with coordinates as terrain.height_file")  # fmt: skip
    grid = _texel_grid(texture.shape[:2], extent_m, georeference)
    with open_raster(file, ORTHOPHOTO_FIELD, _FORMATS) as source:
        if source.transform.is_identity:
            raise TwinError(ORTHOPHOTO_FIELD, f"{file.name!r} has no coordinates",
                            "a GeoTIFF with coordinates; terrain.texture_file for a plain image")  # fmt: skip
        colour, covered = _read(source, file, grid, texture.shape[:2], georeference)
    texture[covered] = colour[covered]
    return covered


def _texel_grid(shape: tuple[int, ...], extent_m: tuple[float, float], georeference: Georeference) -> Affine:
    """Returns the affine transformation from (column, row) of the texture to easting and northing in the CRS."""
    west, north = georeference.from_scene(-extent_m[0] / 2, extent_m[1] / 2)
    unit_m = georeference.metres_per_unit
    width, height = extent_m[0] / unit_m / shape[1], extent_m[1] / unit_m / shape[0]
    return Affine(width, 0.0, float(west), 0.0, -height, float(north))


def _read(
    source: rasterio.DatasetReader,
    file: Path,
    grid: Affine,
    shape: tuple[int, ...],
    georeference: Georeference,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Returns the colours (rows, cols, 3) of an orthophoto at the texels, and whether it covers each texel."""
    bands = _colour_bands(source, file)
    floor_crs = CRS.from_wkt(georeference.crs_wkt) if georeference.crs_wkt else None
    if source.crs is not None and floor_crs is None:
        raise TwinError(ORTHOPHOTO_FIELD, f"{file.name!r} is in {_name(source.crs)}, but the DEM names no CRS",
                        "a DEM with a CRS, or an orthophoto without one in the coordinates of the DEM")  # fmt: skip
    target = floor_crs or CRS.from_epsg(3857)  # without any CRS: both are taken to be in this one
    _check_overlap(source, file, target, array_bounds(shape[0], shape[1], grid))
    _check_resolution(source, file, target, grid)
    with WarpedVRT(
        source, src_crs=source.crs or target, crs=target, transform=grid, width=shape[1], height=shape[0],
        resampling=Resampling.average if _finer(source, target, grid) > 1.5 else Resampling.bilinear,
        add_alpha=ColorInterp.alpha not in source.colorinterp,
    ) as warped:  # fmt: skip
        values = warped.read(bands)
        covered = warped.dataset_mask() > 0
    if values.dtype == np.uint16:
        values = eight_bits(values, _brightest(source, bands))
    colour = np.moveaxis(values.astype(np.uint8), 0, 2)
    return np.ascontiguousarray(np.broadcast_to(colour, (*shape, 3))), covered


def _brightest(source: rasterio.DatasetReader, bands: list[int]) -> int:
    """Returns the greatest value of an orthophoto: that of the bits that the file states (NBITS), else of a sample."""
    if bits := source.tags(bands[0], ns="IMAGE_STRUCTURE").get("NBITS"):
        return 2 ** int(bits) - 1
    shape = (len(bands), min(source.height, _MOST_SAMPLED), min(source.width, _MOST_SAMPLED))
    return int(source.read(bands, out_shape=shape).max())


def _colour_bands(source: rasterio.DatasetReader, file: Path) -> list[int]:
    """Returns the number of the grey band, or the numbers of the bands of red, green and blue, from 1.

    Three bands that are not marked as red, green and blue are taken to be red, green and blue in the order of the file.
    """
    if ColorInterp.palette in source.colorinterp:
        raise TwinError(ORTHOPHOTO_FIELD, f"{file.name!r} has a palette in place of colours", _NO_PALETTE)
    kind_of = {k: interp for k, interp in enumerate(source.colorinterp, 1) if interp != ColorInterp.alpha}
    kinds = {source.dtypes[k - 1] for k in kind_of}
    if not kinds <= {"uint8", "uint16"} or len(kinds) != 1 or len(kind_of) not in (1, 3):
        found = f"{source.count} band(s) of {', '.join(sorted(set(source.dtypes)))}"
        raise TwinError(ORTHOPHOTO_FIELD, f"{file.name!r} is not an orthophoto: {found}", _FORMATS)
    if set(kind_of.values()) == set(_COLOURS):
        return sorted(kind_of, key=lambda k: _COLOURS.index(kind_of[k]))
    return list(kind_of)


def _check_overlap(
    source: rasterio.DatasetReader, file: Path, target: CRS, floor: tuple[float, float, float, float]
) -> None:
    """Raises TwinError if an orthophoto does not overlap the floor (west, south, east, north) in the target CRS."""
    west, south, east, north = _bounds(source, target)
    if west < floor[2] and east > floor[0] and south < floor[3] and north > floor[1]:
        return
    raise TwinError(
        ORTHOPHOTO_FIELD,
        f"{file.name!r} does not overlap the DEM: it covers E {west:.1f} to {east:.1f}, N {south:.1f} to {north:.1f}",
        f"one that overlaps E {floor[0]:.1f} to {floor[2]:.1f}, N {floor[1]:.1f} to {floor[3]:.1f}",
    )


def _check_resolution(source: rasterio.DatasetReader, file: Path, target: CRS, grid: Affine) -> None:
    """Raises TwinError if an orthophoto has too many pixels and is over _MAX_SHARP times finer than the texels."""
    if _finer(source, target, grid) > _MAX_SHARP:
        check_texel_count(source.width, source.height, file, ORTHOPHOTO_FIELD)


def _finer(source: rasterio.DatasetReader, target: CRS, grid: Affine) -> float:
    """Returns the number of pixels of an orthophoto along the side of one texel."""
    west, _, east, _ = _bounds(source, target)
    return grid.a / ((east - west) / source.width)


def _bounds(source: rasterio.DatasetReader, target: CRS) -> tuple[float, float, float, float]:
    """Returns west, south, east and north of an orthophoto in the target CRS; its rows may run either way."""
    left, bottom, right, top = source.bounds
    west, east = sorted((left, right))
    south, north = sorted((bottom, top))
    return transform_bounds(source.crs or target, target, west, south, east, north)


def _name(crs: CRS) -> str:
    """Returns the EPSG code of a CRS, e.g. "EPSG:32755"; "a CRS of its own" if it has none."""
    return crs.to_string() if crs.to_epsg() else "a CRS of its own"
