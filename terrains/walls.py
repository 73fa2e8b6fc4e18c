"""Textures of steep parts of a floor, by triplanar mapping.

The texture of the floor is projected from above, which stretches it on a slope of angle a by 1 / cos a. On steep parts
it is therefore blended with textures projected horizontally: along x onto the coordinates (y, z), along y onto (x, z).
The share of these two together increases smoothly from 0 at a slope of 50 deg, where the texture is stretched by 1.56,
to 1 at 65 deg. With the unit normal n, it is divided between them in proportion to |n_x|^4 and |n_y|^4 (after Geiss
2007, GPU Gems 3, sec. 1.5).
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from twin.core.records import Mask
from twin.terrains.terrain import PaintedTexture, Walls
from twin.terrains.textures import TextureSource, begin_wall_texture, texture_from_photo

#: Cosines of the slope from which on walls have a texture of their own (50 deg), and no other (65 deg).
STEEP_COSINE, WALL_COSINE = 0.643, 0.423
CREASE_COSINE = 0.7  #: cosine of the largest angle between the normals of adjacent cells of one smooth surface
WALL_TEXELS = 10_000_000  #: largest number of texels of the texture of walls


def walls_of(
    height_m: NDArray[np.float32], spacing_m: float, source: TextureSource, cover: str, texel_m: float,
    floor: PaintedTexture, draped: Mask | None = None,
) -> Walls | None:  # fmt: skip
    """Returns the walls of a floor of heights (ny, nx), row 0 = south; None if it has none, or no part is steep.

    Without photo, they are painted with `cover`, a key of `ground_cover.COVERS`, with the random numbers after those of
    the texture of the `floor`. `texel_m` is the side of the texels of the floor and, within WALL_TEXELS, of the walls.
    An orthophoto covers the texels `draped` (rows, cols), row 0 = north, where there are no walls.
    """
    found = wall_weights(height_m, spacing_m, draped) if source.walls else None
    if found is None:
        return None
    length_m, low_m, high_m = (max(height_m.shape) - 1) * spacing_m, float(height_m.min()), float(height_m.max())
    rise_m = high_m - low_m
    texel_m = max(texel_m, float(np.sqrt(length_m * rise_m / WALL_TEXELS)))
    shape = max(2, round(rise_m / texel_m)), max(2, round(length_m / texel_m))
    if source.photo_file is not None:
        begin = partial(texture_from_photo, source, shape, (length_m, rise_m))
    else:
        begin = partial(begin_wall_texture, cover, shape, (length_m, rise_m), spacing_m, floor)
    return Walls(*found, PaintedTexture((*shape, 3), begin, floor.rng), length_m, low_m, high_m)


def wall_weights(
    height_m: NDArray[np.float32], spacing_m: float, draped: Mask | None = None
) -> tuple[NDArray[np.int32], NDArray[np.float32]] | None:
    """Returns `number` and `weights` of `Walls` for heights (ny, nx), 0 under `draped`; None if no cell is steep."""
    # The normal at a corner is the mean over adjacent cells with normals near that of the cell itself (CREASE_COSINE),
    # so that weights vary smoothly, except at edges.
    normals = _cell_normals(height_m, spacing_m)
    steep = normals[..., 2] <= STEEP_COSINE
    if not steep.any():
        return None
    near = np.asarray(maximum_filter(steep, 3), np.bool_)  # the others have no weights
    if draped is not None:
        near &= ~_cells_with(draped, near.shape)
    row, col = np.nonzero(near)
    weights = np.zeros((len(row), 2, 2, 2), np.float32)
    for i, j in np.ndindex(2, 2):
        weights[:, i, j] = _corner_weights(normals, row, col, i, j)
    kept = weights.any(axis=(1, 2, 3))
    number = np.full(near.shape, -1, np.int32)
    number[row[kept], col[kept]] = np.arange(kept.sum())
    return (number, weights[kept]) if kept.any() else None


def _cells_with(texels: Mask, shape: tuple[int, ...]) -> Mask:
    """Returns whether each cell (rows, cols), row 0 = south, overlaps a texel of a mask (h, w), row 0 = north."""
    total = np.pad(np.cumsum(np.cumsum(texels[::-1], axis=0, dtype=np.int64), axis=1), ((1, 0), (1, 0)))
    (r0, r1), (c0, c1) = (
        (np.floor(np.arange(n) * m / n).astype(int), np.ceil(np.arange(1, n + 1) * m / n - 1e-9).astype(int))
        for n, m in zip(shape, texels.shape, strict=True)
    )
    return total[np.ix_(r1, c1)] - total[np.ix_(r0, c1)] - total[np.ix_(r1, c0)] + total[np.ix_(r0, c0)] > 0


def _cell_normals(height_m: NDArray[np.float32], spacing_m: float) -> NDArray[np.float32]:
    east, north = np.diff(height_m, axis=1), np.diff(height_m, axis=0)
    sides = -(east[1:] + east[:-1]) / 2, -(north[:, 1:] + north[:, :-1]) / 2
    normals = np.stack([*sides, np.full(sides[0].shape, spacing_m, np.float32)], axis=2)
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


def _corner_weights(normals: NDArray[np.float32], row: NDArray, col: NDArray, i: int, j: int) -> NDArray[np.float64]:
    """Returns the signed weights (n, 2) of the projections along x and y at a corner (i, j) of cells."""
    rows, cols, _ = normals.shape
    own, mean = normals[row, col], np.zeros((len(row), 3))
    for down, across in np.ndindex(2, 2):
        r, c = row + i + down - 1, col + j + across - 1
        inside = (r >= 0) & (r < rows) & (c >= 0) & (c < cols)
        other = normals[np.clip(r, 0, rows - 1), np.clip(c, 0, cols - 1)]
        product = own * other
        smooth = product[:, 0] + product[:, 1] + product[:, 2] >= CREASE_COSINE
        mean += np.where((inside & smooth)[:, None], other, 0.0)
    x, y, z = mean.T
    t = np.clip((STEEP_COSINE - z / np.sqrt(x * x + y * y + z * z)) / (STEEP_COSINE - WALL_COSINE), 0.0, 1.0)
    share, a, b = t * t * (3.0 - 2.0 * t), np.square(x * x), np.square(y * y)
    weights = np.copysign(share[:, None] * np.stack([a, b], 1) / np.maximum(a + b, 1e-300)[:, None], mean[:, :2])
    return np.where(share[:, None] > 0, weights, 0.0)
