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
    found = (
        _out_of_bounds(
            metrics["consistency"]["nees_position_mean"], nees_bounds(metrics["consistency"]),
            "The position covariances are {}: the mean NEES is {:.3g}, where 3 is expected and {:.3g} to {:.3g} "
            "accepted.",
        ),
        _out_of_bounds(
            metrics["map"]["sigma_ratio"], SIGMA_RATIO_BOUNDS,
            "The sigmas of the map are {}: the RMS of error / sigma is {:.3g}, where 1 is expected and "
            "{:g} to {:g} accepted.",
        ),
        _saturation(metrics["vision"]["saturated_median"]),
        _rejected(metrics["self_check"]["readings_rejected"]),
    )  # fmt: skip
    return [sentence for sentence in found if sentence]


def nees_bounds(consistency: Mapping[str, Any]) -> tuple[float, float]:
    """Returns the smallest and largest accepted mean NEES of the positions, given `consistency` of metrics.json."""
    low, high = (consistency.get(f"nees_position_{end}") for end in ("low", "high"))
    if low is None or high is None:
        return NEES_BOUNDS
    return min(low, NEES_BOUNDS[0]), max(high, NEES_BOUNDS[1])


def _out_of_bounds(value: float | None, bounds: tuple[float, float], sentence: str) -> str:
    """Returns the sentence with "too small" or "too large", the value and the bounds; "" for a value within bounds."""
    if value is None or bounds[0] <= value <= bounds[1]:
        return ""
    return sentence.format("too small" if value > bounds[1] else "too large", value, *bounds)


def _saturation(fraction: float | None) -> str:
    """Returns a warning if the median saturated fraction exceeds `MOST_SATURATED`, else ""."""
    if fraction is None or fraction <= MOST_SATURATED:
        return ""
    share, limit = 100 * fraction, 100 * MOST_SATURATED
    return f"The images are saturated: the median share of saturated values is {share:.3g} % (more than {limit:g} %)."


def _rejected(counts: Mapping[str, int]) -> str:
    """Returns a warning with the number of rejected readings of each sensor that had any, else ""."""
    found = ", ".join(f"{sensor} {count}" for sensor, count in counts.items() if count)
    return f"Readings that contradicted the estimates were not used: {found}." if found else ""
