"""Model of the elevation map: the grid cells that a keyframe sees, and samples of the heights that it contributes.

The heights stand for those from the Kalman depth filter, with one sample per grid cell for all pixels that show the
cell. Their standard deviations are those of `height_errors`; errors are correlated over about a matching window, as
those of dense matching are. A cell is visible if its centre projects into both images and no relief hides it from
either camera (ray casting).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import HeightField
from twin.core.quality import CalibrationEstimate
from twin.core.records import MapGrid, StereoRig
from twin.estimate.mapping import surface
from twin.estimate.mapping.surface import HeightPatch
from twin.surrogate import cell_view
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.floor_relief import Map, floor_relief
from twin.surrogate.height_errors import CellConditions, HeightSigmas, KeyframeRuns, cell_conditions, height_sigmas
from twin.surrogate.matchability import Matchability
from twin.surrogate.measured_view import IDEAL_VIEW, MeasuredView

Index = NDArray[np.int64]
#: Side of the square over which errors are correlated, in matching windows: dense matching is regularised, and the
#: depth filter passes depths on from keyframe to keyframe.
_CORRELATED_WINDOWS = 1.5
#: Rise over run of a line from a cell; floor below this line is taken not to hide the cell. This is exact for rays that
#: are at most 45 deg from the vertical.
_HIDING_SLOPE = 1.0

_NO_CELLS: Index = np.zeros(0, np.int64)


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
    """Samples the height patch of each keyframe: true heights (rows, cols) of the floor plus errors.

    `rig` is the believed calibration, at the scale of the matched images; rays are cast to the true `floor`. `seen`
    (rows, cols) masks the cells that at least one keyframe observed; updated by `mark_seen`. After `keep_conditions`,
    `conditions` are those of the latest height of each cell, (rows * cols,), and `n_heights` its number of heights.
    """

    def __init__(
        self, grid: MapGrid, height_m: Map, rig: StereoRig, floor: HeightField, matchability: Matchability,
        view: MeasuredView = IDEAL_VIEW,
    ):  # fmt: skip
        self.grid, self.height_m, self.seen = grid, height_m, np.zeros(height_m.shape, np.bool_)
        self._rig, self._matchability = rig, matchability
        self.relief = floor_relief(height_m, grid.cell_m, rig, matchability.medium_depth_m)
        self._cells = cell_view.FloorCells(
            grid.west_m, grid.north_m, grid.cell_m, grid.rows, grid.cols, np.ascontiguousarray(height_m.ravel()),
            self.relief.slope.reshape(-1, 2), _may_be_hidden(height_m, grid.cell_m).ravel(), floor,
        )  # fmt: skip
        self._cameras = cell_view.Cameras(
            rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px), float(rig.height_px), rig.baseline_m, view.table,
            rig.baseline_m, 1 / np.square(matchability.dependence.bounds),
        )  # fmt: skip
        self._lowest_m = float(np.nanmin(height_m))
        self._conditions, self.n_heights = np.zeros((len(CellConditions._fields), 0)), np.zeros(0, np.int64)
        self._runs = np.zeros((4, height_m.size))  # see `extend_runs`

    def keep_conditions(self) -> None:
        self._conditions = np.zeros((len(CellConditions._fields), self.height_m.size))
        self.n_heights = np.zeros(self.height_m.size, np.int64)

    @property
    def conditions(self) -> CellConditions:
        return CellConditions(*self._conditions)

    @property
    def correlated_cells(self) -> int:
        return max(round(_CORRELATED_WINDOWS * self.relief.window_cells), 1)

    def new_noise(self, model: ErrorModel, rng: np.random.Generator) -> MapNoise:
        """Returns random numbers of the errors of a map, and forgets the keyframes of earlier maps."""
        self._runs[:], self.n_heights[:] = 0, 0
        shape, cells = self.height_m.shape, self.correlated_cells
        lateral, dropout = rng.standard_normal(shape, np.float32), rng.random(shape, np.float32)
        relief, scatter, edge = (window_noise(shape, cells, rng) for _ in range(3))
        level = float(np.exp(model.survey_scatter * rng.standard_normal()))
        return MapNoise(lateral, relief, heavy_tailed(edge), scatter, dropout, level)

    def calibrate(self, found: CalibrationEstimate) -> None:
        """Corrects the heights of the next map for errors of the calibration that were found."""
        table = self._cameras.table._replace(yaw_rad=found.yaw_rad)
        baseline_m = self._rig.baseline_m * (1 + found.baseline_error)
        self._cameras = self._cameras._replace(table=table, estimated_baseline_m=baseline_m)

    def mark_seen(self, world_from_camera: Array) -> None:
        """Marks the cells that both cameras see from the true pose (4, 4) of a keyframe."""
        window = cell_view.window_in_reach(self._cells, self._cameras, self._lowest_m, world_from_camera)
        cell_view.mark_visible(self._cells, self._cameras, window, world_from_camera, self.seen.reshape(-1))

    def observe(self, true: Array, estimated: Array) -> ObservedCells:
        """Returns the cells that a keyframe with a true and an estimated pose (4, 4) observes."""
        # with calibration errors or an approximated port, the estimated pose determines which point is mapped to a cell
        window = cell_view.window_in_reach(self._cells, self._cameras, self._lowest_m, true)
        found = cell_view.visible_cells(self._cells, self._cameras, window, true, estimated)
        return ObservedCells(*found, true, estimated)

    def sample_patch(
        self, observed: ObservedCells, following: ObservedCells | None, cov: Array, model: ErrorModel, noise: MapNoise,
        rng: np.random.Generator,
    ) -> HeightPatch | None:  # fmt: skip
        """Samples the heights of the cells that a keyframe sees and the next one does not; None if it sees none.

        The keyframes must be passed in the order of the path: the consecutive keyframes that observed a cell determine
        the standard deviation of its height and whether it has one. `following` are the cells of the next one, None:
        there is none; `cov` (6, 6) is that of the estimated pose, in camera axes. Raises FloatingPointError if a height
        or a variance is not finite.
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
        height, variance, systematic, pose = np.full((4, *shape), np.nan, np.float32)
        mapped_m = cell_view.mapped_heights(self._cells, self._cameras, index, observed.true, observed.estimated)
        height[i, k] = mapped_m + error
        variance[i, k] = typical_m**2
        turn = geometry.adjoint(geometry.pose(observed.estimated[:3, :3], np.zeros(3)))
        pose[i, k] = cell_view.pose_variances(self._cells, index, observed.estimated[:3, 3], turn @ cov @ turn.T)
        systematic[i, k] = pose[i, k] + lateral_m**2
        if not np.isfinite(np.stack([values[i, k] for values in (height, variance, systematic)])).all():
            raise FloatingPointError("the error model gives a height or a variance that is not finite")
        pixel, mean_depth_m = np.zeros((*shape, 2), np.float32), float(observed.depth_m.mean())
        lateral = surface.LATERAL_SIGMA_PX * mean_depth_m / self._rig.focal_px
        return HeightPatch(row, col, height, variance, systematic, pixel, lateral, pose_m2=pose)

    def _end_runs(self, observed: ObservedCells, following: ObservedCells | None) -> tuple[Index, CellConditions]:
        """Adds a keyframe to the runs of its cells; returns those that the next one does not see, with conditions."""
        index, following_index, squared_step = observed.cells, _NO_CELLS, 0.0
        if following is not None:
            step_m = float(np.linalg.norm(following.true[:3, 3] - observed.true[:3, 3]))
            following_index, squared_step = following.cells, (step_m / self._rig.baseline_m) ** 2
        ended, (number, squared_steps, border_px, information) = cell_view.extend_runs(
            self._runs, index, observed.border_px, observed.information, following_index, squared_step
        )
        last, step = index[ended], np.sqrt(squared_steps / np.maximum(number - 1, 1))
        views = KeyframeRuns(observed.depth_m[ended], number, step, border_px, np.sqrt(number / information))
        cells = cell_conditions(self._matchability, self._rig, self.relief, last, views)
        if self.n_heights.size:
            self._conditions[:, last] = cells
            self.n_heights[last] += 1
        return last, cells

    def _window(self, index: Index) -> tuple[int, int, tuple[int, int]]:
        rows, cols = index // self.grid.cols, index % self.grid.cols
        return int(rows[0]), int(cols.min()), (int(rows[-1] - rows[0]) + 1, int(np.ptp(cols)) + 1)


