"""The mapped surface as a picture: mesh.glb from an eye above it, drawn by pyrender.

pyrender takes MuJoCo's display down with its own, and a broken driver the whole process. So this module is a program
too: `surface_picture` starts it, and does without a picture where it fails.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from twin.core.records import Array, Image
from twin.report.images import read_rgb

#: A surface that takes longer is left out of the report.
LIMIT_S = 15.0
WIDTH_PX, HEIGHT_PX, VFOV_DEG = 1400, 900, 30.0
#: The eye looks down by so much, from the south and a little from the east.
DOWN_DEG, EAST_DEG = 42.0, 20.0
MARGIN = 1.04
#: Vertices beyond these percentiles may leave the picture: a single wild height must not shrink all others.
FRAMED_PERCENT = (0.2, 99.8)
#: Direction to the light in GLB's axes (east, up, south): the north-west, as in all maps of the report.
LIGHT = np.array([-0.5, 0.7, -0.5])
WHITE = (1.0, 1.0, 1.0, 0.0)


def surface_picture(mesh_file: Path) -> Image | None:
    """The mesh seen obliquely from the south, (h, w, 3) RGB; None where there is no mesh or nothing draws it."""
    if not mesh_file.is_file():
        return None
    try:
        with tempfile.TemporaryDirectory() as folder:
            picture = Path(folder) / "surface.png"
            command = [sys.executable, "-m", __name__, str(mesh_file), str(picture)]
            subprocess.run(command, capture_output=True, timeout=LIMIT_S, check=True)
            return read_rgb(picture)
    except (OSError, subprocess.SubprocessError):
        return None


def draw(mesh: Any) -> Image:
    """A coloured trimesh in GLB's axes (y up) on white, lit from the north-west, cropped to what is drawn."""
    import pyglet

    pyglet.options["headless"] = True  # pyrender opens pyglet's windows at import: a bare machine has no X libraries
    import pyrender

    scene = pyrender.Scene(bg_color=WHITE)
    mesh.visual.vertex_colors = lit(mesh.visual.vertex_colors[:, :3], mesh.vertex_normals)
    scene.add(pyrender.Mesh.from_trimesh(mesh))
    camera = pyrender.PerspectiveCamera(np.deg2rad(VFOV_DEG), aspectRatio=WIDTH_PX / HEIGHT_PX)
    scene.add(camera, pose=eye(mesh.vertices))
    renderer = pyrender.OffscreenRenderer(WIDTH_PX, HEIGHT_PX)
    flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES
    drawn: Any = renderer.render(scene, flags)
    renderer.delete()
    picture, depth = drawn
    rows, cols = np.nonzero(depth)
    return picture[rows.min() : rows.max() + 1, cols.min() : cols.max() + 1]


def lit(colours: Image, normals: Array) -> Image:
    """Vertex colours (n, 3) shaded by Lambert's cosine, with enough even light to keep the mosaic's colours."""
    cosine = np.clip(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    return np.clip(colours * (0.7 + 0.7 * cosine[:, None]), 0, 255).astype(np.uint8)


def eye(vertices: Array) -> Array:
    """(4, 4) pose of an OpenGL camera (looks along -z) that sees all framed vertices (n, 3), as near as can be.

    A point q of the camera's axes at distance d lies inside a half-tangent t where |q_x| <= t (d - q_z).
    """
    low, high = np.percentile(vertices, FRAMED_PERCENT, axis=0)
    corners = np.clip(vertices, low, high)
    rotation = _turn(1, EAST_DEG) @ _turn(0, -DOWN_DEG)
    centre = (low + high) / 2
    tangents = np.tan(np.deg2rad(VFOV_DEG) / 2) * np.array([WIDTH_PX / HEIGHT_PX, 1.0])
    seen = (corners - centre) @ rotation
    away = MARGIN * float((seen[:, 2:] + np.abs(seen[:, :2]) / tangents).max())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre + away * rotation[:, 2]
    return pose


def _turn(axis: int, angle_deg: float) -> Array:
    return np.asarray(cv2.Rodrigues(np.deg2rad(angle_deg) * np.eye(3)[axis])[0])


def _main(mesh_file: str, picture_file: str) -> None:
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")  # before pyrender is imported
    import trimesh

    picture = draw(trimesh.load_scene(mesh_file).to_mesh())
    cv2.imwrite(picture_file, np.ascontiguousarray(picture[..., ::-1]))


if __name__ == "__main__":
    _main(*sys.argv[1:])
