"""Navigation pipeline, after Negahdaripour & Madjidi 2003.

Frame-to-frame motion (F2F) is estimated at every frame. Stereo matching, registration with the mosaic (F2M) and the
measurement of links are done at keyframes, and the global alignment (GA) at the end of each track and of the survey.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link
from twin.core.ortho_tiles import OrthoTile
from twin.core.quality import EstimationQuality
from twin.core.records import (
    NO_STEREO,
    REPEATS,
    ElevationMap,
    Estimate,
    Frame,
    Image,
    MapGrid,
    Mask,
    Readings,
    SensorNoise,
    StereoRig,
    SurveyResult,
    Trajectory,
    is_measured,
)
from twin.core.settings import EstimatorSettings
from twin.core.threads import one_blas_thread
from twin.core.timing import StageTimer, Stopwatch
from twin.estimate.blind_frames import BlindFrame, aligned, blind_frame
from twin.estimate.calibration_errors import lasting_residuals, length_scales
from twin.estimate.late_readings import ReadingsBetweenNodes, motion_since
from twin.estimate.mapping.footprint import MapTile, footprint_grid, footprint_tiles, steps_between, with_margin
from twin.estimate.mapping.map_builder import flown_back, with_scatter
from twin.estimate.mapping.orthomosaic import Restore, Views, orthomosaic
from twin.estimate.navigation.kalman import SENSORS
from twin.estimate.navigation.pose_filter import DeadReckoningState, PoseFilter, clip_covariance
from twin.estimate.navigation.reading_watch import ReadingWatch
from twin.estimate.network import KeyframeNetwork, LinkAttempt
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.trajectory import PoseLog, interpolate_between_keyframes
from twin.estimate.vision.image_quality import MAX_REPETITION
from twin.estimate.vision.mosaic import viewing_plane
from twin.estimate.vision.stereo import Keyframe
from twin.estimate.vision.two_view_motion import Motion
from twin.estimate.vision_interface import Vision

#: Reference position where none is given: the camera at the origin, its optical axis along -z of the world.
_DEFAULT_START = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3))
_F2M_SIGMA = np.array([5e-4] * 3 + [1e-3] * 3)  # standard deviation due to resampling in the mosaic [rad, m]
_TILE_MARGIN = 12  # cells around a tile that are built with it, as a cell depends on its neighbours
_SAME_INTERVAL = 1e-6  # relative difference up to which intervals count as equal, because timestamps are rounded


class _Blindness(NamedTuple):
    """Frames in succession whose motion was predicted, not measured."""

    state: DeadReckoningState  #: before them
    rows: range  #: their rows in the log
    motion: Array  #: (4, 4) product of the predicted visual motions


class Navigator(AbstractContextManager["Navigator"]):
    """Estimates the trajectory of a stereo camera and the map from frames. Use as a context manager, or call `close`.

    Args:
        start: (4, 4) world_from_camera of the first frame, the reference position; by default the camera is at the
            origin with its optical axis along -z of the world. If the frames have readings of height or attitude, the
            z axis of the world must point up.
        readings_noise: believed noise of the navigation sensors whose readings come with the frames.
        vision: source of the visual measurements, closed by the caller; by default, the images of the frames.
        folder: folder for keyframe images and the mosaic while the survey runs; by default a temporary folder.
        stopwatch: function that returns a context manager which times the stage of a given name.
    """

    def __init__(
        self, rig: StereoRig, settings: EstimatorSettings | None = None, start: Array | None = None,
        readings_noise: SensorNoise | None = None, vision: Vision | None = None, folder: Path | None = None,
        stopwatch: StageTimer | None = None,
    ):  # fmt: skip
        self.rig, self.settings = rig, settings or EstimatorSettings()
        self.stopwatch, noise = stopwatch or Stopwatch(), readings_noise or SensorNoise()
        self._resources = _limited_resources()
        self.vision = vision or self._image_vision(folder, noise)
        self.filter = PoseFilter((_DEFAULT_START if start is None else start).copy(), rig, noise)
        self._f2f_at_pair = self._f2f_at_node = self.filter.f2f
        self.network = KeyframeNetwork(self.vision, rig, noise, self.settings, self.stopwatch)
        self._resources.callback(self.network.close)
        self.log = PoseLog()
        self._watch, self._between = ReadingWatch(), ReadingsBetweenNodes(rig, noise)
        self._blind: _Blindness | None = None
        self._blind_frames: list[BlindFrame] = []

    def _image_vision(self, folder: Path | None, noise: SensorNoise) -> StereoVision:
        if folder is None:
            folder = Path(self._resources.enter_context(TemporaryDirectory(prefix="twin-")))
        vision = StereoVision(self.rig, self.settings, folder, stopwatch=self.stopwatch, noise=noise)
        return self._resources.enter_context(vision)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_resources": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores the estimators; `vision` is then closed by the caller in any case."""
        vars(self).update(state)
        self._resources = _limited_resources()
        self._resources.callback(self.network.close)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the threads and removes the temporary folder, if one was created."""
        self._resources.close()

    def set_start_cov(self, cov: Array, prior_cov: Array) -> None:
        """Sets the covariances of the pose at the start, which is nearly exact by default. Call before the first frame.

        Args:
            cov: (6, 6) covariance of the start [rotation, translation] in camera axes (rad, m), for the online pose.
            prior_cov: (6, 6) covariance of the prior factor of the first node in the alignments: large in the
                directions that the readings at all nodes determine, which are factors and would count twice.
        """
        self.filter.cov = cov
        self.network.reference_cov = prior_cov

    def update(self, frame: Frame, track: int = 1) -> Estimate:
        """Processes one frame, later than all previous ones, and returns its online estimate.

        A frame with a stereo pair becomes a keyframe if `frame.keyframe` is True. If `frame.keyframe` is None, it
        becomes one if there is no keyframe yet, if tracking failed, or if the next pair is expected to overlap with the
        last keyframe by less than `settings.keyframe_overlap`. In no case does a pair with too few matched points
        become a keyframe. `track` is the number of its track, from 1 (see `align_track`).

        Raises:
            ValueError: the frame is not later than the last one, or an image is not of the size that the calibration
                states; the frame is ignored.
            OSError: images could not be read or written.
        """
        interval_s = self.interval_s(frame.time_s)
        motion, status = self.vision.track_frame(frame)  # before a frame that is ignored changes anything
        self._fuse_late(frame.readings.late)
        frame = replace(frame, readings=self._watch.fresh(frame.readings, frame.time_s))
        measured = is_measured(status)
        self.log.n_lost += not measured
        last, rejected = self.filter.world_from_camera, self.filter.rejected
        blind = self._blindness(motion, measured)
        velocity_mps = frame.readings.dvl_mps
        if measured and blind is not None:
            motion, frame, interval_s = self._after_blindness(blind, motion, frame)
        since_node = self.filter.since_node, self.filter.since_node_cov
        moved = self.filter.advance(motion, frame.readings, interval_s, measured)
        moved_since = self.filter.since_node, self.filter.since_node_cov
        if frame.readings.dvl_mps is None and velocity_mps is not None:
            self.filter.dvl.resume(velocity_mps)
        self.filter.fuse_vertical(frame.readings)
        frame = replace(frame, readings=self.filter.without_rejected(frame.readings, rejected))
        if not measured:
            guessed = frame.readings.dvl_mps is None and self.network.noise.imu is None
            self._blind_frames.append(blind_frame(len(self.log), since_node, moved_since, frame.readings, guessed))
        step = motion.a_from_b if measured else geometry.inverse(last) @ self.filter.world_from_camera
        self._blind, n_keyframes = None if measured else blind, len(self.network.keyframes)
        if repeats := status in REPEATS:
            self.log.repeats.setdefault(status, []).append(len(self.log))
        if not repeats and self.is_keyframe(frame, status):
            status, readings = self._add_keyframe(frame, track, status)
        else:
            readings = self.filter.fuse_position_fixes(frame.readings)
        online, f2f = self.filter.world_from_camera.copy(), self.filter.f2f
        if measured and blind is not None:
            self.log.append_after(blind.rows.start, frame.time_s, f2f, online, motion.a_from_b)
        else:
            self.log.append(frame.time_s, f2f, online, geometry.log(step), np.diag(motion.cov))
        self._between.keep(frame.time_s, readings)
        self._between.give_to_nodes(self.network.nodes, self.log)
        if not measured and len(self.network.keyframes) > n_keyframes:
            self._blind = None  # tracking continues from the new keyframe
        sigma_m = float(np.sqrt(np.trace(self.filter.cov[3:, 3:])))
        velocity = geometry.log(moved) * (1 / interval_s)
        return Estimate(frame.time_s, online, f2f, velocity, sigma_m, status)

    def _fuse_late(self, late: Sequence[tuple[float, Readings]]) -> None:
        """Fuses readings of earlier times; they are also factors of the next node after their time."""
        if not late or not len(self.log):
            return
        for time_s, readings in late:
            motion, cov = motion_since(self.log, time_s)
            readings = self.filter.fuse_earlier(self._watch.fresh(readings, time_s), motion, cov)
            self._between.keep(time_s, readings)
            self._between.give_to_nodes(self.network.nodes, self.log)

    def _blindness(self, motion: Motion, measured: bool) -> _Blindness | None:
        """Returns the blind frames up to this one, before the pose advances; None if there are none."""
        row, blind = len(self.log), self._blind
        if blind is not None and blind.rows.stop != row:
            blind = None  # frames between were simulated by others
        if measured:
            return blind
        if blind is None:
            blind = _Blindness(self.filter.state, range(row, row), np.eye(4))
        return _Blindness(blind.state, range(blind.rows.start, row + 1), blind.motion @ motion.a_from_b)

    def _after_blindness(self, blind: _Blindness, motion: Motion, frame: Frame) -> tuple[Motion, Frame, float]:
        """Returns to the state before the blind frames; returns the motion and time [s] since then, and the frame."""
        # the frame loses the velocity of the DVL, which is that of the last interval; what the sensors corrected
        # meanwhile refers to predicted motions, and would count twice with the measured one
        self.filter.state = blind.state
        self.filter.dvl.interrupt()
        start_s = float(self.log.times_s.array[max(blind.rows.start - 1, 0)])
        readings = replace(frame.readings, dvl_mps=None)
        return (
            motion._replace(a_from_b=blind.motion @ motion.a_from_b),
            replace(frame, readings=readings),
            frame.time_s - start_s,
        )

    def interval_s(self, time_s: float) -> float:
        """Returns the time since the last frame [s], nominal at first or within rounding; ValueError if <= 0."""
        nominal_s = 1 / self.rig.frame_rate_hz
        interval_s = time_s - self.log.times_s.array[-1] if len(self.log) else nominal_s
        if not interval_s > 0:
            last_s = self.log.times_s.array[-1]
            raise ValueError(f"time_s: {time_s} s is not later than the last frame, at {last_s} s")
        return nominal_s if abs(interval_s / nominal_s - 1) < _SAME_INTERVAL else float(interval_s)

    def is_keyframe(self, frame: Frame, status: str) -> bool:
        """Returns whether a frame is to become a keyframe (`update`), if the next motion equals the last one."""
        if frame.right is None or frame.keyframe is not None:
            return bool(frame.keyframe) and frame.right is not None
        since_pair = geometry.inverse(self._f2f_at_pair) @ self.filter.f2f
        self._f2f_at_pair = self.filter.f2f
        if status != "ok" or not self.network.keyframes:
            return True
        next_pair = self.filter.world_from_camera @ since_pair
        return self.network.overlap(self.network.keyframes[-1], next_pair) < self.settings.keyframe_overlap

    def _add_keyframe(self, frame: Frame, track: int, status: str) -> tuple[str, Readings]:
        """Processes a keyframe (stereo, motion since the last node, F2M, mosaic, network) and restarts F2F tracking."""
        # returns `status`, or why the frame did not become a keyframe (only position fixes are then fused), and the
        # readings that were not rejected; with `wide_search`, the status is "ok" if the link from the last node
        # measures the motion although tracking failed
        points = self.vision.observe_stereo(frame, len(self.log))
        if points is None:
            return NO_STEREO, self.filter.fuse_position_fixes(frame.readings)
        if (tracking_cov := self.vision.tracking_cov()) is not None:
            self.network.history.frame_sigmas_m.append(float(np.sqrt(np.trace(tracking_cov[3:, 3:]))))
        velocity = None  # measured otherwise than by tracking
        number, depth_m = len(self.network.keyframes), float(np.median(points.xyz[:, 2]))
        keyframe = Keyframe(
            number, len(self.log), track, self.filter.world_from_camera, points, frame.readings, depth_m, frame.exposure
        )
        if self.rig.yaw_sigma_rad:
            keyframe.yaw_rad = self.network.yaw_rad()[0]
        self._accumulate(keyframe, self.filter.since_node_cov)
        self.network.add(keyframe)
        is_node = number % self.settings.node_stride == 0
        attempt = self.network.link_to_last_node(keyframe) if is_node else None
        chain = None if attempt is None else attempt.link
        if chain is not None:
            self._follow_chain(keyframe, chain)
            if status != "ok" and self.settings.wide_search:  # the motion was measured after all
                velocity = self._measured_velocity(frame.time_s, chain)
                self.log.n_lost, status = self.log.n_lost - 1, "ok"
        # after `_follow_chain`, to correct its error too
        keyframe.readings = self.filter.fuse_position_fixes(frame.readings)
        with self.stopwatch("f2m"):
            self._register_with_mosaic(keyframe, self.filter.since_node_cov if chain is None else chain.cov)
            keyframe.world_from_camera = self.filter.world_from_camera
            self.vision.add_to_mosaic(keyframe.number, keyframe.world_from_camera)
        if is_node:
            self._connect(keyframe, attempt)
        self.vision.restart_tracking(velocity)
        return status, keyframe.readings

    def _measured_velocity(self, time_s: float, chain: Link) -> Array:
        """Returns the mean velocity (6,) since the last node by the link from it, which also becomes part of F2F."""
        last = self.network.nodes[-1]
        self.filter.f2f = self._f2f_at_node @ chain.i_from_j
        return geometry.log(chain.i_from_j) / (time_s - float(self.log.times_s.array[last.row]))

    def _accumulate(self, keyframe: Keyframe, step_cov: Array) -> None:
        """Sets `accumulated_cov` of a keyframe from that of the last node and `step_cov` (6, 6) since then."""
        if self.network.nodes:
            to_world = geometry.adjoint(self.filter.world_from_camera)
            keyframe.accumulated_cov = self.network.nodes[-1].accumulated_cov + to_world @ step_cov @ to_world.T

    def _follow_chain(self, node: Keyframe, chain: Link) -> None:
        """Replaces the F2F motion since the last node by the more accurate link; corrections since then are kept."""
        # after blind frames, only the part of those before them that belongs to the pose of the last node: the rest
        # belongs to the replaced motion, which may be far less certain
        last = self.network.nodes[-1]
        if self._blind is not None:  # corrections since then refer to predicted motions
            self.filter.state = self._blind.state._replace(f2f=self.filter.f2f)
        correction = geometry.inverse(last.world_from_camera @ self.filter.since_node) @ self.filter.world_from_camera
        if self._blind is not None:
            at_node = geometry.transport_covariance(self.filter.cov_at_node, self.filter.since_node)
            share = np.linalg.solve(at_node + self.filter.since_node_cov + np.eye(6) * 1e-14, at_node).T
            correction = geometry.exp(np.asarray(share @ geometry.log(correction), np.float64))
        cov = geometry.transport_covariance(self.filter.cov_at_node, chain.i_from_j) + chain.cov
        self.filter.reset(last.world_from_camera @ chain.i_from_j @ correction, cov)
        node.world_from_camera = self.filter.world_from_camera

    def _register_with_mosaic(self, keyframe: Keyframe, step_cov: Array) -> None:
        """Corrects the online pose by registration with the mosaic (F2M); `step_cov` (6, 6) is since the last node."""
        # weighted by the covariance of the motion since the keyframe of the compared cells, whose pose errors they have
        pose = self.filter.world_from_camera
        self._accumulate(keyframe, step_cov)
        found = self.vision.register_with_mosaic(pose) if self.settings.use_f2m else None
        if found is None:
            return
        since = keyframe.motion_cov(self.network.keyframes[found.reference_keyframe], pose)
        if self.network.nodes:
            since = clip_covariance(since, np.ascontiguousarray(step_cov), 1.0, np.inf)
        cov = found.correction.cov + np.diag(_F2M_SIGMA**2)
        reduction = self.filter.correct_pose(pose @ found.correction.a_from_b, cov, since)
        if reduction is not None:
            to_world = geometry.adjoint(pose)
            keyframe.accumulated_cov = keyframe.accumulated_cov - to_world @ reduction @ to_world.T

    def _connect(self, node: Keyframe, chain: LinkAttempt | None) -> None:
        """Adds a node to the network, linked to the last node by `chain` or, if it failed, by the F2F motion."""
        bridge = None
        if chain is not None and chain.link is None:
            cov = self.filter.since_node_cov + np.eye(6) * 1e-10
            bridge = Link(self.network.nodes[-1].number, node.number, self.filter.since_node, cov, 0.0, 0)
        self.network.connect(node, chain, bridge, self.filter.start_from_node(node.number))
        self._f2f_at_node = self.filter.f2f
        if self.rig.yaw_sigma_rad:
            self.vision.correct_yaw(*self.network.yaw_rad())

    def align_track(self, track: int) -> None:
        """Aligns the window of tracks that ends with `track`; the online pose is corrected as the last keyframe is.

        Raises SurveyAborted if the alignment failed, OSError if images could not be read or written.
        """
        keyframes = self.network.keyframes
        before = keyframes[-1].world_from_camera if keyframes else np.eye(4)
        node_cov = self.network.align_window(track)
        if node_cov is not None:
            last_from_now = geometry.inverse(before) @ self.filter.world_from_camera
            cov = geometry.transport_covariance(node_cov, last_from_now)
            self.filter.reset(keyframes[-1].world_from_camera @ last_from_now, cov)
            self.filter.cov_at_node = node_cov

    def abandon_alignment(self) -> None:
        """Drops the pending link measurements and disables the final alignment, so that `finish` is quick."""
        self.network.abandon_alignment()

    def finish(self) -> SurveyResult:
        """Returns the result after the final global alignment of all nodes, unless it is switched off or abandoned.

        Over texture that repeats, where links are ambiguous, the final trajectory is the online one. Raises
        SurveyAborted or OSError if the alignment fails; a second call returns the result without it.
        """
        self.network.truncate(len(self.log))
        keyframes, history, log = self.network.keyframes, self.network.history, self.log
        cov = np.tile(self.filter.cov, (len(keyframes), 1, 1))
        repeated = [pair.repetition for pair in self.vision.stereo_observations if pair.repetition is not None]
        if ambiguous := bool(repeated) and float(np.median(repeated)) > MAX_REPETITION:
            self.abandon_alignment()  # links may be wrong, and the alignment would spread their errors
        aligned_cov = self.network.align_all()
        rows, times_s = np.array([k.row for k in keyframes], dtype=np.int64), log.times_s.array
        final = log.online.array
        if self.settings.use_ga and len(rows) and not ambiguous:
            final = interpolate_between_keyframes(log.steps.array, log.variances.array, rows, self.network.poses)
            final = aligned(final, self._blind_frames, set(rows.tolist()), self.rig, self.network.noise)
        return SurveyResult(
            f2f=Trajectory(times_s, log.f2f.array), online=Trajectory(times_s, log.online.array),
            final=Trajectory(times_s, final), keyframe_rows=rows,
            track_of_keyframe=np.array([k.track for k in keyframes], dtype=np.int64),
            node_cov=cov if aligned_cov is None else aligned_cov,
            keyframe_depth_m=np.array([k.depth_m for k in keyframes], dtype=np.float64), links=self.network.links,
            alignments=history.alignments, before_ga=history.before_ga, after_ga=history.after_ga,
            stereo_observations=[pair for pair in self.vision.stereo_observations if pair.row < len(log)],
            quality=self._quality(),
        )  # fmt: skip

    def _quality(self) -> EstimationQuality:
        history, nodes = self.network.history, self.network.nodes
        residuals, alignments = np.array(history.link_residuals), history.alignments
        failed, counts = np.isnan(residuals), self.filter.gates.counts
        across, along = length_scales(nodes, self.network.links, self.rig, self.network.noise)
        return EstimationQuality(
            frames_lost=self.log.n_lost, repeats=self.log.repeats, nodes_bridged=history.nodes_bridged,
            links_tried=len(residuals), links_failed=int(failed.sum()),
            link_residual=None if failed.all() else float(np.median(residuals[~failed])),
            link_chi2=alignments[-1].link_chi2 if alignments else None,
            alignment_converged=not alignments or alignments[-1].converged, epipolar=self.vision.epipolar_error(),
            frame_sigma_m=float(np.percentile(history.frame_sigmas_m, 90)) if history.frame_sigmas_m else None,
            disparity_offset=self.network.offset_by_motions(), distortion=self.network.distortion(),
            calibration=history.calibration, independent_errors=history.independent_errors,
            altimeter_m={n.row: n.readings.altitude_m for n in nodes if n.readings.altitude_m is not None},
            lasting_residuals=lasting_residuals(nodes, self.rig, self.network.noise), length_scale=across,
            depth_scale=along, readings_rejected=dict(zip(SENSORS, counts[:, 1].tolist(), strict=True)),
            readings_disputed=dict(zip(SENSORS, counts[:, 2].tolist(), strict=True)), reading_notes=self._watch.notes,
            readings_believed=dict(zip(SENSORS, counts[:, 3].tolist(), strict=True)),
        )  # fmt: skip

    def build_map(
        self, result: SurveyResult, grid: MapGrid | None = None, progress: Callable[[float], None] | None = None,
        chosen: NDArray[np.bool_] | None = None,
    ) -> ElevationMap | None:  # fmt: skip
        """Builds the elevation map along the final trajectory, from all keyframes but `SurveyResult.unlinked`.

        Heights are measured along z of the world if the optical axis of the first keyframe is within 45 degrees of
        straight down, otherwise along this axis, towards the camera (`ElevationMap.map_from_world`). None without a
        keyframe; raises OSError if an image could not be read.

        Args:
            result: result of the survey (`finish`).
            grid: grid of the map; by default it covers the images of all keyframes.
            progress: called with the fraction of the keyframes processed so far, 0 to 1.
            chosen: (n_keyframes,) keyframes from which the map is built; None: all.
        """
        if not (~result.unlinked if chosen is None else chosen & ~result.unlinked).any():
            return None
        turned, linked, map_from_world = _linked_in_map(result, chosen)
        grid, report = grid or footprint_grid(turned, self.rig), progress or _ignore
        steps = steps_between(result.step_cov, linked)
        found = self.vision.build_map(turned, grid, steps, lambda n_done: report(n_done / len(linked)))
        return replace(found, map_from_world=map_from_world)

    def with_tested_sigma(self, result: SurveyResult, elevation: ElevationMap, chosen: Mask | None) -> ElevationMap:
        """Returns the map of `build_map`, tested (`with_scatter`) if it is made of images; may raise OSError."""
        turned, linked, _ = _linked_in_map(result, chosen)
        if len(linked) < 2 or self.vision.left_image(int(turned.keyframe_rows[0])) is None:
            return elevation
        back, step_cov = flown_back(turned.final.positions[turned.keyframe_rows]), result.step_cov
        sets = [(_of_keyframes(turned, part), steps_between(step_cov, linked[part])) for part in (back, ~back)]
        maps = [self.vision.build_map(part, elevation.grid, steps, _ignore) for part, steps in sets]
        return with_scatter(elevation, *maps)

    def build_tiles(
        self, result: SurveyResult, progress: Callable[[float], None] | None = None
    ) -> Iterator[tuple[MapTile, ElevationMap]]:
        """Yields each tile that images show, with its map, if `build_map` has enlarged the cells (not those of tiles).

        Memory is that of one tile. A keyframe at the border of tiles is processed for each of them. Together the tiles
        are the map of `build_map` on their common grid, except that light pattern and propagation of depth are those of
        the keyframes of a tile. Raises OSError if an image could not be read.
        """
        if not len(result.keyframe_rows):
            return
        turned, linked, map_from_world = _linked_in_map(result)
        tiles, report = footprint_tiles(turned, self.rig), progress or _ignore
        for k, tile in enumerate(tiles):
            part, steps = _of_keyframes(turned, tile.keyframes), steps_between(result.step_cov, linked[tile.keyframes])
            found = self.vision.build_map(part, with_margin(tile.grid, _TILE_MARGIN), steps, _ignore)
            inner = np.s_[_TILE_MARGIN:-_TILE_MARGIN, _TILE_MARGIN:-_TILE_MARGIN]
            layers = found.height_m[inner], found.sigma_m[inner], found.mosaic[inner]
            yield tile, ElevationMap(tile.grid, *layers, map_from_world)
            report((k + 1) / len(tiles))

    def orthomosaic(
        self, result: SurveyResult, elevation: ElevationMap, restore: Restore | None = None,
        progress: Callable[[float], None] | None = None, chosen: NDArray[np.bool_] | None = None,
    ) -> Iterator[OrthoTile] | None:  # fmt: skip
        """Returns an iterator over the tiles of the orthomosaic of the keyframe images; None if there are no images.

        Args:
            restore: removes the effects of lamps and water from an image; None: colours as seen, at equal exposure.
            progress: called with the finished fraction, 0 to 1.
            chosen: (n_keyframes,) keyframes from which it is made; None: all.

        Raises:
            OSError: an image could not be read. The iterator raises it too.
        """
        result = _of_keyframes(
            result, np.flatnonzero(~result.unlinked if chosen is None else chosen & ~result.unlinked)
        )
        rows = result.keyframe_rows
        if len(rows) == 0 or self.vision.left_image(int(rows[0])) is None:
            return None

        def load(k: int) -> Image:
            image = self.vision.left_image(int(rows[k]))
            assert image is not None
            return image

        exposures = {k.row: k.exposure for k in self.network.keyframes}
        poses = elevation.map_from_world @ result.final.world_from_camera[rows]
        views = Views(poses, result.keyframe_depth_m, [exposures[int(row)] for row in rows], load)
        return orthomosaic(views, elevation, self.rig.with_square_pixels(), restore, progress or _ignore)


def _limited_resources() -> ExitStack:
    resources = ExitStack()
    resources.enter_context(one_blas_thread())
    return resources


def _ignore(_: float) -> None:
    """Progress that nobody follows."""


def _linked_in_map(
    result: SurveyResult, chosen: NDArray[np.bool_] | None = None
) -> tuple[SurveyResult, NDArray[np.int64], Array]:
    """Returns the result with linked keyframes only, in the map frame; their numbers; and map_from_world (4, 4)."""
    linked, final = np.flatnonzero(~result.unlinked if chosen is None else chosen & ~result.unlinked), result.final
    map_from_world = viewing_plane(final.world_from_camera[result.keyframe_rows[linked[0]]])
    turned = Trajectory(final.times_s, map_from_world @ final.world_from_camera)
    return replace(_of_keyframes(result, linked), final=turned), linked, map_from_world


def _of_keyframes(result: SurveyResult, chosen: NDArray[Any]) -> SurveyResult:
    """Returns a result with the chosen keyframes only; its links keep the numbers of all keyframes."""
    return replace(
        result,
        keyframe_rows=result.keyframe_rows[chosen],
        node_cov=result.node_cov[chosen],
        keyframe_depth_m=result.keyframe_depth_m[chosen],
    )
