"""Complete survey: plan, fly and estimate track by track, build the map, compare with the truth, write the report."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from twin.core.interrupts import StageGuard
from twin.core.records import Estimate, Frame
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.estimate.pipeline import Navigator
from twin.report.run_writer import PICTURES, RunFolder
from twin.scenario.model import Scenario
from twin.session.assembly import make_navigator, open_world
from twin.session.conclusion import Flight, RunResult, conclude
from twin.session.mission_actions import MissionActions
from twin.session.monitor import SurveyMonitor, SurveyProgress
from twin.world.mission import Course, Mission, prepare
from twin.world.pace import FULL
from twin.world.pilot import make_pilot, without_feedback
from twin.world.world import World


def run(
    scenario: Scenario,
    out: Path,
    progress: Callable[[SurveyProgress], None] = lambda _: None,
    live: bool = False,
    outputs: Collection[str] | None = PICTURES,
) -> RunResult:
    """Flies a scenario and writes a run folder; if the survey is aborted, the folder contains its partial results.

    An interrupt (Ctrl-C) during the flight ends the flight. A later interrupt ends only the current stage: alignment,
    elevation map, evaluation, map files, report or recording. The results of all other stages are written, and
    metrics.json in any case.

    Args:
        scenario: description of the survey.
        out: run folder.
        progress: function called with the progress after every frame.
        live: whether to show the survey in Rerun while it runs.
        outputs: outputs to write in addition to metrics, trajectories and maps: "report", "recording", both or none of
            them. None: write the metrics only.

    Raises:
        ScenarioError: the scenario cannot be flown; nothing was written.
    """
    mission = prepare(scenario)
    stopwatch, guard = Stopwatch(), StageGuard()
    with guard, open_world(mission, stopwatch) as world, RunFolder(out, scenario, outputs) as folder:
        if mission.terrain.n_filled:
            folder.log("terrain holes filled", cells=mission.terrain.n_filled)
        for warning in world.warnings:
            folder.log("warning", text=warning)
        monitor = SurveyMonitor(mission, folder, progress, live)
        with make_navigator(mission, world, out, stopwatch) as navigator:
            try:
                with guard.stage():
                    fly(mission, world, navigator, monitor, monitor.actions)
            except (SurveyAborted, OSError, KeyboardInterrupt) as error:
                guard.cause = str(error) or "interrupted"
            return conclude(Flight(mission, world, navigator, stopwatch, guard), folder, monitor)


def fly(
    mission: Mission,
    world: World,
    navigator: Navigator,
    observe: Callable[[Estimate, Frame], None],
    actions: MissionActions | None = None,
) -> None:
    """Runs the closed loop over all tracks: the pilot steers by the estimates, and its commands move the vehicle.

    If tracking is poor or lost, the vehicle slows down or stops on its path until it is sound again (`MissionActions`).
    After each track, the vehicle keeps station while the navigator runs a global alignment.

    Args:
        mission: the survey to fly.
        world: simulates the vehicle, which executes the commands, and returns the frames.
        navigator: estimates the pose from the frames.
        observe: called with the estimate and its frame after every update of the navigator.
        actions: chooses the pace along the path; None: the vehicle flies at the planned speed in any case.
    """
    pilot = make_pilot(mission)
    fast_forward = world.fast_forward(navigator, pilot)

    def follow(course: Course, track: int) -> None:
        k = 0
        world.start_course(course, track)
        while k < len(course):
            frame = world.observe(course[k])
            estimate = navigator.update(frame, track)
            observe(estimate, frame)
            reference = course[k].reference
            world.act(pilot(without_feedback(estimate, reference, frame.readings), reference))
            pace = FULL if actions is None else actions(estimate)
            k += 1
            if course.holding or (pace == FULL and course.rate == 1):
                first, k = k, fast_forward(course, k)
                if actions is not None:
                    actions.add_sound_frames(k - first)
            else:
                world.end_course(k)
                course, k = mission.fly_on(track, course.path_times_s[k - 1], pace), 0
                world.start_course(course, track)

    for track in mission.tracks:
        follow(mission.fly(track), track)
        follow(mission.hold(track), track)
        navigator.align_track(track)  # during station keeping
        follow(mission.hold(track), track)
