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
    """Where camera or body shall be in the world: position [m], velocity [m/s], yaw [rad], acceleration [m/s2].

    At one time (3,), yaw (); or at n times (n, 3), yaw (n,).
    """

    position: Array
    velocity: Array
    yaw: Array | float
    acceleration: Array

    def row(self, k: int) -> Reference:
        """The k-th of n."""
        return Reference(*(part[k] for part in self))  # type: ignore[index]


class Line(NamedTuple):
    """A straight line from a point [m] along a unit direction."""

    start: Point
    direction: Point
    profile: SpeedProfile

    def points(self) -> Array:
        """Its two ends (2, 3) [m]."""
        start = np.array(self.start)
        return np.stack([start, start + self.profile.length_m * np.array(self.direction)])

    def at(self, times_s: Array) -> Reference:
        """Where the camera shall be at times (n,) since the start, bow to the east; at rest before and after."""
        travelled, speed, acceleration = _along(self.profile, times_s)
        direction = np.array(self.direction)
        place = np.array(self.start) + travelled * direction
        return Reference(place, speed * direction, np.zeros(len(times_s)), acceleration * direction)


class Circle(NamedTuple):
    """A whole level circle, counter-clockwise, from a point back to it; both points in metres."""

    start: Point
    centre: Point
    profile: SpeedProfile

    def points(self) -> Array:
        """Points along it (n, 3) [m], close enough to draw and to bound it; the first is the last."""
        return self._around(np.linspace(0, 2 * np.pi, _CIRCLE_POINTS)) + np.array(self.centre)

    def at(self, times_s: Array) -> Reference:
        """Where the camera shall be at times (n,) since the start, bow to the east; at rest before and after."""
        travelled, speed, acceleration = _along(self.profile, times_s)
        radius_m = math.dist(self.start, self.centre)
        outwards = self._around(travelled[:, 0] / radius_m) / radius_m
        ahead = np.stack([-outwards[:, 1], outwards[:, 0], np.zeros(len(times_s))], axis=1)
        return Reference(
            np.array(self.centre) + radius_m * outwards,
            speed * ahead,
            np.zeros(len(times_s)),
            acceleration * ahead - speed**2 / radius_m * outwards,
        )

    def _around(self, angle: Array) -> Array:
        """From the centre to where the circle is after turning by angles (n,) [rad]: (n, 3) [m]."""
        x, y, _ = np.array(self.start) - self.centre
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c * x - s * y, s * x + c * y, np.zeros_like(c)], axis=-1)


Segment = Line | Circle


def _along(profile: SpeedProfile, times_s: Array) -> Array:
    """Distance, speed and acceleration at times (n,): (3, n, 1) [m, m/s, m/s2]."""
    return np.array([profile.at(t) for t in times_s.tolist()]).reshape(-1, 3).T[:, :, None]


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
