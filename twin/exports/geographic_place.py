"""Place of a scene on the Earth: longitude and latitude of its points, and true north in its axes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from twin.core.georeference import Georeference
from twin.core.records import Array

WGS84 = "EPSG:4326"
_UTM_LATITUDES = -80.0, 84.0  # [deg]
_LINE_M = 100.0  # length of the line to the grid north of the scene whose direction is transformed


class Place(NamedTuple):
    origin: Georeference  #: position of the scene in its CRS
    zone: str  #: UTM zone, for example "33N"
    epsg: int  #: EPSG code of the zone on WGS 84
    #: (3, 3) rotations from the scene axes to (east, true north, up) and to the grid axes of the zone, at the origin.
    north_from_scene: Array
    utm_from_scene: Array


def transformed(source: str, target: str, x: ArrayLike, y: ArrayLike) -> Array:
    from rasterio.warp import transform

    return np.column_stack(transform(source, target, np.atleast_1d(x), np.atleast_1d(y))[:2])


def place_of(origin: Georeference | None) -> Place | None:
    """Returns the place of the scene; None without a projected CRS, or near a pole, where there is no UTM zone."""
    from rasterio.crs import CRS

    if origin is None or origin.crs_wkt is None or not CRS.from_wkt(origin.crs_wkt).is_projected:
        return None
    line = [origin.easting, origin.easting], [origin.northing, origin.northing + _LINE_M / origin.metres_per_unit]
    longitude, latitude = (float(value) for value in transformed(origin.crs_wkt, WGS84, *line)[0])
    if not _UTM_LATITUDES[0] <= latitude < _UTM_LATITUDES[1]:
        return None
    number = int((longitude + 180) % 360 // 6) + 1
    epsg = (32600 if latitude >= 0 else 32700) + number
    local = f"+proj=tmerc +lat_0={latitude} +lon_0={longitude} +datum=WGS84"
    turns = (_turn(transformed(origin.crs_wkt, target, *line)) for target in (local, f"EPSG:{epsg}"))
    return Place(origin, f"{number}{'N' if latitude >= 0 else 'S'}", epsg, *turns)


def _turn(line: Array) -> Array:
    """Returns the rotation (3, 3) about the vertical that turns the y axis to the direction of a line (2, 2)."""
    east, north = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
    return np.array([[north, east, 0.0], [-east, north, 0.0], [0.0, 0.0, 1.0]])
