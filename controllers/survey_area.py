"""Area of a survey: a rectangle, a disc or a polygon, and the direction of the legs in it.

Plans are made in the axes of the legs: u along the legs and v to the left of them, with the origin at the centre of the
area's extent. `SurveyArea` converts between (u, v) and the scene coordinates (x, y).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from twin.core.geometry import Array
from twin.errors import TwinError

Corner = tuple[float, float]
MIN_SIZE_M = 1e-3  # smallest extent of a polygon along and across the legs
MAX_CORNERS = 1000  # each leg of a plan, and each point of a map, is compared with all edges
_EDGE_M = 1e-9  # tolerance: points on the edge count as inside in spite of rounding


@dataclass(frozen=True)
class SurveyArea:
    shape: Literal["rectangle", "disc", "polygon"]  # rectangle, disc or polygon
    size_m: tuple[float, float]  # extent along and across the legs; for a disc, the first value is its diameter
    centre_m: Corner = (0.0, 0.0)  # x, y of the centre of the extent
    heading: float = 0.0  # direction of the legs [rad, counter-clockwise from east]
    corners: tuple[Corner, ...] = ()  # corners (u, v) of a polygon in the axes of the legs [m]; empty for other shapes

    def to_scene(self, u_m: ArrayLike, v_m: ArrayLike) -> tuple[Array, Array]:
        u, v, (c, s) = np.asarray(u_m, np.float64), np.asarray(v_m, np.float64), _cos_sin(self.heading)
        return self.centre_m[0] + (c * u - s * v), self.centre_m[1] + (s * u + c * v)

    def at_fractions(self, fractions: Array) -> Array:
        """Returns the scene points (..., 2) [m] at fractions (..., 2) of the extent, -0.5 to 0.5; 0 is the middle."""
        u, v = np.moveaxis(fractions * self.size_m, -1, 0)
        return np.stack(self.to_scene(u, v), axis=-1)

    def to_legs(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[Array, Array]:
        x, y = np.asarray(x_m, np.float64) - self.centre_m[0], np.asarray(y_m, np.float64) - self.centre_m[1]
        c, s = _cos_sin(self.heading)
        return c * x + s * y, c * y - s * x

    def contains(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        u, v = self.to_legs(x_m, y_m)
        if self.shape == "polygon":
            polygon = self._polygon()
            shapely.prepare(polygon)
            return shapely.intersects_xy(polygon, u, v)
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
        """Returns the least and greatest u [m] of the part of a rectangle or polygon with `low_m` <= v <= `high_m`."""
        reach_m = 2 * self.size_m[0]
        west_m, _, east_m, _ = self._polygon().intersection(shapely.box(-reach_m, low_m, reach_m, high_m)).bounds
        return west_m, east_m

    def _polygon(self) -> shapely.Polygon:
        return shapely.Polygon(self._corners())

    def _corners(self) -> tuple[Corner, ...]:
        if self.shape == "polygon":
            return self.corners
        half_u, half_v = self.size_m[0] / 2, self.size_m[1] / 2
        return (-half_u, -half_v), (half_u, -half_v), (half_u, half_v), (-half_u, half_v)


def polygon_area(corners_m: ArrayLike, heading: float) -> SurveyArea:
    """Returns the area of a polygon (n, 2) in the scene [m], with legs along the heading [rad, counter-clockwise].

    The heading is measured from east. The corners may run in either sense; the first may be repeated at the end. Raises
    TwinError if there are fewer than three or more than MAX_CORNERS corners, a coordinate is not finite, two edges
    intersect, or the extent along or across the legs is less than MIN_SIZE_M.
    """
    corners = np.asarray(corners_m, np.float64).reshape(-1, 2)
    if len(corners) > 1 and np.array_equal(corners[0], corners[-1]):
        corners = corners[:-1]
    if not 3 <= len(corners) <= MAX_CORNERS:
        raise TwinError("plan.polygon", f"{len(corners)} corners", f"3 to {MAX_CORNERS} corners")
    if not np.isfinite(corners).all():
        raise TwinError("plan.polygon", "a coordinate is not finite", "finite numbers")
    if not (polygon := shapely.Polygon(corners)).is_valid:
        problem = f"is not simple: {shapely.is_valid_reason(polygon)}"
        raise TwinError("plan.polygon", problem, "a simple polygon: corners in order along its outline")
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
