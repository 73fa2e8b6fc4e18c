"""Contact of the vehicle's hull, a box, with the floor and with meshes; it ends a survey."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from twin.core.geometry import Array
from twin.errors import SurveyAborted
from twin.kernels import kernel


class HullBox(NamedTuple):
    """Box that stands for the hull, in the axes of the body."""

    half_m: Array  #: (3,) half its sides
    centre_m: Array  #: (3,)

    @property
    def reach_m(self) -> float:
        return float(np.linalg.norm(self.half_m))


class FloorField(NamedTuple):
    """Floor with which the hull may come into contact: a height grid as `twin.core.height_field.HeightField`."""

    height_m: NDArray[np.float32]
    spacing_m: float
    west_m: float
    south_m: float
    highest_m: NDArray[np.float32]  #: greatest height within the reach of a hull whose centre lies in a block of cells
    block_m: float  #: side of a block
    box: HullBox


def floor_field(
    height_m: NDArray[np.float32], spacing_m: float, west_m: float, south_m: float, box: HullBox
) -> FloorField:
    n = int(np.ceil(box.reach_m / spacing_m)) + 1
    padding = [(0, -size % n) for size in height_m.shape]
    padded = np.pad(height_m, padding, constant_values=-np.inf)
    blocks = padded.reshape(padded.shape[0] // n, n, padded.shape[1] // n, n).max(axis=(1, 3))
    highest_m = np.asarray(maximum_filter(blocks, 3, mode="nearest"), np.float32)
    heights = np.ascontiguousarray(height_m, np.float32)
    return FloorField(heights, spacing_m, west_m, south_m, highest_m, n * spacing_m, box)


OPEN_WATER = floor_field(np.full((2, 2), -np.inf, np.float32), 1.0, 0.0, 0.0, HullBox(np.ones(3), np.zeros(3)))


def nothing(world_from_body: Array) -> str:
    """Returns the obstacle that the hull touches in open water."""
    return ""


def contact_error(obstacle: str, time_s: float, world_from_body: Array) -> SurveyAborted:
    x, y, z = world_from_body[:3, 3]
    return SurveyAborted(f"contact of the hull with {obstacle} at {time_s:.2f} s, x {x:.2f}, y {y:.2f}, z {z:.2f} m")


@kernel
def touches_floor(floor, pose):
    """Returns whether the hull at a pose world_from_body (4, 4) meets the floor or lies below it."""
    centre, reach = pose[:3, 3].copy(), np.zeros(3)
    for i in range(3):
        for k in range(3):
            centre[i] += pose[i, k] * floor.box.centre_m[k]
            reach[i] += abs(pose[i, k]) * floor.box.half_m[k]
    low, x, y = centre[2] - reach[2], centre[0] - floor.west_m, centre[1] - floor.south_m
    block_row, block_col = int(np.floor(y / floor.block_m)), int(np.floor(x / floor.block_m))
    rows, cols = floor.highest_m.shape
    if not (0 <= block_row < rows and 0 <= block_col < cols) or low > floor.highest_m[block_row, block_col]:
        return False
    corners, z, half = np.empty((4, 3)), floor.height_m, floor.box.half_m
    ny, nx = z.shape
    south, north = int((y - reach[1]) / floor.spacing_m), int((y + reach[1]) / floor.spacing_m)
    west, east = int((x - reach[0]) / floor.spacing_m), int((x + reach[0]) / floor.spacing_m)
    for r in range(max(south, 0), min(north + 1, ny - 1)):
        for c in range(max(west, 0), min(east + 1, nx - 1)):
            if max(z[r, c], z[r, c + 1], z[r + 1, c], z[r + 1, c + 1]) < low:
                continue
            u, v = x / floor.spacing_m - c, y / floor.spacing_m - r
            if 0 <= u < 1 and 0 <= v < 1:  # the floor below the centre, on one of the two triangles of the cell
                i, j = (0, 1) if u >= v else (1, 0)
                middle = z[r + i, c + j]
                if z[r, c] + max(u, v) * (middle - z[r, c]) + min(u, v) * (z[r + 1, c + 1] - middle) > centre[2]:
                    return True
            for n, (i, j) in enumerate(((0, 0), (0, 1), (1, 1), (1, 0))):  # into the axes of the box
                p, q = (c + j) * floor.spacing_m - x, (r + i) * floor.spacing_m - y
                for k in range(3):
                    corners[n, k] = pose[0, k] * p + pose[1, k] * q + pose[2, k] * (z[r + i, c + j] - centre[2])
            if _meets(half, corners[0], corners[1], corners[2]) or _meets(half, corners[0], corners[2], corners[3]):
                return True
    return False


@kernel
def touches_mesh(half, vertices, faces):
    """Returns whether a box of half sides `half` (3,) meets a triangle (m, 3) of vertices (n, 3) in its axes [m]."""
    for f in range(len(faces)):
        if _meets(half, vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]):
            return True
    return False


@kernel
def _meets(half, a, b, c):
    """Returns whether the box meets a triangle (separating axes: Akenine-Moller 2001, Fast 3D triangle-box overlap)."""
    for k in range(3):
        low, high = min(a[k], b[k], c[k]), max(a[k], b[k], c[k])
        if low > half[k] or high < -half[k]:
            return False
    u, v = b - a, c - b
    if _apart(half, np.cross(u, v), a, b, c):
        return False
    for edge in (u, v, a - c):
        for k in range(3):
            axis = np.zeros(3)
            axis[(k + 1) % 3], axis[(k + 2) % 3] = -edge[(k + 2) % 3], edge[(k + 1) % 3]
            if _apart(half, axis, a, b, c):
                return False
    return True


@kernel
def _apart(half, axis, a, b, c):
    p, q, r, reach = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        p, q, r = p + axis[k] * a[k], q + axis[k] * b[k], r + axis[k] * c[k]
        reach += abs(axis[k]) * half[k]
    return min(p, q, r) > reach or max(p, q, r) < -reach
