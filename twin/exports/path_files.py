"""Files of a planned path for other programs: QGroundControl, KML, GPX and CSV."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from twin.errors import TwinError
from twin.exports.planned_path import PlannedPath

# MAVLink: commands and frames of mission items, type of the vehicle, and autopilot (ArduPilot)
_WAYPOINT, _CHANGE_SPEED = 16, 178
_RELATIVE_ALTITUDE, _NO_POSITION = 3, 2
_SUBMARINE, _ARDUPILOT = 12, 3


def write_qgc(path: PlannedPath, file: Path) -> None:
    """Writes a mission of QGroundControl for ArduSub, whose altitudes are relative to the sea surface.

    The zero of the elevations is taken to be the surface. Raises TwinError if a waypoint is not below it.
    """
    if (highest_m := float(path.crs[:, 2].max())) >= 0:
        problem = f"the path is up to {highest_m:.2f} m above the zero of the elevations, not below the sea surface"
        raise TwinError("--to qgc", problem, "--origin E,N,H, with H the elevation of z = 0 above the sea surface")
    items = [_simple_item(_CHANGE_SPEED, _NO_POSITION, [1, path.speed_mps, -1, 0, 0, 0, 0])]
    rows = zip(path.longitude_latitude.tolist(), path.crs[:, 2], path.heading_deg, path.ends_track, strict=True)
    for (longitude, latitude), altitude_m, heading_deg, ends_track in rows:
        hold_s, altitude = path.hold_s if ends_track else 0.0, round(float(altitude_m), 3)
        params = [hold_s, 0, 0, round(float(heading_deg), 2), latitude, longitude, altitude]
        shown = {"AMSLAltAboveTerrain": None, "Altitude": altitude, "AltitudeMode": 1}
        items.append(shown | _simple_item(_WAYPOINT, _RELATIVE_ALTITUDE, params))
    longitude, latitude = path.longitude_latitude[0].tolist()
    mission = {
        "version": 2, "firmwareType": _ARDUPILOT, "vehicleType": _SUBMARINE, "globalPlanAltitudeMode": 1,
        "cruiseSpeed": path.speed_mps, "hoverSpeed": path.speed_mps, "plannedHomePosition": [latitude, longitude, 0.0],
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
    places = []
    for track in range(1, int(path.track.max()) + 1):
        on_track = path.track == track
        points = zip(path.longitude_latitude[on_track], path.crs[on_track, 2], strict=True)
        text = " ".join(f"{longitude:.9f},{latitude:.9f},{height:.3f}" for (longitude, latitude), height in points)
        places.append(
            f"<Placemark><name>track {track}</name><LineString><altitudeMode>absolute</altitudeMode>"
            f"<coordinates>{text}</coordinates></LineString></Placemark>\n"
        )
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>'
    file.write_text(f"{head}{escape(path.name)}</name>\n{''.join(places)}</Document></kml>\n", encoding="utf-8")


def write_gpx(path: PlannedPath, file: Path) -> None:
    """Writes GPX 1.1 with one route; `ele` is the elevation, negative below sea level."""
    rows = zip(path.longitude_latitude, path.crs[:, 2], path.track, strict=True)
    points = "".join(
        f'<rtept lat="{latitude:.9f}" lon="{longitude:.9f}"><ele>{height:.3f}</ele><name>track {track}</name></rtept>\n'
        for (longitude, latitude), height, track in rows
    )
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="twin"'
    head += ' xmlns="http://www.topografix.com/GPX/1/1"><rte><name>'
    file.write_text(f"{head}{escape(path.name)}</name>\n{points}</rte></gpx>\n", encoding="utf-8")


def write_csv(path: PlannedPath, file: Path) -> None:
    lines = ["track,x_m,y_m,z_m,easting,northing,elevation_m,longitude_deg,latitude_deg,heading_deg,hold_s"]
    holds = path.hold_s * path.ends_track
    rows = zip(path.track, path.scene_m, path.crs, path.longitude_latitude, path.heading_deg, holds, strict=True)
    for track, scene, crs, (longitude, latitude), heading, hold_s in rows:
        metres = ",".join(f"{value:.3f}" for value in (*scene, *crs))
        lines.append(f"{track},{metres},{longitude:.9f},{latitude:.9f},{heading:.2f},{hold_s:g}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
