"""Replay of a recorded stereo data set: runs the estimators on the frames, builds the map, compares with the truth."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from twin.core.checkpoint import Checkpoints
from twin.core.interrupts import StageGuard
from twin.core.output_folder import sole_writer
from twin.core.quality import Finding
from twin.core.records import ElevationMap, SensorNoise, SurveyResult, Trajectory
from twin.core.settings import EstimatorSettings
from twin.core.threads import one_blas_thread
from twin.core.timing import Stopwatch
from twin.core.user_files import is_file
from twin.datasets.image_files import BAYER, Bayer
from twin.errors import SurveyAborted, TwinError
from twin.estimate import Navigator
from twin.estimate.self_check import check_survey
from twin.estimate.stereo_vision import StereoVision
from twin.judge.metrics import EvaluationInput
from twin.judge.recorded import (
    ALIGNMENTS,
    AlignmentName,
    RecordedTruth,
    are_comparable,
    associate,
    in_world,
    true_from_world,
    true_heights,
)
from twin.plugin.guard import check_loadable
from twin.plugin.loading import ESTIMATORS, source_files
from twin.plugin.navigator import NOTE, Estimators, navigator_of
from twin.plugin.protocols import EstimatorSetup
from twin.recordings.opened_dataset import OpenedDataset, ReplayOptions, open_dataset
from twin.recordings.recorded_aiding import Start
from twin.report.replay_description import describe_replay
from twin.report.run_result import RunResult
from twin.report.run_writer import RunFolder, SurveyRecord
from twin.session.assembly import closing, program
from twin.session.conclusion import Estimation, Maps, conclude, remove_state

#: A segment of the path ends, and the network is aligned, when the number of keyframes since the last alignment is this
#: fraction of all keyframes so far, within limits.
_SEGMENT_SHARE, _SEGMENT_KEYFRAMES = 0.3, (10, 100)
ESTIMATOR_OPTION = "--estimator"  # option of `twin replay` that names a plug-in
_COMPARED = (".csv", ".db3", ".mcap", ".tif", ".toml", ".txt", ".xml", ".yaml", ".yml")  # files beside the images
_MOST_RESIDUAL = 2.0  # largest RMS of the residuals of readings [standard deviations] without a warning
_MOST_UNUSED = 0.1  # largest fraction of unusable frames of a complete replay
_ALL_TRACKS = 1000  # every earlier node may be linked to a new one: there is no plan that says where loops close

Progress = Callable[[str, float], None]
T = TypeVar("T")


class ReplayResult(NamedTuple):
    """Outcome of a replay."""

    status: str  #: "complete", "degraded" or "aborted"
    metrics: dict[str, Any]  #: contents of metrics.json
    folder: Path  #: the run folder
    result: SurveyResult | None  #: result of the estimators; None if a finished replay was to be resumed
    elevation: ElevationMap | None  #: the map; None if none was built


@dataclass
class _Estimated:
    """A replay between two frames, or after the last one; all that changes while the frames are estimated."""

    folder: RunFolder
    navigator: Estimators
    stopwatch: Stopwatch
    track: int = 1
    aligned: int = 0  #: number of keyframes at the last alignment
    last_s: float | None = None  #: time of the last frame
    n_read: int = 0  #: frames of the data set that were read
    n_frames: int = 0  #: those of them that could be used
    skipped: Counter[str] | None = None  #: `RecordedFrames.skipped`
    wall_s: float = 0.0
    ended: bool = False
    cause: str = ""  #: why it ended early, "" if it did not


def replay(
    folder: Path, out: Path, options: ReplayOptions | None = None, progress: Progress = lambda stage, share: None,
    resume: bool = False, checkpoint_s: float | None = None,
) -> ReplayResult:  # fmt: skip
    """Runs the estimators on a recorded data set and writes a run folder (`twin.replay`).

    An interrupt (Ctrl-C) ends the current stage; the stages after it are completed. `progress` is called with the stage
    ("replay", "map" or "report") and its completed fraction.
    """
    with sole_writer(out, used=resume), one_blas_thread():
        return _replay(folder, out, options or ReplayOptions(), progress, resume, checkpoint_s)


def _replay(
    folder: Path, out: Path, options: ReplayOptions, progress: Progress, resume: bool, checkpoint_s: float | None
) -> ReplayResult:
    check_loadable(ESTIMATOR_OPTION, ESTIMATORS, options.estimator)
    start_s, guard = time.perf_counter(), StageGuard()
    opened = open_dataset(folder, options)
    settings = replace(options.settings or EstimatorSettings(), window_tracks=_ALL_TRACKS, wide_search=True)
    setup, start = _setup(opened, options, settings)
    source = _source(opened) | {"identity": _identity(opened, options)}
    description = describe_replay(opened.name, source, setup.rig, settings, options.estimator)
    checkpoints = _checkpoints(opened, options, description.text, out, checkpoint_s)
    if resume and (ended := RunResult.of_finished(out, description.text)):
        remove_state(checkpoints, out)
        return ReplayResult(ended.status, ended.metrics, out, None, None)
    found: _Estimated | None = checkpoints.open(resume)
    with guard, ExitStack() as resources:
        if found is None:
            written, stopwatch = resources.enter_context(RunFolder(out, description, options.outputs)), Stopwatch()
            images = StereoVision(setup.rig, settings, out / "keyframes", stopwatch=stopwatch, noise=setup.noise)
            navigator = _navigator(setup, start, options.estimator, settings, resources.enter_context(images))
            found = _Estimated(written, resources.enter_context(navigator), stopwatch)
        else:
            resources.enter_context(found.folder)
            resources.enter_context(closing(found.navigator))
            start_s -= found.wall_s
            opened.frames.skipped = found.skipped or Counter()
        if not found.ended:
            _estimate_in_stage(opened, found, guard, progress, checkpoints, start_s)
        guard.cause = found.cause
        estimation = Estimation(found.navigator, found.stopwatch, guard, found.folder, progress, start_s)
        run, survey = conclude(estimation, _Replayed(opened, options, guard))
    remove_state(checkpoints, out)
    return ReplayResult(run.status, run.metrics, out, survey.result, survey.elevation)


def _identity(opened: OpenedDataset, options: ReplayOptions) -> str:
    """Returns a hash of the options of a replay and of the names and times of its images."""
    frames = [(images.time_s, images.left.name, images.right and images.right.name) for images in opened.dataset.images]
    return sha256(repr((replace(options, settings=None), frames)).encode()).hexdigest()[:16]


def _checkpoints(
    opened: OpenedDataset, options: ReplayOptions, description: str, out: Path, interval_s: float | None
) -> Checkpoints:
    """Returns the checkpoints of a replay, which belong to its description, its files and this program."""
    folder, given = opened.dataset.folder, (options.calibration, options.truth, options.true_map)
    beside = [folder] if folder.is_file() else [file for file in folder.rglob("*") if file.suffix in _COMPARED]
    runs = {out.resolve(), *(file.resolve().parent for file in folder.rglob("env.json"))}  # results in the data set
    used = (file for file in (*beside, *filter(None, given)) if runs.isdisjoint(file.resolve().parents))
    files = *filter(is_file, used), *source_files(ESTIMATOR_OPTION, ESTIMATORS, options.estimator)
    return Checkpoints(out, {"replay": sha256(description.encode()).hexdigest()[:16]} | program(), files, interval_s)


def _estimate_in_stage(
    opened: OpenedDataset, found: _Estimated, guard: StageGuard, progress: Progress, checkpoints: Checkpoints,
    start_s: float,
) -> None:  # fmt: skip
    """Estimates the frames from where a replay is to their end, with checkpoints."""
    try:
        with guard.stage():
            for done in _estimate(opened, found):
                found.wall_s = time.perf_counter() - start_s
                progress("replay", done)
                checkpoints.save_if_due(found)
    except (SurveyAborted, OSError, KeyboardInterrupt) as error:
        found.cause = str(error) or "interrupted"
    found.ended, found.skipped, found.wall_s = True, opened.frames.skipped, time.perf_counter() - start_s
    checkpoints.save_last(found)
    if checkpoints.problem:
        found.folder.log("no checkpoint", reason=checkpoints.problem)


def _setup(opened: OpenedDataset, options: ReplayOptions, settings: EstimatorSettings) -> tuple[EstimatorSetup, Start]:
    """Returns rectified rig, start, noise of the readings, and uncertainty of the start."""
    # start: of the options, else from the readings, else above the floor plane of the first pair
    rig, over_plane, aiding = opened.frames.rectification.rig, opened.plane.world_from_camera, opened.aiding
    start, noise = Start(over_plane if options.start is None else options.start), SensorNoise()
    if aiding is not None:
        rig, noise = replace(rig, body_from_camera=aiding.body_from_camera), aiding.noise
        start = aiding.start(opened.frames, rig, settings, over_plane, options.start) or start
    return EstimatorSetup(rig, start.world_from_camera, noise), start


def _navigator(
    setup: EstimatorSetup, start: Start, estimator: str | None, settings: EstimatorSettings, vision: StereoVision
) -> Estimators:
    navigator = navigator_of(estimator, setup, settings, vision, ESTIMATOR_OPTION)
    if isinstance(navigator, Navigator) and start.cov is not None and start.prior_cov is not None:
        navigator.set_start_cov(start.cov, start.prior_cov)
    return navigator


def _estimate(opened: OpenedDataset, found: _Estimated) -> Iterator[float]:
    """Estimates the frames that follow; yields the completed fraction after each of them."""
    frames, navigator = opened.frames, found.navigator
    for frame in frames.following(found.n_read, found.n_frames, found.skipped):
        if opened.aiding is not None:
            frame = replace(frame, readings=opened.aiding.at(frame.time_s, found.last_s))
            found.last_s = frame.time_s
        navigator.update(frame, found.track)
        n = len(navigator.network.keyframes)
        if n - found.aligned >= np.clip(_SEGMENT_SHARE * n, *_SEGMENT_KEYFRAMES):
            navigator.align_track(found.track)
            found.track, found.aligned = found.track + 1, n
        found.n_read, found.n_frames, found.skipped = frames.n_read, frame.index + 1, frames.skipped.copy()
        yield min(1.0, found.n_frames / len(frames))


@dataclass(frozen=True)
class _Replayed:
    """A data set whose frames have been processed: a `twin.session.conclusion.RunKind`."""

    opened: OpenedDataset
    options: ReplayOptions
    guard: StageGuard

    def maps(self, estimation: Estimation, result: SurveyResult) -> Maps:
        """Builds the map and, if its cells were enlarged, writes it in tiles to the folder `tiles`."""
        with estimation.stopwatch("map"):
            elevation = estimation.build_map(result, None)
            return Maps(elevation, n_tiles=self.guard.attempt("tiles", lambda: _write_tiles(estimation, result)) or 0)

    def findings(self, result: SurveyResult, elevation: ElevationMap | None) -> list[Finding]:
        frames = self.opened.frames
        found, most = list[Finding](), _MOST_UNUSED * len(frames)
        if frames.unused > most:
            text = f"{frames.unused} of {len(frames)} frames of the data set could not be used, see replay.skipped"
            found.append(Finding("frames_used", frames.unused, most, text))
        return found + check_survey(result, frames.rectification.rig, elevation)

    def evaluation(self, result: SurveyResult, maps: Maps) -> EvaluationInput:
        frames, times_s = self.opened.frames, result.online.times_s
        source = _source(self.opened) | {"skipped": dict(frames.skipped), "frames_in_dataset": len(frames)}
        return EvaluationInput(
            result, maps.elevation,
            self.guard.attempt("evaluation", lambda: self._truth(result, maps.elevation)) or self._truth(result, None),
            frames.rectification.rig, timing={"simulated_s": float(times_s[-1] - times_s[0]) if len(times_s) else 0.0},
            identity={"name": self.opened.name}, warnings=self._notes(result),
            source=source | ({"tiles": maps.n_tiles} if maps.n_tiles else {}),
        )  # fmt: skip

    def _truth(self, result: SurveyResult, elevation: ElevationMap | None) -> RecordedTruth:
        path, true_map, alignment = self.opened.truth, self.opened.true_map, self.options.alignment
        if path is None or true_map is None or elevation is None or not are_comparable(result.final, path):
            return RecordedTruth(path, alignment)
        moved = true_from_world(result.final, path, alignment)
        return RecordedTruth(path, alignment, true_heights(elevation, true_map, moved))

    def _notes(self, result: SurveyResult) -> list[str]:
        aiding, estimator = self.opened.aiding, self.options.estimator
        notes = [*self.opened.dataset.notes, *result.quality.repeat_notes, *result.quality.reading_notes]
        notes += [self.opened.depth_note] if self.opened.depth_note else []
        if estimator is not None:
            notes.append(NOTE.format(estimator))
        if aiding is not None:
            notes += aiding.notes
            notes += [
                f"The readings of {name} deviate from the final path by {ratio:.1f} standard deviations (RMS), where 1 "
                "is expected: their noise is larger than stated, or they belong to another body or clock."
                for name, ratio in aiding.residuals(result.final).items()
                if ratio > _MOST_RESIDUAL
            ]
        return notes

    def record(self, survey: EvaluationInput, written: SurveyRecord) -> SurveyRecord:
        """Returns the contents of the run folder, with the truth, moved to the world of the estimates."""
        assert isinstance(survey.truth, RecordedTruth)
        final, path, truth = survey.result.final, survey.truth.trajectory, None
        rows = associate(final.times_s, np.zeros(0) if path is None else path.times_s)
        if path is not None and len(final) and np.array_equal(rows.estimate, np.arange(len(final))):
            moved = in_world(path, final, survey.truth.alignment)
            truth = Trajectory(final.times_s, moved.world_from_camera[rows.truth])
        return replace(written, recorded_truth=truth, recorded_heights_m=survey.truth.heights_m)


def _write_tiles(estimation: Estimation, result: SurveyResult) -> int:
    """Writes the tiles of a map of enlarged cells until an error, which the guard records; returns their number."""
    folder = estimation.folder.tiled_map()
    try:
        for tile, elevation in estimation.navigator.build_tiles(result):
            folder.add(tile.row, tile.col, elevation)
    except OSError as error:
        estimation.guard.cause = estimation.guard.cause or str(error)
    finally:
        with suppress(OSError):
            folder.finish()
    return folder.n_tiles


def _source(opened: OpenedDataset) -> dict[str, Any]:
    return {
        "dataset": opened.name,
        "reader": opened.reader,
        "images": opened.frames.rectification.sentence,
        "plane": opened.plane_text,
        "aiding": ", ".join(opened.used_readings) or "none",
    }


def alignment_name(name: str) -> AlignmentName:
    return _one_of(ALIGNMENTS, name, "--align", "an alignment")


def bayer_pattern(name: str | None) -> Bayer | None:
    return None if name is None else _one_of(BAYER, name, "--bayer", "a Bayer pattern")


def frame_numbers(text: str | None) -> slice:
    """Returns the slice of the text FIRST:END or FIRST:END:STEP, any of them empty; all frames for None."""
    if text is None:
        return slice(None)
    try:
        parts = [int(part) if part.strip() else None for part in text.split(":")]
    except ValueError:
        parts = []
    if len(parts) not in (2, 3) or any(part is not None and part < 0 for part in parts) or parts[2:] == [0]:
        raise TwinError(
            "--frames", f"{text[:40]!r} is no range of frames", "FIRST:END or FIRST:END:STEP, e.g. 100:400:2"
        )
    return slice(*parts)


def _one_of(allowed: Sequence[T], name: str, option: str, what: str) -> T:
    for value in allowed:
        if value == name:
            return value
    raise TwinError(option, f"{name[:40]!r} is not {what}", ", ".join(map(str, allowed)))


def image_topics(text: str | None) -> tuple[str, str] | None:
    """Returns the topics (left, right) in `LEFT,RIGHT`, None for None; raises TwinError unless they are two topics."""
    if text is None:
        return None
    topics = [part.strip() for part in text.split(",")]
    if len(topics) != 2 or not all(topics) or topics[0] == topics[1]:
        raise TwinError("--topics", f"{text[:100]!r} is not two topics", "LEFT,RIGHT")
    return topics[0], topics[1]
