"""Linearised observation equations of camera motion, in one image and between two stereo pairs (compiled).

Coordinates are normalised: x = (column - cx) / f, y = (row - cy) / f, and disparity / f: depth = baseline / disparity.
"""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel

_MIN_DISPARITY = 1e-4  # keeps adjusted points in front of the camera


class PairMeasurements(NamedTuple):
    """Measurements of n points in two stereo pairs, or (`f2f`) in an image, without disparity, and its reference."""

    a: Array  #: (n, 3) normalised (x, y, disparity) in pair a
    b: Array  #: (n, 3) normalised (x, y, disparity) in pair b
    cov_a: Array  #: (n, 3, 3) covariance of each point in `a`
    cov_b: Array  #: (n, 3, 3) covariance of each point in `b`


class PixelLocking(NamedTuple):
    """Derivatives of the measurements of n points in two pairs with respect to the amplitude of pixel locking."""

    a: Array  #: (n, 3) derivative of the normalised (x, y, disparity) in the earlier pair a [1/px]
    b: Array  #: (n, 3) the same in the later pair b


class LinearisedObservations(NamedTuple):
    residual: Array  #: (n, 3) measurements in a, minus their linearised prediction from the measurements in b
    jacobian_point: Array  #: (n, 3, 3) derivative of the prediction with respect to the point (x, y, disparity) in b
    #: (n, 3, p) derivative of the prediction with respect to the p unknowns: the increment of the motion a_from_b, a
    #: twist in the axes of b (p = 6), and the amplitude of pixel locking if that is estimated too (p = 7).
    jacobian_motion: Array
    information: Array  #: (n, 3, 3) inverse covariance of the residual
    normalised_residual: Array  #: (n,) Mahalanobis distance of the residual, divided by sqrt(3)


@kernel
def change_by_yaw(points: Array) -> Array:
    """Returns the change (n, 3) of normalised (x, y, disparity) of a stereo pair per yaw of the right camera [rad]."""
    # at column x of the right image, -(1 + x^2) in the column and -x y in the row (Hartley & Zisserman 2004, section
    # 6.1); the constraint of equal rows takes the mean of both rows
    change = np.zeros((len(points), 3))
    for i in range(len(points)):
        x = points[i, 0] - points[i, 2]
        change[i, 1], change[i, 2] = -x * points[i, 1] / 2, 1 + x * x
    return change


@kernel
def image_jacobian(x, y, depth):
    """Returns the derivative (n, 2, 6) of normalised positions by the twist of the camera (eq. 1), for depths [m]."""
    jacobian = np.empty((len(x), 2, 6))
    for i in range(len(x)):
        u, v, inverse_depth = x[i], y[i], 1 / depth[i]
        jacobian[i, 0] = u * v, -(1 + u * u), v, -inverse_depth, 0.0, u * inverse_depth
        jacobian[i, 1] = 1 + v * v, -u * v, -u, 0.0, -inverse_depth, v * inverse_depth
    return jacobian


@kernel
def normal_equations(jacobian, weight, residual):
    """Returns the normal matrix (6, 6) and right-hand side (6,) of n points with k observations each."""
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for i in range(len(jacobian)):
        for k in range(jacobian.shape[1]):
            for p in range(6):
                scaled = weight[i] * jacobian[i, k, p]
                right[p] += scaled * residual[i, k]
                for q in range(6):
                    normal[p, q] += scaled * jacobian[i, k, q]
    return normal, right


@kernel
def transfer(points_b, a_from_b, baseline):
    """Transfers normalised (x, y, disparity) (n, 3) from pair b to a; with derivatives by point and motion."""
    # (n, 3, 3) by the point in b, (n, 3, 6) by an increment [rotation, translation] (rad, m) of the motion in its axes
    n = len(points_b)
    points_a, jacobian_point, jacobian_motion = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 6))
    rotation, translation = np.empty((3, 3)), np.empty(3)  # translation in baselines
    for r in range(3):
        translation[r] = a_from_b[r, 3] / baseline
        for c in range(3):
            rotation[r, c] = a_from_b[r, c]
    q, q_jacobian = np.empty(3), np.empty((3, 9))  # point in a, times disparity / baseline, and its derivatives
    for i in range(n):
        x, y, d = points_b[i]
        for r in range(3):
            r0, r1, r2 = rotation[r]
            q[r] = r0 * x + r1 * y + r2 + d * translation[r]
            q_jacobian[r, 0], q_jacobian[r, 1], q_jacobian[r, 2] = r0, r1, translation[r]
            q_jacobian[r, 3], q_jacobian[r, 4], q_jacobian[r, 5] = r2 * y - r1, r0 - r2 * x, r1 * x - r0 * y
            for k in range(3):
                q_jacobian[r, 6 + k] = d * rotation[r, k] / baseline
        for r in range(3):
            points_a[i, r] = (d if r == 2 else q[r]) / q[2]
            for k in range(9):
                numerator = q_jacobian[r, k] if r < 2 else (1.0 if k == 2 else 0.0)
                derivative = (numerator - points_a[i, r] * q_jacobian[2, k]) / q[2]
                if k < 3:
                    jacobian_point[i, r, k] = derivative
                else:
                    jacobian_motion[i, r, k - 3] = derivative
    return points_a, jacobian_point, jacobian_motion


