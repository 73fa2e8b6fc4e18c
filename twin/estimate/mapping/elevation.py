"""Fusion of height patches into the elevation map by a Kalman filter of each cell."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import ElevationMap, HeightVariances, Image, Map, MapGrid, Mask
from twin.estimate.mapping.depth_filter import GATE
from twin.estimate.mapping.surface import HeightPatch
from twin.estimate.mapping.visibility import hidden, main_surface
from twin.kernels import kernel

#: The higher of two hypotheses is chosen if the depth variance of the lower one is more than this many times larger.
_VARIANCE_RATIO = 10.0
_WRONG_CHOICE = 0.16  # measured probability that the chosen hypothesis of a cell with two hypotheses is wrong
#: Height error / (roughness * lateral error in cells) where the matching window smooths steps and ridges; measured in
#: 12 surveys, over two reefs and corals on a floor, with four rigs. A smoothed step is a ramp: its errors are up to
#: half its height, but its heights differ little from cell to cell.
_SMOOTHING = 5.0
_NEIGHBOURS_AT_CORNER = 3  # of a cell at a right-angled corner of a step, on its own side (at a straight step: 5)
MIN_CELLS = 12
_NEIGHBOURS = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2))  # rows and columns in 3 x 3 cells
_SUPPORT = 3  # a cell is supported by this many neighbours of agreeing height (`_contradicted`)


class ElevationMapper:
    """Fuses height patches into the cells of a grid. Memory depends on the grid only, not on the length of the survey.

    A cell keeps up to two hypotheses, because a steep cell is measured at its lower edge in one view and at its upper
    edge in another. A height z of variance R updates the best-fitting hypothesis h of variance P if (z - h)^2 < GATE (P
    + R). Otherwise it becomes another one, or replaces the one with the larger depth variance if its own is smaller.
    The lower one is the result unless the higher one has less than a tenth of its depth variance (right in 84 % of the
    cells of the horseshoe reef) or too few neighbours support it. Hypotheses that their last camera cannot have seen
    are dropped (`visibility`), and cells that contradict all neighbours have no result.

    The depth variance is independent between patches; the variance of pose and smoothing is common to them, so it is
    averaged. The result adds the variance of the choice between hypotheses, and that of steps and ridges, which the
    matching window smooths: the square of `_SMOOTHING` times the standard deviation of the lateral error, in cells,
    times the largest roughness within two cells. Smoothing is the same in two surveys of a floor; what differs is, with
    f the standard deviation of the lateral error per two cells, f^2 times the squared range of heights around the cell
    and f times the squared step across it if larger than a cell.
    """

    def __init__(self, grid: MapGrid):
        shape = (grid.rows, grid.cols)
        self.grid = grid
        self._height = np.full((2, *shape), np.nan, np.float32)
        self._variance = np.full((2, *shape), np.inf, np.float32)
        self._systematic, self._pose = np.zeros((2, 2, *shape), np.float32)  # and its part due to the poses
        self._camera = np.full((2, *shape), -1, np.int32)  # index in `_cameras_m` of the last measurement
        self._cameras_m: list[Array] = []
        self._colour = np.zeros((*shape, 4), np.float32)
        self._lateral_m: list[float] = [0.0, 0.0]  # sum and number of the lateral errors of the patches

    def fuse(self, patch: HeightPatch, successor: HeightPatch | None = None, inherited: Mask | None = None) -> None:
        """Fuses those cells of a patch into the map that were not propagated to the next keyframe."""
        # propagated: the successor (patch of the next keyframe) has an agreeing height at a pixel whose depth contains
        # information from this keyframe (`inherited` (H, W))
        self._lateral_m = [self._lateral_m[0] + patch.lateral_m, self._lateral_m[1] + 1]
        height = patch.height_m
        if successor is not None and inherited is not None:
            height = height.copy()
            _remove_propagated(*patch[:5], *successor[:6], inherited, GATE, height)
        camera = -1 if patch.camera_m is None else len(self._cameras_m)
        if patch.camera_m is not None:
            self._cameras_m.append(patch.camera_m)
        pose_m2 = patch.systematic_m2 if patch.pose_m2 is None else patch.pose_m2
        layers = self._height, self._variance, self._systematic, self._pose, self._camera
        _fuse_cells(patch.row, patch.col, height, *patch[3:5], pose_m2, camera, GATE, *layers)

    def add_colours(self, patch: HeightPatch, rgb: Image, gain: Map) -> None:
        """Adds an image, times its gain (H, W, 3), to the orthomosaic; weights decrease from the image centre."""
        _add_colours(patch.row, patch.col, patch.height_m, patch.pixel, rgb, gain, self._colour)

    def _choice(self) -> NDArray[np.int64]:
        low, high = np.argsort(self._height, axis=0)[:, None]
        precise = _taken(self._variance, high) * _VARIANCE_RATIO < _taken(self._variance, low)
        chosen = np.where(np.isfinite(_taken(self._height, high)) & precise, high, low)
        isolated = _isolated(_taken(self._height, chosen), _taken(self._height, 1 - chosen))
        return np.where(isolated, 1 - chosen, chosen)

    def _drop_hidden(self) -> None:
        """Drops hypotheses in small groups that their cameras cannot have seen behind large groups of chosen ones."""
        chosen, surface = self._choice(), None
        for which in (chosen, 1 - chosen):
            height = _taken(self._height, which)
            variance = _taken(self._variance, which) + _taken(self._systematic, which) + self.grid.cell_m**2
            large = main_surface(height, variance)
            surface = surface or (np.where(large, height, np.float32(np.nan)), variance)
            island = np.where(large, np.float32(np.nan), height)
            dropped = hidden(island, _taken(self._camera, which), np.array(self._cameras_m), surface, self.grid)
            for layers, unknown in ((self._height, np.nan), (self._variance, np.inf)):
                kept = np.where(dropped, np.float32(unknown), _taken(layers, which))
                np.put_along_axis(layers, which, kept[None], 0)

    def result(self) -> ElevationMap:
        self._drop_hidden()
        chosen, gap = self._choice(), self._height.max(axis=0) - self._height.min(axis=0)
        height, variance, systematic, pose = (
            _taken(layers, chosen) for layers in (self._height, self._variance, self._systematic, self._pose)
        )
        height[_small_groups(np.isfinite(height))] = np.nan
        lateral_m = self._lateral_m[0] / max(self._lateral_m[1], 1)
        fraction = lateral_m / (2 * self.grid.cell_m)
        height[_contradicted(height, variance + systematic + self.grid.cell_m**2, fraction)] = np.nan
        roughness_m = cv2.dilate(_roughness(height), np.ones((5, 5), np.uint8))
        smoothing_m2 = (_SMOOTHING * lateral_m / self.grid.cell_m * roughness_m) ** 2
        step_m, relief_m = _step(height), _relief(height)
        moved_m2 = fraction * np.where(step_m > self.grid.cell_m, step_m, 0) ** 2 + (fraction * relief_m) ** 2
        choice_m2 = _WRONG_CHOICE * (1 - _WRONG_CHOICE) * np.nan_to_num(gap) ** 2
        sigma = np.sqrt(variance + systematic + smoothing_m2 + choice_m2)
        sigma = np.where(np.isnan(height), np.nan, sigma).astype(np.float32)
        weight = self._colour[..., 3:]
        mosaic = np.divide(self._colour[..., :3], weight, out=np.zeros_like(self._colour[..., :3]), where=weight > 0)
        found = ElevationMap(self.grid, height, sigma, np.clip(mosaic + 0.5, 0, 255).astype(np.uint8))
        found.common_m2 = (smoothing_m2 - moved_m2).astype(np.float32)
        if (typical := found.typical).any():
            parts = variance, pose, systematic - pose + smoothing_m2 + choice_m2
            found.variances = HeightVariances(*(float(part[typical].mean()) for part in parts))
        return found


def _taken(layers: NDArray[Any], which: NDArray[np.int64]) -> Any:
    """Returns the layer (rows, cols) of the hypotheses with the indices `which` (1, rows, cols)."""
    return np.take_along_axis(layers, which, 0)[0]


def _isolated(height: Map, other: Map) -> Mask:
    """Returns a mask (rows, cols) of the cells whose neighbours support the other hypothesis, not the chosen one."""
    # of at least five known neighbours, few are nearer to `height`: usually a mismatch
    around = np.lib.stride_tricks.sliding_window_view(np.pad(height, 1, constant_values=np.nan), (3, 3))
    known, agreeing = np.zeros(height.shape, np.int8), np.zeros(height.shape, np.int8)
    for i, j in _NEIGHBOURS:
        neighbour = around[..., i, j]
        known += np.isfinite(neighbour)
        agreeing += np.abs(neighbour - height) <= np.abs(neighbour - other)
    return np.isfinite(other) & (known >= 5) & (agreeing < _NEIGHBOURS_AT_CORNER)


def _small_groups(known: Mask) -> Mask:
    """Returns a mask of known cells in groups of fewer than `MIN_CELLS`, usually mismatches at image borders."""
    _, label, stats, _ = cv2.connectedComponentsWithStats(known.astype(np.uint8), connectivity=8)
    small = np.asarray(stats)[:, cv2.CC_STAT_AREA] < MIN_CELLS
    return known & small[np.asarray(label, np.int64)]


def _contradicted(height: Map, variance: Map, edge_fraction: float) -> Mask:
    """Returns a mask (rows, cols) of the known cells, alone or in twos and threes, that contradict their neighbours."""
    # heights h and k agree if (h - k)^2 < GATE (P + Q + E), with their variances P and Q, and E the square of
    # `edge_fraction` times the range of the neighbours without the two highest and lowest (only for cells that are not
    # supported without it); supported are cells with `_SUPPORT` agreeing neighbours, or one that is supported so
    rows, cols = height.shape
    near, near_variance = (np.pad(layer, 1, constant_values=np.nan) for layer in (height, variance))
    n_agreeing = np.zeros(height.shape, np.int8)
    for i, j in _NEIGHBOURS:
        other, other_variance = (layer[i : i + rows, j : j + cols] for layer in (near, near_variance))
        n_agreeing += (height - other) ** 2 < GATE * (variance + other_variance)  # False where unknown
    supported = np.pad(n_agreeing >= _SUPPORT, 1)
    row, col = np.nonzero(np.isfinite(height) & (n_agreeing < _SUPPORT))
    around = tuple(np.array([(row + i, col + j) for i, j in _NEIGHBOURS]).transpose(1, 2, 0))  # (n, 8) each
    relief = _trimmed_range(near[around])
    spread = variance[row, col] + (edge_fraction * relief) ** 2
    agrees = (height[row, col, None] - near[around]) ** 2 < GATE * (spread[:, None] + near_variance[around])
    supported[row + 1, col + 1] = agrees.sum(axis=1) >= _SUPPORT
    left = ~supported[row + 1, col + 1] & ~(agrees & supported[around]).any(axis=1)
    left &= (np.isfinite(near[around]) & ~agrees).any(axis=1)
    contradicted = np.zeros(height.shape, np.bool_)
    contradicted[row[left], col[left]] = True
    return contradicted


def _trimmed_range(heights: Map) -> Map:
    """Returns the range (n,) of the known heights (n, 8) without the two highest and lowest; 0 with fewer than six."""
    ordered, known = np.sort(heights, axis=1), np.isfinite(heights).sum(axis=1)  # NaN last
    highest = np.take_along_axis(ordered, np.maximum(known - 3, 0)[:, None], axis=1)[:, 0]
    return np.where(known >= 6, highest - ordered[:, 2], np.float32(0))


def _relief(height: Map) -> Map:
    """Returns the range (rows, cols) of the known heights in 3 x 3 cells [m]; 0 without one."""
    block, far = np.ones((3, 3), np.uint8), np.float32(1e6)
    high, low = (np.where(np.isnan(height), limit, height) for limit in (-far, far))
    return np.maximum(cv2.dilate(high, block) - cv2.erode(low, block), 0)


def _step(height: Map) -> Map:
    """Returns the largest absolute second difference (rows, cols) of height in four directions [m]; 0: unknown."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(height, 1, constant_values=np.nan), (3, 3))
    pairs = ((around[..., i, j], around[..., 2 - i, 2 - j]) for i, j in _NEIGHBOURS[:4])
    return np.nan_to_num(np.fmax.reduce([np.abs(one + other - 2 * height) for one, other in pairs]))


