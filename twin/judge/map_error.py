"""Height errors of the elevation map, over the cells that at least one keyframe observed."""

from __future__ import annotations

import numpy as np

from twin.core.records import Array, ElevationMap, Truth
from twin.judge.summary_statistics import finite_float, mean, percentile, rms

KEYS = ("cell_m", "completeness", "bias_m", "rmse_m", "nmad_m", "p85_m", "le90_m", "le95_m", "max_m", "sigma_ratio")


def height_error(elevation: ElevationMap, truth: Truth) -> Array:
    """Returns estimated minus true height (rows, cols) [m]; NaN where the cell was not observed or not estimated."""
    error = elevation.height_m.astype(float) - truth.height_m
    return np.where(truth.seen, error, np.nan)


def map_metrics(elevation: ElevationMap | None, truth: Truth) -> dict[str, float | None]:
    """Returns `map.*` of metrics.json; every value is None without a map.

    completeness is the fraction of observed cells that have an estimate. For height errors e, NMAD is
    1.4826 median |e - median e|, and LE90 is the 90th percentile of |e| (linear error at 90 %). sigma_ratio is the
    sigma calibration: the RMS of error / sigma, which is 1 if the estimated standard deviations are correct.
    """
    if elevation is None:
        return dict.fromkeys(KEYS)
    errors = height_error(elevation, truth)
    estimated = np.isfinite(errors)
    error, size = errors[estimated], np.abs(errors[estimated])
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
    }


def normalised_error(elevation: ElevationMap, truth: Truth) -> Array:
    """Returns height error / sigma (n,) of the cells that have a height error and a positive sigma."""
    error = height_error(elevation, truth)
    known = np.isfinite(error) & (elevation.sigma_m > 0)
    return error[known] / elevation.sigma_m[known]


def nmad(error: Array) -> float | None:
    """Returns the normalised median absolute deviation of errors (n,); None if there are none.

    It estimates the standard deviation of normal errors and is robust against outliers (Höhle & Höhle 2009).
    """
    return finite_float(1.4826 * np.median(np.abs(error - np.median(error)))) if len(error) else None
