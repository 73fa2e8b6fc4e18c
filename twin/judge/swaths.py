"""The reference path: its direction of travel, its swaths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Truth

#: A frame is on a leg while the reference travels within this cosine of the legs' axis (26 degrees).
ON_LEG_COSINE = 0.9


def travel_direction(reference: Array) -> Array:
    """(n, 2) horizontal unit vector of travel along (n, 3) reference positions; kept while it stands still."""
    n = len(reference)
    if n == 0:
        return np.zeros((0, 2))
    step = np.diff(reference[:, :2], axis=0, append=reference[-1:, :2])
    length = np.linalg.norm(step, axis=1)
    moving = np.flatnonzero(length > 1e-9)
    if len(moving) == 0:
        return np.tile([1.0, 0.0], (n, 1))
    last_moving = np.maximum(np.searchsorted(moving, np.arange(n), side="right") - 1, 0)
    row = moving[last_moving]
    return step[row] / length[row, None]


def swath_numbers(truth: Truth, pattern: str) -> NDArray[np.int64]:
    """(n,) number of the leg or loop, from 0, that each frame of the reference is on; -1 between legs."""
    return truth.track - 1 if pattern == "loops" else leg_numbers(truth.reference)


def leg_numbers(reference: Array) -> NDArray[np.int64]:
    """(n,) number of the leg, from 0, that each frame of the reference is on; -1 on the short segments between.

    Legs run along the axis that the reference mostly travels; a turn or a short segment ends one.
    """
    direction = travel_direction(reference)
    steps = np.diff(reference[:, :2], axis=0, prepend=reference[:1, :2])
    axis = np.linalg.eigh(steps.T @ steps)[1][:, -1]
    cosine = direction @ axis
    on_leg = np.where(np.abs(cosine) > ON_LEG_COSINE, np.sign(cosine), 0.0)
    starts = (on_leg != 0) & (np.diff(on_leg, prepend=0.0) != 0)
    return np.where(on_leg != 0, np.cumsum(starts) - 1, -1).astype(np.int64)
