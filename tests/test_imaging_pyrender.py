"""Depth of the renderer against pyrender, for the same triangles and poses."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import terrains
from scenes.builder import CameraPair, build
from terrains import TextureSource
from twin.core import geometry
from twin.imaging.renderer import Renderer

W, H, VFOV = 160, 120, 45.0
#: Runs in a separate process, as pyrender closes the display of MuJoCo. Without multisampling, which biases the depth.
PYRENDER = """
import sys
import pyglet
pyglet.options["headless"] = True
import numpy as np, pyrender, pyrender.renderer as inner, trimesh
several = inner.glRenderbufferStorageMultisample
inner.glRenderbufferStorageMultisample = lambda target, samples, *rest: several(target, 0, *rest)
given = np.load(sys.argv[1])
height, width = given["shape"]
scene = pyrender.Scene()
scene.add(pyrender.Mesh.from_trimesh(trimesh.Trimesh(given["vertices"], given["faces"], process=False)))
camera = scene.add(pyrender.PerspectiveCamera(float(given["vfov_rad"]), znear=0.05, zfar=100.0))
renderer = pyrender.OffscreenRenderer(int(width), int(height))
depths = []
for pose in given["poses"]:
    scene.set_pose(camera, pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
    depths.append(renderer.render(scene, pyrender.RenderFlags.DEPTH_ONLY))
np.save(sys.argv[2], depths)
"""


def triangles(terrain: terrains.Terrain) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices (n, 3) and faces (m, 3) of a height grid, each cell split along (r, c)-(r + 1, c + 1)."""
    rows, cols = terrain.height_m.shape
    x, y = np.meshgrid(np.arange(cols), np.arange(rows))
    vertices = np.stack(
        [terrain.west_m + terrain.spacing_m * x, terrain.south_m + terrain.spacing_m * y, terrain.height_m], axis=-1
    )
    node = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = (part.ravel() for part in (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]))
    return vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def pyrender_depths(terrain: terrains.Terrain, poses: np.ndarray, folder: Path) -> np.ndarray:
    """Returns the depth images (n, H, W) [m] that pyrender renders from n poses; 0 where there is no floor."""
    vertices, faces = triangles(terrain)
    inputs, outputs = folder / "given.npz", folder / "depth.npy"
    np.savez(inputs, vertices=vertices, faces=faces, poses=poses, shape=(H, W), vfov_rad=np.deg2rad(VFOV))
    command = [sys.executable, "-c", PYRENDER, str(inputs), str(outputs)]
    done = subprocess.run(
        command, env=os.environ | {"PYOPENGL_PLATFORM": "egl"}, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return np.load(outputs)


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    seen_from = [((0, 0, 0), (0.2, 0.1, 2.2)), ((0.1, -0.15, 2.0), (-1.3, 0.4, 1.9)), ((-0.3, 0.2, -1), (1, -1, 2.4))]
    return np.array(
        [
            geometry.pose(geometry.rotation_from_rpy(*rpy) @ geometry.BODY_FROM_DOWN_CAMERA, np.array(position))
            for rpy, position in seen_from
        ]
    )


def test_depth_agrees_with_pyrender(poses: np.ndarray, tmp_path: Path) -> None:
    terrain = terrains.generate("reef", (7.0, 5.0), 0.5, 0.1, 0.04, TextureSource(0.02), 5)
    world = build(
        terrain, CameraPair(W, H, VFOV, 0.2, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3))), 0.01
    )
    with Renderer(world, W, H, VFOV) as renderer:
        ours = np.array([renderer.render(pose)[1] for pose in poses])
    theirs = pyrender_depths(terrain, poses, tmp_path)
    inside = np.isfinite(ours)
    assert ((theirs > 0) != inside).mean() < 1e-3  # pixels on the edge of the floor
    error_m = np.abs(ours - theirs)[inside & (theirs > 0)]
    # the resolution of pyrender's 24-bit depth between 0.05 and 100 m is z^2 / near / 2^24 = 8 um at 2.5 m
    assert len(error_m) > 0.5 * ours.size and np.median(error_m) < 1e-5 and np.percentile(error_m, 98) < 1e-4
