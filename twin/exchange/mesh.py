"""The elevation map as a triangle mesh, with the colours of its cells as GLB (binary glTF)."""

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.gltf import export_glb

from twin.core.geometry import Array
from twin.core.height_field import raster_triangles
from twin.core.records import ElevationMap

#: Rotation from the axes of the world to those of glTF, which is y-up: x is east, y is up, z is south.
GLB_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
#: Maps with more cells are subsampled to about this number of vertices, which common viewers display smoothly.
MAX_VERTICES = 400_000


def surface(
    elevation_map: ElevationMap, max_vertices: int = MAX_VERTICES
) -> tuple[Array, NDArray[np.int64], NDArray[np.uint8]]:
    """Returns the surface of a map: triangles that connect the centres of its cells, about `max_vertices` at most.

    These are vertices (n, 3) in the frame of the map [m], without those of no triangle; triangles (m, 3), which face up
    in this frame; colours (n, 3) of the vertices.
    """
    stride = max(1, int(np.ceil(np.sqrt(elevation_map.height_m.size / max_vertices))))
    x, y = elevation_map.grid.centres()
    height = elevation_map.height_m[::stride, ::stride]
    east, north = np.meshgrid(x[::stride], y[::stride])
    points = np.stack([east, north, height], axis=-1).reshape(-1, 3).astype(np.float64)
    colours = elevation_map.mosaic[::stride, ::stride].reshape(-1, 3)
    used, faces = np.unique(raster_triangles(np.isfinite(height)), return_inverse=True)
    return points[used], faces.reshape(-1, 3), colours[used]


def map_mesh(elevation_map: ElevationMap, max_vertices: int = MAX_VERTICES) -> trimesh.Trimesh:
    """Returns the mesh of a map with its colours, in scene coordinates in glTF axes (`GLB_FROM_WORLD`)."""
    points, faces, colours = surface(elevation_map, max_vertices)
    vertices = elevation_map.to_world(points) @ GLB_FROM_WORLD.T
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)


def write_glb(path: Path, elevation_map: ElevationMap) -> None:
    path.write_bytes(glb(map_mesh(elevation_map)))


def glb(mesh: trimesh.Trimesh, **extras: str) -> bytes:
    """Returns a mesh as GLB with extras of its scene; a mesh without triangles is an empty scene."""
    scene = trimesh.Scene([mesh] if len(mesh.faces) else [])
    scene.metadata.update(extras)
    return export_glb(scene)
