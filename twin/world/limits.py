"""Limits on the size of a survey, checked before memory for it is allocated."""

from __future__ import annotations

import math

from twin.controllers.survey_plan import SurveyPlan
from twin.core.records import MapGrid
from twin.errors import TwinError
from twin.scenario.model import Scenario

#: Largest number of frames (18 hours at 30 Hz; about 1 kB of memory each), of keyframes, and of cells of the map
#: (about 100 bytes of memory each).
MAX_FRAMES, MAX_KEYFRAMES, MAX_MAP_CELLS = 2_000_000, 200_000, 25_000_000


def check_plan_size(scenario: Scenario, plan: SurveyPlan) -> None:
    """Raises TwinError if a plan has more than `MAX_FRAMES` frames or `MAX_KEYFRAMES` keyframes."""
    duration_s = sum(plan.track_duration_s(track) for track in range(1, plan.n_tracks + 1))
    hold_s = scenario.control.hold_s * plan.n_tracks
    n_frames = (duration_s + hold_s) * plan.frame_rate_hz
    _check("plan.area_m", n_frames, MAX_FRAMES, "frames", "fewer plan.tracks, a smaller area, less overlap, more speed")
    n_keyframes = duration_s * plan.frame_rate_hz / plan.n_frames_per_keyframe
    _check("plan.overlap_along", n_keyframes, MAX_KEYFRAMES, "keyframes", "less overlap, or fewer plan.tracks")


def check_map_size(grid: MapGrid) -> None:
    """Raises TwinError if a map has more than `MAX_MAP_CELLS` cells."""
    n_cells = grid.rows * grid.cols
    needed_m = grid.cell_m * math.sqrt(n_cells / MAX_MAP_CELLS)
    _check("map.cell_m", n_cells, MAX_MAP_CELLS, "cells of the map", f"a cell of {needed_m:.2g} m")


def _check(field: str, number: float, limit: int, items: str, remedy: str) -> None:
    """Raises TwinError if a number of items exceeds its limit."""
    if number > limit:
        raise TwinError(field, f"{number:.4g} {items} are too many", f"up to {limit}: {remedy}")
