"""Errors of the tasks of a survey: of their maps, and of the position before and after them."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import ElevationMap, SurveyResult, Truth
from twin.judge.map_error import map_metrics
from twin.judge.trajectory_errors import path_errors


class SurveyedTask(NamedTuple):
    """Task of a survey with its map."""

    name: str
    track: int  #: number of its track, from 1
    elevation: ElevationMap | None  #: map from the keyframes of its track
    truth: Truth  #: truth at the cells of this map
    in_area: NDArray[np.bool_]  #: (rows, cols) cells of the map of the area that lie in the asked part of the task


def task_metrics(
    task: SurveyedTask, result: SurveyResult, elevation: ElevationMap | None, truth: Truth
) -> dict[str, Any]:
    """Returns an item of `tasks[]` of metrics.json.

    The keys of `map.*` are those of the map of the task; area_map_le90_m is LE90 of the map of the area over the same
    ground. error_before_m and error_after_m are the errors of the online position at the frames before the first and
    after the last frame of its track: at the place where the survey was broken off.
    """
    error_m, frames = path_errors(result.online, truth.trajectory).distance_m, np.flatnonzero(truth.track == task.track)
    there = replace(truth, seen=truth.seen & task.in_area, asked=truth.asked & task.in_area)
    return {
        "name": task.name,
        "track": task.track,
        **map_metrics(task.elevation, task.truth),
        "area_map_le90_m": map_metrics(elevation, there)["le90_m"],
        "error_before_m": _at(error_m, int(frames[0]) - 1) if len(frames) else None,
        "error_after_m": _at(error_m, int(frames[-1])) if len(frames) else None,
    }


def _at(error_m: NDArray[np.float64], frame: int) -> float | None:
    return float(error_m[frame]) if 0 <= frame < len(error_m) else None
