"""Gaps of a survey: parts of the area that too few keyframes show, and legs over them after the last track."""

import numpy as np
from numpy.typing import NDArray

from twin.controllers.detours import legs_at
from twin.controllers.segments import Point, Reference, Segment
from twin.core.geometry import Array
from twin.core.quality import Gaps
from twin.world.mission import Mission

_CELLS = 4  # cells along the shorter side of an image
_LEAST_KEYFRAMES = 2  # keyframes with stereo points in a cell; a cell with fewer is a gap
_MOST_TRACKS = 2  # of legs over gaps
_CLOSED = 1.0  # gaps of a leg that are nearer to each other than this share of an image are one
_SAMPLES = 50  # of the floor along a leg


class GapFiller:
    """Counts the keyframes with stereo points (at online poses) in each cell of the area; plans legs over gaps."""

    def __init__(self, mission: Mission):
        plan, chart = mission.plan, mission.chart
        self._plan, self._chart, self._area = plan, chart, plan.area
        self._shape = [int(np.ceil(side * _CELLS / min(plan.request.footprint_m))) for side in self._extent_m]
        self._cell_m = np.array(self._extent_m) / self._shape
        self._n = np.zeros(self._shape, np.int64)
        x, y = self._area.to_scene(*np.meshgrid(*self._centres(), indexing="ij"))
        self._asked = plan.inside_area(x, y) & ~chart.in_hole(x, y)
        self._n_tracks, self.gaps = 0, Gaps()

    def add(self, points_m: Array) -> None:
        """Adds the stereo points (n, 3) of a keyframe in the world [m]."""
        in_legs = np.stack(self._area.to_legs(points_m[:, 0], points_m[:, 1]))
        cell = np.floor((in_legs + np.array(self._extent_m)[:, None] / 2) / self._cell_m[:, None]).astype(np.int64)
        inside = ((cell >= 0) & (cell < np.array(self._shape)[:, None])).all(axis=0)
        shown = np.zeros(self._shape, np.bool_)
        shown[tuple(cell[:, inside])] = True
        self._n += shown

    def path(self, last: Reference, end: Point) -> tuple[Segment, ...]:
        """Returns legs over the gaps, from the end of the planned path, where the reference is `last`; () for none."""
        gap = self._asked & (self._n < _LEAST_KEYFRAMES)
        left_m2, before_m2 = float(gap.sum() * self._cell_m.prod()), self.gaps.left_m2
        self.gaps = Gaps(left_m2 if self.gaps.found_m2 is None else self.gaps.found_m2, left_m2)
        in_vain = before_m2 is not None and left_m2 >= before_m2
        if not gap.any() or in_vain or self._n_tracks == _MOST_TRACKS:
            return ()
        self._n_tracks += 1
        return legs_at(self._plan, end, float(last.yaw), self._legs(gap))

    @property
    def _extent_m(self) -> tuple[float, float]:
        along_m, across_m = self._area.size_m
        return (along_m, along_m) if self._area.shape == "disc" else (along_m, across_m)

    def _centres(self) -> list[Array]:
        sides = zip(self._shape, self._cell_m, strict=True)
        return [(np.arange(n, dtype=np.float64) + 0.5 - n / 2) * side_m for n, side_m in sides]

    def _legs(self, gap: NDArray[np.bool_]) -> list[tuple[Point, Point]]:
        """Returns legs along u over the gaps: one for each run of them in strips as wide as the spacing of the legs."""
        u, v = self._centres()
        n = max(1, int(self._plan.swath_spacing_m / self._cell_m[1]))
        margin_m, found = self._plan.side_along_m / 4, list[tuple[Point, Point]]()
        for first in np.unique(np.nonzero(gap)[1] // n) * n:
            strip = gap[:, first : first + n]
            (at,), across = np.nonzero(strip.any(axis=1)), float(v[first : first + n][strip.any(axis=0)].mean())
            parts = np.split(at, np.flatnonzero(np.diff(u[at]) > _CLOSED * self._plan.side_along_m) + 1)
            legs = [self._on_chart(float(u[k[0]]) - margin_m, float(u[k[-1]]) + margin_m, across) for k in parts]
            found += [leg for leg in legs if leg is not None]
        return found

    def _on_chart(self, start_u: float, end_u: float, v: float) -> tuple[Point, Point] | None:
        """Returns the ends of a leg, cut off where the known floor ends."""
        x, y = self._area.to_scene(np.linspace(start_u, end_u, _SAMPLES), np.full(_SAMPLES, v))
        known, z = np.isfinite(self._chart.height_at(x, y)), self._plan.request.altitude_m
        ends = [(float(x[k]), float(y[k]), z) for k in np.flatnonzero(known)[[0, -1]]] if known.any() else []
        return (ends[0], ends[1]) if ends else None
