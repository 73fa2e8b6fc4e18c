"""Figures of a survey that are not in metrics.json: coverage by keyframes, area, height, pixel size, error classes."""

from typing import NamedTuple

import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray

from twin.core.height_field import map_slopes
from twin.core.image_coverage import image_coverage
from twin.core.records import Array, MapGrid, StereoRig
from twin.judge.height_classes import ErrorClass, error_classes
from twin.report.run_folder import Run

#: Longest side of the coverage [cells]; of larger maps every n-th cell is taken.
_CELLS = 250
_SLOPES_DEG = (0.0, 10.0, 20.0, 40.0, 90.0)
_KEYFRAMES = (1, 2, 3, 6, 10, np.inf)


class KeyframeCoverage(NamedTuple):
    """Coverage of every n-th row and column of a map by stereo pairs, without occlusions."""

    grid: MapGrid  # cells that are n times as large as those of the map
    step: int  # n
    keyframes: NDArray[np.int64]  # (rows, cols) number of keyframes both of whose images show the cell
    range_m: Array  # (rows, cols) mean height of these keyframes above the cell [m]; NaN without one


def keyframe_coverage(run: Run) -> KeyframeCoverage | None:
    """Returns the coverage of the map of a run; None without map, final poses or rig."""
    given, dem = run.scenario.get("rig", {}), run.rasters.get("dem")
    if dem is None or not np.isfinite(dem.values).any() or "final" not in run.trajectories or "hfov_deg" not in given:
        return None
    width_px, tangent = given["image_width_px"], np.tan(np.deg2rad(given["hfov_deg"]) / 2)
    rig = StereoRig(width_px, given["image_height_px"], float(width_px / 2 / tangent), given["baseline_m"])
    poses = run.trajectories["final"].world_from_camera
    step = -(-max(dem.values.shape) // _CELLS)
    heights = dem.values[::step, ::step].astype(float)
    heights = np.where(np.isfinite(heights), heights, np.nanmedian(heights))
    x, y = (centres[::step] for centres in dem.grid.centres())
    points = np.stack([*np.meshgrid(x, y), heights], axis=-1).reshape(-1, 3)
    keyframes = run.keyframes.map_from_world @ poses[run.keyframes.frames[run.keyframes.frames < len(poses)]]
    found = image_coverage(points, keyframes, rig, rig.baseline_m)
    grid = MapGrid(dem.grid.west_m, dem.grid.north_m, step * dem.grid.cell_m, *heights.shape)
    return KeyframeCoverage(grid, step, found.n_images.reshape(heights.shape), found.height_m.reshape(heights.shape))


class SurveyData(NamedTuple):
    """Figures of a survey over its asked area, or over the map if this is not known."""

    asked: str  # the asked area in words, e.g. "4 m x 1.6 m"; "" if not known
    height_m: float  # mean height of the cameras above the surface
    height_low_m: float  # 5th percentile
    height_high_m: float  # 95th percentile
    pixel_m: float  # side of a pixel on the surface at the mean height (ground sample distance)
    swath_m: float  # width of an image there
    covered: dict[int, float]  # share of the area that at least so many keyframes show


def survey_data(run: Run, coverage: KeyframeCoverage | None) -> SurveyData | None:
    """Returns the figures of a survey; None without a map that a keyframe shows."""
    if coverage is None:
        return None
    inside = inside_rings(run, coverage)
    heights = coverage.range_m[inside & np.isfinite(coverage.range_m)]
    if not len(heights):
        return None
    height_m, (low_m, high_m) = float(heights.mean()), np.percentile(heights, [5, 95]).tolist()
    swath_m = 2 * height_m * float(np.tan(np.deg2rad(run.scenario["rig"]["hfov_deg"]) / 2))
    pixel_m = swath_m / run.scenario["rig"]["image_width_px"]
    covered = {n: float((coverage.keyframes[inside] >= n).mean()) for n in (1, 2, 5, 10)}
    return SurveyData(asked_area(run), height_m, low_m, high_m, pixel_m, swath_m, covered)


def asked_area(run: Run) -> str:
    plan, asked_m2 = run.scenario.get("plan", {}), run.keyframes.asked_m2
    if asked_m2 is None:
        return ""
    sides_m = plan["area_m"] if plan.get("polygon") is None and plan.get("pattern") == "lawnmower" else [0.0]
    if np.isclose(np.prod(sides_m), asked_m2, rtol=0.05):  # not if `plan.tracks` cover only a part of it
        return " x ".join(f"{side:g} m" for side in sides_m)
    return f"{asked_m2:.3g} square metres"


def inside_rings(run: Run, coverage: KeyframeCoverage) -> NDArray[np.bool_]:
    """Returns whether each cell (rows, cols) lies in the asked area; all do if it is not known."""
    points = np.stack(np.meshgrid(*coverage.grid.centres()), axis=-1)
    inside = np.zeros(points.shape[:2], bool)
    for ring in run.keyframes.asked_area_m:
        inside ^= Path(ring).contains_points(points.reshape(-1, 2)).reshape(inside.shape)
    return inside if inside.any() else np.ones_like(inside)


def errors_by_class(run: Run, coverage: KeyframeCoverage | None) -> dict[str, list[ErrorClass]]:
    """Returns the height errors by slope [deg], height of the cameras [m] (quarters) and number of keyframes."""
    layers = [run.rasters[key] for key in ("dem_error", "dem_sigma", "dem_truth") if key in run.rasters]
    if coverage is None or len(layers) < 3 or any(layer.grid != run.rasters["dem"].grid for layer in layers):
        return {}
    error, sigma, truth = (layer.values.astype(float) for layer in layers)
    rows, cols = (np.arange(n) // coverage.step for n in error.shape)
    range_m, keyframes = (layer[np.ix_(rows, cols)] for layer in (coverage.range_m, coverage.keyframes))
    known = range_m[np.isfinite(range_m) & np.isfinite(error)]
    quarters = [*np.quantile(known, [0.0, 0.25, 0.5, 0.75]), np.inf] if len(known) else []
    by = {
        "slope": (np.rad2deg(np.arctan(np.hypot(*map_slopes(truth, layers[0].grid.cell_m)))), _SLOPES_DEG),
        "height": (range_m, quarters),
        "keyframes": (keyframes, _KEYFRAMES),
    }
    return {name: error_classes(error, sigma, *given) for name, given in by.items()}
