"""Replay of a recorded stereo data set: runs the estimators on the frames, builds the map, compares with the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.interrupts import StageGuard
from twin.core.output_folder import sole_writer
from twin.core.records import ElevationMap, SensorNoise, StereoRig, SurveyResult, Trajectory
from twin.core.settings import EstimatorSettings
from twin.core.threads import one_blas_thread
from twin.core.timing import Stopwatch, timing_summary
from twin.core.user_files import is_file, resolved
from twin.datasets.bag import is_bag
from twin.datasets.bag_reader import BagTopics
from twin.datasets.calibration_files import read_calibration
from twin.datasets.calibration_values import READ
from twin.datasets.dataset import Dataset
from twin.datasets.image_files import BAYER, Bayer
from twin.datasets.readers import read_dataset
from twin.datasets.truth_files import read_true_map, read_truth
from twin.errors import SurveyAborted, TwinError
from twin.estimate import Navigator
from twin.estimate.first_pair import FloorPlane, PairInspection, floor_plane, inspect_pair
from twin.estimate.pipeline import finish_in_stage
from twin.estimate.self_check import check_survey
from twin.estimate.stereo_vision import StereoVision
from twin.judge import recorded
from twin.judge.recorded import AlignmentName, ReplayEvaluation, associate, evaluate_replay, unevaluated_replay
from twin.judge.true_map import TrueMap, true_heights
from twin.plugin.guard import check_loadable
from twin.plugin.loading import ESTIMATORS
from twin.plugin.navigator import NOTE, PluginNavigator
from twin.plugin.protocols import EstimatorSetup
from twin.recordings.aiding import Aiding, Opening, Start
from twin.recordings.frames import RecordedFrames
from twin.report.replay_description import describe_replay
from twin.report.run_writer import OPTIONAL_OUTPUTS, RunFolder, SurveyRecord

#: A segment of the path ends, and the network is aligned, when the number of keyframes since the last alignment is this
#: fraction of all keyframes so far, within limits.
_SEGMENT_SHARE, _SEGMENT_KEYFRAMES = 0.3, (10, 100)
ESTIMATOR_OPTION = "--estimator"  # option of `twin replay` that names a plug-in
_MOST_RESIDUAL = 2.0  # largest RMS of the residuals of readings [standard deviations] without a warning
_FARTHEST_M = 1e8  # largest coordinate of a true position; in UTM and ECEF they are up to 1e7 m
_MOST_UNUSED = 0.1  # largest fraction of unusable frames of a complete replay
_ALL_TRACKS = 1000  # every earlier node may be linked to a new one: there is no plan that says where loops close

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay.

    Args:
        calibration: calibration file; None: that of the data set.
        truth: file of true poses, or for a ROS 2 bag the topic of true poses; None: that of the data set.
        alignment: how the estimates are moved to the truth before the comparison.
        bayer: pattern of raw images; None: grey or colour images.
        settings: settings of the estimators, of which `window_tracks` and `wide_search` are replaced; None: the
            defaults.
        start: (4, 4) pose world_from_camera of the rectified left camera at the first frame; None: z is up by the
            recorded attitude or, without one, the plane z = 0 of the world is the floor plane of the first pair
            (`floor_plane`).
        outputs: outputs in addition to metrics, trajectories and maps: "report", "recording".
        topics: image topics (left, right) of a ROS 2 bag; None: the only stereo pair in it.
        estimator: estimator of another package ("module:Class" or the name of an entry point `twin.estimators`), from
            whose poses the map is built; None: the estimators of `twin.estimate`.
        aiding: whether recorded readings of pressure, attitude, DVL and IMU are used.
        true_map: GeoTIFF of the true heights [m] in the frame of the true poses; None: that of the data set.
    """

    calibration: Path | None = None
    truth: Path | None = None
    alignment: AlignmentName = "first"
    bayer: Bayer | None = None
    settings: EstimatorSettings | None = None
    start: Array | None = None
    outputs: Collection[str] = OPTIONAL_OUTPUTS
    topics: tuple[str, str] | None = None
    estimator: str | None = None
    aiding: bool = True
    true_map: Path | None = None


