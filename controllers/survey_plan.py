"""Requirements of a survey, and the plan that meets them: the path of every track and the spacing, for any pattern."""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.controllers.camera_surface import CameraSurface
from twin.controllers.curves import PathSegment
from twin.controllers.segments import Circle, Reference, Turn
from twin.controllers.survey_area import SurveyArea
from twin.core.geometry import Array
from twin.errors import TwinError

_EDGE_M = 1e-9  # tolerance: points on the edge count as inside in spite of rounding
TURN_RATE = math.radians(15)  # greatest rate of a turn on the spot [rad/s]: 0.5 deg between frames at 30 Hz
TURN_ACCELERATION = math.radians(15)  # angular acceleration of a turn [rad/s2]
TURN_PER_KEYFRAME = math.radians(10)  # greatest rotation between keyframes [rad]; beyond it, patch matching degrades
FRAMES_BETWEEN_TRACKS = 2  #: between the tracks of a path that is flown in arcs, for the global alignment

#: Largest number of tracks to fly, and of tracks that fill an area; least altitude, and least side of an area [m].
MAX_TRACKS, MAX_FILLING, LEAST_M = 10_000, 1_000_000, 1e-3


class SurveyRequest(NamedTuple):
    area_m: tuple[float, float]  # extent along and across the legs
    altitude_m: float  # of the left camera above the reference plane or, with `surface`, the smoothed floor
    speed_mps: float  # cruise speed
    overlap_along: float  # of consecutive keyframes, as a fraction of the image width (`frames_per_keyframe`)
    overlap_across: float  # required sidelap of neighbouring swaths, as a fraction of `SurveyPlan.side_across_m`
    tracks: int  # number of tracks to fly, starting with the first; 0: all tracks that fill the area
    #: image_width_px, image_height_px, focal_px, frame_rate_hz: parameters of the left camera.
    image_width_px: int
    image_height_px: int
    focal_px: float
    frame_rate_hz: float
    acceleration_mps2: float = 0.2  # greatest acceleration of the camera
    area: SurveyArea | None = None  # of extent `area_m`; None: a rectangle or disc at the origin, with legs along x
    turns: Literal["reverse", "bow_first", "arcs"] = "reverse"
    turn_radius_m: float = 0.0  # least radius of the arcs
    #: Factors on the spacing of keyframes and of swaths on the reference plane; below 1 if the floor is nearer.
    along_scale: float = 1.0
    across_scale: float = 1.0
    #: pairs of v [m], ascending, and the factor on the spacing of legs there; between them it is interpolated. Empty:
    #: the legs are equally spaced.
    leg_spacing: tuple[tuple[float, float], ...] = ()
    surface: CameraSurface | None = None  # planned height z of the camera; None: `altitude_m` everywhere
    cross_lines: int = 0  # number of lines across the legs of a lawnmower, flown after them
    cross_rise_m: float = 0.0  # height of the cross lines above the legs

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Returns width (across the heading) and height (along it) of the image on the reference plane [m]."""
        per_px = self.altitude_m / self.focal_px
        return float(self.image_width_px * per_px), float(self.image_height_px * per_px)


class Detour(NamedTuple):
    """Track away from the legs, for a task."""

    track: int  # its number, from 1
    name: str
    n_frames_per_keyframe: int


@dataclass(frozen=True)
class SurveyPlan:
    """Planned path and heading of the left camera. The vehicle keeps station after each track, or flies arcs."""

    request: SurveyRequest  # the requirements that it meets
    paths: tuple[tuple[PathSegment, ...], ...]  # of each track; segments start and end at rest, but for arcs
    area: SurveyArea  # area to cover; the legs, and the bow on the first leg, point along its heading
    speed_mps: float  # cruise speed along the swaths
    n_frames_per_keyframe: int  # N, frames from one keyframe to the next
    swath_length_m: float  # length of a swath: the mean over all legs that fill the area, or that of a loop
    swath_spacing_m: float  # greatest distance between neighbouring swaths
    n_tracks_to_fill: int  # number of tracks that fill the area, of which the first are planned
    #: Sides of the footprint along which keyframes and neighbouring swaths are displaced; the shorter one for loops.
    side_along_m: float
    side_across_m: float
    least_spacing_m: float  # least distance between neighbouring swaths
    legs_after_gaps: tuple[int, ...] = ()  # numbers of legs, from 0, between which and the one before no area lies
    covered_to_m: float = math.inf  # greatest v of the part of the area that the planned legs have to cover
    detours: tuple[Detour, ...] = ()

    def inside_area(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Returns whether each point of the scene lies in the asked area, which the planned tracks have to cover.

        This is the whole area if they fill it; otherwise the part of it in the strips of the planned legs of a
        lawnmower, or within half of `swath_spacing_m` of a planned loop.
        """
        x_m, y_m = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        inside = self.area.contains(x_m, y_m)
        circles = [segment for path in self.paths for segment in path if isinstance(segment, Circle)]
        if circles and self.n_leg_tracks < self.n_tracks_to_fill:
            return inside & self._near_loop(circles, x_m, y_m)
        if math.isinf(self.covered_to_m):
            return inside
        _, across = self.area.to_legs(x_m, y_m)
        return inside & (across <= self.covered_to_m + _EDGE_M)

    @property
    def swath_notes(self) -> dict[str, Any]:
        """Returns what tells legs from other parts of the path, and neighbours from legs beside a gap of the area."""
        others = [detour.track for detour in self.detours]
        last = {"cross_track": self.cross_track, "other_tracks": others, "last_track": self.n_tracks}
        return last | {"legs_after_gaps": self.legs_after_gaps}

    @property
    def n_leg_tracks(self) -> int:
        """Returns the number of tracks of legs or loops: all but those of the cross lines and of tasks."""
        return self.n_tracks - (self.cross_track is not None) - len(self.detours)

    @property
    def cross_track(self) -> int | None:
        """Returns the number of the track of the cross lines, from 1; None without cross lines."""
        last = max(set(range(1, self.n_tracks + 1)) - {detour.track for detour in self.detours})
        return last if self.request.cross_lines else None

    @property
    def follows_floor(self) -> bool:
        return self.request.surface is not None

    @property
    def turns_on_the_spot(self) -> bool:
        return any(isinstance(segment, Turn) for path in self.paths for segment in path)

    @property
    def flies_arcs(self) -> bool:
        """Returns whether the vehicle flies all tracks without stopping."""
        return self.request.turns == "arcs"

    @property
    def n_tracks(self) -> int:
        return len(self.paths)

    def waypoints(self, track: int) -> Array:
        """Returns the waypoints (n, 3) of a track [m]: end points of its lines and points along its circles."""
        first, *others = self.paths[track - 1]
        points = np.concatenate([first.points(), *(segment.points()[1:] for segment in others)])
        if self.request.surface is not None:
            points[:, 2] += self.request.surface.height_at(points[:, 0], points[:, 1]) - self.request.altitude_m
        return points

    def outline(self) -> Array:
        return np.concatenate([self.waypoints(track) for track in range(1, self.n_tracks + 1)])

    def _near_loop(self, circles: list[Circle], x_m: Array, y_m: Array) -> NDArray[np.bool_]:
        near = np.zeros(x_m.shape, np.bool_)
        for circle in circles:
            radius_m, (x, y, _) = math.dist(circle.start, circle.centre), circle.centre
            near |= np.abs(np.hypot(x_m - x, y_m - y) - radius_m) <= self.swath_spacing_m / 2 + _EDGE_M
        return near

    def track_length_m(self, track: int) -> float:
        path = self.paths[track - 1]
        return sum(segment.profile.length_m for segment in path if not isinstance(segment, Turn))

    def track_duration_s(self, track: int) -> float:
        return sum(segment.profile.duration_s for segment in self.paths[track - 1])

    def frames_of_track(self, track: int) -> tuple[Array, NDArray[np.bool_]]:
        """Returns the times (n,) of the frames of a track since its start [s], and whether each is a keyframe.

        Of a path that is flown in arcs, `FRAMES_BETWEEN_TRACKS` follow, and then the first one of the next track.

        These are every N-th frame, with its own N for a task, and the last one, and more while the vehicle turns
        (`TURN_PER_KEYFRAME`).
        """
        n_frames = round(self.track_duration_s(track) * self.request.frame_rate_hz) + 1
        frames = np.arange(n_frames - (FRAMES_BETWEEN_TRACKS + 1 if self.flies_arcs else 0))
        steps = {detour.track: detour.n_frames_per_keyframe for detour in self.detours}
        times_s, n = frames / self.request.frame_rate_hz, steps.get(track, self.n_frames_per_keyframe)
        keyframe = (frames % n == 0) | (frames == frames[-1])
        if self.turns_on_the_spot:
            n_turning = max(1, int(TURN_PER_KEYFRAME / TURN_RATE * self.request.frame_rate_hz))
            keyframe |= self._turning(track, times_s) & (frames % min(n, n_turning) == 0)
        return times_s, keyframe

    def _turning(self, track: int, times_s: Array) -> NDArray[np.bool_]:
        path = self.paths[track - 1]
        ends_s = np.cumsum([segment.profile.duration_s for segment in path])
        current = np.minimum(np.searchsorted(ends_s, times_s), len(path) - 1)
        return np.array([isinstance(segment, Turn) for segment in path])[current]

    def reference(self, track: int, time_s: float) -> Reference:
        """Returns the reference of the left camera at a time since the start of a track [s]; at rest outside it."""
        return self.references(track, np.array([time_s])).row(0)

    def references(self, track: int, times_s: Array) -> Reference:
        *others, last = self.paths[track - 1]
        parts, remaining_s = [], times_s
        for segment in others:
            n = int(np.searchsorted(remaining_s, segment.profile.duration_s))
            parts.append(segment.at(remaining_s[:n]))
            remaining_s = remaining_s[n:] - segment.profile.duration_s
        level = _joined([*parts, last.at(remaining_s)])
        return level if self.request.surface is None else self.request.surface.follow(level)

    def all_references(self) -> Reference:
        """Returns the references of the left camera at all planned frames, without those between tracks."""
        tracks = range(1, self.n_tracks + 1)
        return _joined([self.references(track, self.frames_of_track(track)[0]) for track in tracks])

    def camera_height_at(self, x_m: Array, y_m: Array) -> Array:
        surface = self.request.surface
        return np.full(len(x_m), self.request.altitude_m) if surface is None else surface.height_at(x_m, y_m)


