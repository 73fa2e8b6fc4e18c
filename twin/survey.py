"""One survey, in the order of the paper: plan, fly and estimate track by track, map, judge, show."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from twin.config import Scenario
from twin.errors import SurveyAborted
from twin.estimate.pipeline import Navigator
from twin.estimate.vision import StereoVision
from twin.mission import Mission, Step, prepare
from twin.pilot import make_pilot
from twin.records import Estimate
from twin.results import RunResult, conclude
from twin.run_writer import RunFolder
from twin.sea import Sea
from twin.timing import Stopwatch

_PATIENCE_S = 2.0  # without vision for longer, the vehicle is lost


class Progress(NamedTuple):
    """How far the survey is: simulated and wall time [s], share of the stage, believed position error (1 sigma) [m]."""

    simulated_s: float
    wall_s: float
    share: float
    sigma_m: float
    stage: str


def run(
    scenario: Scenario,
    out: Path,
    progress: Callable[[Progress], None] = lambda _: None,
    live: bool = False,
) -> RunResult:
    """Flies a scenario and leaves a run folder; an aborted survey keeps what it has.

    Raises:
        ScenarioError: the survey cannot be flown as asked; nothing was written.
    """
    mission = prepare(scenario)
    watch, begun, reason = Stopwatch(), time.perf_counter(), ""

    def say(stage: str, share: float) -> None:
        progress(Progress(0.0, time.perf_counter() - begun, share, 0.0, stage))

    with Sea(mission, watch) as sea, RunFolder(out, mission) as folder:
        navigator = make_navigator(mission, out, watch)
        try:
            fly(mission, sea, navigator, _Watcher(mission, folder, progress, begun, live))
        except (SurveyAborted, OSError, KeyboardInterrupt) as error:
            reason = str(error) or "interrupted"
        return conclude(mission, folder, navigator, sea.truth(), watch, begun, reason, say)


def fly(mission: Mission, sea: Sea, navigator: Navigator, watcher: Callable[[Step, Estimate, Any], None]) -> None:
    """The closed loop: what the vehicle sees moves what it believes, what it believes moves the vehicle."""
    pilot = make_pilot(mission)

    def steer(step: Step, track: int) -> None:
        frame = sea.observe(step, track)
        estimate = navigator.update(frame, track)
        watcher(step, estimate, frame)
        sea.act(pilot(estimate, step.reference))

    for track in mission.tracks:
        for step in mission.fly(track):
            steer(step, track)
        for step in mission.hold(track):
            steer(step, track)
        navigator.align_track(track)  # while the vehicle keeps station
        for step in mission.hold(track):
            steer(step, track)


def make_navigator(mission: Mission, folder: Path, watch: Stopwatch) -> Navigator:
    """The estimators with all they may know: calibration, data sheets, settings, the planned start."""
    scenario, rig = mission.scenario, mission.rig
    pixel_m = scenario.plan.altitude_m / rig.focal_px
    vision = StereoVision(rig, scenario.estimate, pixel_m, folder / "keypoints", watch)
    return Navigator(vision, rig, scenario.believed_noise(), scenario.estimate, mission.start, watch)


class _Watcher:
    """Looks on: progress, log, live view, and the end of patience when vision is lost."""

    def __init__(self, mission: Mission, folder: RunFolder, progress, begun: float, live: bool):
        self.n_frames, self.rate_hz = mission.n_frames, mission.rig.frame_rate_hz
        self.folder, self.progress, self.begun = folder, progress, begun
        self.live = None
        if live:
            from twin.view import Live

            self.live = Live(mission.rig)
        self.blind, self.count, self.status = 0, 0, "ok"

    def __call__(self, step: Step, estimate: Estimate, frame) -> None:
        self.count += 1
        self.blind = 0 if estimate.status == "ok" else self.blind + 1
        if estimate.status != self.status:
            self.folder.log("vision", time_s=estimate.time_s, status=estimate.status)
            self.status = estimate.status
        if self.live is not None:
            self.live.log_frame(frame, estimate)
        wall_s = time.perf_counter() - self.begun
        self.progress(Progress(estimate.time_s, wall_s, self.count / self.n_frames, estimate.sigma_m, "survey"))
        if self.blind > _PATIENCE_S * self.rate_hz:
            raise SurveyAborted(f"vision lost at {estimate.time_s:.1f} s: {estimate.status}")
