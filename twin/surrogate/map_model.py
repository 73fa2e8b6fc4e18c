"""Model of the elevation map: the grid cells that a keyframe sees, and samples of the heights that it contributes.

The heights stand for those from the Kalman depth filter, with one sample per grid cell for all pixels that show the
cell. Their errors are correlated over about a matching window, as those of dense matching are. A cell is visible if its
centre projects into both images and no relief hides it from either camera (ray casting). Where the floor is not a plane
within the matching window, heights have an additional error that grows with the RMS deviation from the plane (the
roughness of the cell), and cells without a height are more frequent. Near walls, errors are larger and heavy-tailed,
because the window shows two surfaces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_camera_ray, map_slopes
from twin.core.records import MapGrid, StereoRig
from twin.estimate.mapping import surface
from twin.estimate.mapping.surface import HeightPatch
from twin.kernels import kernel
from twin.surrogate.error_model import DepthLaw, ErrorModel
from twin.surrogate.matchability import Matchability
from twin.surrogate.measured_view import IDEAL_TABLE, ViewTable, measure_point
from twin.world.observed_cells import DEPTH_TOLERANCE

Map = NDArray[np.float32]
WINDOW_PX = 11  #: side of the window of dense matching, over which the roughness of a cell is computed
#: Side of the square over which errors are correlated, in matching windows: dense matching is regularised, and the
#: depth filter passes depths on from keyframe to keyframe.
_CORRELATED_WINDOWS = 1.5
WALL_SLOPE = 1.0  #: rise over run of the least steep wall
#: Errors near walls decrease with the number of keyframes to the power of minus this.
EDGE_VIEWS_EXPONENT = 0.2
#: Errors near walls are larger at the border of the images by this share, which decreases by the factor 1 / e over
#: 1 / 6 of the image height. Measured over the horseshoe reef and fractal floors; see `edge_border_factor`.
EDGE_BORDER_SHARE, EDGE_BORDER_DECAY = 1.2, 6.0
_LEAST_SLOPE = 0.1  # slope below which errors near walls do not decrease
#: Law of a depth that more keyframes do not improve.
ONE_KEYFRAME = DepthLaw(0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
_NO_CELLS = np.zeros((0, 0), np.float32)
_EVEN = np.ones((1, 1))  # relative bounds of an evenly lit image
#: Rise over run of a line from a cell; floor below this line is taken not to hide the cell. This is exact for rays that
#: are at most 45 deg from the vertical.
_HIDING_SLOPE = 1.0


class DepthErrors(NamedTuple):
    """Errors of the filtered depth that an error model expects at the depths of a `Matchability`."""

    error_law: DepthLaw  #: decrease of the true and of the reported variance with the number of keyframes
    sigma_law: DepthLaw  #: decrease of the true and of the reported variance with the number of keyframes
    error_px: Array  #: (m,) true and reported standard deviation from one keyframe [px of disparity]
    sigma_px: Array  #: (m,) true and reported standard deviation from one keyframe [px of disparity]
    cell_scatter: Array  #: (m,) standard deviation over cells of the logarithm of the reported standard deviation
    completeness: Array  #: (m,) fraction of the smooth cells away from the image border with a depth
    edge_error: Array  #: (m,) true standard deviation of the height error near walls, per `edge_strength` [px^(1/2)]


def depth_errors(model: ErrorModel, matchability: Matchability) -> DepthErrors:
    """Returns the expected errors of the filtered depth."""
    (error, sigma), bounds_px = model.depth_laws(matchability.binning), matchability.bounds_px
    window_px, lamp_share = matchability.window_bounds_px, matchability.lamp_share
    return DepthErrors(
        error,
        sigma,
        error.sigma_px(window_px, lamp_share),
        sigma.sigma_px(window_px, lamp_share),
        model.depth_texture_scatter(bounds_px, matchability.texture.scatter),
        np.array([model.map_completeness(b) for b in bounds_px]),
        np.array([model.edge_error(b) for b in bounds_px]),
    )


class CellErrors(NamedTuple):
    """Errors of the filtered depth: random numbers and standard deviations."""

    lateral_noise: Map  #: (rows, cols) standard normal samples of the lateral error, shared by all views of a cell
    #: (rows, cols) standard normal samples of the error due to relief within the matching window, shared by all views
    #: of a cell; see `window_noise`
    relief_noise: Map
    #: (rows, cols) samples of the error near walls, of zero mean and unit variance, shared by all views of a cell; see
    #: `heavy_tailed`
    edge_noise: Map
    #: (rows, cols) standard normal samples of the logarithm of the standard deviation of depth, shared by all views of
    #: a cell and correlated over a window; see `cell_scatter`
    cell_noise: Map
    #: (rows, cols) uniform numbers in [0, 1); a cell has no depth if its number exceeds `completeness`, which is
    #: multiplied by factors for the roughness and for the image border
    dropout: Map
    lateral_sigma_px: float  #: standard deviation of the lateral error [px]
    #: (m,) ascending depths at which the next four fields are tabulated, and also `edge_error`, `border_width_px`,
    #: `error_noise_share` and `sigma_noise_share` [m]
    depths_m: Array
    depth_error_px: Array  #: (m,) true standard deviation of the depth from one keyframe [px of disparity]
    depth_sigma_px: Array  #: (m,) reported standard deviation of the depth from one keyframe [px of disparity]
    cell_scatter: Array  #: (m,) standard deviation over cells of the logarithm of the reported standard deviation
    #: (m,) fraction of the smooth cells away from the image border for which the filter provides a depth
    completeness: Array
    error_law: DepthLaw = ONE_KEYFRAME  #: decrease of the true variance with the number of keyframes
    sigma_law: DepthLaw = ONE_KEYFRAME  #: decrease of the reported variance with the number of keyframes
    relief_error_gain: float = 0.0  #: `ErrorModel.relief_error_gain`
    relief_error_limit_px: float = 1.0  #: `ErrorModel.relief_error_limit_px`
    #: (m,) true standard deviation of the height error near walls, per `edge_strength` [px^(1/2)]
    edge_error: Array = np.zeros(2)
    edge_sigma_gain: float = 0.0  #: `ErrorModel.edge_sigma_gain`
    edge_half_px: float = np.inf  #: `ErrorModel.edge_half_px`
    #: fraction of cells without a depth at the border of the images; see `error_model.BorderLaw`
    border_share: float = 0.0
    #: (m,) distance from the border over which this fraction decreases by the factor 1 / e [px]
    border_width_px: Array = np.ones(2)
    error_scatter_share: float = 1.0  #: `ErrorModel.error_scatter_share`
    #: (r,) ascending distances from the image border at which the next two fields are tabulated
    border_distances_px: Array = np.array([0.0, 1.0])
    border_depth: Array = np.ones(2)  #: (r,) factor on the true and on the reported standard deviation of depth
    border_edge: Array = np.ones(2)  #: (r,) factor on the error near walls; see `edge_border_factor`
    #: (q,) ascending ratios of the Cramér-Rao bound of a cell to that of the whole image, at which the next two fields
    #: are tabulated; see `MapModel.bound_ratio`
    bound_ratios: Array = np.array([0.0, 1.0])
    bound_error: Array = np.ones(2)  #: (q,) factor on the true standard deviation of depth
    bound_sigma: Array = np.ones(2)  #: (q,) factor on the reported standard deviation of depth
    #: (m,) fraction of the true variance of depth that image noise causes (`DepthLaw.noise_share`)
    error_noise_share: Array = np.zeros(2)
    sigma_noise_share: Array = np.zeros(2)  #: (m,) fraction of the reported variance of depth that image noise causes


class ObservedCells(NamedTuple):
    """Cells that both cameras of a keyframe see, in a rectangular window of the grid."""

    row: int  #: grid position of the first (north-west) cell of the window
    col: int  #: grid position of the first (north-west) cell of the window
    depth_m: Map  #: (rows, cols) depth of the floor point that is mapped to each cell [m]; -1 if it is not seen
    #: (rows, cols) distance of this point from the nearest border of the two images [px]; 0 if it is not seen
    border_px: Map
    #: (rows, cols) 1 / r^2 for the ratio r of the Cramér-Rao bound at the point's position in the left image to that of
    #: the whole image; 0 if it is not seen
    information: Map
    true: Array  #: (4, 4) poses of the keyframe
    estimated: Array  #: (4, 4) poses of the keyframe


class MapModel:
    """Samples the height patch of each keyframe: true heights of the floor plus errors.

    Args:
        grid: grid of the map.
        height_m: (rows, cols) true height at the cell centres [m].
        rig: believed calibration.
        floor: the true floor as a height field, for ray casting.
        depth_m: typical depth of the floor along the optical axis [m].
        view: positions at which true points are measured.
        relative_bounds: (r, c) Cramér-Rao bound in blocks of the image, divided by that of the whole image; see
            `matchability.PositionDependence`.

    Attributes:
        seen: (rows, cols) mask of the cells that at least one keyframe observed; updated by `mark_seen`.
        roughness_m: (rows, cols) RMS deviation of the floor from its best-fit plane within the matching window [m].
        edge_m: (rows, cols) strength of the edges, which causes errors near walls; see `edge_strength`. It is converted
            from px of disparity to metres at the typical depth [m px^(-1/2)].
        window_cells: side of the matching window [cells].
        correlated_cells: side of the square over which errors are correlated [cells].
        views: (rows, cols) number of consecutive keyframes whose depths were fused in the latest height of the cell;
            updated by `sample_patch`.
        step_baselines: (rows, cols) RMS distance between neighbours in this series of keyframes, in stereo baselines; 0
            for one keyframe.
        border_px: (rows, cols) largest distance of the cell from the image border over consecutive keyframes, times the
            square root of their number; the maximum over all series of keyframes [px].
        border_distance_px: (rows, cols) largest distance of the cell from the image border over the consecutive
            keyframes of the latest height [px].
        bound_ratio: (rows, cols) ratio of the Cramér-Rao bound of the consecutive keyframes of the latest height, at
            the positions of the cell in their images, to that of the whole images; their information is added.
    """

    def __init__(
        self,
        grid: MapGrid,
        height_m: Map,
        rig: StereoRig,
        floor: HeightField,
        depth_m: float,
        view: ViewTable = IDEAL_TABLE,
        relative_bounds: Array = _EVEN,
    ):
        self.grid, self.height_m, self.seen, self._rig = grid, height_m, np.zeros(height_m.shape, np.bool_), rig
        self._slope = np.stack(map_slopes(np.asarray(height_m, np.float64), grid.cell_m), axis=-1).astype(np.float32)
        self._lowest_m = float(np.nanmin(height_m))
        self.depth_m = depth_m
        self._floor, self._may_be_hidden = floor, _may_be_hidden(height_m, grid.cell_m)
        window_cells = WINDOW_PX * depth_m / rig.focal_px / grid.cell_m
        self.window_cells = max(round(window_cells), 1)
        self.correlated_cells = max(round(_CORRELATED_WINDOWS * window_cells), 1)
        self.roughness_m = roughness(height_m, window_cells)
        per_m = np.float32(rig.focal_px * rig.baseline_m / depth_m**2)
        self.edge_m = edge_strength(self.roughness_m * per_m, step_slope(height_m, grid.cell_m), window_cells) / per_m
        self.views, run = (np.zeros(height_m.shape, np.int16) for _ in range(2))
        zeros = (np.zeros(height_m.shape, np.float32) for _ in range(7))
        self.step_baselines, self.border_px, self.border_distance_px, self.bound_ratio, *rest = zeros
        self._runs = _Runs(run, *rest)
        self._geotransform = (grid.west_m, grid.north_m, grid.cell_m)
        self._camera = (
            rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px - 1), float(rig.height_px - 1), rig.baseline_m,
            view,
        )  # fmt: skip
        self._information = 1 / np.square(relative_bounds)

    @property
    def steepness(self) -> Map:
        """Returns the magnitude of the slope of the floor (rows, cols) [m/m]."""
        return np.hypot(*np.moveaxis(self._slope, -1, 0))

    def mark_seen(self, world_from_camera: Array) -> None:
        """Marks the cells that both cameras see from the true pose (4, 4) of a keyframe."""
        window = self._window(world_from_camera)
        floor, cells = (self._floor, self._may_be_hidden), (self.height_m, self._geotransform)
        _mark(self.seen, *cells, self._camera[:6], self._camera[6], self._poses_of(world_from_camera), floor, *window)

    def observe(self, true: Array, estimated: Array) -> ObservedCells:
        """Returns the cells that a keyframe observes, with their depths and distances from the image border.

        Args:
            true: (4, 4) true pose of the keyframe.
            estimated: (4, 4) estimated pose of the keyframe. With calibration errors or an approximated port, it
                determines which floor point is mapped to a cell.
        """
        row, end_row, col, end_col = self._window(true)
        shape = max(end_row - row, 0), max(end_col - col, 0)
        depth_m, border_px, information = (np.full(shape, value, np.float32) for value in (-1, 0, 0))
        camera, cells = self._camera[:6], (self.height_m, self._slope, self._geotransform)
        _observe(
            (depth_m, border_px, information), row, col, cells, camera, self._camera[6], self._information,
            self._poses_of(true), estimated @ geometry.inverse(true), (self._floor, self._may_be_hidden),
        )  # fmt: skip
        observed = ObservedCells(row, col, depth_m, border_px, information, true, estimated)
        return observed

    def sample_patch(
        self,
        observed: ObservedCells,
        following: ObservedCells | None,
        cov: Array,
        errors: CellErrors,
        rng: np.random.Generator,
    ) -> HeightPatch | None:
        """Samples the height patch of a keyframe: the heights of the cells that it sees and the next keyframe does not.

        The keyframes must be passed in the order of the path, from the first to the last one: the consecutive keyframes
        that observed a cell determine the standard deviation of its height and whether it has one.

        Args:
            following: cells that the next keyframe observes; None for the last one.
            cov: (6, 6) covariance of the estimated pose, in camera axes.

        Returns:
            The patch, or None if the field of view does not overlap the grid.
        """
        shape, true, estimated = observed.depth_m.shape, observed.true, observed.estimated
        if not observed.depth_m.size:
            return None
        height = np.full(shape, np.nan, np.float32)
        variance, systematic = height.copy(), height.copy()
        step = 0.0 if following is None else float(np.linalg.norm(following.true[:3, 3] - true[:3, 3]))
        rotation = geometry.adjoint(geometry.pose(estimated[:3, :3], np.zeros(3)))
        next_cells = (0, 0, _NO_CELLS) if following is None else following[:3]
        depth_m = _sample_patch(
            height, variance, systematic,
            (self.height_m, self._slope, self.roughness_m, self.edge_m, self._geotransform),
            self._runs,
            (self.views, self.step_baselines, self.border_px, self.border_distance_px, self.bound_ratio), observed[:5],
            next_cells, step / self._rig.baseline_m, self._camera[:6], self._camera[6], geometry.inverse(true),
            estimated @ geometry.inverse(true), estimated[:3, 3].copy(), rotation @ cov @ rotation.T,
            window_noise(shape, self.correlated_cells, rng), errors,
        )  # fmt: skip
        lateral = surface.LATERAL_SIGMA_PX * depth_m / self._rig.focal_px
        return HeightPatch(
            observed.row, observed.col, height, variance, systematic, np.zeros((*shape, 2), np.float32), lateral
        )

    def _poses_of(self, true: Array) -> Array:
        """Returns three matrices (3, 4, 4) for a pose (4, 4) of the left camera."""
        right_from_left = geometry.pose(np.eye(3), np.array([self._rig.baseline_m, 0.0, 0.0]))
        return np.stack([geometry.inverse(true), true, true @ right_from_left])

    def _window(self, world_from_camera: Array) -> tuple[int, int, int, int]:
        """Returns (first row, end row, first column, end column) of the cells that may be in view, without the ends."""
        size = (self.grid.rows, self.grid.cols)
        return _window(world_from_camera, self._camera, self._geotransform, self._lowest_m, size)


@kernel
def _window(pose, camera, geotransform, lowest, size):
    """Returns the rows and columns of the map that the image can show; compiled kernel of `MapModel._window`."""
    focal, cx, cy = camera[:3]
    west, north, cell = geotransform
    rows, cols = size
    x_low = x_high = pose[0, 3]
    y_low = y_high = pose[1, 3]
    for u, v in ((-cx, -cy), (cx, -cy), (-cx, cy), (cx, cy)):
        a, b = u / focal, v / focal
        dx = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2]
        dy = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2]
        dz = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2]
        if dz >= -0.1:  # the view (nearly) reaches the horizon: take the whole grid
            return 0, rows, 0, cols
        far = (lowest - pose[2, 3]) / dz
        x_low, x_high = min(x_low, pose[0, 3] + far * dx), max(x_high, pose[0, 3] + far * dx)
        y_low, y_high = min(y_low, pose[1, 3] + far * dy), max(y_high, pose[1, 3] + far * dy)
    first_row, end_row = max(int((north - y_high) / cell) - 1, 0), min(int((north - y_low) / cell) + 2, rows)
    first_col, end_col = max(int((x_low - west) / cell) - 1, 0), min(int((x_high - west) / cell) + 2, cols)
    return first_row, end_row, first_col, end_col


def window_noise(shape: tuple[int, int], window_cells: int, rng: np.random.Generator) -> Map:
    """Returns standard normal numbers (rows, cols) that are correlated over a square window, as matching errors are.

    Their standard deviation exceeds 1 if the array has fewer rows or columns than the window.

    Args:
        window_cells: side of the window [cells].
    """
    noise = rng.standard_normal(shape, np.float32)
    return np.asarray(uniform_filter(noise, window_cells, mode="wrap") * window_cells, np.float32)


def heavy_tailed(noise: Map) -> Map:
    """Returns n |n| / sqrt(3) for standard normal numbers n (rows, cols): zero mean, unit variance and heavy tails.

    Dense matching resolves most cells near a wall, and assigns others, in patches, to the wrong surface.
    """
    return np.asarray(noise * np.abs(noise) / np.float32(np.sqrt(3)), np.float32)


@kernel(inline="always")
def _border_of(camera, x, y, disparity):
    """Returns the distance of a normalised (x, y, disparity) from the nearest border of the two images [px]."""
    focal, cx, cy, right, bottom, _ = camera
    u, v = focal * x + cx, focal * y + cy
    return min(min(v, bottom - v), min(right - u, u - focal * disparity))


@kernel
def _source(camera_from_world, camera, view, estimated_from_true, point, slope):
    """Returns the true floor point (x, y, z) that is mapped to a cell: the cell's centre minus the mapping error."""
    x, y, z = point
    px, py, _ = _estimated_position(camera_from_world, camera, view, estimated_from_true, x, y, z)
    return 2 * x - px, 2 * y - py, z + slope[0] * (x - px) + slope[1] * (y - py)


