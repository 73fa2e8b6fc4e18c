"""Sizes of the objects in the tank, measured in the elevation map and compared with their true sizes.

Floor that the objects hide from the cameras is found by ray casting in the estimated map.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.height_field import cast_pixels, map_height_field
from twin.core.records import MapGrid, StereoRig
from twin.reproduce.experiment_floors import TankObject

Array = NDArray[np.floating]

MARGIN_M = 0.04  # margin of the window around an object; the outer half of the margin shows the floor
PLATEAU = 0.75  # cells above this fraction of the 90th percentile of height belong to the top of a box or a disc
CENTRAL = 0.5  # extents are medians over lines through the central part of a box or a pipe, a fraction of its size
CENTRAL_ROUND = 0.15  # the same for a disc or a dome
#: A floor point is hidden if its ray meets the map earlier by more than this fraction of the distance to the camera.
HIDDEN_BEFORE = 1e-3
CREST = 0.3  # the crest of a pipe is this fraction of its width; it lies 1.4 mm below the highest line at most


class Size(NamedTuple):
    """Extents of an object along x and y at half of its height, and its height above the floor [m]; NaN if unknown."""

    x_m: float
    y_m: float
    height_m: float


class SizeRow(NamedTuple):
    name: str
    measured: Size
    true: Size

    @property
    def errors_m(self) -> Size:
        return Size(*np.subtract(self.measured, self.true).tolist())


class Window(NamedTuple):
    x_m: Array  #: (cols,) x of the cell centres, relative to the centre of the object
    y_m: Array  #: (rows,) y likewise
    height_m: Array  #: (rows, cols) height above the floor around the object; NaN where unknown


def measure(item: TankObject, height_m: Array, grid: MapGrid, hidden: NDArray[np.bool_] | None = None) -> SizeRow:
    """Returns the size of an object measured in a map of heights (rows, cols) [m], and its true size.

    Cells that the objects hide (`hidden_cells`) count as floor. The height of a pipe is NaN unless most of the lines
    across its central part have a height near its axis; other objects have a top that is large enough to be measured
    beside a hole.
    """
    window = _window(item, height_m, grid, hidden)
    top = _TOPS[item.shape](window)
    share = CENTRAL_ROUND if item.shape in ("disc", "dome") else CENTRAL
    along_x, along_y = (np.abs(at) <= share * side / 2 for at, side in zip(window[:2], item.size_m, strict=False))
    x_m = _median(_extent(window.x_m, line, top / 2) for line in window.height_m[along_y])
    y_m = _median(_extent(window.y_m, line, top / 2) for line in window.height_m[:, along_x].T)
    if item.shape == "pipe":
        crest = window.height_m[np.ix_(np.abs(window.y_m) <= CREST * item.size_m[1] / 2, along_x)]
        top = top if np.isfinite(crest).any(axis=0).mean() > 0.5 else np.nan
    return SizeRow(item.name, Size(x_m, y_m, top), true_size(item))


def true_size(item: TankObject) -> Size:
    """Returns the true extents of an object at half of its height, and its height."""
    share = np.sqrt(3) / 2 if item.shape == "dome" else 1.0  # an ellipsoid of height c is sqrt(1 - 1/4) wide at c / 2
    return Size(share * item.size_m[0], share * item.size_m[1], item.size_m[2])


def _window(item: TankObject, height_m: Array, grid: MapGrid, hidden: NDArray[np.bool_] | None) -> Window:
    """Returns the window of an object; heights are above their median in the outer half of the margin."""
    x, y = (axis - c for axis, c in zip(grid.centres(), item.centre_m, strict=True))
    inside = [np.abs(axis) <= side / 2 + MARGIN_M for axis, side in zip((x, y), item.size_m, strict=False)]
    part = height_m[np.ix_(inside[1], inside[0])].astype(np.float64)
    x, y = x[inside[0]], y[inside[1]]
    beside = (np.abs(x) > item.size_m[0] / 2 + MARGIN_M / 2) | (np.abs(y) > item.size_m[1] / 2 + MARGIN_M / 2)[:, None]
    floor = part[beside & np.isfinite(part)]
    above = part - (np.median(floor) if floor.size else np.nan)
    return Window(x, y, above if hidden is None else np.where(hidden[np.ix_(inside[1], inside[0])], 0.0, above))


def _plateau(window: Window) -> float:
    """Returns the median height of a flat top [m]; NaN without heights."""
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
    """Returns the distance between the outermost rises (`_rise`) of heights (n,) at places (n,) to a level [m]."""
    # from outside to inside, so that holes and mismatches on top of an object do not count; NaN heights are ignored
    known = np.isfinite(height_m)
    if not np.isfinite(level_m) or not known.any():
        return np.nan
    at, above = at_m[known], height_m[known] - level_m
    ends = [_rise(at[side], above[side]) for side in (at >= 0, at <= 0)]
    return ends[0] - ends[1]


def _rise(at: Array, above: Array) -> float:
    """Returns the place farthest from 0 at which heights (n,) above a level turn positive [m], interpolated; or NaN."""
    # NaN if the profile does not rise, or is above the level at its end
    order = np.argsort(-np.abs(at))
    at, above = at[order], above[order]
    higher = np.flatnonzero(above > 0)
    if not len(higher) or higher[0] == 0:
        return np.nan
    k = int(higher[0])
    share = above[k] / (above[k] - above[k - 1])
    return float(at[k] + share * (at[k - 1] - at[k]))


def _median(values: Iterable[float]) -> float:
    found = [value for value in values if np.isfinite(value)]
    return float(np.median(found)) if found else np.nan


def hidden_cells(height_m: NDArray[np.floating], grid: MapGrid, poses: Array, rig: StereoRig) -> NDArray[np.bool_]:
    """Returns a mask (rows, cols) of the cells without a height whose floor an object hides in every stereo pair.

    The floor of a cell, at the median height of the map, is visible in a pair if it lies in both images and nothing in
    the map is between it and one of the cameras. Cells whose floor lies in no pair of images are not in the mask. The
    poses (n, 4, 4) are the estimated world_from_camera of the left images.
    """
    unknown = np.isnan(height_m)
    if unknown.all():
        return np.zeros(height_m.shape, np.bool_)
    floor_m = float(np.nanmedian(height_m))
    field = map_height_field(np.where(unknown, floor_m, height_m), grid)
    x, y = (axis[unknown] for axis in np.meshgrid(*grid.centres()))
    floor, last_px = np.column_stack([x, y, np.full(len(x), floor_m)]), [rig.width_px - 1, rig.height_px - 1]
    in_images, visible = np.zeros((2, len(floor)), np.bool_)
    for left in poses:
        cameras = (left, left @ geometry.pose(np.eye(3), np.array([rig.baseline_m, 0.0, 0.0])))
        points = [geometry.transform(geometry.inverse(camera), floor) for camera in cameras]
        pixels = [rig.project(seen) for seen in points]
        inside = np.all([(place >= 0) & (place <= last_px) for place in pixels], axis=(0, 2))  # NaN is outside
        clear = [
            cast_pixels(field, camera[None], rig, place[inside])[0] >= (1 - HIDDEN_BEFORE) * seen[inside, 2]
            for camera, seen, place in zip(cameras, points, pixels, strict=True)
        ]
        in_images |= inside
        visible[inside] |= np.logical_and(*clear)
    hidden = np.zeros(height_m.shape, np.bool_)
    hidden[unknown] = in_images & ~visible
    return hidden
