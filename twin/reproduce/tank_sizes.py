"""Sizes of the objects in the tank, measured in the elevation map and compared with their true sizes.

Floor that the objects hide from the cameras is found by ray casting in the estimated map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.height_field import cast_ray, map_height_field
from twin.core.records import MapGrid, StereoRig
from twin.kernels import kernel
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
    """Measured and true size of one object."""

    name: str
    measured: Size
    true: Size

    @property
    def errors_m(self) -> Size:
        """Returns measured minus true size [m]."""
        return Size(*np.subtract(self.measured, self.true).tolist())


class Window(NamedTuple):
    """Part of a map around an object."""

    #: x_m, y_m: (cols,), (rows,) coordinates of the cell centres relative to the centre of the object.
    x_m: Array
    y_m: Array
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
    """Returns the part of a map around an object; heights are above their median in the outer half of the margin."""
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

    The profile has heights (n,) at places (n,) relative to the centre of the object [m]; NaN heights are ignored. The
    places are interpolated linearly between the last point at or below the level and the first one above it, from
    outside to inside, so that holes and mismatches on top of an object do not count. NaN if the profile does not rise
    above the level on both sides, or is above it at an end.
    """
    known = np.isfinite(height_m)
    if not np.isfinite(level_m) or not known.any():
        return np.nan
    at, above = at_m[known], height_m[known] - level_m
    ends = [_rise(at[side], above[side]) for side in (at >= 0, at <= 0)]
    return ends[0] - ends[1]


def _rise(at: Array, above: Array) -> float:
    """Returns the place farthest from 0 at which a profile on one side of 0 rises above the level, towards 0 [m].

    The heights (n,) are above the level. NaN if the profile does not rise, or is above the level at its end.
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


def hidden_cells(height_m: NDArray[np.floating], grid: MapGrid, poses: Array, rig: StereoRig) -> NDArray[np.bool_]:
    """Returns a mask (rows, cols) of the cells without a height whose floor an object hides in every stereo pair.

    The floor of a cell is visible in a pair if it lies in both images and no object is between it and one of the
    cameras. The level floor has the median height of the map; the objects are the heights of the map. A cell on top of
    an object is not hidden, so that a cell in the mask is floor beside an object. Cells whose floor lies in no pair of
    images are not in the mask. The poses (n, 4, 4) are the estimated world_from_camera of the left images.
    """
    unknown = np.isnan(height_m)
    if unknown.all():
        return np.zeros(height_m.shape, np.bool_)
    floor_m = float(np.nanmedian(height_m))
    field = map_height_field(np.where(unknown, floor_m, height_m), grid)
    x, y = (axis[unknown] for axis in np.meshgrid(*grid.centres()))
    camera = (rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.width_px - 1.0, rig.height_px - 1.0, rig.baseline_m)
    hidden = np.zeros(height_m.shape, np.bool_)
    hidden[unknown] = _hidden(field, np.ascontiguousarray(poses, np.float64), camera, x, y, floor_m)
    return hidden


@kernel
def _hidden(field, poses, camera, xs, ys, z):
    """Compiled kernel of `hidden_cells`, for the floor points (xs, ys, z)."""
    fx, fy, cx, cy, last_u, last_v, baseline = camera
    hidden = np.zeros(len(xs), np.bool_)
    for k in range(len(xs)):
        x, y = xs[k], ys[k]
        for pose in poses:
            dx, dy, dz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
            depth = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
            if depth <= 0:
                continue
            u = fx * (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / depth + cx
            v = fy * (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / depth + cy
            if not (u <= last_u and 0 <= v <= last_v and u - fx * baseline / depth >= 0):
                continue
            hidden[k] = False
            for shift in (0.0, baseline):
                ox, oy, oz = (pose[0, 3] + shift * pose[0, 0], pose[1, 3] + shift * pose[1, 0],
                              pose[2, 3] + shift * pose[2, 0])  # fmt: skip
                if cast_ray(field, ox, oy, oz, x - ox, y - oy, z - oz) < 1 - HIDDEN_BEFORE:
                    hidden[k] = True
            if not hidden[k]:
                break
    return hidden
