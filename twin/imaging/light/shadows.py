"""Shadows cast by the floor in the light of lamps and sun; they are visible because the lamps are not at the cameras.

A point is in the shadow of a lamp if the ray to it passes below the floor, triangles over a grid of heights. The gap is
least where the ray crosses an edge, so only edge crossings are tested, in blocks and cells high enough to reach it.
Pixels of facets that face away are dark without a ray; from them, and from a grid of tested pixels, the shadows are
completed by region growing.
"""

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.height_field import rises
from twin.core.records import Array, Depth, StereoRig
from twin.core.threads import QUICK, in_row_bands
from twin.imaging.light.illumination import Daylight
from twin.imaging.light.optics import Lit
from twin.imaging.scene.facets import Heights
from twin.kernels import kernel

BLOCK_CELLS = 8  # side of a block of cells; the highest point of each block is stored
STRIDE_PX = 8  # spacing along rows and columns of the pixels that are tested besides those around shadows
DARK, OPEN, CLEAR = np.uint8(0), np.uint8(1), np.uint8(2)  # in shadow; not tested, counts as lit; tested and lit
SUN_M = 1e5  # distance from the camera of a lamp that stands for the sun: rays to it are parallel within 0.1 mrad
BIAS_M = 1e-4  # the floor must be this much higher than a ray to occlude it, as depth is in single precision


class Shadows:
    """Shadow casting by the floor on the light of each lamp and the sun.

    Lamps (n, 3) are in the axes of both cameras, `to_sun` (3,) in those of the floor; None = no shadow.
    """

    def __init__(self, floor: Heights, rig: StereoRig, lamp_positions_m: list[Array], to_sun: Array | None = None):
        height = np.ascontiguousarray(floor.height_m, np.float32)
        # heights of the nodes, highest heights of each cell and of each block of cells; first node, spacing [m]
        self._grid = height, *tops_of(height), floor.west_m, floor.south_m, floor.spacing_m
        self._rig, self._lamps, self._to_sun = rig, lamp_positions_m, to_sun

    def lit(self, depth: Depth, world_from_camera: Array, camera: int, label: NDArray[np.uint16] | None = None) -> Lit:
        """Returns masks (lamps, H, W), and one of the sun if it casts shadows: 0 where the floor occludes the light.

        `label` (H, W) is not 0 where the pixel shows an object above the floor; None: all show the floor.
        """
        lamps = geometry.transform(world_from_camera, self._lamps[camera])
        if self._to_sun is not None:
            lamps = np.vstack([lamps, world_from_camera[:3, 3] + SUN_M * self._to_sun])
        out = np.empty((len(lamps), *depth.shape), np.uint8)
        pose = np.ascontiguousarray(world_from_camera)
        scene = self._grid, depth, self._rig.focal_px, pose, lamps
        in_row_bands(lambda first, end: _test_facing(*scene, label, out, first, end), len(depth), QUICK)
        in_row_bands(lambda first, end: _grow_shadows(*scene, out, first, end), len(lamps), len(depth))
        return out


def direction_to_casting_sun(daylight: Daylight) -> Array | None:
    """Returns the direction (3,) to the sun under water, in world axes; None without daylight, and at the zenith."""
    slanted = daylight.surface_lx.any() and daylight.source.sun_cosine < 1
    return np.array(daylight.source.to_sun) if slanted else None


