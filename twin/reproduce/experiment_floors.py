"""Floors of the experiments: a hollow concrete block on rippled sand, and objects on the floor of a tank.

The lamps above the tank do not move with the cameras. Floor and objects are matt, and the water is clear, so the light
that reaches the cameras is proportional to albedo times illuminance. The texture is this product; the even daylight of
the scenario then yields the images of the unevenly lit tank.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.terrains import Terrain
from twin.terrains.noise import fractal_field

Array = NDArray[np.floating]

SAND_M, SAND_SPACING_M = (2.4, 2.0), 0.005  # size of the sand, spacing of its heights
TANK_M, TANK_SPACING_M = (2.7, 2.7), 0.003
TEXEL_M = 0.002
BLOCK_M, HEIGHT_M = (0.39, 0.19), 0.14  # a standard block, partly buried
CORE_M, CORE_CENTRES_M = (0.13, 0.12), (-0.0875, 0.0875)
HEADING_DEG = 25.0
SAND, CONCRETE = (0.36, 0.31, 0.23), (0.45, 0.44, 0.42)  # albedo
FLOOR, GRAIN, SHADE = 0.36, 0.28, 0.45  # albedo, its relative standard deviation, illuminance in the shade
SPOT_M, SPOT_RADIUS_M = (0.28, 0.12), 0.55  # centre and radius (1/e) of the brightest light
SHADE_EDGE_M, SHADE_WIDTH_M = -0.33, 0.06  # x of the soft edge of the shade, and half the width of this edge


def _nodes(size_m: tuple[float, float], step_m: float) -> tuple[Array, ...]:
    """Returns x and y (rows, cols) [m] of the nodes of a grid around the origin, from south to north."""
    return tuple(np.meshgrid(*(np.arange(round(size / step_m) + 1) * step_m - size / 2 for size in size_m)))


def _texels(size_m: tuple[float, float]) -> tuple[Array, ...]:
    """Returns x and y (rows, cols) [m] of the centres of the texels, from south to north."""
    return tuple(np.meshgrid(*(np.arange(round(side / TEXEL_M)) * TEXEL_M - side / 2 + TEXEL_M / 2 for side in size_m)))


def _terrain(height_m: Array, spacing_m: float, size_m: tuple[float, float], albedo: NDArray[np.floating]) -> Terrain:
    """Returns a terrain around the origin; rows of heights and albedo from south to north."""
    texture = np.clip(255 * albedo[::-1] + 0.5, 0, 255).astype(np.uint8)
    west, south = (-side / 2 for side in size_m)
    return Terrain(height_m.astype(np.float32), spacing_m, west, south, texture, TEXEL_M)


def block_on_sand(seed: int) -> Terrain:
    """Returns a terrain with the block at its centre, the origin; the mean height of the sand is about 0."""
    rng = np.random.default_rng(seed)
    x, y = _nodes(SAND_M, SAND_SPACING_M)
    ripples = 0.012 * np.sin(2 * np.pi * (x + 0.15 * np.sin(2.1 * y) + 0.04 * np.sin(5.3 * y)) / 0.16)
    sand = ripples + 0.004 * fractal_field(x.shape, 120, 0.5, rng)
    height = np.where(_on_block(x, y), HEIGHT_M + 0.001 * fractal_field(x.shape, 8, 0.6, rng), sand)
    x, y = _texels(SAND_M)
    grain = 1 + 0.2 * fractal_field(x.shape, 16, 0.85, rng)
    albedo = np.where(_on_block(x, y)[..., None], CONCRETE, SAND) * grain[..., None]
    return _terrain(height, SAND_SPACING_M, SAND_M, albedo)


def _on_block(x: Array, y: Array) -> NDArray[np.bool_]:
    """Returns whether points are on the block, but not in its hollow cores."""
    heading = np.deg2rad(HEADING_DEG)
    along, across = x * np.cos(heading) + y * np.sin(heading), y * np.cos(heading) - x * np.sin(heading)
    block = (np.abs(along) < BLOCK_M[0] / 2) & (np.abs(across) < BLOCK_M[1] / 2)
    for centre in CORE_CENTRES_M:
        block &= ~((np.abs(along - centre) < CORE_M[0] / 2) & (np.abs(across) < CORE_M[1] / 2))
    return block


class TankObject(NamedTuple):
    """An object on the floor of the tank, with its sides parallel to x and y."""

    name: str
    shape: Literal["box", "disc", "dome", "pipe"]  #: disc: upright cylinder; dome: half an ellipsoid; pipe: lying
    centre_m: tuple[float, float]  #: (x, y) of the centre, in the middle between nodes of the height grid
    #: extent along x and y, and height; the extents are even multiples of `TANK_SPACING_M`, so that the sides lie in
    #: the middle between nodes, where the interpolated surface has half of the height.
    size_m: tuple[float, float, float]
    albedo: float  #: mean albedo of its surface
    grain: float = GRAIN  #: relative standard deviation of the albedo

    def height_at(self, x: Array, y: Array) -> Array:
        """Returns the height of the object's upper surface above the floor at points [m]; 0 outside the object."""
        u, v = ((value - c) / (side / 2) for value, c, side in zip((x, y), self.centre_m, self.size_m, strict=False))
        top = self.size_m[2]
        if self.shape == "box":
            return np.where((np.abs(u) < 1) & (np.abs(v) < 1), top, 0.0)
        if self.shape == "disc":
            return np.where(u**2 + v**2 < 1, top, 0.0)
        if self.shape == "dome":
            return top * np.sqrt(np.maximum(1 - u**2 - v**2, 0.0))
        return np.where((np.abs(u) < 1) & (np.abs(v) < 1), top / 2 * (1 + np.sqrt(np.maximum(1 - v**2, 0.0))), 0.0)


