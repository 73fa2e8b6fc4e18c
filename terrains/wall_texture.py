"""Walls of a floor: the texture of its steep parts, from the same photo or materials as the floor itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.terrains.textures import TextureSource, generate_wall_texture, texture_from_photo
from twin.terrains.walls import Walls, wall_weights

WALL_TEXELS = 10_000_000  #: largest number of texels of the texture of walls


def walls_of(
    height_m: NDArray[np.float32],
    spacing_m: float,
    source: TextureSource,
    cover: str,
    texel_m: float,
    rng: np.random.Generator,
    draped: NDArray[np.bool_] | None = None,
) -> Walls | None:
    """Returns the walls of a floor; None if `source.walls` is false or no part of the floor is steep.

    Args:
        height_m: (ny, nx) heights, row 0 = south.
        source: source of the texture of the floor.
        cover: a key of `ground_cover.COVERS`, for a floor without photo.
        texel_m: side of the texels of the floor; those of the walls have the same side, or a larger one if there would
            be more than WALL_TEXELS.
        draped: (rows, cols) texels, row 0 = north, that an orthophoto covers. It shows no walls, and the scene has its
            colours wherever it has any: there are no walls here.
    """
    found = wall_weights(height_m, spacing_m, draped) if source.walls else None
    if found is None:
        return None
    length_m, low_m, high_m = (max(height_m.shape) - 1) * spacing_m, float(height_m.min()), float(height_m.max())
    rise_m = high_m - low_m
    texel_m = max(texel_m, float(np.sqrt(length_m * rise_m / WALL_TEXELS)))
    shape = max(2, round(rise_m / texel_m)), max(2, round(length_m / texel_m))
    if source.photo_file is not None:
        texture = texture_from_photo(source, shape, (length_m, rise_m))
    else:
        texture = generate_wall_texture(cover, shape, (length_m, rise_m), spacing_m, rng)
    return Walls(*found, texture, length_m, low_m, high_m)
