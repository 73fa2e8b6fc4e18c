"""Rasterization of triangle meshes into images of depth, normals and labels, with a depth test, as in OpenGL.

One kernel serves the cameras, the shadow maps of lamps and sun, and the view from above that gives the true heights.
A pixel shows the triangle that the ray through the pixel centre meets first, and the exact depth of this point. Within
a triangle, 1 / depth is linear in column and row in a perspective view; in a parallel view, depth is linear.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from terrains.objects.mesh import Mesh

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

NEAR_M = 0.05  #: depth of the near clipping plane of all cameras


class Projection(NamedTuple):
    """Projection of points in the axes of a camera (x right, y down, z forward).

    Args:
        focal_px: focal length of a perspective view [px], or pixels per metre of a parallel view.
        cx_px, cy_px: column and row of the optical axis.
        near_m: triangles with a corner at a smaller depth are left out.
        perspective: whether columns and rows are those of a pinhole camera.
    """

    focal_px: float
    cx_px: float
    cy_px: float
    near_m: float
    perspective: bool


class ObjectView(NamedTuple):
    """Objects in an image.

    Args:
        normal: (H, W, 3) float32 unit normals in the axes of the camera, valid where `label` is not 0.
        label: (H, W) uint16, 1 + number of the object that the pixel shows; 0: the floor, or nothing.
    """

    normal: NDArray[np.float32]
    label: NDArray[np.uint16]


class Target(NamedTuple):
    """Images (H, W) that a mesh is drawn into, in the pixels where the mesh is nearer than `depth`.

    Args:
        depth: depth along the optical axis [m]; inf where there is nothing.
        albedo: (H, W, 3) uint8; None: not drawn.
        normal: (H, W, 3) float32 unit normals in the axes of the camera, towards the camera; None: not drawn.
        label: (H, W) uint16 number that identifies the mesh in each pixel; None: not drawn.
        uv: (H, W, 3) float32 values interpolated between the `uv` of the vertices that `draw_mesh` was given; None: not
            drawn.
    """

    depth: Depth
    albedo: NDArray[np.uint8] | None = None
    normal: NDArray[np.float32] | None = None
    label: NDArray[np.uint16] | None = None
    uv: NDArray[np.float32] | None = None


def draw_mesh(
    mesh: Mesh,
    camera_from_object: Array,
    projection: Projection,
    target: Target,
    label: int = 0,
    closed: bool = False,
    uv: NDArray[np.float32] | None = None,
) -> None:
    """Draws a mesh into images, in the pixels where it is nearer than what they show.

    Args:
        mesh: the mesh.
        camera_from_object: (4, 4) or (3, 4) affine map from the axes of the mesh to those of the camera.
        projection: projection of the camera.
        target: images to draw into, modified in place.
        label: number to write into `target.label`.
        closed: whether the mesh is closed, so that the triangles that face away are not drawn.
        uv: (n, 3) values of the vertices, drawn into `target.uv`; None: `target.uv` is not drawn.
    """
    matrix = np.ascontiguousarray(camera_from_object[:3], np.float64)
    if uv is None or target.uv is None:
        uv, target = None, target._replace(uv=None)
    _draw(*mesh, uv, matrix, projection, *target, np.uint16(label), closed)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(vertices, faces, colours, uv, matrix, projection, depth, albedo, normal, label, places, number, closed):
    """Compiled kernel of `draw_mesh`. The compiler removes the code for images that are None."""
    focal, cx, cy, near, perspective = projection
    n = vertices.shape[0]
    point, place = np.empty((n, 3)), np.empty((n, 3))  # in camera axes; column, row and 1 / depth or -depth
    for i in range(n):
        a, b, c = np.float64(vertices[i, 0]), np.float64(vertices[i, 1]), np.float64(vertices[i, 2])
        x = matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c + matrix[0, 3]
        y = matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c + matrix[1, 3]
        z = matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c + matrix[2, 3]
        point[i, 0], point[i, 1], point[i, 2] = x, y, z
        share = 1 / z if perspective else 1.0
        place[i, 0], place[i, 1], place[i, 2] = focal * x * share + cx, focal * y * share + cy, share
        if not perspective:
            place[i, 2] = -z
    height, width = depth.shape
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        if point[i, 2] < near or point[j, 2] < near or point[k, 2] < near:
            continue
        ua, va, ub, vb, uc, vc = place[i, 0], place[i, 1], place[j, 0], place[j, 1], place[k, 0], place[k, 1]
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if area == 0 or (closed and area > 0):  # the area is negative if the triangle faces the viewer
            continue
        first_u = max(int(np.ceil(max(min(ua, ub, uc), -1.0))), 0)
        last_u = int(np.floor(min(max(ua, ub, uc), width - 1.0)))
        first_v = max(int(np.ceil(max(min(va, vb, vc), -1.0))), 0)
        last_v = int(np.floor(min(max(va, vb, vc), height - 1.0)))
        if first_u > last_u or first_v > last_v:
            continue
        per_area = 1 / area
        qa, qb, qc = place[i, 2], place[j, 2], place[k, 2]
        facing = False
        nx, ny, nz = 0.0, 0.0, 0.0
        for v in range(first_v, last_v + 1):
            for u in range(first_u, last_u + 1):
                wb = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) * per_area
                wc = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) * per_area
                wa = 1 - wb - wc
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                q = wa * qa + wb * qb + wc * qc
                z = 1 / q if perspective else -q
                if not np.float32(z) < depth[v, u]:
                    continue
                depth[v, u] = z
                if label is not None:
                    label[v, u] = number
                if normal is not None:
                    if not facing:
                        nx, ny, nz = _normal(point[i], point[j], point[k], perspective)
                        facing = True
                    normal[v, u, 0], normal[v, u, 1], normal[v, u, 2] = nx, ny, nz
                if albedo is not None:
                    pa, pb, pc = (wa * qa / q, wb * qb / q, wc * qc / q) if perspective else (wa, wb, wc)
                    for band in range(3):
                        mixed = pa * colours[i, band] + pb * colours[j, band] + pc * colours[k, band]
                        albedo[v, u, band] = np.uint8(mixed + 0.5)
                if uv is not None:
                    pa, pb, pc = (wa * qa / q, wb * qb / q, wc * qc / q) if perspective else (wa, wb, wc)
                    for part in range(3):
                        places[v, u, part] = pa * uv[i, part] + pb * uv[j, part] + pc * uv[k, part]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _normal(a, b, c, perspective):
    """Returns the unit normal of the triangle a, b, c in camera axes, on the side that the camera sees."""
    px, py, pz, qx, qy, qz = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    away = nx * a[0] + ny * a[1] + nz * a[2] if perspective else nz
    per_n = -1 / np.sqrt(nx * nx + ny * ny + nz * nz)
    per_n = per_n if away > 0 else -per_n
    return nx * per_n, ny * per_n, nz * per_n
