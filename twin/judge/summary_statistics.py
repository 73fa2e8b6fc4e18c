"""Summary statistics for metrics.json: finite numbers, or None if there are no values."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def finite_float(value: Any) -> float | None:
    """Returns the value as a float; None if it is missing or not finite (JSON has no NaN)."""
    return None if value is None or not np.isfinite(value) else float(value)


def _statistic(values: ArrayLike, function: Callable[[Any], Any]) -> float | None:
    """Returns a function of all values; None if there are none or if the result is not finite."""
    array = np.asarray(values, dtype=float)
    return finite_float(function(array)) if array.size else None


def rms(values: ArrayLike) -> float | None:
    return _statistic(values, lambda array: np.sqrt(np.mean(array**2)))


def mean(values: ArrayLike) -> float | None:
    return _statistic(values, np.mean)


def percentile(values: ArrayLike, percent: float) -> float | None:
    """Returns a percentile (0 to 100) of all values, linearly interpolated; None as for `mean`."""
    return _statistic(values, lambda array: np.percentile(array, percent))


def finite_tree(tree: Any) -> Any:
    """Returns nested dicts and lists with numpy scalars converted to Python numbers and non-finite numbers to None."""
    if isinstance(tree, dict):
        return {key: finite_tree(value) for key, value in tree.items()}
    if isinstance(tree, str | bytes) or not isinstance(tree, Iterable):
        scalar = tree.item() if isinstance(tree, np.generic) else tree
        return finite_float(scalar) if isinstance(scalar, float) else scalar
    return [finite_tree(value) for value in tree]
