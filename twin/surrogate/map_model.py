"""Model of the elevation map: the grid cells that a keyframe sees, and samples of the heights that it contributes.

The heights stand for those from the Kalman depth filter, with one sample per grid cell for all pixels that show the
cell. Their standard deviations are those of `height_errors`; errors are correlated over about a matching window, as
those of dense matching are. A cell is visible if its centre projects into both images and no relief hides it from
either camera (ray casting).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, uniform_filter

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_pixels
from twin.core.quality import CalibrationEstimate
from twin.core.records import MapGrid, StereoRig
from twin.estimate.mapping import surface
from twin.estimate.mapping.surface import HeightPatch
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.floor_relief import Map, floor_relief
from twin.surrogate.height_errors import CellConditions, HeightSigmas, KeyframeRuns, cell_conditions, height_sigmas
from twin.surrogate.matchability import Matchability
from twin.surrogate.measured_view import IDEAL_VIEW, MeasuredView
from twin.world.observed_cells import DEPTH_TOLERANCE

Index = NDArray[np.int64]
#: Side of the square over which errors are correlated, in matching windows: dense matching is regularised, and the
#: depth filter passes depths on from keyframe to keyframe.
_CORRELATED_WINDOWS = 1.5
#: Rise over run of a line from a cell; floor below this line is taken not to hide the cell. This is exact for rays that
#: are at most 45 deg from the vertical.
_HIDING_SLOPE = 1.0


class ObservedCells(NamedTuple):
    """The n cells that both cameras of a keyframe see."""

    cells: Index  #: (n,) numbers of the cells, row by row
    depth_m: Array  #: (n,) depth of the floor point that is mapped to each cell
    border_px: Array  #: (n,) distance of this point from the nearest border of the two images
    information: Array  #: (n,) 1 / r^2 for `PositionDependence.bounds` r at its position in the left image
    true: Array  #: (4, 4) true pose of the keyframe
    estimated: Array  #: (4, 4) estimated pose of the keyframe


class MapNoise(NamedTuple):
    """Random numbers of the errors of a map that all views of a cell share; (rows, cols) each."""

    lateral: Map  #: standard normal numbers
    relief: Map  #: standard normal numbers, correlated as `window_noise`
    edge: Map  #: `heavy_tailed` numbers
    scatter: Map  #: standard normal numbers of the logarithm of the noise, correlated as `window_noise`
    dropout: Map  #: uniform numbers in [0, 1): a cell has no depth if its number exceeds `HeightSigmas.known`
    level: float  #: ratio of true to reported noise of the whole map


class MapModel:
    """Samples the height patch of each keyframe: true heights of the floor plus errors.

    Args:
        height_m: (rows, cols) true height at the cell centres.
        rig: believed calibration, at the scale of the matched images.
        floor: the true floor, for ray casting.

    Attributes:
        seen: (rows, cols) mask of the cells that at least one keyframe observed; updated by `mark_seen`.
        conditions: conditions of the latest height of each cell, (rows * cols,) each.
        n_heights: (rows * cols,) number of heights that were fused into the cell.
    """

    def __init__(
        self, grid: MapGrid, height_m: Map, rig: StereoRig, floor: HeightField, matchability: Matchability,
        view: MeasuredView = IDEAL_VIEW,
    ):  # fmt: skip
        self.grid, self.height_m, self.seen = grid, height_m, np.zeros(height_m.shape, np.bool_)
        self._rig, self._floor, self._matchability, self._view = rig, floor, matchability, view
        self.relief = floor_relief(height_m, grid.cell_m, rig, matchability.medium_depth_m)
        self._may_be_hidden = _may_be_hidden(height_m, grid.cell_m).ravel()
        self._information = 1 / np.square(matchability.dependence.bounds)
        self._baseline_m = rig.baseline_m  # that of self-calibration
        self._lowest_m = float(np.nanmin(height_m))
        self.conditions = CellConditions(*np.zeros((len(CellConditions._fields), height_m.size)))
        self.n_heights = np.zeros(height_m.size, np.int64)
        # of the consecutive keyframes up to the current one
        self._views, self._squared_steps, self._border_px, self._sum = np.zeros((4, height_m.size))

    @property
    def correlated_cells(self) -> int:
        return max(round(_CORRELATED_WINDOWS * self.relief.window_cells), 1)

    def new_noise(self, model: ErrorModel, rng: np.random.Generator) -> MapNoise:
        """Returns random numbers of the errors of a map, and forgets the keyframes of earlier maps."""
        for values in (self._views, self._squared_steps, self._border_px, self._sum, self.n_heights):
            values[:] = 0
        shape, cells = self.height_m.shape, self.correlated_cells
        lateral, dropout = rng.standard_normal(shape, np.float32), rng.random(shape, np.float32)
        relief, scatter, edge = (window_noise(shape, cells, rng) for _ in range(3))
        level = float(np.exp(model.survey_scatter * rng.standard_normal()))
        return MapNoise(lateral, relief, heavy_tailed(edge), scatter, dropout, level)

    def calibrate(self, found: CalibrationEstimate) -> None:
        """Corrects the heights of the next map for errors of the calibration that were found."""
        self._view = self._view.without_yaw(found.yaw_rad)
        self._baseline_m = self._rig.baseline_m * (1 + found.baseline_error)

    def mark_seen(self, world_from_camera: Array) -> None:
        """Marks the cells that both cameras see from the true pose (4, 4) of a keyframe."""
        index = self._in_reach(world_from_camera)
        index = index[~self.seen.ravel()[index]]
        visible, _ = self._seen_from(world_from_camera, index, self._centres(index))
        self.seen.ravel()[visible] = True

    def observe(self, true: Array, estimated: Array) -> ObservedCells:
        """Returns the cells that a keyframe with a true and an estimated pose (4, 4) observes.

        With calibration errors or an approximated port, the estimated pose determines which point is mapped to a cell.
        """
        index = self._in_reach(true)
        visible, points = self._seen_from(true, index, self._sources(true, estimated, index))
        measured = self._view.measure(points)
        rig, table = self._rig, self._information
        pixels = measured[:, :2] * rig.focal_px + [rig.cx_px, rig.cy_px]
        blocks = (pixels + 0.5) / [rig.width_px, rig.height_px] * table.shape[::-1] - 0.5
        information = map_coordinates(table, blocks.T[::-1], order=1, mode="nearest")
        depth_m, border_px = rig.baseline_m / points[:, 2], _border_px(measured, rig)
        return ObservedCells(visible, depth_m, border_px, information, true, estimated)

    def sample_patch(
        self,
        observed: ObservedCells,
        following: ObservedCells | None,
        cov: Array,
        model: ErrorModel,
        noise: MapNoise,
        rng: np.random.Generator,
    ) -> HeightPatch | None:
        """Samples the heights of the cells that a keyframe sees and the next one does not; None if it sees none.

        The keyframes must be passed in the order of the path: the consecutive keyframes that observed a cell determine
        the standard deviation of its height and whether it has one.

        Args:
            following: cells that the next keyframe observes; None for the last one.
            cov: (6, 6) covariance of the estimated pose, in camera axes.

        Raises:
            FloatingPointError: a height or a variance is not finite.
        """
        if not len(observed.cells):
            return None
        index, cells = self._end_runs(observed, following)
        sigmas = height_sigmas(model, cells)
        known = noise.dropout.ravel()[index] <= sigmas.known
        index, lateral_m = index[known], surface.LATERAL_SIGMA_PX * cells.lateral_m[known]
        sigmas = HeightSigmas(*(values[known] for values in sigmas))
        row, col, shape = self._window(observed.cells)
        i, k = index // self.grid.cols - row, index % self.grid.cols - col
        typical_m = sigmas.noise_m * np.exp(sigmas.scatter * noise.scatter.ravel()[index])
        error = noise.level * typical_m * window_noise(shape, self.correlated_cells, rng)[i, k]
        for sigma_m, normal in (
            (sigmas.relief_m, noise.relief), (sigmas.edge_m, noise.edge), (sigmas.lateral_m, noise.lateral),
        ):  # fmt: skip
            error += sigma_m * normal.ravel()[index]
        height, variance, systematic = np.full((3, *shape), np.nan, np.float32)
        height[i, k] = self._heights(observed, index) + error
        variance[i, k] = typical_m**2
        systematic[i, k] = self._pose_variances(observed.estimated, cov, index) + lateral_m**2
        if not np.isfinite(np.stack([values[i, k] for values in (height, variance, systematic)])).all():
            raise FloatingPointError("the error model gives a height or a variance that is not finite")
        pixel, mean_depth_m = np.zeros((*shape, 2), np.float32), float(observed.depth_m.mean())
        lateral = surface.LATERAL_SIGMA_PX * mean_depth_m / self._rig.focal_px
        return HeightPatch(row, col, height, variance, systematic, pixel, lateral)

    def _end_runs(self, observed: ObservedCells, following: ObservedCells | None) -> tuple[Index, CellConditions]:
        """Adds a keyframe to the runs of its cells; returns those that the next one does not see, with conditions."""
        index = observed.cells
        self._views[index] += 1
        self._border_px[index] = np.maximum(self._border_px[index], observed.border_px)
        self._sum[index] += observed.information
        ended = np.ones(len(index), np.bool_)
        if following is not None:
            ended = ~np.isin(index, following.cells, assume_unique=True)
            step_m = float(np.linalg.norm(following.true[:3, 3] - observed.true[:3, 3]))
            self._squared_steps[index[~ended]] += (step_m / self._rig.baseline_m) ** 2
        last = index[ended]
        number = self._views[last]
        step = np.sqrt(self._squared_steps[last] / np.maximum(number - 1, 1))
        bound_ratio = np.sqrt(number / self._sum[last])
        views = KeyframeRuns(observed.depth_m[ended], number, step, self._border_px[last], bound_ratio)
        cells = cell_conditions(self._matchability, self._rig, self.relief, last, views)
        for kept, new in zip(self.conditions, cells, strict=True):
            kept[last] = new
        self.n_heights[last] += 1
        for values in (self._views, self._squared_steps, self._border_px, self._sum):
            values[last] = 0
        return last, cells

    def _heights(self, observed: ObservedCells, index: Index) -> Array:
        """Returns the heights (n,) of the cells without errors of measurement, mapped from the estimated pose."""
        slope, centres = self.relief.slope.reshape(-1, 2)[index], self._centres(index)
        sources = self._sources(observed.true, observed.estimated, index)
        mapped = self._mapped(observed.true, observed.estimated, sources)
        return mapped[:, 2] - np.einsum("nk,nk->n", slope, mapped[:, :2] - centres[:, :2])

    def _pose_variances(self, estimated: Array, cov: Array, index: Index) -> Array:
        """Returns the variances (n,) of the heights due to the error of a pose; see `surface.pose_variance`."""
        rotation = geometry.adjoint(geometry.pose(estimated[:3, :3], np.zeros(3)))
        slope, points = self.relief.slope.reshape(-1, 2)[index], self._centres(index) - estimated[:3, 3]
        normal = np.column_stack([-slope, np.ones(len(index))])
        jacobian = np.hstack([np.cross(points, normal), normal]) @ rotation
        return np.einsum("ni,ij,nj->n", jacobian, cov, jacobian)

    def _window(self, index: Index) -> tuple[int, int, tuple[int, int]]:
        rows, cols = index // self.grid.cols, index % self.grid.cols
        return int(rows[0]), int(cols.min()), (int(rows[-1] - rows[0]) + 1, int(np.ptp(cols)) + 1)

    def _centres(self, index: Index) -> Array:
        """Returns the true floor points (n, 3) at the centres of cells."""
        x, y = self.grid.centres()
        heights = self.height_m.ravel()[index].astype(np.float64)
        return np.column_stack([x[index % self.grid.cols], y[index // self.grid.cols], heights])

    def _sources(self, true: Array, estimated: Array, index: Index) -> Array:
        """Returns the true floor points (n, 3) that are mapped to cells: their centres minus the mapping errors."""
        centres = self._centres(index)
        if self._view.is_ideal:
            return centres
        shift = self._mapped(true, estimated, centres)[:, :2] - centres[:, :2]
        slope = self.relief.slope.reshape(-1, 2)[index]
        return centres - np.column_stack([shift, np.einsum("nk,nk->n", slope, shift)])

    def _mapped(self, true: Array, estimated: Array, points: Array) -> Array:
        """Returns the estimated positions (n, 3) of world points (n, 3) seen from a true pose."""
        measured = self._view.measure(self._normalised(true, points))
        depth_m = self._baseline_m / measured[:, 2:]
        return geometry.transform(estimated, np.column_stack([measured[:, :2], np.ones(len(points))]) * depth_m)

    def _normalised(self, true: Array, points: Array) -> Array:
        """Returns the normalised (x, y, disparity) (n, 3) of world points (n, 3) in front of the left camera."""
        seen = geometry.transform(geometry.inverse(true), points)
        return np.column_stack([seen[:, :2], np.full(len(seen), self._rig.baseline_m)]) / seen[:, 2:]

    def _seen_from(self, true: Array, index: Index, points: Array) -> tuple[Index, Array]:
        """Returns the cells whose floor points (n, 3) both cameras see, and the points as normalised (m, 3)."""
        front = geometry.transform(geometry.inverse(true), points)[:, 2] > 0
        index, normalised = index[front], self._normalised(true, points[front])
        inside = _border_px(self._view.measure(normalised), self._rig) >= 0
        index, normalised = index[inside], normalised[inside]
        visible, doubtful = np.ones(len(index), np.bool_), np.flatnonzero(self._may_be_hidden[index])
        visible[doubtful] = ~self._are_hidden(true, normalised[doubtful])
        return index[visible], normalised[visible]

    def _are_hidden(self, true: Array, normalised: Array) -> NDArray[np.bool_]:
        """Returns whether relief hides floor points, normalised (n, 3), from either camera."""
        rig, hidden = self._rig, np.zeros(len(normalised), np.bool_)
        for to_camera_m, shift in ((0.0, 0.0), (rig.baseline_m, normalised[:, 2])):
            camera = geometry.compose(true, geometry.pose(np.eye(3), np.array([to_camera_m, 0.0, 0.0])))
            directions = np.column_stack([normalised[:, 0] - shift, normalised[:, 1]])
            pixels = directions * rig.focal_px + [rig.cx_px, rig.cy_px]
            met_m = cast_pixels(self._floor, camera[None], rig, pixels)[0]
            hidden |= met_m < (1 - DEPTH_TOLERANCE) * rig.baseline_m / normalised[:, 2]
        return hidden

    def _in_reach(self, world_from_camera: Array) -> Index:
        """Returns the cells in the bounding box of the lowest floor in the left image; all if it shows the horizon."""
        rig, grid = self._rig, self.grid
        corners = np.array([[u, v] for u in (-0.5, rig.width_px - 0.5) for v in (-0.5, rig.height_px - 0.5)])
        rays = np.column_stack([rig.normalised(corners), np.ones(4)]) @ world_from_camera[:3, :3].T
        if rays[:, 2].max() >= -0.1:
            return np.arange(self.height_m.size)
        position = world_from_camera[:3, 3]
        far = position[:2] + rays[:, :2] * ((self._lowest_m - position[2]) / rays[:, 2:])
        (west, south), (east, north) = (f(np.vstack([far, position[None, :2]]), axis=0) for f in (np.min, np.max))
        rows = np.clip(((grid.north_m - np.array([north, south])) / grid.cell_m).astype(int) + [-1, 2], 0, grid.rows)
        cols = np.clip(((np.array([west, east]) - grid.west_m) / grid.cell_m).astype(int) + [-1, 2], 0, grid.cols)
        return (np.arange(*rows)[:, None] * grid.cols + np.arange(*cols)).ravel()


def window_noise(shape: tuple[int, int], window_cells: int, rng: np.random.Generator) -> Map:
    """Returns standard normal numbers (rows, cols) that are correlated over a square window, as matching errors are.

    Their standard deviation exceeds 1 if the array has fewer rows or columns than the window.
    """
    noise = rng.standard_normal(shape, np.float32)
    return np.asarray(uniform_filter(noise, window_cells, mode="wrap") * window_cells, np.float32)


def heavy_tailed(noise: Map) -> Map:
    """Returns n |n| / sqrt(3), of unit variance: heavy tails, because cells near a wall may match the wrong surface."""
    return np.asarray(noise * np.abs(noise) / np.float32(np.sqrt(3)), np.float32)


def _border_px(points: Array, rig: StereoRig) -> Array:
    """Returns the distances (n,) of normalised (x, y, disparity) (n, 3) from the border of the two images [px]."""
    u, v = (points[:, :2] * rig.focal_px + [rig.cx_px, rig.cy_px]).T
    u_right = u - rig.focal_px * points[:, 2]
    return np.min([v, rig.height_px - 1 - v, rig.width_px - 1 - u, u_right], axis=0)


def _may_be_hidden(height_m: Map, cell_m: float) -> NDArray[np.bool_]:
    """Returns the mask (rows, cols) of the cells that relief may hide from a camera; no rays are cast for others."""
    height = np.where(np.isfinite(height_m), height_m, np.nanmin(height_m))
    hidden, radius, relief_m = np.zeros(height.shape, np.bool_), 1, float(np.ptp(height))
    while radius * cell_m * _HIDING_SLOPE < relief_m:
        hidden |= maximum_filter(height, 4 * radius + 1) - height > radius * cell_m * _HIDING_SLOPE
        radius *= 2
    return hidden
