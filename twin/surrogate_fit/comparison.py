"""Statistics that compare image measurements with surrogate measurements and with the truth, for the fit.

During a rendered survey, every measurement is made in the images and is also sampled by the surrogate at the same true
poses. Most statistics are ratios of the reported standard deviations (image measurement / surrogate), or errors
relative to the truth, normalised by reported covariances. Image and surrogate measurements have the same geometry,
which therefore cancels in the ratios.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import EpipolarError
from twin.core.records import ElevationMap, Frame, Image, MapGrid, SurveyResult
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision.mosaic import Registration
from twin.estimate.vision.stereo import Keyframe, StereoPoints
from twin.estimate.vision.two_view_motion import Motion
from twin.surrogate.error_model import BinnedDepthLaw, BorderErrorLaw, DepthLaw, ErrorModel, ScatterLaw, SigmaLaw
from twin.surrogate.map_model import WALL_SLOPE
from twin.surrogate.vision import SurrogateVision

_MIN_CELLS = 200  # smallest number of cells of a class; half as many near borders, a tenth for fractions of holes
_STEEP_SLOPE = 0.6  # rise over run that level cells do not reach
_VIEW_BINS = (1, 2, 3, 4, 6, 9, 15, 26, 10_000)  # first number of keyframes of each class of level cells, and the end
ROUGH_PX = 0.25  #: roughness that smooth and level cells do not reach [px]
#: Classes of level cells by name, with their lowest and highest roughness.
_RELIEF_BINS_PX = {"smooth": (0.0, 0.03), "rough": (0.03, 0.08), "rougher": (0.08, ROUGH_PX)}
_EDGE = "edge"  # first part of the names of the classes of cells near walls
_EDGE_BINS = (0.15, 0.3, 0.5, 0.8, 1.2, np.inf)  # `edge_strength` of these classes
_ROUGHNESS_BINS_PX = (0.0, ROUGH_PX, 0.5, 1.0, 2.0, 4.0, 8.0, np.inf)
_BORDER_BINS_PX = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0, 15.0, 20.0)  # see `MapModel.border_px`
_DISTANCE_BINS_PX = (0.0, 2.0, 4.0, 7.0, 12.0, 20.0, 40.0)  # see `MapModel.border_distance_px`
_GROSS = 5.0  # error / sigma beyond which an error counts as a gross error
_HEAVY_P90 = 1.562  # 90th percentile of the absolute value of `map_model.heavy_tailed`
_NORMAL_P90 = 1.2816  # 90th percentile of a standard normal variable
_NONE = DepthLaw(1e-4, 0.0, 0.0, 1.0, 0.0, 0.0)
_NO_CHANGE = BinnedDepthLaw(1.0, 1.0, _NONE.common, _NONE.gain, _NONE.noise_gain)
UNIT_PX = 0.1  #: standard deviation of the depth in the sampled map "depth", for any number of keyframes [px]
#: Quantities of a class of map cells, in the order of the statistic `map_<error or sigma>_<class>`: variances of the
#: maps from images and sampled maps [m^2], and conditions of the class.
MAP_STATISTICS = ("images", "pose", "depth", "lateral", "edge", "all", "views", "step_baselines", "roughness_px")
#: Parameter values of the models of `single_error_models`, in which one error source acts alone.
BIAS_FRACTION, RELIEF_GAIN = 0.8, 0.2


class ComparisonVision:
    """Implementation of `Vision` that measures in images and collects statistics of a comparison with the surrogate.

    Args:
        images: vision that measures in images; its measurements are returned.
        surrogate: vision that samples the same measurements from an error model.
        true_pose: returns the current true pose (4, 4) of the left camera.

    Attributes:
        statistics: samples by name. `..._sigma_ratio` is the ratio of the standard deviation reported for the image
            measurement to the one that the surrogate reports. `..._nees...` is a squared error or difference,
            normalised by a reported covariance and divided by the number of degrees of freedom.
    """

    def __init__(self, images: StereoVision, surrogate: SurrogateVision, true_pose: Callable[[], Array]):
        self.images, self.surrogate, self._true_pose = images, surrogate, true_pose
        self.stereo_observations = images.stereo_observations
        self.runs_in_background = images.runs_in_background
        self.statistics: dict[str, list[float]] = defaultdict(list)
        self.statistics["lamp_share"] = [surrogate.lamp_share]
        texture = surrogate.scene.matchability.texture
        self.statistics["window_ratio"], self.statistics["texture_scatter"] = [texture.median_ratio], [texture.scatter]
        self._poses: dict[int, Array] = {}
        self._last_node = -1
        self._last_link: tuple[int, dict[str, Array]] = (-1, {})  # end node and errors of the chain's previous link
        self._last_pose: Array | None = None
        self._frames: list[tuple[Array, Array]] = []  # error and covariance of each F2F motion since the last keyframe

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        (measured, status), (sampled, _) = self.images.track_frame(frame), self.surrogate.track_frame(frame)
        last, self._last_pose = self._last_pose, self._true_pose()
        self.statistics["frame_lost"].append(float(status != "ok"))
        if last is not None and status == "ok" and measured.n_points:
            true = geometry.inverse(last) @ self._last_pose
            self.statistics["f2f_sigma_ratio"].append(_sigma_ratio(measured.cov, sampled.cov))
            errors = [geometry.log(geometry.inverse(true) @ motion.a_from_b) for motion in (measured, sampled)]
            self.statistics["f2f_nees"].append(_chi2(errors[0], measured.cov) / 6)
            self.statistics["f2f_nees_surrogate"].append(_chi2(errors[1], sampled.cov) / 6)
            self._frames.append((errors[0], measured.cov))
        return measured, status

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        points, sampled = self.images.observe_stereo(frame, row), self.surrogate.observe_stereo(frame, row)
        self.statistics["binning"] = [float(self.images.binning), float(self.surrogate.binning)]
        if len(self._frames) > 1:
            error, cov = (np.sum(x, axis=0) for x in zip(*self._frames, strict=True))
            self.statistics["f2f_interval_nees"].append(_chi2(error, cov) / 6)
            self.statistics["f2f_interval_frames"].append(float(len(self._frames)))
        self._frames = []
        if points is not None and sampled is not None:
            self.statistics["point_fraction"].append(len(points.xyz) / self.surrogate.n_corners)
            latest = self.surrogate.latest
            traces = [float(np.median(np.trace(x.cov, axis1=1, axis2=2))) for x in (points, sampled)]
            sigma_ratio = np.sqrt(traces[0] / traces[1] * (len(latest.points) / latest.n_points))
            self.statistics["match_sigma_ratio"].append(float(sigma_ratio))
            self.statistics["bound_px"].append(latest.bound_px)
            self.statistics["stereo_parallax_px"].append(latest.stereo_parallax_px)
        return points

    def tracking_cov(self) -> Array | None:
        return self.images.tracking_cov()

    def restart_tracking(self) -> None:
        self.images.restart_tracking()
        self.surrogate.restart_tracking()

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        measured = self.images.register_with_mosaic(world_from_camera)
        sampled = self.surrogate.register_with_mosaic(world_from_camera)
        if measured is not None and sampled is not None:
            ours, theirs = measured.correction, sampled.correction
            self.statistics["mosaic_sigma_ratio"].append(_sigma_ratio(ours.cov, theirs.cov))
            difference = geometry.log(geometry.inverse(theirs.a_from_b) @ ours.a_from_b)
            self.statistics["mosaic_difference_nees"].append(_chi2(difference, theirs.cov) / 6)
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

    def discard(self, numbers: range) -> None:
        self.images.discard(numbers)
        self.surrogate.discard(numbers)

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        """Returns the links measured in images, and adds statistics of their comparison with sampled links.

        Links are sampled with all errors and with one error source at a time (`single_error_models`).
        """
        measured = {"images": self.images.measure_motions(node, others)}
        models = {"all": self.surrogate.model, **single_error_models(self.surrogate.model)}
        measured |= {name: self.surrogate.sample_links(node, others, model) for name, model in models.items()}
        pose = self._poses.get(node.number)
        node_pose = self._true_pose() if pose is None else pose
        for k, other in enumerate(others):
            links = {name: motions[k] for name, motions in measured.items()}
            true = geometry.inverse(self._poses[other.number]) @ node_pose
            self._compare_link(other.number, node.number, links, true)
        self._last_node = node.number
        return measured["images"]

    def _compare_link(self, i: int, j: int, links: dict[str, Motion | None], true: Array) -> None:
        """Adds the statistics of one link, measured in images and sampled from each error model."""
        measured, sampled = links["images"], links["all"]
        self.statistics["link_failed_images"].append(float(measured is None))
        self.statistics["link_failed_surrogate"].append(float(sampled is None))
        if sampled is not None:
            self.statistics["link_parallax_px"].append(self.surrogate.latest.parallax_px(self._poses[i]))
            n_points = 0 if measured is None else measured.n_points
            self.statistics["link_matched"].append(n_points / sampled.n_points)
        if measured is None or sampled is None:
            return
        self.statistics["link_sigma_ratio"].append(_sigma_ratio(measured.cov, sampled.cov))
        self.statistics["link_distance"].append(self.surrogate.latest.distance_in_depths(true))
        errors = {name: geometry.log(geometry.inverse(true) @ m.a_from_b) for name, m in links.items() if m is not None}
        for name, error in errors.items():
            self.statistics[f"link_nees_{name}"].append(_chi2(error, sampled.cov) / 6)
        if i == self._last_node:
            (end, previous), self._last_link = self._last_link, (j, errors)
            sigma, adjoint = np.sqrt(np.diag(sampled.cov)), geometry.adjoint(geometry.inverse(true))
            for name, last in previous.items() if end == i else ():
                product = float(adjoint @ last / sigma @ (errors[name] / sigma)) / 6
                self.statistics[f"consecutive_product_{name}"].append(product)

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        """Returns the map from images, and adds statistics of its comparison with sampled maps along the same path.

        There are five sampled maps: one with pose errors alone; three with pose errors and one other kind of error of
        known size (depth errors of `UNIT_PX`, lateral errors of 1 px, or errors near walls with the gain 1); and one
        with all errors of the error model, without the scatter of depth errors between surveys.
        """
        elevation, model = self.images.build_map(result, grid, step_cov, progress), self.surrogate.model
        none = model._replace(
            depth_error=_NONE, depth_sigma=_NONE, lateral_sigma_px=0.0, relief_error_gain=0.0,
            edge_error=SigmaLaw(0.0, 0.0), edge_sigma_gain=0.0, border_error=BorderErrorLaw(0.0, 1.0),
            depth_texture_scatter=ScatterLaw(0.0, 1.0), depth_survey_scatter=0.0, depth_ratio_scatter=0.0,
            depth_binned_error=_NO_CHANGE, depth_binned_sigma=_NO_CHANGE,
        )  # fmt: skip
        unit = _NONE._replace(floor_px=UNIT_PX)
        models = {
            "pose": none,
            "depth": none._replace(depth_error=unit, depth_sigma=unit),
            "lateral": none._replace(lateral_sigma_px=1.0),
            "edge": none._replace(edge_error=SigmaLaw(1.0, 0.0), edge_sigma_gain=1.0),
            "all": model._replace(depth_survey_scatter=0.0, depth_ratio_scatter=0.0),
        }
        maps = {"images": elevation}
        for name, self.surrogate.model in models.items():
            maps[name] = self.surrogate.build_map(result, grid, step_cov, lambda _: None)
        self.surrogate.model = model
        rig, map_model = self.surrogate.rig, self.surrogate.scene.map_model
        self.statistics["metres_per_px"] = [map_model.depth_m**2 / (rig.focal_px * rig.baseline_m)]
        for name, cells in self._cell_classes().items():
            self._compare_maps(name, cells, maps)
        self._compare_borders(maps)
        self._count_holes(elevation)
        return elevation

    def _compare_maps(self, name: str, cells: np.ndarray, maps: dict[str, ElevationMap]) -> None:
        """Adds four statistics of a class of cells: variance of errors, reported variance, tail ratio and scatter."""
        map_model = self.surrogate.scene.map_model
        heights = np.array([elevation.height_m for elevation in maps.values()])
        known = cells & map_model.seen & np.isfinite(heights).all(axis=0)
        if known.sum() < _MIN_CELLS:
            return
        errors = (heights - map_model.height_m)[:, known].astype(np.float64)
        sigmas = np.array([elevation.sigma_m[known] for elevation in maps.values()], np.float64)
        typical = np.median(sigmas, axis=1)
        normalised = np.abs(errors - np.median(errors, axis=1, keepdims=True)) / np.maximum(sigmas, 1e-12)
        variances = np.mean(np.square(np.minimum(normalised, _GROSS)), axis=1) * typical**2
        if name.startswith(_EDGE):
            centred = np.abs(errors - np.median(errors, axis=1, keepdims=True))
            variances = np.square(np.percentile(centred, 90, axis=1) / _HEAVY_P90)
        reported = np.square(typical)
        names = list(maps)
        log_ratio = np.log(sigmas[names.index("images")] / sigmas[names.index("depth")])
        scatter = np.diff(np.percentile(log_ratio, (50, 90))) / _NORMAL_P90
        conditions = [
            float(np.mean(map_model.views[known])), float(np.median(map_model.step_baselines[known])),
            float(np.sqrt(np.mean(self._in_px(map_model.roughness_m)[known] ** 2))),
        ]  # fmt: skip
        self.statistics[f"map_error_{name}"] = [*variances.tolist(), *conditions]
        self.statistics[f"map_sigma_{name}"] = [*reported.tolist(), *conditions]
        self.statistics[f"map_scatter_{name}"] = scatter.tolist()
        centred = np.abs(errors - np.median(errors, axis=1, keepdims=True))[[names.index("images"), names.index("all")]]
        median, p90 = np.maximum(np.percentile(centred, (50, 90), axis=1), 1e-12)
        self.statistics[f"map_tail_{name}"] = (p90 / median).tolist()

    def _compare_borders(self, maps: dict[str, ElevationMap]) -> None:
        """Adds the ratios of errors and of reported standard deviations near image borders, images / sampled map."""
        map_model = self.surrogate.scene.map_model
        images, sampled = maps["images"], maps["all"]
        steepest = np.asarray(maximum_filter(map_model.steepness, 2 * map_model.window_cells + 1))
        level = (
            map_model.seen
            & (steepest <= WALL_SLOPE)
            & (self._in_px(map_model.roughness_m) < _RELIEF_BINS_PX["rough"][1])
        )
        level &= np.isfinite(images.height_m) & np.isfinite(sampled.height_m)
        for low, high in pairwise((*_DISTANCE_BINS_PX, np.inf)):
            cells = level & (map_model.border_distance_px >= low) & (map_model.border_distance_px < high)
            if cells.sum() < _MIN_CELLS / 2:
                continue
            errors = [np.median(np.abs(x.height_m - map_model.height_m)[cells]) for x in (images, sampled)]
            sigmas = [np.median(x.sigma_m[cells]) for x in (images, sampled)]
            self.statistics["border_error_ratio"].append(float(errors[0] / max(errors[1], 1e-12)))
            self.statistics["border_sigma_ratio"].append(float(sigmas[0] / max(sigmas[1], 1e-12)))
            self.statistics["border_distance_px"].append(float(np.median(map_model.border_distance_px[cells])))

    def _cell_classes(self) -> dict[str, np.ndarray]:
        """Returns the masks (rows, cols) of the classes of cells for which the errors of maps are compared, by name."""
        map_model = self.surrogate.scene.map_model
        rough = self._in_px(map_model.roughness_m)
        steepness, views, inner = map_model.steepness, map_model.views, map_model.border_px > _BORDER_BINS_PX[-1]
        wall, edge = (rough > ROUGH_PX) | (steepness > WALL_SLOPE), self._in_px(map_model.edge_m)
        plain = inner & ~np.asarray(maximum_filter(wall, 2 * map_model.window_cells + 1), np.bool_)
        classes = {"steep": plain & (steepness > _STEEP_SLOPE) & (rough < _RELIEF_BINS_PX["smooth"][1])}
        for low, high in pairwise(_EDGE_BINS):
            classes[f"{_EDGE}{low:g}"] = inner & (edge >= low) & (edge < high)
        for name, (smoothest, roughest) in _RELIEF_BINS_PX.items():
            level = plain & (steepness < _STEEP_SLOPE) & (rough >= smoothest) & (rough < roughest)
            for low, high in pairwise(_VIEW_BINS):
                classes[f"{name}{low}"] = level & (views >= low) & (views < high)
        return classes

    def _in_px(self, height_m: np.ndarray) -> np.ndarray:
        """Returns heights [m] converted to differences of disparity at the typical depth of the floor [px]."""
        rig, map_model = self.surrogate.rig, self.surrogate.scene.map_model
        return height_m * (rig.focal_px * rig.baseline_m / map_model.depth_m**2)

    def _count_holes(self, elevation: ElevationMap) -> None:
        """Adds the number of observed cells and their fraction with a height, by roughness and border distance."""
        map_model = self.surrogate.scene.map_model
        roughness = self._in_px(map_model.roughness_m)
        seen, border, known = map_model.seen, map_model.border_px, np.isfinite(elevation.height_m)
        inner, smooth = seen & (border > _BORDER_BINS_PX[-1]), seen & (roughness < ROUGH_PX)
        for name, values, cells, bins in (
            ("hole", roughness, inner, _ROUGHNESS_BINS_PX), ("border", border, smooth, _BORDER_BINS_PX),
        ):  # fmt: skip
            for low, high in pairwise(bins):
                chosen = cells & (values >= low) & (values < high)
                if chosen.sum() > _MIN_CELLS / 10:
                    self.statistics[f"{name}_cells"].append(float(chosen.sum()))
                    self.statistics[f"{name}_known"].append(float(known[chosen].mean()))
                    self.statistics[f"{name}_px"].append(float(np.median(values[chosen])))


def single_error_models(model: ErrorModel) -> dict[str, ErrorModel]:
    """Returns two error models for links: "patches" without errors due to relief, "relief" with these errors alone.

    In "patches", the relief gain is 0, the match error ratio is 1, without growth under lamps, and the bias fraction is
    `BIAS_FRACTION`. In "relief", the relief gain is `RELIEF_GAIN`, and the match error ratio and the common bias are 0.
    The other parameters are those of `model`.
    """
    return {
        "patches": model._replace(
            match_error_ratio=1.0, lamp_error_growth=0.0, match_bias_fraction=BIAS_FRACTION, relief_gain=0.0
        ),
        "relief": model._replace(match_error_ratio=0.0, relief_gain=RELIEF_GAIN, common_bias_px=0.0),
    }


def _chi2(error: Array, cov: Array) -> float:
    """Returns the squared Mahalanobis norm e' C^-1 e of an error e with covariance C."""
    return float(error @ np.linalg.solve(cov, error))


def _sigma_ratio(cov: Array, other: Array) -> float:
    """Returns the ratio of the standard deviations of two covariances (n, n), as geometric mean over n directions."""
    return float(np.exp((np.linalg.slogdet(cov)[1] - np.linalg.slogdet(other)[1]) / (2 * len(cov))))
