"""Textures of steep parts of a floor, by triplanar mapping.

The texture of the floor is projected from above, which stretches it on a slope of angle a by 1 / cos a. On steep parts
it is therefore blended with textures projected horizontally: along x onto the coordinates (y, z), along y onto (x, z).
The share of these two together increases smoothly from 0 at a slope of 50 deg, where the texture is stretched by 1.56,
to 1 at 65 deg. With the unit normal n, it is divided between them in proportion to |n_x|^SHARPNESS and
|n_y|^SHARPNESS (after Geiss 2007, GPU Gems 3, sec. 1.5).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.kernels import kernel

SHARPNESS = 4  #: exponent of the weights of the two horizontal projections
#: Cosines of the slope from which on walls have a texture of their own (50 deg), and no other (65 deg).
STEEP_COSINE, WALL_COSINE = 0.643, 0.423
CREASE_COSINE = 0.7  #: cosine of the largest angle between the normals of adjacent cells of one smooth surface


class Walls(NamedTuple):
    """Texture of the walls of a floor, and its weights.

    A weight belongs to a corner of a cell of the height grid and is interpolated bilinearly within the cell. Its sign
    is that of the normal, so that opposite walls differ: where it is positive, the columns of the texture run along +y
    (projection along x) or +x (projection along y) from the south-west corner of the floor; where it is negative, they
    run in the same direction from right to left.

    Args:
        number: (ny - 1, nx - 1) int32 index in `weights` of each cell of the height grid, row 0 = south; -1 where all
            weights are 0.
        weights: (n, 2, 2, 2) float32 weights at the corners of a cell: south and north, west and east, projection
            along x and y. The rest to 1 is the weight of the texture of the floor.
        texture: (h, w, 3) uint8 RGB albedo; rows run down from the highest point of the floor to its lowest point.
        length_m: length of the texture along its columns [m], the longer side of the floor.
        low_m, high_m: heights of the lower and the upper edge of the texture [m].
    """

    number: NDArray[np.int32]
    weights: NDArray[np.float32]
    texture: NDArray[np.uint8]
    length_m: float
    low_m: float
    high_m: float


class WallWeights(NamedTuple):
    """Weights of the horizontal projections; see `Walls` for the arguments."""

    number: NDArray[np.int32]
    weights: NDArray[np.float32]


def wall_weights(
    height_m: NDArray[np.float32], spacing_m: float, draped: NDArray[np.bool_] | None = None
) -> WallWeights | None:
    """Returns the weights of the horizontal projections of a height grid; None if it has no steep cells.

    The normal at a corner is the mean over the adjacent cells whose normals differ little from that of the cell itself
    (see CREASE_COSINE), so that weights vary smoothly, except at edges.

    Args:
        height_m: (ny, nx) heights, row 0 = south.
        draped: (rows, cols) texels, row 0 = north, that an orthophoto covers; cells with such texels have no weights.
    """
    allowed = np.ones((height_m.shape[0] - 1, height_m.shape[1] - 1), np.bool_)
    if draped is not None:
        allowed = ~_cells_with(draped, allowed.shape)
    normals = _cell_normals(height_m, spacing_m)
    if normals[..., 2].min() > STEEP_COSINE:
        return None
    number, weights = _weights(normals, allowed)
    return WallWeights(number, weights) if len(weights) else None


def _cells_with(texels: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Returns whether each cell (rows, cols), row 0 = south, overlaps a texel of a mask (h, w), row 0 = north."""
    total = np.pad(np.cumsum(np.cumsum(texels[::-1], axis=0, dtype=np.int64), axis=1), ((1, 0), (1, 0)))
    (r0, r1), (c0, c1) = (
        (np.floor(np.arange(n) * m / n).astype(int), np.ceil(np.arange(1, n + 1) * m / n - 1e-9).astype(int))
        for n, m in zip(shape, texels.shape, strict=True)
    )
    return total[np.ix_(r1, c1)] - total[np.ix_(r0, c1)] - total[np.ix_(r1, c0)] + total[np.ix_(r0, c0)] > 0


def _cell_normals(height_m: NDArray[np.float32], spacing_m: float) -> NDArray[np.float32]:
    """Returns the unit normals (ny - 1, nx - 1, 3) of the cells of a height grid (ny, nx): means of both triangles."""
    east, north = np.diff(height_m, axis=1), np.diff(height_m, axis=0)
    sides = -(east[1:] + east[:-1]) / 2, -(north[:, 1:] + north[:, :-1]) / 2
    normals = np.stack([*sides, np.full(sides[0].shape, spacing_m, np.float32)], axis=2)
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


@kernel
def _weights(
    normals: NDArray[np.float32], allowed: NDArray[np.bool_]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:  # pragma: no cover (compiled)
    """Returns `number` and `weights` of `Walls`."""
    rows, cols, _ = normals.shape
    number = np.full((rows, cols), -1, np.int32)
    weights = np.zeros((16, 2, 2, 2), np.float32)
    corner = np.zeros((2, 2, 2), np.float32)
    n = 0
    for r in range(rows):
        for c in range(cols):
            if not allowed[r, c]:
                continue
            for i in range(2):
                for j in range(2):
                    _corner_weights(normals, r, c, i, j, corner[i, j])
            if not corner.any():
                continue
            if n == len(weights):
                grown = np.zeros((2 * n, 2, 2, 2), np.float32)
                grown[:n] = weights
                weights = grown
            number[r, c], weights[n] = n, corner
            n += 1
    return number, weights[:n].copy()


@kernel
def _corner_weights(
    normals: NDArray[np.float32], r: int, c: int, i: int, j: int, weight: NDArray[np.float32]
) -> None:  # pragma: no cover (compiled)
    """Computes the signed weights (2,) of the projections along x and y at a corner of cell (r, c)."""
    rows, cols, _ = normals.shape
    own = normals[r, c]
    x, y, z = 0.0, 0.0, 0.0
    for row in range(max(r + i - 1, 0), min(r + i + 1, rows)):
        for col in range(max(c + j - 1, 0), min(c + j + 1, cols)):
            other = normals[row, col]
            if own[0] * other[0] + own[1] * other[1] + own[2] * other[2] >= CREASE_COSINE:
                x, y, z = x + other[0], y + other[1], z + other[2]
    length = np.sqrt(x * x + y * y + z * z)
    t = min(max((STEEP_COSINE - z / length) / (STEEP_COSINE - WALL_COSINE), 0.0), 1.0)
    share = t * t * (3.0 - 2.0 * t)
    if share == 0.0:
        weight[0], weight[1] = 0.0, 0.0
        return
    a, b = abs(x) ** SHARPNESS, abs(y) ** SHARPNESS
    weight[0], weight[1] = np.copysign(share * a / (a + b), x), np.copysign(share * b / (a + b), y)
