"""Rendering of the floor with MuJoCo: albedo and depth in one pass; steep parts are textured afterwards, by depth."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.errors import TwinError
from twin.imaging.scene.mesh_raster import NEAR_M
from twin.imaging.scene.triplanar import paint_walls, wall_surface
from twin.scenes.builder import FLOOR_GROUP, SceneModel
from twin.scenes.gl import MjModel, MjvScene, mujoco, offscreen_context

_NEAR, _FAR = np.float32(NEAR_M), np.float32(100.0)  # depths of the clipping planes [m]


class Renderer:
    """Renderer of the floor for a pinhole camera; `close` it. One per process and thread; TwinError without OpenGL."""

    def __init__(self, scene: SceneModel, width_px: int, height_px: int, vfov_deg: float):
        self._scene_model = scene
        self._rect = mujoco.MjrRect(0, 0, width_px, height_px)
        self._tan = np.tan(np.deg2rad(vfov_deg) / 2) * np.array([width_px / height_px, 1.0])
        self._focal_px, self._walls = height_px / 2 / self._tan[1], wall_surface(scene.terrain)
        self._rgb = np.empty((height_px, width_px, 3), np.uint8)
        self._z = np.empty((height_px, width_px), np.float32)
        self._gl: Any
        self._gl, self._context = _open(scene.model, width_px, height_px)
        self._scene = _floor_scene(scene.model)
        self._set(
            frustum_near=_NEAR, frustum_far=_FAR, frustum_center=0.0, frustum_width=_NEAR * self._tan[0],
            frustum_top=_NEAR * self._tan[1], frustum_bottom=-_NEAR * self._tan[1], orthographic=0,
        )  # fmt: skip
        order = {geom: k for k, geom in enumerate(scene.tile_geom_ids)}
        geoms = [self._scene.geoms[k] for k in range(self._scene.ngeom)]
        self._tiles = sorted(geoms, key=lambda geom: order[geom.objid])
        self._meshes = [tile.dataid for tile in self._tiles]
        self._shown = np.ones(len(self._tiles), dtype=bool)

    def render(self, world_from_camera: Array) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Returns albedo (H, W, 3) uint8 RGB and depth (H, W) float32 along the optical axis [m]; inf = no floor."""
        self._gl.make_current()
        axes, position_m = world_from_camera[:3, :3], world_from_camera[:3, 3]
        self._set(pos=position_m, forward=axes[:, 2], up=-axes[:, 1])
        self._show(visible_tiles(self._scene_model, world_from_camera, self._tan))
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._z, self._rect, self._context)
        albedo, depth = self._rgb[::-1].copy(), linear_depth(self._z[::-1])  # rows run upwards
        if self._walls is not None:
            paint_walls(self._walls, albedo, depth, world_from_camera, self._focal_px)
        return albedo, depth

    def close(self) -> None:
        """Releases the OpenGL context; closing twice has no effect."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _set(self, **values: Any) -> None:
        """Sets attributes of both cameras of the scene, which MuJoCo averages."""
        for camera in self._scene.camera:
            for name, value in values.items():
                setattr(camera, name, value)

    def _show(self, visible: NDArray[np.bool_]) -> None:
        for k in np.flatnonzero(visible != self._shown):
            self._tiles[k].dataid = self._meshes[k] if visible[k] else -1
        self._shown = visible


def _open(model: MjModel, width_px: int, height_px: int) -> tuple[Any, Any]:
    try:
        gl = offscreen_context(width_px, height_px)
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except mujoco.FatalError as error:
        raise TwinError("rendering", f"OpenGL error: {error}", "OpenGL 1.5 with frame buffer objects") from error
    mujoco.mjr_resizeOffscreen(width_px, height_px, context)
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR  # 32-bit floats have the highest resolution near zero
    return gl, context


def _floor_scene(model: MjModel) -> MjvScene:
    """Returns a MuJoCo scene of the floor tiles without effects that change colours."""
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 10)
    option = mujoco.MjvOption()
    option.geomgroup[:] = 0
    option.geomgroup[FLOOR_GROUP] = 1
    option.flags[mujoco.mjtVisFlag.mjVIS_STATIC] = 1
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mjv_updateScene(model, data, option, None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_STATIC, scene)
    scene.flags[:] = 0
    scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 1
    return scene


def visible_tiles(scene: SceneModel, world_from_camera: Array, half_tangents: Array) -> NDArray[np.bool_]:
    """Returns a mask (n,) of the tiles not outside a plane of the view frustum, of half tangents (2,) across, down."""
    tx, ty = half_tangents
    inward = np.array([[1, 0, tx], [-1, 0, tx], [0, 1, ty], [0, -1, ty], [0, 0, 1.0]]) @ world_from_camera[:3, :3].T
    low, high = scene.tile_low_m - world_from_camera[:3, 3], scene.tile_high_m - world_from_camera[:3, 3]
    # per side, distance of the box corner that is farthest inward: on each axis, the end to which the normal points
    farthest = high @ np.maximum(inward, 0).T + low @ np.minimum(inward, 0).T
    return np.all(farthest >= 0, axis=1)


def linear_depth(z_buffer: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns the depth [m] from OpenGL's reversed depth buffer (1 at near, 0 at far); inf where nothing is drawn.

    With z the value in the buffer, 1 / depth = z (1/near - 1/far) + 1/far.
    """
    inverse = z_buffer * np.float32(1 / _NEAR - 1 / _FAR) + np.float32(1 / _FAR)
    return np.where(z_buffer > 0, np.reciprocal(inverse), np.float32(np.inf))
