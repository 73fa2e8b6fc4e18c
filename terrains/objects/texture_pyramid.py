"""Textures with levels of resolution (mip maps, Williams 1983), all in one array, from which a kernel samples."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray


class Textures(NamedTuple):
    texels: NDArray[np.uint8]  #: (n, 3) texels of all levels of all textures, row by row
    #: (textures, levels, 3) number of the first texel, rows and columns of each level, finest first; a texture with
    #: fewer levels repeats its last one
    levels: NDArray[np.int64]


def textures_of(images: Sequence[NDArray[np.uint8]]) -> Textures:
    """Returns the textures (h, w, 3) with their levels; each has half the rows and columns of the one before."""
    pyramids = [_pyramid(image) for image in images]
    most = max((len(levels) for levels in pyramids), default=1)
    table, blocks, first = np.zeros((len(images), most, 3), np.int64), [], 0
    for k, levels in enumerate(pyramids):
        for j, image in enumerate(levels):
            table[k, j] = first, *image.shape[:2]
            blocks.append(image.reshape(-1, 3))
            first += len(blocks[-1])
        table[k, len(levels) :] = table[k, len(levels) - 1]
    return Textures(np.concatenate(blocks) if blocks else np.zeros((0, 3), np.uint8), table)


def _pyramid(image: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    levels = [np.ascontiguousarray(image)]
    while max(levels[-1].shape[:2]) > 1:
        rows, cols = (max(1, n // 2) for n in levels[-1].shape[:2])
        levels.append(np.asarray(cv2.resize(levels[-1], (cols, rows), interpolation=cv2.INTER_AREA), np.uint8))
    return levels
