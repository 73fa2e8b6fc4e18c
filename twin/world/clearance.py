"""Points of a planned path, and its clearance at constant height or constant altitude above the floor."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter

from twin.controllers.forecast import Clearance, least_clearance
from twin.controllers.survey_plan import SurveyPlan
from twin.core.geometry import Array
from twin.terrains import Terrain


def path_points(plan: SurveyPlan) -> Array:
    """Returns the planned positions (n, 3) of the left camera at all frames, without station keeping [m]."""
    tracks = range(1, plan.n_tracks + 1)
    return np.concatenate([plan.references(t, plan.frames_of_track(t)[0]).position for t in tracks])


def planned_clearance(plan: SurveyPlan, terrain: Terrain) -> Clearance:
    """Returns the least clearance of the planned path: height of the camera above the highest floor in its footprint.

    For a path at constant height, the floor between the swaths is checked too, see `forecast.least_clearance`. For a
    path that follows the floor, the position in the result is that of the camera, not of the highest floor point.
    """
    if plan.surface is None:
        return least_clearance(plan, terrain.height_at)
    across_m, along_m = plan.footprint_m
    turned = plan.area.heading != 0 or plan.turns_on_the_spot
    footprint_m = (np.hypot(across_m, along_m),) * 2 if turned else (across_m, along_m)  # along y and x
    sides = [2 * round(side / 2 / terrain.spacing_m) + 1 for side in footprint_m]
    nearby = maximum_filter(terrain.height_m, sides, mode="nearest")
    x, y, z = path_points(plan).T
    inside = bool(np.isfinite(terrain.height_at(x, y)).all())
    cols = np.clip(np.rint((x - terrain.west_m) / terrain.spacing_m), 0, terrain.height_m.shape[1] - 1).astype(int)
    rows = np.clip(np.rint((y - terrain.south_m) / terrain.spacing_m), 0, terrain.height_m.shape[0] - 1).astype(int)
    gap = z - nearby[rows, cols]
    k = int(gap.argmin())
    return Clearance(float(gap[k]), float(x[k]), float(y[k]), inside)