@kernel
def linearise(measured, structure, a_from_b, baseline):
    """Returns the `LinearisedObservations` of two pairs, at points in b, `structure` (n, 3), and a motion (4, 4)."""
    predicted, jacobian_point, jacobian_motion = transfer(structure, a_from_b, baseline)
    a, b, cov_a, cov_b = measured.a, measured.b, measured.cov_a, measured.cov_b
    n = len(a)
    residual, information, normalised_residual = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n)
    cov, transferred_cov = np.empty((3, 3)), np.empty((3, 3))
    for i in range(n):
        g = jacobian_point[i]
        for r in range(3):
            residual[i, r] = a[i, r] - predicted[i, r]
            for k in range(3):
                residual[i, r] -= g[r, k] * (b[i, k] - structure[i, k])
                transferred_cov[r, k] = g[r, 0] * cov_b[i, 0, k] + g[r, 1] * cov_b[i, 1, k] + g[r, 2] * cov_b[i, 2, k]
            for c in range(r + 1):
                from_b = (
                    transferred_cov[r, 0] * g[c, 0] + transferred_cov[r, 1] * g[c, 1] + transferred_cov[r, 2] * g[c, 2]
                )
                cov[r, c] = cov[c, r] = cov_a[i, r, c] + from_b
        _invert(cov, information[i])
        distance = 0.0
        for r in range(3):
            for c in range(3):
                distance += residual[i, r] * information[i, r, c] * residual[i, c]
        normalised_residual[i] = np.sqrt(distance / 3)
    return LinearisedObservations(residual, jacobian_point, jacobian_motion, information, normalised_residual)


@kernel
def _invert(m, out):
    for r in range(3):
        for c in range(3):
            r1, r2, c1, c2 = (r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3
            out[c, r] = m[r1, c1] * m[r2, c2] - m[r1, c2] * m[r2, c1]
    det = m[0, 0] * out[0, 0] + m[0, 1] * out[1, 0] + m[0, 2] * out[2, 0]
    out /= det


@kernel
def motion_normal_equations(observations, weight):
    """Returns the normal equations of the p unknowns of the motion, with the structure eliminated."""
    # normal matrix (p, p), right-hand side (p,), and its derivative (p, 3) with respect to biases of x, y and disparity
    # in a that are the same at all points; points of robust weight (n,) 0 are skipped
    residual, jacobian, information = observations.residual, observations.jacobian_motion, observations.information
    count = jacobian.shape[2]
    normal, right, bias_jacobian = np.zeros((count, count)), np.zeros(count), np.zeros((count, 3))
    projected = np.empty((count, 3))
    for i in range(len(residual)):
        if weight[i] == 0:
            continue
        for p in range(count):
            for c in range(3):
                projected[p, c] = 0.0
                for r in range(3):
                    projected[p, c] += jacobian[i, r, p] * information[i, r, c]
                projected[p, c] *= weight[i]
                right[p] += projected[p, c] * residual[i, c]
                bias_jacobian[p, c] += projected[p, c]
            for q in range(p + 1):
                for c in range(3):
                    normal[p, q] += projected[p, c] * jacobian[i, c, q]
    for p in range(count):
        for q in range(p):
            normal[q, p] = normal[p, q]
    return normal, right, bias_jacobian


@kernel
def adjust_structure(observations, measured, update):
    """Returns the adjusted points (n, 3) of pair b after an update (p,) of the unknowns of the motion."""
    b, cov_b = measured.b, measured.cov_b
    structure = b.copy()
    remaining, weighted = np.empty(3), np.empty(3)
    for i in range(len(b)):
        for r in range(3):
            remaining[r] = observations.residual[i, r]
            for p in range(len(update)):
                remaining[r] -= observations.jacobian_motion[i, r, p] * update[p]
        for r in range(3):
            weighted[r] = 0.0
            for c in range(3):
                weighted[r] += observations.information[i, r, c] * remaining[c]
        for k in range(3):
            for m in range(3):
                for r in range(3):
                    structure[i, k] += cov_b[i, k, m] * observations.jacobian_point[i, r, m] * weighted[r]
        structure[i, 2] = max(structure[i, 2], _MIN_DISPARITY)
    return structure
