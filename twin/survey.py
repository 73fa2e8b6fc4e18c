"""Complete survey: plan, fly and estimate track by track, build the map, compare with the truth, write the report."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

from twin.core.interrupts import StageGuard
from twin.core.output_folder import sole_writer
from twin.core.quality import Gaps
from twin.core.records import Estimate, Frame
from twin.core.threads import one_blas_thread
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.report.frame_recorder import FrameRecorder, remove_keyframe_images
from twin.report.run_result import RunResult
from twin.report.run_writer import OPTIONAL_OUTPUTS, RunFolder
from twin.scenario.model import Scenario
from twin.session.assembly import Estimators, make_navigator, open_world
from twin.session.conclusion import Estimation, conclude
from twin.session.flown_survey import FlownSurvey
from twin.session.mission_actions import MissionActions
from twin.session.monitor import SurveyMonitor, SurveyProgress
from twin.session.path_adaptation import PathAdaptation
from twin.world.mission import Mission, prepare
from twin.world.mission_flight import Flight
from twin.world.pace import FULL
from twin.world.pilot import make_pilot, without_feedback
from twin.world.world import World


def run(
    scenario: Scenario,
    out: Path,
    progress: Callable[[SurveyProgress], None] = lambda _: None,
    live: bool = False,
    outputs: Collection[str] | None = OPTIONAL_OUTPUTS,
) -> RunResult:
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
    """
    with sole_writer(out), one_blas_thread():
        return _run(prepare(scenario), out, progress, live, outputs)


def _run(
    mission: Mission,
    out: Path,
    progress: Callable[[SurveyProgress], None],
    live: bool,
    outputs: Collection[str] | None,
) -> RunResult:
    scenario, stopwatch, guard = mission.scenario, Stopwatch(), StageGuard()
    images = scenario.imaging.fidelity == "rendered" and outputs is not None
    with guard, open_world(mission, stopwatch) as world, RunFolder(out, scenario, outputs) as folder:
        _log_warnings(mission, world, folder)
        monitor = SurveyMonitor(mission, folder, progress, live)
        gaps = Gaps()
        with make_navigator(mission, world, out, stopwatch) as navigator:
            try:
                with guard.stage(), FrameRecorder(out, scenario.record if images else "none") as recorder:

                    def observe(estimate: Estimate, frame: Frame) -> None:
                        taken = replace(frame, readings=world.measured)
                        if scenario.record == "all" and frame.right is None:
                            taken = replace(taken, right=world.right_image())
                        recorder.add(taken, world.world_from_camera, world.vehicle.twist_body)
                        monitor(estimate, frame)

                    gaps = fly(mission, world, navigator, observe, monitor.actions)
            except (SurveyAborted, OSError, KeyboardInterrupt) as error:
                guard.cause = str(error) or "interrupted"
            for event in world.faults.events:
                folder.log("fault", **event.described)
            for thruster in world.thruster_monitor.lost:
                folder.log("thruster left out", **thruster._asdict())
            warnings = (*world.warnings, *world.faults.sentences, *world.thruster_monitor.sentences)
            actions = monitor.actions.times
            flown = FlownSurvey(mission, world.truth(), warnings, actions, gaps, world.detail_truth)
            estimation = Estimation(navigator, stopwatch, guard, folder, monitor.report_stage, monitor.start_s)
            result, _ = conclude(estimation, flown)
    if scenario.record == "none" and images:
        remove_keyframe_images(out)
    return result


def _log_warnings(mission: Mission, world: World, folder: RunFolder) -> None:
    if (share := mission.terrain.orthophoto_share) is not None and share < 1.0:
        folder.log("orthophoto covers a part of the floor; the rest has the other texture", share=round(share, 4))
    for warning in (*mission.hole_notes, *world.warnings):
        folder.log("warning", text=warning)


def fly(
    mission: Mission,
    world: World,
    navigator: Estimators,
    observe: Callable[[Estimate, Frame], None],
    actions: MissionActions | None = None,
) -> Gaps:
    """Runs the closed loop over all tracks: the pilot steers by the estimates, and its commands move the vehicle.

    After each track, the vehicle keeps station while the navigator runs a global alignment. Returns the gaps that were
    found and flown over after the last track.

    Args:
        observe: called with the estimate and its frame after every update of the navigator; not called for frames
            between keyframes that the compiled loop of a surrogate survey simulates.
        actions: chooses the pace along the path: the vehicle slows down or stops if tracking is poor or lost, until
            tracking recovers; None: the vehicle always flies at the planned speed.

    Raises:
        SurveyAborted: the physics diverged, an alignment or a plug-in failed, or `observe` aborted the survey.
        OSError: images could not be read or written.
    """
    pilot = make_pilot(mission, world.thruster_monitor)
    scenario = mission.scenario
    by_frame = scenario.control.height == "altimeter" or scenario.navigation.needs_every_frame
    flight = Flight(mission, world, None if by_frame else world.fast_forward(navigator, pilot))
    adapt = PathAdaptation(flight, pilot)
    frame = flight.start()
    while frame is not None:
        if flight.aligns:
            navigator.align_track(flight.track)
        estimate = navigator.update(frame, flight.track)
        observe(estimate, frame)
        command = pilot(without_feedback(estimate, flight.reference, frame.readings), flight.reference)
        adapt(frame, estimate, navigator)
        frame = flight.step(command, FULL if actions is None else actions(estimate, bool(frame.keyframe)))
        if actions is not None:
            actions.add_measured_frames(flight.n_skipped)
    return adapt.gaps
