"""The composite map (parts P18 to P20 of the method): what the filter retires, fused cell by cell."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.records import ElevationMap, Image, MapGrid
from twin.estimate.mapping.depth_filter import GATE, Mask
from twin.estimate.mapping.surface import Patch

Map = NDArray[np.float32]

#: The higher of two hypotheses stands if its variance is so many times smaller.
_SURER = 10.0
#: How often the one that stands is wrong.
_DOUBT = 0.16
#: Fewer cells that touch no others are no surface.
LEAST_CELLS = 12


class ElevationMapper:
    """Fuses patches into the cells of a grid; memory is that of the grid, however long the survey.

    A cell keeps up to two hypotheses of its height (a steep cell is seen now at the foot, now at the edge): each patch
    updates the one that fits best if it passes its gate (z - h)^2 < GATE (P + R), or opens the second, or replaces the
    weaker if it knows more. The lower one is the result unless the higher is far better known: windows of matching
    carry the edge of what is near over what lies behind it. Of the cells of the horseshoe reef with two hypotheses the
    lower was right in 82 %, the better known in 67 %, this rule in 84 %.

    Variance has two parts. That of depth is independent from map to map and shrinks with each fusion. That of the pose
    and of smoothed slopes is shared by all cells of a leg, and largely by all legs: it is carried beside as the
    weighted mean of what came in, so it never averages away. To their sum the result adds the lateral error times the
    relief around the cell, and what may be on the wrong side of an edge: a share of the squared step, which for a step
    of more than a cell is that of the lateral error in the cell. Without it the 1 % of cells at the reef's edges that
    show the other side made sigma 1.9 times too small over all.
    """

    def __init__(self, grid: MapGrid):
        shape = (grid.rows, grid.cols)
        self.grid = grid
        self._height = np.full((2, *shape), np.nan, np.float32)
        self._variance = np.full((2, *shape), np.inf, np.float32)
        self._common = np.zeros((2, *shape), np.float32)
        self._colour = np.zeros((*shape, 4), np.float32)
        self._lateral_m: list[float] = [0.0, 0.0]  # sum, count

    def retire(self, patch: Patch, successor: Patch | None = None, taken: Mask | None = None) -> None:
        """Fuses the cells of a patch that its successor, the patch of the next keyframe, does not carry on.

        A cell is carried on where the successor covers it with a pixel that took old information in (`taken`) and
        whose height agrees: so what is known of a cell enters the map once, and none is lost between two patches.
        """
        self._lateral_m = [self._lateral_m[0] + patch.lateral_m, self._lateral_m[1] + 1]
        height = patch.height_m
        if successor is not None and taken is not None:
            height = height.copy()
            _strike_carried(*patch[:5], *successor[:6], taken, GATE, height)
        _fuse_cells(patch.row, patch.col, height, *patch[3:5], GATE, self._height, self._variance, self._common)

    def add_colours(self, patch: Patch, rgb: Image, gain: Map) -> None:
        """Adds the image to the mosaic: a weighted mean that prefers what lies near the middle of the image."""
        _paint(patch.row, patch.col, patch.height_m, patch.pixel, rgb, gain, self._colour)

    def result(self) -> ElevationMap:
        """The likelier hypothesis of every cell, its standard deviation and the mosaic."""
        (low, high), gap = np.argsort(self._height, axis=0), self._height.max(axis=0) - self._height.min(axis=0)
        of_low, of_high = (np.take_along_axis(self._variance, which[None], 0)[0] for which in (low, high))
        chosen = np.where(np.isfinite(gap) & (of_high * _SURER < of_low), high, low)[None]
        height, variance, common = (
            np.take_along_axis(layers, chosen, 0)[0] for layers in (self._height, self._variance, self._common)
        )
        height[_islands(np.isfinite(height))] = np.nan
        step = _step(height)
        lateral_m = self._lateral_m[0] / max(self._lateral_m[1], 1)
        share = lateral_m / (2 * self.grid.cell_m)
        edge_m2 = (share * _relief(height)) ** 2 + share * np.where(step > self.grid.cell_m, step, 0) ** 2
        doubt_m2 = _DOUBT * (1 - _DOUBT) * np.nan_to_num(gap) ** 2
        sigma = np.where(np.isnan(height), np.nan, np.sqrt(variance + common + edge_m2 + doubt_m2)).astype(np.float32)
        weight = self._colour[..., 3:]
        mosaic = np.divide(self._colour[..., :3], weight, out=np.zeros_like(self._colour[..., :3]), where=weight > 0)
        return ElevationMap(self.grid, height, sigma, np.clip(mosaic + 0.5, 0, 255).astype(np.uint8))


def _islands(known: Mask) -> Mask:
    """Groups of known cells too small to be a surface: mismatches at the rim of images."""
    _, label, stats, _ = cv2.connectedComponentsWithStats(known.astype(np.uint8), connectivity=8)
    small = np.asarray(stats)[:, cv2.CC_STAT_AREA] < LEAST_CELLS
    return known & small[np.asarray(label, np.int64)]


def _relief(height: Map) -> Map:
    """Highest minus lowest known height among the 3 x 3 cells around each [m]."""
    block = np.ones((3, 3), np.uint8)
    far = np.float32(1e6)
    high = cv2.dilate(np.where(np.isnan(height), -far, height), block)
    return np.maximum(high - cv2.erode(np.where(np.isnan(height), far, height), block), 0)


def _step(height: Map) -> Map:
    """By how much the surface departs from a plane across each cell: its largest second difference [m]."""
    step = np.zeros_like(height)
    inner, around = height[1:-1, 1:-1], np.lib.stride_tricks.sliding_window_view(height, (3, 3))
    for i, j in ((0, 1), (1, 0), (0, 0), (0, 2)):
        bend = np.abs(around[..., i, j] + around[..., 2 - i, 2 - j] - 2 * inner)
        np.fmax(step[1:-1, 1:-1], bend, out=step[1:-1, 1:-1])
    return step


@njit(cache=True, nogil=True)
def _strike_carried(
    row, col, height, variance, common, new_row, new_col, new_height, new_variance, new_common, pixel, taken, gate, left
):
    """Sets to NaN what the successor carries on."""
    for i in range(max(row, new_row), min(row + height.shape[0], new_row + new_height.shape[0])):
        for j in range(max(col, new_col), min(col + height.shape[1], new_col + new_height.shape[1])):
            a, b, c, e = i - row, j - col, i - new_row, j - new_col
            if not taken[int(pixel[c, e, 1] + 0.5), int(pixel[c, e, 0] + 0.5)]:
                continue
            spread = variance[a, b] + new_variance[c, e] + common[a, b] + new_common[c, e]
            if (height[a, b] - new_height[c, e]) ** 2 < gate * spread:
                left[a, b] = np.nan


@njit(cache=True, nogil=True)
def _fuse_cells(row, col, height, variance, common, gate, heights, variances, commons):
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            z = height[i, j]
            if np.isnan(z):
                continue
            r, q = variance[i, j], common[i, j]
            a, b = row + i, col + j
            best, least = -1, gate
            for n in range(2):
                if np.isnan(heights[n, a, b]):
                    continue
                fit = (z - heights[n, a, b]) ** 2 / (variances[n, a, b] + r + commons[n, a, b] + q)
                if fit < least:
                    best, least = n, fit
            if best < 0:
                weaker = 0 if variances[0, a, b] >= variances[1, a, b] else 1
                if r < variances[weaker, a, b]:
                    heights[weaker, a, b], variances[weaker, a, b], commons[weaker, a, b] = z, r, q
                continue
            p = variances[best, a, b]
            gain = p / (p + r)
            heights[best, a, b] += gain * (z - heights[best, a, b])
            commons[best, a, b] += gain * (q - commons[best, a, b])
            variances[best, a, b] = p * r / (p + r)


@njit(cache=True, nogil=True)
def _paint(row, col, height, pixel, rgb, gain, colour):
    rows, cols = rgb.shape[0] - 1, rgb.shape[1] - 1
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            if np.isnan(height[i, j]):
                continue
            x, y = pixel[i, j, 0], pixel[i, j, 1]
            u, v = min(int(x), cols - 1), min(int(y), rows - 1)
            s, t = x - u, y - v
            off = (2 * x / cols - 1) ** 2 + (2 * y / rows - 1) ** 2
            weight = np.exp(-4 * off) + 1e-4
            for k in range(3):
                top = (1 - s) * rgb[v, u, k] * gain[v, u, k] + s * rgb[v, u + 1, k] * gain[v, u + 1, k]
                low = (1 - s) * rgb[v + 1, u, k] * gain[v + 1, u, k] + s * rgb[v + 1, u + 1, k] * gain[v + 1, u + 1, k]
                colour[row + i, col + j, k] += weight * ((1 - t) * top + t * low)
            colour[row + i, col + j, 3] += weight
