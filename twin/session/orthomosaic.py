"""The orthomosaic of a survey: computed tile by tile, written, and compared with the true albedo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from twin.core.ortho_tiles import mean_colours, window
from twin.core.records import ElevationMap, SurveyResult, Truth
from twin.core.timing import StageTimer
from twin.estimate.mapping.orthomosaic import Restore
from twin.estimate.pipeline import Navigator
from twin.judge.orthomosaic import OrthomosaicJudge
from twin.report.run_writer import RunFolder
from twin.world.mission import Mission


class Orthomosaic(NamedTuple):
    """An orthomosaic that has been made and compared with the truth.

    Args:
        elevation: the elevation map, with the mean colours of the orthomosaic in its cells.
        metrics: `orthomosaic.*` of metrics.json.
    """

    elevation: ElevationMap
    metrics: dict[str, float | None]


def is_wanted(mission: Mission, folder: RunFolder) -> bool:
    """Returns whether to make the orthomosaic of a survey.

    It is made if the scenario enables it, and maps are written or a requirement limits one of its metrics.
    """
    scenario = mission.scenario
    return scenario.map.orthomosaic and (
        folder.writes_maps or any(name.startswith("orthomosaic.") for name in scenario.require)
    )


def make_orthomosaic(
    mission: Mission,
    navigator: Navigator,
    result: SurveyResult,
    elevation: ElevationMap,
    truth: Truth,
    folder: RunFolder,
    tools: tuple[StageTimer, Callable[[float], None]],
) -> Orthomosaic | None:
    """Makes the orthomosaic of a survey, writes it if the run folder keeps maps, and compares it with the truth.

    The orthomosaic is made from the images, the estimated poses and map, and, for the restoration of colours, from the
    lamps and the water of the scenario. The true albedo is used for the comparison only.

    Args:
        mission: the survey as planned.
        navigator: the estimators, with the images of the keyframes.
        result: output of the estimators.
        elevation: elevation map.
        truth: source of the true albedo and of the asked area.
        folder: run folder.
        tools: timer of the stages, which excludes the comparison from the stage "orthomosaic"; and function called
            with the completed fraction.

    Returns:
        The elevation map with the orthomosaic averaged to its cells, and the errors of the orthomosaic; None without
        images or mapped cells.

    Raises:
        OSError: the file could not be written, or an image could not be read.
    """
    stopwatch, progress = tools
    if not np.isfinite(elevation.height_m).any():
        return None
    with stopwatch("orthomosaic"):
        restore = _restoration(mission, elevation) if mission.scenario.map.restore else None
        tiles = navigator.orthomosaic(result, elevation, restore, progress)
        first = None if tiles is None else next(tiles, None)
    if tiles is None or first is None:
        return None
    judge, mosaic = OrthomosaicJudge(mission.scenario.map.restore), np.zeros_like(elevation.mosaic)
    n = round(elevation.grid.cell_m / first.grid.cell_m)
    with folder.orthomosaic_file(first.grid, mission.terrain.georeference) as file:
        tile = first
        while tile is not None:
            colours, row, col = mean_colours(tile, n), tile.row // n, tile.col // n
            mosaic[row : row + len(colours), col : col + colours.shape[1]] = colours
            if truth.albedo is not None and truth.in_area is not None:
                part = window(tile.grid, tile.row, tile.col, *tile.rgba.shape[:2])
                judge.add(tile, truth.albedo(part), truth.in_area(*np.meshgrid(*part.centres())))
            with stopwatch("orthomosaic"):
                if file is not None:
                    file.write(tile)
                tile = next(tiles, None)
    return Orthomosaic(replace(elevation, mosaic=mosaic), judge.metrics())


def _restoration(mission: Mission, elevation: ElevationMap) -> Restore:
    """Returns the restoration, which removes the effects of lamps, daylight and water from the colours of images."""
    from twin.imaging.restoration import Restoration  # imported here: a survey without it does not need its tables

    return Restoration(mission.scenario, mission.illumination, mission.rig, elevation)
