"""Rigid motions: all rotation, quaternion and axis conventions are defined here.

A pose is a 4x4 homogeneous matrix, such as ``world_from_camera``; ``a_from_b @ b_from_c`` is ``a_from_c``. A small
motion is a twist ``[rotation, translation]`` (rad, m), ordered as in GTSAM and applied on the right:
``pose @ exp(motion)``.

World: x east, y north, z up. Body: x forward, y left, z up. Camera: x right, y down, z forward. Pixel (0, 0) is the
centre of the top-left pixel.
"""

import numpy as np
from numpy.typing import NDArray

from twin.kernels import kernel

Array = NDArray[np.float64]

#: Rotation of a camera that looks straight down, with the top of the image towards the bow.
BODY_FROM_DOWN_CAMERA: Array = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@kernel
def copy_into(target: Array, values: Array) -> None:
    """Assigns target[...] = values of one shape (n,) or (n, m), without the shape check that Numba compiles."""
    for i in range(target.shape[0]):
        if target.ndim == 1:
            target[i] = values[i]
        else:
            for k in range(target.shape[1]):
                target[i, k] = values[i, k]


@kernel
def skew(v: Array) -> Array:
    """Returns the matrix (3, 3) with skew(v) @ x = v x x, the cross product."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@kernel
def pose(rotation: Array, position: Array) -> Array:
    result = np.zeros((4, 4))
    copy_into(result[:3, :3], rotation)
    copy_into(result[:3, 3], position)
    result[3, 3] = 1.0
    return result


@kernel
def inverse(a_from_b: Array) -> Array:
    result = np.zeros((4, 4))
    for i in range(3):
        for k in range(3):
            result[i, k] = a_from_b[k, i]
            result[i, 3] -= a_from_b[k, i] * a_from_b[k, 3]
    result[3, 3] = 1.0
    return result


@kernel
def compose(a_from_b: Array, b_from_c: Array) -> Array:
    result = np.zeros((4, 4))
    for i in range(3):
        for k in range(4):
            result[i, k] = (
                a_from_b[i, 0] * b_from_c[0, k] + a_from_b[i, 1] * b_from_c[1, k] + a_from_b[i, 2] * b_from_c[2, k]
            )
        result[i, 3] += a_from_b[i, 3]
    result[3, 3] = 1.0
    return result


@kernel
def transform_covariance(matrix: Array, cov: Array) -> Array:
    """Returns matrix @ cov @ matrix.T (6, 6), exactly symmetric, for a matrix (6, 6) and a symmetric cov (6, 6)."""
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


@kernel
def product(a: Array, b: Array) -> Array:
    """Returns the product (n, k) of small matrices (n, m) and (m, k), without BLAS."""
    result = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(b.shape[1]):
            for m in range(a.shape[1]):
                result[i, k] += a[i, m] * b[m, k]
    return result


def nearest_rigid(matrices: Array) -> Array:
    """Returns the nearest rigid motions (..., 4, 4) of matrices with rounding errors, such as long products."""
    return _nearest_rigid(np.ascontiguousarray(matrices).reshape(-1, 4, 4)).reshape(matrices.shape)


@kernel
def _nearest_rigid(matrices):
    """Kernel of `nearest_rigid`: Newton's iteration R <- (R + R^-T) / 2 (Higham 1986)."""
    result = matrices.copy()
    for motion in result:
        change = np.inf
        while change > 1e-12:  # convergence is quadratic
            a, b, c = motion[0, :3], motion[1, :3], motion[2, :3]
            cofactors = np.stack((np.cross(b, c), np.cross(c, a), np.cross(a, b)))
            step = 0.5 * (cofactors / np.sum(a * cofactors[0]) - motion[:3, :3])
            copy_into(motion[:3, :3], motion[:3, :3] + step)
            change = np.abs(step).max()
    return result


