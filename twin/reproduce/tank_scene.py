"""Floor of the tank experiments: objects of a few inches and a PVC pipe on a level floor, in uneven light.

The lamps above the tank do not move with the cameras. Floor and objects are matt, and the water is clear, so the light
that reaches the cameras is proportional to albedo times illuminance. The texture is this product; the even daylight of
the scenario then yields the images of the unevenly lit tank.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.terrains import Terrain
from twin.terrains.noise import fractal_field

Array = NDArray[np.float64]

SIZE_M, SPACING_M, TEXEL_M = (2.7, 2.7), 0.003, 0.002
FLOOR, GRAIN, SHADE = 0.36, 0.28, 0.45  # albedo, its relative standard deviation, illuminance in the shade
SPOT_M, SPOT_RADIUS_M = (0.28, 0.12), 0.55  # centre and radius (1/e) of the brightest light
SHADE_EDGE_M, SHADE_WIDTH_M = -0.33, 0.06  # x of the soft edge of the shade, and half the width of this edge


class TankObject(NamedTuple):
    """An object on the floor of the tank, with its sides parallel to x and y.

    Args:
        name: name in the tables.
        shape: "box", "disc" (an upright cylinder), "dome" (half an ellipsoid) or "pipe" (a lying cylinder).
        centre_m: (x, y) of the centre, in the middle between nodes of the height grid.
        size_m: extent along x and y, and height; the extents are even multiples of `SPACING_M`, so that the sides lie
            in the middle between nodes, where the interpolated surface has half of the height.
        albedo: mean albedo of its surface.
        grain: relative standard deviation of the albedo.
    """

    name: str
    shape: Literal["box", "disc", "dome", "pipe"]
    centre_m: tuple[float, float]
    size_m: tuple[float, float, float]
    albedo: float
    grain: float = GRAIN

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
    """Returns the floor of the tank with its centre at the origin and z = 0 on the level floor.

    Args:
        seed: seed of the texture.
        objects: the objects on the floor.
    """
    rng = np.random.default_rng(seed)
    x, y = _grid(SPACING_M, edges=True)
    height = np.max([item.height_at(x, y) for item in objects], axis=0, initial=0.0)
    x, y = _grid(TEXEL_M, edges=False)
    noise = fractal_field(x.shape, 24, 0.85, rng)
    albedo = FLOOR * (1 + GRAIN * noise)
    for item in objects:
        albedo = np.where(item.height_at(x, y) > 0, item.albedo * (1 + item.grain * noise), albedo)
    texture = np.clip(255 * (albedo * illuminance_at(x, y))[::-1] + 0.5, 0, 255).astype(np.uint8)
    west, south = (-side / 2 for side in SIZE_M)
    return Terrain(height.astype(np.float32), SPACING_M, west, south, np.repeat(texture[..., None], 3, 2), TEXEL_M)


def illuminance_at(x: Array, y: Array) -> Array:
    """Returns the illuminance of the floor relative to its largest value; it has a spot and a soft-edged shadow."""
    spot = np.exp(-((x - SPOT_M[0]) ** 2 + (y - SPOT_M[1]) ** 2) / SPOT_RADIUS_M**2)
    lit = 0.5 + 0.5 * np.tanh((x - SHADE_EDGE_M) / SHADE_WIDTH_M)
    return (0.55 + 0.45 * spot) * (SHADE + (1 - SHADE) * lit)


def _grid(step_m: float, edges: bool) -> tuple[Array, Array]:
    """Returns x and y (rows, cols) [m] of the nodes (`edges`) or of the cell centres of a grid, from south to north."""
    axes = [np.arange(round(size / step_m) + edges) * step_m - size / 2 for size in SIZE_M]
    east, north = (axis if edges else axis + step_m / 2 for axis in axes)
    x, y = np.meshgrid(east, north)
    return np.asarray(x, np.float64), np.asarray(y, np.float64)
