"""Complete survey: plan, fly and estimate track by track, build the map, compare with the truth, write the report."""

from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from twin.core.checkpoint import Checkpoints
from twin.core.interrupts import StageGuard
from twin.core.output_folder import sole_writer
from twin.core.quality import Gaps
from twin.core.records import Estimate, Frame
from twin.core.threads import one_blas_thread
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.report.frame_recorder import FrameRecorder, Record, remove_keyframe_images
from twin.report.run_result import RunResult
from twin.report.run_writer import OPTIONAL_OUTPUTS, RunFolder
from twin.scenario.file import dump_toml
from twin.scenario.model import Scenario
from twin.session.assembly import Estimators, checkpoints_of, closing, make_navigator, open_world
from twin.session.conclusion import Estimation, conclude, remove_state
from twin.session.flown_survey import FlownSurvey
from twin.session.mission_actions import MissionActions
from twin.session.monitor import SurveyMonitor, SurveyProgress
from twin.session.path_adaptation import PathAdaptation
from twin.world.mission import Mission, prepare
from twin.world.mission_flight import Flight
from twin.world.pace import FULL
from twin.world.pilot import PilotOfEstimates, make_pilot, without_feedback
from twin.world.world import World


@dataclass
class _Loop:
    """What the closed loop carries from one frame to the next."""

    flight: Flight
    pilot: PilotOfEstimates
    adapt: PathAdaptation
    frame: Frame | None


@dataclass
class _Survey:
    """A survey between two frames, or after the last one."""

    world: World
    folder: RunFolder
    monitor: SurveyMonitor
    navigator: Estimators
    stopwatch: Stopwatch
    recorder: FrameRecorder | None = None
    loop: _Loop | None = None
    flown: bool = False  #: whether the last frame has been flown
    cause: str = ""  #: why the flight was aborted, "" if it was not
    gaps: Gaps = Gaps()


def run(
    scenario: Scenario, out: Path, progress: Callable[[SurveyProgress], None] = lambda _: None, live: bool = False,
    outputs: Collection[str] | None = OPTIONAL_OUTPUTS, resume: bool = False, checkpoint_s: float | None = 0.0,
) -> RunResult:  # fmt: skip
    """Runs the survey of a scenario and writes a run folder, with the partial results if the survey is aborted.

    An interrupt (Ctrl-C) during the flight ends the flight. A later interrupt ends only the current stage: alignment,
    elevation map, orthomosaic, evaluation, map files, report or recording. The results of all other stages are written,
    and metrics.json in any case. Errors are those of `twin.run`.

    Args:
        progress: function called with the progress during the later stages and after every frame, except frames between
            keyframes that the compiled loop of a surrogate survey simulates.
        live: whether to show the survey in Rerun while it runs.
        outputs: outputs to write in addition to metrics, trajectories and maps: "report", "recording", both or none of
            them. None: write the metrics only.
        resume: whether to continue the survey in the folder from its last checkpoint; it ends as if it had not been
            killed, except times. Without a checkpoint in an otherwise empty folder, the survey begins.
        checkpoint_s: wall time between checkpoints [s]; 0: none; None: 60, or so much that they take 1 % of the time.
    """
    with sole_writer(out, used=resume), one_blas_thread():
        checkpoints = checkpoints_of(scenario, out, checkpoint_s)
        result = RunResult.of_finished(out, dump_toml(scenario)) if resume else None
        if result is None:
            result = _run(prepare(scenario), out, progress, live, outputs, checkpoints, resume)
        remove_state(checkpoints, out)
        if scenario.record == "none" and outputs is not None:
            remove_keyframe_images(out)
    return result


def _run(
    mission: Mission, out: Path, progress: Callable[[SurveyProgress], None], live: bool,
    outputs: Collection[str] | None, checkpoints: Checkpoints, resume: bool,
) -> RunResult:  # fmt: skip
    guard, stopwatch = StageGuard(), Stopwatch()
    with guard, ExitStack() as opened:
        with open_world(mission, stopwatch) as fresh:
            survey: _Survey | None = checkpoints.open(resume, (*fresh.made_anew, progress))
            if survey is None:
                folder = opened.enter_context(RunFolder(out, mission.scenario, outputs))
                _log_warnings(mission, fresh, folder)
                monitor = SurveyMonitor(mission, folder, progress)
                navigator = opened.enter_context(make_navigator(mission, fresh, out, stopwatch))
                survey = _Survey(fresh, folder, monitor, navigator, stopwatch)
            else:
                opened.enter_context(survey.folder)
                opened.enter_context(closing(survey.navigator))
            world, folder, monitor = survey.world, survey.folder, survey.monitor
            if live:
                from twin.report.recording import LiveViewer

                monitor.live = LiveViewer(mission.rig)
            if not survey.flown:
                images = mission.scenario.imaging.fidelity == "rendered" and outputs is not None
                _fly_recorded(mission, survey, out, mission.scenario.record if images else "none", guard, checkpoints)
            guard.cause = survey.cause
            for event in world.faults.events:
                folder.log("fault", **event.described)
            for thruster in world.thruster_monitor.lost:
                folder.log("thruster left out", **thruster._asdict())
            warnings = (*world.warnings, *world.faults.sentences, *world.thruster_monitor.sentences)
            actions = monitor.actions.times
            flown = FlownSurvey(mission, world.truth(), warnings, actions, survey.gaps, world.detail_truth)
        timed = survey.navigator, survey.stopwatch
        estimation = Estimation(*timed, guard, folder, monitor.report_stage, monitor.start_s)
        return conclude(estimation, flown)[0]


