"""Texture with levels of resolution (mip maps, Williams 1983), and lists of trilinear samples of it."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image
from twin.core.vector_math import sum_of_texels
from twin.kernels import kernel

_BLOCK_ROWS = 512  # rows of a texture that are halved at once, to limit memory
_FAST = {"contract", "arcp", "nsz", "reassoc"}


class TextureLevels(NamedTuple):
    finest: NDArray[np.uint8]  # (3 n,) colours of the finest level, row by row: the texture itself, not a copy
    coarser: NDArray[np.uint8]  # (3 m,) colours of all other levels
    table: NDArray[np.int64]  # (levels, 3) first texel in its array, rows and columns of each level, finest first


def levels_of(texture: Image) -> TextureLevels:
    """Returns a texture (h, w, 3) with its levels: each has half the rows and columns, rounded up, at least 2."""
    levels = [np.ascontiguousarray(texture)]
    while min(levels[-1].shape[:2]) > 2:
        levels.append(_halved(levels[-1]))
    table, first = np.zeros((len(levels), 3), np.int64), 0
    for k, level in enumerate(levels):
        table[k] = first, *level.shape[:2]
        first += level.shape[0] * level.shape[1] if k else 0
    coarser = [level.reshape(-1) for level in levels[1:]]
    return TextureLevels(levels[0].reshape(-1), np.concatenate([np.zeros(0, np.uint8), *coarser]), table)


def _halved(image: Image) -> Image:
    rows, cols = image.shape[:2]
    half = np.empty((-(-rows // 2), -(-cols // 2), 3), np.uint8)
    for top in range(0, rows, _BLOCK_ROWS):
        part = image[top : top + _BLOCK_ROWS]
        even = cv2.copyMakeBorder(part, 0, len(part) % 2, 0, cols % 2, cv2.BORDER_REPLICATE)
        size = half.shape[1], len(even) // 2
        half[top // 2 : top // 2 + size[1]] = cv2.resize(even, size, interpolation=cv2.INTER_AREA)
    return half


@kernel(fastmath=_FAST, error_model="numpy", forceinline=True)
def level_of(size_2):
    """Replaces squared sizes of pixels (n,) [texels] by levels, linear within an octave; below one texel: 0."""
    bits = size_2.view(np.int32)
    for i in range(size_2.size):
        size_2[i] = max(size_2[i], np.float32(1))
    for i in range(size_2.size):  # log2 from exponent and mantissa
        size_2[i] = np.float32(0.5) * (np.float32(bits[i]) * np.float32(2**-23) - np.float32(127))


@kernel(fastmath=_FAST, error_model="numpy", forceinline=True)
def add_samples(texture, x, y, level, weight, at, n, shares, cells, total):
    """Adds samples to the colours (3 W,) of pixels, interpolated linearly between texels and levels."""
    # the first n columns (finest texels), rows, levels, weights, and numbers of the pixels are those of the samples;
    # `shares` (3, n) float32 and `cells` (3, n) int32 are overwritten; beyond its border, a texture repeats its texels
    finest, coarser, table = texture
    zero, one, half, two = np.float32(0), np.float32(1), np.float32(0.5), np.float32(2)
    high, wide, last = np.float32(table[0, 1]), np.float32(table[0, 2]), max(np.float32(len(table) - 1.001), zero)
    across, down, whole, col, row, number = shares[0], shares[1], shares[2], cells[0], cells[1], cells[2]
    for coarse in range(2):
        for i in range(n):
            exact = min(level[i], last)
            finer = np.floor(exact)
            k = np.int32(np.int32(finer) + coarse)
            per_texel = np.int32((np.int32(127) - k) << np.int32(23)).view(np.float32)  # 2^-k
            c = min(max(x[i] * per_texel - half, zero), wide * per_texel - one)
            r = min(max(y[i] * per_texel - half, zero), high * per_texel - one)
            left = min(np.floor(c), np.ceil(wide * per_texel) - two)
            top = min(np.floor(r), np.ceil(high * per_texel) - two)
            across[i], down[i] = c - left, r - top
            col[i], row[i], number[i] = np.int32(left), np.int32(top), k
            whole[i] = weight[i] * (exact - finer if coarse else one - exact + finer)
        for i in range(n):
            if whole[i] > zero:
                first, width = table[number[i], 0], table[number[i], 2]
                start, s, lower = 3 * (first + row[i] * width + col[i]), across[i], down[i] * whole[i]
                upper = whole[i] - lower
                weights = upper - s * upper, s * upper, lower - s * lower, s * lower
                if number[i] == 0:
                    red, green, blue = sum_of_texels(finest, start, 3 * width, weights)  # pyright: ignore
                else:
                    red, green, blue = sum_of_texels(coarser, start, 3 * width, weights)  # pyright: ignore
                k = 3 * at[i]
                total[k] += red
                total[k + 1] += green
                total[k + 2] += blue
