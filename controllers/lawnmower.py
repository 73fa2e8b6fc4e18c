"""The lawnmower survey: L tracks of two legs and two short segments (Negahdaripour & Madjidi 2003, section III-A).

The vehicle keeps its bow to the east and flies every second leg backwards, so the top of the image always points east:
key points follow each other along the image height, swaths lie side by side along the image width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.profile import SpeedProfile

Array = NDArray[np.float64]


class PlanFault(ValueError):  # noqa: N818
    """A plan that cannot be flown: the scenario key at fault, what is wrong, what would be right."""

    def __init__(self, field: str, problem: str, allowed: str):
        self.field, self.problem, self.allowed = field, problem, allowed
        super().__init__(f"{field}: {problem} (allowed: {allowed})")


class Reference(NamedTuple):
    """Where camera or body shall be in the world: position [m], velocity [m/s], yaw [rad], acceleration [m/s2]."""

    position: Array
    velocity: Array
    yaw: float
    acceleration: Array


@dataclass(frozen=True)
class SurveyPlan:
    """A lawnmower survey of the left camera, bow to the east.

    Args:
        area_m: extent along x (the legs) and y, centred at the origin.
        altitude_m: height of the camera above the reference plane z = 0.
        speed_mps: cruise speed along the legs; every segment starts and ends at rest.
        frame_rate_hz: frames per second.
        n_frames_per_key: N, frames from key point to key point.
        n_tracks: L, tracks to fly, two legs each.
        leg_spacing_m: distance between neighbouring legs.
        footprint_m: width (across track) and height (along track) of the image on the reference plane.
        focal_px: focal length of the cameras.
        acceleration_mps2: greatest acceleration.
    """

    area_m: tuple[float, float]
    altitude_m: float
    speed_mps: float
    frame_rate_hz: float
    n_frames_per_key: int
    n_tracks: int
    leg_spacing_m: float
    footprint_m: tuple[float, float]
    focal_px: float
    acceleration_mps2: float

    def waypoints(self, track: int) -> Array:
        """Corners of a track (from 1): leg out, over, leg back, on to the next but from the last; (5 or 4, 3) [m]."""
        half_x, half_y = self.area_m[0] / 2, self.area_m[1] / 2
        south = (2 * track - 1.5) * self.leg_spacing_m - half_y
        out = [(-half_x, south), (half_x, south)]
        back = [(half_x, south + self.leg_spacing_m), (-half_x, south + self.leg_spacing_m)]
        onward = [(-half_x, south + 2 * self.leg_spacing_m)] if track < self.n_tracks else []
        return np.array([(x, y, self.altitude_m) for x, y in out + back + onward])

    def _segments(self, track: int) -> list[tuple[Array, Array, SpeedProfile]]:
        """Start, unit direction and speed profile of each straight segment of a track."""
        corners = self.waypoints(track)
        steps = np.diff(corners, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        return [
            (start, step / length, SpeedProfile(float(length), self.speed_mps, self.acceleration_mps2))
            for start, step, length in zip(corners[:-1], steps, lengths, strict=True)
        ]

    def track_length_m(self, track: int) -> float:
        """Length of the path of a track (from 1)."""
        return sum(profile.length_m for _, _, profile in self._segments(track))

    def track_duration_s(self, track: int) -> float:
        """Time to fly a track (from 1), without the station keeping after it."""
        return sum(profile.duration_s for _, _, profile in self._segments(track))

    def reference(self, track: int, time_s: float) -> Reference:
        """Where the left camera shall be at a time since the start of a track (from 1); at rest before and after it."""
        segments = self._segments(track)
        for start, direction, profile in segments[:-1]:
            if time_s < profile.duration_s:
                return _along(start, direction, profile, time_s)
            time_s -= profile.duration_s
        return _along(*segments[-1], time_s)


def _along(start: Array, direction: Array, profile: SpeedProfile, time_s: float) -> Reference:
    travelled, speed, acceleration = profile.at(time_s)
    return Reference(start + travelled * direction, speed * direction, 0.0, acceleration * direction)


def plan(
    area_m: tuple[float, float],
    altitude_m: float,
    speed_mps: float,
    overlap_along: float,
    overlap_across: float,
    tracks: int,
    image_width_px: int,
    image_height_px: int,
    focal_px: float,
    frame_rate_hz: float,
    acceleration_mps2: float = 0.2,
) -> SurveyPlan:
    """The survey that keeps the overlaps over an area (Negahdaripour & Madjidi 2003, section III-A).

    N = round((1 - overlap_along) ImgSize Altitude FrameRate / (FocalLength Speed)); legs lie at most
    (1 - overlap_across) ImgSize Altitude / FocalLength apart and split the area into equal strips, an even number of
    them. As in the paper ImgSize is the image width in both.

    Args:
        tracks: how many tracks to fly, from the south; 0 flies all that fill the area.

    Raises:
        PlanFault: the key at fault, what is wrong, what is allowed.
    """
    _refuse_impossible(area_m, altitude_m, speed_mps, overlap_along, overlap_across, focal_px, frame_rate_hz)
    width_m, height_m = (float(size_px * altitude_m / focal_px) for size_px in (image_width_px, image_height_px))
    advance_m = (1 - overlap_along) * width_m
    n_frames_per_key = round(advance_m * frame_rate_hz / speed_mps)
    if n_frames_per_key < 1:
        fastest = 2 * advance_m * frame_rate_hz
        raise PlanFault("plan.speed_mps", f"{speed_mps:g}: no frame falls between key points", f"below {fastest:.3g}")
    # A strip that exceeds the limit by rounding alone must not cost a track.
    filling = math.ceil(area_m[1] / ((1 - overlap_across) * width_m) / 2 - 1e-9)
    if not 0 <= tracks <= filling:
        raise PlanFault("plan.tracks", f"{tracks}: the area holds {filling} at this overlap", f"0 to {filling}")
    return SurveyPlan(
        area_m=area_m,
        altitude_m=altitude_m,
        speed_mps=speed_mps,
        frame_rate_hz=frame_rate_hz,
        n_frames_per_key=n_frames_per_key,
        n_tracks=tracks or filling,
        leg_spacing_m=area_m[1] / (2 * filling),
        footprint_m=(width_m, height_m),
        focal_px=float(focal_px),
        acceleration_mps2=acceleration_mps2,
    )


def _refuse_impossible(
    area_m: tuple[float, float],
    altitude_m: float,
    speed_mps: float,
    overlap_along: float,
    overlap_across: float,
    focal_px: float,
    frame_rate_hz: float,
) -> None:
    positive = {
        "plan.altitude_m": altitude_m,
        "plan.speed_mps": speed_mps,
        "plan.area_m": min(area_m),
        "rig.frame_rate_hz": frame_rate_hz,
        "rig.hfov_deg": focal_px,
    }
    for field, value in positive.items():
        if not (value > 0 and math.isfinite(value)):
            problem = "the camera has no footprint" if field in ("plan.altitude_m", "rig.hfov_deg") else f"{value:g}"
            raise PlanFault(field, problem, "above 0")
    for field, value in {"plan.overlap_along": overlap_along, "plan.overlap_across": overlap_across}.items():
        if not 0 < value < 1:
            raise PlanFault(field, f"{value:g}", "between 0 and 1, both excluded")
