"""Levels of detail of a mesh, by clustering of vertices (Rossignac & Borrel 1993).

The vertices of each cell of a cubic grid become one vertex, their mean; triangles with two corners in one cell are
removed. No point of the surface moves by more than the diagonal of a cell, so the cell bounds the error of a level.
Colours are averaged over a cell too, which filters them as a mip-map filters a texture.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.terrains.objects.coloured_mesh import Mesh, median_edge_m
from twin.terrains.objects.parts import Parts, parts_of

FEWEST_FACES = 64  #: a level with at most this many triangles is the last one


class Level(NamedTuple):
    """One level of detail."""

    mesh: Mesh  #: its positions are stored column by column, as the rasterizer reads them
    cell_m: float  #: side of the cells in which vertices were merged; 0 for the full mesh
    parts: Parts  #: bounds of the parts of the mesh


def level_of(mesh: Mesh, cell_m: float) -> Level:
    """Returns a mesh as a level of detail."""
    return Level(mesh._replace(vertices_m=np.asfortranarray(mesh.vertices_m)), cell_m, parts_of(mesh))


def levels_of(mesh: Mesh) -> tuple[Level, ...]:
    """Returns the levels of detail, finest first.

    The first level is the full mesh. The side of the cells of the others starts at the median edge length of the full
    mesh and grows by a factor of sqrt(2) in each step; a step that removes no triangles makes no level. The last level
    has at most FEWEST_FACES triangles, or the next step would leave none.
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
    """Returns the mesh with the vertices of each cubic cell of side `cell_m` merged to their mean.

    Triangles that then have two corners in one cell are removed, and of equal triangles all but one.
    """
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
