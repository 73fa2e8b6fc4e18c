"""Expected height error of the map, from the surrogate's error model at the floor points visible in the keyframes."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import ndtr, ndtri

from twin.core.geometry import Array
from twin.core.height_field import RAY_COLUMNS, ray_grid
from twin.surrogate import error_model_file
from twin.surrogate.floor_relief import floor_relief
from twin.surrogate.height_errors import CellConditions, KeyframeRuns, cell_conditions, height_sigmas
from twin.surrogate.matchability import Matchability
from twin.world.floor_forecast import FloorForecast
from twin.world.mission import Mission
from twin.world.top_surface import true_heights

#: Largest number of floor points from which the distribution of the height error is computed.
_POINTS = 20_000
_GOLDEN_RATIO = 0.6180339887498949  # multiples of it, modulo 1, are spread evenly


class ExpectedError(NamedTuple):
    sigma_m: Array  #: (n,) standard deviation of the height error at floor points spread evenly over the images
    #: share of the floor in view for which the depth filter provides a height, without losses near image borders
    completeness: float
    bound_px: float  #: largest Cramér-Rao bound of image matching at the depths of these points
    fitted_bound_px: float  #: largest bound of the surveys to which the error model was fitted

    def percentile_m(self, percent: float, holes: float = 0.0) -> float | None:
        """Returns a percentile of the absolute height error; None if it is infinite or no floor is in view."""
        # a mixture of zero-mean normal distributions of `sigma_m`; infinite in holes, a share of the area
        share = percent / 100
        if share >= 1 - holes or len(self.sigma_m) == 0:
            return None
        below = lambda x: (1 - holes) * float(np.mean(2 * ndtr(x / self.sigma_m) - 1)) - share  # noqa: E731
        high = float(self.sigma_m.max())
        while below(high) < 0:
            high *= 2
        return float(root_scalar(below, bracket=(0.0, high), method="brentq", xtol=1e-9).root)

    @property
    def rmse_m(self) -> float | None:
        return float(np.sqrt(np.mean(self.sigma_m**2))) if len(self.sigma_m) else None


def expected_error(mission: Mission, forecast: FloorForecast) -> ExpectedError:
    """Returns the expected height error of the map, without the errors of the poses.

    The law is that of the surrogate (`surrogate.height_errors`), away from the borders of the images. The number of
    keyframes that observe a point is 1 / (1 - overlap along the leg). The scatter of the noise over the cells of a map
    is spread evenly over the points.
    """
    scenario = mission.scenario
    fitted = error_model_file.load(scenario.imaging.error_model)
    matching = Matchability(scenario, mission.illumination, mission.terrain)
    points = _floor_points(mission, forecast, matching)
    sigmas, n = height_sigmas(fitted.model, points), len(points.bound_px)
    evenly = (0.5 + np.arange(n) * _GOLDEN_RATIO) % 1
    return ExpectedError(
        sigmas.total_m(ndtri(np.clip(evenly, 1e-6, 1 - 1e-6))), float(sigmas.known.mean()) if n else 0.0,
        float(points.bound_px.max(initial=0.0)), fitted.largest_bound_px,
    )  # fmt: skip


def _floor_points(mission: Mission, forecast: FloorForecast, matching: Matchability) -> CellConditions:
    """Returns the conditions of points of the floor that are spread evenly over the images."""
    rig, grid, keyframes = mission.rig, mission.grid, forecast.keyframes.world_from_camera
    rays = np.column_stack([rig.normalised(ray_grid(rig, RAY_COLUMNS)), np.ones(forecast.depth_m.shape[1])])
    image, ray = np.nonzero(np.isfinite(forecast.depth_m))
    kept = np.unique(np.linspace(0, len(image) - 1, min(_POINTS, len(image))).astype(int))
    image, ray = image[kept], ray[kept]
    depth_m = forecast.depth_m[image, ray]
    offset = depth_m[:, None] * np.einsum("nij,nj->ni", keyframes[image, :3, :3], rays[ray])
    x, y, _ = (keyframes[image, :3, 3] + offset).T
    rows = np.clip(((grid.north_m - y) / grid.cell_m).astype(int), 0, grid.rows - 1)
    cols = np.clip(((x - grid.west_m) / grid.cell_m).astype(int), 0, grid.cols - 1)
    matched, typical_m = rig.binned(matching.binning), float(np.median(depth_m)) if len(depth_m) else 1.0
    relief = floor_relief(true_heights(grid, forecast.surface.height_at), grid.cell_m, matched, typical_m)
    steps_m = np.linalg.norm(np.diff(keyframes[:, :3, 3], axis=0), axis=1)
    step_m = float(np.median(steps_m)) if len(steps_m) else 0.0
    given = 1 / (1 - mission.scenario.plan.overlap_along), step_m / rig.baseline_m, np.inf, 1.0
    views = KeyframeRuns(depth_m, *(np.full(len(depth_m), value) for value in given))
    return cell_conditions(matching, matched, relief, rows * grid.cols + cols, views)