def tops_of(height: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the heights [m] of the highest corner of each cell and of the highest node of each block of cells."""
    cells = np.maximum(np.maximum(height[:-1, :-1], height[:-1, 1:]), np.maximum(height[1:, :-1], height[1:, 1:]))
    starts = [np.arange(0, n, BLOCK_CELLS) for n in cells.shape]
    return cells, np.maximum.reduceat(np.maximum.reduceat(cells, starts[0], axis=0), starts[1], axis=1)


@kernel(error_model="numpy")
def _test_facing(grid, depth, focal, pose, lamps, label, out, first, end):
    """Marks the pixels of rows of `out` (lamps, H, W)."""
    height, _, _, west, south, spacing = grid
    width, cols = depth.shape[1], height.shape[1]
    points, parts, cells = np.empty((3, width)), np.empty((2, width)), np.empty(width, np.int32)
    rises, there = np.empty((2, width), np.float32), np.empty(width, np.uint8)
    for v in range(first, end):
        y = (v - 0.5 * (depth.shape[0] - 1)) / focal
        _find_floor(depth[v], y, focal, pose, there, points[0], points[1], points[2])
        _find_cells(points[0], west, spacing, cols, parts[0], cells, 1, True)
        _find_cells(points[1], south, spacing, height.shape[0], parts[1], cells, cols, False)
        _find_rises(height.reshape(-1), cols, parts[0], parts[1], cells, rises[0], rises[1])
        for k in range(lamps.shape[0]):
            _face_lamp(lamps[k], spacing, points[0], points[1], points[2], rises[0], rises[1], there, out[k, v])
        if label is not None:
            for u in range(width):
                if label[v, u]:
                    out[:, v, u] = OPEN


@kernel(error_model="numpy")
def _find_floor(here, y, focal, pose, there, east, north, up):
    a, b, c = pose[0, 0], pose[0, 1] * y + pose[0, 2], pose[0, 3]
    d, e, f = pose[1, 0], pose[1, 1] * y + pose[1, 2], pose[1, 3]
    g, h, i = pose[2, 0], pose[2, 1] * y + pose[2, 2], pose[2, 3]
    far, middle, per_focal = np.float32(np.inf), 0.5 * (here.size - 1), 1 / focal
    for u in range(here.size):
        shows = here[u] < far
        z = np.float64(here[u]) if shows else 0.0
        x = (u - middle) * per_focal
        there[u] = shows
        east[u], north[u], up[u] = z * (a * x + b) + c, z * (d * x + e) + f, z * (g * x + h) + i


@kernel(error_model="numpy")
def _find_cells(at, start, spacing, n, part, cells, stride, is_first):
    """Computes the grid cells of positions (w,) along an axis of n nodes, and the fractional positions in the cells."""
    per_m, last = 1 / spacing, n - 2.0
    for u in range(at.size):
        x = (at[u] - start) * per_m
        cell = min(max(np.floor(x), 0.0), last)
        part[u] = x - cell
        cells[u] = np.int32(cell) * np.int32(stride) + (np.int32(0) if is_first else cells[u])


@kernel(error_model="numpy")
def _find_rises(height, cols, part_x, part_y, cells, to_east, to_north):
    """Computes the rise of the facet in each cell towards east and north [m per cell]."""
    for u in range(cells.size):
        k = np.uint32(cells[u])
        m = k + np.uint32(cols)
        south_west, south_east = height[k], height[k + np.uint32(1)]
        north_west, north_east = height[m], height[m + np.uint32(1)]
        to_east[u], to_north[u] = rises(south_west, south_east, north_west, north_east, part_x[u], part_y[u])


@kernel(error_model="numpy")
def _face_lamp(lamp, spacing, east, north, up, to_east, to_north, there, out):
    """Fills a row `out` (w,) with the marks of `_test_facing`, for one lamp at the position (3,) [m]."""
    x, y, z = lamp[0], lamp[1], lamp[2]
    for u in range(out.size):
        facing = (z - up[u]) * spacing - (x - east[u]) * to_east[u] - (y - north[u]) * to_north[u]
        tested = OPEN if facing > 0 else DARK
        out[u] = tested if there[u] else CLEAR


@kernel(error_model="numpy")
def _grow_shadows(grid, depth, focal, pose, lamps, out, first, end):
    """Completes the shadow masks of the lamps `first` to `end` - 1 by region growing."""
    height, width = depth.shape
    stack = np.empty(height * width, np.int32)
    for k in range(first, end):
        n = 0
        for v in range(0, height, STRIDE_PX):
            for u in range(0, width, STRIDE_PX):
                if out[k, v, u] == OPEN:
                    out[k, v, u] = _cast(grid, depth, focal, pose, lamps[k], v, u)
        for v in range(height):
            if _any_dark(out[k, v]):
                for u in range(width):
                    if out[k, v, u] == DARK:
                        stack[n], n = v * width + u, n + 1
        while n:
            n -= 1
            above, left = stack[n] // width, stack[n] % width
            for v in range(max(above - 1, 0), min(above + 2, height)):
                for u in range(max(left - 1, 0), min(left + 2, width)):
                    if out[k, v, u] == OPEN:
                        out[k, v, u] = _cast(grid, depth, focal, pose, lamps[k], v, u)
                        if out[k, v, u] == DARK:
                            stack[n], n = v * width + u, n + 1
        mask = out[k].reshape(-1)
        for i in range(mask.size):
            mask[i] = min(mask[i], OPEN)


@kernel
def _any_dark(row):
    """Returns whether a row (w,) of marks has DARK pixels; without branches, so that the compiler can vectorize it."""
    least = OPEN
    for u in range(row.size):
        least = min(least, row[u])
    return least == DARK


@kernel(error_model="numpy", inline="always")
def point_of(depth, focal, pose, v, u):
    z = np.float64(depth[v, u])
    scale = z / focal
    x, y = (u - 0.5 * (depth.shape[1] - 1)) * scale, (v - 0.5 * (depth.shape[0] - 1)) * scale
    east = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
    north = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
    return east, north, pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]


@kernel(error_model="numpy")
def _cast(grid, depth, focal, pose, lamp, v, u):
    """Returns DARK if the floor occludes `lamp` (3,) as seen from the point in pixel (v, u), else CLEAR."""
    height, cell_tops, block_tops, west, south, spacing = grid
    x, y, z = point_of(depth, focal, pose, v, u)
    to = (lamp[0] - x) / spacing, (lamp[1] - y) / spacing, lamp[2] - z
    dark = occluded(height, cell_tops, block_tops, (x - west) / spacing, (y - south) / spacing, z, *to)
    return DARK if dark else CLEAR


@kernel(error_model="numpy", inline="always")
def _grid_steps(at, along, cell, size):
    """Prepares the grid traversal of a ray `at + t * along` in one dimension, for grid lines `size` apart."""
    if along == 0:
        return 0, np.inf, np.inf
    per_along = 1 / along
    step = 1 if along > 0 else -1
    return step, ((cell + (along > 0)) * size - at) * per_along, step * size * per_along


@kernel(error_model="numpy")
def occluded(height, cell_tops, block_tops, x, y, z, dx, dy, dz):
    """Returns whether the floor is above the ray from (x, y, z) to (x + dx, y + dy, z + dz); x, y in cells, z [m]."""
    rows, cols = block_tops.shape
    r = min(max(int(np.floor(y / BLOCK_CELLS)), 0), rows - 1)
    c = min(max(int(np.floor(x / BLOCK_CELLS)), 0), cols - 1)
    size = float(BLOCK_CELLS)
    step_c, at_c, per_c = _grid_steps(x, dx, c, size)
    step_r, at_r, per_r = _grid_steps(y, dy, r, size)
    t = 0.0
    while t < 1 and 0 <= r < rows and 0 <= c < cols:
        leave = min(at_c, at_r, 1.0)
        if block_tops[r, c] > z + min(dz * t, dz * leave) + BIAS_M:
            if _occluded_in_block(height, cell_tops, block_tops[r, c], x, y, z, dx, dy, dz, t, leave, r, c):
                return True
        t = leave
        if at_c < at_r:
            c, at_c = c + step_c, at_c + per_c
        else:
            r, at_r = r + step_r, at_r + per_r
    return False


@kernel(error_model="numpy")
def _occluded_in_block(height, cell_tops, block_top, x, y, z, dx, dy, dz, t, end, block_r, block_c):
    """Returns the result of `occluded` for the part of the ray from t to `end`, which lies in one block."""
    first_r, first_c = block_r * BLOCK_CELLS, block_c * BLOCK_CELLS
    last_r = min(first_r + BLOCK_CELLS, cell_tops.shape[0]) - 1
    last_c = min(first_c + BLOCK_CELLS, cell_tops.shape[1]) - 1
    r = min(max(int(np.floor(y + dy * t)), first_r), last_r)
    c = min(max(int(np.floor(x + dx * t)), first_c), last_c)
    step_c, at_c, per_c = _grid_steps(x, dx, c, 1.0)
    step_r, at_r, per_r = _grid_steps(y, dy, r, 1.0)
    z += BIAS_M
    while first_r <= r <= last_r and first_c <= c <= last_c and t <= end + 1e-12:
        leave = min(at_c, at_r, 1.0)
        if dz > 0 and z + dz * t > block_top:
            return False
        if cell_tops[r, c] > z + min(dz * t, dz * leave):
            if _above_in_cell(height, r, c, x - c, y - r, z, dx, dy, dz, t, leave):
                return True
        t = leave
        if at_c < at_r:
            c, at_c = c + step_c, at_c + per_c
        else:
            r, at_r = r + step_r, at_r + per_r
    return False


@kernel(error_model="numpy")
def _above_in_cell(height, r, c, x, y, z, dx, dy, dz, t, leave):
    """Returns whether the floor of a cell is above the ray, from (x, y) in it [cells], between t and `leave`."""
    # Over a triangle, the height of the ray above the floor is linear in t, so it is tested where the ray leaves it.
    south_west, south_east = height[r, c], height[r, c + 1]
    north_west, north_east = height[r + 1, c], height[r + 1, c + 1]
    across = dx - dy
    s = (y - x) / across if across != 0.0 else t  # the cell's diagonal, from south-west to north-east
    if t < s < leave and south_west + (x + dx * s) * (north_east - south_west) > z + dz * s:
        return True
    if leave >= 1:
        return False  # the lamp is in this cell, above the floor
    u, v = x + dx * leave, y + dy * leave
    if u >= v:
        top = south_west + u * (south_east - south_west) + v * (north_east - south_east)
    else:
        top = south_west + v * (north_west - south_west) + u * (north_east - north_west)
    return top > z + dz * leave
