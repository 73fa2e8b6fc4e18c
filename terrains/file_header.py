"""Images and heights in files: limits on their size, checked with the header before the contents are read."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.user_files import IMAGE_DRIVERS, MOST_IMAGE_BYTES, open_raster, read_bytes, reading
from twin.errors import TwinError
from twin.terrains.terrain import MAX_NODES, MAX_TEXELS

HEIGHT_FIELD = "terrain.height_file"
HEIGHT_FORMATS = "GeoTIFF (.tif, .tiff), ESRI grid (.asc), XYZ grid (.xyz), 16-bit PNG or .npy with one height per cell"
TEXTURE_FIELD = "terrain.texture_file"
ORTHOPHOTO_FIELD = "terrain.orthophoto_file"
#: Largest number of values of a file by its key, and what the values are called.
_MOST = dict.fromkeys((TEXTURE_FIELD, ORTHOPHOTO_FIELD), (MAX_TEXELS, "pixels")) | {
    HEIGHT_FIELD: (MAX_NODES, "heights")
}


def height_error(file: Path, problem: str, allowed: str = HEIGHT_FORMATS) -> TwinError:
    return TwinError(HEIGHT_FIELD, f"{file.name!r} {problem}", allowed)


def check_count(cols: int, rows: int, file: Path, field: str) -> None:
    most, values = _MOST[field]
    if cols * rows > most:
        raise TwinError(field, f"{file.name!r} has {cols} x {rows} {values}", f"at most {most} {values}")


def decoded(file: Path, field: str, allowed: str, flags: int) -> NDArray[np.generic] | None:
    """Returns the pixels of an image file; None if unreadable, TwinError if missing, of another type or too large."""
    with open_raster(file, field, allowed, IMAGE_DRIVERS) as source:
        check_count(source.width, source.height, file, field)
    data = read_bytes(file, field, allowed, MOST_IMAGE_BYTES)
    with reading(file, field, allowed):
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)


def eight_bits(values: NDArray[np.uint16], brightest: int) -> NDArray[np.uint8]:
    """Returns an 8-bit image; white is the greatest value of the 8, 10, 12, 14 or 16 bits that hold `brightest`."""
    white = next(2**bits - 1 for bits in (8, 10, 12, 14, 16) if brightest < 2**bits)
    return np.clip(np.rint(values * (255.0 / white)), 0, 255).astype(np.uint8)