class ReplayResult(NamedTuple):
    """Outcome of a replay.

    Args:
        status: "complete", "degraded" or "aborted".
        metrics: contents of metrics.json.
        folder: the run folder.
        result: result of the estimators.
        elevation: the map; None if none was built.
    """

    status: str
    metrics: dict[str, Any]
    folder: Path
    result: SurveyResult
    elevation: ElevationMap | None


class OpenedDataset(NamedTuple):
    """A data set that is ready to be replayed.

    Args:
        name: name of the data set: that of its folder or file.
        reader: name of the reader of its layout.
        dataset: the data set.
        frames: its rectified frames.
        truth: true poses of the rectified left camera, at times relative to the first frame; None without a truth.
        pair: the first stereo pair.
        plane: floor plane of the first pair, in the axes of the left camera (`floor_plane`).
        aiding: readings of the navigation sensors; None if none were recorded or they are not wanted.
        true_map: true heights in the frame of `truth`; None if they are not known.
    """

    name: str
    reader: str
    dataset: Dataset
    frames: RecordedFrames
    truth: Trajectory | None
    pair: PairInspection
    plane: FloorPlane
    aiding: Aiding | None
    true_map: TrueMap | None = None

    @property
    def plane_text(self) -> str:
        """Returns a phrase that states how the plane of the map was chosen; a start in the options is ignored."""
        if self.aiding is not None and "attitude" in self.aiding.used:
            return "plane of the map horizontal by the recorded attitude"
        if self.aiding is not None and "vertical" in self.aiding.used:
            return "plane of the map horizontal by the recorded specific forces"
        return f"plane of the map {'fitted to the floor' if self.plane.fitted else 'perpendicular to the first view'}"


def replay(
    folder: Path, out: Path, options: ReplayOptions | None = None, progress: Progress = lambda stage, share: None
) -> ReplayResult:
    """Runs the estimators on a recorded data set and writes a run folder.

    An interrupt (Ctrl-C) ends the current stage; the stages after it are completed.

    Args:
        folder: folder of the data set, or a ROS 2 bag.
        out: run folder to write, new or empty.
        options: options of the replay.
        progress: called with the stage ("replay", "map" or "report") and its completed fraction.

    Raises:
        TwinError: the data set, one of its files or the estimator cannot be used (nothing was written), or the run
            folder is not empty, is written by another process, or cannot be written.
    """
    with sole_writer(out), one_blas_thread():
        return _replay(folder, out, options or ReplayOptions(), progress)


