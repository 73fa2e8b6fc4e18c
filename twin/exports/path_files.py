"""Files of a planned path for other programs: QGroundControl, KML, GPX and CSV."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.records import Array
from twin.core.templates import filled
from twin.errors import TwinError
from twin.exports.planned_path import PlannedPath

# MAVLink: commands and frames of mission items, type of the vehicle, and autopilot (ArduPilot)
_WAYPOINT, _CHANGE_SPEED = 16, 178
_RELATIVE_ALTITUDE, _NO_POSITION = 3, 2
_SUBMARINE, _ARDUPILOT = 12, 3


def write_qgc(path: PlannedPath, file: Path) -> None:
    """Writes a mission of QGroundControl for ArduSub, relative to the sea surface (elevation 0); TwinError above it."""
    if (highest_m := float(path.crs[:, 2].max())) >= 0:
        problem = f"the path is up to {highest_m:.2f} m above the zero of the elevations, not below the sea surface"
        raise TwinError("--to qgc", problem, "--origin E,N,H, with H the elevation of z = 0 above the sea surface")
    items = [_simple_item(_CHANGE_SPEED, _NO_POSITION, [1, path.speed_mps, -1, 0, 0, 0, 0])]
    rows = np.column_stack([path.holds_s, path.heading_deg.round(2), _geographic(path)]).tolist()
    for hold_s, heading_deg, longitude, latitude, altitude_m in rows:
        altitude = round(altitude_m, 3)
        params = [hold_s, 0, 0, heading_deg, latitude, longitude, altitude]
        shown = {"AMSLAltAboveTerrain": None, "Altitude": altitude, "AltitudeMode": 1}
        items.append(shown | _simple_item(_WAYPOINT, _RELATIVE_ALTITUDE, params))
    mission = {
        "version": 2, "firmwareType": _ARDUPILOT, "vehicleType": _SUBMARINE, "globalPlanAltitudeMode": 1,
        "cruiseSpeed": path.speed_mps, "hoverSpeed": path.speed_mps, "plannedHomePosition": [*rows[0][3:1:-1], 0.0],
        "items": [item | {"doJumpId": number} for number, item in enumerate(items, 1)],
    }  # fmt: skip
    tree = {
        "fileType": "Plan", "version": 1, "groundStation": "QGroundControl", "mission": mission,
        "geoFence": {"version": 2, "circles": [], "polygons": []}, "rallyPoints": {"version": 2, "points": []},
    }  # fmt: skip
    file.write_text(json.dumps(tree, indent=1), encoding="utf-8")


def _simple_item(command: int, frame: int, params: list[Any]) -> dict[str, Any]:
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": params, "autoContinue": True}


def write_kml(path: PlannedPath, file: Path) -> None:
    """Writes KML 2.2 with a line for each track, at elevations above sea level."""
    points = _geographic(path)
    tracks = {track: points[path.track == track] for track in np.unique(path.track).tolist()}
    text = filled("twin.exports", "planned_path.kml.j2", {"name": path.name, "tracks": tracks})
    file.write_text(text, encoding="utf-8")


def write_gpx(path: PlannedPath, file: Path) -> None:
    """Writes GPX 1.1 with one route; `ele` is the elevation, negative below sea level."""
    text = filled("twin.exports", "planned_path.gpx.j2", {"name": path.name, "points": _geographic(path)})
    file.write_text(text, encoding="utf-8")


def write_csv(path: PlannedPath, file: Path) -> None:
    columns = path.track, path.scene_m, path.crs, path.longitude_latitude, path.heading_deg, path.holds_s
    head = "track,x_m,y_m,z_m,easting,northing,elevation_m,longitude_deg,latitude_deg,heading_deg,hold_s"
    form = ["%d"] + ["%.3f"] * 6 + ["%.9f"] * 2 + ["%.2f", "%g"]
    np.savetxt(file, np.column_stack(columns), form, ",", header=head, comments="")


def _geographic(path: PlannedPath) -> Array:
    """Returns longitude, latitude and elevation (n, 3) of the waypoints [deg, deg, m]."""
    return np.column_stack([path.longitude_latitude, path.crs[:, 2]])
