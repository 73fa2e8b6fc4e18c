"""A floor as a MuJoCo mesh: rays and images of MuJoCo, as oracles of the renderer."""

from __future__ import annotations

import ctypes
import os
from typing import Any

import numpy as np

from twin.core.height_field import grid_triangles
from twin.scenes.gl import MjModel, mujoco
from twin.terrains import Terrain

NEAR_M, FAR_M = 0.05, 100.0


def floor_model(terrain: Terrain) -> MjModel:
    """Returns a MuJoCo model of a floor: one static mesh with its texture, which emits its colours."""
    spec = mujoco.MjSpec()
    spec.stat.extent = 1.0  # MuJoCo multiplies the clipping distances by the extent
    spec.visual.headlight.active = 0
    spec.visual.quality.offsamples = 0  # with multisampling, depth would be displaced by a fraction of a pixel
    ny, nx = terrain.height_m.shape
    x, y = np.meshgrid(np.arange(nx), np.arange(ny))
    nodes = [terrain.west_m + terrain.spacing_m * x, terrain.south_m + terrain.spacing_m * y, terrain.height_m]
    image = spec.add_texture(name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    image.height, image.width = terrain.texture.shape[:2]
    image.data = terrain.texture.tobytes()
    material = spec.add_material(name="floor", emission=1.0, specular=0.0, shininess=0.0, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    mesh = spec.add_mesh(name="floor", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = np.stack(nodes, axis=-1).astype(np.float64).ravel()
    mesh.usertexcoord = np.stack([x / (nx - 1), 1 - y / (ny - 1)], axis=-1).ravel()
    mesh.userface = grid_triangles(np.arange(ny * nx, dtype=np.int32).reshape(ny, nx)).ravel()
    mesh.usernormal = np.tile([0.0, 0.0, 1.0], ny * nx)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="floor", material="floor")
    return spec.compile()


def ray_lengths(model: MjModel, start: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Returns the t (n,) at which the rays start + t along, along (n, 3), meet the model; inf if they do not."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = np.zeros(1, np.int32)
    t = np.array([mujoco.mj_ray(model, data, start, ray, None, 1, -1, geom, None) for ray in along])
    return np.where(t < 0, np.inf, t)


def image(model: MjModel, shape: tuple[int, int], focal_px: float, world_from_camera: np.ndarray) -> np.ndarray:
    """Returns the image (H, W, 3) that MuJoCo renders with OpenGL, without effects that change colours."""
    height, width = shape
    gl: Any = _context(width, height)
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_resizeOffscreen(width, height, context)
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    scene, data, option = mujoco.MjvScene(model, maxgeom=10), mujoco.MjData(model), mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_STATIC] = 1
    mujoco.mj_kinematics(model, data)
    mujoco.mjv_updateScene(model, data, option, None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_STATIC, scene)
    scene.flags[:] = 0
    scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 1
    top = NEAR_M * height / 2 / focal_px
    for camera in scene.camera:  # MuJoCo averages both
        camera.frustum_near, camera.frustum_far, camera.frustum_center = NEAR_M, FAR_M, 0.0
        camera.frustum_width, camera.frustum_top, camera.frustum_bottom = top * width / height, top, -top
        camera.pos, camera.orthographic = world_from_camera[:3, 3], 0
        camera.forward, camera.up = world_from_camera[:3, 2], -world_from_camera[:3, 1]
    colours, rectangle = np.empty((height, width, 3), np.uint8), mujoco.MjrRect(0, 0, width, height)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    mujoco.mjr_render(rectangle, scene, context)
    mujoco.mjr_readPixels(colours, None, rectangle, context)
    context.free()
    gl.free()
    return colours[::-1]


def _context(width: int, height: int) -> Any:
    """Returns a current OpenGL context. PyOpenGL 3.1.0, which pyrender pins, lacks EGLDeviceEXT, an opaque pointer."""
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    from OpenGL import EGL

    if not hasattr(EGL, "EGLDeviceEXT"):
        EGL.EGLDeviceEXT = ctypes.c_void_p
    from mujoco.egl import GLContext

    context = GLContext(width, height)
    context.make_current()
    return context