def _replay(folder: Path, out: Path, chosen: ReplayOptions, progress: Progress) -> ReplayResult:
    """Replays a data set as `replay` does, into a folder that this process has locked."""
    check_loadable(ESTIMATOR_OPTION, ESTIMATORS, chosen.estimator)
    opened = open_dataset(folder, chosen)
    settings = replace(chosen.settings or EstimatorSettings(), window_tracks=_ALL_TRACKS, wide_search=True)
    flight = _prepared(opened, chosen, settings)
    stopwatch, guard = Stopwatch(), StageGuard()
    description = describe_replay(opened.name, _source(opened), flight.rig, settings, chosen.estimator)
    start_s = time.perf_counter()
    with (
        guard,
        RunFolder(out, description, chosen.outputs) as written,
        _navigator(chosen.estimator, flight, settings, out / "keyframes", stopwatch) as navigator,
    ):
        try:
            with guard.stage():
                _estimate(opened, navigator, progress)
        except (SurveyAborted, OSError, KeyboardInterrupt) as error:
            guard.cause = str(error) or "interrupted"
        result = finish_in_stage(navigator, guard)
        with stopwatch("map"):
            elevation = guard.attempt(
                "map", lambda: navigator.build_map(result, None, lambda share: progress("map", share))
            )
            n_tiles = guard.attempt("tiles", lambda: _write_tiles(navigator, result, written, guard)) or 0
        progress("report", 0.0)
        heights = guard.attempt("evaluation", lambda: _true_heights(opened, chosen, result, elevation))
        evaluation = _evaluation(opened, chosen, result, elevation, guard)
        timing = _timing(start_s, result, stopwatch)
        evaluation = replace(evaluation, timing=timing, true_heights_m=heights)
        if n_tiles:
            evaluation = replace(evaluation, source=evaluation.source | {"tiles": n_tiles})
        metrics = guard.attempt("evaluation", lambda: evaluate_replay(evaluation)) or unevaluated_replay(evaluation)
        record = SurveyRecord(
            result, elevation, None, None, stopwatch, metrics,
            recorded_truth=_truth_of_frames(opened, chosen, result), recorded_heights_m=heights,
        )  # fmt: skip
        metrics = written.finish(record, guard)
    return ReplayResult(metrics["status"], metrics, out, result, elevation)


class _Prepared(NamedTuple):
    """Input of the estimators of a replay besides the frames.

    Args:
        rig: rectified rig, with the pose of the left camera in the body if readings are used.
        start: pose at the first frame.
        noise: noise of the readings.
    """

    rig: StereoRig
    start: Start
    noise: SensorNoise


def _prepared(opened: OpenedDataset, options: ReplayOptions, settings: EstimatorSettings) -> _Prepared:
    """Returns the rig, the start and the noise of the readings (the default noise without readings).

    The start is that of the options; without one, that from the readings; without either, the camera above the floor
    plane of the first pair.
    """
    rig, over_plane, aiding = opened.frames.rectification.rig, opened.plane.world_from_camera, opened.aiding
    start = Start(over_plane if options.start is None else options.start)
    if aiding is None:
        return _Prepared(rig, start, SensorNoise())
    rig = replace(rig, body_from_camera=aiding.body_from_camera)
    opening = Opening(opened.frames, rig, settings, over_plane)
    return _Prepared(rig, aiding.start(opening, options.start) or start, aiding.noise)


@contextmanager
def _navigator(
    estimator: str | None, prepared: _Prepared, settings: EstimatorSettings, folder: Path, timer: Stopwatch
) -> Iterator[Navigator]:
    """Yields the estimators of `twin.estimate`, or those of a plug-in if `estimator` names one.

    Args:
        estimator: name of the plug-in, or None.
        prepared: rig, start and sensor noise.
        settings: settings of the estimators.
        folder: folder of the keyframe images.
        timer: stopwatch of the stages.
    """
    rig, start, noise = prepared
    if estimator is None:
        with Navigator(rig, settings, start.world_from_camera, noise, folder=folder, stopwatch=timer) as navigator:
            if start.cov is not None and start.prior_cov is not None:
                navigator.set_start_cov(start.cov, start.prior_cov)
            yield navigator
        return
    setup = EstimatorSetup(rig, start.world_from_camera, noise)
    with (
        StereoVision(rig, settings, folder, stopwatch=timer, noise=noise) as vision,
        PluginNavigator(estimator, setup, settings, vision, timer, ESTIMATOR_OPTION) as navigator,
    ):
        yield navigator


def alignment_name(name: str) -> AlignmentName:
    """Returns `name` if it is the name of an alignment (`AlignmentName`); raises TwinError otherwise."""
    for allowed in recorded.ALIGNMENTS:
        if name == allowed:
            return allowed
    raise TwinError("--align", f"{name[:40]!r} is not an alignment", ", ".join(recorded.ALIGNMENTS))


