"""Oblique picture of the mapped surface: mesh.glb rendered with pyrender in a separate process.

A faulty OpenGL driver can crash the process. Therefore `surface_picture` runs this module as a program and returns None
if the program fails.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:  # loading other modules would take most of the time of the program
    from twin.core.records import Array, Image

#: Time limit of the rendering process; if rendering takes longer, the report has no picture of the surface.
LIMIT_S = 15.0
WIDTH_PX, HEIGHT_PX, VFOV_DEG = 1400, 900, 30.0
#: Viewing direction: depression angle, and angle of the camera's position from south towards east.
DEPRESSION_DEG, EAST_DEG = 42.0, 20.0
MARGIN = 1.04  # camera distance / smallest distance with all vertices in view
#: The picture shows all vertices with coordinates between these percentiles; outliers may be cut off.
FRAMED_PERCENT = (0.2, 99.8)
#: Direction to the light in the axes of glTF (east, up, south): north-west, as in all maps of the report.
LIGHT = np.array([-0.5, 0.7, -0.5])
WHITE = (1.0, 1.0, 1.0, 0.0)


def surface_picture(mesh_file: Path, map_from_world: Array | None = None, limit_s: float = LIMIT_S) -> Image | None:
    """Returns an oblique view of the mesh from the south-south-east, (h, w, 3) RGB; None if it cannot be rendered.

    Args:
        mesh_file: the mesh in the world (`twin.exchange.mesh.map_mesh`).
        map_from_world: (4, 4) pose of the world in the map, whose axes are east, north and up of the picture; None: the
            identity.
        limit_s: time limit of the rendering process.
    """
    from twin.report.images import read_rgb

    if not mesh_file.is_file():
        return None
    try:
        with tempfile.TemporaryDirectory() as folder:
            picture = Path(folder) / "surface.png"
            pose = json.dumps(np.eye(4).tolist() if map_from_world is None else map_from_world.tolist())
            command = [sys.executable, "-P", "-m", __name__, str(mesh_file), str(picture), pose]
            subprocess.run(command, capture_output=True, timeout=limit_s, check=True)
            return read_rgb(picture)
    except (OSError, subprocess.SubprocessError):
        return None


def render_mesh(mesh: Any) -> Image:
    """Returns a picture of a coloured trimesh in the axes of glTF (y up), lit from the north-west and cropped to it."""
    import pyglet

    pyglet.options["headless"] = True  # otherwise pyglet's window module, imported by pyrender, needs X libraries
    import pyrender

    scene = pyrender.Scene(bg_color=WHITE)
    mesh.visual.vertex_colors = shaded_colours(mesh.visual.vertex_colors[:, :3], mesh.vertex_normals)
    scene.add(pyrender.Mesh.from_trimesh(mesh))
    camera = pyrender.PerspectiveCamera(np.deg2rad(VFOV_DEG), aspectRatio=WIDTH_PX / HEIGHT_PX)
    scene.add(camera, pose=camera_pose(mesh.vertices))
    renderer = pyrender.OffscreenRenderer(WIDTH_PX, HEIGHT_PX)
    flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES
    rendered: Any = renderer.render(scene, flags)
    renderer.delete()
    picture, depth = rendered
    rows, cols = np.nonzero(depth)
    return picture[rows.min() : rows.max() + 1, cols.min() : cols.max() + 1]


def in_map_frame(vertices: Array, map_from_world: Array) -> Array:
    """Returns vertices (n, 3) of a mesh in the world in the frame of its map, both in the axes of glTF [m]."""
    if np.array_equal(map_from_world, np.eye(4)):
        return vertices
    from twin.core import geometry
    from twin.exchange.mesh import GLB_FROM_WORLD  # imports trimesh, which only this process needs

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
    rotation = _axis_rotation(1, EAST_DEG) @ _axis_rotation(0, -DEPRESSION_DEG)
    centre = (low + high) / 2
    tangents = np.tan(np.deg2rad(VFOV_DEG) / 2) * np.array([WIDTH_PX / HEIGHT_PX, 1.0])
    points = (framed - centre) @ rotation
    distance = MARGIN * float((points[:, 2:] + np.abs(points[:, :2]) / tangents).max())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre + distance * rotation[:, 2]
    return pose


def _axis_rotation(axis: int, angle_deg: float) -> Array:
    return np.asarray(cv2.Rodrigues(np.deg2rad(angle_deg) * np.eye(3)[axis])[0])


def _main(mesh_file: str, picture_file: str, map_from_world: str) -> None:
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")  # must be set before pyrender is imported
    import trimesh

    mesh = trimesh.load_scene(mesh_file).to_mesh()
    mesh.vertices = in_map_frame(mesh.vertices, np.array(json.loads(map_from_world)))
    picture = render_mesh(mesh)
    cv2.imwrite(picture_file, np.ascontiguousarray(picture[..., ::-1]))


if __name__ == "__main__":
    _main(*sys.argv[1:])
