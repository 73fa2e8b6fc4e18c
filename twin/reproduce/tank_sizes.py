"""Sizes of the objects in the tank, measured in the elevation map and compared with their true sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import MapGrid
from twin.reproduce.tank_scene import TankObject

Array = NDArray[np.floating]

MARGIN_M = 0.04  # margin of the window around an object; the outer half of the margin shows the floor
PLATEAU = 0.75  # cells above this fraction of the 90th percentile of height belong to the top of a box or a disc
CENTRAL = 0.5  # extents are medians over lines through the central part of a box or a pipe, a fraction of its size
CENTRAL_ROUND = 0.15  # the same for a disc or a dome
CREST = 0.3  # the crest of a pipe is this fraction of its width; it lies 1.4 mm below the highest line at most


class Size(NamedTuple):
    """Extents of an object along x and y at half of its height, and its height above the floor [m]; NaN if unknown."""

    x_m: float
    y_m: float
    height_m: float


class SizeRow(NamedTuple):
    """Measured and true size of one object."""

    name: str
    measured: Size
    true: Size

    @property
    def errors_m(self) -> Size:
        """Returns measured minus true size [m]."""
        return Size(*np.subtract(self.measured, self.true).tolist())


class Window(NamedTuple):
    """Part of a map around an object.

    Args:
        x_m, y_m: (cols,), (rows,) coordinates of the cell centres relative to the centre of the object.
        height_m: (rows, cols) height above the floor around the object; NaN where unknown.
    """

    x_m: Array
    y_m: Array
    height_m: Array


def measure(item: TankObject, height_m: Array, grid: MapGrid, hidden: NDArray[np.bool_] | None = None) -> SizeRow:
    """Returns the size of an object measured in a map of heights (rows, cols) [m], and its true size.

    Args:
        item: the object.
        height_m: heights of the map [m]; NaN where unknown.
        grid: grid of the map.
        hidden: mask (rows, cols) of the cells that the objects hide (`hidden_cells`), which count as floor; None: none.
    """
    window = window_around(item, height_m, grid, hidden)
    top = _TOPS[item.shape](window)
    share = CENTRAL_ROUND if item.shape in ("disc", "dome") else CENTRAL
    across = np.abs(window.y_m) <= share * item.size_m[1] / 2, np.abs(window.x_m) <= share * item.size_m[0] / 2
    lines = window.height_m[across[0]], window.height_m[:, across[1]].T
    x_m, y_m = (
        _median(_extent(at, line, top / 2) for line in rows) for at, rows in zip(window[:2], lines, strict=True)
    )
    return SizeRow(item.name, Size(x_m, y_m, top if _shows_crest(item, window) else np.nan), true_size(item))


def true_size(item: TankObject) -> Size:
    """Returns the true extents of an object at half of its height, and its height."""
    share = np.sqrt(3) / 2 if item.shape == "dome" else 1.0  # an ellipsoid of height c is sqrt(1 - 1/4) wide at c / 2
    return Size(share * item.size_m[0], share * item.size_m[1], item.size_m[2])


def _shows_crest(item: TankObject, window: Window) -> bool:
    """Returns whether the map has heights at the crest of an object, without which its height cannot be measured.

    This is the case if most of the lines across the central part of a pipe have a height near its axis. Objects with
    another shape have a top that is large enough to be measured beside a hole.
    """
    if item.shape != "pipe":
        return True
    along, crest = (
        np.abs(axis) <= share * side / 2
        for axis, share, side in zip(window[:2], (CENTRAL, CREST), item.size_m, strict=False)
    )
    return bool(np.isfinite(window.height_m[np.ix_(crest, along)]).any(axis=0).mean() > 0.5)


def window_around(item: TankObject, height_m: Array, grid: MapGrid, hidden: NDArray[np.bool_] | None = None) -> Window:
    """Returns the part of a map around an object; heights are above their median in the outer half of the margin.

    Arguments as for `measure`.
    """
    x, y = (axis - c for axis, c in zip(grid.centres(), item.centre_m, strict=True))
    inside = [np.abs(axis) <= side / 2 + MARGIN_M for axis, side in zip((x, y), item.size_m, strict=False)]
    part = height_m[np.ix_(inside[1], inside[0])].astype(np.float64)
    x, y = x[inside[0]], y[inside[1]]
    beside = (np.abs(x) > item.size_m[0] / 2 + MARGIN_M / 2) | (np.abs(y) > item.size_m[1] / 2 + MARGIN_M / 2)[:, None]
    floor = part[beside & np.isfinite(part)]
    above = part - (np.median(floor) if floor.size else np.nan)
    return Window(x, y, above if hidden is None else np.where(hidden[np.ix_(inside[1], inside[0])], 0.0, above))


def _plateau(window: Window) -> float:
    """Returns the median height of the cells on top of an object with a flat top [m]; NaN without heights."""
    known = window.height_m[np.isfinite(window.height_m)]
    if known.size == 0:
        return np.nan
    return float(np.median(known[known >= PLATEAU * np.percentile(known, 90)]))


def _summit(window: Window) -> float:
    """Returns the height of the vertex of a paraboloid fitted to the cap of a dome [m]; NaN for fewer than 12 cells."""
    x, y = np.meshgrid(window.x_m, window.y_m)
    known = np.isfinite(window.height_m)
    reach = 0.3 * max(np.abs(window.x_m).max() - MARGIN_M, 0.0)
    cap = known & (np.hypot(x, y) <= reach)
    if cap.sum() < 12:
        return np.nan
    a, b = x[cap], y[cap]
    terms = np.column_stack([np.ones_like(a), a, b, a**2, a * b, b**2])
    c = np.linalg.lstsq(terms, window.height_m[cap], rcond=None)[0]
    vertex = np.linalg.solve(-np.array([[2 * c[3], c[4]], [c[4], 2 * c[5]]]), c[1:3])
    return float(c[0] + c[1:3] @ vertex / 2)


def _crest(window: Window) -> float:
    """Returns the height of the crest of a pipe along x [m]: the median over x of the greatest height across it."""
    along = np.abs(window.x_m) <= CENTRAL * (np.abs(window.x_m).max() - MARGIN_M)
    part = window.height_m[:, along]
    known = part[:, np.isfinite(part).any(axis=0)]
    return float(np.median(np.nanmax(known, axis=0))) if known.size else np.nan


_TOPS: dict[str, Callable[[Window], float]] = {"box": _plateau, "disc": _plateau, "dome": _summit, "pipe": _crest}


def _extent(at_m: Array, height_m: Array, level_m: float) -> float:
    """Returns the distance between the outermost places on both sides of 0 where a profile rises to a level [m].

    The places are interpolated linearly between the last point at or below the level and the first one above it, from
    outside to inside, so that holes and mismatches on top of an object do not count. NaN if the profile does not rise
    above the level on both sides, or is above it at an end.

    Args:
        at_m: (n,) places along the profile, relative to the centre of the object [m].
        height_m: (n,) heights [m]; points without a height are ignored.
        level_m: the level [m].
    """
    known = np.isfinite(height_m)
    if not np.isfinite(level_m) or not known.any():
        return np.nan
    at, above = at_m[known], height_m[known] - level_m
    ends = [_rise(at[side], above[side]) for side in (at >= 0, at <= 0)]
    return ends[0] - ends[1]


def _rise(at: Array, above: Array) -> float:
    """Returns the place farthest from 0 at which a profile rises above the level, towards 0 [m]; NaN if it does not.

    Args:
        at: (n,) places along the profile on one side of 0 [m].
        above: (n,) height above the level at these places [m].
    """
    order = np.argsort(-np.abs(at))
    at, above = at[order], above[order]
    higher = np.flatnonzero(above > 0)
    if not len(higher) or higher[0] == 0:
        return np.nan
    k = int(higher[0])
    share = above[k] / (above[k] - above[k - 1])
    return float(at[k] + share * (at[k - 1] - at[k]))


def _median(values: Iterable[float]) -> float:
    """Returns the median of the finite values; NaN if there are none."""
    found = np.array([value for value in values if np.isfinite(value)])
    return float(np.median(found)) if found.size else np.nan
