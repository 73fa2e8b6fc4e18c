"""Rasterization of triangle meshes into images of depth, normals and labels, with a depth test, as in OpenGL.

One kernel serves the cameras, the shadow maps, and the view from above that gives the true heights. A pixel shows the
triangle that the ray through its centre meets first, with the exact depth; 1 / depth (in a parallel view, depth) is
linear in the image. Triangles are about as large as a pixel, so each part of a mesh (`objects.detail`) passes through
loops that write lists, almost without branches. Parts outside the image or facing away are left out.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Depth
from twin.core.threads import in_row_bands
from twin.kernels import kernel
from twin.terrains.objects.coloured_mesh import Mesh
from twin.terrains.objects.detail import PART_FACES, UNKNOWN, Parts

NEAR_M = 0.05  #: depth of the near clipping plane of all cameras
MARGIN = 1e-6  #: relative margin of tests that leave out parts, far above rounding errors
MARGIN_PX = 1e-3  #: the same, in the image


class Projection(NamedTuple):
    """Projection of points in the axes of a camera (x right, y down, z forward)."""

    focal_px: float  # focal length of a perspective view [px], or pixels per metre of a parallel view
    cx_px: float  # column and row of the optical axis
    cy_px: float
    near_m: float  # triangles with a corner at a smaller depth are left out
    perspective: bool  # whether columns and rows are those of a pinhole camera


def view_planes(view: Projection, shape: tuple[int, int]) -> Array:
    """Returns the planes (k, 4) that bound a view of (rows, cols) pixels: inward unit normal and offset [m]."""
    centre = np.array([view.cx_px, view.cy_px])
    low, high = (-0.5 - centre) / view.focal_px, (np.array(shape[::-1]) - 0.5 - centre) / view.focal_px
    planes = np.array([[1.0, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 1, -view.near_m]])
    planes[:4, 2 if view.perspective else 3] = -low[0], high[0], -low[1], high[1]
    planes = planes if view.perspective else planes[:4]
    return planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)


class ObjectView(NamedTuple):
    # (H, W, 3) float32 unit normals in the axes of the camera, valid where `label` is not 0
    normal: NDArray[np.float32]
    label: NDArray[np.uint16]  # (H, W) uint16, 1 + number of the object that the pixel shows; 0: the floor, or nothing


NO_OBJECTS = ObjectView(np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.uint16))


class Target(NamedTuple):
    """Images (H, W) that a mesh is drawn into, in the pixels where the mesh is nearer than `depth`."""

    depth: Depth  # depth along the optical axis [m]; inf where there is nothing
    albedo: NDArray[np.uint8] | None = None  # (H, W, 3) uint8; None: not drawn
    # (H, W, 3) float32 unit normals in the axes of the camera, towards the camera; None: not drawn
    normal: NDArray[np.float32] | None = None
    # (H, W) uint16 number that identifies the mesh in each pixel; None: not drawn
    label: NDArray[np.uint16] | None = None
    # (H, W, 3) float32 values interpolated between `DrawnMesh.uv` of the vertices; None: not drawn
    uv: NDArray[np.float32] | None = None


class DrawnMesh(NamedTuple):
    mesh: Mesh  # triangles
    camera_from_object: Array  # (4, 4) or (3, 4) affine map from the axes of the mesh to those of the camera
    label: int = 0  # number to write into `Target.label`
    closed: bool = False  # whether the mesh is closed, so that the triangles that face away are not drawn
    parts: Parts = UNKNOWN  # bounds of the parts of the mesh
    # (n, 3) values of the vertices, drawn into `Target.uv`; None: `Target.uv` is not drawn
    uv: NDArray[np.float32] | None = None


def draw_meshes(drawn: Sequence[DrawnMesh], projection: Projection, target: Target) -> None:
    """Draws meshes in their order into images in place, where they are nearer than what these show."""
    draw = []
    for item in drawn:
        points = np.ascontiguousarray(item.mesh.vertices_m.T)
        matrix = np.ascontiguousarray(item.camera_from_object[:3], np.float64)
        images = target._replace(uv=None) if item.uv is None else target
        uv = None if target.uv is None else item.uv
        geometry = points, *item.mesh[1:], uv, item.parts, matrix, projection
        draw.append(partial(_draw, *geometry, *images, item.label, item.closed))

    def draw_rows(first: int, end: int) -> None:
        for draw_rows_of_mesh in draw:
            draw_rows_of_mesh(first, end)

    in_row_bands(draw_rows, len(target.depth))


@kernel(error_model="numpy")
def _draw(
    points, faces, colours, uv, parts, matrix, projection, depth, albedo, normal, label, places, number, closed, first,
    end,
):  # fmt: skip
    """Draws the rows `first` to `end` - 1 of a mesh with the points (3, n), see `draw_meshes`."""
    n = faces.shape[0]
    shown = np.empty((n + PART_FACES - 1) // PART_FACES, np.int32)
    window = 0, depth.shape[1], first, end
    n_shown = _list_parts(parts, matrix, projection, window, closed, shown)
    if n_shown == 0:
        return
    point, place = np.empty(points.shape), np.empty(points.shape)
    _project(points, matrix, projection, point, place)
    perspective = projection[4]
    kept = np.empty(PART_FACES + 1, np.int32)
    capacity = max(PART_FACES, depth.shape[1] // 2 + 1)  # blocks of 2 x 2 pixels, enough for two rows of pixels
    blocks = np.empty((3, capacity), np.int32)
    block_face, block_u, block_v = blocks[0], blocks[1], blocks[2]
    weight_b, weight_c, hits = np.empty((capacity, 4)), np.empty((capacity, 4)), np.empty(4 * capacity + 1, np.int32)
    for s in range(n_shown):
        start = shown[s] * PART_FACES
        n_kept = _list_triangles(faces, start, min(start + PART_FACES, n), place, window, closed, kept)
        k, row = 0, first
        while k < n_kept:
            n_hits, k, row = _list_pixels(
                faces, kept, n_kept, k, row, place, window, block_face, block_u, block_v, weight_b, weight_c, hits
            )
            f, i, j, m, oriented = np.int32(-1), 0, 0, 0, False
            qa, qb, qc, nx, ny, nz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for h in range(n_hits):
                block, pixel = hits[h] >> 2, hits[h] & 3
                u, v = block_u[block] + (pixel & 1), block_v[block] + (pixel >> 1)
                wb, wc = weight_b[block, pixel], weight_c[block, pixel]
                wa = 1 - wb - wc
                if block_face[block] != f:
                    f, oriented = block_face[block], False
                    i, j, m = faces[f, 0], faces[f, 1], faces[f, 2]
                    qa, qb, qc = place[2, i], place[2, j], place[2, m]
                q = wa * qa + wb * qb + wc * qc
                z = 1 / q if perspective else -q
                if not np.float32(z) < depth[v, u]:
                    continue
                depth[v, u] = z
                if label is not None:
                    label[v, u] = number
                if normal is not None:
                    if not oriented:
                        nx, ny, nz = _normal(point, i, j, m, perspective)
                        oriented = True
                    normal[v, u, 0], normal[v, u, 1], normal[v, u, 2] = nx, ny, nz
                pa, pb, pc = (wa * qa / q, wb * qb / q, wc * qc / q) if perspective else (wa, wb, wc)
                if albedo is not None:
                    for band in range(3):
                        mixed = pa * colours[i, band] + pb * colours[j, band] + pc * colours[m, band]
                        albedo[v, u, band] = np.uint8(mixed + 0.5)
                if uv is not None:
                    for t in range(3):
                        places[v, u, t] = pa * uv[i, t] + pb * uv[j, t] + pc * uv[m, t]


@kernel(error_model="numpy")
def _list_parts(parts, matrix, projection, window, closed, shown):
    """Writes the numbers of the parts that the image may show to `shown`; returns how many there are."""
    # the others are nearer than the near plane, outside the `window` (first column, end, first row, end), or of a
    # closed mesh and facing away: with the centre c of the part, w = c - e from a camera at e, the angle b between w
    # and the axis of the cone of normals, and the angle a of this cone, m (p - e) >= |w| cos(a + b) - behind_m (see
    # `Parts`) for the corner p and normal m of every triangle; in a parallel view, w is the direction of view
    centre, half, axis, cos_sin, behind = parts
    focal, cx, cy, near, perspective = projection
    left, right, top, bottom = window
    inverse = _inverse(matrix)
    n = 0
    for p in range(shown.size):
        shown[n] = p
        if centre.shape[0] == 0:
            n += 1
            continue
        x, rx = _interval(matrix[0], centre[p], half[p])
        y, ry = _interval(matrix[1], centre[p], half[p])
        z, rz = _interval(matrix[2], centre[p], half[p])
        farthest, nearest = z + rz, max(z - rz, near)
        x0, x1, y0, y1 = x - rx, x + rx, y - ry, y + ry
        if perspective:
            x0, x1 = x0 / (nearest if x0 < 0 else farthest), x1 / (farthest if x1 < 0 else nearest)
            y0, y1 = y0 / (nearest if y0 < 0 else farthest), y1 / (farthest if y1 < 0 else nearest)
        u0, u1 = max(np.ceil(focal * x0 + cx - MARGIN_PX), left), min(np.floor(focal * x1 + cx + MARGIN_PX), right - 1)
        v0, v1 = max(np.ceil(focal * y0 + cy - MARGIN_PX), top), min(np.floor(focal * y1 + cy + MARGIN_PX), bottom - 1)
        away = False
        if closed:
            wx, wy, wz = (x, y, z) if perspective else (0.0, 0.0, 1.0)
            a = inverse[0, 0] * wx + inverse[0, 1] * wy + inverse[0, 2] * wz
            b = inverse[1, 0] * wx + inverse[1, 1] * wy + inverse[1, 2] * wz
            c = inverse[2, 0] * wx + inverse[2, 1] * wy + inverse[2, 2] * wz
            length_2, along = a * a + b * b + c * c, a * axis[p, 0] + b * axis[p, 1] + c * axis[p, 2]
            across = np.sqrt(max(length_2 - along * along, 0.0))
            gap = behind[p] if perspective or behind[p] == np.inf else 0.0
            gap += MARGIN * np.sqrt(length_2)
            away = along > 0 and along * cos_sin[p, 0] - across * cos_sin[p, 1] > gap
        n += np.int64((farthest >= near) & (u0 <= u1) & (v0 <= v1) & (not away))
    return n


@kernel(error_model="numpy", forceinline=True)
def _interval(row, centre, half):
    middle = row[0] * centre[0] + row[1] * centre[1] + row[2] * centre[2] + row[3]
    return middle, abs(row[0]) * half[0] + abs(row[1]) * half[1] + abs(row[2]) * half[2]


@kernel(error_model="numpy")
def _inverse(matrix):
    """Returns the inverse (3, 3) of the linear part of a map (3, 4); zeros, which keep all parts, if it mirrors."""
    a, b, c = matrix[0, :3], matrix[1, :3], matrix[2, :3]
    inverse = np.zeros((3, 3))
    inverse[:, 0], inverse[:, 1], inverse[:, 2] = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    determinant = np.sum(a * inverse[:, 0])
    return inverse / determinant if determinant > 0 else np.zeros((3, 3))


@kernel(error_model="numpy")
def _project(points, matrix, projection, point, place):
    """Computes the points (3, n) in camera axes, and their `place` (3, n): column, row and 1 / depth or -depth."""
    focal, cx, cy, near, perspective = projection
    a, b, c = points
    n = a.size
    for k in range(3):
        m, along = matrix[k], point[k]
        for i in range(n):
            along[i] = m[0] * np.float64(a[i]) + m[1] * np.float64(b[i]) + m[2] * np.float64(c[i]) + m[3]
    x, y, z = point
    u, v, q = place
    for i in range(n):
        q[i] = 1 / z[i] if perspective else 1.0
    for i in range(n):
        column = focal * x[i] * q[i] + cx
        u[i] = np.nan if z[i] < near else column
    for i in range(n):
        v[i] = focal * y[i] * q[i] + cy
    if not perspective:
        for i in range(n):
            q[i] = -z[i]


@kernel(error_model="numpy", forceinline=True)
def _list_triangles(faces, start, end, place, window, closed, kept):
    """Writes to `kept` the triangles `start` to `end` - 1 that may cover pixel centres; returns their number."""
    u, v = place[0], place[1]
    n = 0
    for f in range(start, end):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ua, va, ub, vb, uc, vc = u[i], v[i], u[j], v[j], u[k], v[k]
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)  # negative if the triangle faces the viewer
        u0, u1, v0, v1 = _rectangle(ua, va, ub, vb, uc, vc, window)
        kept[n] = f
        n += np.int64(((area < 0) | ((area > 0) & (not closed))) & (u0 <= u1) & (v0 <= v1))
    return n


@kernel(error_model="numpy", forceinline=True)
def _rectangle(ua, va, ub, vb, uc, vc, window):
    """Returns first and last column, first and last row of the pixel centres around a triangle."""
    left, right, top, bottom = window
    u0, u1 = max(np.ceil(min(ua, ub, uc)), np.float64(left)), min(np.floor(max(ua, ub, uc)), np.float64(right - 1))
    v0, v1 = max(np.ceil(min(va, vb, vc)), np.float64(top)), min(np.floor(max(va, vb, vc)), np.float64(bottom - 1))
    return u0, u1, v0, v1


@kernel(error_model="numpy", forceinline=True)
def _list_pixels(faces, kept, n_kept, k, row, place, window, block_face, block_u, block_v, weight_b, weight_c, hits):
    """Lists pixels that the triangles `kept[k]` to `kept[n_kept - 1]` cover, from row `row` of the first on."""
    # by block of 2 x 2 pixels: triangle, first column and row, weights of the second and third corner; a hit is 4 times
    # the number of a block plus that of a pixel in it. Returns the number of hits, and `k` and `row` to go on from if
    # the arrays are full.
    u, v = place[0], place[1]
    n_blocks, n_hits = 0, 0
    while k < n_kept:
        f = kept[k]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ua, va, ub, vb, uc, vc = u[a], v[a], u[b], v[b], u[c], v[c]
        ab_u, ab_v, ac_u, ac_v = ub - ua, vb - va, uc - ua, vc - va
        per_area = 1 / (ab_u * ac_v - ac_u * ab_v)
        u0, u1, v0, v1 = _rectangle(ua, va, ub, vb, uc, vc, window)
        y = max(v0, np.float64(row))
        while y <= v1:
            if n_blocks + (u1 - u0) / 2 + 1 > block_face.size:
                return n_hits, k, np.int64(y)
            x = u0
            while x <= u1:
                block_face[n_blocks], block_u[n_blocks], block_v[n_blocks] = f, np.int32(x), np.int32(y)
                for pixel in range(4):
                    across, down = x + (pixel & 1) - ua, y + (pixel >> 1) - va
                    wb, wc = (across * ac_v - ac_u * down) * per_area, (ab_u * down - across * ab_v) * per_area
                    weight_b[n_blocks, pixel], weight_c[n_blocks, pixel] = wb, wc
                    inside = (1 - wb - wc >= 0) & (wb >= 0) & (wc >= 0)
                    hits[n_hits] = 4 * n_blocks + pixel
                    n_hits += np.int64(inside & (x + (pixel & 1) <= u1) & (y + (pixel >> 1) <= v1))
                n_blocks += 1
                x += 2
            y += 2
        k, row = k + 1, window[2]
    return n_hits, k, row


@kernel(error_model="numpy", forceinline=True)
def _normal(point, i, j, k, perspective):
    x, y, z = point[0], point[1], point[2]
    px, py, pz, qx, qy, qz = x[j] - x[i], y[j] - y[i], z[j] - z[i], x[k] - x[i], y[k] - y[i], z[k] - z[i]
    nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    away = nx * x[i] + ny * y[i] + nz * z[i] if perspective else nz
    per_n = -1 / np.sqrt(nx * nx + ny * ny + nz * nz)
    per_n = per_n if away > 0 else -per_n
    return nx * per_n, ny * per_n, nz * per_n
