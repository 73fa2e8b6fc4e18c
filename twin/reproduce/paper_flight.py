"""Flights of the paper's mission: with alignment, and on the integrated frame-to-frame motion alone."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
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
        truth: true trajectory and floor.
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


def fly_aligned(scenario: Scenario) -> Flown:
    """Flies a mission with all corrections; the network is aligned after each track.

    Raises:
        TwinError: the mission cannot be prepared, or no stereo pair became a keyframe.
    """
    return _fly(prepare(scenario), make_navigator)


def fly_without_alignment(scenario: Scenario) -> Flown:
    """Flies a mission on the integrated F2F motion, without F2M and GA, and maps along the F2F trajectory.

    This is the case of Negahdaripour & Madjidi (2003, Fig. 7c): the vehicle follows a path with drift, so its images
    do not cover the whole area, and the map has holes.

    Raises:
        TwinError: the mission cannot be prepared, or no stereo pair became a keyframe.
    """
    estimate = scenario.estimate.model_copy(update={"use_f2m": False, "use_ga": False, "max_links": 1})
    return _fly(prepare(scenario.model_copy(update={"estimate": estimate})), _f2f_navigator)


def _f2f_navigator(mission: Mission, world: World, folder: Path, stopwatch: Stopwatch) -> Navigator:
    """Returns an `F2fNavigator`; arguments as for `make_navigator`."""
    settings, noise = mission.scenario.estimator_settings(), mission.scenario.believed_noise()
    vision = image_vision(mission, folder, stopwatch)
    return F2fNavigator(mission.rig, settings, mission.start, noise, vision, stopwatch=stopwatch)


def _fly(mission: Mission, make: Callable[[Mission, World, Path, Stopwatch], Navigator]) -> Flown:
    """Flies a mission with the navigator that `make` returns, and builds the elevation map.

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
            fly(mission, world, navigator, lambda *_: None)
        except SurveyAborted as error:
            guard.cause = str(error)
        result = finished(navigator, guard)
        if isinstance(navigator, F2fNavigator):
            result = replace(result, online=result.f2f, final=result.f2f)
        with stopwatch("map"):
            elevation = required_map(navigator, result, mission.grid, guard)
        return Flown(mission, result, elevation, world.truth(), stopwatch.summary(), guard.cause)
