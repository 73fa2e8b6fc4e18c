"""Real floors: heights from GeoTIFF, 16-bit PNG or .npy, texture from any image."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from terrains.terrain import Terrain, TerrainFault, texture_shape
from terrains.textures import paint, read_image, tile

if TYPE_CHECKING:
    import rasterio

FIELD = "terrain.height_file"
ALLOWED = "GeoTIFF (.tif, .tiff), 16-bit PNG or .npy with one height a cell"


def load(
    height_file: str | Path,
    texture_file: str | Path | None,
    texture_px_m: float,
    height_spacing_m: float,
    height_range_m: float,
    seed: int | np.random.SeedSequence,
) -> Terrain:
    """A real floor, centred at the origin, its lowest point at z = 0, its holes filled and counted.

    Args:
        height_file: heights, row 0 = north. A height belongs to its cell's centre, so the floor is a cell smaller than
            the raster.
        texture_file: an image tiled at texture_px_m; None: generated.
        height_spacing_m: grid spacing where the file does not tell it (PNG, .npy, TIFF without georeference).
        height_range_m: height of a PNG's full white over full black.
    Raises:
        TerrainFault: what is wrong with which file.
    """
    raw, spacing_m = read_heights(Path(height_file), height_spacing_m, height_range_m)
    height_m, n_filled = fill_holes(raw[::-1])
    height_m = (height_m - height_m.min()).astype(np.float32)
    ny, nx = height_m.shape
    extent_m = ((nx - 1) * spacing_m, (ny - 1) * spacing_m)
    shape = texture_shape((ny, nx), spacing_m, texture_px_m)
    texel_m = extent_m[0] / shape[1]
    if texture_file is not None:
        texture = tile(read_image(Path(texture_file)), texture_px_m, shape, extent_m)
    else:
        texture = paint("file", height_m, shape, texel_m, np.random.default_rng(seed))
    return Terrain(height_m, spacing_m, -extent_m[0] / 2, -extent_m[1] / 2, texture, texel_m, n_filled)


def read_heights(file: Path, height_spacing_m: float, height_range_m: float) -> tuple[NDArray[np.float64], float]:
    """Heights (ny, nx) [m], row 0 = north, NaN in holes, and their spacing [m].

    Raises:
        TerrainFault: unreadable, an image, all NaN, a single row or column.
    """
    if not file.is_file():
        raise TerrainFault(FIELD, f"no such file {str(file)!r}", ALLOWED)
    suffix = file.suffix.lower()
    if suffix in (".tif", ".tiff"):
        heights, spacing_m = _read_tiff(file, height_spacing_m)
    elif suffix == ".png":
        heights, spacing_m = _read_png(file) * height_range_m, height_spacing_m
    elif suffix == ".npy":
        heights, spacing_m = _read_npy(file), height_spacing_m
    else:
        raise TerrainFault(FIELD, f"{file.name!r} is not a height file", ALLOWED)
    _check(heights, file)
    return heights, spacing_m


def fill_holes(height_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """Every NaN replaced by its nearest height; how many there were."""
    holes = ~np.isfinite(height_m)
    if not holes.any():
        return height_m, 0
    from scipy import ndimage  # here: it takes 0.1 s, and most floors are whole

    nearest = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    assert nearest is not None
    return height_m[tuple(nearest)], int(holes.sum())


def _read_tiff(file: Path, height_spacing_m: float) -> tuple[NDArray[np.float64], float]:
    import rasterio  # here: most floors need none of its 20 MB
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings(), rasterio.open(file) as source:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            if source.count != 1 or source.dtypes[0] in ("uint8", "int8"):
                bands = f"{source.count} band(s) of {source.dtypes[0]}"
                raise TerrainFault(FIELD, f"{file.name!r} is an image, not heights: {bands}", ALLOWED)
            spacing_m = _spacing(source, height_spacing_m, file)
            band = source.read(1, masked=True)
    except (RasterioError, OSError) as error:
        raise TerrainFault(FIELD, f"{file.name!r} cannot be read: {error}", ALLOWED) from error
    return np.ma.filled(band.astype(np.float64), np.nan), spacing_m


def _spacing(source: rasterio.DatasetReader, height_spacing_m: float, file: Path) -> float:
    """The grid spacing of a GeoTIFF [m], which must be metric, north up and square."""
    t = source.transform
    if t.is_identity:
        return height_spacing_m
    if source.crs is not None and source.crs.is_geographic:
        raise TerrainFault(FIELD, f"{file.name!r} is in degrees", "a projected or local grid in metres")
    if t.b != 0 or t.d != 0 or t.a <= 0 or t.e >= 0 or abs(t.a + t.e) > 1e-3 * t.a:
        raise TerrainFault(FIELD, f"{file.name!r} is turned, or its cells are not square", "north up, square cells")
    factor = source.crs.linear_units_factor[1] if source.crs is not None and source.crs.is_projected else 1.0
    return float(t.a * factor)


def _read_png(file: Path) -> NDArray[np.float64]:
    """Heights as shares of the range, 0 to 1."""
    content = np.fromfile(file, np.uint8)
    image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if image is None:
        raise TerrainFault(FIELD, f"{file.name!r} cannot be read as PNG", ALLOWED)
    if image.ndim != 2 or image.dtype != np.uint16:
        kind = f"{8 * image.dtype.itemsize}-bit, {1 if image.ndim == 2 else image.shape[2]} channel(s)"
        raise TerrainFault(FIELD, f"{file.name!r} is an image, not heights: {kind}", ALLOWED)
    return image.astype(np.float64) / 65535.0


def _read_npy(file: Path) -> NDArray[np.float64]:
    try:
        array = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise TerrainFault(FIELD, f"{file.name!r} cannot be read: {error}", ALLOWED) from error
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu" or array.dtype == np.uint8:
        shape = getattr(array, "shape", "no array")
        raise TerrainFault(FIELD, f"{file.name!r} holds no heights: {shape} of {getattr(array, 'dtype', '?')}", ALLOWED)
    return array.astype(np.float64)


def _check(height_m: NDArray[np.float64], file: Path) -> None:
    rows, cols = height_m.shape
    if rows < 2 or cols < 2:
        raise TerrainFault(FIELD, f"{file.name!r} has {rows} row(s) and {cols} column(s)", "at least 2 x 2 heights")
    if not np.isfinite(height_m).any():
        raise TerrainFault(FIELD, f"{file.name!r} has no height at all (all NaN or nodata)", "at least one height")
