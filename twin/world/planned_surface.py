"""Surface in the planned images: the floor with its objects as seen from above, as a height grid for ray casting."""

from __future__ import annotations

from dataclasses import replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from twin.core.records import MapGrid
from twin.terrains import Terrain
from twin.terrains.terrain import MAX_NODES
from twin.world.coverage import true_heights
from twin.world.mission import Mission
from twin.world.top_surface import top_surface

FINE_M = 0.01  #: largest spacing of the nodes if there are objects, unless MAX_NODES requires a larger one


def planned_surface(mission: Mission) -> Terrain:
    """Returns the terrain whose heights are those of the highest of floor and objects.

    Each cell of the floor is divided into n x n small cells. The diagonal of a cell consists of diagonals of small
    cells, so the surface away from the objects is that of the floor. The side of an object is a slope between two
    nodes, and there is no space below overhangs. Without objects, and for a survey by the surrogate, which does not
    simulate them, the terrain of the mission is returned.
    """
    floor = mission.terrain
    if not mission.objects or mission.scenario.imaging.fidelity != "rendered":
        return floor
    divisions = _divisions(floor)
    spacing_m = floor.spacing_m / divisions
    rows, cols = ((n - 1) * divisions + 1 for n in floor.height_m.shape)
    nodes = MapGrid(floor.west_m - spacing_m / 2, floor.north_m + spacing_m / 2, spacing_m, rows, cols)
    heights = top_surface(nodes, _heights_of_floor(floor, nodes), mission.objects).height_m
    known = None if floor.known is None else ~floor.in_hole(*np.meshgrid(*nodes.centres()))[::-1]
    return replace(floor, height_m=np.ascontiguousarray(heights[::-1]), spacing_m=spacing_m, known=known)


def _divisions(floor: Terrain) -> int:
    """Returns the number n of divisions of the side of a cell, from FINE_M and MAX_NODES; at least 1."""
    wanted = max(1, ceil(floor.spacing_m / FINE_M - 1e-6))
    allowed = int(np.sqrt(MAX_NODES / floor.height_m.size))
    return max(1, min(wanted, allowed))


def _heights_of_floor(floor: Terrain, nodes: MapGrid) -> NDArray[np.float32]:
    """Returns the heights (rows, cols) of the floor at the centres of a grid; row 0 = north.

    Centres that rounding places outside the terrain are moved to its border.
    """

    def height_at(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return floor.height_at(np.clip(x, floor.west_m, floor.east_m), np.clip(y, floor.south_m, floor.north_m))

    return true_heights(nodes, height_at)
