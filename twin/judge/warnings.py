"""Warnings that follow from the metrics of a survey: consistency, sigma calibration, images, readings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Bounds of the mean NEES of the positions: a survey is reported as inconsistent if its value is outside them and
#: outside the interval expected of consistent covariances (`consistency.nees_interval`). The expectation is 3.
NEES_BOUNDS = (2.0, 5.0)
#: Bounds of the sigma ratio (RMS of height error / sigma); outside them the sigmas of a map are reported as
#: miscalibrated. The expectation is 1.
SIGMA_RATIO_BOUNDS = (0.5, 2.0)
#: Saturated fraction of the pixel values (median over the images) above which the images are reported as saturated.
MOST_SATURATED = 0.01


def metric_warnings(metrics: Mapping[str, Any]) -> list[str]:
    """Returns a sentence for each metric that is out of its bounds: NEES, sigma ratio, saturation of the images.

    One more reports rejected readings of navigation sensors.
    """
    nees, sigma_ratio = metrics["consistency"]["nees_position_mean"], metrics["map"]["sigma_ratio"]
    low, high = nees_bounds(metrics["consistency"])
    least, most = SIGMA_RATIO_BOUNDS
    found = []
    if nees is not None and not low <= nees <= high:
        found.append(
            f"The position covariances are {_size(nees, high)}: the mean NEES is {nees:.3g}, where 3 is expected and "
            f"{low:.3g} to {high:.3g} accepted."
        )
    if sigma_ratio is not None and not least <= sigma_ratio <= most:
        found.append(
            f"The sigmas of the map are {_size(sigma_ratio, most)}: the RMS of error / sigma is {sigma_ratio:.3g}, "
            f"where 1 is expected and {least:g} to {most:g} accepted."
        )
    if (metrics["vision"]["saturated_median"] or 0.0) > MOST_SATURATED:
        share, limit = 100 * metrics["vision"]["saturated_median"], 100 * MOST_SATURATED
        found.append(
            f"The images are saturated: the median share of saturated values is {share:.3g} % (more than {limit:g} %)."
        )
    rejected = metrics["self_check"]["readings_rejected"].items()
    if texts := [f"{sensor} {count}" for sensor, count in rejected if count]:
        found.append(f"Readings that contradicted the estimates were not used: {', '.join(texts)}.")
    return found


def _size(value: float, most: float) -> str:
    """Returns the fault of covariances whose normalised errors are out of bounds."""
    return "too small" if value > most else "too large"


def nees_bounds(consistency: Mapping[str, Any]) -> tuple[float, float]:
    """Returns the smallest and largest accepted mean NEES of the positions, given `consistency` of metrics.json."""
    low, high = (consistency.get(f"nees_position_{end}") for end in ("low", "high"))
    if low is None or high is None:
        return NEES_BOUNDS
    return min(low, NEES_BOUNDS[0]), max(high, NEES_BOUNDS[1])