def bayer_pattern(name: str | None) -> Bayer | None:
    """Returns the Bayer pattern of a name; None if `name` is None.

    Raises:
        TwinError: no pattern has this name.
    """
    for allowed in (None, *BAYER):
        if name == allowed:
            return allowed
    raise TwinError("--bayer", f"{str(name)[:40]!r} is not a Bayer pattern", ", ".join(BAYER))


def image_topics(text: str | None) -> tuple[str, str] | None:
    """Returns the topics of the left and the right images from the text `LEFT,RIGHT`; None if `text` is None.

    Raises:
        TwinError: the text is not two different topics.
    """
    if text is None:
        return None
    topics = [part.strip() for part in text.split(",")]
    if len(topics) != 2 or not all(topics) or topics[0] == topics[1]:
        raise TwinError("--topics", f"{text[:100]!r} is not two topics", "LEFT,RIGHT")
    return topics[0], topics[1]


def open_dataset(folder: Path, options: ReplayOptions) -> OpenedDataset:
    """Returns a data set with its calibration, truth and readings, after checks of these and of its first stereo pair.

    Raises:
        TwinError: the folder has no known layout, there is no calibration or no usable pair, fewer than 30 points of
            the first pair are matched, the cameras are swapped, the calibration or the truth does not fit the images, a
            file is damaged, or topics are named for a data set that is not a bag.
    """
    in_bag = options.truth is not None and is_bag(folder) and not is_file(options.truth)
    left, right = options.topics or (None, None)
    dataset, reader = read_dataset(folder, BagTopics(left, right, str(options.truth) if in_bag else None))
    if options.topics is not None and not is_bag(folder):
        raise TwinError("--topics", f"{folder} is not a ROS 2 bag", "no topics for other data sets")
    calibration = dataset.calibration if options.calibration is None else read_calibration(options.calibration)
    if isinstance(calibration, TwinError):
        raise calibration
    if calibration is None:
        raise TwinError(str(folder), "has no calibration", f"--calibration FILE: {READ}")
    frames = RecordedFrames(dataset, calibration, options.bayer)
    truth = _truth(dataset, frames, None if in_bag else options.truth)
    first = frames.first_pair()
    pair = inspect_pair(first, frames.rectification.rig, options.settings)
    if pair.swapped:
        problem = "the left and the right images are swapped, or both upside down: the disparities are negative"
        raise TwinError(str(folder), problem, "left images of the camera on the left")
    plane = floor_plane(pair.points)
    if plane is None:
        problem = f"only {len(pair.points.xyz)} points of the first pair are matched"
        raise TwinError(str(folder), problem, "a rectified pair that fits the calibration; see `--preview`")
    aiding = _aiding(dataset, frames) if options.aiding else None
    true_map = _true_map(dataset, truth, options)
    return OpenedDataset(resolved(folder).name, reader, dataset, frames, truth, pair, plane, aiding, true_map)


def _true_map(dataset: Dataset, truth: Trajectory | None, options: ReplayOptions) -> TrueMap | None:
    """Returns the true heights: those of the option, or those of the data set if the true poses are its own, too.

    Raises:
        TwinError: the file is not a height grid, or there are no true poses, in whose frame the heights are.
    """
    if options.true_map is None:
        own = dataset.true_map if options.truth is None and truth is not None else None
        return None if own is None else read_true_map(own)
    if truth is None:
        raise TwinError("--true-map", "the data set has no true poses, in whose frame the heights are", "--truth")
    return read_true_map(options.true_map)


def _aiding(dataset: Dataset, frames: RecordedFrames) -> Aiding | None:
    """Returns the aiding by the recorded readings for the rectified frames; None if no readings were recorded.

    Raises:
        TwinError: the readings are damaged.
    """
    if isinstance(dataset.readings, TwinError):
        raise dataset.readings
    if dataset.readings is None:
        return None
    rectified = frames.rectification
    return Aiding(dataset.readings, rectified.left_from_rectified, frames.start_s, rectified.rig.frame_rate_hz)


