"""Path at a height above a floor that is not known: its heights follow the floor as measured so far."""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from twin.controllers.camera_surface import CameraSurface, surface_above_floor
from twin.controllers.survey_area import SurveyArea
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Estimate, Frame
from twin.world.mission import Mission
from twin.world.path_checks import VEHICLE_REACH_M
from twin.world.planning import climb_slopes, smoothed_over

_CELLS = 8  # cells of the measured floor along the shorter side of an image
_MOST_CELLS = 4_000_000
_TOP_SHARE = 0.9  # height of the obstacles in a cell: this quantile of the points of a keyframe in it
#: Floor that has not been measured has the mean height of the measured floor around it, with Gaussian weights: their
#: standard deviation is this share of the shorter side of an image. Single lines need a larger one than images.
_CONTINUED = {"altimeter": 1.0, "map": 0.5, "planned": 0.5}
_FAR_WEIGHT = 1e-3  # of the mean of all measured floor near the vehicle


class FloorFollower:
    """Measures the floor during the flight, and makes the surface that the camera follows above it.

    Heights are averages over cells, from readings of the altimeter or from the stereo points of keyframes, at the
    online poses; they are relative to the floor as known before the survey. The surface is `rise_m` above the asked
    one, and clear of obstacles, also `beside_m` beside the planned path.
    """

    def __init__(self, mission: Mission):
        scenario, request = mission.scenario, mission.plan.request
        self._chart, self._continued_cells = mission.chart, _CELLS * _CONTINUED[scenario.control.height]
        beam = scenario.navigation.altimeter_beam_deg
        self._echoes = EchoCorrection(beam) if scenario.control.height == "altimeter" else None
        self._sides_m, self._slopes = smoothed_over(scenario, request), climb_slopes(scenario)
        self._altitude_m, self._clearance_m = request.altitude_m, scenario.plan.clearance_m
        self._heading, self.rise_m, self.beside_m = mission.plan.area.heading, 0.0, 0.0
        path = mission.plan.outline()[:, :2]
        self._west_south_m = path.min(axis=0) - 2 * max(self._sides_m)
        extent_m = np.ptp(path, axis=0) + 4 * max(self._sides_m)
        self._cell_m = max(min(self._sides_m) / _CELLS, float(np.sqrt(extent_m.prod() / _MOST_CELLS)))
        cols, rows = (int(np.ceil(side_m / self._cell_m)) + 1 for side_m in extent_m)
        self._sum_m, self._n = np.zeros((rows, cols)), np.zeros((rows, cols), np.int64)
        self._top_m = np.full((rows, cols), -np.inf)

    def found(self, frame: Frame, estimate: Estimate, points_m: Array | None) -> CameraSurface | None:
        """Adds what a frame has measured; returns the surface to follow from a keyframe on, None at other frames.

        `points_m` are the stereo points (n, 3) of the keyframe in the world; None if the frame has become none.
        """
        if self._echoes is not None:
            if frame.readings.altitude_m is not None and estimate.is_measured:
                self.add(self._echoes.floor_point(estimate.world_from_camera, frame.readings.altitude_m)[None])
            return self.surface(estimate.world_from_camera[:2, 3]) if frame.keyframe else None
        if points_m is None:
            return None
        self.add(points_m)
        return self.surface(estimate.world_from_camera[:2, 3])

    def add(self, points_m: Array) -> None:
        """Adds measured points (n, 3) of the floor [m]."""
        numbers = np.floor((points_m[:, :2] - self._west_south_m) / self._cell_m).astype(np.int64)
        col, row, (rows, cols) = numbers[:, 0], numbers[:, 1], self._n.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        cell, above_m = (row * cols + col)[inside], (points_m[:, 2] - self._known_m(points_m))[inside]
        order = np.lexsort((points_m[inside, 2], cell))
        cells, first, n = np.unique(cell[order], return_index=True, return_counts=True)
        if len(cells) == 0:
            return
        at = np.unravel_index(cells, self._n.shape)
        self._sum_m[at] += np.add.reduceat(above_m[order], first)
        self._n[at] += n
        top_m = points_m[inside, 2][order][first + (_TOP_SHARE * (n - 1)).astype(int)]
        self._top_m[at] = np.maximum(self._top_m[at], top_m)

    @property
    def floor_m(self) -> Array:
        """Returns the floor measured so far (n, 3): centres of the cells with points and their mean heights [m]."""
        row, col = np.nonzero(self._n)
        at_m = self._west_south_m + self._cell_m * (np.column_stack([col, row]) + 0.5)
        return np.column_stack([at_m, self._known_m(at_m) + self._sum_m[row, col] / self._n[row, col]])

    def surface(self, position_m: Array) -> CameraSurface:
        """Returns the surface around a position (x, y) [m]: above the floor as measured and, elsewhere, continued."""
        reach = np.ceil(3 * max(self._sides_m) / self._cell_m).astype(int)
        nearest = np.round((position_m - self._west_south_m) / self._cell_m).astype(int)
        col, row = np.clip(nearest, 0, np.array(self._n.shape[::-1]) - 1)  # far off the path, its edge
        part = slice(max(0, row - reach), row + reach + 1), slice(max(0, col - reach), col + reach + 1)
        corner_m = self._west_south_m + self._cell_m * (np.array([part[1].start, part[0].start]) + 0.5)
        above_m, reach_m = self._continued(part), VEHICLE_REACH_M + self._clearance_m + self.beside_m
        top_m = maximum_filter(self._top_m[part], 2 * int(np.ceil(reach_m / self._cell_m)) + 1)

        def sampled(values: Array, x_m: Array, y_m: Array, order: int) -> Array:
            at = (y_m - corner_m[1]) / self._cell_m, (x_m - corner_m[0]) / self._cell_m
            return map_coordinates(values, np.broadcast_arrays(*at), order=order, mode="nearest")

        return surface_above_floor(
            lambda x, y: self._chart.height_near(x, y) + sampled(above_m, x, y, 1) + self.rise_m,
            SurveyArea("rectangle", self._sides_m, (float(position_m[0]), float(position_m[1])), self._heading),
            self._cell_m, self._altitude_m, self._sides_m, self._slopes,
            lambda x, y: sampled(top_m, x, y, 0) + self._clearance_m,
        )  # fmt: skip

    def _known_m(self, points_m: Array) -> Array:
        return self._chart.height_near(points_m[:, 0], points_m[:, 1])

    def _continued(self, part: tuple[slice, slice]) -> Array:
        """Returns the heights (rows, cols) above the known floor in a part of the cells, measured or continued."""
        measured = self._n[part] > 0
        if not measured.any():
            return np.zeros(measured.shape)
        mean_m = self._sum_m[part] / np.maximum(self._n[part], 1)
        weight, total_m = (
            gaussian_filter(layer, self._continued_cells, mode="constant") for layer in (measured.astype(float), mean_m)
        )
        continued_m = (total_m + _FAR_WEIGHT * mean_m[measured].mean()) / (weight + _FAR_WEIGHT)
        return np.where(measured, mean_m, continued_m)


