"""Model of the mosaic: for each floor cell, the first keyframe that shows it; later ones do not overwrite the cell."""

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.kernels import kernel

_CELL_M = 0.1  # side of a floor cell [m]
_MIN_COVERAGE = 0.1  # smallest fraction of a keyframe's field of view that the mosaic must cover for a registration

Cells = NDArray[np.int64]  #: floor cells, each with column and row packed into one integer


@kernel
def floor_cells(pose, points, baseline):
    """Returns the floor cell (n,) of each point (n, 3), normalised (x, y, disparity) in a camera at a pose (4, 4)."""
    cells = np.empty(len(points), np.int64)
    for k in range(len(points)):
        x, y, d = points[k]
        depth = baseline / d
        col = np.floor((depth * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]) + pose[0, 3]) / _CELL_M)
        row = np.floor((depth * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]) + pose[1, 3]) / _CELL_M)
        cells[k] = (np.int64(row) << 32) + np.int64(col)
    return cells


class MosaicView(NamedTuple):
    """Keyframes that make up the part of the mosaic in a camera's field of view."""

    numbers: list[int]  #: (n,) numbers of the keyframes, ascending
    estimated: Array  #: (n, 4, 4) estimated poses at which the keyframes were added to the mosaic
    fractions: Array  #: (n,) fraction of the mosaic in view that comes from each keyframe; sums to 1
    coverage: float  #: fraction of the field of view that the mosaic covers


class MosaicModel:
    def __init__(self) -> None:
        self._first_keyframe: dict[int, int] = {}
        self._estimated: dict[int, Array] = {}

    def clear(self) -> None:
        self._first_keyframe.clear()
        self._estimated.clear()

    def add(self, number: int, estimated: Array, cells: Cells) -> None:
        """Adds a keyframe with its estimated pose (4, 4); cells that are already covered keep their keyframe."""
        self._estimated[number] = estimated
        for cell in cells.tolist():
            self._first_keyframe.setdefault(cell, number)

    def view(self, cells: Cells) -> MosaicView | None:
        """Returns the keyframes whose images fill these cells; None if the mosaic covers too few of the cells."""
        counts = Counter(map(self._first_keyframe.get, cells.tolist()))
        counts.pop(None, None)
        if counts.total() < _MIN_COVERAGE * len(cells):
            return None
        numbers = sorted(number for number in counts if number is not None)
        fractions = np.array([counts[number] for number in numbers]) / counts.total()
        estimated = np.array([self._estimated[number] for number in numbers])
        return MosaicView(numbers, estimated, fractions, counts.total() / len(cells))
