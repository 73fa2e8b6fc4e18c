"""Readings that are older than the last frame, or that no node has: their motion to the time at which they are used."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.estimate.trajectory import PoseLog
from twin.estimate.vision.stereo import Keyframe
from twin.kernels import kernel

_NAMES = ("pressure_z_m", "ahrs_rpy_rad", "usbl_m")
_SAME_S = 1e-6  # difference up to which times count as equal
#: A reading is given to a node if the standard deviation of the motion in between is at most this share of its own: the
#: factor then has an eighth more than it is believed to have.
_MOST_ADDED = 0.5


def motion_since(log: PoseLog, time_s: float, end: int | None = None) -> tuple[Array, Array]:
    """Returns the motion (4, 4) from a time to the frame in row `end` of a non-empty log, and its covariance (6, 6)."""
    # the motion is uniform between frames; a time outside those of the frames counts as that of the nearest one
    times_s = log.times_s.array[: None if end is None else end + 1]
    time_s = float(np.clip(time_s, times_s[0], times_s[-1]))
    at = int(np.searchsorted(times_s, time_s - _SAME_S))  # the first frame that is not before the time
    steps, variances = log.steps.array[at + 1 : len(times_s)], log.variances.array[at + 1 : len(times_s)]
    if (ahead_s := float(times_s[at]) - time_s) > _SAME_S:
        share = ahead_s / float(times_s[at] - times_s[at - 1])
        steps = np.vstack([share * log.steps.array[at], steps])
        variances = np.vstack([share * log.variances.array[at], variances])
    return _accumulated(steps, variances)


@kernel
def _accumulated(steps, variances):
    motion, cov = np.eye(4), np.zeros((6, 6))
    for k in range(len(steps)):
        step = geometry.exp(steps[k])
        motion = geometry.compose(motion, step)
        cov = geometry.transport_covariance(cov, step) + np.diag(variances[k])
    return motion, cov


class ReadingsBetweenNodes:
    """Gives a node without a reading the last one before it, of pressure, AHRS or USBL, moved along the path."""

    def __init__(self, rig: StereoRig, noise: SensorNoise):
        self._body_from_camera = rig.body_from_camera
        self._sigmas = {
            "pressure_z_m": (3, noise.height_sigma_m), "usbl_m": (3, noise.usbl_m),
            "ahrs_rpy_rad": (0, float(noise.attitude_sigmas_rad.min())),
        }  # fmt: skip
        self._waiting: dict[str, tuple[float, Any]] = {}
        self._given: set[tuple[int, str]] = set()  # number of the node, name

    def keep(self, time_s: float, readings: Readings) -> None:
        """Keeps the readings of a time, later than that of the last ones of the same sensor."""
        for name in _NAMES:
            if (value := getattr(readings, name)) is not None:
                self._waiting[name] = time_s, value

    def give_to_nodes(self, nodes: Sequence[Keyframe], log: PoseLog) -> None:
        """Gives the kept readings to the first node that is not before them, unless it has its own."""
        for name, (time_s, value) in list(self._waiting.items()):
            k = bisect_left(nodes, time_s - _SAME_S, key=lambda node: log.times_s.array[node.row])
            if k == len(nodes):
                continue
            del self._waiting[name]
            node = nodes[k]
            if getattr(node.readings, name) is not None and (node.number, name) not in self._given:
                continue
            motion, cov = motion_since(log, time_s, node.row)
            first, sigma = self._sigmas[name]
            if np.diag(cov)[first : first + 3].max() <= (_MOST_ADDED * sigma) ** 2:
                moved = self._moved(name, value, node.world_from_camera, motion)
                node.readings = replace(node.readings, **{name: moved})
                self._given.add((node.number, name))

    def _moved(self, name: str, value: Any, world_from_camera: Array, motion: Array) -> Any:
        """Returns a reading taken before a motion (4, 4) as it would be after it, at a pose (4, 4)."""
        before = world_from_camera @ geometry.inverse(motion)
        if name == "ahrs_rpy_rad":
            to_body = self._body_from_camera[:3, :3]
            turned = geometry.rotation_from_rpy(*value) @ to_body @ motion[:3, :3] @ to_body.T
            return geometry.rpy_from_rotation(turned)
        moved_m = world_from_camera[:3, 3] - before[:3, 3]
        return value + (moved_m if name == "usbl_m" else float(moved_m[2]))