def _fly_recorded(
    mission: Mission, survey: _Survey, out: Path, record: Record, guard: StageGuard, checkpoints: Checkpoints
) -> None:
    """Flies a survey from where it is to its end, with checkpoints; `survey.cause` says why it ended early."""
    world = survey.world

    def save_if_due(loop: _Loop) -> None:
        survey.loop = loop
        checkpoints.save_if_due(survey)

    try:
        with guard.stage(), survey.recorder or FrameRecorder(out, record) as recorder:
            survey.recorder = recorder

            def observe(estimate: Estimate, frame: Frame) -> None:
                taken = replace(frame, readings=world.measured)
                if mission.scenario.record == "all" and frame.right is None:
                    taken = replace(taken, right=world.right_image())
                recorder.add(taken, world.world_from_camera, world.vehicle.twist_body, world.thrust_n)
                survey.monitor(estimate, frame)

            actions = survey.monitor.actions
            survey.gaps = fly(mission, world, survey.navigator, observe, actions, survey.loop, save_if_due)
    except (SurveyAborted, OSError, KeyboardInterrupt) as error:
        survey.cause = str(error) or "interrupted"
        survey.folder.log("flight ended early", reason=survey.cause)
    survey.loop, survey.recorder, survey.flown = None, None, True
    checkpoints.save_last(survey)
    if checkpoints.problem:
        survey.folder.log("no checkpoint", reason=checkpoints.problem)


def _log_warnings(mission: Mission, world: World, folder: RunFolder) -> None:
    if (share := mission.terrain.orthophoto_share) is not None and share < 1.0:
        folder.log("orthophoto covers a part of the floor; the rest has the other texture", share=round(share, 4))
    for warning in (*mission.hole_notes, *world.warnings):
        folder.log("warning", text=warning)


def fly(
    mission: Mission, world: World, navigator: Estimators, observe: Callable[[Estimate, Frame], None],
    actions: MissionActions | None = None, resumed: _Loop | None = None,
    between_frames: Callable[[_Loop], None] = lambda _: None,
) -> Gaps:  # fmt: skip
    """Runs the closed loop over all tracks: the pilot steers by the estimates, and its commands move the vehicle.

    After each track, the vehicle keeps station while the navigator runs a global alignment. Returns the gaps that were
    found and flown over after the last track.

    Args:
        observe: called with the estimate and its frame after every update of the navigator; not called for frames
            between keyframes that the compiled loop of a surrogate survey simulates.
        actions: chooses the pace along the path: the vehicle slows down or stops if tracking is poor or lost, until
            tracking recovers; None: the vehicle always flies at the planned speed.
        resumed: the loop of a checkpoint, which goes on; None: the survey begins.
        between_frames: called before every frame; it may save a checkpoint.

    Raises:
        SurveyAborted: the physics diverged, an alignment or a plug-in failed, or `observe` aborted the survey.
        OSError: images could not be read or written.
    """
    loop, scenario = resumed or _take_off(mission, world), mission.scenario
    flight, pilot, adapt = loop.flight, loop.pilot, loop.adapt
    by_frame = scenario.control.height == "altimeter" or scenario.navigation.needs_every_frame
    flight.fast_forward = None if by_frame else world.fast_forward(navigator, pilot)
    while (frame := loop.frame) is not None:
        between_frames(loop)
        if flight.aligns:
            navigator.align_track(flight.track)
        estimate = navigator.update(frame, flight.track)
        observe(estimate, frame)
        command = pilot(without_feedback(estimate, flight.reference, frame.readings), flight.reference)
        adapt(frame, estimate, navigator)
        loop.frame = flight.step(command, FULL if actions is None else actions(estimate, bool(frame.keyframe)))
        if actions is not None:
            actions.add_measured_frames(flight.n_skipped)
    return adapt.gaps


def _take_off(mission: Mission, world: World) -> _Loop:
    pilot, flight = make_pilot(mission, world.thruster_monitor), Flight(mission, world)
    return _Loop(flight, pilot, PathAdaptation(flight, pilot), flight.start())
