"""The elevation map as a coloured triangle mesh in GLB."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.gltf import export_glb

from twin.core.records import ElevationMap

#: GLB is Y-up: east stays x, up becomes y, north becomes -z.
GLB_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
#: Larger maps are thinned to about so many vertices, so that viewers keep up.
MAX_VERTICES = 400_000


def write_glb(path: Path, elevation_map: ElevationMap, max_vertices: int = MAX_VERTICES) -> None:
    """Writes the seen cells as a surface with the mosaic's colours; a map without any as an empty scene."""
    mesh = surface(elevation_map, max_vertices)
    scene = trimesh.Scene([mesh] if len(mesh.faces) else [])
    path.write_bytes(export_glb(scene))


def surface(elevation_map: ElevationMap, max_vertices: int = MAX_VERTICES) -> trimesh.Trimesh:
    """The mesh in GLB's axes: a vertex at each seen cell's centre, triangles between neighbours, faces upwards."""
    stride = max(1, int(np.ceil(np.sqrt(elevation_map.height_m.size / max_vertices))))
    x, y = elevation_map.grid.centres()
    height = elevation_map.height_m[::stride, ::stride]
    east, north = np.meshgrid(x[::stride], y[::stride])
    points = np.stack([east, north, height], axis=-1).reshape(-1, 3)
    colours = elevation_map.mosaic[::stride, ::stride].reshape(-1, 3)
    faces = _faces(np.isfinite(height))
    used, faces = np.unique(faces, return_inverse=True)
    return trimesh.Trimesh(
        points[used] @ GLB_FROM_WORLD.T, faces.reshape(-1, 3), vertex_colors=colours[used], process=False
    )


def _faces(seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(n, 3) indices of the triangles of a grid (row 0 = north) with all corners seen, counter-clockwise from above."""
    index = np.arange(seen.size).reshape(seen.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    triangles = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
    return triangles[seen.reshape(-1)[triangles].all(axis=1)]
