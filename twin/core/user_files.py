"""Gate for files that a user names: bounded regular files; whatever a reader raises becomes a TwinError of one line.

Rasters are opened by named drivers of GDAL only, without network and without other files.
"""

import io
import json
import math
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin.errors import TwinError, described

if TYPE_CHECKING:
    import rasterio

os.environ.setdefault("GDAL_CACHEMAX", "64")  # blocks of rasters in memory [MB]; by default 5 % of all memory

MOST_TEXT_BYTES = 64 * 2**20  #: largest text file, unless its reader sets another limit
IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")  #: formats of images by their names in Pillow
MOST_IMAGE_BYTES = 512 * 2**20  #: largest encoded image
_MOST_BYTES = 16 * 2**30  # largest file that is not read as a whole
#: First bytes of the files of each driver. Other drivers (WMS, VRT) read other files or send requests.
_SIGNATURES = {
    "GTiff": rb"II[*+]\0|MM\0[*+]",
    "PNG": rb"\x89PNG",
    "JPEG": rb"\xff\xd8\xff",
    "BMP": rb"BM",
    "WEBP": rb"RIFF....WEBP",
    "AAIGrid": rb"(?i)\s*(ncols|nrows)\s",
    "XYZ": rb"\s*[-+.\d]|(?i:\s*x[\s,;]+y)",
}
IMAGE_DRIVERS = ("GTiff", "PNG", "JPEG", "BMP", "WEBP")  #: drivers that read plain images
_MOST_CRS_BYTES = 2**20  # largest file of a CRS beside a grid as text, which GDAL reads as a whole
_MOST_TILE_PX = 2**24  # largest number of pixels of a tile that exceeds the raster
_BESIDE = re.compile(r"<(SRS|GeoTransform|NoDataValue|Scale|Offset|UnitType|GCPList)\b")
_ONE_FILE = "one file that contains them, as gdal_translate IN OUT writes it"


@contextmanager
def reading(file: Path, key: str = "", allowed: str = "", most_bytes: int = _MOST_BYTES) -> Iterator[None]:
    """Checks a file; within the context, any exception of its reader becomes a TwinError.

    So does a file that is missing, not a regular file or too large. The error names the key, of the scenario, or the
    file itself for "", and the files that are allowed.
    """
    _check(file, key, allowed, most_bytes)
    try:
        yield
    except TwinError:
        raise
    except Exception as error:  # readers raise any of many types for a damaged file
        reason = described(error).removeprefix("ValueError: ")
        raise _error(file, key, f"cannot be read: {reason}", allowed) from error


def read_bytes(file: Path, key: str = "", allowed: str = "", most_bytes: int = MOST_TEXT_BYTES) -> bytes:
    """Returns the contents of a file; raises TwinError as `reading` does."""
    with reading(file, key, allowed, most_bytes), file.open("rb") as stream:
        data = stream.read(most_bytes + 1)  # a file of /proc has more bytes than its size states
    if len(data) > most_bytes:
        raise _error(file, key, "is too large", _limit(most_bytes, allowed))
    return data


def read_text(
    file: Path, key: str = "", allowed: str = "", most_bytes: int = MOST_TEXT_BYTES, encoding: str = "utf-8-sig"
) -> str:
    data = read_bytes(file, key, allowed, most_bytes)
    with reading(file, key, allowed):
        return io.TextIOWrapper(io.BytesIO(data), encoding).read()


def read_json(file: Path, key: str = "", allowed: str = "", most_bytes: int = MOST_TEXT_BYTES) -> Any:
    text = read_text(file, key, allowed, most_bytes)
    with reading(file, key, allowed):
        try:
            return json.loads(text)
        except json.JSONDecodeError as error:
            raise _error(file, key, f"is not JSON: {error}", allowed) from None


def _check(file: Path, key: str, allowed: str, most_bytes: int) -> None:
    if not is_file(file):
        if problem := path_problem(file):
            raise _error(file, key, f"cannot be read: {problem}", allowed)
        if file.exists():
            raise _error(file, key, "is not a regular file", allowed)
        raise TwinError(key, f"no such file {str(file)!r}", allowed) if key else _error(file, key, "does not exist")
    n_bytes = file.stat().st_size
    if n_bytes > most_bytes:
        raise _error(file, key, f"is too large: {n_bytes} bytes", _limit(most_bytes, allowed))


def _limit(most_bytes: int, allowed: str) -> str:
    return f"at most {most_bytes} bytes" + (f", {allowed}" if allowed else "")


def _error(file: Path, key: str, problem: str, allowed: str = "") -> TwinError:
    if key:
        return TwinError(key, f"{file.name!r} {problem}", allowed)
    return TwinError(ascii(str(file))[1:-1] if not str(file).isprintable() else str(file), problem, allowed)


def is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def resolved(path: Path) -> Path:
    """Returns the absolute path, without symbolic links if it can be resolved."""
    try:
        return path.resolve()
    except (OSError, ValueError, RuntimeError):  # too long; null byte; loop of links
        return path.absolute()


def path_problem(path: Path) -> str | None:
    """Returns why the file system rejects a path, which need not exist; None if it does not."""
    text = str(path)
    if "\0" in text:
        return "contains a null byte"
    if not text.isprintable() and any("\ud800" <= character <= "\udfff" for character in text):
        return "is not text in UTF-8"  # OpenCV crashes on such a path
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return "is a link to a missing file" if path.is_symlink() else None
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    return None


@contextmanager
def open_raster(
    file: Path, key: str = "", allowed: str = "", drivers: Sequence[str] = ("GTiff",)
) -> "Iterator[rasterio.DatasetReader]":
    """Opens a raster file by one of the named drivers of GDAL; `key` and `allowed` are those of `reading`.

    Raises TwinError if the file is missing, damaged or of another format, names another file, or has larger tiles than
    it needs, coordinates that are not finite, or coordinates or values without data in a file beside it.
    """
    import rasterio  # imported here: it takes 20 MB of memory, and most terrains do not need it
    from rasterio.errors import NotGeoreferencedWarning

    # GDAL looks for no file beside the opened one: overviews and masks beside it may be of any driver
    with reading(file, key, allowed), warnings.catch_warnings(), rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        driver = _driver(file, drivers)
        for crs in (file.with_suffix(suffix) for suffix in (".prj", ".PRJ") if driver == "AAIGrid"):
            if os.path.lexists(crs) and (crs.is_symlink() or not is_file(crs) or crs.stat().st_size > _MOST_CRS_BYTES):
                raise ValueError(f"{crs.name!r} is not a regular file of at most {_MOST_CRS_BYTES} bytes")
        with rasterio.open(file, driver=driver) as source:
            _check_contents(source)
            if source.driver in ("GTiff", "AAIGrid", "XYZ"):
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


def _check_contents(source: "rasterio.DatasetReader") -> None:
    if "OVERVIEWS" in source.tag_namespaces():  # GDAL opens the file that OVERVIEW_FILE names, with any driver
        raise ValueError("it names another file, of overviews")
    if max((rows * cols for rows, cols in source.block_shapes), default=0) > max(
        _MOST_TILE_PX, source.width * source.height
    ):
        raise ValueError(f"its tiles of {source.block_shapes[0]} pixels are larger than the raster")
    if not all(map(math.isfinite, source.transform[:6])):
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
