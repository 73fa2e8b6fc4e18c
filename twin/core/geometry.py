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
def put(target: Array, values: Array) -> None:
    """target[...] = values, both of one shape (n,) or (n, m).

    numba's own brings the text of an error that cannot happen here into all who call it: a third of all compiled code.
    """
    for i in range(target.shape[0]):
        if target.ndim == 1:
            target[i] = values[i]
        else:
            for k in range(target.shape[1]):
                target[i, k] = values[i, k]


@njit(cache=True, nogil=True)
def skew(v: Array) -> Array:
    """The matrix whose product with x is the cross product v x x. (3,) -> (3, 3)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit(cache=True, nogil=True)
def pose(rotation: Array, position: Array) -> Array:
    """A pose from a (3, 3) rotation and a (3,) position [m]."""
    result = np.zeros((4, 4))
    put(result[:3, :3], rotation)
    put(result[:3, 3], position)
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


@njit(cache=True, nogil=True)
def compose(a_from_b: Array, b_from_c: Array) -> Array:
    """a_from_c, of poses (4, 4): their product in a third of the time that it takes a library for large matrices."""
    result = np.zeros((4, 4))
    for i in range(3):
        for k in range(4):
            result[i, k] = (
                a_from_b[i, 0] * b_from_c[0, k] + a_from_b[i, 1] * b_from_c[1, k] + a_from_b[i, 2] * b_from_c[2, k]
            )
        result[i, 3] += a_from_b[i, 3]
    result[3, 3] = 1.0
    return result


@njit(cache=True, nogil=True)
def sandwich(matrix: Array, cov: Array) -> Array:
    """matrix cov matrix' (6, 6), of a symmetric cov, symmetric to the last bit."""
    half, result = np.empty((6, 6)), np.empty((6, 6))
    for i in range(6):
        for k in range(6):
            half[i, k] = (
                matrix[i, 0] * cov[0, k] + matrix[i, 1] * cov[1, k] + matrix[i, 2] * cov[2, k]
                + matrix[i, 3] * cov[3, k] + matrix[i, 4] * cov[4, k] + matrix[i, 5] * cov[5, k]
            )  # fmt: skip
    for i in range(6):
        for k in range(i + 1):
            result[i, k] = result[k, i] = (
                half[i, 0] * matrix[k, 0] + half[i, 1] * matrix[k, 1] + half[i, 2] * matrix[k, 2]
                + half[i, 3] * matrix[k, 3] + half[i, 4] * matrix[k, 4] + half[i, 5] * matrix[k, 5]
            )  # fmt: skip
    return result


@njit(cache=True, nogil=True)
def product(a: Array, b: Array) -> Array:
    """a b, of matrices as small as a rotation. (n, m), (m, k) -> (n, k)."""
    result = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(b.shape[1]):
            for m in range(a.shape[1]):
                result[i, k] += a[i, m] * b[m, k]
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
            put(motion[:3, :3], motion[:3, :3] + step)
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
    x, y, z = w[0], w[1], w[2]
    angle2 = x * x + y * y + z * z
    result = np.empty((3, 3))
    result[0, 0], result[1, 1], result[2, 2] = (
        1.0 + b * (x * x - angle2), 1.0 + b * (y * y - angle2), 1.0 + b * (z * z - angle2),
    )  # fmt: skip
    result[0, 1], result[1, 0] = b * x * y - a * z, b * x * y + a * z
    result[0, 2], result[2, 0] = b * x * z + a * y, b * x * z - a * y
    result[1, 2], result[2, 1] = b * y * z - a * x, b * y * z + a * x
    return result


@njit(cache=True, nogil=True)
def so3_log(rotation: Array) -> Array:
    """Rotation vector [rad] of a rotation matrix, angle in [0, pi]. (3, 3) -> (3,)."""
    w = np.empty(3)
    w[0], w[1], w[2] = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
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
    scale = 0.5 if sine < 1e-8 else 0.5 * np.arctan2(sine, cosine) / sine
    for k in range(3):
        w[k] *= scale
    return w


@njit(cache=True, nogil=True)
def exp(motion: Array) -> Array:
    """Pose reached by a twist [rotation, translation] (rad, m) held for unit time. (6,) -> (4, 4)."""
    w, result = motion[:3], np.zeros((4, 4))
    jacobian = _left_jacobian(w)
    put(result[:3, :3], so3_exp(w))
    for i in range(3):
        for k in range(3):
            result[i, 3] += jacobian[i, k] * motion[3 + k]
    result[3, 3] = 1.0
    return result


@njit(cache=True, nogil=True)
def log(a_from_b: Array) -> Array:
    """Twist [rotation, translation] of a pose: the inverse of `exp`. (4, 4) -> (6,)."""
    w, result = so3_log(a_from_b[:3, :3]), np.zeros(6)
    c, _ = _of_half_turn(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    inward = _of_powers(w, -0.5, c)
    for i in range(3):
        result[i] = w[i]
        for k in range(3):
            result[3 + i] += inward[i, k] * a_from_b[k, 3]
    return result


@njit(cache=True, nogil=True)
def log_derivative(motion: Array) -> Array:
    """The matrix J with log(exp(motion) exp(d)) = motion + J d for small d. (6,) -> (6, 6).

    Of the rotation alone it is I + K / 2 + c K^2 with K the cross product by w. Motions are rotations by dual numbers
    w + e v, so that the part by which a rotation moves the position is that matrix's derivative along v (Selig 2005).
    """
    w, v, result = motion[:3], motion[3:], np.zeros((6, 6))
    c, slope = _of_half_turn(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    along = w[0] * v[0] + w[1] * v[1] + w[2] * v[2]
    of_rotation = _of_powers(w, 0.5, c)
    square = _of_powers(w, 0.0, 2.0 * slope * along)
    lever = 0.5 * skew(v)
    for i in range(3):
        for k in range(3):
            lever[i, k] += c * (v[i] * w[k] + w[i] * v[k]) + square[i, k]
        lever[i, i] -= 2.0 * c * along + 1.0
    put(result[:3, :3], of_rotation)
    put(result[3:, 3:], of_rotation)
    put(result[3:, :3], lever)
    return result


@njit(cache=True, nogil=True)
def _of_half_turn(angle2: float) -> tuple[float, float]:
    """c = 1 / a^2 - cot(a / 2) / (2 a) of an angle a, and its derivative by a^2; by the square of the angle."""
    if angle2 < 1e-2:
        return (
            1 / 12 + angle2 * (1 / 720 + angle2 * (1 / 30240 + angle2 / 1209600)),
            1 / 720 + angle2 * (1 / 15120 + angle2 / 403200),
        )
    angle = np.sqrt(angle2)
    cot, sine = 1.0 / np.tan(angle / 2.0), np.sin(angle / 2.0)
    slope = 1.0 / (8.0 * angle2 * sine * sine) + cot / (4.0 * angle2 * angle) - 1.0 / (angle2 * angle2)
    return 1.0 / angle2 - cot / (2.0 * angle), slope


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
