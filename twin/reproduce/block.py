"""Floor of the turbidity experiment: a hollow concrete block on rippled sand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.terrains import Terrain
from twin.terrains.noise import fractal_field

Array = NDArray[np.float64]

SIZE_M, SPACING_M, TEXEL_M = (2.4, 2.0), 0.005, 0.002
BLOCK_M, HEIGHT_M = (0.39, 0.19), 0.14  # a standard block, partly buried
CORE_M, CORE_CENTRES_M = (0.13, 0.12), (-0.0875, 0.0875)
HEADING_DEG = 25.0
SAND, CONCRETE = (0.36, 0.31, 0.23), (0.45, 0.44, 0.42)  # albedo


def block_on_sand(seed: int) -> Terrain:
    """Returns a terrain with the block at its centre, which is the origin; the mean height of the sand is about 0.

    Args:
        seed: seed of the sand relief, the roughness of the block and the noise of the texture.
    """
    rng = np.random.default_rng(seed)
    x, y = _grid(SPACING_M, edges=True)
    ripples = 0.012 * np.sin(2 * np.pi * (x + 0.15 * np.sin(2.1 * y) + 0.04 * np.sin(5.3 * y)) / 0.16)
    sand = ripples + 0.004 * fractal_field(x.shape, 120, 0.5, rng)
    height = np.where(_inside(x, y), HEIGHT_M + 0.001 * fractal_field(x.shape, 8, 0.6, rng), sand)
    x, y = _grid(TEXEL_M, edges=False)
    grain = 1 + 0.2 * fractal_field(x.shape, 16, 0.85, rng)
    albedo = np.where(_inside(x, y)[..., None], CONCRETE, SAND) * grain[..., None]
    texture = np.clip(255 * albedo[::-1] + 0.5, 0, 255).astype(np.uint8)
    west, south = (-side / 2 for side in SIZE_M)
    return Terrain(height.astype(np.float32), SPACING_M, west, south, texture, TEXEL_M)


def _grid(step_m: float, edges: bool) -> tuple[Array, Array]:
    """Returns the x and y coordinates of a grid, with rows from south to north.

    Args:
        step_m: grid spacing.
        edges: True for the grid nodes, including those on the terrain edges; False for the cell centres.
    """
    axes = [np.arange(round(size / step_m) + edges) * step_m - size / 2 for size in SIZE_M]
    east, north = (axis if edges else axis + step_m / 2 for axis in axes)
    x, y = np.meshgrid(east, north)
    return np.asarray(x, np.float64), np.asarray(y, np.float64)


def _inside(x: Array, y: Array) -> NDArray[np.bool_]:
    """Returns a mask of the points on the block, excluding its hollow cores."""
    heading = np.deg2rad(HEADING_DEG)
    along, across = x * np.cos(heading) + y * np.sin(heading), y * np.cos(heading) - x * np.sin(heading)
    block = (np.abs(along) < BLOCK_M[0] / 2) & (np.abs(across) < BLOCK_M[1] / 2)
    for centre in CORE_CENTRES_M:
        block &= ~((np.abs(along - centre) < CORE_M[0] / 2) & (np.abs(across) < CORE_M[1] / 2))
    return block
