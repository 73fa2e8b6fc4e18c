"""Opening of raster files that others name: formats by name, no network, no other file."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from twin.core.user_files import read_text, reading
from twin.errors import TwinError

if TYPE_CHECKING:
    import rasterio

#: First bytes of the files of each driver of GDAL that is used. Other drivers (WMS, VRT) read other files or send
#: requests.
_SIGNATURES = {
    "GTiff": rb"II[*+]\0|MM\0[*+]",
    "PNG": rb"\x89PNG",
    "JPEG": rb"\xff\xd8\xff",
    "BMP": rb"BM",
    "WEBP": rb"RIFF....WEBP",
}
IMAGE_DRIVERS = tuple(_SIGNATURES)  #: drivers that read plain images
_MOST_TILE_PX = 2**24  # largest number of pixels of a tile that exceeds the raster
_BESIDE = re.compile(r"<(SRS|GeoTransform|NoDataValue|Scale|Offset|UnitType|GCPList)\b")
_ONE_FILE = "one file that contains them, as gdal_translate IN OUT writes it"


@contextmanager
def open_raster(
    file: Path, key: str = "", allowed: str = "", drivers: Sequence[str] = ("GTiff",)
) -> Iterator[rasterio.DatasetReader]:
    """Opens a raster file by one of the named drivers of GDAL; `key` and `allowed` are those of `user_files.reading`.

    Raises:
        TwinError: the file is missing, damaged or of another format, names another file, or has larger tiles than it
            needs, coordinates that are not finite, or coordinates or values without data in a file beside it.
    """
    import rasterio  # imported here: it takes 20 MB of memory, and most terrains do not need it
    from rasterio.errors import NotGeoreferencedWarning

    # GDAL looks for no file beside the opened one: overviews and masks beside it may be of any driver
    with reading(file, key, allowed), warnings.catch_warnings(), rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(file, driver=_driver(file, drivers)) as source:
            _check(source)
            if source.driver == "GTiff":
                _check_beside(file, key, source.transform.is_identity)
            yield source


def _driver(file: Path, drivers: Sequence[str]) -> str:
    """Returns the driver of a file, by its first bytes; raises ValueError if it is none of `drivers`."""
    with file.open("rb") as stream:
        start = stream.read(12)
    for driver in drivers:
        if re.match(_SIGNATURES[driver], start, re.DOTALL):
            return driver
    raise ValueError(f"it is not a file of the format {', '.join(drivers)}")


def _check(source: rasterio.DatasetReader) -> None:
    """Raises ValueError if a raster names another file, has overlarge tiles or coordinates that are not finite."""
    if "OVERVIEWS" in source.tag_namespaces():  # GDAL opens the file that OVERVIEW_FILE names, with any driver
        raise ValueError("it names another file, of overviews")
    if max((rows * cols for rows, cols in source.block_shapes), default=0) > max(
        _MOST_TILE_PX, source.width * source.height
    ):
        raise ValueError(f"its tiles of {source.block_shapes[0]} pixels are larger than the raster")
    if not np.isfinite(source.transform[:6]).all():
        raise ValueError("its coordinates are not finite")


def _check_beside(file: Path, key: str, unplaced: bool) -> None:
    """Raises TwinError if coordinates or missing values of a raster are in a file beside it, which is not read."""
    worlds = [file.with_suffix(suffix) for suffix in (".tfw", ".tifw", ".wld") if unplaced]
    notes = file.with_name(f"{file.name}.aux.xml")
    found = [world for world in worlds if world.is_file()]
    if notes.is_file() and _BESIDE.search(read_text(notes)):
        found.append(notes)
    if found:
        raise TwinError(key or str(file), f"{found[0].name!r} has coordinates or values of {file.name!r}", _ONE_FILE)
