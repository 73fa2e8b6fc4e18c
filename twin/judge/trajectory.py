"""How far a trajectory is from the truth, anchored only at the first true pose: nothing is fitted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.records import Array, Trajectory
from twin.judge.summary_statistics import number, rms


class PathErrors(NamedTuple):
    """Estimate minus truth at every frame.

    Args:
        travelled_m: (n,) true path since the first frame [m].
        position_m: (n, 3) in the world [m].
        heading_rad: (n,) wrapped to [-pi, pi) [rad].
    """

    travelled_m: Array
    position_m: Array
    heading_rad: Array

    @property
    def distance_m(self) -> Array:
        """(n,) length of the position error [m]."""
        return np.linalg.norm(self.position_m, axis=1)


def anchor(first_estimated: Array, first_true: Array) -> Array:
    """true_from_estimated (4, 4): carries the estimate's world into the true one by the first pose alone."""
    return first_true @ geometry.inverse(first_estimated)


def path_errors(estimate: Trajectory, truth: Trajectory) -> PathErrors:
    """Errors of the frames that both have, after anchoring at the first pose."""
    n = min(len(estimate), len(truth))
    true = truth.world_from_camera[:n]
    if n == 0:
        return PathErrors(np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    moved = anchor(estimate.world_from_camera[0], true[0]) @ estimate.world_from_camera[:n]
    heading = geometry.heading_of_camera(moved) - geometry.heading_of_camera(true)
    return PathErrors(travelled(true[:, :3, 3]), moved[:, :3, 3] - true[:, :3, 3], geometry.wrap_angle(heading))


def travelled(positions: Array) -> Array:
    """Length of the path up to each of (n, 3) positions, starting at 0 [m]."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])[: len(positions)]


def trajectory_metrics(errors: PathErrors) -> dict[str, float | None]:
    """`trajectory.*` of metrics.json; drift is the end error over the true path [%]."""
    distance = errors.distance_m
    end, path = (float(distance[-1]), float(errors.travelled_m[-1])) if len(distance) else (None, None)
    x, y, z = errors.position_m.T
    heading = rms(np.rad2deg(errors.heading_rad))
    return {
        "ate_rmse_m": rms(distance),
        "ate_max_m": number(distance.max()) if len(distance) else None,
        "x_rmse_m": rms(x),
        "y_rmse_m": rms(y),
        "z_rmse_m": rms(z),
        "heading_rmse_deg": heading,
        "end_error_m": number(end),
        "drift_percent": 100 * end / path if path and end is not None else None,
        "path_m": number(path),
    }
