"""Flights of the paper's mission: with alignment, and on the integrated frame-to-frame motion alone."""

from __future__ import annotations

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
from twin.estimate.pipeline import Navigator, finish_in_stage
from twin.scenario.model import Scenario
from twin.session.assembly import image_vision, make_navigator, open_world
from twin.survey import fly
from twin.world.mission import Mission, prepare
from twin.world.world import World


@dataclass(frozen=True)
class Flown:
    """A mission that was flown."""

    mission: Mission
    result: SurveyResult
    elevation: ElevationMap  #: map along the final trajectory; after a flight without alignment, the F2F trajectory
    truth: Truth  #: true trajectory and floor, without the function that returns the albedo
    stages: dict[str, Any]  #: durations of the processing stages, as `Stopwatch.summary` returns them
    ended: str = ""  #: why the flight ended early or the final alignment is missing; "" if neither is the case


class F2fNavigator(Navigator):
    """Navigator whose online and final poses are the integrated frame-to-frame motion, without any correction."""

    def update(self, frame: Frame, track: int = 1) -> Estimate:
        estimate = super().update(frame, track)
        return estimate._replace(world_from_camera=estimate.f2f_from_start)

    def align_track(self, track: int) -> None:
        """Does nothing."""

    def finish(self) -> SurveyResult:
        result = super().finish()
        return replace(result, online=result.f2f, final=result.f2f)


def fly_in_parallel(flights: Mapping[str, tuple[Callable[[Scenario, str], Flown], Scenario]]) -> dict[str, Flown]:
    """Flies missions in processes of their own, at most one per core, and returns them by name.

    Prints lines of progress on stderr during long flights.

    Args:
        flights: function that flies the mission and its scenario, by name; the longest first.

    Raises:
        TwinError: a mission cannot be prepared, or no stereo pair became a keyframe.
    """
    with ProcessPoolExecutor(min(len(flights), os.cpu_count() or 1), mp_context=get_context("spawn")) as pool:
        flown = {name: pool.submit(function, scenario, name) for name, (function, scenario) in flights.items()}
        return {name: future.result() for name, future in flown.items()}


def fly_aligned(scenario: Scenario, name: str = "") -> Flown:
    """Flies a mission with all corrections; the network is aligned after each track.

    The name is that in the lines of progress on stderr; "": no such lines.

    Raises:
        TwinError: the mission cannot be prepared, or no stereo pair became a keyframe.
    """
    return _fly(prepare(scenario), make_navigator, name)


def fly_without_alignment(scenario: Scenario, name: str = "") -> Flown:
    """Flies a mission on the integrated F2F motion, without F2M and GA, and maps along the F2F trajectory.

    This is the case of Negahdaripour & Madjidi (2003, Fig. 7c): the vehicle follows a path with drift, so its images
    do not cover the whole area, and the map has holes. Arguments and errors as for `fly_aligned`.
    """
    estimate = scenario.estimate.model_copy(update={"use_f2m": False, "use_ga": False, "max_links": 1})
    return _fly(prepare(scenario.model_copy(update={"estimate": estimate})), _f2f_navigator, name)


@contextmanager
def _f2f_navigator(mission: Mission, _: World, folder: Path, stopwatch: Stopwatch) -> Generator[Navigator]:
    """Opens an `F2fNavigator`; arguments as for `make_navigator`."""
    settings, noise = mission.scenario.estimator_settings(), mission.scenario.believed_noise()
    with (
        image_vision(mission, folder, stopwatch) as vision,
        F2fNavigator(mission.rig, settings, mission.start, noise, vision, stopwatch=stopwatch) as navigator,
    ):
        yield navigator


Make = Callable[[Mission, World, Path, Stopwatch], AbstractContextManager[Navigator]]


def _fly(mission: Mission, make: Make, name: str = "") -> Flown:
    """Flies a mission with the navigator that `make` opens, and builds the elevation map; name: see `fly_aligned`."""
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
    navigator: Navigator, grid: MapGrid, guard: StageGuard, stopwatch: Stopwatch | None = None
) -> tuple[SurveyResult, ElevationMap]:
    """Returns the result of the estimators and the elevation map along the final trajectory.

    If the final alignment fails, the result is without it, and `guard.cause` states why.

    Raises:
        TwinError: the survey has no keyframe, so that there is no map.
        KeyboardInterrupt: the alignment was interrupted; an interrupt ends the whole experiment.
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
