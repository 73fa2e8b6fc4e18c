"""Replay of a recorded stereo data set: runs the estimators on the frames, builds the map, compares with the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.interrupts import StageGuard
from twin.core.paths import is_file
from twin.core.records import ElevationMap, SurveyResult, Trajectory
from twin.core.settings import EstimatorSettings
from twin.core.timing import Stopwatch, timing_summary
from twin.datasets.bag import is_bag
from twin.datasets.bag_reader import BagTopics
from twin.datasets.calibration_files import read_calibration
from twin.datasets.dataset import Dataset
from twin.datasets.frames import RecordedFrames
from twin.datasets.image_files import BAYER, Bayer
from twin.datasets.readers import read_dataset
from twin.datasets.truth_files import read_truth
from twin.errors import SurveyAborted, TwinError
from twin.estimate import Navigator
from twin.estimate.first_pair import FloorPlane, PairInspection, floor_plane, inspect_pair
from twin.estimate.pipeline import finish_in_stage
from twin.estimate.self_check import check_survey
from twin.judge import recorded
from twin.judge.recorded import AlignmentName, ReplayEvaluation, associate, evaluate_replay, unevaluated_replay
from twin.report.replay_description import describe_replay
from twin.report.run_writer import OPTIONAL_OUTPUTS, RunFolder, SurveyRecord

#: A segment of the path ends, and the network is aligned, after this fraction of the keyframes so far, within limits.
_SEGMENT_SHARE, _SEGMENT_KEYFRAMES = 0.3, (10, 100)
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
        settings: settings of the estimators; None: the defaults.
        start: (4, 4) pose world_from_camera of the left camera at the first frame; None: the plane z = 0 of the world
            is fitted to the floor in the first pair.
        outputs: outputs in addition to metrics, trajectories and maps: "report", "recording".
        topics: image topics (left, right) of a ROS 2 bag; None: the only stereo pair in it.
    """

    calibration: Path | None = None
    truth: Path | None = None
    alignment: AlignmentName = "first"
    bayer: Bayer | None = None
    settings: EstimatorSettings | None = None
    start: Array | None = None
    outputs: Collection[str] = OPTIONAL_OUTPUTS
    topics: tuple[str, str] | None = None


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
        name: name of the data set: that of its folder.
        reader: name of the reader of its layout.
        dataset: the data set.
        frames: its rectified frames.
        truth: true poses of the rectified left camera, at times relative to the first frame; None without a truth.
        pair: the first stereo pair.
        plane: plane of the floor in the axes of the left camera at the first pair.
    """

    name: str
    reader: str
    dataset: Dataset
    frames: RecordedFrames
    truth: Trajectory | None
    pair: PairInspection
    plane: FloorPlane

    @property
    def plane_text(self) -> str:
        """Returns a phrase that states how the plane of the map was chosen."""
        return f"plane of the map {'fitted to the floor' if self.plane.fitted else 'perpendicular to the first view'}"


def replay(
    folder: Path, out: Path, options: ReplayOptions | None = None, progress: Progress = lambda stage, share: None
) -> ReplayResult:
    """Runs the estimators on a recorded data set and writes a run folder.

    An interrupt (Ctrl-C) ends the current stage; the other stages are completed.

    Args:
        folder: folder of the data set, or a ROS 2 bag.
        out: run folder to write.
        options: options of the replay.
        progress: called with the stage ("replay", "map" or "report") and its completed fraction.

    Raises:
        TwinError: the data set or one of its files cannot be used (nothing was written), or the run folder cannot be
            written.
    """
    chosen = options or ReplayOptions()
    opened = open_dataset(folder, chosen)
    settings = replace(chosen.settings or EstimatorSettings(), window_tracks=_ALL_TRACKS, wide_search=True)
    start = opened.plane.world_from_camera if chosen.start is None else chosen.start
    rig, stopwatch, guard = opened.frames.rectification.rig, Stopwatch(), StageGuard()
    description = describe_replay(opened.name, _source(opened), rig, settings)
    start_s = time.perf_counter()
    with (
        guard,
        RunFolder(out, description, chosen.outputs) as written,
        Navigator(rig, settings, start, folder=out / "keyframes", stopwatch=stopwatch) as navigator,
    ):
        try:
            with guard.stage():
                _estimate(opened.frames, navigator, progress)
        except (SurveyAborted, OSError, KeyboardInterrupt) as error:
            guard.cause = str(error) or "interrupted"
        result = finish_in_stage(navigator, guard)
        with stopwatch("map"):
            elevation = guard.attempt(
                "map", lambda: navigator.build_map(result, None, lambda share: progress("map", share))
            )
        progress("report", 0.0)
        evaluation = _evaluation(opened, chosen, result, elevation, guard)
        evaluation = replace(evaluation, timing=_timing(start_s, result, stopwatch))
        metrics = guard.attempt("evaluation", lambda: evaluate_replay(evaluation)) or unevaluated_replay(evaluation)
        record = SurveyRecord(
            result, elevation, None, None, stopwatch, metrics, recorded_truth=_truth_of_frames(opened, chosen, result)
        )
        metrics = written.finish(record, guard)
    return ReplayResult(metrics["status"], metrics, out, result, elevation)


def alignment_name(name: str) -> AlignmentName:
    """Returns `name` if it is the name of an alignment; raises TwinError otherwise."""
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
    """Reads a data set and checks all that can be checked before the estimators run.

    Raises:
        TwinError: there is no calibration or no usable pair, the cameras are swapped, the calibration or the truth does
            not fit the images, or a file is damaged.
    """
    in_bag = options.truth is not None and is_bag(folder) and not is_file(options.truth)
    left, right = options.topics or (None, None)
    dataset, reader = read_dataset(folder, BagTopics(left, right, str(options.truth) if in_bag else None))
    calibration = dataset.calibration if options.calibration is None else read_calibration(options.calibration)
    if isinstance(calibration, TwinError):
        raise calibration
    if calibration is None:
        raise TwinError(str(folder), "has no calibration", "--calibration FILE (OpenCV, Kalibr or COLMAP)")
    frames = RecordedFrames(dataset, calibration, options.bayer)
    truth = _truth(dataset, frames, None if in_bag else options.truth)
    first = frames.first_pair()
    pair = inspect_pair(first, frames.rectification.rig, options.settings)
    if pair.swapped:
        problem = "the left and the right images are swapped: the disparities of the first pair are negative"
        raise TwinError(str(folder), problem, "left images of the camera on the left")
    plane = floor_plane(pair.points)
    if plane is None:
        problem = f"only {len(pair.points.xyz)} points of the first pair are matched"
        raise TwinError(str(folder), problem, "a rectified pair that fits the calibration; see `--preview`")
    return OpenedDataset(folder.resolve().name, reader, dataset, frames, truth, pair, plane)


def _truth(dataset: Dataset, frames: RecordedFrames, file: Path | None) -> Trajectory | None:
    """Returns the true poses of the rectified left camera, at times relative to the first frame; None without a truth.

    Raises:
        TwinError: the file of the truth is damaged or its times do not fit those of the frames.
    """
    truth = dataset.truth if file is None else read_truth(file, dataset)
    if isinstance(truth, TwinError):
        raise truth
    if truth is None:
        return None
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


def _estimate(frames: RecordedFrames, navigator: Navigator, progress: Progress) -> None:
    """Passes all frames to the estimators; the network is aligned after each segment of keyframes."""
    track, aligned = 1, 0
    for k, frame in enumerate(frames):
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
    findings = check_survey(result, opened.frames.rectification.rig) if len(result.keyframe_rows) else []
    reasons = [guard.reason] if guard.reason else [finding.sentence for finding in findings]
    identity = {
        "name": opened.name,
        "seed": None,
        "version": version("seabed-twin"),
        "scenario_hash": None,
        "status": "aborted" if guard.reason else "degraded" if findings else "complete",
        "reason": "; ".join(reasons),
    }
    skipped = dict(opened.frames.skipped)
    source = _source(opened) | {"skipped": skipped, "frames_in_dataset": len(opened.frames)}
    return ReplayEvaluation(
        result,
        opened.truth,
        options.alignment,
        None if elevation is None else elevation.grid.cell_m,
        {},
        identity,
        source,
        opened.dataset.notes,
    )


def _source(opened: OpenedDataset) -> dict[str, Any]:
    """Returns texts on the data set (name, reader, images, plane of the map) for metrics.json and the run folder."""
    return {
        "dataset": opened.name,
        "reader": opened.reader,
        "images": opened.frames.rectification.sentence,
        "plane": opened.plane_text,
    }


def _truth_of_frames(opened: OpenedDataset, options: ReplayOptions, result: SurveyResult) -> Trajectory | None:
    """Returns the true poses of all frames in the world of the final trajectory; None if any frame has none."""
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
