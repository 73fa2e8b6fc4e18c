"""Poses of all frames from those of the keyframes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array


def interpolate_between_keyframes(f2f: Array, rows: NDArray[np.int64], keyframe_poses: Array) -> Array:
    """Follows frame-to-frame motion from each keyframe and spreads what is left at the next evenly over the way.

    Args:
        f2f: (n, 4, 4) poses by frame-to-frame motion alone.
        rows: (m,) frames that are keyframes, ascending.
        keyframe_poses: (m, 4, 4) their aligned poses.

    Returns:
        (n, 4, 4), equal to `keyframe_poses` at the keyframes; frame-to-frame motion before the first and after the last.
    """
    if len(rows) == 0:
        return f2f.copy()
    result = np.empty_like(f2f)
    first = keyframe_poses[0] @ geometry.inverse(f2f[rows[0]])
    result[: rows[0]] = first @ f2f[: rows[0]]
    for k, row in enumerate(rows):
        end = rows[k + 1] if k + 1 < len(rows) else len(f2f)
        there = keyframe_poses[k] @ geometry.inverse(f2f[row])
        if k + 1 < len(rows):
            gap = geometry.log(geometry.inverse(there @ f2f[end]) @ keyframe_poses[k + 1])
            _spread(there, f2f[row:end], gap, result[row:end])
        else:
            result[row:] = there @ f2f[row:]
    return result


@njit(cache=True, nogil=True)
def _spread(there, f2f, gap, out):
    """Poses (n, 4, 4) moved by `there`, each with its even share of the gap (6,) behind the last."""
    step = 1 / len(f2f)
    for k in range(len(f2f)):
        geometry.put(out[k], geometry.compose(geometry.compose(there, f2f[k]), geometry.exp(gap * (k * step))))
