"""Requirements of a scenario: limits of metrics, and whether a survey meets each limit."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from twin.errors import TwinError

#: Prefixes of metrics whose limit is a lower bound. The limit of every other metric is an upper bound.
MORE_IS_BETTER = (
    "map.completeness", "timing.real_time_factor", "overlap.", "consistency.within_", "vision.points_",
    "vision.contrast_", "orthomosaic.coverage_", "orthomosaic.matched",
)  # fmt: skip

#: Metrics that can be negative, for which the ratio of two values has no meaning.
SIGNED = (
    "map.bias_m", "orthomosaic.bias_east_m", "orthomosaic.bias_north_m", "self_check.disparity_offset",
    "self_check.pitch_deg", "self_check.roll_deg", "self_check.row_offset_px", "self_check.row_shift",
    "self_check.yaw_deg",
)  # fmt: skip


def judge_requirements(limits: Mapping[str, float], metrics: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Returns `require` of metrics.json: value, limit and verdict of each required metric.

    A metric whose value is None fails.

    Raises:
        TwinError: a name does not refer to a number in metrics.json.
    """
    check_metric_names(limits, metrics)
    values = numbers_of(metrics)
    return {
        name: {"value": values[name], "limit": limit, "passed": meets_limit(name, values[name], limit)}
        for name, limit in limits.items()
    }


def check_metric_names(names: Iterable[str], metrics: Mapping[str, Any]) -> None:
    """Checks that every name is the dotted path of a number in `metrics`.

    Raises:
        TwinError: a name is not such a path; the message suggests similar names.
    """
    known = list(numbers_of(metrics))
    for name in names:
        if name not in known:
            completions = [k for k in known if k.startswith(name)]
            similar = (completions or difflib.get_close_matches(name, known, cutoff=0.5))[:3]
            hint = f", did you mean {' or '.join(similar)}?" if similar else ""
            raise TwinError(f"require.{name}", f"no such metric{hint}", "a dotted name of metrics.json")


def numbers_of(metrics: Mapping[str, Any], prefix: str = "") -> dict[str, float | None]:
    """Returns each number and None in nested tables of `metrics` by its dotted path, but not those at its top level."""
    found: dict[str, float | None] = {}
    for key, value in metrics.items():
        if isinstance(value, Mapping):
            found |= numbers_of(value, f"{prefix}{key}.")
        elif prefix and (value is None or isinstance(value, int | float)):
            found[prefix + key] = value
    return found


def more_is_better(name: str) -> bool:
    """Returns whether larger values of a metric are better; its limit is then a lower bound."""
    return name.startswith(MORE_IS_BETTER)


def meets_limit(name: str, value: float | None, limit: float) -> bool:
    """Returns whether the value of a metric meets its limit; None does not."""
    return value is not None and (value >= limit if more_is_better(name) else value <= limit)
