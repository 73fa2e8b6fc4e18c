"""Compiled ray casting on the floor, in any direction: the floor is the plane z = 0 or a height field."""

from __future__ import annotations

import numpy as np

from twin.core.height_field import cast_ray, rises
from twin.kernels import kernel

LIFT_M = 1e-6  # distance by which a path vertex on the floor is moved off the floor, along the normal
TOLERANCE_M = 1e-4  # an intersection with the floor this close to the end of a ray does not block the ray


@kernel
def floor_distance(is_plane, field, ox, oy, oz, dx, dy, dz):
    """Returns the distance [m] at which the ray from o in the unit direction d meets the floor; inf if it does not.

    The floor is the plane z = 0 if `is_plane`, else `field`.
    """
    if is_plane:
        return -oz / dz if dz < 0 else np.inf
    if dz < 0:
        return cast_ray(field, ox, oy, oz, dx, dy, dz)
    return _distance_upwards(field, ox, oy, oz, dx, dy, max(dz, 1e-9))


@kernel
def _distance_upwards(field, ox, oy, oz, dx, dy, dz):
    """Returns the result of `floor_distance` for a rising ray (dz > 0) and a height field.

    A ray cast in the reverse direction decides whether the floor blocks the ray; steps and bisection then locate the
    point of intersection.
    """
    top = min((field.highest_m - oz) / dz, field.spacing_m * (field.height_m.shape[0] + field.height_m.shape[1]))
    if top <= 0:
        return np.inf
    back = cast_ray(field, ox + top * dx, oy + top * dy, oz + top * dz, -dx, -dy, -dz)
    if back >= top - TOLERANCE_M:
        return np.inf
    step = field.spacing_m / 4
    low = 0.0
    while low < top:
        high = min(low + step, top)
        if _gap(field, ox + high * dx, oy + high * dy, oz + high * dz) < 0:
            for _ in range(40):
                middle = (low + high) / 2
                if _gap(field, ox + middle * dx, oy + middle * dy, oz + middle * dz) < 0:
                    high = middle
                else:
                    low = middle
            return high
        low = high
    return np.inf


@kernel
def _gap(field, x, y, z):
    """Returns the height of a point above the floor [m]; inf where the floor has no height."""
    height, _, _ = _height_and_slopes(field, x, y)
    return z - height if not np.isnan(height) else np.inf


@kernel
def _height_and_slopes(field, x, y):
    """Returns the height of the floor [m] and its slopes towards east and north; NaN, 0, 0 outside the grid."""
    rows, cols = field.height_m.shape
    u, v = (x - field.west_m) / field.spacing_m, (y - field.south_m) / field.spacing_m
    if not (0 <= u <= cols - 1 and 0 <= v <= rows - 1):
        return np.nan, 0.0, 0.0
    c, r = min(int(u), cols - 2), min(int(v), rows - 2)
    u, v = u - c, v - r
    h00, h01 = field.height_m[r, c], field.height_m[r, c + 1]
    h10, h11 = field.height_m[r + 1, c], field.height_m[r + 1, c + 1]
    east, north = rises(h00, h01, h10, h11, u, v)
    return h00 + u * east + v * north, east / field.spacing_m, north / field.spacing_m


@kernel
def floor_normal(is_plane, field, x, y):
    """Returns the unit normal x, y, z of the triangle of the floor at (x, y), upwards; 0, 0, 1 outside the grid."""
    if is_plane:
        return 0.0, 0.0, 1.0
    _, east, north = _height_and_slopes(field, x, y)
    length = np.sqrt(east * east + north * north + 1)
    return -east / length, -north / length, 1 / length


@kernel
def sees(is_plane, field, ax, ay, az, bx, by, bz):
    """Returns whether the straight line between two points above the floor is not blocked by the floor."""
    if is_plane:
        return az > 0 and bz > 0
    dx, dy, dz = bx - ax, by - ay, bz - az
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    if distance < TOLERANCE_M:
        return True
    dx, dy, dz = dx / distance, dy / distance, dz / distance
    if dz > 0:  # rays are cast downwards
        return cast_ray(field, bx, by, bz, -dx, -dy, min(-dz, -1e-9)) >= distance - TOLERANCE_M
    return cast_ray(field, ax, ay, az, dx, dy, min(dz, -1e-9)) >= distance - TOLERANCE_M
