"""Flights of the paper's mission: with alignment, and on the integrated frame-to-frame motion alone."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from twin.core.interrupts import StageGuard
from twin.core.records import ElevationMap, Estimate, Frame, SurveyResult, Truth
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.estimate.pipeline import Navigator
from twin.reproduce.conclusion import finished, required_map
from twin.scenario.model import Scenario
from twin.session.assembly import image_vision, make_navigator, open_world
from twin.survey import fly
from twin.world.mission import Mission, prepare
from twin.world.world import World


@dataclass(frozen=True)
class Flown:
    """A mission that was flown.

    Args:
        mission: the mission.
        result: output of the estimators.
        elevation: map along the final trajectory; after a flight without alignment, along the F2F trajectory.
        truth: true trajectory and floor, without the function that returns the albedo.
        stages: durations of the processing stages, as `Stopwatch.summary` returns them.
        ended: why the flight ended early or the final alignment is missing; "" if neither is the case.
    """

    mission: Mission
    result: SurveyResult
    elevation: ElevationMap
    truth: Truth
    stages: dict[str, Any]
    ended: str = ""


class F2fNavigator(Navigator):
    """Navigator that reports the integrated frame-to-frame motion as the online pose, without any correction."""

    def update(self, frame: Frame, track: int = 1) -> Estimate:
        estimate = super().update(frame, track)
        return estimate._replace(world_from_camera=estimate.f2f_from_start)

    def align_track(self, track: int) -> None:
        """Does nothing."""


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

    Args:
        scenario: description of the survey.
        name: name in the lines of progress on stderr; "": no such lines.

    Raises:
        TwinError: the mission cannot be prepared, or no stereo pair became a keyframe.
    """
    return _fly(prepare(scenario), make_navigator, name)


def fly_without_alignment(scenario: Scenario, name: str = "") -> Flown:
    """Flies a mission on the integrated F2F motion, without F2M and GA, and maps along the F2F trajectory.

    This is the case of Negahdaripour & Madjidi (2003, Fig. 7c): the vehicle follows a path with drift, so its images
    do not cover the whole area, and the map has holes. Arguments as for `fly_aligned`.

    Raises:
        TwinError: the mission cannot be prepared, or no stereo pair became a keyframe.
    """
    estimate = scenario.estimate.model_copy(update={"use_f2m": False, "use_ga": False, "max_links": 1})
    return _fly(prepare(scenario.model_copy(update={"estimate": estimate})), _f2f_navigator, name)


def _f2f_navigator(mission: Mission, world: World, folder: Path, stopwatch: Stopwatch) -> Navigator:
    """Returns an `F2fNavigator`; arguments as for `make_navigator`."""
    settings, noise = mission.scenario.estimator_settings(), mission.scenario.believed_noise()
    vision = image_vision(mission, folder, stopwatch)
    return F2fNavigator(mission.rig, settings, mission.start, noise, vision, stopwatch=stopwatch)


Make = Callable[[Mission, World, Path, Stopwatch], AbstractContextManager[Navigator]]


class _ProgressLines:
    """Prints a line on stderr after each tenth of a flight that takes more than a minute."""

    def __init__(self, name: str, n_frames: int) -> None:
        self._name, self._n_frames = name, n_frames
        self._start_s, self._tenths = time.monotonic(), 0

    def __call__(self, _: Estimate, frame: Frame) -> None:
        tenths, elapsed_s = 10 * (frame.index + 1) // self._n_frames, time.monotonic() - self._start_s
        if self._name and tenths > self._tenths and elapsed_s > 60:
            print(f"{self._name}: {10 * tenths} % flown after {elapsed_s / 60:.0f} min", file=sys.stderr)
        self._tenths = tenths


def _fly(mission: Mission, make: Make, name: str = "") -> Flown:
    """Flies a mission with the navigator that `make` returns, and builds the elevation map; name: see `fly_aligned`.

    Raises:
        TwinError: no stereo pair became a keyframe, so that there is no map.
    """
    stopwatch, guard = Stopwatch(), StageGuard()
    with (
        tempfile.TemporaryDirectory(prefix="twin-") as folder,
        open_world(mission, stopwatch) as world,
        make(mission, world, Path(folder), stopwatch) as navigator,
    ):
        try:
            fly(mission, world, navigator, _ProgressLines(name, mission.n_frames))
        except SurveyAborted as error:
            guard.cause = str(error)
        result = finished(navigator, guard)
        if isinstance(navigator, F2fNavigator):
            result = replace(result, online=result.f2f, final=result.f2f)
        with stopwatch("map"):
            elevation = required_map(navigator, result, mission.grid, guard)
        return Flown(mission, result, elevation, replace(world.truth(), albedo=None), stopwatch.summary(), guard.cause)
