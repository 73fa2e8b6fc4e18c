"""Images at other places than their pixels, by cubic B-splines in single precision.

OpenCV's warps round places to 1/32 px. Here light is gathered with the spline itself as the response of a pixel: what
a rendering holds beyond half a cycle a pixel would else beat with the places. Pictures of a sensor are interpolated:
filtered first so that the spline passes through every pixel (Unser et al. 1993, doi 10.1109/78.193221).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.records import Image
from twin.imaging.row_parallel import in_row_bands

Light = NDArray[np.float32]
Places = NDArray[np.float32]  #: (h, w, 2) column and row of a source image [px]

REACH_PX = 2  # a spline's, to each side
POLE, MIRRORED = 3**0.5 - 2, 16  # of a spline's coefficients; POLE^16 is lost in single precision
MEETINGS = 4  # of a ray with the depth map; each leaves of the error p / z times the floor's slope, p = ray's offset
MET_PX = 1e-3  # a last step of which some percent are left


def gather(light: Light, places: Places) -> Light:
    """(h, w, 3) light (H, W, 3) as pixels at these places gather it; beyond its border the border goes on."""
    return _gathered(np.ascontiguousarray(light).reshape(len(light), -1), places)


def interpolate(image: Image, places: Places) -> Image:
    """An image (H, W, 3) between its pixels, exact at them."""
    spline = image.reshape(len(image), -1).astype(np.float32)
    in_row_bands(lambda first, end: _filter_columns(spline, first, end), spline.shape[1])
    in_row_bands(lambda first, end: _filter_rows(spline, first, end), len(spline))
    between, out = _gathered(spline, places), np.empty((*places.shape[:2], 3), np.uint8)
    in_row_bands(lambda first, end: _round(between, out, first, end), len(places))
    return out


def _gathered(source: NDArray[np.float32], places: Places) -> Light:
    out = np.empty((*places.shape[:2], 3), np.float32)
    in_row_bands(lambda first, end: _gather(source, places, out, first, end), len(places))
    return out


def meet(depth: NDArray[np.float32], places: Places, shift_px_m: Places) -> Places:
    """Where rays that do not pass through the eye meet the floor, in its image.

    A ray that lies off the eye by p [m] at depth zero is seen f p / z beside its end, z the depth of the floor that is
    seen there. 1 / z of a plane is even in the image: between pixels it is taken straight.

    Args:
        depth: (H, W) [m]; inf where no floor is.
        places: ends of the rays, infinitely far.
        shift_px_m: f p.
    """
    out, nearness = np.empty_like(places), np.reciprocal(depth)
    in_row_bands(lambda first, end: _meet(nearness, places, shift_px_m, out, first, end), len(places))
    return out


@njit(cache=True, nogil=True, inline="always")
def _weights(t):
    """Of the four pixels around a place that lies t behind the second."""
    s, sixth = np.float32(1.0) - t, np.float32(1 / 6)
    four, three = np.float32(4.0), np.float32(3.0)
    a, d = s * s * s * sixth, t * t * t * sixth
    b = (four + three * t * t * (t - np.float32(2.0))) * sixth
    return a, b, np.float32(1.0) - a - b - d, d


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(source, places, out, first, end):
    """Fills rows `first` to `end` of `out` (h, w, 3) from `source` (H, 3 W)."""
    rows, cols = source.shape[0], source.shape[1] // 3
    for v in range(first, end):
        for u in range(out.shape[1]):
            x, y = places[v, u, 0], places[v, u, 1]
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
    """Fills rows `first` to `end` of `out` with whole numbers of a byte."""
    least, most = np.float32(0.0), np.float32(255.0)
    for v in range(first, end):
        row, filled = numbers[v].reshape(-1), out[v].reshape(-1)
        for k in range(row.size):
            filled[k] = np.uint8(min(max(row[k] + np.float32(0.5), least), most))


@njit(cache=True, nogil=True)
def _filter_columns(image, first, end):
    """Turns columns `first` to `end` of an image (H, n) into a cubic spline's coefficients, mirrored at its ends.

    With the pole p they are 6 times those of 1 / (1 - p z^-1), then of -p / (1 - p z) (Unser et al. 1993).
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
    """The same along rows `first` to `end` of an image (H, 3 W)."""
    for v in range(first, end):
        _filter_columns(image[v].reshape(-1, 3), 0, 3)


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(inverse, places, shift, out, first, end):
    rows, cols = inverse.shape
    for v in range(first, end):
        for u in range(out.shape[1]):
            x, y = places[v, u, 0], places[v, u, 1]
            for _ in range(MEETINGS):
                col = min(max(int(np.floor(x)), 0), cols - 2)
                row = min(max(int(np.floor(y)), 0), rows - 2)
                s = min(max(x - np.float32(col), np.float32(0.0)), np.float32(1.0))
                t = min(max(y - np.float32(row), np.float32(0.0)), np.float32(1.0))
                above = inverse[row, col] + s * (inverse[row, col + 1] - inverse[row, col])
                below = inverse[row + 1, col] + s * (inverse[row + 1, col + 1] - inverse[row + 1, col])
                nearness = above + t * (below - above)
                was_x, was_y = x, y
                x = places[v, u, 0] + shift[v, u, 0] * nearness
                y = places[v, u, 1] + shift[v, u, 1] * nearness
                if abs(x - was_x) + abs(y - was_y) < np.float32(MET_PX):
                    break
            out[v, u, 0], out[v, u, 1] = x, y
