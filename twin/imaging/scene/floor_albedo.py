"""Albedo of the floor in an image whose depth is known: the texture projected from above, and that of its walls.

The texture is sampled trilinearly at a level as coarse as the longer side of the pixel on its facet, as in OpenGL. The
pixels of a row pass through short loops without branches.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Image
from twin.imaging.scene import pixel_rows as px
from twin.imaging.scene.texture_levels import TextureLevels, add_samples, level_of, levels_of
from twin.imaging.scene.triplanar import WallSurface, add_walls, wall_surface
from twin.kernels import kernel
from twin.terrains import Terrain

LEAST_COSINE = 0.05  #: smallest cosine of the angle between ray and normal; smaller ones count as this value
_FAST = {"contract", "arcp", "nsz", "reassoc"}


class FloorSurface(NamedTuple):
    height: NDArray[np.float32]  # (ny, nx) heights of the nodes [m], row 0 = south
    texture: TextureLevels
    walls: WallSurface  # of no cells: the texture is projected from above everywhere
    corner_m: Array  # (3,) x and y of the south-west corner, z of the highest point [m]
    spacing_m: float
    per_m: Array  # (2,) texels per metre along x and y


def floor_surface(terrain: Terrain, low_m: Array, high_m: Array) -> FloorSurface:
    """Returns the floor with a texture that is painted at least between two corners (x, y) [m]."""
    texture = terrain.texture_within(low_m, high_m)
    rows, cols, _ = texture.shape
    per_m = np.array([cols, rows]) / terrain.size_m
    corner_m = np.array([terrain.west_m, terrain.south_m, terrain.highest_m])
    height = np.ascontiguousarray(terrain.height_m, np.float32)
    return FloorSurface(height, levels_of(texture), wall_surface(terrain), corner_m, terrain.spacing_m, per_m)


def paint_floor(
    surface: FloorSurface, depth: NDArray[np.float32], albedo: Image, world_from_camera: Array, focal_px: float,
    rows: slice,
) -> None:  # fmt: skip
    """Paints rows of the image (H, W, 3) of a centred pinhole camera, and replaces 1 / depth [1/m] by depth [m]."""
    pose = np.array(world_from_camera[:3])
    pose[:, 3] -= surface.corner_m
    pose[2] = -pose[2]  # east, north and down from the highest point [m]
    cell = np.floor(pose[:2, 3] / surface.spacing_m)  # positions relative to the camera need only float32
    cell = np.clip(cell, 0, np.array(surface.height.shape[::-1]) - 2)
    pose[:2, 3] -= cell * surface.spacing_m
    view = pose.astype(np.float32)
    _paint(surface, view, cell.astype(np.int64), np.float32(focal_px), depth, albedo, rows.start, rows.stop)


@kernel(fastmath=_FAST, error_model="numpy")
def _paint(surface, view, origin, focal, depth, albedo, first, end):
    height, texture, walls, _, spacing, per_m = surface
    rows, width = depth.shape
    work, listed = np.empty((px.N_ROWS, width), np.float32), np.empty((px.N_ROWS, width), np.float32)
    weight, total = np.empty(width, np.float32), np.empty(3 * width, np.float32)
    cells, steep, column = np.empty((6, width), np.int32), np.empty((6, width), np.int32), np.arange(width)
    per_x, per_y, high = np.float32(per_m[0]), np.float32(per_m[1]), np.float32(texture.table[0, 1])
    for u in range(width):
        work[px.COLUMN, u] = np.float32(u) - np.float32(0.5) * np.float32(width - 1)
    for v in range(first, end):
        y = (np.float32(v) - np.float32(0.5) * np.float32(rows - 1)) / focal
        _find_facets(height, np.float32(spacing), view, origin, focal, y, depth[v], work, weight, cells)
        _find_footprints(view, focal, y, work, width)
        east, north, level = work[px.EAST], work[px.NORTH], work[px.LEVEL]
        ax, ay, bx, by = work[px.ACROSS_X], work[px.ACROSS_Y], work[px.DOWN_X], work[px.DOWN_Y]
        for u in range(width):
            a, b, c, d = ax[u] * per_x, ay[u] * per_y, bx[u] * per_x, by[u] * per_y
            level[u] = max(a * a + b * b, c * c + d * d)
        level_of(level)
        total[:] = 0
        n = _list_walls(walls, work, weight, cells, listed, steep)
        if n > 0:
            _find_footprints(view, focal, y, listed, n)
            add_walls(walls, listed, steep, n, weight, total)
        for u in range(width):
            ax[u], ay[u] = east[u] * per_x, high - north[u] * per_y
        add_samples(texture, ax, ay, level, weight, column, width, work[px.SPARE :], cells[3:], total)
        out = albedo[v].reshape(-1)
        for k in range(out.size):
            out[k] = np.uint8(np.int32(total[k] + np.float32(0.5)))


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _find_facets(height, spacing, view, origin, focal, y, depth, work, weight, cells):
    """Replaces 1 / depth by depth; fills the rows DEPTH to ROW of `work`, and row 1 of `cells` with the cells."""
    # the weights are 1, or 0 where there is no floor
    rows, cols = height.shape
    zero, one, per_cell = np.float32(0), np.float32(1), np.float32(1) / spacing
    west, south = -np.float32(origin[0]), -np.float32(origin[1])
    last_col, last_row, nodes = west + np.float32(cols - 2), south + np.float32(rows - 2), np.int32(cols)
    start = np.int32(origin[1] * cols + origin[0])
    ax, ay, x0, y0 = view[0, 0], view[1, 0], view[0, 1] * y + view[0, 2], view[1, 1] * y + view[1, 2]
    here, middle, flat = cells[1], cells[2], height.reshape(-1)
    column, far, east, north = work[px.COLUMN], work[px.DEPTH], work[px.EAST], work[px.NORTH]
    s, t = work[px.COL], work[px.ROW]
    for u in range(depth.size):
        shows, z = depth[u] > zero, one / depth[u]
        depth[u] = z
        z = z if shows else zero
        x = column[u] / focal
        to_east, to_north = z * (ax * x + x0) + view[0, 3], z * (ay * x + y0) + view[1, 3]
        col = min(max(np.floor(to_east * per_cell), west), last_col)
        row = min(max(np.floor(to_north * per_cell), south), last_row)
        s[u], t[u] = to_east * per_cell - col, to_north * per_cell - row
        far[u], east[u], north[u] = z, to_east - west * spacing, to_north - south * spacing
        weight[u] = one if shows else zero
        node = start + np.int32(row) * nodes + np.int32(col)
        here[u], middle[u] = node, node + (np.int32(1) if s[u] >= t[u] else nodes)
    first, second = work[px.FALL_X], work[px.FALL_Y]
    for u in range(depth.size):  # unsigned, as signed indices would be tested for negative ones
        corner, between = np.uint32(here[u]), flat[np.uint32(middle[u])]
        first[u], second[u] = flat[corner] - between, between - flat[corner + np.uint32(cols + 1)]
    for u in range(depth.size):
        lower, a, b = s[u] >= t[u], first[u] * per_cell, second[u] * per_cell
        first[u], second[u] = (a if lower else b), (b if lower else a)


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _find_footprints(view, focal, y, work, n):
    """Fills the rows BELOW to DOWN_Z of `work` for its first n pixels."""
    # the facet is the plane with the normal N = (fall_x, fall_y, -1) in the axes east, north, down; with the ray d of a
    # pixel at the depth z, and d' its change to the next pixel, the point moves by z (d' - d N.d' / N.d)
    ax, ay, az, bx, by, bz = view[0, 0], view[1, 0], view[2, 0], view[0, 1], view[1, 1], view[2, 1]
    x0, y0, z0 = view[0, 1] * y + view[0, 2], view[1, 1] * y + view[1, 2], view[2, 1] * y + view[2, 2]
    one, least, down_0, per_px = np.float32(1), np.float32(LEAST_COSINE), view[2, 3], np.float32(1) / focal
    for i in range(n):
        x = work[px.COLUMN, i] * per_px
        dx, dy, dz = x0 + x * ax, y0 + x * ay, z0 + x * az
        east, north, far = work[px.FALL_X, i], work[px.FALL_Y, i], work[px.DEPTH, i]
        smallest = least * np.sqrt((one + east * east + north * north) * (dx * dx + dy * dy + dz * dz))
        along = one / max(dz - east * dx - north * dy, smallest)  # the camera sees the upper side
        size = far * per_px
        du, dv = (az - east * ax - north * ay) * along, (bz - east * bx - north * by) * along
        work[px.ACROSS_X, i], work[px.DOWN_X, i] = size * (ax - dx * du), size * (bx - dx * dv)
        work[px.ACROSS_Y, i], work[px.DOWN_Y, i] = size * (ay - dy * du), size * (by - dy * dv)
        work[px.ACROSS_Z, i], work[px.DOWN_Z, i] = size * (az - dz * du), size * (bz - dz * dv)
        work[px.BELOW, i] = down_0 + far * dz


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _list_walls(walls, work, weight, cells, listed, steep):
    """Copies what `add_walls` needs of the pixels that show steep cells; returns their number."""
    n, number, cols = 0, walls.number.reshape(-1), walls.number.shape[1]
    if number.size == 0:
        return 0
    for u in range(weight.size):  # a grid has one column of nodes more than of cells
        steep[0, n] = u
        steep[1, n] = number[cells[1, u] - cells[1, u] // (cols + 1)]
        n += np.int64((steep[1, n] >= 0) & (weight[u] > 0))
    for row in range(px.COLUMN, px.ROW + 1):
        for i in range(n):
            listed[row, i] = work[row, steep[0, i]]
    return n
