"""Poses of all frames: their record, and their interpolation between the poses of the keyframes."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.series import GrowingArray
from twin.estimate.adjustment.pose_graph import retract
from twin.kernels import kernel

_LEAST_VARIANCE = 1e-12  # of a component of a step [rad^2, m^2]
_MAX_ITERATIONS = 10  # of the closure, which converges quadratically


@dataclass
class PoseLog:
    """Times and estimated poses of all n frames; each frame takes 360 bytes of memory."""

    times_s: GrowingArray = field(default_factory=GrowingArray)  #: (n,) [s]
    #: (n, 4, 4) world_from_camera from frame-to-frame motion alone.
    f2f: GrowingArray = field(default_factory=lambda: GrowingArray(4, 4))
    online: GrowingArray = field(default_factory=lambda: GrowingArray(4, 4))  #: (n, 4, 4) world_from_camera
    #: (n, 6) twists from frame to frame: those of vision, or of the online pose where vision failed. The online pose
    #: also has the noise of the navigation sensors, but where vision fails they determine it.
    steps: GrowingArray = field(default_factory=lambda: GrowingArray(6))
    #: (n, 6) variances of `steps` [rad^2, m^2], in the axes of the later frame.
    variances: GrowingArray = field(default_factory=lambda: GrowingArray(6))
    n_lost: int = 0  #: number of frames whose motion was not measured but predicted
    #: rows of the frames at which a camera was frozen, by status (`vision.repeated_images`).
    repeats: dict[str, list[int]] = field(default_factory=dict[str, list[int]])

    def __len__(self) -> int:
        return len(self.times_s)

    def append_after(self, first: int, time_s: float, f2f: Array, online: Array, motion: Array) -> None:
        """Appends a frame whose motion (4, 4) was measured since the one before row `first`; closes the steps since."""
        # the steps in between were predicted; the last one is taken to be like them
        self.append(time_s, f2f, online, self.steps.array[-1].copy(), self.variances.array[-1].copy())
        motions = retract(np.tile(np.eye(4), (len(self) - first, 1, 1)), self.steps.array[first:])
        _close(motion, motions, np.maximum(self.variances.array[first:], _LEAST_VARIANCE))
        self.steps.array[first:] = np.array([geometry.log(one) for one in motions]).reshape(-1, 6)

    def append(self, times_s: float | Array, f2f: Array, online: Array, steps: Array, variances: Array) -> None:
        self.times_s.append(times_s)
        self.f2f.append(f2f)
        self.online.append(online)
        self.steps.append(steps)
        self.variances.append(variances)


def interpolate_between_keyframes(
    steps: Array, variances: Array, rows: NDArray[np.int64], keyframe_poses: Array
) -> Array:
    """Returns the poses (n, 4, 4) of all frames from those of the keyframes (m, 4, 4) and the steps between frames.

    Between two keyframes, with indices `rows` (m,), the misclosure of the steps is distributed over them by least
    squares, weighted by their variances: a step that failed takes nearly all of it. Frames before the first and after
    the last keyframe follow the steps without correction. `steps` and `variances` are those of `PoseLog`; m > 0.
    """
    motions, variances = retract(np.tile(np.eye(4), (len(steps), 1, 1)), steps), np.maximum(variances, _LEAST_VARIANCE)
    between = zip(rows, rows[1:], keyframe_poses, keyframe_poses[1:], strict=False)
    for row, next_row, pose, next_pose in between:
        inner = slice(row + 1, next_row + 1)
        _close(geometry.inverse(pose) @ next_pose, motions[inner], variances[inner])
    return _follow(motions, rows, keyframe_poses)


@kernel
def _close(target, motions, variances):
    """Corrects motions (n, 4, 4), in place, so that their product is the motion `target` (4, 4)."""
    # C_k A_k' (sum of A C A')^-1 times the misclosure, with covariances C_k and the adjoint A_k from the axes after
    # motion k to those at the end
    n = len(motions)
    adjoints = np.empty((n, 6, 6))
    for _ in range(_MAX_ITERATIONS):
        end_from_frame, cov = np.eye(4), np.zeros((6, 6))
        for k in range(n - 1, -1, -1):
            geometry.copy_into(adjoints[k], geometry.adjoint(end_from_frame))
            cov += geometry.product(adjoints[k] * variances[k], adjoints[k].T)
            end_from_frame = geometry.compose(end_from_frame, geometry.inverse(motions[k]))
        misclosure = geometry.log(geometry.compose(end_from_frame, target))
        share = np.linalg.solve(cov, misclosure)
        for k in range(n):
            correction = geometry.exp(variances[k] * (adjoints[k].T @ share))
            geometry.copy_into(motions[k], geometry.compose(motions[k], correction))
        if np.abs(misclosure).max() < 1e-9:
            break


@kernel
def _follow(motions, rows, keyframe_poses):
    """Returns the poses (n, 4, 4) that follow the motions (n, 4, 4) from each keyframe to the next one."""
    path = np.empty_like(motions)
    for k in range(len(rows)):
        geometry.copy_into(path[rows[k]], keyframe_poses[k])
        end = rows[k + 1] if k + 1 < len(rows) else len(motions)
        for row in range(rows[k] + 1, end):
            geometry.copy_into(path[row], geometry.compose(path[row - 1], motions[row]))
    for row in range(rows[0], 0, -1):
        geometry.copy_into(path[row - 1], geometry.compose(path[row], geometry.inverse(motions[row])))
    return path
