"""Place and attitude on the Earth: longitude and latitude, true north in the axes of a scene, angles of a camera."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from twin.core.georeference import Georeference
from twin.core.records import Array

WGS84 = "EPSG:4326"
_UTM_LATITUDES = -80.0, 84.0  # [deg]
_LINE_M = 100.0  # length of the line to the grid north of the scene whose direction is transformed
#: Rotation from the axes (top of the image, right, line of sight) to those of the camera (right, down, line of sight).
_CAMERA_FROM_TOP_RIGHT_SIGHT = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
#: Rotation from the axes (east, north, up) to (north, east, down).
_NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


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


def yaw_pitch_roll_deg(world_from_camera: Array) -> tuple[float, float, float]:
    """Returns yaw (0 to 360), pitch (-90 to 90) and roll (-180 to 180) of a camera [deg], as iFDO and Metashape do.

    With R the rotation from (top of the image, right, line of sight) to (north, east, down), R = R_z(yaw) R_y(pitch)
    R_x(roll): a camera with zero angles looks straight down, with the top of the image to the north. Yaw grows
    clockwise as seen from above; a positive pitch raises the line of sight towards the top of the image.
    `world_from_camera` is a pose (4, 4) or a rotation (3, 3) in the world (x east, y north, z up).
    """
    r = _NED_FROM_ENU @ world_from_camera[:3, :3] @ _CAMERA_FROM_TOP_RIGHT_SIGHT
    yaw = np.arctan2(r[1, 0], r[0, 0])
    pitch = np.arcsin(np.clip(-r[2, 0], -1.0, 1.0))
    roll = np.arctan2(r[2, 1], r[2, 2])
    return float(np.rad2deg(yaw)) % 360.0, float(np.rad2deg(pitch)), float(np.rad2deg(roll))
