"""Terrains from files: heights from GeoTIFF, 16-bit PNG or .npy, texture from any image."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from terrains.terrain import Terrain, texture_shape
from terrains.textures import generate_texture, read_image, tile_image
from twin.errors import TwinError

if TYPE_CHECKING:
    import rasterio

FIELD = "terrain.height_file"
ALLOWED = "GeoTIFF (.tif, .tiff), 16-bit PNG or .npy with one height per cell"


def load(
    height_file: str | Path,
    texture_file: str | Path | None,
    texture_px_m: float,
    height_spacing_m: float,
    height_range_m: float,
    seed: int | np.random.SeedSequence,
) -> Terrain:
    """Reads a terrain, fills its holes, centres it at the origin and moves its lowest point to z = 0.

    Args:
        height_file: heights, row 0 = north. A height belongs to the centre of its raster cell, so the terrain is one
            cell smaller than the raster in both directions.
        texture_file: image that is repeated as tiles; None: the texture is generated.
        texture_px_m: side of a texel, and of a pixel of the texture image on the floor.
        height_spacing_m: grid spacing if the file does not contain one (PNG, .npy, TIFF without georeference).
        height_range_m: height difference between white and black in a PNG.
        seed: seed of the texture if it is generated.
    Raises:
        TwinError: a file is missing or invalid.
    """
    raw, spacing_m = read_heights(Path(height_file), height_spacing_m, height_range_m)
    height_m, n_filled = fill_holes(raw[::-1])
    height_m = (height_m - height_m.min()).astype(np.float32)
    ny, nx = height_m.shape
    extent_m = ((nx - 1) * spacing_m, (ny - 1) * spacing_m)
    shape = texture_shape((ny, nx), spacing_m, texture_px_m)
    texel_m = extent_m[0] / shape[1]
    if texture_file is not None:
        texture = tile_image(read_image(Path(texture_file)), texture_px_m, shape, extent_m)
    else:
        texture = generate_texture("file", height_m, shape, texel_m, np.random.default_rng(seed))
    return Terrain(height_m, spacing_m, -extent_m[0] / 2, -extent_m[1] / 2, texture, texel_m, n_filled)


def read_heights(file: Path, height_spacing_m: float, height_range_m: float) -> tuple[NDArray[np.float64], float]:
    """Returns the heights (ny, nx) of a file [m], row 0 = north, NaN in holes, and their grid spacing [m].

    Args:
        file: GeoTIFF, 16-bit PNG or .npy.
        height_spacing_m: grid spacing if the file does not contain one.
        height_range_m: height difference between white and black in a PNG.
    Raises:
        TwinError: the file cannot be read, does not contain heights, is all NaN, or has a single row or column.
    """
    if not file.is_file():
        raise TwinError(FIELD, f"no such file {str(file)!r}", ALLOWED)
    suffix = file.suffix.lower()
    if suffix in (".tif", ".tiff"):
        heights, spacing_m = _read_tiff(file, height_spacing_m)
    elif suffix == ".png":
        heights, spacing_m = _read_png(file) * height_range_m, height_spacing_m
    elif suffix == ".npy":
        heights, spacing_m = _read_npy(file), height_spacing_m
    else:
        raise TwinError(FIELD, f"{file.name!r} is not a height file", ALLOWED)
    _check(heights, file)
    return heights, spacing_m


def fill_holes(height_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """Replaces NaN and infinite values by the nearest height; returns the heights and the number of replaced values."""
    holes = ~np.isfinite(height_m)
    if not holes.any():
        return height_m, 0
    from scipy import ndimage  # imported here: it takes 0.1 s, and most terrains have no holes

    nearest = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    assert nearest is not None
    return height_m[tuple(nearest)], int(holes.sum())


def _read_tiff(file: Path, height_spacing_m: float) -> tuple[NDArray[np.float64], float]:
    """Returns the heights of a GeoTIFF, NaN where it has no data, and their grid spacing [m]."""
    import rasterio  # imported here: it takes 20 MB, and most terrains do not need it
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings(), rasterio.open(file) as source:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            if source.count != 1 or source.dtypes[0] in ("uint8", "int8"):
                bands = f"{source.count} band(s) of {source.dtypes[0]}"
                raise TwinError(FIELD, f"{file.name!r} is an image, not heights: {bands}", ALLOWED)
            spacing_m = _spacing(source, height_spacing_m, file)
            band = source.read(1, masked=True)
    except (RasterioError, OSError) as error:
        raise TwinError(FIELD, f"{file.name!r} cannot be read: {error}", ALLOWED) from error
    return np.ma.filled(band.astype(np.float64), np.nan), spacing_m


def _spacing(source: rasterio.DatasetReader, height_spacing_m: float, file: Path) -> float:
    """Returns the grid spacing of a GeoTIFF [m].

    Raises:
        TwinError: the grid is in degrees, is not north up, or its cells are not square.
    """
    t = source.transform
    if t.is_identity:
        return height_spacing_m
    if source.crs is not None and source.crs.is_geographic:
        raise TwinError(FIELD, f"{file.name!r} is in degrees", "a projected or local grid in metres")
    if t.b != 0 or t.d != 0 or t.a <= 0 or t.e >= 0 or abs(t.a + t.e) > 1e-3 * t.a:
        raise TwinError(FIELD, f"{file.name!r} is rotated, or its cells are not square", "north up, square cells")
    factor = source.crs.linear_units_factor[1] if source.crs is not None and source.crs.is_projected else 1.0
    return float(t.a * factor)


def _read_png(file: Path) -> NDArray[np.float64]:
    """Reads the heights of a 16-bit PNG as fractions of the height range, 0 to 1."""
    content = np.fromfile(file, np.uint8)
    image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if image is None:
        raise TwinError(FIELD, f"{file.name!r} cannot be read as PNG", ALLOWED)
    if image.ndim != 2 or image.dtype != np.uint16:
        kind = f"{8 * image.dtype.itemsize}-bit, {1 if image.ndim == 2 else image.shape[2]} channel(s)"
        raise TwinError(FIELD, f"{file.name!r} is an image, not heights: {kind}", ALLOWED)
    return image.astype(np.float64) / 65535.0


def _read_npy(file: Path) -> NDArray[np.float64]:
    """Reads the heights of a .npy file [m]."""
    try:
        array = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise TwinError(FIELD, f"{file.name!r} cannot be read: {error}", ALLOWED) from error
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu" or array.dtype == np.uint8:
        shape = getattr(array, "shape", "no array")
        raise TwinError(FIELD, f"{file.name!r} contains no heights: {shape} of {getattr(array, 'dtype', '?')}", ALLOWED)
    return array.astype(np.float64)


def _check(height_m: NDArray[np.float64], file: Path) -> None:
    """Raises TwinError if there are fewer than 2 x 2 heights, or none is finite."""
    rows, cols = height_m.shape
    if rows < 2 or cols < 2:
        raise TwinError(FIELD, f"{file.name!r} has {rows} row(s) and {cols} column(s)", "at least 2 x 2 heights")
    if not np.isfinite(height_m).any():
        raise TwinError(FIELD, f"{file.name!r} has no valid height (all NaN or nodata)", "at least one valid height")
