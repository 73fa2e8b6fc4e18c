"""One survey, in the order of the paper: plan, fly and estimate track by track, map, judge, show."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple

from twin.core.records import Estimate
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.estimate.pipeline import Navigator
from twin.estimate.stereo_vision import StereoVision, Vision
from twin.report.run_writer import PICTURES, RunFolder
from twin.scenario.model import Scenario
from twin.session.conclusion import RunResult, conclude
from twin.world.mission import Course, Mission, Step, prepare
from twin.world.pilot import make_pilot
from twin.world.world import Watch, World

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
    shows: Collection[str] | None = PICTURES,
) -> RunResult:
    """Flies a scenario and leaves a run folder; an aborted survey keeps what it has.

    Args:
        shows: what is drawn of it in the end, "report" and "recording"; None: its figures alone are wanted.

    Raises:
        ScenarioError: the survey cannot be flown as asked; nothing was written.
    """
    mission = prepare(scenario)
    watch, begun, reason = Stopwatch(), time.perf_counter(), ""

    def say(stage: str, share: float) -> None:
        progress(Progress(0.0, time.perf_counter() - begun, share, 0.0, stage))

    with open_world(mission, watch) as world, RunFolder(out, mission, shows) as folder:
        for warning in world.warnings:
            folder.log("warning", text=warning)
        navigator = make_navigator(mission, vision_in(world, out), watch)
        try:
            fly(mission, world, navigator, _Watcher(mission, folder, progress, begun, live))
        except (SurveyAborted, OSError, KeyboardInterrupt) as error:
            reason = str(error) or "interrupted"
        return conclude(mission, folder, navigator, world, watch, begun, reason, say)


def fly(mission: Mission, world: World, navigator: Navigator, watcher: Callable[[Step, Estimate, Any], None]) -> None:
    """The closed loop: what the vehicle sees moves what it believes, what it believes moves the vehicle."""
    pilot = make_pilot(mission)
    glide = world.glide(navigator, pilot)

    def follow(course: Course, track: int) -> None:
        k = 0
        world.begin(course, track)
        while k < len(course):
            frame = world.observe(course[k])
            estimate = navigator.update(frame, track)
            watcher(course[k], estimate, frame)
            world.act(pilot(estimate, course[k].reference))
            k = k + 1 if glide is None else glide(course, k + 1)

    for track in mission.tracks:
        follow(mission.fly(track), track)
        follow(mission.hold(track), track)
        navigator.align_track(track)  # while the vehicle keeps station
        follow(mission.hold(track), track)


def open_world(mission: Mission, watch: Stopwatch) -> World:
    """The world of a mission, as real as its scenario asks."""
    if mission.scenario.imaging.fidelity == "rendered":
        from twin.world.rendered_world import RenderedWorld  # only here: MuJoCo and OpenGL are 25 MB

        return RenderedWorld(mission, watch)
    from twin.surrogate import error_model_file
    from twin.surrogate.surrogate_world import SurrogateWorld

    return SurrogateWorld(mission, watch, error_model_file.load(mission.scenario.imaging.error_model))


def vision_in(world: World, folder: Path) -> Vision:
    """What answers for the stereo camera: the images, or the world in their place where nothing is rendered."""
    return world.vision or image_vision(world.mission, folder, world.watch)


def image_vision(mission: Mission, folder: Path, watch: Watch) -> StereoVision:
    """Vision by images, with all it may know."""
    pixel_m = mission.scenario.plan.altitude_m / mission.rig.focal_px
    return StereoVision(mission.rig, mission.scenario.estimate, pixel_m, folder / "keyframes", watch)


def make_navigator(mission: Mission, vision: Vision, watch: Stopwatch) -> Navigator:
    """The estimators with all they may know: calibration, data sheets, settings, the planned start."""
    scenario = mission.scenario
    noise, beside = scenario.believed_noise(), scenario.imaging.fidelity == "rendered"
    return Navigator(vision, mission.rig, noise, scenario.estimate, mission.start, watch, beside)


class _Watcher:
    """Looks on: progress, log, live view, and the end of patience when vision is lost."""

    def __init__(self, mission: Mission, folder: RunFolder, progress, begun: float, live: bool):
        self.n_frames, self.rate_hz = mission.n_frames, mission.rig.frame_rate_hz
        self.water = mission.scenario.water.label
        self.folder, self.progress, self.begun = folder, progress, begun
        self.live = None
        if live:
            from twin.report.recording import Live

            self.live = Live(mission.rig)
        self.blind, self.status = 0, "ok"

    def __call__(self, step: Step, estimate: Estimate, frame) -> None:
        self.blind = 0 if estimate.status == "ok" else self.blind + 1
        if estimate.status != self.status:
            self.folder.log("vision", time_s=estimate.time_s, status=estimate.status)
            self.status = estimate.status
        if self.live is not None:
            self.live.log_frame(frame, estimate)
        wall_s = time.perf_counter() - self.begun
        share = (frame.index + 1) / self.n_frames
        self.progress(Progress(estimate.time_s, wall_s, share, estimate.sigma_m, "survey"))
        if self.blind > _PATIENCE_S * self.rate_hz:
            raise SurveyAborted(f"vision lost at {estimate.time_s:.1f} s in water {self.water}: {estimate.status}")
