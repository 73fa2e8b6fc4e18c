"""Verdict on the metrics of a survey: requirements of its scenario, and warnings of values that are out of bounds."""

import difflib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from twin.errors import TwinError

#: Prefixes of metrics whose limit is a lower bound. The limit of every other metric is an upper bound.
MORE_IS_BETTER = (
    "map.completeness", "timing.real_time_factor", "overlap.", "consistency.within_", "vision.points_",
    "vision.contrast_", "orthomosaic.coverage_", "orthomosaic.matched", "control.least_height_m", "water.",
    "links.along.count", "links.across.count",
)  # fmt: skip

#: Metrics that can be negative: their limit is one of the absolute value; the ratio of two values has no meaning.
SIGNED = (
    "map.bias_m", "orthomosaic.bias_east_m", "orthomosaic.bias_north_m", "self_check.disparity_offset",
    "self_check.pitch_deg", "self_check.roll_deg", "self_check.row_offset_px", "self_check.row_shift",
    "self_check.yaw_deg", "self_check.calibration.yaw_deg", "self_check.calibration.baseline_error",
)  # fmt: skip

#: Bounds of the mean NEES of the positions: a survey is reported as inconsistent if its value is outside them and
#: outside the interval expected of consistent covariances (`consistency.nees_interval`). The expectation is 3.
NEES_BOUNDS = (2.0, 5.0)
#: Bounds of the sigma ratio (RMS of height error / sigma); outside them the sigmas of a map are reported as
#: miscalibrated. The expectation is 1.
SIGMA_RATIO_BOUNDS = (0.5, 2.0)
#: Saturated fraction of the pixel values (median over the images) above which the images are reported as saturated.
MOST_SATURATED = 0.01


def judge_requirements(limits: Mapping[str, float], metrics: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Returns `require` of metrics.json: value, limit, verdict (None fails); raises TwinError for an unknown name."""
    check_metric_names(limits, metrics)
    values = numbers_of(metrics)
    return {
        name: {"value": values[name], "limit": limit, "passed": meets_limit(name, values[name], limit)}
        for name, limit in limits.items()
    }


def check_metric_names(names: Iterable[str], metrics: Mapping[str, Any]) -> None:
    """Raises TwinError, with similar names, if a name is not the dotted path of a number in `metrics`."""
    known = list(numbers_of(metrics))
    for name in names:
        if name not in known:
            completions = [k for k in known if k.startswith(name)]
            similar = (completions or difflib.get_close_matches(name, known, cutoff=0.5))[:3]
            hint = f", did you mean {' or '.join(similar)}?" if similar else ""
            raise TwinError(f"require.{name}", f"no such metric{hint}", "a dotted name of metrics.json")


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the dotted keys and the values of nested tables; a list is one value."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def numbers_of(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    """Returns each number and None in nested tables of `metrics` by its dotted path, but not those at its top level."""
    numbers = {name: value for name, value in leaves(metrics) if value is None or isinstance(value, int | float)}
    return {name: value for name, value in numbers.items() if "." in name}


def more_is_better(name: str) -> bool:
    """Returns whether larger values of a metric are better; its limit is then a lower bound."""
    return name.startswith(MORE_IS_BETTER)


def meets_limit(name: str, value: float | None, limit: float) -> bool:
    if value is None or more_is_better(name):
        return value is not None and value >= limit
    return (abs(value) if name in SIGNED else value) <= limit


def metric_warnings(metrics: Mapping[str, Any]) -> list[str]:
    """Returns sentences on metrics that are out of bounds (NEES, sigma ratio, saturation) and on rejected readings."""
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
    return "too small" if value > most else "too large"


def nees_bounds(consistency: Mapping[str, Any]) -> tuple[float, float]:
    """Returns the smallest and largest accepted mean NEES of the positions, given `consistency` of metrics.json."""
    low, high = (consistency.get(f"nees_position_{end}") for end in ("low", "high"))
    if low is None or high is None:
        return NEES_BOUNDS
    return min(low, NEES_BOUNDS[0]), max(high, NEES_BOUNDS[1])
