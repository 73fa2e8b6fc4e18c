"""How a motion shows in one image and between two stereo pairs: linearised rows and their normal equations.

Coordinates are normalised: x = (column - cx) / f, y = (row - cy) / f; disparity likewise: depth = baseline / disparity.
Compiled: a keyframe's five links take 30 solutions of 500 points each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from twin.core.geometry import Array

_NEAREST = 1e-4  # disparity of a point that the adjustment would push beyond infinity


class Observations(NamedTuple):
    """What n points measured by two pairs a and b say of the motion, linearised.

    Args:
        error: (n, 3) of what a measured, against the structure moved from b.
        by_point: (n, 3, 3), by_motion: (n, 3, 6) derivatives of the prediction.
        information: (n, 3, 3) inverse covariance of the error.
        size: (n,) of the error in its own deviations, per degree of freedom.
    """

    error: Array
    by_point: Array
    by_motion: Array
    information: Array
    size: Array


@njit(cache=True, nogil=True)
def image_motion(x, y, depth):
    """Rows of eq. (1): image velocity per camera twist [w, t] (Negahdaripour & Madjidi 2003). (n,) -> (n, 2, 6)"""
    rows = np.empty((len(x), 2, 6))
    for i in range(len(x)):
        u, v, near = x[i], y[i], 1 / depth[i]
        rows[i, 0] = u * v, -(1 + u * u), v, -near, 0.0, u * near
        rows[i, 1] = 1 + v * v, -u * v, -u, 0.0, -near, v * near
    return rows


@njit(cache=True, nogil=True)
def normal_equations(rows, weight, value):
    """Of weighted least squares: rows (n, k, 6), weight (n,), value (n, k). -> (6, 6), (6,)"""
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for i in range(len(rows)):
        for k in range(rows.shape[1]):
            for p in range(6):
                scaled = weight[i] * rows[i, k, p]
                right[p] += scaled * value[i, k]
                for q in range(6):
                    normal[p, q] += scaled * rows[i, k, q]
    return normal, right


def linearise(
    a: Array, b: Array, structure: Array, cov_a: Array, cov_b: Array, a_from_b: Array, baseline_m: float
) -> Observations:
    """Rows of points measured as `a` and `b` (n, 3) with these covariances (n, 3, 3), at a structure in b (n, 3)."""
    return Observations(*linearised(a, b, structure, cov_a, cov_b, a_from_b, baseline_m))


def weighted_normal_equations(seen: Observations, weight: Array) -> tuple[Array, Array, Array]:
    """The structure eliminated: normal matrix (6, 6), right side (6,), effect of an error that all share (6, 3)."""
    return reduced(seen.error, seen.by_motion, seen.information, weight)


def adjust_structure(seen: Observations, b: Array, cov_b: Array, twist: Array) -> Array:
    """The structure (n, 3) in b once the motion has moved by `twist`."""
    return _adjust_structure(seen.error, seen.by_point, seen.by_motion, seen.information, b, cov_b, twist)


@njit(cache=True, nogil=True)
def transfer(z_b, a_from_b, baseline):
    """(x, y, disparity) in a of points measured in b; derivatives by the point (n, 3, 3) and the motion (n, 3, 6)."""
    n = len(z_b)
    z_a, by_point, by_motion = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 6))
    rotation, lever = np.empty((3, 3)), np.empty(3)
    for r in range(3):
        lever[r] = a_from_b[r, 3] / baseline
        for c in range(3):
            rotation[r, c] = a_from_b[r, c]
    q, q_by = np.empty(3), np.empty((3, 9))  # the point in a, times disparity / baseline; by point and motion
    for i in range(n):
        x, y, d = z_b[i]
        for r in range(3):
            r0, r1, r2 = rotation[r]
            q[r] = r0 * x + r1 * y + r2 + d * lever[r]
            q_by[r, 0], q_by[r, 1], q_by[r, 2] = r0, r1, lever[r]
            q_by[r, 3], q_by[r, 4], q_by[r, 5] = r2 * y - r1, r0 - r2 * x, r1 * x - r0 * y
            for k in range(3):
                q_by[r, 6 + k] = d * rotation[r, k] / baseline
        for r in range(3):
            z_a[i, r] = (d if r == 2 else q[r]) / q[2]
            for k in range(9):
                top = q_by[r, k] if r < 2 else (1.0 if k == 2 else 0.0)
                slope = (top - z_a[i, r] * q_by[2, k]) / q[2]
                if k < 3:
                    by_point[i, r, k] = slope
                else:
                    by_motion[i, r, k - 3] = slope
    return z_a, by_point, by_motion


@njit(cache=True, nogil=True)
def linearised(a, b, structure, cov_a, cov_b, a_from_b, baseline):
    predicted, by_point, by_motion = transfer(structure, a_from_b, baseline)
    n = len(a)
    error, information, size = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n)
    cov, carried = np.empty((3, 3)), np.empty((3, 3))
    for i in range(n):
        g = by_point[i]
        for r in range(3):
            error[i, r] = a[i, r] - predicted[i, r]
            for k in range(3):
                error[i, r] -= g[r, k] * (b[i, k] - structure[i, k])
                carried[r, k] = g[r, 0] * cov_b[i, 0, k] + g[r, 1] * cov_b[i, 1, k] + g[r, 2] * cov_b[i, 2, k]
            for c in range(r + 1):
                off = carried[r, 0] * g[c, 0] + carried[r, 1] * g[c, 1] + carried[r, 2] * g[c, 2]
                cov[r, c] = cov[c, r] = cov_a[i, r, c] + off
        _invert(cov, information[i])
        square = 0.0
        for r in range(3):
            for c in range(3):
                square += error[i, r] * information[i, r, c] * error[i, c]
        size[i] = np.sqrt(square / 3)
    return error, by_point, by_motion, information, size


@njit(cache=True, nogil=True)
def _invert(m, out):
    """Inverse of a 3x3 matrix by its cofactors."""
    for r in range(3):
        for c in range(3):
            r1, r2, c1, c2 = (r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3
            out[c, r] = m[r1, c1] * m[r2, c2] - m[r1, c2] * m[r2, c1]
    det = m[0, 0] * out[0, 0] + m[0, 1] * out[1, 0] + m[0, 2] * out[2, 0]
    out /= det


@njit(cache=True, nogil=True)
def reduced(error, by_motion, information, weight):
    normal, right, by_common = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 3))
    projected = np.empty((6, 3))
    for i in range(len(error)):
        if weight[i] == 0:
            continue
        for p in range(6):
            for c in range(3):
                projected[p, c] = 0.0
                for r in range(3):
                    projected[p, c] += by_motion[i, r, p] * information[i, r, c]
                projected[p, c] *= weight[i]
                right[p] += projected[p, c] * error[i, c]
                by_common[p, c] += projected[p, c]
            for q in range(p + 1):
                for c in range(3):
                    normal[p, q] += projected[p, c] * by_motion[i, c, q]
    for p in range(6):
        for q in range(p):
            normal[q, p] = normal[p, q]
    return normal, right, by_common


@njit(cache=True, nogil=True)
def _adjust_structure(error, by_point, by_motion, information, b, cov_b, twist):
    structure = b.copy()
    left, pulled = np.empty(3), np.empty(3)
    for i in range(len(b)):
        for r in range(3):
            left[r] = error[i, r]
            for p in range(6):
                left[r] -= by_motion[i, r, p] * twist[p]
        for r in range(3):
            pulled[r] = 0.0
            for c in range(3):
                pulled[r] += information[i, r, c] * left[c]
        for k in range(3):
            for m in range(3):
                for r in range(3):
                    structure[i, k] += cov_b[i, k, m] * by_point[i, r, m] * pulled[r]
        structure[i, 2] = max(structure[i, 2], _NEAREST)
    return structure
