"""Slopes of a map of heights."""

from __future__ import annotations

import numpy as np

from twin.core.geometry import Array


def map_slopes(height_m: Array, cell_m: float) -> tuple[Array, Array]:
    """Returns the slopes of a map towards the east and towards the north, each (rows, cols), by central differences.

    At the edges of the map, the differences are one-sided. Along an axis with a single cell, the slope is 0.

    Args:
        height_m: (rows, cols) heights; row 0 is the northernmost, column 0 the westernmost.
    """
    south, east = (
        np.gradient(height_m, cell_m, axis=axis) if height_m.shape[axis] > 1 else np.zeros_like(height_m)
        for axis in (0, 1)
    )
    return np.asarray(east, np.float64), -np.asarray(south, np.float64)