def _truth(dataset: Dataset, frames: RecordedFrames, file: Path | None) -> Trajectory | None:
    """Returns the true poses of the rectified left camera, at times relative to the first frame; None without a truth.

    Raises:
        TwinError: the truth is damaged or has no poses, a true position is impossible, or there are several frames and
            none of them has a true pose at its time (`associate`).
    """
    truth = dataset.truth if file is None else read_truth(file, dataset)
    if isinstance(truth, TwinError):
        raise truth
    if truth is None:
        return None
    truth = _ordered(truth, str(file or dataset.folder))
    moved = Trajectory(
        truth.times_s - frames.start_s, truth.world_from_camera @ frames.rectification.left_from_rectified
    )
    times_s = np.array([frame.time_s for frame in dataset.images]) - frames.start_s
    if len(times_s) > 1 and len(associate(times_s, moved.times_s).estimate) == 0:
        span = f"{truth.times_s.min():.3f} to {truth.times_s.max():.3f} s"
        given = f"{frames.start_s:.3f} to {frames.start_s + times_s.max():.3f} s"
        source = str(file or dataset.folder)
        raise TwinError(source, f"the truth is of another clock: {span}", f"the times of the frames, {given}")
    return moved


def _ordered(truth: Trajectory, source: str) -> Trajectory:
    """Returns the true poses in the order of time; of several poses at the same time, only the first one is kept.

    Args:
        truth: the true poses.
        source: file or folder of the truth, for the message.

    Raises:
        TwinError: there are no poses, or a coordinate of a position is larger than 1e8 m or not a number.
    """
    if not len(truth):
        raise TwinError(source, "the truth has no poses", "true poses at the times of the frames")
    largest_m = float(np.abs(truth.positions).max(initial=0.0))
    if not largest_m <= _FARTHEST_M:
        raise TwinError(source, f"a coordinate of a true position is {largest_m:g} m", f"up to {_FARTHEST_M:g} m")
    times_s, first = np.unique(truth.times_s, return_index=True)
    return Trajectory(times_s, truth.world_from_camera[first])


def _estimate(opened: OpenedDataset, navigator: Navigator, progress: Progress) -> None:
    """Passes all frames, with their readings, to the estimators, and aligns the network after each segment."""
    track, aligned, frames = 1, 0, opened.frames
    for k, frame in enumerate(frames):
        if opened.aiding is not None:
            frame = replace(frame, readings=opened.aiding.at(frame.time_s))
        navigator.update(frame, track)
        n = len(navigator.network.keyframes)
        if n - aligned >= np.clip(_SEGMENT_SHARE * n, *_SEGMENT_KEYFRAMES):
            navigator.align_track(track)
            track, aligned = track + 1, n
        progress("replay", min(1.0, (k + 1) / len(frames)))


def _evaluation(
    opened: OpenedDataset,
    options: ReplayOptions,
    result: SurveyResult,
    elevation: ElevationMap | None,
    guard: StageGuard,
) -> ReplayEvaluation:
    """Returns the input of the evaluation, without timing."""
    findings = check_survey(result, opened.frames.rectification.rig, elevation) if len(result.keyframe_rows) else []
    sentences = [*_unused(opened.frames), *(finding.sentence for finding in findings)]
    reasons = [guard.reason] if guard.reason else sentences
    identity = {
        "name": opened.name,
        "seed": None,
        "version": version("seabed-twin"),
        "scenario_hash": None,
        "status": "aborted" if guard.reason else "degraded" if sentences else "complete",
        "reason": "; ".join(reasons),
    }
    skipped = dict(opened.frames.skipped)
    source = _source(opened) | {"skipped": skipped, "frames_in_dataset": len(opened.frames)}
    return ReplayEvaluation(
        result,
        opened.truth,
        options.alignment,
        elevation,
        {},
        identity,
        source,
        _notes(opened, options, result),
    )


