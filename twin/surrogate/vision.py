"""Visual measurements of a surrogate survey: true values with errors sampled from an error model.

The surrogate is part of the simulated world: it uses the truth and returns only measurements, each with the covariance
that the image-based estimators would report. A raster of points represents all matched points of a keyframe; the noise
of one is that of the mean of the matched points that it represents. Links are computed from the raster points by the
same equations as from matched points. The noise of a stereo pair is sampled once and enters all links of the keyframe:
in full if it is the later one of the link, else with the fraction `ErrorModel.match_bias_fraction`.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import cast_pixels, height_field
from twin.core.quality import EpipolarError, YawEffect
from twin.core.records import ElevationMap, Frame, Image, MapGrid, StereoObservation, StereoRig, SurveyResult
from twin.core.settings import COMMON_BIAS_PX, MIN_INLIER_SHARE, EstimatorSettings, braking_factor
from twin.core.timing import StageTimer
from twin.estimate.mapping import elevation
from twin.estimate.mapping.map_builder import with_calibration_sigma
from twin.estimate.vision import stereo
from twin.estimate.vision.f2f import MAX_POINTS as F2F_POINTS
from twin.estimate.vision.f2f import MIN_MATCHED, NOT_MATCHED, constant_velocity_motion
from twin.estimate.vision.mosaic import Registration
from twin.estimate.vision.stereo import Keyframe, StereoPoints
from twin.estimate.vision.two_view_motion import Motion
from twin.surrogate import sampling
from twin.surrogate.coverage import RENDERED, unmodelled
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.map_model import Index, MapModel
from twin.surrogate.matchability import Matchability
from twin.surrogate.measured_view import MeasuredRows, measured_view
from twin.surrogate.mosaic_model import Cells, MosaicModel, floor_cells
from twin.terrains import Terrain
from twin.world.mission import Mission
from twin.world.top_surface import true_heights
from twin.world.world import streams

_RASTER = (6, 8)  # rows and columns of the raster of points
_RELIEF_CELLS = 128  # number of floor cells in x and in y after which the sampled errors due to relief repeat
_CORNER_AREA_PX2 = 75.0  # smallest image area per detected corner, in rendered surveys
_MIN_POINTS = 12  # smallest number of matched points for a keyframe or a link
_BLOCK = 4096  # random numbers generated at a time
#: Largest relative increase of a link's squared median residual due to relief: matches shifted more are outliers.
_RESIDUAL_GROWTH = 2.0


class KeyframeTruth(NamedTuple):
    """True geometry and sampled noise of a keyframe."""

    pose: Array  #: (4, 4) true pose
    points: Array  #: (n, 3) true normalised (x, y, disparity) of the raster points that are inside both images
    raster_indices: Index  #: (n,) index of each point in the raster
    noise: Array  #: (rows, cols, 3) standard normal samples of the stereo errors of the raster points
    bound_px: float  #: Cramér-Rao bound of a patch's position
    unevenness_px: float  #: `Matchability.unevenness_at` its depth
    n_points: float  #: number of matched points that the raster points represent
    baseline_m: float  #: stereo baseline [m]
    #: (6, 6) covariance of a motion estimated from known depth and flow vectors of unit standard deviation
    unit_cov: Array
    cells: Cells  #: (n,) floor cells of the points
    clear_share: float  #: fraction of the matches that remain in the presence of marine snow
    noise_ratio: float  #: ratio of the scatter of the row differences to that expected from noise (`MeasuredRows`)
    disparity: float  #: mean normalised disparity of the points

    @property
    def stereo_parallax_px(self) -> float:
        """Returns the RMS parallax of the relief in a patch between the two cameras."""
        return self.unevenness_px * self.disparity

    def parallax_px(self, earlier_pose: Array) -> float:
        """Returns the RMS parallax of the relief in a patch between the keyframe and an earlier pose (4, 4)."""
        moved_m = self.pose[:3, 3] - earlier_pose[:3, 3]
        return self.unevenness_px * math.sqrt(moved_m.dot(moved_m)) * self.disparity / self.baseline_m


class FrameErrors(NamedTuple):
    """Distribution of the errors of frame-to-frame motions until the next keyframe."""

    root: Array  #: (6, 6) lower Cholesky factor of the true covariance of the independent error of a motion
    cov: Array  #: (6, 6) reported covariance of a motion
    anticorrelation: float  #: `ErrorModel.f2f_anticorrelation`
    gain: Array  #: `MeasuredView.motion_gain`


class SurrogateVision:
    """Implementation of `Vision` that samples measurements from an error model.

    `true_pose` returns the current true world_from_camera (4, 4) of the left camera. `rig` is the calibration that the
    estimators use, at the scale of the images that they match, which may be binned; `view` has the positions at which
    they measure true points. `last_pose` (4, 4) is the true one of the last frame, None before the first one;
    `last_normals` (6,) are the normal samples of the last frame-to-frame motion, 0 after tracking was restarted;
    `frame_errors` is the error distribution of the current ones, None without points to track.

    Raises UnmodelledError if marine snow prevents all matches at `Matchability.medium_depth_m`; so does `build_map` if
    the error model gives a height that is not finite.
    """

    runs_in_background = False  # sampling a link takes less time than a thread switch

    def __init__(self, mission: Mission, model: ErrorModel, true_pose: Callable[[], Array], stopwatch: StageTimer):
        scenario, terrain = mission.scenario, mission.terrain
        self._unmodelled = partial(unmodelled, mission)
        rng, settings = streams(scenario.seed)["surrogate"], scenario.estimator_settings()
        self.matchability = matchability = _matchability(mission)
        self.view = view = measured_view(mission.true_cameras, mission.rig, matchability.depths_m)
        self._tracked_view = view  # of the keyframe whose points are tracked
        self.floor = height_field(terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m)
        self.rig = rig = mission.rig.binned(matchability.binning)
        self._map_model_of = partial(_map_model, terrain, (rig, self.floor, matchability, view))
        self.map_model = self._map_model_of(mission.grid)
        self.settings, self.model, self.stopwatch = settings, model, stopwatch
        self._true_pose, self._rng = true_pose, rng
        margin_px = float(stereo.margin_px(settings.patch_px))
        self._camera = (
            rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px), float(rig.height_px), margin_px, rig.baseline_m,
        )  # fmt: skip
        self.n_corners = corner_count(rig, settings)
        self._pixels = _raster(rig, margin_px)
        middle = rig.baseline_m / float(np.median(matchability.depths_m))
        self._rays = view.true_directions(rig.normalised(self._pixels), middle)  # of the true points
        self._true_pixels = self._rays * rig.focal_px + [rig.cx_px, rig.cy_px]
        exact = view.is_ideal and not rig.yaw_sigma_rad
        self._rows = None if exact else MeasuredRows(view, rig, settings.patch_px, rng)
        self.last_pose: Array | None = None
        self.last_normals = np.zeros(6)
        self._tracking_cov: Array | None = None
        self._poses: dict[int, Array] = {}  # true poses of all keyframes
        self._pose_at: dict[int, Array] = {}  # the same, by the row of the frame
        self._keyframes: dict[int, KeyframeTruth] = {}  # keyframes that may still be linked
        self._latest: KeyframeTruth | None = None
        self.stereo_observations: list[StereoObservation] = []
        self.frame_errors: FrameErrors | None = None
        self._last_motion, self._blind_s = np.eye(4), 0.0  # blind: time without points to track
        self._mosaic = MosaicModel()
        self._link_rng = np.random.Generator(np.random.Philox(key=[int(rng.integers(2**63)), 0]))
        self._link_start: Any = self._link_rng.bit_generator.state  # with the counter 0
        self._normals, self._n_used = np.zeros((0, 6)), 0
        self._relief_noise = rng.standard_normal((_RELIEF_CELLS, _RELIEF_CELLS, 2))
        origin = np.zeros((1, 2))
        # covariance of a stereo point for a standard deviation of one pixel of a position in each image
        self._unit_cov = stereo.fuse(origin, origin, np.eye(2)[None], rig)[1][0]
        self._unit_root = np.linalg.cholesky(self._unit_cov)

    @property
    def latest(self) -> KeyframeTruth:
        """Returns the last keyframe with a stereo observation."""
        assert self._latest is not None
        return self._latest

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        pose = self._true_pose()
        previous, self.last_pose = self.last_pose, pose
        if previous is None:
            return Motion(np.eye(4), np.eye(6) * 1e-12, 0, 0.0), "ok"
        if (errors := self.frame_errors) is None:
            self._tracking_cov = None
            interval_s = 1 / self.rig.frame_rate_hz
            factor = braking_factor(self._blind_s, interval_s, self.settings.stops_if_blind)
            self._blind_s += interval_s
            if factor < 1:
                self._last_motion = geometry.exp(factor * geometry.log(self._last_motion))
            return constant_velocity_motion(self._last_motion), NOT_MATCHED
        self._blind_s = 0.0
        normals = self.draw_normals(1)[0]
        self._last_motion = sampling.sample_f2f_motion(errors, previous, pose, normals, self.last_normals)
        self.last_normals = normals
        return Motion(self._last_motion, errors.cov, F2F_POINTS, 0.0), "ok"

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        self.frame_errors = None  # no points to track until `restart_tracking`
        with self.stopwatch("stereo"):
            pose = self._true_pose()
            self.map_model.mark_seen(pose)
            depth_m = cast_pixels(self.floor, pose[None], self.rig, self._true_pixels)[0]
            hits = np.flatnonzero((depth_m > 0) & (depth_m < np.inf))  # 0: the camera is below the floor
            enough = len(hits) >= sampling.MIN_POINTS
            mean_m = float(depth_m[hits].mean()) if enough else math.nan
            seen, n_points = self._matched_points(hits, depth_m, mean_m) if enough else (hits, 0.0)
            # points of one row or column of the raster do not determine a motion
            in_line = len(seen) > 0 and min(map(np.ptp, np.unravel_index(seen, _RASTER))) == 0
            if n_points < _MIN_POINTS or len(seen) < sampling.MIN_POINTS or in_line:
                self.stereo_observations.append(StereoObservation(row, int(n_points), None))
                return None
            self._pose_at[row] = pose
            return self._sample_stereo(pose, row, seen, depth_m, n_points, mean_m)

    def _matched_points(self, hits: Index, depth_m: Array, mean_m: float) -> tuple[Index, float]:
        """Returns the raster points (n,) that are matched, of those that show the floor, and the number of matches."""
        matchability = self.matchability
        share = self.model.point_fraction(float(matchability.bound_at(mean_m))) * matchability.clear_share_at(mean_m)
        points = self._true_points(hits, depth_m)
        matched = np.ones(len(hits), np.bool_) if self._rows is None else self._rows.are_matched(points)
        n_points = len(hits) / len(self._rays) * share * self.n_corners * float(matched.mean())
        return hits[matched & self._in_both_images(points)], n_points

    def _sample_stereo(
        self, pose: Array, row: int, hits: Index, depth_m: Array, n_points: float, mean_m: float
    ) -> StereoPoints:
        """Samples the positions of the raster points `hits` in a stereo pair, and keeps the keyframe's truth."""
        points, rig, matchability = self._true_points(hits, depth_m), self.rig, self.matchability
        bound_px, n = float(matchability.bound_at(mean_m)), len(points)
        measured, self._tracked_view = self.view.measure(points), self.view
        noise = self._rng.standard_normal((*_RASTER, 3))
        n_tracked = F2F_POINTS / overlap_inflation(F2F_POINTS, rig, self.settings.patch_px)
        unit_cov = sampling.unit_motion_cov(measured, rig.baseline_m, n_tracked)
        observation, noise_ratio = StereoObservation(row, int(n_points), None), 1.0
        if self._rows is not None:
            level_px = self.model.match_sigma_px(bound_px, 0.0)
            observation, noise_ratio = self._rows.observe(observation, points, level_px)
        self.stereo_observations.append(observation)
        latest = self._latest = KeyframeTruth(
            pose, points, hits, noise, bound_px, matchability.unevenness_at(mean_m), n_points, rig.baseline_m, unit_cov,
            floor_cells(pose, points, rig.baseline_m), matchability.clear_share_at(mean_m), noise_ratio,
            float(np.mean(points[:, 2])),
        )  # fmt: skip
        sigma_px = self.model.match_sigma_px(bound_px, latest.stereo_parallax_px) * np.sqrt(n / n_points)
        measured = measured + noise.reshape(-1, 3)[hits] @ (self._unit_root.T * sigma_px)
        xyz = np.column_stack([measured[:, :2], np.ones(n)]) * (rig.baseline_m / measured[:, 2:])
        cov = np.broadcast_to(self._unit_cov * (sigma_px * noise_ratio) ** 2, (n, 3, 3))
        pixels, around_px = self._pixels[hits].astype(np.float32), rig.focal_px * measured[:, 2]
        return StereoPoints(pixels, np.zeros((n, 2)), around_px, measured, cov, xyz, np.zeros(n))

    def _true_points(self, indices: Index, depth_m: Array) -> Array:
        return np.column_stack([self._rays[indices], self.rig.baseline_m / depth_m[indices]])

    def _in_both_images(self, points: Array) -> NDArray[np.bool_]:
        """Returns the mask (n,) of the true points (n, 3) whose patches lie inside both images."""
        measured = self.view.measure(points)
        left_px = measured[:, :2] * self.rig.focal_px + [self.rig.cx_px, self.rig.cy_px]
        right_px = left_px - np.column_stack([self.rig.focal_px * measured[:, 2], np.zeros(len(measured))])
        in_left, in_right = (stereo.well_inside(px, self.rig, self.settings.patch_px) for px in (left_px, right_px))
        return in_left & in_right

    def tracking_cov(self) -> Array | None:
        return self._tracking_cov

    def restart_tracking(self, velocity: Array | None = None) -> None:
        model = self.model
        if model.rematched(self.latest.bound_px) * self.latest.clear_share < MIN_MATCHED:
            return  # vision is lost until the next keyframe
        root, cov = self._motion_errors(float(model.difference_sigma_px(self.latest.bound_px)))
        independent = 1 / np.sqrt(1 + model.f2f_anticorrelation**2)
        gain = self._tracked_view.motion_gain(self.latest.points, self.rig.baseline_m)
        self.frame_errors = FrameErrors(independent * root, cov, model.f2f_anticorrelation, gain)
        self.last_normals, self._tracking_cov = np.zeros(6), cov

    def _motion_errors(self, sigma_px: float) -> tuple[Array, Array]:
        """Returns the lower Cholesky factor and the covariance (6, 6) of a motion estimated from flow."""
        cov = self.latest.unit_cov * (sigma_px / self.rig.focal_px) ** 2
        return np.asarray(np.linalg.cholesky(cov), np.float64), cov

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        view = self._mosaic.view(self.latest.cells)
        if view is None:
            return None
        points, pose, camera = self.latest.points, self.latest.pose, (*self._camera, self.view.table)
        cov = self._unit_cov * self.model.match_sigma_px(self.latest.bound_px, 0.0) ** 2
        measured = np.array([
            sampling.measured_motion(points, self._poses[number], pose, camera, cov)
            for number in view.numbers
        ])  # fmt: skip
        mean = sampling.mosaic_correction(view.estimated, measured, view.fractions, world_from_camera)
        root, cov = self._motion_errors(self.model.mosaic_sigma_px / np.sqrt(view.coverage))
        error = root @ self.draw_normals(1)[0] * self.model.mosaic_error_ratio
        correction = Motion(geometry.exp(mean + error), cov, len(self.latest.points), 1.0)
        return Registration(correction, view.numbers[int(np.searchsorted(np.cumsum(view.fractions), 0.5))])

    def add_to_mosaic(self, number: int, world_from_camera: Array) -> None:
        self._poses[number], self._keyframes[number] = self.latest.pose, self.latest
        self._mosaic.add(number, world_from_camera, self.latest.cells)

    def rebuild_mosaic(self, keyframes: Sequence[Keyframe]) -> None:
        self._mosaic.clear()
        for keyframe in keyframes:
            cells = self._keyframes[keyframe.number].cells
            self._mosaic.add(keyframe.number, keyframe.world_from_camera, cells)

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        with self.stopwatch("network"):
            return self.sample_links(node, others, self.model)

    def epipolar_error(self) -> EpipolarError | None:
        return None if self._rows is None else self._rows.report()

    def correct_yaw(self, yaw_rad: float, sigma_rad: float) -> None:
        if self._rows is not None:
            self.view = self._rows.correct_yaw(yaw_rad, sigma_rad)

    def discard(self, numbers: range) -> None:
        for number in numbers:
            self._keyframes.pop(number, None)

    def sample_links(self, node: Keyframe, others: Sequence[Keyframe], model: ErrorModel) -> list[Motion | None]:
        """Samples the motions of a node from earlier ones; None if too few points or too small a part are matched."""
        if not others:
            return []
        later, earlier = self._keyframes.get(node.number, self.latest), [self._keyframes[k.number] for k in others]
        n, lamp_factor = len(later.points), float(model.lamp_factor(self.matchability.lamp_share))
        laws = [self._link_law(later, one, model) for one in earlier]
        found, (_, _, sigma_px, scale, share) = list[Motion | None](), np.array(laws).T.copy()
        counts, motions, covs, yaws = sampling.sample_links(
            later.points, later.noise.reshape(-1, 3)[later.raster_indices],
            np.array([one.noise for one in earlier]), self._relief_noise,
            np.array([self._link_normals(node.number, k.number, n + 1) for k in others]),
            np.array([one.pose for one in earlier]), later.pose,
            (*self._camera, self.view.without_yaw(node.yaw_rad).table), self._unit_cov,
            np.array([(law[2] * later.noise_ratio) ** 2 for law in laws]), self._unit_root, sigma_px * lamp_factor,
            model.match_bias_fraction,
            model.relief_gain * lamp_factor * later.unevenness_px / self.rig.focal_px * scale,
            model.distance_growth, COMMON_BIAS_PX / self.rig.focal_px, share,
        )  # fmt: skip
        for k, (stereo_sigma_px, match_fraction, *_) in enumerate(laws):
            n_matched = int(counts[k] / n * later.n_points * match_fraction)
            if counts[k] < sampling.MIN_POINTS or n_matched < _MIN_POINTS or match_fraction < MIN_INLIER_SHARE:
                found.append(None)
                continue
            # relief increases the variance of the difference of a match's two image positions, 2 sigma^2 without it
            growth = 1 + (model.relief_gain * later.parallax_px(earlier[k].pose)) ** 2 / (2 * stereo_sigma_px**2)
            residual = math.sqrt(1 + _RESIDUAL_GROWTH * (growth - 1) / (growth + 1))
            (turned_rad, sigma_rad), by_yaw = yaws[k, :2].tolist(), yaws[k, 2:]
            yaw = YawEffect(node.yaw_rad + turned_rad, sigma_rad * growth**0.5, by_yaw, node.yaw_rad)
            known = yaw if math.isfinite(sigma_rad) else None
            found.append(Motion(motions[k], covs[k] * growth, n_matched, residual, yaw=known))
        return found

    def _link_law(self, later: KeyframeTruth, earlier: KeyframeTruth, model: ErrorModel) -> tuple[float, ...]:
        """Returns the standard deviation of a match in one image [px], the fraction of points that are matched,
        the standard deviation of the mean that a raster point represents [px], the ratio of both, and `noise_share`.
        """
        n, bound_px = len(later.points), max(later.bound_px, earlier.bound_px)
        sigma_px = model.match_sigma_px(bound_px, max(later.stereo_parallax_px, earlier.stereo_parallax_px))
        match_fraction = min(later.clear_share, earlier.clear_share) * model.rematched(bound_px)
        n_matches = later.n_points * match_fraction
        scale = math.sqrt(n / n_matches * overlap_inflation(n_matches, self.rig, self.settings.patch_px))
        return sigma_px, match_fraction, sigma_px * scale, scale, n / n_matches

    def _link_normals(self, number: int, other: int, n: int) -> Array:
        """Returns standard normal numbers (n, 3) of a link, which depend on seed and keyframe numbers only."""
        self._link_start["state"]["counter"][2:] = number, other
        self._link_rng.bit_generator.state = self._link_start
        return self._link_rng.standard_normal((n, 3))

    def left_image(self, row: int) -> Image | None:
        return None

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        mapper, rng = elevation.ElevationMapper(grid), self._rng
        map_model = self.map_model if grid == self.map_model.grid else self._map_model_of(grid)
        calibration = result.quality.calibration
        map_model.calibrate(calibration)
        noise = map_model.new_noise(self.model, rng)
        estimated = result.final.world_from_camera[result.keyframe_rows]
        true = [self._pose_at[row] for row in result.keyframe_rows.tolist()]
        following = map_model.observe(true[0], estimated[0]) if true else None
        for k, cov in enumerate(result.node_cov):
            observed, is_last = following, k == len(true) - 1
            following = None if is_last else map_model.observe(true[k + 1], estimated[k + 1])
            try:
                patch = observed and map_model.sample_patch(observed, following, cov, self.model, noise, rng)
            except FloatingPointError as error:  # so that a study counts it as unknown, not as failed
                raise self._unmodelled([(str(error), RENDERED)]) from None
            if patch is not None:
                mapper.fuse(patch)
            progress(k + 1)
        return with_calibration_sigma(mapper.result(), estimated, self.rig, calibration)

    def draw_normals(self, n: int) -> Array:
        """Returns the next standard normal numbers (n, 6), which are generated in blocks."""
        while self._n_used + n > len(self._normals):
            fresh = self._rng.standard_normal((_BLOCK, 6))
            self._normals, self._n_used = np.concatenate([self._normals[self._n_used :], fresh]), 0
        self._n_used += n
        return self._normals[self._n_used - n : self._n_used]


