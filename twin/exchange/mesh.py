"""The elevation map as a coloured triangle mesh in GLB (binary glTF)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb

from twin.core.height_field import raster_triangles
from twin.core.records import ElevationMap

#: Rotation from the axes of the world to those of glTF, which is y-up: x is east, y is up, z is south.
GLB_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
#: Maps with more cells are subsampled to about this number of vertices, which common viewers display smoothly.
MAX_VERTICES = 400_000


def write_glb(path: Path, elevation_map: ElevationMap, max_vertices: int = MAX_VERTICES) -> None:
    """Writes the mesh of a map (`map_mesh`) as GLB; a mesh without triangles is written as an empty scene."""
    mesh = map_mesh(elevation_map, max_vertices)
    scene = trimesh.Scene([mesh] if len(mesh.faces) else [])
    path.write_bytes(export_glb(scene))


def map_mesh(elevation_map: ElevationMap, max_vertices: int = MAX_VERTICES) -> trimesh.Trimesh:
    """Returns the triangle mesh of a map with its colours, in scene coordinates in glTF axes (`GLB_FROM_WORLD`).

    Vertices are the centres of the mapped cells, subsampled to about `max_vertices`. Triangles connect neighbouring
    vertices and face up in the frame of the map; cells that belong to no triangle are omitted.
    """
    stride = max(1, int(np.ceil(np.sqrt(elevation_map.height_m.size / max_vertices))))
    x, y = elevation_map.grid.centres()
    height = elevation_map.height_m[::stride, ::stride]
    east, north = np.meshgrid(x[::stride], y[::stride])
    points = np.stack([east, north, height], axis=-1).reshape(-1, 3).astype(np.float64)
    colours = elevation_map.mosaic[::stride, ::stride].reshape(-1, 3)
    used, faces = np.unique(raster_triangles(np.isfinite(height)), return_inverse=True)
    return trimesh.Trimesh(
        elevation_map.to_world(points[used]) @ GLB_FROM_WORLD.T,
        faces.reshape(-1, 3),
        vertex_colors=colours[used],
        process=False,
    )
