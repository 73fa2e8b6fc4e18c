"""Reader of a plain folder: left/ and right/ with images of equal names, and a calibration file."""

import re
from pathlib import Path

import numpy as np

from twin.datasets.calibration_files import find_calibration, read_calibration
from twin.datasets.dataset import Dataset, StereoImages, value_or_error
from twin.datasets.text_files import inside, read_table
from twin.errors import TwinError

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_UNITS = {19: 1e-9, 16: 1e-6, 13: 1e-3}  # unit [s] of a time since 1970, by its number of digits
_ASSUMED_HZ = 1.0


class PlainFolderReader:
    name = "folder"
    layout = "left/ and right/ with images of equal names, and a calibration (OpenCV, Kalibr, ROS, ORB-SLAM3, COLMAP)"

    def recognises(self, folder: Path) -> bool:
        return (folder / "left").is_dir() and (folder / "right").is_dir()

    def read(self, folder: Path) -> Dataset:
        """Returns the data set; raises TwinError without images, or if times.txt or an image folder is not valid."""
        left, right = image_files(folder / "left"), image_files(folder / "right")
        names = sorted(left.keys() | right.keys(), key=_natural_order)
        if not names:
            raise TwinError(str(folder), "has no images of the left camera or of the right one", ", ".join(SUFFIXES))
        times_s, notes = _times(folder / "times.txt", names)
        frames = [
            StereoImages(time_s, left[name], right.get(name))
            for name, time_s in zip(names, times_s, strict=True)
            if name in left
        ]
        calibration = value_or_error(lambda: (file := find_calibration(folder)) and read_calibration(file))
        n_right_only = len(right.keys() - left.keys())
        return Dataset(folder, frames, calibration, None, n_right_only, notes, np.array(times_s))


def image_files(folder: Path) -> dict[str, Path]:
    """Returns the image files of a folder, by file name without suffix; empty if the folder does not exist.

    Hidden files and those with other suffixes than `SUFFIXES` are ignored. Raises TwinError if an image is a link that
    leads out of the folder, or two images have the same name without suffix.
    """
    if not folder.is_dir():
        return {}
    found: dict[str, Path] = {}
    files = (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith("."))
    for file in sorted(files):
        if file.stem in found:
            raise TwinError(str(folder), f"has several images called {file.stem[:100]!r}", "one suffix per name")
        found[file.stem] = inside(folder, file.name, folder)
    return found


def _natural_order(name: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", name) if part]


def _times(file: Path, names: list[str]) -> tuple[list[float], tuple[str, ...]]:
    """Returns the times of the images [s], from times.txt, else from their names, and notes on assumptions."""
    # seconds, in names with a decimal point, or whole numbers in one of `_UNITS` since 1970; else 1 frame per second
    if file.exists():
        times_s = read_table(file, 1)[:, 0]
        if len(times_s) != len(names):
            raise TwinError(str(file), f"has {len(times_s)} times", f"{len(names)}, one per image")
        return (times_s * _UNITS.get(len(f"{times_s[0]:.0f}"), 1.0)).tolist(), ()
    if all(re.fullmatch(r"\d+\.\d+", name) for name in names):
        return [float(name) for name in names], ()
    lengths = {len(name) for name in names if name.isdecimal()}
    if len(lengths) == 1 and all(name.isdecimal() for name in names) and (unit := _UNITS.get(*lengths)):
        return [int(name) * unit for name in names], ()
    note = f"The data set has no times (times.txt); {_ASSUMED_HZ:g} frame per second was assumed."
    return [k / _ASSUMED_HZ for k in range(len(names))], (note,) if len(names) > 1 else ()
