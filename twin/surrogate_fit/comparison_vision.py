"""Statistics of image measurements compared with the surrogate's and with the truth, for the fit.

During a rendered survey, every measurement is made in the images, and the surrogate samples the same one at the same
true poses. Reported covariances and errors of motions are expressed as standard deviations of a single match or flow
vector [px], by the covariance that the surrogate reports for one of unit standard deviation.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import EpipolarError
from twin.core.records import ElevationMap, Frame, Image, MapGrid, SurveyResult
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision.mosaic import Registration
from twin.estimate.vision.stereo import Keyframe, StereoPoints
from twin.estimate.vision.two_view_motion import Motion
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.floor_relief import WALL_SLOPE
from twin.surrogate.vision import SurrogateVision

_MIN_CELLS = 100  # smallest number of cells of a class
_VIEW_BINS = (1, 2, 3, 4, 6, 9, 15, 26, 10_000)  # first number of keyframes of each class of level cells, and the end
_ROUGHNESS_BINS_PX = (0.0, 0.03, 0.08, 0.25)  # ends of the roughness of the classes of level cells
_EDGE_BINS = (0.15, 0.3, 0.5, 0.8, 1.2, np.inf)  # ends of the strength of edges of the classes of cells near walls
_HOLE_ROUGHNESS_PX = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, np.inf)
_HOLE_BORDER_PX = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0, 15.0)
_INNER_PX = 20.0  # distance from the border of the images beyond which the border has no effect
_NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal variable
_HEAVY_P90 = 1.562  # 90th percentile of the absolute value of `map_model.heavy_tailed`
_UPPER_TAIL = 1.2816  # 90th percentile of a standard normal variable
#: Parameters of `single_error_models`; the relief gain is so large that the bias common to all points is negligible.
RELIEF_GAIN, BIAS_FRACTION = 10.0, 0.8


class ComparisonVision:
    """Implementation of `Vision` that measures in images and collects statistics of a comparison with the surrogate."""

    def __init__(self, images: StereoVision, surrogate: SurrogateVision, true_pose: Callable[[], Array]):
        self.images, self.surrogate, self._true_pose = images, surrogate, true_pose
        self.stereo_observations = images.stereo_observations
        self.runs_in_background = images.runs_in_background
        self.statistics: dict[str, list[float]] = defaultdict(list)  #: samples by name; see `fit`
        #: measured values and medians of the conditions of each class of map cells, by kind of value
        self.classes: dict[str, list[list[float]]] = defaultdict(list)
        self.statistics["lamp_share"] = [surrogate.matchability.lamp_share]
        self._poses: dict[int, Array] = {}
        self._last_node = -1
        self._last_link: tuple[int, dict[str, Array]] = (-1, {})  # end node and errors of the chain's previous link
        self._last_pose: Array | None = None
        self._frames: list[tuple[Array, Array]] = []  # error and covariance of each F2F motion since the last keyframe

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        (measured, status), _ = self.images.track_frame(frame), self.surrogate.track_frame(frame)
        last, self._last_pose = self._last_pose, self._true_pose()
        self.statistics["frame_lost"].append(float(status != "ok"))
        if last is not None and status == "ok" and measured.n_points and self.surrogate.frame_errors is not None:
            true = geometry.inverse(last) @ self._last_pose
            unit = self.surrogate.latest.unit_cov / self.surrogate.rig.focal_px**2  # for flow vectors of 1 px
            error = geometry.log(geometry.inverse(true) @ measured.a_from_b)
            self.statistics["f2f_reported_px"].append(_sigma_ratio(measured.cov, unit))
            self.statistics["f2f_error_px"].append(float(np.sqrt(_chi2(error, unit) / 6)))
            self._frames.append((error, unit))
        return measured, status

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        points, sampled = self.images.observe_stereo(frame, row), self.surrogate.observe_stereo(frame, row)
        self.statistics["binning"] = [float(self.images.binning), float(self.surrogate.matchability.binning)]
        if len(self._frames) > 1:
            error, cov = (np.sum(x, axis=0) for x in zip(*self._frames, strict=True))
            self.statistics["f2f_interval_px"].append(float(np.sqrt(_chi2(error, cov) / 6)))
            self.statistics["f2f_interval_frames"].append(float(len(self._frames)))
        self._frames = []
        if points is not None and sampled is not None:
            latest, model = self.surrogate.latest, self.surrogate.model
            traces = [float(np.median(np.trace(x.cov, axis1=1, axis2=2))) for x in (points, sampled)]
            of_match = np.sqrt(traces[0] / traces[1] * len(latest.points) / latest.n_points) / latest.noise_ratio
            reported_px = of_match * model.match_sigma_px(latest.bound_px, latest.stereo_parallax_px)
            self.statistics["match_reported_px"].append(float(reported_px))
            self.statistics["point_fraction"].append(len(points.xyz) / self.surrogate.n_corners)
            self.statistics["bound_px"].append(latest.bound_px)
            self.statistics["stereo_parallax_px"].append(latest.stereo_parallax_px)
        return points

    def tracking_cov(self) -> Array | None:
        return self.images.tracking_cov()

    def restart_tracking(self, velocity: Array | None = None) -> None:
        self.images.restart_tracking(velocity)
        self.surrogate.restart_tracking(velocity)

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        measured = self.images.register_with_mosaic(world_from_camera)
        sampled = self.surrogate.register_with_mosaic(world_from_camera)
        if measured is not None and sampled is not None:
            ours, theirs, model = measured.correction, sampled.correction, self.surrogate.model
            self.statistics["mosaic_reported_px"].append(_sigma_ratio(ours.cov, theirs.cov) * model.mosaic_sigma_px)
            difference = geometry.log(geometry.inverse(theirs.a_from_b) @ ours.a_from_b)
            of_images = max(_chi2(difference, theirs.cov) / 6 - model.mosaic_error_ratio**2, 0.01)
            self.statistics["mosaic_error_px"].append(float(np.sqrt(of_images)) * model.mosaic_sigma_px)
        return measured

    def add_to_mosaic(self, number: int, world_from_camera: Array) -> None:
        self._poses[number] = self._true_pose()
        self.images.add_to_mosaic(number, world_from_camera)
        self.surrogate.add_to_mosaic(number, world_from_camera)

    def rebuild_mosaic(self, keyframes: Sequence[Keyframe]) -> None:
        self.images.rebuild_mosaic(keyframes)
        self.surrogate.rebuild_mosaic(keyframes)

    def epipolar_error(self) -> EpipolarError | None:
        return self.images.epipolar_error()

    def left_image(self, row: int) -> Image | None:
        return self.images.left_image(row)

    def correct_yaw(self, yaw_rad: float, sigma_rad: float) -> None:
        self.images.correct_yaw(yaw_rad, sigma_rad)

    def discard(self, numbers: range) -> None:
        self.images.discard(numbers)
        self.surrogate.discard(numbers)

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        measured = {"images": self.images.measure_motions(node, others)}
        for name, model in single_error_models(self.surrogate.model).items():
            measured[name] = self.surrogate.sample_links(node, others, model)
        pose = self._poses.get(node.number)
        node_pose = self._true_pose() if pose is None else pose
        for k, other in enumerate(others):
            true = geometry.inverse(self._poses[other.number]) @ node_pose
            self._compare_link(other.number, node.number, {name: found[k] for name, found in measured.items()}, true)
        self._last_node = node.number
        return measured["images"]

    def _compare_link(self, i: int, j: int, links: dict[str, Motion | None], true: Array) -> None:
        """Adds the statistics of one link, measured in images and sampled with the `single_error_models`."""
        measured, sampled = links["images"], links["patches"]
        self.statistics["link_failed"].append(float(measured is None))
        if sampled is not None:
            self.statistics["link_matched"].append((0 if measured is None else measured.n_points) / sampled.n_points)
        known = {name: motion for name, motion in links.items() if motion is not None}
        if measured is None or len(known) < len(links):
            return
        cov = known["patches"].cov
        self.statistics["link_reported_ratio"].append(_sigma_ratio(measured.cov, cov))
        depths = float(np.linalg.norm(true[:3, 3])) * self.surrogate.latest.disparity / self.surrogate.latest.baseline_m
        self.statistics["link_distance"].append(depths)
        errors = {name: geometry.log(geometry.inverse(true) @ motion.a_from_b) for name, motion in known.items()}
        for name, error in errors.items():
            self.statistics[f"link_nees_{name}"].append(_chi2(error, cov) / 6)
        if i == self._last_node:
            (end, previous), self._last_link = self._last_link, (j, errors)
            sigma, adjoint = np.sqrt(np.diag(cov)), geometry.adjoint(geometry.inverse(true))
            for name, last in previous.items() if end == i else ():
                product = float(adjoint @ last / sigma @ (errors[name] / sigma)) / 6
                self.statistics[f"consecutive_product_{name}"].append(product)

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        """Returns the map from images, and adds its classes of cells."""
        # relative to a sampled map without errors of measurement along the same path, so that those due to the poses
        # cancel; only cells to which one patch contributed are compared
        found, model = self.images.build_map(result, grid, step_cov, progress), self.surrogate.model
        self.surrogate.model = exact_map_model(model)
        self.surrogate.map_model.keep_conditions()
        exact = self.surrogate.build_map(result, grid, step_cov, lambda _: None)
        self.surrogate.model = model
        map_model = self.surrogate.map_model
        cells, seen = map_model.conditions, map_model.n_heights == 1
        inner = seen & (cells.border_px > _INNER_PX)
        level = cells.roughness_px < _ROUGHNESS_BINS_PX[1]
        known = np.isfinite(found.height_m).ravel()
        for bins, values, chosen in (
            (_HOLE_ROUGHNESS_PX, cells.roughness_px, inner),
            (_HOLE_BORDER_PX, cells.border_px * np.sqrt(cells.views), seen & level),
        ):
            for low, high in pairwise(bins):
                self._add_class("known", chosen & (values >= low) & (values < high), lambda one: [known[one].mean()])
        known &= np.isfinite(exact.height_m).ravel()
        error_m = (found.height_m.astype(np.float64) - exact.height_m).ravel()
        variance = np.square(found.sigma_m.astype(np.float64)) - np.square(exact.sigma_m.astype(np.float64))
        noise_m = np.sqrt(np.maximum(variance, 1e-12)).ravel()
        plain = inner & known & ~self._near_walls()
        for low, high in pairwise(_EDGE_BINS):
            strength = cells.edge_m / np.maximum(cells.metres_per_px, 1e-12)
            edge = inner & known & (strength >= low) & (strength < high)
            self._add_class("edge", edge, lambda one: [_deviation(error_m[one], 90) / _HEAVY_P90])
        for smoothest, roughest in pairwise(_ROUGHNESS_BINS_PX):
            for low, high in pairwise(_VIEW_BINS):
                rough = (cells.roughness_px >= smoothest) & (cells.roughness_px < roughest)
                chosen = plain & rough & (cells.views >= low) & (cells.views < high)
                self._add_class("level", chosen, lambda one: _level_values(error_m[one], noise_m[one]))
        return found

    def _near_walls(self) -> NDArray[np.bool_]:
        """Returns the mask (rows * cols,) of the cells whose matching window shows a wall or an edge."""
        relief = self.surrogate.map_model.relief
        wall = (np.hypot(*np.moveaxis(relief.slope, -1, 0)) > WALL_SLOPE) | (relief.edge_m > 0)
        return np.asarray(maximum_filter(wall, 2 * round(relief.window_cells) + 1), np.bool_).ravel()

    def _add_class(
        self, kind: str, chosen: NDArray[np.bool_], values: Callable[[NDArray[np.bool_]], Sequence[float]]
    ) -> None:
        """Adds a class of cells, if it has enough of them: values, then conditions."""
        if chosen.sum() < _MIN_CELLS:
            return
        conditions = self.surrogate.map_model.conditions
        medians = [float(np.median(part[chosen])) for part in conditions]
        self.classes[kind].append([float(value) for value in values(chosen)] + medians)


def exact_map_model(model: ErrorModel) -> ErrorModel:
    """Returns an error model with which every cell in view has a height without errors of measurement."""
    return model._replace(
        flow_floor_px=1e-4, efficiency=0.0, texture_scatter=0.0, survey_scatter=0.0, lateral_sigma_px=0.0,
        relief_error_px=0.0, edge_error=0.0, edge_half_px=1e9, border_holes=0.0, map_half_px=1e9,
    )  # fmt: skip


def single_error_models(model: ErrorModel) -> dict[str, ErrorModel]:
    """Returns two error models for links: "patches" without errors due to relief, "relief" with hardly any others."""
    # both without growth under lamps; with the bias fraction `BIAS_FRACTION`, and the relief gain `RELIEF_GAIN`
    no_lamps = model._replace(lamp_growth=0.0)
    return {
        "patches": no_lamps._replace(match_bias_fraction=BIAS_FRACTION, relief_gain=0.0),
        "relief": no_lamps._replace(
            match_floor_px=1e-4, efficiency=0.0, stereo_relief_gain=0.0, relief_gain=RELIEF_GAIN
        ),
    }


def _level_values(error_m: Array, noise_m: Array) -> list[float]:
    """Returns the robust standard deviation of errors, the median reported one, and the scatter of its logarithm."""
    logs = np.percentile(np.log(noise_m), (50, 90))
    return [_deviation(error_m, 50) / _NORMAL_MEDIAN, float(np.exp(logs[0])), float(logs[1] - logs[0]) / _UPPER_TAIL]


def _deviation(error_m: Array, percent: float) -> float:
    return float(np.percentile(np.abs(error_m - np.median(error_m)), percent))


def _chi2(error: Array, cov: Array) -> float:
    """Returns the squared Mahalanobis norm e' C^-1 e of an error e with covariance C."""
    return float(error @ np.linalg.solve(cov, error))


def _sigma_ratio(cov: Array, other: Array) -> float:
    """Returns the ratio of the standard deviations of two covariances, as geometric mean over the directions."""
    return float(np.exp((np.linalg.slogdet(cov)[1] - np.linalg.slogdet(other)[1]) / (2 * len(cov))))