#: Objects of the experiments: 1.4 to 6 inches, and a pipe of 2.4 inches, white, with little texture, in the light.
OBJECTS = (
    TankObject("brick", "box", (-0.1485, -0.2385), (0.150, 0.090, 0.060), 0.42),
    TankObject("crate", "box", (0.5115, -0.2985), (0.120, 0.120, 0.090), 0.35),
    TankObject("slab", "box", (-0.5685, 0.1515), (0.120, 0.150, 0.036), 0.5),
    TankObject("can", "disc", (-0.0885, 0.3615), (0.102, 0.102, 0.075), 0.4),
    TankObject("stone", "dome", (-0.5385, -0.2985), (0.150, 0.120, 0.060), 0.3),
    TankObject("PVC pipe", "pipe", (0.3015, 0.1215), (0.480, 0.060, 0.060), 0.92, 0.01),
)


def tank_floor(seed: int, objects: Sequence[TankObject] = OBJECTS) -> Terrain:
    """Returns the floor of the tank with its centre at the origin and z = 0 on the level floor."""
    rng = np.random.default_rng(seed)
    x, y = _nodes(TANK_M, TANK_SPACING_M)
    height = np.max([item.height_at(x, y) for item in objects], axis=0, initial=0.0)
    x, y = _texels(TANK_M)
    noise = fractal_field(x.shape, 24, 0.85, rng)
    albedo = FLOOR * (1 + GRAIN * noise)
    for item in objects:
        albedo = np.where(item.height_at(x, y) > 0, item.albedo * (1 + item.grain * noise), albedo)
    spot = np.exp(-((x - SPOT_M[0]) ** 2 + (y - SPOT_M[1]) ** 2) / SPOT_RADIUS_M**2)
    lit = 0.5 + 0.5 * np.tanh((x - SHADE_EDGE_M) / SHADE_WIDTH_M)
    illuminance = (0.55 + 0.45 * spot) * (SHADE + (1 - SHADE) * lit)  # relative to its largest value
    return _terrain(height, TANK_SPACING_M, TANK_M, np.repeat((albedo * illuminance)[..., None], 3, 2))
