"""Survey requirements, and the plan that meets them: parameters and the path of every track, for any pattern."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.segments import Reference, Segment
from twin.errors import TwinError

Array = NDArray[np.float64]


class SurveyRequest(NamedTuple):
    """Requirements of a survey.

    Args:
        area_m: extent along x and y, centred at the origin.
        altitude_m: height of the left camera above the reference plane z = 0.
        speed_mps: cruise speed.
        overlap_along: required overlap of consecutive keyframes, as a fraction of the image width (see
            `frames_per_keyframe`).
        overlap_across: required sidelap of neighbouring swaths, as a fraction.
        tracks: number of tracks to fly, starting with the first; 0: all tracks that fill the area.
        image_width_px, image_height_px, focal_px, frame_rate_hz: parameters of the left camera.
        acceleration_mps2: greatest acceleration of the camera.
    """

    area_m: tuple[float, float]
    altitude_m: float
    speed_mps: float
    overlap_along: float
    overlap_across: float
    tracks: int
    image_width_px: int
    image_height_px: int
    focal_px: float
    frame_rate_hz: float
    acceleration_mps2: float = 0.2

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Returns width (across the heading) and height (along it) of the image on the reference plane [m]."""
        per_px = self.altitude_m / self.focal_px
        return float(self.image_width_px * per_px), float(self.image_height_px * per_px)


@dataclass(frozen=True)
class SurveyPlan:
    """Planned path of the left camera, with the bow to the east. The vehicle keeps station after each track.

    Args:
        paths: segments of each track; every segment starts and ends at rest.
        area_m: extent along x and y, centred at the origin.
        altitude_m: height of the camera above the reference plane z = 0.
        speed_mps: cruise speed along the swaths.
        frame_rate_hz: frames per second.
        n_frames_per_keyframe: N, frames from one keyframe to the next.
        swath_length_m: length of a swath (a leg or a loop).
        swath_spacing_m: greatest distance between neighbouring swaths.
        footprint_m: width (across the heading) and height (along the heading) of the image on the reference plane.
        side_along_m: side of the footprint along which consecutive keyframes are displaced.
        side_across_m: side of the footprint along which neighbouring swaths are displaced.
        focal_px: focal length of the cameras.
        acceleration_mps2: greatest acceleration of the camera.
    """

    paths: tuple[tuple[Segment, ...], ...]
    area_m: tuple[float, float]
    altitude_m: float
    speed_mps: float
    frame_rate_hz: float
    n_frames_per_keyframe: int
    swath_length_m: float
    swath_spacing_m: float
    footprint_m: tuple[float, float]
    side_along_m: float
    side_across_m: float
    focal_px: float
    acceleration_mps2: float

    @property
    def n_tracks(self) -> int:
        """Returns the number of tracks L."""
        return len(self.paths)

    def waypoints(self, track: int) -> Array:
        """Returns the outline of a track (from 1): end points of lines and points along circles, (n, 3) [m]."""
        first, *others = self.paths[track - 1]
        return np.concatenate([first.points(), *(segment.points()[1:] for segment in others)])

    def outline(self) -> Array:
        """Returns the waypoints of all tracks (n, 3) [m]."""
        return np.concatenate([self.waypoints(track) for track in range(1, self.n_tracks + 1)])

    def track_length_m(self, track: int) -> float:
        """Returns the path length of a track (from 1) [m]."""
        return sum(segment.profile.length_m for segment in self.paths[track - 1])

    def track_duration_s(self, track: int) -> float:
        """Returns the duration of a track (from 1) [s], without the station keeping after it."""
        return sum(segment.profile.duration_s for segment in self.paths[track - 1])

    def frames_of_track(self, track: int) -> tuple[Array, NDArray[np.bool_]]:
        """Returns the frames of a track (from 1): times (n,) since its start [s], and which are keyframes (n,) bool.

        Every N-th frame and the last one are keyframes.
        """
        frames = np.arange(round(self.track_duration_s(track) * self.frame_rate_hz) + 1)
        return frames / self.frame_rate_hz, (frames % self.n_frames_per_keyframe == 0) | (frames == frames[-1])

    def reference(self, track: int, time_s: float) -> Reference:
        """Returns the reference of the left camera at a time since the start of a track (from 1).

        The velocity is 0 before the start and after the end of the track.
        """
        return self.references(track, np.array([time_s])).row(0)

    def references(self, track: int, times_s: Array) -> Reference:
        """Returns the references of the left camera at increasing times (n,) since the start of a track (from 1)."""
        *others, last = self.paths[track - 1]
        parts, remaining_s = [], times_s
        for segment in others:
            n = int(np.searchsorted(remaining_s, segment.profile.duration_s))
            parts.append(segment.at(remaining_s[:n]))
            remaining_s = remaining_s[n:] - segment.profile.duration_s
        return Reference(*map(np.concatenate, zip(*parts, last.at(remaining_s), strict=True)))


def frames_per_keyframe(request: SurveyRequest, speed_mps: float) -> int:
    """Returns the number of frames per keyframe N (Negahdaripour & Madjidi 2003, section III-A).

    N = round((1 - overlap_along) ImgSize Altitude FrameRate / (FocalLength Speed)); ImgSize is the image width, as in
    that paper.

    Raises:
        TwinError: N would be 0 at this speed.
    """
    advance_m = (1 - request.overlap_along) * request.footprint_m[0]
    n = round(advance_m * request.frame_rate_hz / speed_mps)
    if n < 1:
        fastest = 2 * advance_m * request.frame_rate_hz
        raise TwinError(
            "plan.speed_mps",
            f"{speed_mps:g} is too fast: less than one frame per keyframe",
            f"below {fastest:.3g}",
        )
    return n


def n_tracks_to_fly(request: SurveyRequest, n_filling: int) -> int:
    """Returns the number of tracks to fly.

    Args:
        request: the requirements; `tracks` = 0 means all tracks.
        n_filling: number of tracks that fill the area.
    Raises:
        TwinError: more tracks are requested than fill the area.
    """
    if not 0 <= request.tracks <= n_filling:
        problem = f"{request.tracks} is too many: {n_filling} fill the area at this overlap"
        raise TwinError("plan.tracks", problem, f"0 to {n_filling}")
    return request.tracks or n_filling


def check_request(request: SurveyRequest) -> None:
    """Raises TwinError if a requirement is invalid for every pattern."""
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
    overlaps = {"plan.overlap_along": request.overlap_along, "plan.overlap_across": request.overlap_across}
    for field, value in overlaps.items():
        if not 0 < value < 1:
            raise TwinError(field, f"{value:g}", "between 0 and 1, both excluded")
