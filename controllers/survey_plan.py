"""The survey as planned: its numbers and the path of every track, whatever the pattern."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.segments import Reference, Segment

Array = NDArray[np.float64]


class PlanFault(ValueError):  # noqa: N818
    """A plan that cannot be flown: the scenario key at fault, what is wrong, what would be right."""

    def __init__(self, field: str, problem: str, allowed: str):
        self.field, self.problem, self.allowed = field, problem, allowed
        super().__init__(f"{field}: {problem} (allowed: {allowed})")


class SurveyRequest(NamedTuple):
    """What a survey shall keep to.

    Args:
        area_m: extent along x and y, centred at the origin.
        altitude_m: height of the left camera above the reference plane z = 0.
        speed_mps: cruise speed.
        overlap_along, overlap_across: wanted shares, of consecutive keyframes and of neighbouring swaths.
        tracks: how many tracks to fly, the first ones of the whole survey; 0 flies all that fill the area.
        image_width_px, image_height_px, focal_px, frame_rate_hz: of the left camera.
        acceleration_mps2: greatest acceleration.
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
        """Width (across the bow) and height (along it) of the image on the reference plane."""
        per_px = self.altitude_m / self.focal_px
        return float(self.image_width_px * per_px), float(self.image_height_px * per_px)


@dataclass(frozen=True)
class SurveyPlan:
    """The path of the left camera, bow to the east, in tracks that each end with station keeping.

    Args:
        paths: the segments of each track; every one starts and ends at rest.
        area_m: extent along x and y, centred at the origin.
        altitude_m: height of the camera above the reference plane z = 0.
        speed_mps: cruise speed along the swaths.
        frame_rate_hz: frames per second.
        n_frames_per_keyframe: N, frames from keyframe to keyframe.
        swath_length_m: length of a swath: a leg, or a loop.
        swath_spacing_m: greatest distance between neighbouring swaths.
        footprint_m: width (across the bow) and height (along it) of the image on the reference plane.
        side_along_m, side_across_m: side of the footprint along which keyframes, and swaths, part from each other.
        focal_px: focal length of the cameras.
        acceleration_mps2: greatest acceleration.
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
        """L."""
        return len(self.paths)

    def waypoints(self, track: int) -> Array:
        """Points along a track (from 1) that draw and bound it: corners of lines, points of circles; (n, 3) [m]."""
        first, *others = self.paths[track - 1]
        return np.concatenate([first.points(), *(segment.points()[1:] for segment in others)])

    def outline(self) -> Array:
        """The waypoints of all tracks (n, 3) [m]."""
        return np.concatenate([self.waypoints(track) for track in range(1, self.n_tracks + 1)])

    def track_length_m(self, track: int) -> float:
        """Length of the path of a track (from 1)."""
        return sum(segment.profile.length_m for segment in self.paths[track - 1])

    def track_duration_s(self, track: int) -> float:
        """Time to fly a track (from 1), without the station keeping after it."""
        return sum(segment.profile.duration_s for segment in self.paths[track - 1])

    def frames_of_track(self, track: int) -> tuple[Array, NDArray[np.bool_]]:
        """Time (n,) since the start of a track (from 1) [s] of each frame and whether it is a keyframe (n,).

        Every N-th is one, and the last.
        """
        frames = np.arange(round(self.track_duration_s(track) * self.frame_rate_hz) + 1)
        return frames / self.frame_rate_hz, (frames % self.n_frames_per_keyframe == 0) | (frames == frames[-1])

    def reference(self, track: int, time_s: float) -> Reference:
        """Where the left camera shall be at a time since the start of a track (from 1); at rest before and after it."""
        return self.references(track, np.array([time_s])).row(0)

    def references(self, track: int, times_s: Array) -> Reference:
        """The same at times (n,), rising."""
        *others, last = self.paths[track - 1]
        parts, left_s = [], times_s
        for segment in others:
            n = int(np.searchsorted(left_s, segment.profile.duration_s))
            parts.append(segment.at(left_s[:n]))
            left_s = left_s[n:] - segment.profile.duration_s
        return Reference(*map(np.concatenate, zip(*parts, last.at(left_s), strict=True)))


def frames_per_keyframe(request: SurveyRequest, speed_mps: float) -> int:
    """N = round((1 - overlap_along) ImgSize Altitude FrameRate / (FocalLength Speed)).

    As in the paper ImgSize is the image width (Negahdaripour & Madjidi 2003, section III-A).

    Raises:
        PlanFault: the speed leaves no frame between keyframes.
    """
    advance_m = (1 - request.overlap_along) * request.footprint_m[0]
    n = round(advance_m * request.frame_rate_hz / speed_mps)
    if n < 1:
        fastest = 2 * advance_m * request.frame_rate_hz
        raise PlanFault("plan.speed_mps", f"{speed_mps:g}: no frame falls between keyframes", f"below {fastest:.3g}")
    return n


def tracks_to_fly(request: SurveyRequest, filling: int) -> int:
    """How many tracks to fly where `filling` fill the area. Raises PlanFault."""
    if not 0 <= request.tracks <= filling:
        problem = f"{request.tracks}: the area holds {filling} at this overlap"
        raise PlanFault("plan.tracks", problem, f"0 to {filling}")
    return request.tracks or filling


def refuse_impossible(request: SurveyRequest) -> None:
    """Refuses what no pattern can keep to. Raises PlanFault."""
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
            raise PlanFault(field, problem, "above 0")
    shares = {"plan.overlap_along": request.overlap_along, "plan.overlap_across": request.overlap_across}
    for field, value in shares.items():
        if not 0 < value < 1:
            raise PlanFault(field, f"{value:g}", "between 0 and 1, both excluded")
