"""Forecast of a survey over its floor: depth, footprint, overlap and coverage of the planned images by ray casting."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.height_field import RAY_COLUMNS, HeightField, cast_pixels, image_overlap, ray_grid
from twin.core.records import MapGrid
from twin.judge.swaths import KeyframePoses, image_pairs, thinned
from twin.terrains import Terrain
from twin.world.mission import Mission
from twin.world.observed_cells import seen_over
from twin.world.planning import floor_of, planned_keyframes
from twin.world.top_surface import with_objects

_OVERLAP_PAIRS = 1000  #: largest number of pairs from which a median overlap is forecast
_COVERAGE_CELLS = 1000  #: largest number of cells of the grid of the coverage along the longer side of the asked area


class Spread(NamedTuple):
    """Percentiles of a quantity; all are None if it has no finite value."""

    minimum: float | None
    p05: float | None
    median: float | None
    maximum: float | None


@dataclass(frozen=True)
class FloorForecast:
    """Forecast for n planned keyframes, k pairs along and j across swaths; NaN where an image shows no floor."""

    surface: Terrain  #: `planned_surface`; "floor" below refers to this surface
    keyframes: KeyframePoses
    depth_m: Array  #: (n, m) depth along the optical axis at m pixels on a regular grid
    altitude_m: Array  #: (n,) height of the camera above the floor straight below it
    clearance_m: Array  #: (n,) height of the camera above the highest floor in its image
    footprint_m: Array  #: (n, 2) extent on a level floor at the median depth, across and along the heading
    gsd_m: Array  #: (n,) ground sample distance at the median depth
    stereo_share: Array  #: (n,) share of the floor in the left image that the right image shows too
    #: along_position_m, across_position_m: (k, 2) and (j, 2) horizontal midpoint of the two cameras of each pair.
    along_position_m: Array
    across_position_m: Array
    overlap_along: Array  #: (k,) overlap of consecutive keyframes of the same swath
    overlap_across: Array  #: (j,) sidelap: overlap of a keyframe with the image abreast of it on the next swath
    coverage: float  #: share of the asked area that both cameras see in a keyframe, from images of fewer pixels


class PlannedOverlap(NamedTuple):
    along: float | None
    across: float | None


def planned_surface(mission: Mission) -> Terrain:
    """Returns the floor as known before the survey; the true one with its objects, which the surrogate lacks."""
    if mission.chart is not mission.terrain or not mission.objects or mission.scenario.imaging.fidelity != "rendered":
        return mission.chart
    return with_objects(mission.terrain, mission.objects)


def planned_overlap(mission: Mission, most_pairs: int = _OVERLAP_PAIRS) -> PlannedOverlap:
    """Returns the median overlaps forecast from at most `most_pairs` along and across swaths; None without one."""
    keyframes = planned_keyframes(mission.plan, mission.scenario.plan.pattern)
    pairs = (thinned(p, most_pairs) for p in image_pairs(keyframes, mission.plan.follows_floor))
    field = floor_of(planned_surface(mission))
    return PlannedOverlap(*(spread(image_overlap(field, *p, mission.rig)).median for p in pairs))


def forecast_over_floor(mission: Mission) -> FloorForecast:
    """Returns the forecast of a mission, from rays cast from the planned keyframes to floor and objects.

    Cameras look straight down; distortion, port, calibration errors and space below overhangs are neglected.
    """
    rig, surface = mission.rig, planned_surface(mission)
    field = floor_of(surface)
    keyframes = planned_keyframes(mission.plan, mission.scenario.plan.pattern)
    poses = keyframes.world_from_camera
    depth = cast_pixels(field, poses, rig, ray_grid(rig, RAY_COLUMNS))
    depth[np.isinf(depth)] = np.nan
    median, nearest = _row_statistic(np.nanmedian, depth), _row_statistic(np.nanmin, depth)
    x, y, z = keyframes.position_m.T
    along, across = image_pairs(keyframes, mission.plan.follows_floor)
    return FloorForecast(
        surface=surface,
        keyframes=keyframes,
        depth_m=depth,
        altitude_m=np.where(mission.chart.in_hole(x, y), np.nan, z - surface.height_at(x, y)),
        clearance_m=nearest,  # the optical axis is vertical
        footprint_m=median[:, None] * [rig.width_px / rig.fx_px, rig.height_px / rig.fy_px],
        gsd_m=median / rig.focal_px,
        stereo_share=image_overlap(field, poses, poses @ rig.left_from_right, rig),
        along_position_m=(along.first[:, :2, 3] + along.second[:, :2, 3]) / 2,
        across_position_m=(across.first[:, :2, 3] + across.second[:, :2, 3]) / 2,
        overlap_along=image_overlap(field, *along, rig),
        overlap_across=image_overlap(field, *across, rig),
        coverage=_coverage(mission, field, poses),
    )


def spread(values: Array) -> Spread:
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return Spread(None, None, None, None)
    return Spread(*(float(v) for v in np.percentile(known, [0, 5, 50, 100])))


def _row_statistic(statistic, values: Array) -> Array:
    result = np.full(len(values), np.nan)
    known = np.isfinite(values).any(axis=1)
    result[known] = statistic(values[known], axis=1)
    return result


def _coverage(mission: Mission, field: HeightField, poses: Array) -> float:
    grid = _grid_of_area(mission)
    seen = seen_over(grid, mission.rig, field, poses)
    x, y = np.meshgrid(*grid.centres())
    asked = mission.asked(x, y)
    return float(seen[asked].mean()) if asked.any() else 0.0


def _grid_of_area(mission: Mission) -> MapGrid:
    """Returns a grid over the asked area with cells as in the map, or at most _COVERAGE_CELLS along a side."""
    outline = mission.plan.area.outline()
    sides_m, middle = np.ptp(outline, axis=0), (outline.min(axis=0) + outline.max(axis=0)) / 2
    cell_m = max(mission.grid.cell_m, float(sides_m.max()) / _COVERAGE_CELLS)
    cols, rows = (max(1, round(side / cell_m)) for side in sides_m)
    return MapGrid(middle[0] - cols * cell_m / 2, middle[1] + rows * cell_m / 2, cell_m, rows, cols)
