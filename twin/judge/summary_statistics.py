"""Figures for metrics.json: finite numbers, or None where there is nothing to judge."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def number(value: Any) -> float | None:
    """The value as a float; None where it is missing or not finite (JSON knows no NaN)."""
    return None if value is None or not np.isfinite(value) else float(value)


def rms(values: ArrayLike) -> float | None:
    """Root of the mean square over all values; None of none."""
    array = np.asarray(values, dtype=float)
    return number(np.sqrt(np.mean(array**2))) if array.size else None


def mean(values: ArrayLike) -> float | None:
    """The mean; None of none."""
    array = np.asarray(values, dtype=float)
    return number(array.mean()) if array.size else None


def percentile(values: ArrayLike, share: float) -> float | None:
    """The value that `share` percent do not exceed, interpolated linearly; None of none."""
    array = np.asarray(values, dtype=float)
    return number(np.percentile(array, share)) if array.size else None


def finite_tree(tree: Any) -> Any:
    """The same nested dicts and lists with numpy scalars made plain and non-finite numbers made None."""
    if isinstance(tree, dict):
        return {key: finite_tree(value) for key, value in tree.items()}
    if isinstance(tree, str | bytes) or not isinstance(tree, Iterable):
        plain = tree.item() if isinstance(tree, np.generic) else tree
        return number(plain) if isinstance(plain, float) else plain
    return [finite_tree(value) for value in tree]
