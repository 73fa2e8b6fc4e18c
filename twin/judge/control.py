"""How well the vehicle flew its plan: true positions against the reference."""

from __future__ import annotations

import numpy as np

from twin.core.records import Array, Truth
from twin.judge.summary_statistics import rms
from twin.judge.swaths import travel_direction


def control_metrics(truth: Truth) -> dict[str, float | None]:
    """`control.*` of metrics.json: cross-track while flying, altitude always, distance in 3-D while holding station."""
    n = min(len(truth.trajectory), len(truth.reference))
    offset = truth.trajectory.positions[:n] - truth.reference[:n]
    holding = truth.holding[:n]
    return {
        "cross_track_rmse_m": rms(cross_track(offset, travel_direction(truth.reference[:n]))[~holding]),
        "altitude_rmse_m": rms(offset[:, 2]),
        "station_keeping_rmse_m": rms(np.linalg.norm(offset[holding], axis=1)),
    }


def cross_track(offset: Array, direction: Array) -> Array:
    """(n,) part of offsets (n, 3) horizontally across the direction of travel (n, 2), positive to port [m]."""
    return direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]
