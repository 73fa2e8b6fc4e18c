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
TAPS = 10  # pixels to each side in the prefilter of rows; POLE^10 is 2e-6
INTERSECTION_STEPS = 4  # maximum; each multiplies the error by p / z (see `intersect`) times the slope of the floor
INTERSECTION_PX = 1e-2  # the iteration ends when a step is shorter; the remaining error is a few percent of that step


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
    in_row_bands(lambda first, end: _fill_from(source, positions, out, first, end), len(positions))
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _fill_from(source, positions, out, first, end):
    """Fills rows `first` to `end` of `out` (h, w, 3) from `source` (H, 3 W)."""
    rows, cols = source.shape[0], source.shape[1] // 3
    for v in range(first, end):
        for u in range(out.shape[1]):
            x, y = positions[v, u, 0], positions[v, u, 1]
            col, row = int(np.floor(x)), int(np.floor(y))
            wx, wy = _weights(x - np.float32(col)), _weights(y - np.float32(row))
            if 0 < col < cols - 2 and 0 < row < rows - 2:
                weighted_sum(source, row - 1, row, row + 1, row + 2, 3 * (col - 1), wx, wy, out[v, u])
                continue
            for band in range(3):
                total = np.float32(0.0)
                for j in range(4):
                    line = source[min(max(row - 1 + j, 0), rows - 1)]
                    for i in range(4):
                        total += wy[j] * wx[i] * line[3 * min(max(col - 1 + i, 0), cols - 1) + band]
                out[v, u, band] = total


@njit(cache=True, nogil=True, inline="always")
def weighted_sum(image, a, b, c, d, at, across, down, out):
    """Writes to `out` (3,) the weighted sum of 4 x 4 pixels of an image (H, 3 W): rows a to d, from element `at` on."""
    above, here, below, last = image[a], image[b], image[c], image[d]
    k, three = np.uint64(at), np.uint64(3)
    for band in range(3):
        total = np.float32(0.0)
        i = k + np.uint64(band)
        for j in range(4):
            total += across[j] * (down[0] * above[i] + down[1] * here[i] + down[2] * below[i] + down[3] * last[i])
            i += three
        out[band] = total


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


@njit(cache=True, nogil=True, fastmath={"contract"})
def _filter_rows(image, first, end):
    """Same as `_filter_columns`, but for rows `first` to `end` of an image (H, 3 W).

    The two recursive filters have the impulse response -6 p / (1 - p^2) p^|n|, which is symmetric and is summed up to
    |n| = `TAPS`; a convolution is faster along the rows, where a recursion has to wait for the last pixel.
    """
    n = image.shape[1]
    width = n // 3
    wide = np.empty(n + 6 * TAPS, np.float32)
    pole = np.float32(POLE)
    middle_weight = np.float32(-6.0) * pole / (np.float32(1.0) - pole * pole)
    for v in range(first, end):
        row = image[v]
        wide[3 * TAPS : 3 * TAPS + n] = row
        for i in range(1, TAPS + 1):
            before, after = _mirrored(-i, width), _mirrored(width - 1 + i, width)
            for band in range(3):
                wide[3 * (TAPS - i) + band] = row[3 * before + band]
                wide[3 * (TAPS + width - 1 + i) + band] = row[3 * after + band]
        middle = wide[3 * TAPS : 3 * TAPS + n]
        for k in range(n):
            row[k] = middle_weight * middle[k]
        weight = middle_weight
        for i in range(1, TAPS + 1):
            weight *= pole
            left, right = wide[3 * (TAPS - i) : 3 * (TAPS - i) + n], wide[3 * (TAPS + i) : 3 * (TAPS + i) + n]
            for k in range(n):
                row[k] += weight * (left[k] + right[k])


@njit(cache=True, nogil=True)
def _mirrored(at, size):
    """Returns the position of a pixel in an image that is mirrored at the centres of its first and last pixel."""
    period = max(2 * (size - 1), 1)
    at = abs(at) % period
    return min(at, period - at) if size > 1 else 0


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect(near, positions, parallax, out, first, end):
    """Writes the intersections of rows `first` to `end` (exclusive) to `out`; `near` is the inverse depth.

    See `intersect` for the fixed-point iteration.
    """
    rows, cols = near.shape
    for v in range(first, end):
        inverse = near[v * rows // len(out), 0]
        for u in range(out.shape[1]):
            x = positions[v, u, 0] + parallax[v, u, 0] * inverse  # start from the inverse depth at the last pixel
            y = positions[v, u, 1] + parallax[v, u, 1] * inverse
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
