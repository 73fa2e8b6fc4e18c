"""How far the elevation map is from the true floor, over the cells that a keyframe truly saw."""

from __future__ import annotations

import numpy as np

from twin.core.records import Array, ElevationMap, Truth
from twin.judge.summary_statistics import mean, number, percentile, rms

KEYS = ("cell_m", "completeness", "bias_m", "rmse_m", "nmad_m", "p85_m", "le90_m", "le95_m", "max_m", "sigma_ratio")


def height_error(elevation: ElevationMap, truth: Truth) -> Array:
    """(rows, cols) estimated minus true height [m]; NaN where not seen in truth or not estimated."""
    error = elevation.height_m.astype(float) - truth.height_m
    return np.where(truth.seen, error, np.nan)


def map_metrics(elevation: ElevationMap | None, truth: Truth) -> dict[str, float | None]:
    """`map.*` of metrics.json; all None without a map.

    NMAD is 1.4826 median |e - median e|; LE90 is the 90th percentile of |e| (linear error at 90 %, as DEM standards
    have it); sigma_ratio is the RMS of e / sigma: 1 where the map's own sigma tells the truth.
    """
    if elevation is None:
        return dict.fromkeys(KEYS)
    errors = height_error(elevation, truth)
    estimated = np.isfinite(errors)
    error, size = errors[estimated], np.abs(errors[estimated])
    return {
        "cell_m": number(elevation.grid.cell_m),
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
    """(n,) height error over its sigma, of the cells that have both."""
    error = height_error(elevation, truth)
    known = np.isfinite(error) & (elevation.sigma_m > 0)
    return error[known] / elevation.sigma_m[known]


def nmad(error: Array) -> float | None:
    """Normalised median absolute deviation: the standard deviation of a normal error, deaf to outliers."""
    return number(1.4826 * np.median(np.abs(error - np.median(error)))) if len(error) else None