def _write_tiles(navigator: Navigator, result: SurveyResult, written: RunFolder, guard: StageGuard) -> int:
    """Writes the tiles of a map whose cells were enlarged, in the folder `tiles`, and returns their number.

    An error of a file ends the writing; the guard records it. The tiles that are finished by then remain.
    """
    folder = written.tiled_map()
    try:
        for tile, elevation in navigator.build_tiles(result):
            folder.add(tile.row, tile.col, elevation)
    except OSError as error:
        guard.cause = guard.cause or str(error)
    finally:
        with suppress(OSError):
            folder.finish()
    return folder.n_tiles


def _true_heights(
    opened: OpenedDataset, options: ReplayOptions, result: SurveyResult, elevation: ElevationMap | None
) -> NDArray[np.float32] | None:
    """Returns the true heights at the cells of the map, moved to it by the alignment; None if they are not known."""
    if opened.true_map is None or opened.truth is None or elevation is None:
        return None
    moved = recorded.world_alignment(result.final, opened.truth, options.alignment)
    return true_heights(elevation, opened.true_map, moved)


def _unused(frames: RecordedFrames) -> list[str]:
    """Returns one sentence if more than a tenth of the frames could not be used, otherwise an empty list."""
    if frames.unused <= _MOST_UNUSED * len(frames):
        return []
    return [f"{frames.unused} of {len(frames)} frames of the data set could not be used, see replay.skipped"]


def _notes(opened: OpenedDataset, options: ReplayOptions, result: SurveyResult) -> tuple[str, ...]:
    """Returns the notes of the reader and the readings, and sentences on a plug-in and on readings that do not fit."""
    notes = [*opened.dataset.notes, *result.quality.repeat_notes]
    if options.estimator is not None:
        notes.append(NOTE.format(options.estimator))
    if opened.aiding is not None:
        notes += opened.aiding.notes
        notes += [
            f"The readings of {name} deviate from the final path by {ratio:.1f} standard deviations (RMS), where 1 is "
            "expected: their noise is larger than stated, or they belong to another body or clock."
            for name, ratio in opened.aiding.residuals(result.final).items()
            if ratio > _MOST_RESIDUAL
        ]
    return tuple(notes)


def _source(opened: OpenedDataset) -> dict[str, Any]:
    """Returns texts on the replay for metrics.json and scenario.resolved.toml, by key."""
    return {
        "dataset": opened.name,
        "reader": opened.reader,
        "images": opened.frames.rectification.sentence,
        "plane": opened.plane_text,
        "aiding": ", ".join(opened.aiding.used if opened.aiding is not None else []) or "none",
    }


def _truth_of_frames(opened: OpenedDataset, options: ReplayOptions, result: SurveyResult) -> Trajectory | None:
    """Returns the true poses of all frames of the final trajectory, in its world; None unless every frame has one."""
    if opened.truth is None or not len(result.final):
        return None
    rows = associate(result.final.times_s, opened.truth.times_s)
    if not np.array_equal(rows.estimate, np.arange(len(result.final))):
        return None
    true = Trajectory(result.final.times_s, opened.truth.world_from_camera[rows.truth])
    moved = np.linalg.inv(recorded.true_from_world(result.final, true, options.alignment)) @ true.world_from_camera
    return Trajectory(true.times_s, moved)


def _timing(start_s: float, result: SurveyResult, stopwatch: Stopwatch) -> dict[str, Any]:
    """Returns wall time and recorded time [s], peak memory [MiB] and the durations of the processing stages.

    Args:
        start_s: value of `time.perf_counter` at the start of the replay [s].
        result: result of the estimators, which has the recorded times.
        stopwatch: durations of the stages.
    """
    times_s = result.online.times_s
    recorded_s = float(times_s[-1] - times_s[0]) if len(times_s) else 0.0
    return timing_summary(recorded_s, time.perf_counter() - start_s, stopwatch)
