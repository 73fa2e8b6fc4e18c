"""Values of a calibration file: numbers, matrices, image sizes; keys that nobody read."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.geometry import Array
from twin.errors import TwinError

#: Calibration files that are read.
READ = "OpenCV, Kalibr, ROS camera_info pair, ORB-SLAM3, OKVIS, VINS-Fusion, Basalt, MATLAB (JSON), Metashape, COLMAP"
_UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "meters": 1.0, "millimeters": 0.001, "inches": 0.0254}
_LARGEST = 1e12  # largest absolute value of a number in a calibration file


def refuse_unknown(keys: Iterable[Any], file: Path) -> None:
    unknown = [str(key)[:40] for key in keys]
    if unknown:
        names = ", ".join(map(repr, unknown[:5]))
        raise TwinError(str(file), f"has unknown or repeated keys, which could change its meaning: {names}", READ)


def table_of(value: Any, file: Path) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise TwinError(str(file), "has no table of a camera", READ)
    return value


def numbers_of(value: Any, file: Path, key: str, shape: tuple[int, ...] | None = None) -> Array:
    """Returns numbers (or their key `data`) as an array; raises TwinError unless all |x| < 1e12 and `shape` fits."""
    value = value.get("data") if isinstance(value, Mapping) else value
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    count = None if shape is None else int(np.prod(shape))
    if value is None or not (np.abs(array) < _LARGEST).all() or (count is not None and array.size != count):
        raise TwinError(str(file), f"{key} is missing or not valid", f"{count or 'finite'} numbers")
    return array if shape is None else array.reshape(shape)


def metres_of(unit: Any, key: str, file: Path) -> float:
    """Returns the length of a unit of length [m]; raises TwinError, naming `key`, for an unknown one."""
    if str(unit) not in _UNITS_M:
        raise TwinError(str(file), f"{key} {str(unit)[:40]!r} is not known", ", ".join(_UNITS_M))
    return _UNITS_M[str(unit)]


def size_of(value: Any, file: Path) -> tuple[int, int] | None:
    """Returns an image size [width, height] [px]; None for None; raises TwinError if these are not two numbers."""
    if value is None:
        return None
    width, height = numbers_of(value, file, "the image size", (2,))
    return int(width), int(height)
