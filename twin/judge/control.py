"""Control errors: differences between the true positions of the left camera and the reference path."""

from __future__ import annotations

import numpy as np

from twin.core.records import Array, Truth
from twin.judge.summary_statistics import rms
from twin.judge.swaths import travel_direction


def control_metrics(truth: Truth) -> dict[str, float | None]:
    """Returns `control.*` of metrics.json, without slowed_s and held_s, the durations of the mission's actions [s].

    The cross-track error is computed over the frames in which the vehicle travels, the altitude error over all frames,
    and the station-keeping error (3-D distance) over the frames in which the vehicle keeps station.
    """
    n = min(len(truth.trajectory), len(truth.reference))
    offset = truth.trajectory.positions[:n] - truth.reference[:n]
    holding = truth.holding[:n]
    return {
        "cross_track_rmse_m": rms(cross_track(offset, travel_direction(truth.reference[:n]))[~holding]),
        "altitude_rmse_m": rms(offset[:, 2]),
        "station_keeping_rmse_m": rms(np.linalg.norm(offset[holding], axis=1)),
    }


def cross_track(offset: Array, direction: Array) -> Array:
    """Returns the cross-track component (n,) of offsets [m]: horizontal, positive to port of the direction of travel.

    Args:
        offset: (n, 3) position minus reference [m].
        direction: (n, 2) horizontal unit vectors of travel.
    """
    return direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]
