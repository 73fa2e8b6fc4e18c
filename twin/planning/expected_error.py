"""Expected height error of the map, from the surrogate's error model at the floor points visible in the keyframes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import ndtr, ndtri

from twin.core.geometry import Array
from twin.core.height_field import ray_grid
from twin.core.image_overlap import RAY_COLUMNS
from twin.core.records import StereoRig
from twin.surrogate import error_model_file
from twin.surrogate.map_model import (
    EDGE_VIEWS_EXPONENT,
    WINDOW_PX,
    depth_errors,
    edge_strength,
    relief_error_px,
    roughness,
    step_slope,
)
from twin.surrogate.matchability import Matchability
from twin.world.floor_forecast import FloorForecast
from twin.world.mission import Mission
from twin.world.top_surface import true_heights

#: Largest number of floor points from which the distribution of the height error is computed.
_POINTS = 20_000
_GOLDEN_RATIO = 0.6180339887498949  # multiples of it, modulo 1, are spread evenly


class ExpectedError(NamedTuple):
    """Expected height error of the map.

    Args:
        sigma_m: (n,) standard deviation of the height error at floor points spread evenly over the images [m].
        completeness: share, 0 to 1, of the floor in view for which the depth filter provides a height. Losses at edges
            and near the border of the images are neglected.
        bound_px: largest Cramér-Rao bound of image matching at the depths of these points [px of the matched images].
        fitted_bound_px: largest bound of the surveys to which the error model was fitted [px].
    """

    sigma_m: Array
    completeness: float
    bound_px: float
    fitted_bound_px: float

    def percentile_m(self, percent: float, holes: float = 0.0) -> float | None:
        """Returns a percentile of the absolute height error [m]; None if it is infinite or no floor is in view.

        The error is a mixture of zero-mean normal distributions with the standard deviations `sigma_m`; in holes of the
        map it is infinite.

        Args:
            percent: 0 to 100.
            holes: share of the area without a height, 0 to 1.
        """
        share = percent / 100
        if share >= 1 - holes or len(self.sigma_m) == 0:
            return None
        sigma = self.sigma_m
        below = lambda x: (1 - holes) * float(np.mean(2 * ndtr(x / sigma) - 1)) - share  # noqa: E731
        high = float(sigma.max())
        while below(high) < 0:
            high *= 2
        return float(root_scalar(below, bracket=(0.0, high), method="brentq", xtol=1e-9).root)

    @property
    def rmse_m(self) -> float | None:
        """Returns the expected RMSE of the heights [m]; None if no floor is in view."""
        return float(np.sqrt(np.mean(self.sigma_m**2))) if len(self.sigma_m) else None


def expected_error(mission: Mission, forecast: FloorForecast) -> ExpectedError:
    """Returns the expected height error of the map, without the errors of the poses.

    The error has three parts. A disparity error of s pixels at depth Z is a depth error of s Z^2 / (f b), with focal
    length f [px] and baseline b [m]. This depth error decreases with increasing distance between consecutive keyframes
    and with the number of keyframes that observe a point, which is 1 / (1 - overlap along the leg). A lateral error of
    the mapped surface causes a height error proportional to the slope of the floor. Edges and other roughness within
    the matching window cause an error that increases with the roughness. The standard deviations of all errors, and
    the scatter of the disparity error over the cells of a map, come from the error model fitted to rendered surveys.
    The disparity error depends on the water, light, texture and sensor of the scenario, through the Cramér-Rao bound
    of image matching (`Matchability`).
    """
    rig, scenario = mission.rig, mission.scenario
    fitted = error_model_file.load(scenario.imaging.error_model)
    model, matching = fitted.model, Matchability(scenario, mission.illumination, mission.terrain)
    rig = rig.binned(matching.binning)
    depth, slope, rough_m, edge_m = _floor_points(mission, forecast, rig)
    errors = depth_errors(model, matching)

    def at_depth(table: Array) -> Array:
        return np.interp(depth, matching.depths_m, table)

    bound, sigma_px = at_depth(matching.bounds_px), at_depth(errors.error_px)
    in_view = at_depth(errors.completeness)
    poses, overlap = forecast.keyframes.world_from_camera, scenario.plan.overlap_along
    step = float(np.median(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))) if len(poses) > 1 else 0.0
    share = errors.error_law.relative_variance(
        1 / (1 - overlap), step / rig.baseline_m, at_depth(matching.window_bounds_px)
    )
    scatter = at_depth(model.error_scatter_share * errors.cell_scatter)
    evenly = (0.5 + np.arange(len(depth)) * _GOLDEN_RATIO) % 1
    sigma_px *= np.exp(scatter * ndtri(np.clip(evenly, 1e-6, 1 - 1e-6)))
    vertical = depth**2 / (rig.focal_px * rig.baseline_m) * sigma_px * np.sqrt(share)
    lateral = slope * model.lateral_sigma_px * depth / rig.focal_px
    per_px = depth**2 / (rig.focal_px * rig.baseline_m)
    relief = per_px * relief_error_px(rough_m / per_px, model.relief_error_gain, model.relief_error_limit_px)
    walls = at_depth(errors.edge_error) * edge_m
    walls *= (1 - overlap) ** EDGE_VIEWS_EXPONENT
    sigma_m = np.sqrt(vertical**2 + lateral**2 + relief**2 + walls**2)
    return ExpectedError(
        sigma_m, float(in_view.mean()) if len(depth) else 0.0,
        float(bound.max(initial=0.0)), model.bound_range_px[1],
    )  # fmt: skip


def _floor_points(mission: Mission, forecast: FloorForecast, matched: StereoRig) -> tuple[Array, Array, Array, Array]:
    """Returns depth [m], slope [m/m], roughness [m] and strength of edges of the floor at n points, each (n,).

    The points are spread evenly over the images. The strength of edges is `MapModel.edge_m` [m px^(-1/2)].

    Args:
        mission: the survey.
        forecast: poses of the keyframes, surface of floor and objects, and its depths in their images.
        matched: calibration of the images that are matched, which may be binned.
    """
    rig, grid = mission.rig, mission.grid
    rays = np.column_stack([rig.normalised(ray_grid(rig, RAY_COLUMNS)), np.ones(forecast.depth_m.shape[1])])
    image, ray = np.nonzero(np.isfinite(forecast.depth_m))
    kept = np.unique(np.linspace(0, len(image) - 1, min(_POINTS, len(image))).astype(int))
    image, ray = image[kept], ray[kept]
    depth, poses = forecast.depth_m[image, ray], forecast.keyframes.world_from_camera[image]
    x, y, _ = (poses[:, :3, 3] + depth[:, None] * np.einsum("nij,nj->ni", poses[:, :3, :3], rays[ray])).T
    heights = true_heights(grid, forecast.surface.height_at)
    down, east = np.gradient(heights, grid.cell_m)
    typical_m = float(np.median(depth)) if len(depth) else 1.0
    window_cells = WINDOW_PX * typical_m / matched.focal_px / grid.cell_m
    rough, steepness = roughness(heights, window_cells), np.hypot(down, east)
    per_m = matched.focal_px * matched.baseline_m / typical_m**2
    edge = edge_strength(rough * np.float32(per_m), step_slope(heights, grid.cell_m), window_cells) / per_m
    rows = np.clip(((grid.north_m - y) / grid.cell_m).astype(int), 0, grid.rows - 1)
    cols = np.clip(((x - grid.west_m) / grid.cell_m).astype(int), 0, grid.cols - 1)
    at = rows, cols
    return depth, np.nan_to_num(steepness[at]), rough[at].astype(float), edge[at].astype(float)
