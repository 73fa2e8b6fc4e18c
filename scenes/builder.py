"""MuJoCo model of the scene: the seafloor and a free-floating vehicle, which is a mass without a shape.

The floor is divided into textured mesh tiles so that only the tiles in view are rendered. Meshes instead of MuJoCo
height fields: a mesh is rendered twice as fast because triangles share vertices, its texture is mapped exactly by
explicit texture coordinates, and it has no side walls.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.height_field import grid_triangles
from twin.scenes.gl import MjModel, MjSpec, mujoco
from twin.terrains import Terrain

TILE_CELLS = 48  #: cells along a tile's side: a compromise between OpenGL state changes and vertices outside the view
MAX_TILES = 900  #: MuJoCo supports at most 1000 textures
MARGIN_TEXELS = 16  #: margin of each tile's texture, copied from its neighbours; enough for 4 mip-map levels
FLOOR_GROUP = 0


class SceneModel(NamedTuple):
    """Compiled MuJoCo model; its users create their own MjData.

    The free joint of its body "vehicle" is qpos[0:7] (position, quaternion wxyz) and qvel[0:6]; the n floor tiles have
    geoms, and corners (n, 3) of their bounding boxes.
    """

    model: MjModel
    terrain: Terrain
    tile_geom_ids: NDArray[np.int64]
    tile_low_m: Array
    tile_high_m: Array


def build(
    terrain: Terrain, timestep_s: float, mass_kg: float = 1.0, inertia_kgm2: Array | tuple[float, ...] = (1.0, 1.0, 1.0)
) -> SceneModel:
    """Compiles floor and vehicle into one MuJoCo model with gravity, without lights, buoyancy, drag and thrust.

    `inertia_kgm2` are the moments of inertia (3,) of the vehicle about its axes.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "seabed"
    spec.option.timestep = timestep_s
    spec.stat.extent = 1.0  # MuJoCo multiplies the clipping distances by the extent
    spec.visual.headlight.active = 0
    spec.visual.quality.offsamples = 0  # with multisampling, depth would be displaced by a fraction of a pixel
    spec.visual.quality.shadowsize = 0
    tiles = _add_floor(spec, terrain)
    body = spec.worldbody.add_body(name="vehicle")  # its origin is the centre of gravity
    body.add_freejoint(name="vehicle")
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass_kg, np.zeros(3), np.array(inertia_kgm2)
    model = spec.compile()
    ids = np.array([model.geom(name).id for name in tiles])
    low_m, high_m = (np.array([side(nodes, axis=0) for nodes in tiles.values()]) for side in (np.min, np.max))
    return SceneModel(model, terrain, ids, low_m, high_m)


def _add_floor(spec: MjSpec, terrain: Terrain) -> dict[str, NDArray[np.float64]]:
    """Adds the terrain as static, emissive tiles without contacts; returns the nodes (n, 3) [m] of each by name."""
    ny, nx = terrain.height_m.shape
    cells = tile_cells(ny - 1, nx - 1)
    rows, cols = ([slice(k, min(k + cells, n - 1) + 1) for k in range(0, n - 1, cells)] for n in (ny, nx))
    return dict(_add_tile(spec, terrain, row, col) for row in rows for col in cols)


def tile_cells(n_rows: int, n_cols: int) -> int:
    cells = TILE_CELLS
    while -(-n_rows // cells) * -(-n_cols // cells) > MAX_TILES:
        cells += 16
    return cells


def _add_tile(spec: MjSpec, terrain: Terrain, rows: slice, cols: slice) -> tuple[str, NDArray[np.float64]]:
    """Adds the tile of some rows and columns (texture, material, mesh and geom); returns its name and nodes (n, 3)."""
    name = f"floor_{rows.start}_{cols.start}"
    texture, texcoord = _tile_texture(terrain, rows, cols)
    image = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    image.height, image.width = texture.shape[:2]
    image.data = texture.tobytes()
    # Emission only: the scene has no light, so the rendered colour is the colour of the texture.
    material = spec.add_material(name=name, emission=1.0, specular=0.0, shininess=0.0, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    vertices = _vertices(terrain, rows, cols)
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.usertexcoord = vertices.ravel(), texcoord.ravel()
    node = np.arange(len(vertices), dtype=np.int32).reshape(rows.stop - rows.start, -1)
    mesh.userface = grid_triangles(node).ravel()
    mesh.usernormal = np.tile([0.0, 0.0, 1.0], len(vertices))  # unlit; with equal normals the driver shares vertices
    shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name, "material": name, "group": FLOOR_GROUP}
    spec.worldbody.add_geom(name=name, contype=0, conaffinity=0, **shape)
    return name, vertices


def _vertices(terrain: Terrain, rows: slice, cols: slice) -> NDArray[np.float64]:
    x_m = terrain.west_m + terrain.spacing_m * np.arange(cols.start, cols.stop)
    y_m = terrain.south_m + terrain.spacing_m * np.arange(rows.start, rows.stop)
    nodes = np.stack([*np.meshgrid(x_m, y_m), terrain.height_m[rows, cols]], axis=-1)
    return nodes.reshape(-1, 3).astype(np.float64)


def _tile_texture(terrain: Terrain, rows: slice, cols: slice) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Returns the texture of a tile with margins, and the texture coordinates of its nodes.

    Margins repeat the texture around the tile and end at multiples of MARGIN_TEXELS: mip-map levels show no seam.
    """
    ny, nx = terrain.height_m.shape
    h, w = terrain.texture.shape[:2]
    across = np.arange(cols.start, cols.stop) * (w / (nx - 1))
    down = (ny - 1 - np.arange(rows.start, rows.stop)) * (h / (ny - 1))  # texture rows run south
    left, right = _aligned(across[0], across[-1])
    top, bottom = _aligned(down[-1], down[0])
    inner = terrain.texture[max(top, 0) : min(bottom, h), max(left, 0) : min(right, w)]
    borders = (max(-top, 0), max(bottom - h, 0), max(-left, 0), max(right - w, 0))
    texture = cv2.copyMakeBorder(inner, *borders, cv2.BORDER_REPLICATE) if any(borders) else inner
    u, v = np.meshgrid((across - left) / (right - left), (down - top) / (bottom - top))
    return np.ascontiguousarray(texture, dtype=np.uint8), np.stack([u, v], axis=-1).reshape(-1, 2)


def _aligned(low: float, high: float) -> tuple[int, int]:
    """Returns the interval [low, high] rounded outwards to multiples of MARGIN_TEXELS, plus one margin on each side."""
    step = MARGIN_TEXELS
    return int(np.floor(low / step) - 1) * step, int(np.ceil(high / step) + 1) * step
