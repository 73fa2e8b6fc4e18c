"""Which keyframe's view the mosaic shows where: the oldest one, as in the real mosaic."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.geometry import Array

_CELL_M = 0.1
_LEAST_SHARE = 0.1  # of the view that must have been laid before

Cells = NDArray[np.int64]  #: of the floor: column and row in one number


@njit(cache=True, nogil=True)
def cells_of(pose, points, baseline):
    """The cell (n,) of each of points (n, 3), normalised (x, y, disparity), of a camera at (4, 4)."""
    cells = np.empty(len(points), np.int64)
    for k in range(len(points)):
        x, y, d = points[k]
        depth = baseline / d
        col = np.floor((depth * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3]) / _CELL_M)
        row = np.floor((depth * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]) + pose[1, 3]) / _CELL_M)
        cells[k] = (np.int64(row) << 32) + np.int64(col)
    return cells


class Shares(NamedTuple):
    """Numbers of keyframes, rising; where they are believed to be (n, 4, 4), and their parts (n,) of a view."""

    numbers: list[int]
    believed: Array
    parts: Array


class Owners:
    """Keyframes by the cells of floor that they laid first."""

    def __init__(self) -> None:
        self._owner: dict[int, int] = {}
        self._believed: dict[int, Array] = {}

    def clear(self) -> None:
        self._owner.clear()
        self._believed.clear()

    def lay(self, number: int, believed: Array, cells: Cells) -> None:
        """Lays a keyframe where nothing is yet, at its believed pose (4, 4)."""
        self._believed[number] = believed
        for cell in cells.tolist():
            self._owner.setdefault(cell, number)

    def shares(self, cells: Cells) -> Shares | None:
        """Of the keyframes that laid what is in view; None where too little is."""
        counts = Counter(map(self._owner.get, cells.tolist()))
        counts.pop(None, None)
        if counts.total() < _LEAST_SHARE * len(cells):
            return None
        numbers = sorted(number for number in counts if number is not None)
        parts = np.array([counts[number] for number in numbers]) / counts.total()
        return Shares(numbers, np.array([self._believed[number] for number in numbers]), parts)