def _roughness(height: Map) -> Map:
    """Returns the RMS distance (rows, cols) of the heights of 3 x 3 cells from their plane [m]; 0 with unknown ones."""
    known = np.isfinite(height)
    z, one, across = np.where(known, height, 0).astype(np.float64), np.ones(3), np.array([-1.0, 0, 1])
    mean, right, up = (cv2.sepFilter2D(z, -1, *weights) for weights in ((one / 9, one), (across, one), (one, across)))
    square = cv2.sepFilter2D(z**2, -1, one / 9, one) - mean**2 - (right**2 + up**2) / 54
    complete = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    return np.where(complete, np.sqrt(np.maximum(square, 0)), 0)


@kernel
def _remove_propagated(
    row, col, height, variance, systematic, new_row, new_col, new_height, new_variance, new_systematic, pixel,
    inherited, gate, remaining,
):  # fmt: skip
    """Sets the cells of `remaining` that were propagated to the next keyframe to NaN (see `ElevationMapper.fuse`)."""
    for i in range(max(row, new_row), min(row + height.shape[0], new_row + new_height.shape[0])):
        for j in range(max(col, new_col), min(col + height.shape[1], new_col + new_height.shape[1])):
            a, b, c, e = i - row, j - col, i - new_row, j - new_col
            if not inherited[int(pixel[c, e, 1] + 0.5), int(pixel[c, e, 0] + 0.5)]:
                continue
            total = variance[a, b] + new_variance[c, e] + systematic[a, b] + new_systematic[c, e]
            if (height[a, b] - new_height[c, e]) ** 2 < gate * total:
                remaining[a, b] = np.nan


