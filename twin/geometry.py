"""Rigid motions: the one home of every rotation, quaternion and axis convention.

A pose is a 4x4 homogeneous matrix named ``world_from_camera``; inner names cancel in products. A small motion is a
6-vector ``[rotation, translation]`` (rad, m), applied on the right: ``pose @ exp(motion)``: gtsam's order.

World: x east, y north, z up. Body: x forward, y left, z up. Camera: x right, y down, z forward. Pixel (0, 0) is the
centre of the top-left pixel.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: A camera that looks straight down with the top of its image towards the bow: columns are its axes in the body.
BODY_FROM_DOWN_CAMERA: Array = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@njit(cache=True, nogil=True)
def skew(v: Array) -> Array:
    """The matrix whose product with x is the cross product v x x. (3,) -> (3, 3)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit(cache=True, nogil=True)
def pose(rotation: Array, position: Array) -> Array:
    """A pose from a (3, 3) rotation and a (3,) position [m]."""
    result = np.zeros((4, 4))
    result[:3, :3] = rotation
    result[:3, 3] = position
    result[3, 3] = 1.0
    return result


@njit(cache=True, nogil=True)
def inverse(a_from_b: Array) -> Array:
    """b_from_a, exactly rigid. (4, 4) -> (4, 4)."""
    result = np.zeros((4, 4))
    for i in range(3):
        for k in range(3):
            result[i, k] = a_from_b[k, i]
            result[i, 3] -= a_from_b[k, i] * a_from_b[k, 3]
    result[3, 3] = 1.0
    return result


def rigid(almost: Array) -> Array:
    """The rigid motion nearest to a product of many: `inverse` doubles what a rotation lacks of orthogonality.

    (..., 4, 4) -> (..., 4, 4)
    """
    return _rigid(np.ascontiguousarray(almost).reshape(-1, 4, 4)).reshape(almost.shape)


@njit(cache=True, nogil=True)
def _rigid(almost):
    """Newton's iteration for the orthogonal polar factor, R <- (R + R^-T) / 2 (Higham 1986). (n, 4, 4) -> (n, 4, 4)."""
    result = almost.copy()
    for motion in result:
        change = np.inf
        while change > 1e-12:  # the next one is its square
            a, b, c = motion[0, :3], motion[1, :3], motion[2, :3]
            cofactors = np.stack((np.cross(b, c), np.cross(c, a), np.cross(a, b)))
            step = 0.5 * (cofactors / np.sum(a * cofactors[0]) - motion[:3, :3])
            motion[:3, :3] += step
            change = np.abs(step).max()
    return result


@njit(cache=True, nogil=True)
def so3_exp(w: Array) -> Array:
    """Rotation matrix of a rotation vector [rad], by the formula of Rodrigues, exact near identity. (3,) -> (3, 3)."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-4:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    return _of_powers(w, a, b)


@njit(cache=True, nogil=True)
def _left_jacobian(w: Array) -> Array:
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-3:
        a, b = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        a, b = (1.0 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    return _of_powers(w, a, b)


@njit(cache=True, nogil=True)
def _of_powers(w: Array, a: float, b: float) -> Array:
    """I + a K + b K^2 with K the cross product by w; K^2 = w w' - |w|^2 I."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    result = a * skew(w)
    for i in range(3):
        for k in range(3):
            result[i, k] += b * w[i] * w[k]
        result[i, i] += 1.0 - b * angle2
    return result


@njit(cache=True, nogil=True)
def so3_log(rotation: Array) -> Array:
    """Rotation vector [rad] of a rotation matrix, angle in [0, pi]. (3, 3) -> (3,)."""
    w = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    sine = 0.5 * np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    cosine = 0.5 * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1.0)
    if cosine < -0.9:  # near half a turn the difference above says little: the axis is in the diagonal
        i = 0
        for k in range(1, 3):
            if rotation[k, k] > rotation[i, i]:
                i = k
        axis = np.zeros(3)
        for k in range(3):
            axis[k] = 0.5 * (rotation[i, k] + rotation[k, i]) - (cosine if k == i else 0.0)
        length = np.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
        forth = axis[0] * w[0] + axis[1] * w[1] + axis[2] * w[2] >= 0
        return axis * ((1.0 if forth else -1.0) * np.arctan2(sine, cosine) / length)
    return w * (0.5 if sine < 1e-8 else 0.5 * np.arctan2(sine, cosine) / sine)