def window_noise(shape: tuple[int, int], window_cells: int, rng: np.random.Generator) -> Map:
    """Returns standard normal numbers (rows, cols) that are correlated over a square window, as matching errors are."""
    # their standard deviation exceeds 1 if the array has fewer rows or columns than the window
    noise = rng.standard_normal(shape, np.float32)
    return np.asarray(uniform_filter(noise, window_cells, mode="wrap") * window_cells, np.float32)


def heavy_tailed(noise: Map) -> Map:
    """Returns n |n| / sqrt(3), of unit variance: heavy tails, because cells near a wall may match the wrong surface."""
    return np.asarray(noise * np.abs(noise) / np.float32(np.sqrt(3)), np.float32)


def _may_be_hidden(height_m: Map, cell_m: float) -> NDArray[np.bool_]:
    """Returns the mask (rows, cols) of the cells that relief may hide from a camera; no rays are cast for others."""
    height = np.where(np.isfinite(height_m), height_m, np.nanmin(height_m))
    hidden, radius, relief_m = np.zeros(height.shape, np.bool_), 1, float(np.ptp(height))
    while radius * cell_m * _HIDING_SLOPE < relief_m:
        hidden |= maximum_filter(height, 4 * radius + 1) - height > radius * cell_m * _HIDING_SLOPE
        radius *= 2
    return hidden
