"""Which key point's view the mosaic shows where: the oldest one, as in the real mosaic."""

from __future__ import annotations

from collections import Counter

import numpy as np

from twin import geometry
from twin.geometry import Array
from twin.records import StereoRig

_CELL_M = 0.1
_LEAST_SHARE = 0.1  # of the view that must have been laid before


class Owners:
    """Key points by the cells of floor that they laid first."""

    def __init__(self, rig: StereoRig):
        self._baseline_m = rig.baseline_m
        self._owner: dict[tuple[int, int], int] = {}
        self._believed: dict[int, Array] = {}

    def clear(self) -> None:
        self._owner.clear()
        self._believed.clear()

    def lay(self, number: int, believed: Array, true: Array, points: Array) -> None:
        """Lays a key point's points (n, 3), normalised (x, y, disparity), where nothing is yet."""
        self._believed[number] = believed
        for cell in self._cells(true, points):
            self._owner.setdefault(cell, number)

    def shares(self, true: Array, points: Array) -> list[tuple[int, Array, float]] | None:
        """Number, believed pose and share of each key point that laid what is in view; None where too little is."""
        counts = Counter(self._owner.get(cell) for cell in self._cells(true, points))
        counts.pop(None, None)
        total = sum(counts.values())
        if total < _LEAST_SHARE * len(points):
            return None
        return [(number, self._believed[number], n / total) for number, n in counts.items() if number is not None]

    def _cells(self, true: Array, points: Array) -> list[tuple[int, int]]:
        xyz = np.column_stack([points[:, :2], np.ones(len(points))]) * (self._baseline_m / points[:, 2:])
        cells = np.floor(geometry.transform(true, xyz)[:, :2] / _CELL_M).astype(np.int64)
        return [(x, y) for x, y in cells.tolist()]
