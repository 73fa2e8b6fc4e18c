"""Curves of a path that is flown at constant speed, bow first: the curvature changes continuously along them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import root_scalar

from twin.controllers.segments import Line, Point, Reference, Segment, SpeedProfile
from twin.core.geometry import Array

_STEP_M = 0.01  # of the integration along a curve
_RAMP_S = 3.0  # time in which the curvature rises from 0 to its greatest value, or falls to 0

#: Curvatures [1/m], positive to the left, at distances [m] from the start; linear between them.
Bends = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Curve:
    """Level curve from a start point [m] and a yaw [rad]; the bow points along it."""

    start: Point
    yaw: float
    bends: Bends
    speed_mps: float

    @property
    def profile(self) -> SpeedProfile:
        return SpeedProfile(self.bends[-1][0], self.speed_mps, math.inf)

    @cached_property
    def _samples(self) -> tuple[Array, Array]:
        """Returns distances (n,) [m], and rows x, y [m], yaw [rad] and curvature [1/m] (4, n) there."""
        ends, curvatures = np.array(self.bends).T
        along = np.unique(np.concatenate([np.arange(0.0, ends[-1], _STEP_M), ends]))
        curvature = np.interp(along, ends, curvatures)
        yaw = self.yaw + cumulative_trapezoid(curvature, along, initial=0)
        x, y = (cumulative_trapezoid(f(yaw), along, initial=0) for f in (np.cos, np.sin))
        return along, np.stack([x + self.start[0], y + self.start[1], yaw, curvature])

    def points(self) -> Array:
        x, y, *_ = self._samples[1]
        return np.column_stack([x, y, np.full(len(x), self.start[2])])

    def at(self, times_s: Array) -> Reference:
        """Returns the references (n,) at times (n,) since the start [s]."""
        along, rows = self._samples
        x, y, yaw, curvature = (np.interp(self.speed_mps * times_s, along, row) for row in rows)
        level, c, s = np.zeros(len(yaw)), np.cos(yaw), np.sin(yaw)
        centripetal = (self.speed_mps**2 * curvature)[:, None] * np.column_stack([-s, c, level])
        velocity = self.speed_mps * np.column_stack([c, s, level])
        return Reference(np.column_stack([x, y, level + self.start[2]]), velocity, yaw, centripetal)


PathSegment = Segment | Curve


def end_of(path: Sequence[PathSegment]) -> Point:
    x, y, z = path[-1].points()[-1].tolist()
    return x, y, z


def steady_line(start: Point, yaw: float, length_m: float, speed_mps: float) -> Line:
    profile = SpeedProfile(length_m, speed_mps, math.inf)
    return Line(start, (math.cos(yaw), math.sin(yaw), 0.0), profile, yaw)


def u_turn(start: Point, yaw: float, across_m: float, radius_m: float, speed_mps: float) -> Curve:
    """Returns the turn by 180 deg that ends abreast of its start, `across_m` to the left (negative: to the right)."""
    # a half circle with clothoid ramps where one of at least `radius_m` fits; else a keyhole turn, which first bends
    # away
    bends = _bends_of_turn(abs(across_m), radius_m, speed_mps)
    return Curve(start, yaw, tuple((s, math.copysign(k, k * across_m)) for s, k in bends), speed_mps)


@cache
def _bends_of_turn(across_m: float, radius_m: float, speed_mps: float) -> Bends:
    def excess_m(away: float, radius: float) -> float:
        bends = _bends([-away, math.pi + 2 * away, -away], radius, _RAMP_S * speed_mps)
        return float(Curve((0.0, 0.0, 0.0), 0.0, bends, speed_mps).points()[-1, 1]) - across_m

    away, radius = 0.0, radius_m
    if excess_m(0.0, radius_m) > 0:
        away = root_scalar(excess_m, args=(radius_m,), bracket=(0.0, math.pi / 2), xtol=1e-10).root
    else:
        radius = root_scalar(lambda r: excess_m(0.0, r), bracket=(radius_m, across_m / 2), xtol=1e-10).root
    return _bends([-away, math.pi + 2 * away, -away], radius, _RAMP_S * speed_mps)


def _bends(angles: Sequence[float], radius_m: float, ramp_m: float) -> Bends:
    """Returns arcs by angles [rad], each with a ramp of its curvature at both ends."""
    bends = [(0.0, 0.0)]
    for angle in angles:
        peak = math.copysign(min(1 / radius_m, abs(angle) / ramp_m), angle)
        if peak:
            start_m, length_m = bends[-1][0], angle / peak + ramp_m
            bends += [(start_m + s, k) for s, k in ((ramp_m, peak), (length_m - ramp_m, peak), (length_m, 0.0))]
    return tuple(bends)
