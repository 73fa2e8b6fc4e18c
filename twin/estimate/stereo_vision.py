from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import EpipolarError
from twin.core.records import (
    LEFT_REPEATS,
    RIGHT_REPEATS,
    RIGHT_REPEATS_BLIND,
    ElevationMap,
    Frame,
    Image,
    Map,
    MapGrid,
    SensorNoise,
    StereoObservation,
    StereoRig,
    SurveyResult,
)
from twin.core.settings import EstimatorSettings
from twin.core.timing import StageTimer, Stopwatch
from twin.estimate.mapping.map_builder import KeyframePath, MapView, build_map
from twin.estimate.vision import disparity, epipolar_calibration, matching, stereo, wide_search
from twin.estimate.vision.disparity import DenseMatch
from twin.estimate.vision.epipolar_calibration import EpipolarCalibration
from twin.estimate.vision.f2f import FrameToFrame
from twin.estimate.vision.image_quality import MAX_REPETITION, contrast, repetition, saturated_fraction
from twin.estimate.vision.image_spool import ImageSpool
from twin.estimate.vision.light_pattern import light_pattern, pattern_coefficients, pattern_difference, pattern_fit
from twin.estimate.vision.mosaic import Mosaic, Registration, can_represent, viewing_plane
from twin.estimate.vision.pair_matching import SEARCH_PX, PairMatcher
from twin.estimate.vision.repeated_images import RepeatedImages
from twin.estimate.vision.stereo import Keyframe, StereoPoints
from twin.estimate.vision.two_view_motion import Motion

_MIN_POINTS = 12  # smallest number of matched points for a keyframe
_PATTERN_PAIRS = 100  # largest number of keyframes from which the light pattern is estimated
#: A pair is matched again for the map if the light pattern has changed by more since then, RMS [grey levels]: half the
#: smallest noise.
_PATTERN_CHANGE = 0.2