@kernel
def _fuse_cells(
    row, col, height, variance, systematic, pose, camera, gate, heights, variances, systematics, poses, cameras
):  # fmt: skip
    """Kalman update of the cells' heights and variances with those of new patches."""
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            z = height[i, j]
            if np.isnan(z):
                continue
            r, q = variance[i, j], systematic[i, j]
            a, b = row + i, col + j
            best, best_fit = -1, gate
            for n in range(2):
                if np.isnan(heights[n, a, b]):
                    continue
                fit = (z - heights[n, a, b]) ** 2 / (variances[n, a, b] + r + systematics[n, a, b] + q)
                if fit < best_fit:
                    best, best_fit = n, fit
            if best < 0:
                worse = 0 if variances[0, a, b] >= variances[1, a, b] else 1
                if r < variances[worse, a, b]:
                    heights[worse, a, b], variances[worse, a, b], systematics[worse, a, b] = z, r, q
                    poses[worse, a, b], cameras[worse, a, b] = pose[i, j], camera
                continue
            p = variances[best, a, b]
            gain = p / (p + r)
            heights[best, a, b] += gain * (z - heights[best, a, b])
            systematics[best, a, b] += gain * (q - systematics[best, a, b])
            poses[best, a, b] += gain * (pose[i, j] - poses[best, a, b])
            variances[best, a, b], cameras[best, a, b] = p * r / (p + r), camera


@kernel
def _add_colours(row, col, height, pixel, rgb, gain, colour):
    """Adds the weighted colour of each cell with a height to `colour` (rows, cols, 4): R, G, B and the weight."""
    rows, cols = rgb.shape[0] - 1, rgb.shape[1] - 1
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            if np.isnan(height[i, j]):
                continue
            x, y = pixel[i, j, 0], pixel[i, j, 1]
            u, v = min(int(x), cols - 1), min(int(y), rows - 1)
            s, t = x - u, y - v
            radius2 = (2 * x / cols - 1) ** 2 + (2 * y / rows - 1) ** 2
            weight = np.exp(-4 * radius2) + 1e-4
            for k in range(3):
                top = (1 - s) * rgb[v, u, k] * gain[v, u, k] + s * rgb[v, u + 1, k] * gain[v, u + 1, k]
                bottom = (1 - s) * rgb[v + 1, u, k] * gain[v + 1, u, k]
                bottom += s * rgb[v + 1, u + 1, k] * gain[v + 1, u + 1, k]
                colour[row + i, col + j, k] += weight * ((1 - t) * top + t * bottom)
            colour[row + i, col + j, 3] += weight
