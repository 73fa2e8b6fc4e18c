"""The flown path against the reference path: direction of travel, swaths (legs or loops), control errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Truth
from twin.judge.summary_statistics import rms

#: A frame belongs to a leg if |cos| of the angle between its direction of travel and the axis of the legs exceeds
#: this value (angle below 26 deg).
ON_LEG_COSINE = 0.9
#: Change of the planned heading between two frames above which they belong to a turn [rad].
TURNING_STEP = 1e-9


def travel_direction(reference: Array) -> Array:
    """Returns horizontal unit vectors of travel (n, 2) along reference positions (n, 3).

    The direction at a position is that of the step to the next position. Where this step has no horizontal length, the
    direction is that of the last step before it that has one, or else of the first step that has one; [1, 0] if no step
    has one.
    """
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
    """Returns the number (n,) of the leg or loop of each frame, from 0; -1 for frames between legs and during turns.

    With the pattern "loops", each frame belongs to the loop of its track; otherwise the path consists of legs.
    """
    if pattern == "loops":
        return truth.track - 1
    numbers = leg_numbers(truth.reference)
    return numbers if truth.reference_yaw is None else np.where(is_turning(truth.reference_yaw), -1, numbers)


def is_turning(yaw: Array) -> NDArray[np.bool_]:
    """Returns a mask (n,) of the frames whose planned heading [rad] differs from the previous or the next one."""
    steps = np.abs(np.diff(yaw)) > TURNING_STEP
    turning = np.zeros(len(yaw), np.bool_)
    turning[1:] |= steps
    turning[:-1] |= steps
    return turning


def leg_numbers(reference: Array) -> NDArray[np.int64]:
    """Returns the number (n,) of the leg of each frame, from 0; -1 on the short segments between legs.

    The axis of the legs is the principal axis of the steps between the reference positions (n, 3). A leg ends where the
    direction of travel reverses or a short segment begins.
    """
    direction = travel_direction(reference)
    steps = np.diff(reference[:, :2], axis=0, prepend=reference[:1, :2])
    axis = np.linalg.eigh(steps.T @ steps)[1][:, -1]
    cosine = direction @ axis
    on_leg = np.where(np.abs(cosine) > ON_LEG_COSINE, np.sign(cosine), 0.0)
    starts = (on_leg != 0) & (np.diff(on_leg, prepend=0.0) != 0)
    return np.where(on_leg != 0, np.cumsum(starts) - 1, -1).astype(np.int64)


def control_metrics(truth: Truth) -> dict[str, float | None]:
    """Returns `control.*` of metrics.json, without slowed_s and held_s, the durations of the mission's actions [s].

    The cross-track error (horizontal, across the direction of travel) is computed over the frames in which the vehicle
    travels, the altitude error over all frames, and the station-keeping error (3-D distance) over the frames in which
    the vehicle keeps station.
    """
    n = min(len(truth.trajectory), len(truth.reference))
    offset = truth.trajectory.positions[:n] - truth.reference[:n]
    holding, direction = truth.holding[:n], travel_direction(truth.reference[:n])
    across = direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]
    return {
        "cross_track_rmse_m": rms(across[~holding]),
        "altitude_rmse_m": rms(offset[:, 2]),
        "station_keeping_rmse_m": rms(np.linalg.norm(offset[holding], axis=1)),
    }
