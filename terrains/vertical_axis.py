"""What a height file states: direction and unit of its values, CRS. `terrain.z` may give the direction."""

import re
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.errors import TwinError
from twin.terrains.file_header import height_error

Direction = Literal["up", "down"]

ASSUMED = "assumed: it names none"  #: evidence of a unit that a file does not state
#: Lengths [m] of the units that a raster band may have, by their names in lower case.
UNITS_M = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), 0.001),
    **dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet"), 0.3048),
    **dict.fromkeys(("us survey foot", "us survey feet", "ftus", "us-ft", "us ft", "foot_us"), 1200 / 3937),
    **dict.fromkeys(("fathom", "fathoms"), 1.8288),
}
#: Words in names and tags that indicate depths. They leave open whether depths are positive or negative numbers.
_DEPTH_WORD = re.compile(r"depth|sounding", re.IGNORECASE)
#: Band names that state depths. If the band has no negative value, its values increase downwards.
_DEPTH_BAND = re.compile(r"^\s*(water |sea ?floor |bottom )?depths?\b", re.IGNORECASE)
_HEIGHT_BAND = re.compile(r"elevation|height|altitude", re.IGNORECASE)
#: Beginnings of standard names that the CF conventions define as positive downwards.
_CF_DEPTHS = ("depth", "sea_floor_depth")


class VerticalAxis(NamedTuple):
    """Vertical axis of the values of a file, as the file describes it."""

    direction: Direction | None = None  #: of the axis of the vertical CRS or of the CF attributes; None without either
    metres_per_unit: float = 1.0  #: length of the unit; 1 if the file does not name one
    band_name: str = ""  #: description, long name or standard name of the band, the first that is given
    texts: tuple[str, ...] = ()  #: file name, names and tags that may name the quantity of the values
    datum: str = ""  #: name of the vertical CRS; "" if there is none
    in_crs: bool = False  #: whether the file names a CRS; there, a sea floor has no positive elevations
    unit_evidence: str = ASSUMED  #: what states the unit


class HeightFile(NamedTuple):
    """Values of a file of heights, before holes are filled, with what the file states of them."""

    values: NDArray[np.float64]  #: (rows, cols), row 0 = north; NaN where the file has no height
    spacing_m: float  #: distance between neighbouring values
    axis: VerticalAxis
    georeference: Georeference | None = None  #: position of the centre in the CRS of the file; None without coordinates
    crs: str = ""  #: name of the horizontal CRS; "" without one
    ground_scale: float | None = None  #: distance on the ground / distance in a projected CRS, at the centre
    nodata: str = ""  #: value or band by which the file declares cells without a height; "" if it declares none
    doubts: tuple[str, ...] = ()  #: sentences on values that may mark cells without a height


def unit_length_m(name: str, file: Path) -> float:
    length_m = UNITS_M.get(name.strip().lower().replace("_", " "), UNITS_M.get(name.strip().lower()))
    if length_m is None:
        raise height_error(file, f"has heights in the unknown unit {name!r}", "metres, feet or fathoms")
    return length_m


def cf_direction(tags: dict[str, str]) -> Direction | None:
    """Returns the direction given by the CF attributes of a band; None if not given."""
    positive = tags.get("positive", "").lower()
    if positive == "up" or positive == "down":
        return positive
    return "down" if tags.get("standard_name", "").lower().startswith(_CF_DEPTHS) else None


def direction_of(
    values: NDArray[np.float64], axis: VerticalAxis, asked: Direction | None, file: Path
) -> tuple[Direction, str]:
    """Returns the direction in which the values (rows, cols), not finite in holes, increase, and the evidence for it.

    `asked` is `terrain.z` of the scenario, which takes precedence; None: determined from the file. Raises TwinError if
    the file does not make clear which way its values increase.
    """
    if asked is not None:
        return asked, "terrain.z"
    heights = values[np.isfinite(values)]
    low, high = float(heights.min()), float(heights.max())
    shown = f"{file.name!r} with values from {low:g} to {high:g}"
    if axis.direction == "down" and high <= 0:
        raise _ambiguous(f"{shown} states that they increase downwards, but none is positive")
    if axis.direction is not None:
        return axis.direction, "vertical CRS or CF attributes"
    named = [text for text in (axis.band_name, *axis.texts) if _DEPTH_WORD.search(text)]
    if not named and low > (0 if axis.in_crs else high - low) and not _HEIGHT_BAND.search(axis.band_name):
        raise _ambiguous(f"{shown}, all positive, does not state whether they are heights or depths")
    if not named or high <= 0:  # depths as negative numbers increase upwards
        return "up", "name of the band" if _HEIGHT_BAND.search(axis.band_name) else f"assumed: values from {low:g}"
    if low >= 0 and _DEPTH_BAND.search(axis.band_name):
        return "down", "name of the band"
    raise _ambiguous(f"{shown} may hold depths ({named[0]!r})")


def _ambiguous(problem: str) -> TwinError:
    return TwinError("terrain.z", f"missing: {problem}", '"up" for elevations, "down" for depths')
