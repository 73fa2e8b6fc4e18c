"""Levels of detail of a mesh, by clustering of vertices (Rossignac & Borrel 1993), and bounds of their parts.

The vertices of each cell of a cubic grid become one vertex, their mean; triangles with two corners in one cell are
removed. No point of the surface moves by more than the diagonal of a cell, so the cell bounds the error of a level.
Colours are averaged over a cell too, which filters them as a mip-map filters a texture.

A part is a run of consecutive triangles, which are neighbours in the built-in shapes and in most mesh files. Its bounds
are a box and a cone that contains the normals of its triangles (Shirman & Abi-Ezzi 1993).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.terrains.objects.coloured_mesh import Mesh, median_edge_m

FEWEST_FACES = 64  #: a level with at most this many triangles is the last one
PART_FACES = 128  #: triangles in a part; the last part may have fewer
THIN = 1e-6  #: a triangle with a smaller ratio of height to length has no reliable normal


class Parts(NamedTuple):
    """Bounds of the n parts of a mesh, in the axes of the object.

    With c the centre of a part, p a corner and m the unit normal of any of its triangles, the angle between m and
    `axis` is at most the one whose cosine and sine are `cos_sin`, and m (p - c) >= -`behind_m`.
    """

    centre_m: Array  #: (n, 3) centre of the bounding box
    half_m: Array  #: (n, 3) half of its extent
    axis: Array  #: (n, 3) unit vector, axis of the cone of the normals
    cos_sin: Array  #: (n, 2) cosine and sine of the largest angle between the axis and a normal; at most 90 deg
    #: (n,) largest distance of the centre in front of the plane of a triangle; inf if normals differ from the axis by
    #: 90 deg or more, or are not known
    behind_m: Array


#: Stands for the bounds of a mesh whose bounds are not known, so that all its parts are drawn.
UNKNOWN = Parts(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty(0))


class Level(NamedTuple):
    mesh: Mesh  #: its positions are stored column by column, as the rasterizer reads them
    cell_m: float  #: side of the cells in which vertices were merged; 0 for the full mesh
    parts: Parts  #: bounds of the parts of the mesh


def level_of(mesh: Mesh, cell_m: float) -> Level:
    return Level(mesh._replace(vertices_m=np.asfortranarray(mesh.vertices_m)), cell_m, parts_of(mesh))


def levels_of(mesh: Mesh) -> tuple[Level, ...]:
    """Returns the levels of detail, finest first, from the full mesh to one with at most FEWEST_FACES triangles.

    The side of the cells starts at the median edge length of the full mesh and grows by a factor of sqrt(2); a step
    that removes no triangles makes no level, and one that would leave none is the end.
    """
    cell_m = median_edge_m(mesh)
    levels = [level_of(mesh, 0.0)]
    while len(levels[-1].mesh.faces) > FEWEST_FACES:
        coarser = clustered(mesh, cell_m)
        if len(coarser.faces) == 0:
            break
        if len(coarser.faces) < len(levels[-1].mesh.faces):
            levels.append(level_of(coarser, cell_m))
        cell_m *= np.sqrt(2)
    return tuple(levels)


def clustered(mesh: Mesh, cell_m: float) -> Mesh:
    """Returns the mesh with the vertices of each cubic cell merged, without degenerate and equal triangles."""
    vertex_of, colours, positions = _clusters(mesh, cell_m)
    faces = vertex_of[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    smallest_first = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    _, kept = np.unique(_numbers(smallest_first), return_index=True)
    return Mesh(positions.astype(np.float32), faces[np.sort(kept)].astype(np.int32), colours)


def cell_colours(mesh: Mesh, cell_m: float) -> NDArray[np.uint8]:
    """Returns the mean colour (n, 3) of the vertices in the cubic cell of side `cell_m` of each vertex."""
    vertex_of, colours, _ = _clusters(mesh, cell_m)
    return colours[vertex_of]


def _clusters(mesh: Mesh, cell_m: float) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.float64]]:
    """Returns the number (n,) of the cell of each vertex, and mean colour and position (k, 3) of each cell."""
    cells = np.floor((mesh.vertices_m - mesh.vertices_m.min(axis=0)) / cell_m).astype(np.int64)
    _, cell_of, count = np.unique(_numbers(cells), return_inverse=True, return_counts=True)
    colours, positions = (
        np.stack([np.bincount(cell_of, column, len(count)) / count for column in values.T.astype(np.float64)], axis=1)
        for values in (mesh.colours, mesh.vertices_m)
    )
    return cell_of, np.rint(colours).astype(np.uint8), positions


def _numbers(triples: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns a number (n,) for each triple (n, 3) of integers >= 0; only equal triples have equal numbers."""
    size = triples.max(axis=0, initial=0) + 1
    return (triples[:, 0] * size[1] + triples[:, 1]) * size[2] + triples[:, 2]


def parts_of(mesh: Mesh) -> Parts:
    n = -(-len(mesh.faces) // PART_FACES)
    faces = np.pad(mesh.faces, ((0, n * PART_FACES - len(mesh.faces)), (0, 0)), mode="edge")
    corners = mesh.vertices_m[faces].astype(np.float64)
    normals, thin = _normals(corners)
    corners, normals = corners.reshape(n, -1, 3, 3), normals.reshape(n, -1, 3)
    low, high, mean = corners.min(axis=(1, 2)), corners.max(axis=(1, 2)), normals.sum(axis=1)
    centre, axis = (low + high) / 2, mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    cosine = np.minimum((normals @ axis[..., None])[..., 0].min(axis=1), 1.0)
    behind = (normals * (centre[:, None] - corners[:, :, 0])).sum(axis=2).max(axis=1)
    known = (cosine > 0) & ~thin.reshape(n, -1).any(axis=1)
    cosine = np.where(known, cosine, 0.0)
    cone = np.stack([cosine, np.sqrt(1 - cosine**2)], axis=1)
    return Parts(centre, (high - low) / 2, axis, cone, np.where(known, behind, np.inf))


def _normals(corners: Array) -> tuple[Array, Array]:
    """Returns the unit normals (m, 3) of triangles (m, 3, 3), and whether each triangle is thin (m,)."""
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    x, y, z = np.cross(ab, ac).T
    length, size = np.sqrt(x * x + y * y + z * z), np.abs(np.concatenate([ab, ac], axis=1)).max(axis=1)
    return np.stack([x, y, z], axis=1) / np.maximum(length, 1e-300)[:, None], length <= THIN * size**2
