"""Height errors of the elevation map, over the cells that both cameras saw in a keyframe and over the asked area."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from twin.core.records import Array, ElevationMap, HeightVariances, Truth
from twin.judge.summary_statistics import finite_float, mean, percentile, rms

KEYS = (
    "cell_m", "completeness", "bias_m", "rmse_m", "nmad_m", "p85_m", "le90_m", "le95_m", "max_m", "sigma_ratio",
    "completeness_area", "le90_area_m", "median_m", "gross_share", "floor_median_m", "floor_le90_m",
    "floor_gross_share", "objects_median_m", "objects_le90_m", "objects_gross_share",
    "typical_rmse_m", "stereo_error_m", "pose_error_m", "relief_error_m", "calibration_error_m",
)  # fmt: skip
#: Causes of errors of heights in words, by their names in `HeightVariances`.
CAUSES = {
    "stereo": "noise of the stereo matching", "pose": "errors of the camera poses", "relief": "slopes and steps",
    "calibration": "errors of the calibration",
}  # fmt: skip
GROSS_M = 0.1  #: absolute height error above which a cell counts as a gross error
#: Metrics that are infinite, and therefore written as None, if the map has too many holes.
INFINITE_WITH_HOLES = ("map.le90_area_m",)


def height_error(elevation: ElevationMap, truth: Truth) -> Array:
    """Returns estimated minus true height (rows, cols) [m]; NaN in cells not observed, or without one of the two."""
    error = elevation.height_m.astype(float) - truth.height_m
    return np.where(truth.seen, error, np.nan)


def map_metrics(elevation: ElevationMap | None, truth: Truth) -> dict[str, float | None]:
    """Returns `map.*` of metrics.json; every value is None without a map.

    completeness is the fraction of observed cells that have an estimate. For height errors e, NMAD is 1.4826 median |e
    - median e|, and LE90 the 90th percentile of |e| (linear error at 90 %). sigma_ratio is the RMS of error / sigma, 1
    for correct standard deviations. completeness_area and le90_area_m are over the cells of the asked area, where a
    cell without an estimate (a hole) counts as an infinite error; an infinite percentile is None. median_m is the
    median of |e|, and gross_share the fraction of cells with |e| > 0.1 m. floor_* and objects_* are over the cells
    whose highest surface is the floor or an object; without objects, all cells are floor and objects_* are None.
    typical_rmse_m is over the 95 % most certain cells; stereo_error_m, pose_error_m, relief_error_m and
    calibration_error_m are the standard deviations of these cells by cause (`HeightVariances`), as the estimators state
    them. The root of the sum of their squares corresponds to typical_rmse_m.
    """
    if elevation is None:
        return dict.fromkeys(KEYS)
    asked = np.abs(elevation.height_m.astype(float) - truth.height_m)[truth.asked]
    errors = height_error(elevation, truth)
    estimated = np.isfinite(errors)
    error, size = errors[estimated], np.abs(errors[estimated])
    on_object = np.zeros(len(size), bool) if truth.objects is None else truth.objects[estimated] > 0
    return {
        "cell_m": finite_float(elevation.grid.cell_m),
        "completeness": mean(estimated[truth.seen]),
        "bias_m": mean(error),
        "rmse_m": rms(error),
        "nmad_m": nmad(error),
        "p85_m": percentile(size, 85),
        "le90_m": percentile(size, 90),
        "le95_m": percentile(size, 95),
        "max_m": percentile(size, 100),
        "sigma_ratio": rms(normalised_error(elevation, truth)),
        "completeness_area": mean(np.isfinite(asked)),
        "le90_area_m": percentile_with_holes(asked, 90),
        "median_m": percentile(size, 50),
        "gross_share": mean(size > GROSS_M),
        **_of_surface("floor", size[~on_object]),
        **_of_surface("objects", size[on_object]),
        "typical_rmse_m": rms(errors[estimated & elevation.typical]),
        **errors_by_cause(elevation),
    }


def errors_by_cause(elevation: ElevationMap) -> dict[str, float | None]:
    """Returns the stated standard deviations of the heights by their causes [m]."""
    return {
        f"{cause}_error_m": finite_float(variance**0.5) for cause, variance in elevation.variances._asdict().items()
    }


def cause_shares(heights: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Returns the stated error [m] by cause, the largest first, and its share of the sum of squares, of `map.*`."""
    stated = ((cause, heights.get(f"{cause}_error_m")) for cause in HeightVariances._fields)
    known = {cause: error_m for cause, error_m in stated if error_m}
    variance = sum(error_m**2 for error_m in known.values())
    return {cause: (known[cause], known[cause] ** 2 / variance) for cause in sorted(known, key=lambda k: -known[k])}


def _of_surface(name: str, size: Array) -> dict[str, float | None]:
    return {
        f"{name}_median_m": percentile(size, 50),
        f"{name}_le90_m": percentile(size, 90),
        f"{name}_gross_share": mean(size > GROSS_M),
    }


def completeness_metric(metric: str) -> str | None:
    """Returns the completeness metric to report with a statistic of the height errors; None for other metrics."""
    if not metric.startswith("map.") or metric.startswith("map.completeness") or metric == "map.cell_m":
        return None
    return "map.completeness_area" if "_area" in metric else "map.completeness"


def with_completeness(metrics: Iterable[str]) -> list[str]:
    """Returns names of metrics and those of the completeness metrics to report with them, each once."""
    return list(dict.fromkeys(name for metric in metrics for name in (metric, completeness_metric(metric)) if name))


def percentile_with_holes(size: Array, percent: float) -> float | None:
    """Returns a percentile of absolute errors (n,), linearly interpolated; NaN counts as infinite; None if infinite."""
    known = np.isfinite(size)
    if not known.any():
        return None
    # the upper of the two values between which the percentile lies must be finite: infinity cannot be interpolated
    if np.isinf(np.percentile(np.where(known, size, np.inf), percent, method="higher")):
        return None
    return percentile(np.where(known, size, size[known].max()), percent)


def normalised_error(elevation: ElevationMap, truth: Truth) -> Array:
    """Returns height error / sigma (n,) of the cells that have a height error and a positive sigma."""
    error = height_error(elevation, truth)
    known = np.isfinite(error) & (elevation.sigma_m > 0)
    return error[known] / elevation.sigma_m[known]


def nmad(error: Array) -> float | None:
    """Returns the normalised median absolute deviation of errors (n,) (Höhle & Höhle 2009); None if there are none."""
    return finite_float(1.4826 * np.median(np.abs(error - np.median(error)))) if len(error) else None
