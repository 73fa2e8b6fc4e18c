"""Flights of the paper's mission: with alignment, and on the integrated frame-to-frame motion alone."""

import os
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from twin.core.interrupts import StageGuard
from twin.core.records import ElevationMap, Estimate, Frame, MapGrid, SurveyResult, Truth
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted, TwinError
from twin.estimate.pipeline import Navigator
from twin.scenario.model import Scenario
from twin.session.assembly import Estimators, image_vision, make_navigator, open_world
from twin.session.conclusion import finish_in_stage
from twin.survey import fly
from twin.world.mission import Mission, prepare
from twin.world.world import World


@dataclass(frozen=True)
class Flown:
    mission: Mission
    result: SurveyResult
    elevation: ElevationMap  #: map along the final trajectory; after a flight without alignment, the F2F trajectory
    truth: Truth  #: true trajectory and floor, without the function that returns the albedo
    stages: dict[str, Any]  #: durations of the processing stages, as `Stopwatch.summary` returns them
    ended: str = ""  #: why the flight ended early or the final alignment is missing; "" if neither is the case


class F2fNavigator(Navigator):
    """Navigator whose online and final poses are the integrated frame-to-frame motion."""

    def update(self, frame: Frame, track: int = 1) -> Estimate:
        estimate = super().update(frame, track)
        return estimate._replace(world_from_camera=estimate.f2f_from_start)

    def align_track(self, track: int) -> None:
        """Does nothing."""

    def finish(self) -> SurveyResult:
        result = super().finish()
        return replace(result, online=result.f2f, final=result.f2f)


def fly_in_parallel(flights: Mapping[str, tuple[Callable[[Scenario, str], Flown], Scenario]]) -> dict[str, Flown]:
    """Flies missions, the longest first, in processes, at most one per core; raises errors as `fly_aligned` does."""
    with ProcessPoolExecutor(min(len(flights), os.cpu_count() or 1), mp_context=get_context("spawn")) as pool:
        flown = {name: pool.submit(function, scenario, name) for name, (function, scenario) in flights.items()}
        return {name: future.result() for name, future in flown.items()}


def fly_aligned(scenario: Scenario, name: str = "") -> Flown:
    """Flies a mission, aligned after each track; `name` prints progress; TwinError if invalid or without keyframe."""
    return _fly(prepare(scenario), make_navigator, name)


def fly_without_alignment(scenario: Scenario, name: str = "") -> Flown:
    """Flies a mission on the integrated F2F motion, without F2M and GA, and maps along it; see `fly_aligned`."""
    # Negahdaripour & Madjidi (2003, Fig. 7c): the path drifts, so images miss some of the area, and the map has holes.
    estimate = scenario.estimate.model_copy(update={"use_f2m": False, "use_ga": False, "max_links": 1})
    return _fly(prepare(scenario.model_copy(update={"estimate": estimate})), _f2f_navigator, name)


@contextmanager
def _f2f_navigator(mission: Mission, _: World, folder: Path, stopwatch: Stopwatch) -> Generator[Navigator]:
    settings, noise = mission.scenario.estimator_settings(), mission.scenario.believed_noise()
    with (
        image_vision(mission, folder, stopwatch) as vision,
        F2fNavigator(mission.rig, settings, mission.start, noise, vision, stopwatch=stopwatch) as navigator,
    ):
        yield navigator


def _fly(mission: Mission, make: Callable[..., AbstractContextManager[Estimators]], name: str = "") -> Flown:
    """Flies a mission with the navigator that `make` opens, with the arguments of `make_navigator`."""
    stopwatch, guard = Stopwatch(), StageGuard()
    with (
        tempfile.TemporaryDirectory(prefix="twin-") as folder,
        open_world(mission, stopwatch) as world,
        make(mission, world, Path(folder), stopwatch) as navigator,
    ):
        try:
            fly(mission, world, navigator, _progress_lines(name, mission.n_frames))
        except SurveyAborted as error:
            guard.cause = str(error)
        result, elevation = finished_map(navigator, mission.grid, guard, stopwatch)
        return Flown(mission, result, elevation, replace(world.truth(), albedo=None), stopwatch.summary(), guard.cause)


def _progress_lines(name: str, n_frames: int) -> Callable[[Estimate, Frame], None]:
    """Returns a function that prints a line on stderr after each tenth of a flight of more than a minute."""
    start_s, printed = time.monotonic(), 0

    def observe(_: Estimate, frame: Frame) -> None:
        nonlocal printed
        tenths, elapsed_s = 10 * (frame.index + 1) // n_frames, time.monotonic() - start_s
        if name and tenths > printed and elapsed_s > 60:
            print(f"{name}: {10 * tenths} % flown after {elapsed_s / 60:.0f} min", file=sys.stderr)
        printed = tenths

    return observe


def finished_map(
    navigator: Estimators, grid: MapGrid, guard: StageGuard, stopwatch: Stopwatch | None = None
) -> tuple[SurveyResult, ElevationMap]:
    """Returns the result of the estimators and the elevation map along the final trajectory.

    If the final alignment fails, the result is without it, and `guard.cause` states why. Raises TwinError without a
    keyframe, and KeyboardInterrupt, which ends the experiment, if the alignment was interrupted.
    """
    result = finish_in_stage(navigator, guard)
    if guard.skipped:
        raise KeyboardInterrupt
    with (stopwatch or Stopwatch())("map"):
        elevation = navigator.build_map(result, grid)
    if elevation is None:
        reason = f" ({guard.cause})" if guard.cause else ""
        raise TwinError("experiment", f"no map, because no stereo pair became a keyframe{reason}", "at least one")
    return result, elevation
