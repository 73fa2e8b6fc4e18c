"""Terrains from files: heights from GeoTIFF, 16-bit PNG or .npy, texture from a photo or an orthophoto."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.core.user_files import reading
from twin.terrains.file_header import HEIGHT_FIELD, HEIGHT_FORMATS, check_count, decoded, height_error
from twin.terrains.ground_cover import DEFAULT_COVERS
from twin.terrains.holes import check_no_undeclared_holes, fill_holes, known_nodes
from twin.terrains.terrain import Terrain, texture_shape
from twin.terrains.textures import TextureSource, generate_texture, texture_from_photo
from twin.terrains.vertical_axis import Direction, VerticalAxis, upward_sign
from twin.terrains.walls import walls_of

Heights = NDArray[np.float64]

_MOST_HEIGHT_M = 20_000.0


def load(
    height_file: str | Path, texture: TextureSource, height_spacing_m: float, height_range_m: float,
    seed: int | np.random.SeedSequence, z: Direction | None = None,
) -> Terrain:  # fmt: skip
    """Reads a terrain, fills its holes, centres it at the origin and moves its lowest point to z = 0.

    Args:
        height_file: file of heights, row 0 = north. A height belongs to the centre of its raster cell, so the terrain
            is one cell smaller than the raster in both directions.
        height_spacing_m: grid spacing if the file does not contain one (PNG, .npy, TIFF without georeference).
        height_range_m: height difference between white and black in a PNG.
        seed: seed of the texture if it is generated.
        z: direction in which the values of the file increase; None: determined from the file.
    Raises:
        TwinError: a file is missing, invalid or too large, the direction of heights unclear, or the cover unknown.
    """
    file = Path(height_file)
    given, spacing_m, axis, georeference = _read_heights(file, height_spacing_m, height_range_m)
    _check(given, file)
    upward_m = upward_sign(given, axis, z, file) * axis.metres_per_unit
    values = given[::-1] * upward_m
    has_height = np.isfinite(values)
    raw, known = fill_holes(values), known_nodes(has_height)
    if (most_m := float(np.abs(raw).max())) > _MOST_HEIGHT_M:  # larger than any on Earth
        raise height_error(file, f"has a height of {most_m:g} m", f"heights within {_MOST_HEIGHT_M:g} m of zero")
    lowest_m = raw.min()
    height_m = (raw - lowest_m).astype(np.float32)
    georeference = georeference and replace(georeference, elevation_m=float(lowest_m))
    ny, nx = height_m.shape
    extent_m = ((nx - 1) * spacing_m, (ny - 1) * spacing_m)
    shape = texture_shape((ny, nx), spacing_m, texture.texel_m(extent_m) if texture.in_images else spacing_m)
    texel_m = extent_m[0] / shape[1]
    cover, rng = texture.cover or DEFAULT_COVERS["file"], np.random.default_rng(seed)
    if texture.photo_file is not None:
        texels = texture_from_photo(texture, shape, extent_m)
    else:
        texels = generate_texture(cover, height_m, shape, texel_m, rng)
    covered = share = None
    if texture.orthophoto_file is not None:
        # imported here: rasterio takes 20 MB of memory, and most terrains do not need it
        from twin.terrains.draped_orthophoto import lay_orthophoto

        covered = lay_orthophoto(texels, Path(texture.orthophoto_file), extent_m, georeference)
        share = float(covered.mean())
    walls = walls_of(height_m, spacing_m, texture, cover, texel_m, rng, covered)
    west_m, south_m = -extent_m[0] / 2, -extent_m[1] / 2
    filled = None if has_height.all() else ~has_height
    return Terrain(height_m, spacing_m, west_m, south_m, texels, texel_m, filled, georeference, share, walls, known)


def _read_heights(
    file: Path, height_spacing_m: float, height_range_m: float
) -> tuple[Heights, float, VerticalAxis, Georeference | None]:
    """Returns what `elevation_model.read_geotiff` returns of a GeoTIFF, of any file of heights."""
    suffix, named = file.suffix.lower(), VerticalAxis(texts=(file.stem,))
    if suffix in (".tif", ".tiff"):
        from twin.terrains.elevation_model import read_geotiff  # imported here: it imports rasterio

        return read_geotiff(file, height_spacing_m)
    if suffix == ".png":
        return _read_png(file) * height_range_m, height_spacing_m, named._replace(band_name="height"), None
    if suffix == ".npy":
        values = _read_npy(file)
        check_no_undeclared_holes(values, file, "NaN in place of {}")
        return values, height_spacing_m, named, None
    raise height_error(file, "is not a height file")


def _read_png(file: Path) -> Heights:
    """Returns the heights of a 16-bit PNG as fractions of the height range."""
    image = decoded(file, HEIGHT_FIELD, HEIGHT_FORMATS, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise height_error(file, "cannot be read as PNG")
    if image.ndim != 2 or image.dtype != np.uint16:
        kind = f"{8 * image.dtype.itemsize}-bit, {1 if image.ndim == 2 else image.shape[2]} channel(s)"
        raise height_error(file, f"is an image, not heights: {kind}")
    return image.astype(np.float64) / 65535.0


def _read_npy(file: Path) -> Heights:
    with reading(file, HEIGHT_FIELD, HEIGHT_FORMATS):
        array = np.load(file, mmap_mode="r", allow_pickle=False)  # only the header is read
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu" or array.dtype == np.uint8:
        shape = getattr(array, "shape", "no array")
        raise height_error(file, f"contains no heights: {shape} of {getattr(array, 'dtype', '?')}")
    check_count(array.shape[1], array.shape[0], file, HEIGHT_FIELD)
    return array.astype(np.float64)


def _check(values: Heights, file: Path) -> None:
    rows, cols = values.shape
    if rows < 2 or cols < 2:
        raise height_error(file, f"has {rows} row(s) and {cols} column(s)", "at least 2 x 2 heights")
    if not np.isfinite(values).any():
        raise height_error(file, "has no valid height (all NaN or nodata)", "one valid height or more")