@njit(cache=True, nogil=True)
def exp(motion: Array) -> Array:
    """Pose reached by a twist [rotation, translation] (rad, m) held for unit time. (6,) -> (4, 4)."""
    w = motion[:3]
    jacobian, way = _left_jacobian(w), np.zeros(3)
    for i in range(3):
        for k in range(3):
            way[i] += jacobian[i, k] * motion[3 + k]
    return pose(so3_exp(w), way)


@njit(cache=True, nogil=True)
def log(a_from_b: Array) -> Array:
    """Twist [rotation, translation] of a pose: the inverse of `exp`. (4, 4) -> (6,)."""
    result = np.empty(6)
    result[:3] = so3_log(a_from_b[:3, :3])
    result[3:] = np.linalg.solve(_left_jacobian(result[:3]), a_from_b[:3, 3].copy())
    return result


@njit(cache=True, nogil=True)
def adjoint(a_from_b: Array) -> Array:
    """The 6x6 matrix that carries a motion in b into a: a_from_b exp(m) = exp(Ad m) a_from_b."""
    result = np.zeros((6, 6))
    x, y, z = a_from_b[0, 3], a_from_b[1, 3], a_from_b[2, 3]
    for k in range(3):
        r0, r1, r2 = a_from_b[0, k], a_from_b[1, k], a_from_b[2, k]
        result[0, k] = result[3, 3 + k] = r0
        result[1, k] = result[4, 3 + k] = r1
        result[2, k] = result[5, 3 + k] = r2
        result[3, k], result[4, k], result[5, k] = y * r2 - z * r1, z * r0 - x * r2, x * r1 - y * r0
    return result


def transform(a_from_b: Array, points_b: Array) -> Array:
    """Points (n, 3) of b in a."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


@njit(cache=True, nogil=True)
def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """world_from_body rotation: yaw about z, then pitch about y, then roll about x (rad, intrinsic z-y'-x'')."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


@njit(cache=True, nogil=True)
def rpy_from_rotation(rotation: Array) -> Array:
    """[roll, pitch, yaw] (rad) of world_from_body: the inverse of `rotation_from_rpy`. (3, 3) -> (3,).

    Straight up or down, where only their difference is known, roll is zero.
    """
    level = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], level)
    if level < 1e-12:
        return np.array([0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


@njit(cache=True, nogil=True)
def wrap_angle(angle: Array) -> Array:
    """The same angles in [-pi, pi) (rad)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def quaternion_wxyz(rotation: Array) -> Array:
    """MuJoCo's quaternion [w, x, y, z] of a rotation matrix, w >= 0."""
    return quaternion_xyzw(rotation)[[3, 0, 1, 2]]


def rotation_from_wxyz(quaternion: Array) -> Array:
    """Rotation matrices (..., 3, 3) of MuJoCo's quaternions [w, x, y, z] (..., 4)."""
    from scipy.spatial.transform import Rotation  # here: it takes 0.15 s and 20 MB, and most surveys need none

    return Rotation.from_quat(np.asarray(quaternion)[..., [1, 2, 3, 0]]).as_matrix()


def quaternion_xyzw(rotation: Array) -> Array:
    """Rerun's and TUM's quaternion [x, y, z, w] of a rotation matrix, w >= 0."""
    return quaternions_xyzw(np.asarray(rotation, np.float64)[None])[0]


@njit(cache=True, nogil=True)
def quaternions_xyzw(rotations: Array) -> Array:
    """The same of many: (n, 3, 3) -> (n, 4), from the largest of the four for precision (Shepperd 1978)."""
    out = np.empty((len(rotations), 4))
    for k in range(len(rotations)):
        r = rotations[k]
        four = np.array([r[0, 0], r[1, 1], r[2, 2], r[0, 0] + r[1, 1] + r[2, 2]])
        q, i = out[k], int(np.argmax(four))
        if i == 3:
            q[0], q[1], q[2] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
            q[3] = 1 + four[3]
        else:
            j, m = (i + 1) % 3, (i + 2) % 3
            q[i] = 1 - four[3] + 2 * four[i]
            q[j], q[m] = r[j, i] + r[i, j], r[m, i] + r[i, m]
            q[3] = r[m, j] - r[j, m]
        q *= (-1.0 if q[3] < 0 else 1.0) / np.sqrt(np.sum(q * q))
    return out


def heading_of_camera(world_from_camera: Array) -> Array:
    """Heading of the bow [rad, counter-clockwise from east] of down-looking cameras. (..., 4, 4) -> (...)."""
    forward = -world_from_camera[..., :3, 1]  # the top of the image
    return np.arctan2(forward[..., 1], forward[..., 0])
