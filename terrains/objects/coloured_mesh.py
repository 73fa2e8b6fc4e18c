"""Triangle meshes with one colour per vertex: the form of all objects, whether built in or read from a file."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.core.geometry import Array


class Mesh(NamedTuple):
    """Triangles with one colour per vertex, counter-clockwise as seen from outside."""

    vertices_m: NDArray[np.float32]  #: (n, 3) positions in the axes of the object, z up
    faces: NDArray[np.int32]  #: (m, 3) vertex numbers
    colours: NDArray[np.uint8]  #: (n, 3) albedo, 255 = white


def mesh_of(vertices_m: ArrayLike, faces: ArrayLike, albedo: ArrayLike) -> Mesh:
    """Returns a mesh of vertices (n, 3) and faces (m, 3) with the albedo (3,) or (n, 3), limited to 0 to 1."""
    return with_colours(vertices_m, faces, np.rint(np.clip(np.asarray(albedo, np.float64), 0, 1) * 255))


def with_colours(vertices_m: ArrayLike, faces: ArrayLike, colours: ArrayLike) -> Mesh:
    """Returns a mesh whose colours, 0 to 255, are one for each vertex or one for all."""
    vertices = np.asarray(vertices_m)
    return Mesh(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.int32),
        np.ascontiguousarray(np.broadcast_to(colours, vertices.shape), np.uint8),
    )


def joined(meshes: list[Mesh]) -> Mesh:
    first = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    faces = [mesh.faces + np.int32(k) for mesh, k in zip(meshes, first, strict=False)]
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([mesh.colours for mesh in meshes]),
    )


def standing(mesh: Mesh) -> Mesh:
    low, high = extent(mesh)
    origin = np.append((low + high)[:2] / 2, low[2])
    return mesh._replace(vertices_m=(mesh.vertices_m - origin).astype(np.float32))


def welded_faces(mesh: Mesh) -> NDArray[np.int64]:
    """Returns the faces (k, 3) with equal positions as one vertex, without faces in which two corners coincide."""
    _, corner = np.unique(mesh.vertices_m, axis=0, return_inverse=True)
    faces = corner.ravel()[mesh.faces].astype(np.int64)
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


def is_closed(mesh: Mesh) -> bool:
    """Returns whether a mesh encloses a volume with all triangles facing outwards, so that back faces are hidden."""
    faces, n = welded_faces(mesh), len(mesh.vertices_m)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    there, back = np.sort(start * n + end), np.sort(end * n + start)
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces].astype(np.float64), 1, 0)
    volume = np.einsum("ij,ij->", a, np.cross(b, c))
    return bool((there[1:] != there[:-1]).all() and np.array_equal(there, back) and volume > 0)


def extent(mesh: Mesh) -> tuple[Array, Array]:
    return mesh.vertices_m.min(axis=0).astype(np.float64), mesh.vertices_m.max(axis=0).astype(np.float64)


def median_edge_m(mesh: Mesh) -> float:
    """Returns the median length of the edges [m] longer than a millionth of the largest extent; else that millionth."""
    corners = mesh.vertices_m[mesh.faces]
    lengths_m = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    shortest_m = 1e-6 * float(np.ptp(mesh.vertices_m, axis=0).max())
    counted_m = lengths_m[lengths_m > shortest_m]
    return float(np.median(counted_m)) if len(counted_m) else shortest_m
