"""Frames whose motion was predicted, not measured: their poses between the measured frames before and after them."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.estimate.alignment import align
from twin.estimate.vision.stereo import Keyframe

_EXACT = np.eye(6) * 1e-10  # covariance of a measured frame: negligible next to that of a predicted motion
_LEAST_VARIANCE = 1e-12  # of a motion along any direction [rad^2, m^2]


class BlindFrame(NamedTuple):
    """A frame without a measured motion."""

    row: int
    motion: Array  #: (4, 4) motion since the previous frame: predicted, and fused with the DVL
    cov: Array  #: (6, 6) its covariance
    readings: Readings
    guessed: bool  #: whether the motion follows from the last measured velocity alone, without DVL and IMU


def blind_frame(
    row: int, before: tuple[Array, Array], after: tuple[Array, Array], readings: Readings, guessed: bool
) -> BlindFrame:
    """Returns a blind frame from the motion since the last node and its covariance, before and after it."""
    motion = geometry.inverse(before[0]) @ after[0]
    values, axes = np.linalg.eigh(after[1] - geometry.transport_covariance(before[1], motion))
    cov = axes * np.asarray(np.maximum(values, _LEAST_VARIANCE), np.float64) @ axes.T
    return BlindFrame(row, motion, cov, readings, guessed)


def aligned(
    path: Array, blind: Sequence[BlindFrame], keyframes: Collection[int], rig: StereoRig, noise: SensorNoise
) -> Array:
    """Returns a path (n, 4, 4) whose blind frames fit their predicted motions and readings best.

    The measured frames before and after them, and keyframes (their rows), are exact. Blind frames at the end of the
    path are held on one side only, those at its beginning stay as they are.
    """
    path = path.copy()
    free = [frame for frame in blind if frame.row not in keyframes]
    starts = np.flatnonzero(np.diff([frame.row for frame in free], prepend=-2) != 1)  # of runs of consecutive rows
    for start, stop in zip(starts, [*starts[1:], None], strict=False):
        frames = free[start:stop]
        first, end = frames[0].row - 1, frames[-1].row + 1
        if first < 0:
            continue
        steps = _weighted(frames)
        if end < len(path):
            steps.append(steps[-1]._replace(row=end))  # the last motion is taken to be like the one before
        rows = [first, *(frame.row for frame in steps)]
        readings = {frame.row: frame.readings for frame in frames}
        nodes = [Keyframe(k, row, 1, path[row], None, readings.get(row, Readings())) for k, row in enumerate(rows)]
        links = [Link(k, k + 1, frame.motion, frame.cov, 0.0, 0) for k, frame in enumerate(steps)]
        anchors = {0: _EXACT} | ({len(rows) - 1: _EXACT} if end < len(path) else {})
        poses = align(nodes, links, anchors, rig, noise, marginals_of=[]).poses
        path[first + 1 : end] = poses[1 : len(frames) + 1]
    return path


def _weighted(frames: Sequence[BlindFrame]) -> list[BlindFrame]:
    """Returns frames whose guessed motions have variances that grow with the square of the time since the first one."""
    # the velocity of a vehicle changes gradually, so the first guesses are good; the sum of the variances stays
    growth = 3 * ((np.arange(len(frames)) + 0.5) / len(frames)) ** 2
    return [
        frame._replace(cov=factor * frame.cov) if frame.guessed else frame
        for frame, factor in zip(frames, growth, strict=True)
    ]
