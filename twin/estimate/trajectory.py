"""Poses of all frames, interpolated between the poses of the keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.kernels import kernel


def interpolate_between_keyframes(f2f: Array, rows: NDArray[np.int64], keyframe_poses: Array) -> Array:
    """Interpolates the poses of keyframes to all frames along the frame-to-frame motion.

    From each keyframe, the poses follow the frame-to-frame motion to the next keyframe. The misclosure, i.e. the motion
    from the pose so reached to the given pose of the next keyframe, is distributed linearly over the frames in between.

    Args:
        f2f: (n, 4, 4) poses from frame-to-frame motion alone.
        rows: (m,) indices of the frames that are keyframes, ascending.
        keyframe_poses: (m, 4, 4) aligned poses of these keyframes.

    Returns:
        (n, 4, 4) poses of all frames, equal to `keyframe_poses` at the keyframes. Frames before the first and after the
        last keyframe follow the frame-to-frame motion without correction. Without keyframes, a copy of `f2f`.
    """
    if len(rows) == 0:
        return f2f.copy()
    result = np.empty_like(f2f)
    world_from_start = keyframe_poses[0] @ geometry.inverse(f2f[rows[0]])
    result[: rows[0]] = world_from_start @ f2f[: rows[0]]
    for k, row in enumerate(rows):
        end = rows[k + 1] if k + 1 < len(rows) else len(f2f)
        world_from_start = keyframe_poses[k] @ geometry.inverse(f2f[row])
        if k + 1 < len(rows):
            misclosure = geometry.log(geometry.inverse(world_from_start @ f2f[end]) @ keyframe_poses[k + 1])
            _distribute(world_from_start, f2f[row:end], misclosure, result[row:end])
        else:
            result[row:] = world_from_start @ f2f[row:]
    return result


@kernel
def _distribute(world_from_start, f2f, misclosure, out):
    """Writes the poses `world_from_start` @ `f2f`, corrected for the twist `misclosure` (6,), to `out` (n, 4, 4).

    Pose k of the n poses is moved by the fraction k / n of the misclosure; pose n would be that of the next keyframe.
    """
    step = 1 / len(f2f)
    for k in range(len(f2f)):
        pose = geometry.compose(world_from_start, f2f[k])
        geometry.copy_into(out[k], geometry.compose(pose, geometry.exp(misclosure * (k * step))))
