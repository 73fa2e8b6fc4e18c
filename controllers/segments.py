"""The pieces of a planned path, each flown from rest to rest: straight lines and whole circles."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.profile import SpeedProfile

Array = NDArray[np.float64]
Point = tuple[float, float, float]

_CIRCLE_POINTS = 181  # every second degree


class Reference(NamedTuple):
    """Where camera or body shall be in the world: position [m], velocity [m/s], yaw [rad], acceleration [m/s2]."""

    position: Array
    velocity: Array
    yaw: float
    acceleration: Array


class Line(NamedTuple):
    """A straight line from a point [m] along a unit direction."""

    start: Point
    direction: Point
    profile: SpeedProfile

    def points(self) -> Array:
        """Its two ends (2, 3) [m]."""
        start = np.array(self.start)
        return np.stack([start, start + self.profile.length_m * np.array(self.direction)])

    def at(self, time_s: float) -> Reference:
        """Where the camera shall be at a time since the start, bow to the east; at rest before and after."""
        travelled, speed, acceleration = self.profile.at(time_s)
        direction = np.array(self.direction)
        return Reference(np.array(self.start) + travelled * direction, speed * direction, 0.0, acceleration * direction)


class Circle(NamedTuple):
    """A whole level circle, counter-clockwise, from a point back to it; both points in metres."""

    start: Point
    centre: Point
    profile: SpeedProfile

    def points(self) -> Array:
        """Points along it (n, 3) [m], close enough to draw and to bound it; the first is the last."""
        return self._around(np.linspace(0, 2 * np.pi, _CIRCLE_POINTS)) + np.array(self.centre)

    def at(self, time_s: float) -> Reference:
        """Where the camera shall be at a time since the start, bow to the east; at rest before and after."""
        travelled, speed, acceleration = self.profile.at(time_s)
        radius_m = math.dist(self.start, self.centre)
        outwards = self._around(np.array([travelled / radius_m]))[0] / radius_m
        ahead = np.array([-outwards[1], outwards[0], 0.0])
        return Reference(
            np.array(self.centre) + radius_m * outwards,
            speed * ahead,
            0.0,
            acceleration * ahead - speed**2 / radius_m * outwards,
        )

    def _around(self, angle: Array) -> Array:
        """From the centre to where the circle is after turning by angles (n,) [rad]: (n, 3) [m]."""
        x, y, _ = np.array(self.start) - self.centre
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c * x - s * y, s * x + c * y, np.zeros_like(c)], axis=-1)


Segment = Line | Circle


def line(start: Point, end: Point, cruise_mps: float, acceleration_mps2: float) -> Line:
    """The line between two points, no faster than a cruise speed; it speeds up and slows down at a constant rate."""
    length_m = math.dist(start, end)
    x, y, z = ((b - a) / length_m for a, b in zip(start, end, strict=True))
    return Line(start, (x, y, z), SpeedProfile(length_m, cruise_mps, acceleration_mps2))


def circle(start: Point, centre: Point, cruise_mps: float, acceleration_mps2: float) -> Circle:
    """The circle through a point about a centre whose acceleration, along and across the path, keeps to a limit.

    The cruise speed is cut to `circling_mps`; what the turn leaves of the limit speeds the vehicle up.
    """
    radius_m = math.dist(start, centre)
    cruise_mps = min(cruise_mps, circling_mps(radius_m, acceleration_mps2))
    across_mps2 = cruise_mps**2 / radius_m
    along_mps2 = math.sqrt(acceleration_mps2**2 - across_mps2**2)
    return Circle(start, centre, SpeedProfile(2 * math.pi * radius_m, cruise_mps, along_mps2))


def circling_mps(radius_m: float, acceleration_mps2: float) -> float:
    """Greatest speed on a circle: v^2 / r = a / sqrt(2) leaves as much acceleration along the path as across it."""
    return math.sqrt(radius_m * acceleration_mps2 / math.sqrt(2))