@kernel
def so3_exp(w: Array) -> Array:
    """Returns the rotation matrix (3, 3) of a rotation vector (3,) [rad] by Rodrigues' formula."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-4:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    return _skew_polynomial(w, a, b)


@kernel
def _left_jacobian(w: Array) -> Array:
    """Returns the left Jacobian (3, 3) of SO(3) at a rotation vector (3,); `exp` multiplies the translation by it."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-3:
        a, b = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        a, b = (1.0 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    return _skew_polynomial(w, a, b)


@kernel
def _skew_polynomial(w: Array, a: float, b: float) -> Array:
    """Returns I + a K + b K^2 (3, 3) with K = skew(w) and K^2 = w w' - |w|^2 I."""
    x, y, z = w[0], w[1], w[2]
    angle2 = x * x + y * y + z * z
    result = np.empty((3, 3))
    result[0, 0], result[1, 1] = 1.0 + b * (x * x - angle2), 1.0 + b * (y * y - angle2)
    result[2, 2] = 1.0 + b * (z * z - angle2)
    result[0, 1], result[1, 0] = b * x * y - a * z, b * x * y + a * z
    result[0, 2], result[2, 0] = b * x * z + a * y, b * x * z - a * y
    result[1, 2], result[2, 1] = b * y * z - a * x, b * y * z + a * x
    return result


@kernel
def so3_log(rotation: Array) -> Array:
    """Returns the rotation vector (3,) [rad] of a rotation matrix (3, 3), with an angle in [0, pi]."""
    w = np.empty(3)
    w[0], w[1], w[2] = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    sine = 0.5 * np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    cosine = 0.5 * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1.0)
    if cosine < -0.9:  # near an angle of pi, w vanishes: the axis follows from the symmetric part
        i = 0
        for k in range(1, 3):
            if rotation[k, k] > rotation[i, i]:
                i = k
        axis = np.zeros(3)
        for k in range(3):
            axis[k] = 0.5 * (rotation[i, k] + rotation[k, i]) - (cosine if k == i else 0.0)
        length = np.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
        same_sign = axis[0] * w[0] + axis[1] * w[1] + axis[2] * w[2] >= 0
        return axis * ((1.0 if same_sign else -1.0) * np.arctan2(sine, cosine) / length)
    scale = 0.5 if sine < 1e-8 else 0.5 * np.arctan2(sine, cosine) / sine
    for k in range(3):
        w[k] *= scale
    return w


@kernel
def exp(motion: Array) -> Array:
    """Returns the pose (4, 4) that a constant twist (6,) [rotation, translation] (rad, m) reaches in unit time."""
    w, result = motion[:3], np.zeros((4, 4))
    jacobian = _left_jacobian(w)
    copy_into(result[:3, :3], so3_exp(w))
    for i in range(3):
        for k in range(3):
            result[i, 3] += jacobian[i, k] * motion[3 + k]
    result[3, 3] = 1.0
    return result


