"""The orthomosaic of a survey: computed tile by tile, written, and compared with the true albedo."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from twin.core.ortho_tiles import mean_colours, window
from twin.core.records import ElevationMap, SurveyResult, Truth
from twin.estimate.mapping.orthomosaic import Restore
from twin.judge.orthomosaic_errors import OrthomosaicJudge
from twin.report.run_writer import RunFolder
from twin.session.conclusion import Estimation, Maps
from twin.world.mission import Mission


def is_wanted(mission: Mission, folder: RunFolder) -> bool:
    """Returns whether to make the orthomosaic of a survey.

    It is made if the scenario enables it, and maps are written or a requirement limits one of its metrics.
    """
    scenario = mission.scenario
    return scenario.map.orthomosaic and (
        folder.writes_maps or any(name.startswith("orthomosaic.") for name in scenario.require)
    )


def make_orthomosaic(
    mission: Mission, truth: Truth, estimation: Estimation, result: SurveyResult, elevation: ElevationMap
) -> Maps | None:
    """Makes the orthomosaic of a survey, writes it if the run folder keeps maps, and compares it with the truth.

    The orthomosaic is made from the images, the estimated poses and map, and, for the restoration of colours, from the
    lamps and the water of the scenario. The true albedo is used for the comparison only.

    Returns:
        The elevation map with the orthomosaic averaged to its cells, and the errors of the orthomosaic; None without
        images or mapped cells.

    Raises:
        OSError: the file could not be written, or an image could not be read.
    """
    stopwatch, folder, restored = estimation.stopwatch, estimation.folder, mission.scenario.map.restore
    if not np.isfinite(elevation.height_m).any():
        return None
    with stopwatch("orthomosaic"):
        restore = _restoration(mission, elevation) if restored else None
        report = partial(estimation.progress, "orthomosaic")
        tiles = estimation.navigator.orthomosaic(result, elevation, restore, report) or iter(())
        first = tile = next(tiles, None)
    if first is None:
        return None
    judge, mosaic = OrthomosaicJudge(restored), np.zeros_like(elevation.mosaic)
    n = round(elevation.grid.cell_m / first.grid.cell_m)
    with folder.orthomosaic_file(first.grid, mission.terrain.georeference) as file:
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
    return Maps(replace(elevation, mosaic=mosaic), judge.metrics())


def _restoration(mission: Mission, elevation: ElevationMap) -> Restore:
    """Returns the restoration, which removes the effects of lamps, daylight and water from the colours of images."""
    from twin.imaging.restoration import Restoration  # imported here: a survey without it does not need its tables

    return Restoration(mission.scenario, mission.illumination, mission.rig, elevation)
