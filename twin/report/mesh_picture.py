"""Oblique picture of the mapped surface: mesh.glb, drawn by the rasterizer of the cameras."""

from pathlib import Path

import cv2
import numpy as np
import trimesh

from twin.core import geometry
from twin.core.records import Array, Image
from twin.exchange.mesh import GLB_FROM_WORLD
from twin.imaging.scene.mesh_raster import NEAR_M, DrawnMesh, Projection, Target, draw_meshes
from twin.terrains.objects.coloured_mesh import with_colours

WIDTH_PX, HEIGHT_PX, VFOV_DEG = 1400, 900, 30.0
#: Viewing direction: depression angle, and angle of the camera's position from south towards east.
DEPRESSION_DEG, EAST_DEG = 42.0, 20.0
MARGIN = 1.04  # camera distance / smallest distance with all vertices in view
#: The picture shows all vertices with coordinates between these percentiles; outliers may be cut off.
FRAMED_PERCENT = (0.2, 99.8)
#: Direction to the light in the axes of glTF (east, up, south): north-west, as in all maps of the report.
LIGHT = np.array([-0.5, 0.7, -0.5])
_FINER = 2  # the picture is drawn with so many times more rows and columns, and reduced


def surface_picture(mesh_file: Path, map_from_world: Array | None = None) -> Image | None:
    """Returns an oblique view (h, w, 3) RGB of a map_mesh file, lit from the north-west; None if it cannot be read.

    `map_from_world` (4, 4) is the pose of the world in the map, whose axes are those of the picture; None: identity.
    """
    if not mesh_file.is_file():
        return None
    try:
        mesh = trimesh.load_scene(mesh_file).to_mesh()
    except (ValueError, KeyError, TypeError, IndexError, OSError):
        return None
    if not len(mesh.vertices):
        return None
    mesh.vertices = in_map_frame(mesh.vertices, np.eye(4) if map_from_world is None else map_from_world)
    colours = shaded_colours(mesh.visual.vertex_colors[:, :3], mesh.vertex_normals)
    height, width = _FINER * HEIGHT_PX, _FINER * WIDTH_PX
    focal_px = height / 2 / np.tan(np.deg2rad(VFOV_DEG) / 2)
    view = Projection(float(focal_px), (width - 1) / 2, (height - 1) / 2, NEAR_M, True)
    drawn, depth = np.full((height, width, 3), 255, np.uint8), np.full((height, width), np.inf, np.float32)
    camera_from_mesh = np.diag([1.0, -1.0, -1.0, 1.0]) @ geometry.inverse(camera_pose(mesh.vertices))
    draw_meshes(
        [DrawnMesh(with_colours(mesh.vertices, mesh.faces, colours), camera_from_mesh)], view, Target(depth, drawn)
    )
    rows, cols = (np.flatnonzero(np.isfinite(depth).any(axis=axis)) // _FINER for axis in (1, 0))
    if not len(rows):
        return None
    shown = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    picture = cv2.resize(drawn, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA)
    return np.asarray(picture[shown], np.uint8)


def in_map_frame(vertices: Array, map_from_world: Array) -> Array:
    """Returns vertices (n, 3) of a mesh in the world in the frame of its map, both in the axes of glTF [m]."""
    return geometry.transform(map_from_world, vertices @ GLB_FROM_WORLD) @ GLB_FROM_WORLD.T


def shaded_colours(colours: Image, normals: Array) -> Image:
    """Returns vertex colours (n, 3) with Lambertian shading and enough ambient light to keep the mosaic's colours."""
    cosine = np.clip(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    return np.clip(colours * (0.7 + 0.7 * cosine[:, None]), 0, 255).astype(np.uint8)


def camera_pose(vertices: Array) -> Array:
    """Returns the pose (4, 4) of an OpenGL camera (viewing along -z) that has all vertices except outliers in view.

    At the distance d from the centre of the vertices, a vertex at q relative to this centre, in camera axes, is in view
    if |q_x| <= t (d - q_z), with t the tangent of half the horizontal field of view, and accordingly for q_y. The
    distance is the smallest such d times `MARGIN`.
    """
    low, high = np.percentile(vertices, FRAMED_PERCENT, axis=0)
    framed = np.clip(vertices, low, high)
    about_up, about_right = np.deg2rad([[0.0, EAST_DEG, 0.0], [-DEPRESSION_DEG, 0.0, 0.0]])
    rotation = geometry.so3_exp(about_up) @ geometry.so3_exp(about_right)
    centre = (low + high) / 2
    tangents = np.tan(np.deg2rad(VFOV_DEG) / 2) * np.array([WIDTH_PX / HEIGHT_PX, 1.0])
    points = (framed - centre) @ rotation
    distance = MARGIN * float((points[:, 2:] + np.abs(points[:, :2]) / tangents).max())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre + distance * rotation[:, 2]
    return pose
