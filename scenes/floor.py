"""Seafloor in a MuJoCo model, divided into textured mesh tiles so that only the tiles in view are rendered.

The tiles are meshes instead of MuJoCo height fields: a mesh is rendered twice as fast because triangles share vertices,
its texture is mapped exactly by explicit texture coordinates, and it has no side walls.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.height_field import grid_triangles
from twin.scenes.gl import MjSpec, mujoco
from twin.terrains import Terrain

TILE_CELLS = 48  #: cells along a tile's side: a compromise between OpenGL state changes and vertices outside the view
MAX_TILES = 900  #: MuJoCo supports at most 1000 textures
MARGIN_TEXELS = 16  #: margin of each tile's texture, copied from its neighbours; enough for 4 mip-map levels
FLOOR_GROUP = 0


class Tile(NamedTuple):
    """One tile of the floor: geom name, minimum and maximum corner (3,) of its bounding box in the world [m]."""

    name: str
    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]


def add_floor(spec: MjSpec, terrain: Terrain) -> list[Tile]:
    """Adds the terrain to the model as static, emissive tiles without contacts; returns the tiles."""
    ny, nx = terrain.height_m.shape
    cells = tile_cells(ny - 1, nx - 1)
    rows, cols = ([slice(k, min(k + cells, n - 1) + 1) for k in range(0, n - 1, cells)] for n in (ny, nx))
    return [_add_tile(spec, terrain, row, col) for row in rows for col in cols]


def tile_cells(n_rows: int, n_cols: int) -> int:
    """Returns the number of cells along a tile's side: TILE_CELLS, or more to stay within MAX_TILES tiles."""
    cells = TILE_CELLS
    while -(-n_rows // cells) * -(-n_cols // cells) > MAX_TILES:
        cells += 16
    return cells


def _add_tile(spec: MjSpec, terrain: Terrain, rows: slice, cols: slice) -> Tile:
    """Adds the tile of the given grid rows and columns (texture, material, mesh and geom), and returns it."""
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
    return Tile(name, vertices.min(axis=0), vertices.max(axis=0))


def _vertices(terrain: Terrain, rows: slice, cols: slice) -> NDArray[np.float64]:
    """Returns the nodes (n, 3) of a tile [m], row by row."""
    x_m = terrain.west_m + terrain.spacing_m * np.arange(cols.start, cols.stop)
    y_m = terrain.south_m + terrain.spacing_m * np.arange(rows.start, rows.stop)
    nodes = np.stack([*np.meshgrid(x_m, y_m), terrain.height_m[rows, cols]], axis=-1)
    return nodes.reshape(-1, 3).astype(np.float64)


def _tile_texture(terrain: Terrain, rows: slice, cols: slice) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Returns the texture of a tile with margins, and the texture coordinates of its nodes.

    The margins repeat the texture of the neighbouring tiles or, beyond the terrain, the texels of its edge, and start
    and end at multiples of MARGIN_TEXELS, which aligns the mip-map levels of adjacent tiles: no seam is visible.
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
