"""Compiled rays on the floor of the reference, a height field: the normal at a point, and lines of sight."""

import numpy as np

from twin.core.height_field import cast_ray, height_field, rises
from twin.kernels import kernel

LIFT_M = 1e-6  # distance by which a path vertex on the floor is moved off the floor, along the normal
TOLERANCE_M = 1e-4  # an intersection with the floor this close to the end of a line of sight does not block it
REACH_M = 1e4
LEVEL = height_field(np.zeros((2, 2)), 2 * REACH_M, -REACH_M, -REACH_M)  # the plane z = 0, in one cell


@kernel
def floor_normal(relief, x, y):
    """Returns the unit normal x, y, z of the triangle of the floor at (x, y) on its grid, upwards."""
    rows, cols = relief.height_m.shape
    u, v = (x - relief.west_m) / relief.spacing_m, (y - relief.south_m) / relief.spacing_m
    c, r = min(max(int(u), 0), cols - 2), min(max(int(v), 0), rows - 2)
    of_cell = relief.height_m[r : r + 2, c : c + 2]
    east, north = rises(of_cell[0, 0], of_cell[0, 1], of_cell[1, 0], of_cell[1, 1], u - c, v - r)
    length = np.sqrt(east * east + north * north + relief.spacing_m**2)
    return -east / length, -north / length, relief.spacing_m / length


@kernel
def sees(relief, start, end):
    """Returns whether the floor does not block the straight line between two points above the floor."""
    x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    length = max(np.sqrt(x * x + y * y + z * z), TOLERANCE_M)
    met_m = cast_ray(relief, start[0], start[1], start[2], x / length, y / length, z / length)
    return met_m >= length - TOLERANCE_M