class EchoCorrection:
    """Height of the floor below an altimeter that returns the nearest echo in its beam, from upslope."""

    # A plane of gradient g is h / (cos a + |g| sin a) away at the edge of a beam of half-width a. |g| is the mean over
    # the floor so far, with slopes alike in all directions: sqrt(pi / 2) times the RMS of those along the path.

    def __init__(self, beam_deg: float):
        self._half = np.deg2rad(beam_deg / 2)
        self._last_m, self._rise2, self._run2 = np.full(3, np.nan), 0.0, 0.0

    def floor_point(self, world_from_camera: Array, distance_m: float) -> Array:
        """Returns the point (3,) of the floor on the axis of the beam [m]."""
        echo_m = geometry.transform(world_from_camera, np.array([[0.0, 0.0, distance_m]]))[0]
        step_m = echo_m - self._last_m
        run_m = float(np.hypot(step_m[0], step_m[1]))
        if not run_m <= 2 * distance_m * np.tan(self._half):  # the next beam, or the first one
            self._last_m = echo_m
            if np.isfinite(run_m):
                self._rise2, self._run2 = self._rise2 + float(step_m[2] ** 2), self._run2 + run_m**2
        gradient = np.sqrt(np.pi / 2 * self._rise2 / self._run2) if self._run2 else 0.0
        angle = min(self._half, float(np.arctan(gradient)))  # the nearest point is inside the beam on gentle slopes
        along_m = distance_m * (np.cos(angle) + gradient * np.sin(angle))
        return geometry.transform(world_from_camera, np.array([[0.0, 0.0, along_m]]))[0]
