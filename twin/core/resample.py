"""Resampling of images at subpixel positions by cubic B-splines in single precision.

OpenCV's warps round positions to 1/32 px. A prefilter (Unser et al. 1993, doi 10.1109/78.193221) makes the splines pass
through the pixels, so that resampling adds no blur of its own: a port without refraction changes no image.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.interpolation import bspline_weights
from twin.core.records import Image
from twin.core.threads import QUICK, in_row_bands
from twin.core.vector_math import sum_of_pixels
from twin.kernels import kernel

Positions = NDArray[np.float32]  #: (h, w, 2) column and row of a source image [px]

REACH_PX = 2  # support of the spline to each side
POLE, MIRRORED = 3**0.5 - 2, 16  # pole of the prefilter, length of its initial sum; POLE^16 is negligible
BLOCK = 128  # columns filtered at a time, so that they stay in the second-level cache
EXACT = np.float32(2e-3)  # largest deviation from an integer that is due to single precision
TAPS = 8  # pixels to each side in the prefilter of rows; POLE^9 is 7e-6


def interpolate(image: Image, positions: Positions) -> Image:
    """Returns the image (h, w, 3) interpolated from `image` (H, W, 3) at `positions`; exact at pixel centres."""
    spline, out = spline_coefficients(image), np.empty((*positions.shape[:2], 3), np.uint8)
    in_row_bands(lambda first, end: _fill_from(spline, positions, out, first, end), len(positions))
    return out


def spline_coefficients(image: NDArray[Any]) -> NDArray[np.float32]:
    """Returns the coefficients (H, 3 W) of the cubic B-spline through the pixels of an image (H, W, 3)."""
    spline = image.reshape(len(image), -1).astype(np.float32)
    in_row_bands(lambda first, end: _filter_columns(spline, first, end), spline.shape[1], QUICK)
    wide = cv2.copyMakeBorder(spline.reshape(image.shape), 0, 0, TAPS, TAPS, cv2.BORDER_REFLECT_101)
    flat = wide.reshape(len(wide), -1)
    in_row_bands(lambda first, end: _filter_rows(flat, spline, first, end), len(spline), QUICK)
    return spline


@kernel
def _fill_from(source, positions, out, first, end):
    n = out.shape[1]
    x, y, row = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(3 * n, np.float32)
    weights, cells = np.empty((8, n), np.float32), np.empty(n, np.int32)
    for v in range(first, end):
        unpack(positions[v].reshape(-1), x, y)
        spline_row(source, x, y, weights, cells, row)
        _round_row(row, out[v].reshape(-1))


@kernel
def _round_row(row, out):
    """Rounds values (3 w,) to 0 to 255, and adds the remainder of each to the next pixel of its band."""
    # Without them, small shifts of an image with little contrast would be lost: they change integers by less than 1/2.
    red = green = blue = np.float32(0.0)
    for k in range(0, row.size, 3):  # the bands together, as each pixel waits for the remainder of the last one
        out[k], red = _rounded(row[k] + red)
        out[k + 1], green = _rounded(row[k + 1] + green)
        out[k + 2], blue = _rounded(row[k + 2] + blue)


@kernel(forceinline=True)
def _rounded(value):
    half, least, most = np.float32(0.5), np.float32(0.0), np.float32(255.0)
    rounded = np.floor(min(max(value, least), most) + half)
    remainder = min(max(value - rounded, -half), half)
    return np.uint8(rounded), remainder if abs(remainder) > EXACT else np.float32(0.0)


@kernel
def unpack(pairs, x, y):
    for u in range(x.size):
        x[u], y[u] = pairs[2 * u], pairs[2 * u + 1]


@kernel
def spline_row(source, x, y, weights, cells, out):
    """Fills `out` (3 w,) with the values of the cubic B-spline of an image (H, 3 W) at columns x and rows y (w,).

    `weights` (8, w) float32 and `cells` (w,) int32 are working memory.
    """
    _spline_weights(x, weights[0], weights[1], weights[2], weights[3])
    _spline_weights(y, weights[4], weights[5], weights[6], weights[7])
    sum_row(source, x, y, weights, cells, out)


@kernel
def sum_row(source, x, y, weights, cells, out):
    """Fills `out` as `spline_row` does, with given weights (8, w) of 4 columns and 4 rows, see `sum_of_pixels`."""
    rows, cols = source.shape[0], source.shape[1] // 3
    _inner_cells(x, y, rows, cols, cells)
    for u in range(x.size):
        if cells[u] >= 0:
            red, green, blue = sum_of_pixels(source, np.int64(cells[u]), 3 * cols, weights, u)  # pyright: ignore
            out[3 * u], out[3 * u + 1], out[3 * u + 2] = red, green, blue
        else:
            _sum_at_border(source, x[u], y[u], weights, u, out)


@kernel(forceinline=True, fastmath={"contract"})
def _spline_weights(at, before, here, after, last):
    for u in range(at.size):
        before[u], here[u], after[u], last[u] = bspline_weights(at[u] - np.floor(at[u]))


@kernel
def _inner_cells(x, y, rows, cols, cells):
    """Computes the index of the first of the 4 x 4 pixels around each position; -1 if not all are inside the image."""
    zero, last_x, last_y = np.float32(0.0), np.float32(cols - 2), np.float32(rows - 2)
    stride, three, one = np.int32(3 * cols), np.int32(3), np.int32(1)
    for u in range(x.size):
        col, row = np.floor(x[u]), np.floor(y[u])
        inside = (col > zero) & (col < last_x) & (row > zero) & (row < last_y)
        cell = (np.int32(row) - one) * stride + three * (np.int32(col) - one)
        cells[u] = cell if inside else -one


@kernel
def _sum_at_border(source, x, y, weights, u, out):
    """Fills pixel u of `out` with the result of `sum_of_pixels`; beyond the image, its border pixels are repeated."""
    rows, cols = source.shape[0], source.shape[1] // 3
    col, row = int(np.floor(x)), int(np.floor(y))
    for band in range(3):
        total = np.float32(0.0)
        for j in range(4):
            line = source[min(max(row - 1 + j, 0), rows - 1)]
            for i in range(4):
                weight = weights[4 + j, u] * weights[i, u]
                total += weight * line[3 * min(max(col - 1 + i, 0), cols - 1) + band]
        out[3 * u + band] = total


@kernel
def _filter_columns(image, first, end):
    """Replaces columns of an image by B-spline coefficients: the filter 6 / (1 - p z^-1), then -p / (1 - p z)."""
    for start in range(first, end, BLOCK):
        _filter_block(image, start, min(start + BLOCK, end))


@kernel
def _filter_block(image, first, end):
    pole, rows = np.float32(POLE), image.shape[0]
    for k in range(first, end):
        total, power = image[0, k], np.float32(1.0)
        for i in range(1, min(MIRRORED, rows)):
            power *= pole
            total += power * image[i, k]
        image[0, k] = total
    for v in range(1, rows):
        before, here = image[v - 1, first:end], image[v, first:end]
        for k in range(here.size):
            here[k] += pole * before[k]
    last, before = image[rows - 1, first:end], image[rows - 2, first:end]
    for k in range(last.size):
        last[k] = np.float32(6.0) * pole / (pole * pole - np.float32(1.0)) * (last[k] + pole * before[k])
    for v in range(rows - 2, -1, -1):
        after, here = image[v + 1, first:end], image[v, first:end]
        for k in range(here.size):
            here[k] = pole * (after[k] - np.float32(6.0) * here[k])


@kernel(fastmath={"contract"})
def _filter_rows(wide, image, first, end):
    """Fills rows of an image (H, 3 W) with the coefficients of rows that are mirrored by TAPS."""
    # The two filters have the impulse response -6 p / (1 - p^2) p^|n| to |n| = TAPS, divided by its sum, so that even
    # light stays; along rows, a convolution is faster than a recursion, which waits for the previous pixel.
    pole = np.float32(POLE)
    sum_of_powers = 1.0
    for i in range(1, TAPS + 1):
        sum_of_powers += 2 * POLE**i
    middle_weight = np.float32(1 / sum_of_powers)
    for v in range(first, end):
        row, line = image[v], wide[v]
        for k in range(row.size):
            total, weight, at = middle_weight * line[k + 3 * TAPS], middle_weight, np.uint32(k)
            for i in range(1, TAPS + 1):  # the innermost loop, so that each value is written once
                weight *= pole
                total += weight * (line[at + np.uint32(3 * (TAPS - i))] + line[at + np.uint32(3 * (TAPS + i))])
            row[k] = total
