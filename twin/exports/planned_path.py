"""Planned path of the vehicle as waypoints on the Earth: the plan of a scenario, for autopilots and maps."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.georeference import Georeference
from twin.core.records import Array
from twin.errors import TwinError
from twin.exports.geographic_place import WGS84, place_of, transformed
from twin.world.mission import Mission

TOLERANCE_M = 0.05  #: largest distance of the planned path from the lines between waypoints
_TURN_M = 1.0  # distance that counts as much as a turn by 1 rad: headings are within 0.05 rad of the planned ones


class PlannedPath(NamedTuple):
    """Waypoints of the origin of the vehicle, in the order of the survey."""

    name: str
    speed_mps: float  #: cruise speed
    track: NDArray[np.int64]  #: (n,) number of the track of each waypoint, from 1
    scene_m: Array  #: (n, 3) x, y, z in the scene
    crs: Array  #: (n, 3) easting and northing in the CRS of the scene, in its unit; elevation [m]
    longitude_latitude: Array  #: (n, 2) on WGS 84 [deg]
    heading_deg: Array  #: (n,) direction of the bow, clockwise from true north, 0 to 360
    holds_s: Array  #: (n,) time of station keeping at each waypoint: the last ones of the tracks


def planned_path(mission: Mission, origin: Georeference | None) -> PlannedPath:
    """Returns the planned path; TwinError without a georeference with a projected CRS between 80 S and 84 N."""
    place = place_of(origin)
    if origin is None or place is None or origin.crs_wkt is None:
        allowed = "a DEM with a projected CRS, or --crs EPSG:CODE --origin E,N,H"
        raise TwinError("--to", f"{mission.scenario.name} has no place on the Earth", allowed)
    body_in_camera_m = geometry.inverse(mission.rig.body_from_camera)[:3, 3]
    tracks, positions, yaws = [], [], []
    for track in mission.tracks:
        reference = mission.plan.references(track, mission.plan.frames_of_track(track)[0])
        bow = np.asarray(reference.yaw)
        body = reference.position + geometry.rotations_of_down_camera(bow) @ body_in_camera_m
        kept = _simplified(np.column_stack([body, _TURN_M * np.cos(bow), _TURN_M * np.sin(bow)]))
        tracks.append(np.full(len(kept), track))
        positions.append(body[kept])
        yaws.append(bow[kept])
    scene_m, yaw, track = np.concatenate(positions), np.concatenate(yaws), np.concatenate(tracks)
    easting, northing = origin.from_scene(*scene_m[:, :2].T)
    bow = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))]) @ place.north_from_scene.T
    hold_s = 0.0 if mission.plan.flies_arcs else mission.scenario.control.hold_s
    return PlannedPath(
        mission.scenario.name, mission.plan.speed_mps, track, scene_m,
        np.column_stack([easting, northing, origin.elevation_m + scene_m[:, 2]]),
        transformed(origin.crs_wkt, WGS84, easting, northing),
        np.degrees(np.arctan2(bow[:, 0], bow[:, 1])) % 360,
        hold_s * np.append(np.diff(track) > 0, True),
    )  # fmt: skip


def _simplified(points: Array) -> NDArray[np.int64]:
    """Returns the indices of the points (n, d) whose lines are within TOLERANCE_M of all points (Douglas-Peucker)."""
    kept, spans = {0, len(points) - 1}, [(0, len(points) - 1)]
    while spans:
        first, last = spans.pop()
        start, line, inner = points[first], points[last] - points[first], points[first + 1 : last]
        if not len(inner):
            continue
        share = np.clip((inner - start) @ line / max(float(line @ line), 1e-12), 0.0, 1.0)
        distance = np.linalg.norm(inner - start - share[:, None] * line, axis=1)
        if distance.max() > TOLERANCE_M:
            middle = first + 1 + int(distance.argmax())
            kept.add(middle)
            spans += [(first, middle), (middle, last)]
    return np.array(sorted(kept))