def _joined(parts: list[Reference]) -> Reference:
    return Reference(*map(np.concatenate, zip(*parts, strict=True)))


def frames_per_keyframe(request: SurveyRequest, speed_mps: float) -> int:
    """Returns the number of frames per keyframe N (Negahdaripour & Madjidi 2003, section III-A).

    N = round((1 - overlap_along) ImgSize Altitude FrameRate / (FocalLength Speed)), multiplied by `along_scale`;
    ImgSize is the image width. Raises TwinError if N would be 0 at this speed.
    """
    advance_m = (1 - request.overlap_along) * request.footprint_m[0] * request.along_scale
    n = round(advance_m * request.frame_rate_hz / speed_mps)
    if n < 1:
        fastest = 2 * advance_m * request.frame_rate_hz
        raise TwinError(
            "plan.speed_mps", f"{speed_mps:g} is too fast: less than one frame per keyframe", f"below {fastest:.3g}"
        )
    return n


def n_tracks_to_fly(request: SurveyRequest, n_filling: int) -> int:
    """Returns the number of tracks to fly, of `n_filling` that fill the area; raises TwinError if too many."""
    n_flown = request.tracks or n_filling
    if n_flown > MAX_TRACKS or n_filling > MAX_FILLING:
        problem = f"{n_flown:.4g} tracks are too many, of {n_filling:.4g} that fill the area"
        remedy = "less overlap, more altitude, a smaller area, or fewer plan.tracks"
        raise TwinError("plan.overlap_across", problem, f"up to {MAX_TRACKS}, of {MAX_FILLING}: {remedy}")
    if not 0 <= request.tracks <= n_filling:
        problem = f"{request.tracks} is too many: {n_filling} fill the area at this overlap"
        raise TwinError("plan.tracks", problem, f"0 to {n_filling}")
    return n_flown


def check_request(request: SurveyRequest) -> None:
    """Raises TwinError if a requirement is invalid, whatever the pattern."""
    positive = {
        "plan.altitude_m": request.altitude_m,
        "plan.speed_mps": request.speed_mps,
        "plan.area_m": min(request.area_m),
        "rig.frame_rate_hz": request.frame_rate_hz,
        "rig.hfov_deg": request.focal_px,
    }
    for field, value in positive.items():
        if not (value > 0 and math.isfinite(value)):
            problem = "the camera has no footprint" if field in ("plan.altitude_m", "rig.hfov_deg") else f"{value:g}"
            raise TwinError(field, problem, "above 0")
    for field in ("plan.altitude_m", "plan.area_m"):
        if positive[field] < LEAST_M:
            raise TwinError(field, f"{positive[field]:g} is too small", f"at least {LEAST_M:g}")
    overlaps = {"plan.overlap_along": request.overlap_along, "plan.overlap_across": request.overlap_across}
    for field, value in overlaps.items():
        if not 0 < value < 1:
            raise TwinError(field, f"{value:g}", "between 0 and 1, both excluded")
