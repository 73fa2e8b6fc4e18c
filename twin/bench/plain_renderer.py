"""Plain rendering of a floor by `mujoco.Renderer`: one textured mesh, without light and water."""

from contextlib import AbstractContextManager

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import grid_triangles
from twin.core.records import Image, StereoRig
from twin.scenes.gl import draw_with_egl, mujoco
from twin.terrains import Terrain

_TO_MUJOCO_AXES = np.diag([1.0, -1.0, -1.0])  # MuJoCo's cameras have y up and look along -z


class PlainRenderer(AbstractContextManager["PlainRenderer"]):
    """Renderer for the images of a pinhole camera; a context manager, which frees OpenGL."""

    def __init__(self, terrain: Terrain, rig: StereoRig):
        spec = mujoco.MjSpec()
        spec.stat.extent = 1.0  # MuJoCo multiplies the clipping distances by the extent
        spec.visual.quality.offsamples, spec.visual.headlight.active = 0, 0
        spec.visual.global_.offwidth, spec.visual.global_.offheight = rig.width_px, rig.height_px
        image = spec.add_texture(name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
        (image.height, image.width), image.data = terrain.texture.shape[:2], terrain.texture.tobytes()
        material = spec.add_material(name="floor", emission=1.0, specular=0.0, shininess=0.0)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
        ny, nx = terrain.height_m.shape
        u, v = np.meshgrid(np.linspace(0, 1, nx), np.linspace(0, 1, ny))
        x, y = terrain.west_m + u * terrain.size_m[0], terrain.south_m + v * terrain.size_m[1]
        mesh = spec.add_mesh(name="floor", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        mesh.uservert, mesh.usertexcoord = (
            np.stack(part, -1).ravel() for part in ((x, y, terrain.height_m), (u, 1 - v))
        )
        mesh.userface = grid_triangles(np.arange(nx * ny, dtype=np.int32).reshape(ny, nx)).ravel()
        mesh.usernormal = np.tile([0.0, 0.0, 1.0], nx * ny)  # unlit
        shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": "floor", "material": "floor"}
        spec.worldbody.add_geom(contype=0, conaffinity=0, **shape)
        camera = spec.worldbody.add_body(name="camera", mocap=True)
        camera.add_camera(name="camera", fovy=float(np.rad2deg(2 * np.arctan(rig.height_px / 2 / rig.focal_px))))
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        draw_with_egl()
        self._renderer = mujoco.Renderer(self._model, rig.height_px, rig.width_px)

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def render(self, world_from_camera: Array) -> Image:
        """Returns the RGB image (height, width, 3) of a camera with this pose (4, 4)."""
        self._data.mocap_pos[0] = world_from_camera[:3, 3]
        self._data.mocap_quat[0] = geometry.quaternion_wxyz(world_from_camera[:3, :3] @ _TO_MUJOCO_AXES)
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, "camera")
        return self._renderer.render()
