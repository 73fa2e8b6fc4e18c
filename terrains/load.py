"""Terrains from files: heights from GeoTIFF, text grids, 16-bit PNG or .npy, texture from a photo or an orthophoto."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.user_files import reading
from twin.terrains.file_header import HEIGHT_FIELD, HEIGHT_FORMATS, check_count, decoded, height_error
from twin.terrains.ground_cover import DEFAULT_COVERS
from twin.terrains.holes import check_no_undeclared_holes, fill_holes, known_nodes
from twin.terrains.terrain import InputStatement, PaintedTexture, Terrain, texture_shape
from twin.terrains.textures import TextureSource, painted_texture, texture_from_photo
from twin.terrains.vertical_axis import Direction, HeightFile, VerticalAxis, direction_of
from twin.terrains.walls import walls_of

Heights = NDArray[np.float64]

_MOST_HEIGHT_M = 20_000.0
_DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".asc": "AAIGrid", ".xyz": "XYZ"}  # drivers of GDAL by suffix
#: Programs that convert files of other formats, which may name further files, or points that have to be gridded.
_POINTS = "pdal translate {} floor.tif --writers.gdal.resolution=CELL_M --writers.gdal.output_type=mean"
_CONVERSIONS = {
    ".nc": "gdal_translate NETCDF:{}:VARIABLE floor.tif", ".bag": "gdal_translate -b 1 {} floor.tif",
    ".las": _POINTS, ".laz": _POINTS,
}  # fmt: skip


def load(
    height_file: str | Path, texture: TextureSource, height_spacing_m: float, height_range_m: float,
    seed: int | np.random.SeedSequence, z: Direction | None = None,
) -> Terrain:  # fmt: skip
    """Reads a terrain, fills its holes, centres it at the origin and moves its lowest point to z = 0.

    A height belongs to the centre of its raster cell, so the terrain is one cell smaller than the raster in both
    directions. `height_spacing_m` is for files without a grid spacing, `height_range_m` between white and black for a
    PNG, and `seed` for a generated texture; without `z`, the direction of the values is determined from the file.
    Raises TwinError if a file is missing, invalid or too large, the direction unclear, or the cover unknown.
    """
    file = Path(height_file)
    given = _read_heights(file, height_spacing_m, height_range_m)
    _check(given.values, file)
    direction, evidence = direction_of(given.values, given.axis, z, file)
    values = given.values[::-1] * given.axis.metres_per_unit * (1.0 if direction == "up" else -1.0)
    has_height, spacing_m, georeference = np.isfinite(values), given.spacing_m, given.georeference
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
    painted = texels = painted_texture(cover, height_m, shape, texel_m, rng)
    colours = f"generated: {cover}"
    if texture.photo_file is not None:
        texels, colours = texture_from_photo(texture, shape, extent_m), Path(texture.photo_file).name
    covered = share = None
    if texture.orthophoto_file is not None:
        # imported here: rasterio takes 20 MB of memory, and most terrains do not need it
        from twin.terrains.draped_orthophoto import lay_orthophoto

        texels = texels.image if isinstance(texels, PaintedTexture) else texels
        covered = lay_orthophoto(texels, Path(texture.orthophoto_file), extent_m, georeference)
        share = float(covered.mean())
        colours = f"{Path(texture.orthophoto_file).name} over {100 * share:.3g} % of the floor, else {colours}"
    walls = walls_of(height_m, spacing_m, texture, cover, texel_m, painted, covered)
    west_m, south_m = -extent_m[0] / 2, -extent_m[1] / 2
    filled = None if has_height.all() else ~has_height
    finite = given.values[np.isfinite(given.values)]
    stated = InputStatement(
        file.name, given.crs, given.ground_scale, spacing_m,
        "terrain.height_spacing_m" if georeference is None else "its coordinates",
        given.axis.metres_per_unit, given.axis.unit_evidence, direction, evidence,
        float(finite.min()), float(finite.max()), given.nodata,
        float(1 - has_height.mean()), colours, given.doubts,
    )  # fmt: skip
    return Terrain(
        height_m, spacing_m, west_m, south_m, texels, texel_m, filled, georeference, share, walls, known, stated
    )


def _read_heights(file: Path, height_spacing_m: float, height_range_m: float) -> HeightFile:
    suffix, named = file.suffix.lower(), VerticalAxis(texts=(file.stem,))
    if suffix in _DRIVERS:
        from twin.terrains.elevation_model import read_raster_heights  # imported here: it imports rasterio

        return read_raster_heights(file, height_spacing_m, _DRIVERS[suffix])
    if suffix == ".png":
        axis = named._replace(band_name="height", unit_evidence="terrain.height_range_m")
        return HeightFile(_read_png(file) * height_range_m, height_spacing_m, axis)
    if suffix == ".npy":
        values = _read_npy(file)
        doubts = check_no_undeclared_holes(values, file, "NaN in place of {}")
        return HeightFile(values, height_spacing_m, named, doubts=tuple(doubts))
    if suffix in _CONVERSIONS:
        raise height_error(
            file, f"is not read as {suffix}", f"a GeoTIFF, as {_CONVERSIONS[suffix].format(file.name)} writes it"
        )
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
