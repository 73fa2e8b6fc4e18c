"""Area of a survey: a rectangle, a disc or polygons with holes, and the direction of the legs in it.

Plans are made in the axes of the legs: u along the legs and v to the left of them, with the origin at the centre of the
area's extent. `SurveyArea` converts between (u, v) and the scene coordinates (x, y).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from twin.core.geometry import Array
from twin.errors import TwinError

Corner = tuple[float, float]
Ring = tuple[Corner, ...]
MIN_SIZE_M = 1e-3  # smallest extent of a polygon along and across the legs
MAX_CORNERS = 1000  # each leg of a plan, and each point of a map, is compared with all edges
_EDGE_M = 1e-9  # tolerance: points on the edge count as inside in spite of rounding


@dataclass(frozen=True)
class SurveyArea:
    shape: Literal["rectangle", "disc", "polygon"]  # rectangle, disc or one or more polygons
    size_m: tuple[float, float]  # extent along and across the legs; for a disc, the first value is its diameter
    centre_m: Corner = (0.0, 0.0)  # x, y of the centre of the extent
    heading: float = 0.0  # direction of the legs [rad, counter-clockwise from east]
    #: for each polygon, the corners (u, v) of its outline and of its holes, in the axes of the legs [m]; else empty
    polygons: tuple[tuple[Ring, ...], ...] = ()

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

    def vectors_to_legs(self, vectors: Array) -> Array:
        """Returns horizontal vectors (n, 2) of the scene in the axes of the legs."""
        c, s = _cos_sin(self.heading)
        return vectors @ np.array([[c, -s], [s, c]])

    def contains(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        u, v = self.to_legs(x_m, y_m)
        if self.shape == "polygon":
            polygons = self._geometry()
            shapely.prepare(polygons)
            return shapely.intersects_xy(polygons, u, v)
        if self.shape == "disc":
            return np.hypot(u, v) <= self.size_m[0] / 2 + _EDGE_M
        return (np.abs(u) <= self.size_m[0] / 2 + _EDGE_M) & (np.abs(v) <= self.size_m[1] / 2 + _EDGE_M)

    def outlines(self) -> list[Array]:
        """Returns the closed outlines (n, 2) of the area and its holes in the scene [m]; every 2 deg on a disc."""
        if self.shape == "disc":
            angle = np.linspace(0, 2 * np.pi, 181)
            rings = [self.size_m[0] / 2 * np.column_stack([np.cos(angle), np.sin(angle)])]
        else:
            rings = [np.array([*ring, ring[0]]) for rings in self._rings() for ring in rings]
        return [np.column_stack(self.to_scene(*ring.T)) for ring in rings]

    def outline(self) -> Array:
        """Returns the points (n, 2) of all outlines in the scene [m]."""
        return np.concatenate(self.outlines())

    def extent_between(self, low_m: float, high_m: float) -> tuple[float, float]:
        """Returns the least and greatest u [m] of the part of a rectangle or polygon with `low_m` <= v <= `high_m`."""
        reach_m = 2 * self.size_m[0]
        west_m, _, east_m, _ = self._geometry().intersection(shapely.box(-reach_m, low_m, reach_m, high_m)).bounds
        return west_m, east_m

    def bands(self) -> list[tuple[float, float]]:
        """Returns the intervals of v [m] in which the area has points, in ascending order; several if it has gaps."""
        spans = sorted((min(v for _, v in rings[0]), max(v for _, v in rings[0])) for rings in self._rings())
        bands = spans[:1]
        for low, high in spans[1:]:
            if low <= bands[-1][1]:
                bands[-1] = bands[-1][0], max(high, bands[-1][1])
            else:
                bands.append((low, high))
        return bands if len(bands) > 1 else [(-self.size_m[1] / 2, self.size_m[1] / 2)]

    def _geometry(self) -> shapely.Polygon | shapely.MultiPolygon:
        polygons = [shapely.Polygon(outline, holes) for outline, *holes in self._rings()]
        return polygons[0] if len(polygons) == 1 else shapely.MultiPolygon(polygons)

    def _rings(self) -> tuple[tuple[Ring, ...], ...]:
        if self.shape == "polygon":
            return self.polygons
        half_u, half_v = self.size_m[0] / 2, self.size_m[1] / 2
        return ((((-half_u, -half_v), (half_u, -half_v), (half_u, half_v), (-half_u, half_v)),),)


def polygons_area(polygons_m: Sequence[Sequence[ArrayLike]], heading: float) -> SurveyArea:
    """Returns the area of polygons in the scene [m], with legs along the heading [rad, counter-clockwise from east].

    Each has the corners (n, 2) of its outline and of its holes, in either sense; the first may be repeated at the end.
    Polygons may touch or overlap. Raises TwinError if a ring has fewer than three corners, or all together more than
    MAX_CORNERS; a coordinate is not finite; two edges of a polygon intersect, or a hole lies outside it; or the extent
    along or across the legs is less than MIN_SIZE_M.
    """
    rings = _united([[_ring(corners) for corners in polygon] for polygon in polygons_m])
    legs = SurveyArea("polygon", (0.0, 0.0), heading=heading)
    in_legs = [[np.column_stack(legs.to_legs(*ring.T)) for ring in polygon] for polygon in rings]
    corners = np.concatenate([ring for polygon in in_legs for ring in polygon])
    size = float(np.ptp(corners[:, 0])), float(np.ptp(corners[:, 1]))
    if min(size) < MIN_SIZE_M:
        raise TwinError("plan.polygon", f"is {size[0]:g} x {size[1]:g} m large", f"at least {MIN_SIZE_M:g} m each way")
    low_u, low_v = corners.min(axis=0)
    middle_u, middle_v = float(low_u + size[0] / 2), float(low_v + size[1] / 2)
    c, s = _cos_sin(heading)
    centre = c * middle_u - s * middle_v, s * middle_u + c * middle_v
    moved = tuple(
        tuple(tuple((float(u - middle_u), float(v - middle_v)) for u, v in ring) for ring in polygon)
        for polygon in in_legs
    )
    return SurveyArea("polygon", size, centre, heading, moved)


def _ring(corners_m: ArrayLike) -> Array:
    """Returns the corners (n, 2) of a ring without a repeated first one."""
    corners = np.asarray(corners_m, np.float64).reshape(-1, 2)
    return corners[:-1] if len(corners) > 1 and np.array_equal(corners[0], corners[-1]) else corners


def _united(rings: list[list[Array]]) -> list[list[Array]]:
    """Returns the rings of the union of polygons, which may touch or overlap; a single one as it is given."""
    counts = [len(ring) for polygon in rings for ring in polygon]
    if min(counts) < 3 or sum(counts) > MAX_CORNERS:
        shown = min(counts) if min(counts) < 3 else sum(counts)
        raise TwinError("plan.polygon", f"{shown} corners", f"3 to {MAX_CORNERS} corners")
    if not all(np.isfinite(ring).all() for polygon in rings for ring in polygon):
        raise TwinError("plan.polygon", "a coordinate is not finite", "finite numbers")
    polygons = [shapely.Polygon(outline, holes) for outline, *holes in rings]
    for polygon in polygons:
        if not polygon.is_valid:
            allowed = "a simple polygon: corners in order along its outline, holes inside it"
            raise TwinError("plan.polygon", f"is not simple: {shapely.is_valid_reason(polygon)}", allowed)
    if len(polygons) == 1:
        return rings
    united = shapely.get_parts(shapely.union_all(polygons))
    return [[_ring(shapely.get_coordinates(ring)) for ring in (p.exterior, *p.interiors)] for p in united]


def _cos_sin(angle: float) -> tuple[float, float]:
    """Returns cosine and sine of an angle [rad]; exact for multiples of a right angle."""
    quarters = angle / (math.pi / 2)
    if abs(quarters - round(quarters)) < 1e-12:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    return math.cos(angle), math.sin(angle)
