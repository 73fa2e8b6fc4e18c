"""What the scenario demands of the survey."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from twin.errors import TwinError

#: Metrics of which more is better: their limit is a lower bound. All others are errors, times or sizes.
MORE_IS_BETTER = (
    "map.completeness",
    "timing.real_time_factor",
    "overlap.",
    "consistency.within_",
    "vision.points_",
    "vision.contrast_",
)


def judge_requirements(limits: Mapping[str, float], metrics: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """`require` of metrics.json: value, limit and verdict of each named metric; a metric without value has not passed.

    Raises:
        TwinError: a name is no number of metrics.json.
    """
    check_names(limits, metrics)
    return {name: _verdict(name, _find(metrics, name), limit) for name, limit in limits.items()}


def check_names(names: Iterable[str], metrics: Mapping[str, Any]) -> None:
    """Refuses names that are no number of `metrics` (dotted path), before a survey is flown in vain."""
    known = list(number_paths(metrics))
    for name in names:
        if name not in known:
            begun = [k for k in known if k.startswith(name)]
            near = (begun or difflib.get_close_matches(name, known, cutoff=0.5))[:3]
            hint = f", did you mean {' or '.join(near)}?" if near else ""
            raise TwinError(f"require.{name}", f"no such metric{hint}", "a dotted name of metrics.json")


def number_paths(metrics: Mapping[str, Any], prefix: str = "") -> Iterable[str]:
    """Dotted names of every number (or missing number) in the sections of metrics."""
    for key, value in metrics.items():
        if isinstance(value, Mapping):
            yield from number_paths(value, f"{prefix}{key}.")
        elif prefix and (value is None or isinstance(value, int | float)):
            yield prefix + key


def more_is_better(name: str) -> bool:
    return name.startswith(MORE_IS_BETTER)


def _find(metrics: Mapping[str, Any], name: str) -> float | None:
    value: Any = metrics
    for key in name.split("."):
        value = value[key]
    return value


def _verdict(name: str, value: float | None, limit: float) -> dict[str, Any]:
    met = value is not None and (value >= limit if more_is_better(name) else value <= limit)
    return {"value": value, "limit": limit, "passed": met}
