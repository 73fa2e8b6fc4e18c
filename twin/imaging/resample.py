"""Resampling of images at subpixel positions by cubic B-splines in single precision.

OpenCV's warps are not used, because they round positions to 1/32 px. For radiance, the B-spline is the point spread
function of a pixel: it suppresses spatial frequencies above half a cycle per pixel, which would alias. Sensor images
are interpolated: a prefilter makes the spline pass through the value of every pixel (Unser et al. 1993, doi
10.1109/78.193221).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.records import Image
from twin.imaging.row_parallel import in_row_bands

Radiance = NDArray[np.float32]
Positions = NDArray[np.float32]  #: (h, w, 2) column and row of a source image [px]

REACH_PX = 2  # support of the spline to each side
POLE, MIRRORED = 3**0.5 - 2, 16  # pole of the prefilter, length of its initial sum; POLE^16 is negligible
INTERSECTION_STEPS = 4  # maximum; each multiplies the error by p / z (see `intersect`) times the slope of the floor
INTERSECTION_PX = 1e-3  # the iteration ends when a step is shorter; the remaining error is a few percent of that step


def sample(light: Radiance, positions: Positions) -> Radiance:
    """Returns the radiance (h, w, 3) recorded by pixels at these positions in a radiance image (H, W, 3).

    Beyond the image border, the values of the nearest border pixel are repeated.
    """
    return _sampled(np.ascontiguousarray(light).reshape(len(light), -1), positions)


def interpolate(image: Image, positions: Positions) -> Image:
    """Returns the image (h, w, 3) interpolated from `image` (H, W, 3) at `positions`; exact at pixel centres."""
    spline = image.reshape(len(image), -1).astype(np.float32)
    in_row_bands(lambda first, end: _filter_columns(spline, first, end), spline.shape[1])
    in_row_bands(lambda first, end: _filter_rows(spline, first, end), len(spline))
    between, out = _sampled(spline, positions), np.empty((*positions.shape[:2], 3), np.uint8)
    in_row_bands(lambda first, end: _round(between, out, first, end), len(positions))
    return out


def _sampled(source: NDArray[np.float32], positions: Positions) -> Radiance:
    out = np.empty((*positions.shape[:2], 3), np.float32)
    in_row_bands(lambda first, end: _sample(source, positions, out, first, end), len(positions))
    return out


def intersect(depth: NDArray[np.float32], positions: Positions, parallax_px_m: Positions) -> Positions:
    """Returns the image positions where rays that do not pass through the camera centre intersect the floor.

    A ray that crosses the plane of depth zero at distance p [m] from the camera centre is imaged f p / z away from its
    vanishing point, with f the focal length [px] and z the depth of the floor at that position. The map of 1 / z, which
    is linear for a plane, is interpolated bilinearly.

    Args:
        depth: (H, W) depth [m]; inf where there is no floor.
        positions: (h, w, 2) vanishing points of the rays.
        parallax_px_m: (h, w, 2) product f p, in columns and rows [px m].
    """
    out, near = np.empty_like(positions), np.reciprocal(depth)
    in_row_bands(lambda first, end: _intersect(near, positions, parallax_px_m, out, first, end), len(positions))
    return out


@njit(cache=True, nogil=True, inline="always")
def _weights(t):
    """Returns the B-spline weights of four consecutive pixels for a position t in [0, 1] pixels after the second."""
    s, sixth = np.float32(1.0) - t, np.float32(1 / 6)
    four, three = np.float32(4.0), np.float32(3.0)
    a, d = s * s * s * sixth, t * t * t * sixth
    b = (four + three * t * t * (t - np.float32(2.0))) * sixth
    return a, b, np.float32(1.0) - a - b - d, d


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(source, positions, out, first, end):
    """Fills rows `first` to `end` of `out` (h, w, 3) from `source` (H, 3 W)."""
    rows, cols = source.shape[0], source.shape[1] // 3
    for v in range(first, end):
        for u in range(out.shape[1]):
            x, y = positions[v, u, 0], positions[v, u, 1]
            col, row = int(np.floor(x)), int(np.floor(y))
            wx, wy = _weights(x - np.float32(col)), _weights(y - np.float32(row))
            a, b = 3 * min(max(col - 1, 0), cols - 1), 3 * min(max(col, 0), cols - 1)
            c, d = 3 * min(max(col + 1, 0), cols - 1), 3 * min(max(col + 2, 0), cols - 1)
            red = green = blue = np.float32(0.0)
            for j in range(4):
                line = source[min(max(row - 1 + j, 0), rows - 1)]
                red += wy[j] * (wx[0] * line[a] + wx[1] * line[b] + wx[2] * line[c] + wx[3] * line[d])
                green += wy[j] * (wx[0] * line[a + 1] + wx[1] * line[b + 1] + wx[2] * line[c + 1] + wx[3] * line[d + 1])
                blue += wy[j] * (wx[0] * line[a + 2] + wx[1] * line[b + 2] + wx[2] * line[c + 2] + wx[3] * line[d + 2])
            out[v, u, 0], out[v, u, 1], out[v, u, 2] = red, green, blue


@njit(cache=True, nogil=True)
def _round(numbers, out, first, end):
    """Fills rows `first` to `end` of `out` with numbers rounded and clipped to 8 bits."""
    least, most = np.float32(0.0), np.float32(255.0)
    for v in range(first, end):
        row, filled = numbers[v].reshape(-1), out[v].reshape(-1)
        for k in range(row.size):
            filled[k] = np.uint8(min(max(row[k] + np.float32(0.5), least), most))


@njit(cache=True, nogil=True)
def _filter_columns(image, first, end):
    """Replaces columns `first` to `end` of an image (H, n) by cubic B-spline coefficients, with mirrored ends.

    Applies 6 times the filter 1 / (1 - p z^-1), then the filter -p / (1 - p z), with p the pole (Unser et al. 1993).
    """
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


@njit(cache=True, nogil=True)
def _filter_rows(image, first, end):
    """Same as `_filter_columns`, but for rows `first` to `end` of an image (H, 3 W)."""
    for v in range(first, end):
        _filter_columns(image[v].reshape(-1, 3), 0, 3)


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect(near, positions, parallax, out, first, end):
    """Writes the intersections of rows `first` to `end` (exclusive) to `out`; `near` is the inverse depth.

    See `intersect` for the fixed-point iteration.
    """
    rows, cols = near.shape
    for v in range(first, end):
        for u in range(out.shape[1]):
            x, y = positions[v, u, 0], positions[v, u, 1]
            for _ in range(INTERSECTION_STEPS):
                col = min(max(int(np.floor(x)), 0), cols - 2)
                row = min(max(int(np.floor(y)), 0), rows - 2)
                s = min(max(x - np.float32(col), np.float32(0.0)), np.float32(1.0))
                t = min(max(y - np.float32(row), np.float32(0.0)), np.float32(1.0))
                above = near[row, col] + s * (near[row, col + 1] - near[row, col])
                below = near[row + 1, col] + s * (near[row + 1, col + 1] - near[row + 1, col])
                inverse = above + t * (below - above)
                was_x, was_y = x, y
                x = positions[v, u, 0] + parallax[v, u, 0] * inverse
                y = positions[v, u, 1] + parallax[v, u, 1] * inverse
                if abs(x - was_x) + abs(y - was_y) < np.float32(INTERSECTION_PX):
                    break
            out[v, u, 0], out[v, u, 1] = x, y
