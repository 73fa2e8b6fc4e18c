"""Area of a survey: a rectangle, a disc or a polygon, and the direction of the legs in it.

Plans are made in the axes of the legs: u along the legs and v to the left of them, with the origin at the centre of the
area's extent. `SurveyArea` converts between (u, v) and the scene coordinates (x, y).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.errors import TwinError

Array = NDArray[np.float64]
Corner = tuple[float, float]
MIN_SIZE_M = 1e-3  # smallest extent of a polygon along and across the legs
MAX_CORNERS = 1000  # time and memory of `_check_simple` grow with the square of the number of corners
_EDGE_M = 1e-9  # tolerance: points on the edge count as inside in spite of rounding


@dataclass(frozen=True)
class SurveyArea:
    """Area that a survey has to cover, in the scene.

    Args:
        shape: rectangle, disc or polygon.
        size_m: extent along and across the legs; for a disc, the first value is its diameter.
        centre_m: x, y of the centre of the extent.
        heading: direction of the legs [rad, counter-clockwise from east].
        corners: corners (u, v) of a polygon in the axes of the legs [m]; empty for other shapes.
    """

    shape: Literal["rectangle", "disc", "polygon"]
    size_m: tuple[float, float]
    centre_m: Corner = (0.0, 0.0)
    heading: float = 0.0
    corners: tuple[Corner, ...] = ()

    def to_scene(self, u_m: ArrayLike, v_m: ArrayLike) -> tuple[Array, Array]:
        """Converts points from the axes of the legs to x, y in the scene [m]."""
        u, v, (c, s) = np.asarray(u_m, np.float64), np.asarray(v_m, np.float64), _cos_sin(self.heading)
        return self.centre_m[0] + (c * u - s * v), self.centre_m[1] + (s * u + c * v)

    def at_fractions(self, fractions: Array) -> Array:
        """Returns the scene points (..., 2) [m] at fractions of the area's extent along and across the legs.

        Args:
            fractions: (..., 2) fractions, -0.5 to 0.5; 0 is the middle.
        """
        u, v = np.moveaxis(fractions * self.size_m, -1, 0)
        return np.stack(self.to_scene(u, v), axis=-1)

    def to_legs(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[Array, Array]:
        """Converts points from the scene to the axes of the legs [m]."""
        x, y = np.asarray(x_m, np.float64) - self.centre_m[0], np.asarray(y_m, np.float64) - self.centre_m[1]
        c, s = _cos_sin(self.heading)
        return c * x + s * y, c * y - s * x

    def contains(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Returns whether each scene point lies in the area; the edges of a rectangle and a disc belong to it."""
        u, v = self.to_legs(x_m, y_m)
        if self.shape == "polygon":
            return _in_polygon(u, v, self.corners)
        if self.shape == "disc":
            return np.hypot(u, v) <= self.size_m[0] / 2 + _EDGE_M
        return (np.abs(u) <= self.size_m[0] / 2 + _EDGE_M) & (np.abs(v) <= self.size_m[1] / 2 + _EDGE_M)

    def outline(self) -> Array:
        """Returns the closed outline (n, 2) in the scene [m]; for a disc, one point every 2 degrees."""
        if self.shape == "disc":
            angle = np.linspace(0, 2 * np.pi, 181)
            u, v = self.size_m[0] / 2 * np.cos(angle), self.size_m[0] / 2 * np.sin(angle)
        else:
            u, v = np.array([*self._corners(), self._corners()[0]]).T
        return np.column_stack(self.to_scene(u, v))

    def extent_between(self, low_m: float, high_m: float) -> tuple[float, float]:
        """Returns the least and the greatest u [m] of the part of a rectangle or polygon with `low_m` <= v <= `high_m`.

        u is the coordinate along the legs, v the one to the left of them.
        """
        corners = self._corners()
        found = [u for a, b in pairwise([*corners, corners[0]]) for u in _clipped(a, b, low_m, high_m)]
        return min(found), max(found)

    def _corners(self) -> tuple[Corner, ...]:
        """Returns the corners of a rectangle or polygon in the axes of the legs."""
        if self.shape == "polygon":
            return self.corners
        half_u, half_v = self.size_m[0] / 2, self.size_m[1] / 2
        return (-half_u, -half_v), (half_u, -half_v), (half_u, half_v), (-half_u, half_v)


