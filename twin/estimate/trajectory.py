"""Poses of all frames from those of the key points."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin import geometry
from twin.geometry import Array


def interpolate_between_keys(f2f: Array, rows: NDArray[np.int64], key_poses: Array) -> Array:
    """Follows frame-to-frame motion from each key point and spreads what is left at the next evenly over the way.

    Args:
        f2f: (n, 4, 4) poses by frame-to-frame motion alone.
        rows: (m,) frames that are key points, ascending.
        key_poses: (m, 4, 4) their aligned poses.

    Returns:
        (n, 4, 4); equal to `key_poses` at the key points; before the first and after the last, frame to frame alone.
    """
    if len(rows) == 0:
        return f2f.copy()
    result = np.empty_like(f2f)
    first = key_poses[0] @ geometry.inverse(f2f[rows[0]])
    result[: rows[0]] = first @ f2f[: rows[0]]
    for k, row in enumerate(rows):
        end = rows[k + 1] if k + 1 < len(rows) else len(f2f)
        there = key_poses[k] @ geometry.inverse(f2f[row])
        if k + 1 < len(rows):
            gap = geometry.log(geometry.inverse(there @ f2f[end]) @ key_poses[k + 1])
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
