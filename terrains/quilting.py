"""Textures without visible repetition from one photo: image quilting.

The texture is filled with overlapping square blocks of the photo, row by row. Each block is taken from a random place
of the photo where it agrees well with the previous blocks in the overlap, and is joined to them along the path of least
difference through the overlap (Efros & Freeman 2001, Image quilting for texture synthesis and transfer, sec. 2).
"""

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image
from twin.kernels import kernel

BLOCK_FRACTION = 5  #: shorter side of the photo divided by the side of a block
OVERLAP_FRACTION = 4  #: side of a block divided by the overlap of neighbouring blocks
CANDIDATES = 60  #: random places of the photo that are compared for each block
TOLERANCE = 1.2  #: places whose difference is at most this many times the least one are equally likely
LIGHTING_SAMPLES = 250_000  #: approximate number of pixels to which the slow variation of brightness is fitted
LIGHTING_ROWS = 128  #: rows of a photo that are divided by this variation at a time
MIN_BLOCK_PX = 8  #: a photo whose blocks would be smaller is repeated as tiles


def even_lighting(photo: Image) -> Image:
    """Returns a photo (h, w, 3) without slow variations of its brightness; a black photo unchanged."""
    # divided by a polynomial of degree 2 in row and column, fitted to about LIGHTING_SAMPLES pixels of the mean of R, G
    # and B, or by 5 % of the mean where that is less
    step = max(1, round(np.sqrt(photo.shape[0] * photo.shape[1] / LIGHTING_SAMPLES)))
    v, u = (np.linspace(-1.0, 1.0, n, dtype=np.float32) for n in photo.shape[:2])
    grey = photo[::step, ::step].mean(axis=2, dtype=np.float32)
    mean = float(grey.mean())
    if mean == 0.0:
        return photo
    terms = _terms(v[::step, None], u[None, ::step])
    fit = np.linalg.lstsq(np.stack([np.broadcast_to(t, grey.shape).ravel() for t in terms], axis=1), grey.ravel())[0]
    even = np.empty_like(photo)
    for first in range(0, len(photo), LIGHTING_ROWS):
        rows = slice(first, first + LIGHTING_ROWS)
        brightness = sum(c * t for c, t in zip(fit.astype(np.float32), _terms(v[rows, None], u[None]), strict=True))
        gain = np.float32(mean) / np.maximum(brightness, np.float32(0.05 * mean))
        even[rows] = np.clip(np.rint(photo[rows] * gain[..., None]), 0, 255)
    return even


def _terms(v: NDArray[np.float32], u: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    return np.ones((1, 1), np.float32), u, v, u * u, u * v, v * v


def quilt(photo: Image, shape: tuple[int, int], rng: np.random.Generator) -> Image:
    """Returns a texture (rows, cols, 3) of blocks of a photo (h, w, 3) of its scale; a part of it if it fits.

    The photo has at least BLOCK_FRACTION * MIN_BLOCK_PX rows and columns.
    """
    rows, cols = shape
    if rows <= photo.shape[0] and cols <= photo.shape[1]:
        return np.ascontiguousarray(photo[:rows, :cols])
    side = min(photo.shape[:2]) // BLOCK_FRACTION
    overlap = side // OVERLAP_FRACTION
    step = side - overlap
    n_rows, n_cols = (-(-max(n - overlap, 1) // step) for n in shape)
    texture = np.zeros((n_rows * step + overlap, n_cols * step + overlap, 3), np.uint8)
    places = rng.integers(0, 2**31, (n_rows, n_cols, CANDIDATES, 2)).astype(np.int64)
    places %= np.array([photo.shape[0] - side + 1, photo.shape[1] - side + 1])
    photo, draws = np.ascontiguousarray(photo), rng.random((n_rows, n_cols))
    for i, j in np.ndindex(n_rows, n_cols):
        target = texture[i * step : i * step + side, j * step : j * step + side]
        difference = _differences(target, photo, places[i, j], overlap, i > 0, j > 0)
        agreeing = np.flatnonzero(difference <= difference.min() * TOLERANCE)
        r, c = places[i, j, agreeing[int(draws[i, j] * len(agreeing))]]
        _join(target, photo[r : r + side, c : c + side], overlap, i > 0, j > 0)
    return np.ascontiguousarray(texture[:rows, :cols])


@kernel
def _differences(target, photo, places, overlap, above, left):
    """Returns the sums of squared differences in the overlaps with the blocks above and left, of every second pixel."""
    side, totals = target.shape[0], np.zeros(len(places))
    for k in range(len(places)):
        block, total = photo[places[k, 0] : places[k, 0] + side, places[k, 1] : places[k, 1] + side], 0.0
        for r in range(0, overlap if above else 0, 2):
            for c in range(0, side, 2):
                total += _squared(target[r, c], block[r, c])
        for r in range(overlap if above else 0, side, 2):
            for c in range(0, overlap if left else 0, 2):
                total += _squared(target[r, c], block[r, c])
        totals[k] = total
    return totals


@kernel
def _squared(a, b):
    d0, d1, d2 = float(a[0]) - b[0], float(a[1]) - b[1], float(a[2]) - b[2]
    return d0 * d0 + d1 * d1 + d2 * d2


@kernel
def _join(target, block, overlap, above, left):
    """Copies a block (side, side, 3) below and right of the cuts of least difference to the target; blends 3 px."""
    side = target.shape[0]
    upper, west, cost = np.full(side, -2.0), np.full(side, -2.0), np.empty((side, overlap))
    if above:
        for c in range(side):
            for r in range(overlap):
                cost[c, r] = _squared(target[r, c], block[r, c])
        upper = _cheapest_path(cost)
    if left:
        for r in range(side):
            for c in range(overlap):
                cost[r, c] = _squared(target[r, c], block[r, c])
        west = _cheapest_path(cost)
    for r in range(side):
        for c in range(side):
            weight = min(max((r - upper[c]) / 3.0 + 0.5, 0.0), 1.0) * min(max((c - west[r]) / 3.0 + 0.5, 0.0), 1.0)
            for k in range(3):
                target[r, c, k] = np.uint8(round(weight * block[r, c, k] + (1.0 - weight) * target[r, c, k]))


@kernel
def _cheapest_path(cost):
    """Returns the connected path through all rows of costs (n, m) with the least sum: its column (n,) in each row."""
    n, m = cost.shape
    total, path = cost.copy(), np.empty(n)
    for i in range(1, n):
        for j in range(m):
            total[i, j] += total[i - 1, max(j - 1, 0) : min(j + 2, m)].min()
    low, high = 0, m
    for i in range(n - 1, -1, -1):
        j = low + int(np.argmin(total[i, low:high]))
        path[i], low, high = j, max(j - 1, 0), min(j + 2, m)
    return path
