"""Terrains from files: heights from GeoTIFF, 16-bit PNG or .npy, texture from a photo or an orthophoto."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.core.user_files import MOST_IMAGE_BYTES, read_bytes, reading
from twin.errors import TwinError
from twin.terrains.file_header import HEIGHT_FIELD, HEIGHT_FORMATS, check_height_count, image_size
from twin.terrains.ground_cover import DEFAULT_COVERS
from twin.terrains.holes import check_no_undeclared_holes, fill_holes, known_nodes
from twin.terrains.terrain import Terrain, texture_shape
from twin.terrains.textures import TextureSource, generate_texture, texture_from_photo
from twin.terrains.vertical import Direction, VerticalAxis, upward_sign
from twin.terrains.wall_texture import walls_of

_MOST_HEIGHT_M = 20_000.0


class HeightGrid(NamedTuple):
    """Heights as read from a file.

    Args:
        values: (ny, nx) elevations or depths in the unit of `axis`, row 0 = north, not finite in holes.
        spacing_m: grid spacing [m].
        axis: vertical axis as the file describes it.
        georeference: position of the centre of the raster in its CRS, at the elevation 0; None if the file has no
            coordinates.
    """

    values: NDArray[np.float64]
    spacing_m: float
    axis: VerticalAxis
    georeference: Georeference | None = None


def load(
    height_file: str | Path,
    texture: TextureSource,
    height_spacing_m: float,
    height_range_m: float,
    seed: int | np.random.SeedSequence,
    z: Direction | None = None,
) -> Terrain:
    """Reads a terrain, fills its holes, centres it at the origin and moves its lowest point to z = 0.

    Args:
        height_file: file of heights, row 0 = north. A height belongs to the centre of its raster cell, so the terrain
            is one cell smaller than the raster in both directions.
        height_spacing_m: grid spacing if the file does not contain one (PNG, .npy, TIFF without georeference).
        height_range_m: height difference between white and black in a PNG.
        seed: seed of the texture if it is generated.
        z: direction in which the values of the file increase; None: determined from the file.
    Raises:
        TwinError: a file is missing, invalid or too large, the direction of the heights is not clear, or the cover is
            unknown.
    """
    read = read_heights(Path(height_file), height_spacing_m, height_range_m)
    upward_m = upward_sign(read.values, read.axis, z, Path(height_file)) * read.axis.metres_per_unit
    values = read.values[::-1] * upward_m
    (raw, n_filled), known = fill_holes(values), known_nodes(np.isfinite(values))
    _check_plausible(raw, Path(height_file))
    lowest_m, spacing_m = raw.min(), read.spacing_m
    height_m = (raw - lowest_m).astype(np.float32)
    georeference = read.georeference and replace(read.georeference, elevation_m=float(lowest_m))
    ny, nx = height_m.shape
    extent_m = ((nx - 1) * spacing_m, (ny - 1) * spacing_m)
    shape = texture_shape((ny, nx), spacing_m, texture.texel_m(extent_m) if texture.in_images else spacing_m)
    texel_m = extent_m[0] / shape[1]
    cover, rng = texture.cover or DEFAULT_COVERS["file"], np.random.default_rng(seed)
    if texture.photo_file is not None:
        texels = texture_from_photo(texture, shape, extent_m)
    else:
        texels = generate_texture(cover, height_m, shape, texel_m, rng)
    covered = None
    if texture.orthophoto_file is not None:
        # imported here: rasterio takes 20 MB of memory, and most terrains do not need it
        from twin.terrains.orthophoto import lay_orthophoto

        covered = lay_orthophoto(texels, Path(texture.orthophoto_file), extent_m, georeference)
    walls = walls_of(height_m, spacing_m, texture, cover, texel_m, rng, covered)
    share = None if covered is None else float(covered.mean())
    west_m, south_m = -extent_m[0] / 2, -extent_m[1] / 2
    return Terrain(height_m, spacing_m, west_m, south_m, texels, texel_m, n_filled, georeference, share, walls, known)


def read_heights(file: Path, height_spacing_m: float, height_range_m: float) -> HeightGrid:
    """Reads the heights of a file. Checks their number in the header before it reads them.

    Args:
        file: GeoTIFF, 16-bit PNG or .npy.
        height_spacing_m: grid spacing if the file does not contain one.
        height_range_m: height difference between white and black in a PNG.
    Raises:
        TwinError: the file is missing, cannot be read, contains no heights or no finite one, has a single row or
            column or more than MAX_NODES heights, or its grid or unit is not supported.
    """
    suffix = file.suffix.lower()
    named = VerticalAxis(texts=(file.stem,))
    if suffix in (".tif", ".tiff"):
        # imported here: rasterio takes 20 MB of memory, and most terrains do not need it
        from twin.terrains.geotiff import read_geotiff

        grid = HeightGrid(*read_geotiff(file, height_spacing_m))
    elif suffix == ".png":
        grid = HeightGrid(_read_png(file) * height_range_m, height_spacing_m, named._replace(band_name="height"))
    elif suffix == ".npy":
        grid = HeightGrid(_read_npy(file), height_spacing_m, named)
        check_no_undeclared_holes(grid.values, file, "NaN in place of {}")
    else:
        raise TwinError(HEIGHT_FIELD, f"{file.name!r} is not a height file", HEIGHT_FORMATS)
    _check(grid.values, file)
    return grid


def _check_plausible(height_m: NDArray[np.float64], file: Path) -> None:
    """Raises TwinError if a height is larger than any on Earth, with a margin."""
    if (most_m := float(np.abs(height_m).max())) > _MOST_HEIGHT_M:
        allowed = f"heights within {_MOST_HEIGHT_M:g} m of zero"
        raise TwinError(HEIGHT_FIELD, f"{file.name!r} has a height of {most_m:g} m", allowed)


def _read_png(file: Path) -> NDArray[np.float64]:
    """Reads the heights of a 16-bit PNG as fractions of the height range, 0 to 1."""
    check_height_count(*image_size(file, HEIGHT_FIELD, HEIGHT_FORMATS), file)
    data = read_bytes(file, HEIGHT_FIELD, HEIGHT_FORMATS, MOST_IMAGE_BYTES)
    with reading(file, HEIGHT_FIELD, HEIGHT_FORMATS):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise TwinError(HEIGHT_FIELD, f"{file.name!r} cannot be read as PNG", HEIGHT_FORMATS)
    if image.ndim != 2 or image.dtype != np.uint16:
        kind = f"{8 * image.dtype.itemsize}-bit, {1 if image.ndim == 2 else image.shape[2]} channel(s)"
        raise TwinError(HEIGHT_FIELD, f"{file.name!r} is an image, not heights: {kind}", HEIGHT_FORMATS)
    return image.astype(np.float64) / 65535.0


def _read_npy(file: Path) -> NDArray[np.float64]:
    """Reads the heights (rows, cols) of a .npy file [m]."""
    with reading(file, HEIGHT_FIELD, HEIGHT_FORMATS):
        array = np.load(file, mmap_mode="r", allow_pickle=False)  # only the header is read
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu" or array.dtype == np.uint8:
        shape = getattr(array, "shape", "no array")
        problem = f"{file.name!r} contains no heights: {shape} of {getattr(array, 'dtype', '?')}"
        raise TwinError(HEIGHT_FIELD, problem, HEIGHT_FORMATS)
    check_height_count(array.shape[1], array.shape[0], file)
    return array.astype(np.float64)


def _check(height_m: NDArray[np.float64], file: Path) -> None:
    """Raises TwinError if there are fewer than 2 x 2 heights, or none is finite."""
    rows, cols = height_m.shape
    if rows < 2 or cols < 2:
        raise TwinError(HEIGHT_FIELD, f"{file.name!r} has {rows} row(s) and {cols} column(s)", "at least 2 x 2 heights")
    if not np.isfinite(height_m).any():
        raise TwinError(
            HEIGHT_FIELD, f"{file.name!r} has no valid height (all NaN or nodata)", "one valid height or more"
        )
