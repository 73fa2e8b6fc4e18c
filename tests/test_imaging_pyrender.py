"""Depth of floor and objects in the images against pyrender, for the same triangles and poses."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from twin import terrains
from twin.core import geometry
from twin.core.records import StereoRig
from twin.imaging.scene import object_view
from twin.imaging.scene.object_view import Objects, draw_over_floor
from twin.imaging.scene.renderer import Renderer
from twin.terrains import TextureSource
from twin.terrains.objects.placed_object import PlacedObject, model_of
from twin.terrains.objects.shapes import build_shape

W, H, VFOV = 160, 120, 45.0
#: Runs in a separate process, as pyrender closes other OpenGL displays. Without multisampling, which biases the depth.
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
    depths.append(renderer.render(scene, pyrender.RenderFlags.DEPTH_ONLY | pyrender.RenderFlags.SKIP_CULL_FACES))
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


def pyrender_depths(vertices: np.ndarray, faces: np.ndarray, poses: np.ndarray, folder: Path) -> np.ndarray:
    """Returns the depth images (n, H, W) [m] that pyrender renders from n poses; 0 where there is nothing."""
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
    renderer = Renderer(terrain, W, H, H / 2 / float(np.tan(np.deg2rad(VFOV / 2))))
    ours = np.array([renderer.render(pose)[1] for pose in poses])
    theirs = pyrender_depths(*triangles(terrain), poses, tmp_path)
    inside = np.isfinite(ours)
    assert ((theirs > 0) != inside).mean() < 1e-3  # pixels on the edge of the floor
    error_m = np.abs(ours - theirs)[inside & (theirs > 0)]
    # the resolution of pyrender's 24-bit depth between 0.05 and 100 m is z^2 / near / 2^24 = 8 um at 2.5 m
    assert len(error_m) > 0.5 * ours.size and np.median(error_m) < 1e-5 and np.percentile(error_m, 98) < 1e-4


@pytest.mark.long
def test_depth_of_objects_agrees_with_pyrender(poses: np.ndarray, tmp_path: Path, monkeypatch) -> None:
    """Within 1 mm at 99.9 % of the pixels; the others are silhouettes, as OpenGL rounds vertices to 1/256 pixel."""
    monkeypatch.setattr(object_view, "LEVEL_PX", 0.0)  # the full meshes
    rng = np.random.default_rng(3)
    items = []
    for k, name in enumerate(("boulder", "brain_coral", "table_coral", "sponge", "sea_star", "pipe")):
        pose = np.diag([0.6, 0.6, 0.6, 1.0])
        pose[:3, 3] = 0.7 * (k % 3) - 0.7, 0.7 * (k // 3) - 0.35, 0.1
        items.append(PlacedObject(model_of(build_shape(name, None, rng)), pose, 0.6, k))
    meshes = [item.model.levels[0].mesh for item in items]
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    vertices = [geometry.transform(item.world_from_object, item.model.levels[0].mesh.vertices_m) for item in items]
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    focal_px = H / 2 / np.tan(np.deg2rad(VFOV / 2))
    objects, rig = Objects(items), StereoRig(W, H, focal_px, 0.15, 30.0, np.eye(4))
    ours = np.full((len(poses), H, W), np.inf, np.float32)
    for depth, pose in zip(ours, poses, strict=True):
        draw_over_floor(objects, rig, np.zeros((H, W, 3), np.uint8), depth, pose, 0.0)
    theirs = pyrender_depths(np.concatenate(vertices), np.concatenate(faces), poses, tmp_path)
    theirs[theirs == 0] = np.inf
    assert np.isfinite(theirs).mean() > 0.1
    with np.errstate(invalid="ignore"):
        same = (np.isinf(ours) & np.isinf(theirs)) | (np.abs(ours - theirs) < 1e-3)
    assert same.mean() >= 0.999
