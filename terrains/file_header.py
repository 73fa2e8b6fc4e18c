"""Limits on the size of raster files, checked with the size in the header before the contents are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.core.raster_files import IMAGE_DRIVERS, open_raster
from twin.errors import TwinError
from twin.terrains.terrain import MAX_NODES, MAX_TEXELS

HEIGHT_FIELD = "terrain.height_file"
HEIGHT_FORMATS = "GeoTIFF (.tif, .tiff), 16-bit PNG or .npy with one height per cell"
TEXTURE_FIELD = "terrain.texture_file"
ORTHOPHOTO_FIELD = "terrain.orthophoto_file"


def check_height_count(cols: int, rows: int, file: Path) -> None:
    """Raises TwinError if a file has more than MAX_NODES heights."""
    if cols * rows > MAX_NODES:
        raise TwinError(HEIGHT_FIELD, f"{file.name!r} has {cols} x {rows} heights", f"at most {MAX_NODES} heights")


def check_texel_count(cols: int, rows: int, file: Path, field: str = TEXTURE_FIELD) -> None:
    """Raises TwinError, naming the key `field`, if a texture image has more than MAX_TEXELS pixels."""
    if cols * rows > MAX_TEXELS:
        raise TwinError(field, f"{file.name!r} has {cols} x {rows} pixels", f"at most {MAX_TEXELS} pixels")


def eight_bits(values: NDArray[np.uint16], brightest: int) -> NDArray[np.uint8]:
    """Returns an image of 8 bits from one of 16 bits, of which the pixels may use the lower 8, 10, 12 or 14 only.

    Args:
        brightest: greatest value of the whole image; white is the greatest value of the fewest bits that contain it.
    """
    white = next(2**bits - 1 for bits in (8, 10, 12, 14, 16) if brightest < 2**bits)
    return np.clip(np.rint(values * (255.0 / white)), 0, 255).astype(np.uint8)


def image_size(file: Path, key: str, allowed: str) -> tuple[int, int]:
    """Returns the number of columns and rows of an image file (PNG, JPEG, TIFF, BMP, WebP) from its header.

    Raises:
        TwinError: the file is missing or not such an image; names the key.
    """
    with open_raster(file, key, allowed, IMAGE_DRIVERS) as source:
        return source.width, source.height