@kernel
def _transformed(m, x, y, z):
    """Returns the point (x, y, z) transformed by a pose (4, 4)."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@kernel
def _estimated_position(camera_from_world, camera, view, estimated_from_true, x, y, z):
    """Returns the estimated world position of a world point that the camera sees from its true pose."""
    baseline, m = camera[5], camera_from_world
    true_x, true_y, depth = _transformed(m, x, y, z)
    seen_x, seen_y, disparity = measure_point(view, true_x / depth, true_y / depth, baseline / depth)
    far = baseline / disparity
    cx, cy, cz = far * seen_x - m[0, 3], far * seen_y - m[1, 3], far - m[2, 3]
    return _transformed(
        estimated_from_true,
        m[0, 0] * cx + m[1, 0] * cy + m[2, 0] * cz,
        m[0, 1] * cx + m[1, 1] * cy + m[2, 1] * cz,
        m[0, 2] * cx + m[1, 2] * cy + m[2, 2] * cz,
    )


def _may_be_hidden(height_m: Map, cell_m: float) -> NDArray[np.bool_]:
    """Returns the mask (rows, cols) of the cells that relief may hide from a camera; no rays are cast for others."""
    height = np.where(np.isfinite(height_m), height_m, np.nanmin(height_m))
    hidden, radius, relief_m = np.zeros(height.shape, np.bool_), 1, float(np.ptp(height))
    while radius * cell_m * _HIDING_SLOPE < relief_m:
        hidden |= maximum_filter(height, 4 * radius + 1) - height > radius * cell_m * _HIDING_SLOPE
        radius *= 2
    return hidden


def roughness(height_m: Map, window_cells: float) -> Map:
    """Returns the RMS deviation (rows, cols) of the floor from its best-fit plane within a square window [m].

    Its square is the variance of the heights minus the part that a linear regression on both coordinates explains.

    Args:
        height_m: (rows, cols) heights; NaN is replaced by the lowest height.
    """
    side = _odd(window_cells)
    height = np.where(np.isfinite(height_m), height_m, np.nanmin(height_m)).astype(np.float64)
    height -= height.mean()
    row, col = np.indices(height.shape, dtype=np.float64)

    def mean(values: Array) -> Array:
        return uniform_filter(values, side, mode="nearest")

    level = mean(height)
    variance = mean(height**2) - level**2
    for coordinate in (row, col):
        covariance = mean(height * coordinate) - level * mean(coordinate)
        variance -= covariance**2 / ((side**2 - 1) / 12)
    return np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)


def step_slope(height_m: Map, cell_m: float) -> Map:
    """Returns the slope (rows, cols) of the largest steps from a cell to its neighbours in x and in y [m/m].

    A central difference would halve the slope of a wall between two cells.

    Args:
        height_m: (rows, cols) heights; NaN is replaced by the lowest height.
    """
    height = np.where(np.isfinite(height_m), height_m, np.nanmin(height_m)).astype(np.float64)
    steps = []
    for axis in (0, 1):
        step = np.abs(np.diff(height, axis=axis, prepend=np.nan, append=np.nan))
        before, after = (step[:-1], step[1:]) if axis == 0 else (step[:, :-1], step[:, 1:])
        steps.append(np.fmax(before, after))
    return (np.hypot(*steps) / cell_m).astype(np.float32)


def edge_strength(roughness_px: Map, slope: Map, window_cells: float) -> Map:
    """Returns the strength of the edges (rows, cols) [px^(1/2)], which determines the errors near walls.

    It is the square root of r s, and 0 where the matching window of the cell shows no wall. The slope s of the cell, at
    least `_LEAST_SLOPE`, counts because a lateral displacement of the matched edge causes a height error on the face of
    the wall, and hardly any on the level floor next to the wall. r is the geometric mean of the roughness of the cell
    and of the largest roughness of the windows that contain the cell: the error is large if the window of the cell
    shows two surfaces, or if the cell is matched as its neighbours are. The square root is taken because dense matching
    resolves large structures better.

    Args:
        roughness_px: (rows, cols) roughness [px of disparity]; see `roughness`.
        slope: (rows, cols) slope of the cells [m/m]; see `step_slope`. A cell steeper than `WALL_SLOPE` is a wall.
    """
    side = _odd(window_cells)
    near_wall = maximum_filter(slope, side) > WALL_SLOPE
    mean_px = np.sqrt(roughness_px * np.asarray(maximum_filter(roughness_px, side), np.float32))
    return np.where(near_wall, np.sqrt(mean_px * np.maximum(slope, _LEAST_SLOPE)), 0).astype(np.float32)


def edge_border_factor(border_px: Array, height_px: int) -> Array:
    """Returns the factor on errors near walls at distances (n,) from the border of the images [px].

    Towards the border, cameras see the relief from the side, and each camera sees other parts of it.

    Args:
        border_px: (n,) distances.
    """
    return 1 + EDGE_BORDER_SHARE * np.exp(-EDGE_BORDER_DECAY * border_px / height_px)


def _odd(window_cells: float) -> int:
    """Returns the side of a window of cells, rounded to an odd number of cells, at least 3."""
    return 2 * max(round((window_cells - 1) / 2), 1) + 1


@kernel
def _is_hidden(poses, baseline, field, x, y, depth):
    """Returns whether relief hides the floor point at normalised (x, y) and `depth` from either camera."""
    nearest = (1 - DEPTH_TOLERANCE) * depth
    if cast_camera_ray(field, poses[1], x, y) < nearest:
        return True
    return cast_camera_ray(field, poses[2], x - baseline / depth, y) < nearest


@kernel
def _mark(seen, height, geotransform, camera, view, poses, floor, row, end_row, col, end_col):
    """Sets `seen` for the cells of a window that both cameras see."""
    (west, north, cell), (field, may_be_hidden), baseline = geotransform, floor, camera[5]
    for i in range(row, end_row):
        y = north - (i + 0.5) * cell
        for j in range(col, end_col):
            if seen[i, j]:
                continue
            a, b, depth = _transformed(poses[0], west + (j + 0.5) * cell, y, height[i, j])
            if not depth > 0:
                continue
            seen_a, seen_b, disparity = a / depth, b / depth, baseline / depth
            if view.values.size:
                seen_a, seen_b, disparity = measure_point(view, seen_a, seen_b, disparity)
            if _border_of(camera, seen_a, seen_b, disparity) >= 0:
                hidden = may_be_hidden[i, j] and _is_hidden(poses, baseline, field, a / depth, b / depth, depth)
                seen[i, j] = not hidden


@kernel
def _observe(out, row, col, cells, camera, view, image_information, poses, estimated_from_true, floor):
    """Compiled kernel of `MapModel.observe`; writes depth, distance from the border and information to `out`."""
    (height, slope, (west, north, cell)), (depth_out, border, information) = cells, out
    (field, may_be_hidden), m, ideal, baseline = floor, poses[0], view.values.size == 0, camera[5]
    for i in range(depth_out.shape[0]):
        y = north - (row + i + 0.5) * cell
        for j in range(depth_out.shape[1]):
            x, z = west + (col + j + 0.5) * cell, np.float64(height[row + i, col + j])
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if not depth > 0:
                continue
            if ideal:
                a = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
                b = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
                seen_a, seen_b, disparity = a, b, baseline / depth
            else:
                s = slope[row + i, col + j]
                a, b, depth = _transformed(m, *_source(m, camera, view, estimated_from_true, (x, y, z), (s[0], s[1])))
                a, b = a / depth, b / depth
                seen_a, seen_b, disparity = measure_point(view, a, b, baseline / depth)
            border_px = _border_of(camera, seen_a, seen_b, disparity)
            if not border_px >= 0:
                continue
            if may_be_hidden[row + i, col + j] and _is_hidden(poses, baseline, field, a, b, depth):
                continue
            depth_out[i, j], border[i, j] = depth, border_px
            information[i, j] = _information_at(image_information, camera, seen_a, seen_b)


@kernel(inline="always")
def _information_at(table, camera, x, y):
    """Returns the value of a table (rows, cols) over the blocks of the image at a normalised (x, y), interpolated."""
    focal, cx, cy, right, bottom, _ = camera
    rows, cols = table.shape
    row = min(max((focal * y + cy + 0.5) / (bottom + 1) * rows - 0.5, 0.0), rows - 1.0)
    col = min(max((focal * x + cx + 0.5) / (right + 1) * cols - 0.5, 0.0), cols - 1.0)
    i, j = int(row), int(col)
    k, n = min(i + 1, rows - 1), min(j + 1, cols - 1)
    upper = table[i, j] + (col - j) * (table[i, n] - table[i, j])
    lower = table[k, j] + (col - j) * (table[k, n] - table[k, j])
    return upper + (row - i) * (lower - upper)


class _Runs(NamedTuple):
    """Consecutive keyframes that observe each cell, up to the current one."""

    views: NDArray[np.int16]  #: (rows, cols) number of these keyframes
    #: (rows, cols) sum of the squared distances between neighbours in this series, in squared stereo baselines
    squared_steps: Map
    border_px: Map  #: (rows, cols) largest distance from the image border over these keyframes [px]
    information: Map  #: (rows, cols) sum of `ObservedCells.information` over these keyframes


@kernel
def _sample_patch(
    out, variance, systematic, floor, runs, fused, observed, following, step, camera, view,
    camera_from_world, estimated_from_true, position, cov, depth_noise, errors,
):  # fmt: skip
    """Compiled kernel of `MapModel.sample_patch`; returns the mean depth [m]."""
    (height, slope, roughness, edge, (west, north, cell)), (row, col, depth_m, border_px, information) = floor, observed
    next_row, next_col, next_depth_m = following
    views, step_baselines, best_border_px, border_distance_px, bound_ratio = fused
    total, count = 0.0, 0
    for i in range(row, row + out.shape[0]):
        y = north - (i + 0.5) * cell
        for j in range(col, col + out.shape[1]):
            depth = np.float64(depth_m[i - row, j - col])
            if depth < 0:
                continue
            runs.views[i, j] += 1
            runs.border_px[i, j] = max(runs.border_px[i, j], border_px[i - row, j - col])
            runs.information[i, j] += information[i - row, j - col]
            p, q = i - next_row, j - next_col
            if 0 <= p < next_depth_m.shape[0] and 0 <= q < next_depth_m.shape[1] and next_depth_m[p, q] > 0:
                runs.squared_steps[i, j] += step * step
                continue
            n_views, border = runs.views[i, j], runs.border_px[i, j] * np.sqrt(runs.views[i, j])
            border_distance_px[i, j] = runs.border_px[i, j]
            ring, in_ring = _interval(errors.border_distances_px, border_distance_px[i, j])
            bound_ratio[i, j] = np.sqrt(n_views / runs.information[i, j])
            q, in_ratios = _interval(errors.bound_ratios, bound_ratio[i, j])
            mean_step = np.sqrt(runs.squared_steps[i, j] / max(n_views - 1, 1))
            views[i, j], step_baselines[i, j] = n_views, mean_step
            best_border_px[i, j] = max(best_border_px[i, j], border)
            runs.views[i, j], runs.squared_steps[i, j], runs.border_px[i, j], runs.information[i, j] = 0, 0.0, 0.0, 0.0
            k, fraction = _interval(errors.depths_m, depth)
            per_px = depth * depth / (camera[0] * camera[5])
            rough_px = roughness[i, j] / per_px
            complete = _interpolate(errors.completeness, k, fraction) / (1 + (rough_px / errors.edge_half_px) ** 2)
            complete *= 1 - errors.border_share * np.exp(-border / _interpolate(errors.border_width_px, k, fraction))
            depth_error_px = _interpolate(errors.depth_error_px, k, fraction)
            if errors.dropout[i, j] > complete or depth_error_px == np.inf:  # nothing is matched at an infinite bound
                continue
            error_noise = _interpolate(errors.error_noise_share, k, fraction)
            sigma_noise = _interpolate(errors.sigma_noise_share, k, fraction)
            error_share = _relative_variance(errors.error_law, n_views, mean_step, error_noise)
            sigma_share = _relative_variance(errors.sigma_law, n_views, mean_step, sigma_noise)
            # estimated position of the floor at this cell, and the height of its tangent plane at the cell's centre
            sx, sy = np.float64(slope[i, j, 0]), np.float64(slope[i, j, 1])
            x, z = west + (j + 0.5) * cell, np.float64(height[i, j])
            if view.values.size:
                source = _source(camera_from_world, camera, view, estimated_from_true, (x, y, z), (sx, sy))
                px, py, pz = _estimated_position(camera_from_world, camera, view, estimated_from_true, *source)
            else:
                px, py, pz = _transformed(estimated_from_true, x, y, z)
            value = pz - sx * (px - x) - sy * (py - y)
            steep = np.sqrt(sx * sx + sy * sy)
            log_scale = _interpolate(errors.cell_scatter, k, fraction) * errors.cell_noise[i, j]
            error_px = np.exp(errors.error_scatter_share * log_scale) * np.sqrt(error_share)
            error_px *= depth_error_px
            border_depth = _interpolate(errors.border_depth, ring, in_ring)
            error_px *= border_depth * _interpolate(errors.bound_error, q, in_ratios)
            value += per_px * error_px * depth_noise[i - row, j - col]
            relief_px = relief_error_px(rough_px, errors.relief_error_gain, errors.relief_error_limit_px)
            value += per_px * relief_px * errors.relief_noise[i, j]
            edge_error = _interpolate(errors.edge_error, k, fraction) * _interpolate(errors.border_edge, ring, in_ring)
            value += edge_error * edge[i, j] / n_views**EDGE_VIEWS_EXPONENT * errors.edge_noise[i, j]
            value += steep * errors.lateral_sigma_px * depth / camera[0] * errors.lateral_noise[i, j]
            out[i - row, j - col] = value
            sigma_px = np.exp(log_scale) * _interpolate(errors.depth_sigma_px, k, fraction)
            sigma_px *= border_depth * _interpolate(errors.bound_sigma, q, in_ratios)
            variance[i - row, j - col] = sigma_share * (per_px * sigma_px) ** 2
            systematic[i - row, j - col] = surface.pose_variance(
                x - position[0], y - position[1], z - position[2], sx, sy, cov
            )
            systematic[i - row, j - col] += (surface.LATERAL_SIGMA_PX * depth / camera[0] * steep) ** 2
            systematic[i - row, j - col] += (errors.edge_sigma_gain * edge[i, j]) ** 2
            if not np.isfinite(value + complete + variance[i - row, j - col] + systematic[i - row, j - col]):
                raise FloatingPointError("the error model gives a height or a variance that is not finite")
            total += depth
            count += 1
    return total / max(count, 1)


@kernel
def relief_error_px(rough_px, gain, limit_px):
    """Returns the standard deviation of a height error due to relief within the matching window [px of disparity].

    It is a q^2 / sqrt(1 + q^4), with q = gain r / a, for the roughness r and the limit a: it is proportional to r^2 for
    small roughness, which dense matching resolves.

    Args:
        rough_px: roughness of the cell [px of disparity].
    """
    share = (gain * rough_px / max(limit_px, 1e-9)) ** 2
    return limit_px * share / np.sqrt(1 + share**2)


@kernel
def _relative_variance(law, n_views, step_baselines, noise_share):
    """Compiled form of `DepthLaw.relative_variance`, with the result of `DepthLaw.noise_share`."""
    squared = step_baselines * step_baselines
    gain = law.gain * squared / (squared + law.half_step**2) if squared > 0 else 0.0
    gain += law.noise_gain * noise_share
    return law.common + (1 - law.common) / (1 + gain * (n_views - 1))


@kernel(inline="always")
def _interval(ascending, value):
    """Returns the index of the interval that contains a value, and the value's relative position (0 to 1) in it."""
    k = 0
    while k < len(ascending) - 2 and value > ascending[k + 1]:
        k += 1
    return k, min(max((value - ascending[k]) / (ascending[k + 1] - ascending[k]), 0.0), 1.0)


@kernel(inline="always")
def _interpolate(values, k, fraction):
    """Returns the tabulated value interpolated linearly at a relative position within interval k."""
    return (1 - fraction) * values[k] + fraction * values[k + 1]
