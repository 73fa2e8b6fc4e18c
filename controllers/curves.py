"""Curves of a path that is flown at constant speed, bow first: the curvature changes continuously along them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import root_scalar

from twin.controllers.segments import Line, Point, Reference, Segment
from twin.core.geometry import Array

_STEP_M = 0.01  # of the integration along a curve
_RAMP_S = 3.0  # time in which the curvature rises from 0 to its greatest value, or falls to 0


@dataclass(frozen=True)
class SteadySpeed:
    """Speed profile of constant speed, which continues before and after the segment."""

    length_m: float
    cruise_mps: float

    @property
    def duration_s(self) -> float:
        return self.length_m / self.cruise_mps

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Returns distance [m], speed [m/s] and acceleration [m/s2] at a time since the start [s]."""
        return self.cruise_mps * time_s, self.cruise_mps, 0.0


class Bend(NamedTuple):
    """Piece of a curve whose curvature changes linearly over its length; positive to the left."""

    length_m: float
    first_per_m: float
    last_per_m: float


@dataclass(frozen=True)
class Curve:
    """Level curve from a start point [m] and a yaw [rad]; the bow points along it."""

    start: Point
    yaw: float
    bends: tuple[Bend, ...]
    speed_mps: float

    @property
    def profile(self) -> SteadySpeed:
        return SteadySpeed(sum(bend.length_m for bend in self.bends), self.speed_mps)

    @cached_property
    def _samples(self) -> tuple[Array, Array, Array, Array]:
        """Returns distance [m], curvature [1/m], yaw [rad] (n,) and position (n, 2) [m] of points along the curve."""
        ends = np.cumsum([0.0, *(bend.length_m for bend in self.bends)])
        along = np.unique(np.concatenate([np.arange(0.0, ends[-1], _STEP_M), ends]))
        curvature = np.zeros(len(along))
        for bend, low, high in zip(self.bends, ends[:-1], ends[1:], strict=True):
            inside = (along >= low) & (along <= high)
            curvature[inside] = np.interp(along[inside], [low, high], [bend.first_per_m, bend.last_per_m])
        yaw = self.yaw + cumulative_trapezoid(curvature, along, initial=0)
        direction = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        xy = np.array(self.start[:2]) + cumulative_trapezoid(direction, along, axis=0, initial=0)
        return along, curvature, yaw, xy

    def points(self) -> Array:
        _, _, _, xy = self._samples
        return np.column_stack([xy, np.full(len(xy), self.start[2])])

    def at(self, times_s: Array) -> Reference:
        """Returns the references (n,) at times (n,) since the start [s]."""
        along, curvature, yaw, xy = self._samples
        s = self.speed_mps * times_s
        x, y, heading, bend = (np.interp(s, along, values) for values in (*xy.T, yaw, curvature))
        level, c, sine = np.zeros(len(s)), np.cos(heading), np.sin(heading)
        return Reference(
            np.column_stack([x, y, level + self.start[2]]),
            self.speed_mps * np.column_stack([c, sine, level]),
            heading,
            (self.speed_mps**2 * bend)[:, None] * np.column_stack([-sine, c, level]),
        )


PathSegment = Segment | Curve


def end_of(path: Sequence[PathSegment]) -> Point:
    x, y, z = path[-1].points()[-1].tolist()
    return x, y, z


def steady_line(start: Point, yaw: float, length_m: float, speed_mps: float) -> Line:
    return Line(start, (math.cos(yaw), math.sin(yaw), 0.0), SteadySpeed(length_m, speed_mps), yaw)


def u_turn(start: Point, yaw: float, across_m: float, radius_m: float, speed_mps: float) -> Curve:
    """Returns the turn by 180 deg that ends `across_m` to the left of its start, or to the right if negative.

    A half circle with ramps of its curvature (clothoids) where there is room for one of at least `radius_m`; else a
    keyhole turn, which first bends away. It ends abreast of its start.
    """
    sign, bends = math.copysign(1.0, across_m), _bends_of_turn(abs(across_m), radius_m, speed_mps)
    return Curve(start, yaw, tuple(Bend(b.length_m, sign * b.first_per_m, sign * b.last_per_m) for b in bends), speed_mps)


@cache
def _bends_of_turn(across_m: float, radius_m: float, speed_mps: float) -> tuple[Bend, ...]:
    ramp_m, half = _RAMP_S * speed_mps, [math.pi]

    def width_m(angles: Sequence[float], radius: float) -> float:
        curve = Curve((0.0, 0.0, 0.0), 0.0, _bends(angles, radius, ramp_m), speed_mps)
        return float(curve.points()[-1, 1])

    def keyhole(away: float) -> list[float]:
        return [-away, math.pi + 2 * away, -away]

    if width_m(half, radius_m) > across_m:
        away = root_scalar(lambda a: width_m(keyhole(a), radius_m) - across_m, bracket=(1e-6, math.pi / 2), xtol=1e-10)
        return _bends(keyhole(away.root), radius_m, ramp_m)
    wide = root_scalar(lambda r: width_m(half, r) - across_m, bracket=(radius_m, across_m / 2), xtol=1e-10)
    return _bends(half, wide.root, ramp_m)


def _bends(angles: Sequence[float], radius_m: float, ramp_m: float) -> tuple[Bend, ...]:
    """Returns the pieces of arcs by angles [rad], each with a ramp of its curvature at both ends."""
    bends: list[Bend] = []
    for angle in angles:
        peak = math.copysign(min(1 / radius_m, abs(angle) / ramp_m), angle)
        bends.append(Bend(ramp_m, 0.0, peak))
        if (rest_m := angle / peak - ramp_m) > 0:
            bends.append(Bend(rest_m, peak, peak))
        bends.append(Bend(ramp_m, peak, 0.0))
    return tuple(bends)