def _map_model(terrain: Terrain, known: tuple[Any, ...], grid: MapGrid) -> MapModel:
    return MapModel(grid, true_heights(grid, terrain.height_at), *known)


def _matchability(mission: Mission) -> Matchability:
    """Returns the matchability of a mission; raises UnmodelledError if marine snow prevents all matches."""
    found = Matchability(mission.scenario, mission.illumination, mission.terrain, mission.plan.area.at_fractions)
    if not math.isfinite(found.medium_bound_px):
        where = f"marine snow prevents all matches of the floor at a depth of {found.medium_depth_m:.3g} m"
        problem = f"the surrogate cannot simulate this survey: {where}"
        raise unmodelled(mission, [(problem, f"less [snow], or {RENDERED}")])
    return found


def corner_count(rig: StereoRig, settings: EstimatorSettings) -> float:
    """Returns the number of points to match in an image; a small one has fewer, or a grid (`matching.corners`)."""
    corners = rig.width_px * rig.height_px / _CORNER_AREA_PX2
    return float(settings.points if corners < settings.points / 2 else min(corners, settings.points))


def overlap_inflation(n_points: float, rig: StereoRig, patch_px: int) -> float:
    """Returns the variance of a mean over n patches, relative to that of patches without common pixels."""
    # the expected value of `matching.variance_inflation` for patches spread at random, which share a fraction
    # patch_px^2 / (width height) of their pixels on average
    return 1 + n_points * patch_px**2 / (rig.width_px * rig.height_px)


def _raster(rig: StereoRig, margin_px: float) -> Array:
    """Returns the pixels (n, 2) of the raster points, evenly spaced over the part of the image with matches."""
    sides = zip(_RASTER, (rig.height_px, rig.width_px), strict=True)
    axes = (margin_px + (np.arange(n) + 0.5) / n * (side - 2 * margin_px) for n, side in sides)
    v, u = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    return np.column_stack([u, v]) - 0.5
