"""Rasterization of the floor, a triangulated height grid, into an image of inverse depth, with a depth test.

A pixel shows the triangle that the ray through its centre meets first; 1 / depth is linear on a triangle in the image
(as in `mesh_raster`). Blocks of cells outside the view are left out by their bounding boxes. The cells of a block pass
through loops without branches, which list the triangles that face the camera and may cover a pixel centre: cells may
be much smaller than a pixel. Triangles nearer than the near plane in part are clipped.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array
from twin.imaging.scene.mesh_raster import Projection, view_planes
from twin.kernels import kernel

BLOCK_CELLS = 16  #: side of a block of cells
#: Least weight of a corner at a pixel that a triangle covers: far above rounding errors, so that no pixel falls between
#: two triangles, and small enough to change no depth by more than 1e-4 of the extent of a triangle.
LEAST_WEIGHT = -1e-4
_FAST = {"contract", "arcp", "nsz", "reassoc"}


class FloorGrid(NamedTuple):
    height: NDArray[np.float32]  # (ny, nx) heights of the nodes [m], row 0 = south
    low: NDArray[np.float32]  # (rows, cols) least and greatest height of each block of cells [m]
    high: NDArray[np.float32]


def floor_grid(height_m: NDArray[np.float32]) -> FloorGrid:
    """Returns the heights (ny, nx) [m] of a floor with the bounds of its blocks."""
    height = np.ascontiguousarray(height_m, np.float32)
    return FloorGrid(height, _bound(np.minimum, height), _bound(np.maximum, height))


def _bound(least_or_most: np.ufunc, height: NDArray[np.float32]) -> NDArray[np.float32]:
    for axis in range(2):
        starts = np.arange(0, height.shape[axis] - 1, BLOCK_CELLS)
        shared = np.take(height, np.minimum(starts + BLOCK_CELLS, height.shape[axis] - 1), axis)  # with the next block
        height = least_or_most(least_or_most.reduceat(height, starts, axis), shared)
    return height


def draw_floor(
    grid: FloorGrid, camera_from_grid: Array, view: Projection, inverse_depth: NDArray[np.float32], rows: slice
) -> None:
    """Draws rows of the floor into an image (H, W) of 1 / depth [1/m], in place, where it is nearer."""
    # `camera_from_grid` (3, 4) maps column, row and height [m] of a node to the axes of the camera [m]
    first, end = rows.start, rows.stop
    in_camera = view_planes(view._replace(cy_px=view.cy_px - first), (end - first, inverse_depth.shape[1]))
    planes = in_camera[:, :3] @ camera_from_grid
    planes[:, 3] += in_camera[:, 3]
    _draw(grid, camera_from_grid, planes, view, inverse_depth, first, end)


@kernel(fastmath=_FAST, error_model="numpy")
def _draw(grid, matrix, planes, view, inverse_depth, first, end):
    height, low, high = grid
    focal, near = np.float32(view[0]), view[3]
    camera = focal, np.float32(view[1]), np.float32(view[2])
    window = np.float32(0), np.float32(inverse_depth.shape[1] - 1), np.float32(first), np.float32(end - 1)
    nodes = BLOCK_CELLS + 1
    place = np.empty((3, nodes, nodes), np.float32)
    u, v, q = place[0].reshape(-1), place[1].reshape(-1), place[2].reshape(-1)
    kept = np.empty(2 * BLOCK_CELLS * BLOCK_CELLS + 1, np.int32)
    for i in range(low.shape[0]):
        for j in range(low.shape[1]):
            r, c = i * BLOCK_CELLS, j * BLOCK_CELLS
            rows, cols = min(BLOCK_CELLS, height.shape[0] - 1 - r), min(BLOCK_CELLS, height.shape[1] - 1 - c)
            box = c, c + cols, r, r + rows, low[i, j], high[i, j]
            visible = True
            for k in range(planes.shape[0]):
                visible &= _farthest(planes[k], box) >= 0
            if not visible:
                continue
            if _farthest(-matrix[2], box) > -near:
                _draw_clipped(height, matrix, near, r, r + rows, c, c + cols, camera, inverse_depth, window)
                continue
            _project(height, matrix, r, c, rows, cols, camera, place)
            n = _list_triangles(place, rows, cols, window, kept)
            for k in range(n):
                a = np.int64(kept[k] >> 1)
                upper = kept[k] & 1
                b, d = a + 1 + upper * nodes, a + nodes + 1 - upper
                _draw_triangle(u[a], v[a], q[a], u[b], v[b], q[b], u[d], v[d], q[d], inverse_depth, window)


@kernel(error_model="numpy", forceinline=True)
def _farthest(plane, box):
    """Returns the greatest value of an affine function (4,) of column, row and height in a box."""
    west, east, south, north, low, high = box
    x, y, z = plane[0], plane[1], plane[2]
    furthest = x * (east if x > 0 else west) + y * (north if y > 0 else south) + z * (high if z > 0 else low)
    return furthest + plane[3]


@kernel(fastmath=_FAST, error_model="numpy", forceinline=True)
def _project(height, matrix, first_row, first_col, rows, cols, camera, place):
    """Computes column, row and 1 / depth (3, nodes, nodes) of the nodes of a block in the image."""
    focal, cx, cy = camera
    along_x, along_y, along_z = np.float32(matrix[0, 0]), np.float32(matrix[1, 0]), np.float32(matrix[2, 0])
    up_x, up_y, up_z = np.float32(matrix[0, 2]), np.float32(matrix[1, 2]), np.float32(matrix[2, 2])
    for r in range(rows + 1):
        x = np.float32(matrix[0, 0] * first_col + matrix[0, 1] * (first_row + r) + matrix[0, 3])
        y = np.float32(matrix[1, 0] * first_col + matrix[1, 1] * (first_row + r) + matrix[1, 3])
        z = np.float32(matrix[2, 0] * first_col + matrix[2, 1] * (first_row + r) + matrix[2, 3])
        here, u, v, inverse = height[first_row + r], place[0, r], place[1, r], place[2, r]
        for c in range(cols + 1):
            step, up = np.float32(c), here[first_col + c]
            q = np.float32(1) / (z + step * along_z + up * up_z)
            u[c] = focal * (x + step * along_x + up * up_x) * q + cx
            v[c] = focal * (y + step * along_y + up * up_y) * q + cy
            inverse[c] = q


@kernel(fastmath=_FAST, error_model="numpy", forceinline=True)
def _list_triangles(place, rows, cols, window, kept):
    """Lists the triangles of a block that face the camera and may cover a pixel centre; returns their number."""
    # a triangle is twice the number of its south-west node, plus 1 for the north-western one of a cell
    n = 0
    for r in range(rows):
        u, v, u_north, v_north = place[0, r], place[1, r], place[0, r + 1], place[1, r + 1]
        for c in range(cols):
            ua, va, ub, vb = u[c], v[c], u[c + 1], v[c + 1]
            uc, vc, ud, vd = u_north[c + 1], v_north[c + 1], u_north[c], v_north[c]
            across, down = uc - ua, vc - va
            lower = (ub - ua) * down - across * (vb - va) < 0
            upper = across * (vd - va) - (ud - ua) * down < 0
            u0, u1, v0, v1 = min(ua, uc), max(ua, uc), min(va, vc), max(va, vc)
            number = np.int32(2 * (r * (BLOCK_CELLS + 1) + c))
            kept[n] = number
            n += np.int64(lower & _covers(min(u0, ub), max(u1, ub), min(v0, vb), max(v1, vb), window))
            kept[n] = number + np.int32(1)
            n += np.int64(upper & _covers(min(u0, ud), max(u1, ud), min(v0, vd), max(v1, vd), window))
    return n


@kernel(error_model="numpy", forceinline=True)
def _covers(u0, u1, v0, v1, window):
    """Returns whether a rectangle in the image has a pixel centre within the window."""
    left, right, top, bottom = window
    return (max(np.ceil(u0), left) <= min(np.floor(u1), right)) & (max(np.ceil(v0), top) <= min(np.floor(v1), bottom))


@kernel(fastmath=_FAST, error_model="numpy", forceinline=True)
def _draw_triangle(ua, va, qa, ub, vb, qb, uc, vc, qc, inverse_depth, window):
    left, right, top, bottom = window
    u0, u1 = np.int64(max(np.ceil(min(ua, ub, uc)), left)), np.int64(min(np.floor(max(ua, ub, uc)), right))
    v0, v1 = np.int64(max(np.ceil(min(va, vb, vc)), top)), np.int64(min(np.floor(max(va, vb, vc)), bottom))
    ab_u, ab_v, ac_u, ac_v = ub - ua, vb - va, uc - ua, vc - va
    per_area = np.float32(1) / (ab_u * ac_v - ac_u * ab_v)
    b_right, b_down, c_right, c_down = ac_v * per_area, -ac_u * per_area, -ab_v * per_area, ab_u * per_area
    least, most = np.float32(LEAST_WEIGHT), np.float32(1 - LEAST_WEIGHT)
    qb, qc, across = qb - qa, qc - qa, np.float32(u0) - ua
    for v in range(v0, v1 + 1):
        down, row = np.float32(v) - va, inverse_depth[v]
        b0, c0 = across * b_right + down * b_down, across * c_right + down * c_down
        for u in range(u0, u1 + 1):
            step = np.float32(u - u0)
            b, c = b0 + step * b_right, c0 + step * c_right
            q = qa + b * qb + c * qc
            nearer = (b >= least) & (c >= least) & (b + c <= most) & (q > row[u])
            row[u] = q if nearer else row[u]


@kernel(error_model="numpy")
def _draw_clipped(height, matrix, near, first_row, end_row, first_col, end_col, camera, inverse_depth, window):
    """Draws the triangles of a block without what is nearer than `near`: polygons of up to four corners."""
    focal, cx, cy = camera
    corners, point, place = np.empty((3, 3)), np.empty((4, 3)), np.empty((4, 3), np.float32)
    for cell in range((end_row - first_row) * (end_col - first_col)):
        r, c = first_row + cell // (end_col - first_col), first_col + cell % (end_col - first_col)
        for upper in range(2):
            for k in range(3):
                row, col = r + (k > 1 - upper), c + (k == 1 or k == 2 - upper)
                corners[k] = matrix[:, 0] * col + matrix[:, 1] * row + matrix[:, 2] * height[row, col] + matrix[:, 3]
            n = 0
            for k in range(3):
                here, after = corners[k], corners[(k + 1) % 3]
                if here[2] >= near:
                    point[n], n = here, n + 1
                if (here[2] >= near) != (after[2] >= near):
                    point[n], n = here + (near - here[2]) / (after[2] - here[2]) * (after - here), n + 1
            for k in range(n):
                x, y, z = point[k]
                place[k, 0], place[k, 1], place[k, 2] = focal * x / z + cx, focal * y / z + cy, 1 / z
            for k in range(2, n):
                (ua, va, qa), (ub, vb, qb), (uc, vc, qc) = place[0], place[k - 1], place[k]
                if (ub - ua) * (vc - va) < (uc - ua) * (vb - va):
                    _draw_triangle(ua, va, qa, ub, vb, qb, uc, vc, qc, inverse_depth, window)
