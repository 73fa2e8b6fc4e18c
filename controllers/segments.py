"""Segments of a planned path: straight lines, full circles and turns on the spot, each flown from rest to rest."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array

Point = tuple[float, float, float]

_CIRCLE_POINTS = 181  # one point every 2 degrees


@dataclass(frozen=True)
class SpeedProfile:
    """Trapezoidal speed profile: constant acceleration, cruise, deceleration; triangular on a short segment."""

    length_m: float  # length of the segment
    cruise_mps: float  # speed limit
    acceleration_mps2: float  # acceleration, and deceleration at the end

    @cached_property
    def peak_mps(self) -> float:
        return min(self.cruise_mps, math.sqrt(self.length_m * self.acceleration_mps2))

    @cached_property
    def duration_s(self) -> float:
        return self.length_m / self.peak_mps + self.peak_mps / self.acceleration_mps2

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Returns distance [m], speed [m/s] and acceleration [m/s2] at a time since the start [s]; at rest outside."""
        duration, peak, rate = self.duration_s, self.peak_mps, self.acceleration_mps2
        if not 0 <= time_s < duration:
            return (0.0 if time_s < 0 else self.length_m), 0.0, 0.0
        ramp = peak / rate
        if time_s < ramp:
            return 0.5 * rate * time_s**2, rate * time_s, rate
        if time_s < duration - ramp:
            return peak * (time_s - 0.5 * ramp), peak, 0.0
        remaining = duration - time_s
        return self.length_m - 0.5 * rate * remaining**2, rate * remaining, -rate


class Reference(NamedTuple):
    """Reference of the camera or body in the world: position [m], velocity [m/s], yaw [rad] and acceleration [m/s2].

    Shapes: (3,) and a scalar yaw for one time, (n, 3) and yaw (n,) for n times.
    """

    position: Array
    velocity: Array
    yaw: Array | float
    acceleration: Array

    def row(self, k: int) -> "Reference":
        return Reference(*(part[k] for part in self))  # type: ignore[index]


class Line(NamedTuple):
    """Straight line from a start point [m] along a unit direction, with the bow at a constant yaw [rad]."""

    start: Point
    direction: Point
    profile: SpeedProfile
    yaw: float = 0.0

    def points(self) -> Array:
        start = np.array(self.start)
        return np.stack([start, start + self.profile.length_m * np.array(self.direction)])

    def at(self, times_s: Array) -> Reference:
        """Returns the references (n,) at times (n,) since the start [s]."""
        distance, speed, acceleration = _along(self.profile, times_s)
        direction = np.array(self.direction)
        position = np.array(self.start) + distance * direction
        return Reference(position, speed * direction, np.full(len(times_s), self.yaw), acceleration * direction)


class Circle(NamedTuple):
    """Full horizontal circle, counter-clockwise from the start point [m]; the bow keeps a constant yaw [rad]."""

    start: Point
    centre: Point
    profile: SpeedProfile
    yaw: float = 0.0

    def points(self) -> Array:
        """Returns points along the circle (n, 3) [m]; the first and the last are equal."""
        return self._from_centre(np.linspace(0, 2 * np.pi, _CIRCLE_POINTS)) + np.array(self.centre)

    def at(self, times_s: Array) -> Reference:
        distance, speed, acceleration = _along(self.profile, times_s)
        radius_m = math.dist(self.start, self.centre)
        radial = self._from_centre(distance[:, 0] / radius_m) / radius_m
        tangent = np.stack([-radial[:, 1], radial[:, 0], np.zeros(len(times_s))], axis=1)
        return Reference(
            np.array(self.centre) + radius_m * radial,
            speed * tangent,
            np.full(len(times_s), self.yaw),
            acceleration * tangent - speed**2 / radius_m * radial,
        )

    def _from_centre(self, angle: Array) -> Array:
        x, y, _ = np.array(self.start) - self.centre
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c * x - s * y, s * x + c * y, np.zeros_like(c)], axis=-1)


class Turn(NamedTuple):
    """Turn on the spot, about the vertical axis through the camera, whose position does not change."""

    position: Point  # position of the camera [m]
    yaw: float  # yaw at the start [rad]
    sense: float  # +1 counter-clockwise, -1 clockwise
    profile: SpeedProfile  # profile of the rotation angle, in rad, rad/s and rad/s2 instead of m, m/s and m/s2

    def points(self) -> Array:
        return np.array([self.position])

    def at(self, times_s: Array) -> Reference:
        angle = _along(self.profile, times_s)[0, :, 0]
        still = np.zeros((len(times_s), 3))
        return Reference(still + self.position, still, self.yaw + self.sense * angle, still.copy())


Segment = Line | Circle | Turn


def _along(profile: SpeedProfile, times_s: Array) -> Array:
    return np.array([profile.at(t) for t in times_s.tolist()]).reshape(-1, 3).T[:, :, None]


def line(start: Point, end: Point, cruise_mps: float, acceleration_mps2: float, yaw: float = 0.0) -> Line:
    length_m = math.dist(start, end)
    x, y, z = ((b - a) / length_m for a, b in zip(start, end, strict=True))
    return Line(start, (x, y, z), SpeedProfile(length_m, cruise_mps, acceleration_mps2), yaw)


def circle(start: Point, centre: Point, cruise_mps: float, acceleration_mps2: float, yaw: float = 0.0) -> Circle:
    """Returns the circle from a start point about a centre [m], flown with at most `acceleration_mps2` in total.

    The tangential acceleration is chosen so that the total equals the limit when the cruise speed is reached.
    """
    radius_m = math.dist(start, centre)
    cruise_mps = min(cruise_mps, max_circle_speed_mps(radius_m, acceleration_mps2))
    centripetal_mps2 = cruise_mps**2 / radius_m
    tangential_mps2 = math.sqrt(acceleration_mps2**2 - centripetal_mps2**2)
    return Circle(start, centre, SpeedProfile(2 * math.pi * radius_m, cruise_mps, tangential_mps2), yaw)


def max_circle_speed_mps(radius_m: float, acceleration_mps2: float) -> float:
    """Returns the greatest cruise speed v on a circle of radius r for a limit a of the total acceleration [m/s].

    With v^2 / r = a / sqrt(2), centripetal and tangential acceleration are equal at the limit.
    """
    return math.sqrt(radius_m * acceleration_mps2 / math.sqrt(2))
