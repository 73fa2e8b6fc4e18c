"""Absolute trajectory errors of estimates that are anchored at the first true pose, without a fitted transform."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.records import Array, Trajectory
from twin.judge.summary_statistics import finite_float, rms


class PathErrors(NamedTuple):
    """Errors of an estimated trajectory at n frames, estimate minus truth.

    Args:
        travelled_m: (n,) length of the true path since the first of these frames [m].
        position_m: (n, 3) position error in the world [m].
        heading_rad: (n,) heading error, wrapped to [-pi, pi) [rad].
    """

    travelled_m: Array
    position_m: Array
    heading_rad: Array

    @property
    def distance_m(self) -> Array:
        """Returns the norm (n,) of the position error [m]."""
        return np.linalg.norm(self.position_m, axis=1)


def anchor(first_estimated: Array, first_true: Array) -> Array:
    """Returns true_from_estimated (4, 4), the transform that maps the first estimated pose to the first true pose."""
    return first_true @ geometry.inverse(first_estimated)


def path_errors(estimate: Trajectory, truth: Trajectory) -> PathErrors:
    """Returns the errors at the frames of both trajectories, with the estimate anchored at the first true pose.

    If the trajectories differ in length, the frames at the end of the longer one are left out.
    """
    n = min(len(estimate), len(truth))
    true = truth.world_from_camera[:n]
    if n == 0:
        return PathErrors(np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    anchored = anchor(estimate.world_from_camera[0], true[0]) @ estimate.world_from_camera[:n]
    heading = geometry.heading_of_camera(anchored) - geometry.heading_of_camera(true)
    position = anchored[:, :3, 3] - true[:, :3, 3]
    return PathErrors(cumulative_length(true[:, :3, 3]), position, geometry.wrap_angle(heading))


def cumulative_length(positions: Array) -> Array:
    """Returns the length (n,) of the path from the first position to each of the positions (n, 3) [m]."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])[: len(positions)]


def trajectory_metrics(errors: PathErrors) -> dict[str, float | None]:
    """Returns `trajectory.*` of metrics.json; the drift is the end error in percent of the true path length."""
    distance = errors.distance_m
    end, path = (float(distance[-1]), float(errors.travelled_m[-1])) if len(distance) else (None, None)
    x, y, z = errors.position_m.T
    heading = rms(np.rad2deg(errors.heading_rad))
    return {
        "ate_rmse_m": rms(distance),
        "ate_max_m": finite_float(distance.max()) if len(distance) else None,
        "x_rmse_m": rms(x),
        "y_rmse_m": rms(y),
        "z_rmse_m": rms(z),
        "heading_rmse_deg": heading,
        "end_error_m": finite_float(end),
        "drift_percent": 100 * end / path if path and end is not None else None,
        "path_m": finite_float(path),
    }