@kernel
def log(a_from_b: Array) -> Array:
    """Returns the twist (6,) [rotation, translation] (rad, m) of a pose (4, 4), the inverse of `exp`."""
    w, result = so3_log(a_from_b[:3, :3]), np.zeros(6)
    c, _ = _inverse_jacobian_coefficient(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    inverse_jacobian = _skew_polynomial(w, -0.5, c)
    for i in range(3):
        result[i] = w[i]
        for k in range(3):
            result[3 + i] += inverse_jacobian[i, k] * a_from_b[k, 3]
    return result


@kernel
def log_derivative(motion: Array) -> Array:
    """Returns the inverse right Jacobian J (6, 6) of SE(3) at a motion (6,): log(exp(motion) exp(d)) ~ motion + J d.

    For [w, v] and K = skew(w), the diagonal blocks are I + K / 2 + c K^2, the lower left block their derivative with
    respect to w in the direction v (Selig 2005).
    """
    w, v, result = motion[:3], motion[3:], np.zeros((6, 6))
    c, slope = _inverse_jacobian_coefficient(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    along = w[0] * v[0] + w[1] * v[1] + w[2] * v[2]
    rotation_block = _skew_polynomial(w, 0.5, c)
    square = _skew_polynomial(w, 0.0, 2.0 * slope * along)
    coupling = 0.5 * skew(v)
    for i in range(3):
        for k in range(3):
            coupling[i, k] += c * (v[i] * w[k] + w[i] * v[k]) + square[i, k]
        coupling[i, i] -= 2.0 * c * along + 1.0
    copy_into(result[:3, :3], rotation_block)
    copy_into(result[3:, 3:], rotation_block)
    copy_into(result[3:, :3], coupling)
    return result


@kernel
def _inverse_jacobian_coefficient(angle2: float) -> tuple[float, float]:
    """Returns c = 1 / a^2 - cot(a / 2) / (2 a) and dc/d(a^2), given the squared rotation angle a^2 [rad^2]."""
    if angle2 < 1e-2:
        return (
            1 / 12 + angle2 * (1 / 720 + angle2 * (1 / 30240 + angle2 / 1209600)),
            1 / 720 + angle2 * (1 / 15120 + angle2 / 403200),
        )
    angle = np.sqrt(angle2)
    cot, sine = 1.0 / np.tan(angle / 2.0), np.sin(angle / 2.0)
    slope = 1.0 / (8.0 * angle2 * sine * sine) + cot / (4.0 * angle2 * angle) - 1.0 / (angle2 * angle2)
    return 1.0 / angle2 - cot / (2.0 * angle), slope


@kernel
def adjoint(a_from_b: Array) -> Array:
    """Returns the adjoint Ad (6, 6) of a pose: a_from_b exp(m) = exp(Ad m) a_from_b for a twist m (6,) in frame b."""
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
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


@kernel
def transport_covariance(cov: Array, a_from_b: Array) -> Array:
    """Returns the covariance (6, 6) of the pose of frame b, in its axes, given that of a frame a rigidly attached."""
    return transform_covariance(adjoint(inverse(a_from_b)), cov)


@kernel
def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Returns the rotation world_from_body (3, 3) of angles [rad]: yaw about z, pitch about y', roll about x''."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


@kernel
def rpy_from_rotation(rotation: Array) -> Array:
    """Returns roll, pitch, yaw (3,) [rad], the inverse of `rotation_from_rpy`; roll is zero at a pitch of +-90 deg."""
    horizontal = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], horizontal)
    if horizontal < 1e-12:
        return np.array([0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


@kernel
def wrap_angle(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def quaternion_wxyz(rotation: Array) -> Array:
    return quaternion_xyzw(rotation)[[3, 0, 1, 2]]


def rotation_from_wxyz(quaternion: Array) -> Array:
    from scipy.spatial.transform import Rotation  # takes 0.15 s and 20 MB to import, and most surveys do not need it

    return Rotation.from_quat(np.asarray(quaternion)[..., [1, 2, 3, 0]]).as_matrix()


def quaternion_xyzw(rotation: Array) -> Array:
    return quaternions_xyzw(np.asarray(rotation, np.float64)[None])[0]


@kernel
def quaternions_xyzw(rotations: Array) -> Array:
    """Returns the quaternions [x, y, z, w] (n, 4) of rotations (n, 3, 3), w >= 0 (Shepperd 1978)."""
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
    """Returns the heading of the bow (...) [rad, counter-clockwise from east] of down-looking cameras (..., 4, 4)."""
    forward = -world_from_camera[..., :3, 1]  # the top of the image
    return np.arctan2(forward[..., 1], forward[..., 0])


def rotations_of_down_camera(yaw: Array) -> Array:
    """Returns world_from_camera rotations (..., 3, 3) of level cameras that look down, with the bow at `yaw` (...)."""
    c, s = np.cos(yaw), np.sin(yaw)
    zero, one = np.zeros_like(c), np.ones_like(c)
    world_from_body = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(*np.shape(c), 3, 3)
    return world_from_body @ BODY_FROM_DOWN_CAMERA