class StereoVision(AbstractContextManager["StereoVision"]):
    """`Vision` from recorded or rendered stereo images, binned as `stereo.choose_binning` tells at the first keyframe.

    Use as a context manager, or call `close`. `folder` is for the images of keyframes and the tiles of the mosaic.
    `cell_m`, multiplied by the binning, is the cell size of the mosaic [m], by default the ground sample distance of
    the first keyframe at full size. `stopwatch` returns a context manager that times the stage of a given name. The
    `noise` of the navigation sensors tells a frozen camera from a vehicle at rest (`RepeatedImages`).
    """

    runs_in_background = True  # matching takes long enough to justify a separate thread

    def __init__(
        self, rig: StereoRig, settings: EstimatorSettings, folder: Path, cell_m: float | None = None,
        stopwatch: StageTimer | None = None, noise: SensorNoise | None = None,
    ):  # fmt: skip
        noise = noise or SensorNoise()
        self.repeats, self._imu_noise = RepeatedImages(settings.noisy_images, noise), noise.imu
        self.full_rig, self.settings, self.stopwatch = rig.with_square_pixels(), settings, stopwatch or Stopwatch()
        self._row_scale, self._size_px = rig.fx_px / rig.fy_px, (rig.width_px, rig.height_px)
        self._cell_m, self._folder = cell_m, folder
        self._last_s = np.nan  # time of the last frame
        self._plane_from_world: Array | None = None
        self.calibration = EpipolarCalibration()
        self._configure(binning=1)
        self.stereo_observations: list[StereoObservation] = []
        self._repetition: dict[int, float] = {}  # of the images of keyframes, by frame index
        self._in_mosaic: set[int] = set()  # numbers of the keyframes that it shows
        self._points: StereoPoints | None = None

    def _configure(self, binning: int) -> None:
        self.binning, self.rig = binning, self.full_rig.binned(binning)
        self.spool = ImageSpool(self._folder, binning)
        self._pattern_fits: dict[int, Array] = {}  # by frame index, as `_known_patterns` is
        self._known_patterns: dict[int, Array | None] = {}  # coefficients of that without which a pair was matched
        self.f2f = FrameToFrame(self.rig, self.settings.patch_px, self._imu_noise, self.settings.stops_if_blind)
        self.matcher = PairMatcher(self.rig, self.spool, self.settings.patch_px)
        self._gray = self._depth_m = np.zeros((self.rig.height_px, self.rig.width_px), np.float32)
        self._image = self._gray.astype(np.uint8)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.spool.close()
        self.matcher.close()

    @cached_property
    def mosaic(self) -> Mosaic:
        assert self._points is not None
        cell_m = self._cell_m or float(np.median(self._points.xyz[:, 2])) / self.full_rig.focal_px
        return Mosaic(cell_m * self.binning, self._folder / "mosaic")

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        check_image_sizes(frame, self._size_px)
        with self.stopwatch("f2f"):
            self._set_image(matching.scaled_rows(frame.left, self._row_scale))
            last_s, self._last_s = self._last_s, frame.time_s
            interval_s = frame.time_s - last_s if frame.time_s > last_s else None
            frozen = self.repeats.status(frame, self.f2f.filter.velocity, interval_s or 1 / self.rig.frame_rate_hz)
            unusable, imu = frozen if frozen == LEFT_REPEATS else "", frame.readings.imu
            motion, status = self.f2f.step(self._image, interval_s, unusable, imu and imu.until(frame.time_s))
            if frozen == RIGHT_REPEATS and status != "ok":
                frozen = RIGHT_REPEATS_BLIND
            return motion, status if frozen == "ok" else frozen

    def _set_image(self, left: Image) -> None:
        self._gray = matching.gray(left, self.binning)
        self._image = matching.normalise(self._gray)

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        assert frame.right is not None
        left, right = (matching.scaled_rows(image, self._row_scale) for image in (frame.left, frame.right))
        with self.stopwatch("stereo"):
            if self._points is None:
                self._choose_scale(left, right)
            corrected, gray, dense, points = self._match_pair(left, right, row)
            if len(points.xyz) >= _MIN_POINTS:
                self.calibration.add(points, self.rig, self.settings.patch_px)
                if self.calibration.update(self.full_rig):
                    corrected, gray, dense, points = self._match_pair(left, right, row)
            self.stereo_observations.append(self._observation(row, frame.left, points))
        if len(points.xyz) < _MIN_POINTS:
            del self._pattern_fits[row]
            return None
        self._points, self._depth_m = points, self._depth(dense)
        self.spool.put(row, left, corrected, (self._gray, gray), dense)
        self.matcher.removed_yaw[row] = float(self.calibration.removed[1])
        self.matcher.twists[row] = self.f2f.filter.velocity.copy()
        return points

    def _depth(self, dense: DenseMatch) -> Map:
        far_enough_px = np.where(dense.best_px > 1.0, dense.best_px, np.nan)
        return np.asarray(self.rig.focal_px * self.rig.baseline_m / far_enough_px, np.float32)

    def _choose_scale(self, left: Image, right: Image) -> None:
        """Chooses the binning from a stereo pair before the first keyframe; a change reprocesses the left image."""
        binning = stereo.choose_binning(left, right, self.full_rig, self.settings)
        if binning != self.binning:
            self.close()
            before = self.f2f
            self._configure(binning)
            self._set_image(left)
            self.f2f.filter, self.f2f.started = before.filter, before.started

    def _match_pair(self, left: Image, right: Image, row: int) -> tuple[Image, matching.Gray, DenseMatch, StereoPoints]:
        """Returns the right image without known rectification errors, its grey levels, disparity, and points."""
        right = self.calibration.rectify(right, self.full_rig)
        gray = matching.gray(right, self.binning)
        levels = np.array([matching.luma(matching.binned(image, self.binning)) for image in (left, right)])
        self._pattern_fits[row] = pattern_fit(levels)
        self._known_patterns[row] = known = self._pattern(list(self._pattern_fits))
        dense = disparity.match_densely(*(levels - light_pattern(known, gray.shape)))
        return right, gray, dense, stereo.match_stereo_points(self._gray, gray, dense.best_px, self.rig, self.settings)

    def _pattern(self, rows: Sequence[int]) -> Array | None:
        """Returns the coefficients of the light pattern from keyframes at given frame indices."""
        return pattern_coefficients([self._pattern_fits[row] for row in rows[:: -(-len(rows) // _PATTERN_PAIRS)]])

    def _observation(self, row: int, left: Image, points: StereoPoints) -> StereoObservation:
        """Returns the quality of a stereo pair; row differences are in pixels of the full image with square pixels."""
        seen = contrast(self._gray), saturated_fraction(left)
        repeated = self._repetition[row] = repetition(self._image, self.settings.patch_px)
        if not len(points.xyz):
            return StereoObservation(row, 0, *seen, repetition=repeated)
        sigma_px = float(np.median(epipolar_calibration.row_sigma(points))) * self.rig.focal_px / points.noise_ratio
        rows_px = float(np.median(points.row_difference_px)), epipolar_calibration.spread(points), sigma_px
        scaled = (self.binning * value for value in rows_px)
        return StereoObservation(row, len(points.xyz), *seen, *scaled, repetition=repeated)

    def tracking_cov(self) -> Array | None:
        return None if self.f2f.reference is None else self.f2f.cov_since_keyframe

    def restart_tracking(self, velocity: Array | None = None) -> None:
        if self._points is not None:
            self.f2f.restart(self._image, self._points, velocity)

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        assert self._points is not None
        if not can_represent(self._depth_m):
            return None
        half_m = half_window_m(self._points, self.rig)
        return self.mosaic.register(self._image, self._depth_m, self._on_plane(world_from_camera), half_m, self.rig)

    def _on_plane(self, world_from_camera: Array) -> Array:
        """Returns the pose (4, 4) of a camera in the axes of the mosaic, which are chosen at the first call."""
        if self._plane_from_world is None:
            self._plane_from_world = viewing_plane(world_from_camera)
        return self._plane_from_world @ world_from_camera

    def add_to_mosaic(self, number: int, world_from_camera: Array) -> None:
        if not can_represent(self._depth_m):
            return
        self.mosaic.add(number, self._image, self._depth_m, self._on_plane(world_from_camera), self.rig)
        self._in_mosaic.add(number)

    def rebuild_mosaic(self, keyframes: Sequence[Keyframe]) -> None:
        self.mosaic.cells.clear()
        for key in keyframes:
            if key.number not in self._in_mosaic:
                continue
            image = matching.normalise(self.spool.gray(key.row)[0])
            depth_m = self._depth(self.spool.disparity(key.row))
            self.mosaic.add(key.number, image, depth_m, self._on_plane(key.world_from_camera), self.rig)

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        motions = self._match_and_measure(node, others)
        found = zip(others, motions, strict=True)
        return [self._search_widely(node, other) if motion is None else motion for other, motion in found]

    def _match_and_measure(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        with self.stopwatch("flow"):
            matches = self.matcher.match(node, others)
        with self.stopwatch("network"):
            return [self.matcher.motion(node, other, pair) for other, pair in zip(others, matches, strict=True)]

    def _search_widely(self, node: Keyframe, other: Keyframe) -> Motion | None:
        """Returns the motion from `other` to `node`, predicted from features of the whole images and then measured."""
        # without `wide_search`, or if the texture repeats, only where the poses are too uncertain for matching, and
        # rejected if it contradicts them; None if not tried, failed or rejected
        if node.points is None or not len(node.points.xyz):
            return None
        ambiguous = max(self._repetition[key.row] for key in (node, other)) > MAX_REPETITION
        predicted_cov, anywhere = node.motion_cov(other), self.settings.wide_search and not ambiguous
        if not (anywhere or wide_search.may_exceed(SEARCH_PX, node.points, predicted_cov, self.rig)):
            return None
        with self.stopwatch("flow"):
            grays = self.spool.gray(node.row)[0], self.spool.gray(other.row)[0]
            other_from_node = wide_search.coarse_motion(*grays, node.points, self.rig, self.settings.patch_px)
            if other_from_node is None:
                return None
            moved = replace(other, world_from_camera=node.world_from_camera @ geometry.inverse(other_from_node))
        motion = self._match_and_measure(node, [moved])[0]
        predicted = geometry.inverse(other.world_from_camera) @ node.world_from_camera
        if motion is None or anywhere or wide_search.agrees(motion.a_from_b, motion.cov, predicted, predicted_cov):
            return motion
        return None

    def epipolar_error(self) -> EpipolarError:
        return self.calibration.report()

    def correct_yaw(self, yaw_rad: float, sigma_rad: float) -> None:
        self.calibration.correct_yaw(yaw_rad, sigma_rad, self.full_rig)

    def discard(self, numbers: range) -> None:
        """Does nothing: the images are on disk, so there is no memory to release."""

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        self.spool.free_cache()  # the map is made of images and disparities
        rows = result.keyframe_rows
        removed_rad = np.array([self.matcher.removed_yaw[row] for row in rows.tolist()])
        yaw_rad = result.quality.calibration.yaw_rad - removed_rad
        coefficients = self._pattern(rows.tolist()) if len(rows) else None
        pattern = light_pattern(coefficients, self._gray.shape)
        views = (self._map_view(row, coefficients) for row in rows.tolist())
        path = KeyframePath(result.final.world_from_camera[rows], result.node_cov, step_cov, yaw_rad)
        return build_map(views, path, self.rig, grid, progress, pattern, result.quality.calibration)

    def _map_view(self, row: int, pattern: Array | None) -> MapView:
        left = matching.binned(self.spool.left(row), self.binning)
        if pattern_difference(self._known_patterns[row], pattern) <= _PATTERN_CHANGE:
            return left, self.spool.disparity(row).fine
        return left, matching.binned(self.spool.right(row), self.binning)

    def left_image(self, row: int) -> Image | None:
        return self.spool.left(row)


def half_window_m(points: StereoPoints, rig: StereoRig) -> float:
    """Returns half the side of the square of the mosaic that is used for registration [m]."""
    # by the 90th percentile of the depths: one mismatch of 0.5 px would make that of the largest need 20 GB of memory
    return 0.6 * float(np.quantile(points.xyz[:, 2], 0.9)) * rig.width_px / rig.focal_px


def check_image_sizes(frame: Frame, size_px: tuple[int, int]) -> None:
    """Raises ValueError if an image of a frame has not the width and height that the calibration states [px]."""
    for side, image in (("left", frame.left), ("right", frame.right)):
        if image is not None and image.shape[1::-1] != size_px:
            found, expected = (" x ".join(str(n) for n in size) for size in (image.shape[1::-1], size_px))
            raise ValueError(f"{side}: the image has {found} px, but the calibration is of {expected} px")
