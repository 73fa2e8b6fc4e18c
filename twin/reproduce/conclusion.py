"""Conclusion of an experiment's flight: result of the estimators and elevation map, or an error that states why not."""

from __future__ import annotations

from twin.core.interrupts import StageGuard
from twin.core.records import ElevationMap, MapGrid, SurveyResult
from twin.errors import TwinError
from twin.estimate.pipeline import Navigator, finish_in_stage


def finished(navigator: Navigator, guard: StageGuard) -> SurveyResult:
    """Returns the result of the estimators, without the final alignment if it fails; `guard.cause` then states why.

    Raises:
        KeyboardInterrupt: the alignment was interrupted; an interrupt ends the whole experiment.
    """
    result = finish_in_stage(navigator, guard)
    if guard.skipped:
        raise KeyboardInterrupt
    return result


def required_map(navigator: Navigator, result: SurveyResult, grid: MapGrid, guard: StageGuard) -> ElevationMap:
    """Returns the elevation map along the final trajectory.

    Args:
        navigator: the estimators.
        result: result of the estimators.
        grid: grid of the map.
        guard: its `cause` states why the flight ended early, for the error message; "" if it did not.

    Raises:
        TwinError: the survey has no keyframe, so that there is no map.
    """
    elevation = navigator.build_map(result, grid)
    if elevation is None:
        reason = f" ({guard.cause})" if guard.cause else ""
        raise TwinError("experiment", f"no map, because no stereo pair became a keyframe{reason}", "at least one")
    return elevation