def polygon_area(corners_m: ArrayLike, heading: float) -> SurveyArea:
    """Returns the area of a polygon.

    Args:
        corners_m: (n, 2) corners x, y in the scene, in either sense of rotation; the first may be repeated at the end.
        heading: direction of the legs [rad, counter-clockwise from east].
    Raises:
        TwinError: the polygon has fewer than three or more than MAX_CORNERS corners, a coordinate is not finite, two
            edges intersect, or the extent along or across the legs is less than MIN_SIZE_M.
    """
    corners = np.asarray(corners_m, np.float64).reshape(-1, 2)
    if len(corners) > 1 and np.array_equal(corners[0], corners[-1]):
        corners = corners[:-1]
    if not 3 <= len(corners) <= MAX_CORNERS:
        raise TwinError("plan.polygon", f"{len(corners)} corners", f"3 to {MAX_CORNERS} corners")
    if not np.isfinite(corners).all():
        raise TwinError("plan.polygon", "a coordinate is not finite", "finite numbers")
    _check_simple(corners)
    u, v = SurveyArea("polygon", (0.0, 0.0), heading=heading).to_legs(*corners.T)
    size = float(np.ptp(u)), float(np.ptp(v))
    if min(size) < MIN_SIZE_M:
        raise TwinError("plan.polygon", f"is {size[0]:g} x {size[1]:g} m large", f"at least {MIN_SIZE_M:g} m each way")
    middle_u, middle_v = float(u.min() + size[0] / 2), float(v.min() + size[1] / 2)
    c, s = _cos_sin(heading)
    centre = c * middle_u - s * middle_v, s * middle_u + c * middle_v
    in_legs = tuple((float(a - middle_u), float(b - middle_v)) for a, b in zip(u, v, strict=True))
    return SurveyArea("polygon", size, centre, heading, in_legs)


def _cos_sin(angle: float) -> tuple[float, float]:
    """Returns cosine and sine of an angle [rad]; exact for multiples of a right angle."""
    quarters = angle / (math.pi / 2)
    if abs(quarters - round(quarters)) < 1e-12:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    return math.cos(angle), math.sin(angle)


def _clipped(a: Corner, b: Corner, low_m: float, high_m: float) -> list[float]:
    """Clips the edge from a to b to `low_m` <= v <= `high_m`; returns u [m] of both ends of the clipped edge.

    Corners are pairs (u, v); for u and v see `extent_between`. Returns [] if the edge lies outside.
    """
    (ua, va), (ub, vb) = a, b
    if max(va, vb) < low_m or min(va, vb) > high_m:
        return []
    if va == vb:
        return [ua, ub]
    shares = (min(max((v - va) / (vb - va), 0.0), 1.0) for v in (low_m, high_m))
    return [ua + share * (ub - ua) for share in shares]


def _in_polygon(u: Array, v: Array, corners: tuple[Corner, ...]) -> NDArray[np.bool_]:
    """Returns whether each point lies in a polygon: a ray from it along +u then crosses an odd number of edges."""
    inside = np.zeros(np.broadcast(u, v).shape, np.bool_)
    for (ua, va), (ub, vb) in pairwise([*corners, corners[0]]):
        if va != vb:
            crossing = ua + (v - va) / (vb - va) * (ub - ua)
            inside ^= ((va > v) != (vb > v)) & (u < crossing)
    return inside


def _check_simple(corners: Array) -> None:
    """Raises TwinError if two edges of a polygon (n, 2) touch or cross, except neighbours at their common corner."""
    n, ends = len(corners), np.roll(corners, -1, axis=0)
    number = np.arange(n)
    meet = _edges_meet(corners, ends)
    meet[number, number] = meet[number, (number + 1) % n] = meet[(number + 1) % n, number] = False
    back, ahead = np.roll(corners, 1, axis=0) - corners, ends - corners
    folded = (_cross(back, ahead) == 0) & ((back * ahead).sum(axis=1) >= 0)  # the outline turns back on itself
    meet[number, (number - 1) % n] |= folded
    if meet.any():
        i, j = sorted(np.argwhere(meet)[0] + 1)
        problem = f"edges {i} and {j} intersect"
        raise TwinError("plan.polygon", problem, "a simple polygon: corners in order along its outline")


def _edges_meet(start: Array, end: Array) -> NDArray[np.bool_]:
    """Returns for each pair (n, n) of line segments from `start` (n, 2) to `end` whether they have a common point."""
    low, high = np.minimum(start, end), np.maximum(start, end)
    near = (low[:, None] <= high[None]).all(axis=-1) & (low[None] <= high[:, None]).all(axis=-1)
    along = (end - start)[:, None]
    to_start, to_end = (_cross(along, points[None] - start[:, None]) for points in (start, end))
    apart = to_start * to_end > 0  # [i, j]: both ends of segment j lie on the same side of segment i
    return near & ~apart & ~apart.T


def _cross(a: Array, b: Array) -> Array:
    """Returns the z component of the cross products of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
