"""Camera motion from image motion: eqs. (1) and (2), and structure and motion together from two stereo pairs.

Coordinates are normalised: x = (column - cx) / f, y = (row - cy) / f; disparity likewise: depth = baseline / disparity.
A motion is the pose of the later camera in the earlier one, or its twist [w, t] (rad, m).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin import geometry
from twin.geometry import Array

_HUBER = 1.5
_MIN_POINTS = 12


class Motion(NamedTuple):
    """An estimated motion.

    Args:
        a_from_b: (4, 4) pose of the later camera b in the earlier a.
        cov: (6, 6) of [rotation, translation] in b (rad, m).
        n_points: inliers.
        residual: robust deviation of the residuals, in the units of what was measured.
        closed_form: (4, 4) the motion by eq. (2) that the estimate started from; None without.
    """

    a_from_b: Array
    cov: Array
    n_points: int
    residual: float
    closed_form: Array | None = None


def image_motion(x: Array, y: Array, depth: Array) -> Array:
    """Rows of eq. (1): image velocity per camera twist [w, t] (Negahdaripour & Madjidi 2003). -> (n, 2, 6)"""
    zero, one = np.zeros_like(x), np.ones_like(x)
    rotation_u, rotation_v = [x * y, -(1 + x * x), y], [1 + y * y, -x * y, -x]
    translation_u, translation_v = [-one, zero, x], [zero, -one, y]
    u = np.stack([*rotation_u, *(a / depth for a in translation_u)], axis=-1)
    v = np.stack([*rotation_v, *(a / depth for a in translation_v)], axis=-1)
    return np.stack([u, v], axis=1)


def closed_form_motion(x: Array, y: Array, depth: Array, flow: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares for [w, t] from flow (n, 2) and depth (n,), eq. (2). -> twist (6,), normal (6, 6)."""
    rows = image_motion(x, y, depth)
    weighted = rows * weight[:, None, None]
    normal = np.einsum("nki,nkj->ij", weighted, rows)
    return np.linalg.solve(normal, np.einsum("nki,nk->i", weighted, flow)), normal


def frame_motion(points: Array, observed: Array, guess: Array, iterations: int = 4) -> Motion | None:
    """Motion that carries known points to where the next frame shows them: eq. (2) iterated with Huber weights.

    Args:
        points: (n, 3) in the earlier camera [m].
        observed: (n, 2) normalised coordinates in the later image.
        guess: (4, 4) expected pose of the later camera in the earlier.

    Returns:
        The motion, or None when too few points agree.
    """
    if len(points) < _MIN_POINTS:
        return None
    a_from_b, normal, weight, sigma = guess, np.eye(6), np.zeros(len(points)), 0.0
    for _ in range(iterations):
        xyz = geometry.transform(geometry.inverse(a_from_b), points)
        if np.any(xyz[:, 2] <= 0):
            return None
        x, y = xyz[:, 0] / xyz[:, 2], xyz[:, 1] / xyz[:, 2]
        residual = observed - np.stack([x, y], axis=1)
        size = np.linalg.norm(residual, axis=1)
        sigma = max(float(np.median(size)) / 1.1774, 1e-7)  # median of a Rayleigh distribution
        weight = _huber(size, sigma, cut=5.0)
        twist, normal = closed_form_motion(x, y, xyz[:, 2], residual, weight)
        a_from_b = a_from_b @ geometry.exp(twist)
    n_points = int(np.count_nonzero(weight))
    cov = np.asarray(np.linalg.inv(normal) * sigma**2, np.float64)
    return None if n_points < _MIN_POINTS else Motion(a_from_b, cov, n_points, sigma)


def exact_depth_motion(a: Array, b: Array, baseline_m: float, guess: Array) -> Array | None:
    """Motion between two stereo pairs by eq. (2): depth as b measures it is taken as exact, the disparity of a unused.

    The closed form of P14: quick, and biased by the noise of the depth. Arguments as of `pair_motion`.

    Returns:
        (4, 4) pose of b in a, or None when too few points agree.
    """
    points = np.column_stack([b[:, :2], np.ones(len(b))]) * baseline_m / b[:, 2:]
    found = frame_motion(points, a[:, :2], geometry.inverse(guess))
    return None if found is None else geometry.inverse(found.a_from_b)


def _huber(size: Array, sigma: float, cut: float) -> Array:
    """Huber's weights (n,) of residuals of this size, zero beyond `cut` deviations."""
    return np.minimum(1.0, _HUBER * sigma / np.maximum(size, 1e-12)) * (size < cut * sigma)


def pair_motion(
    a: Array,
    b: Array,
    cov_a: Array,
    cov_b: Array,
    baseline_m: float,
    guess: Array,
    common_sigma: float = 0.0,
    correlation: float = 1.0,
    iterations: int = 6,
) -> Motion | None:
    """Motion between two stereo pairs with the structure estimated along: no errors-in-variables bias.

    Both pairs measure each point as (x, y, disparity); the true point in b is unknown. With residual e = z_a - g(z_b),
    G = dg/dz_b and A = dg/dmotion, the structure is eliminated: minimise e' (C_a + G C_b G')^-1 e, linearised at the
    adjusted structure (the mixed-adjustment model of Mikhail 1976 on which eqs. (6), (7) rest).

    Args:
        a, b: (n, 3) normalised (x, y, disparity) of the same points in the earlier and the later pair.
        cov_a, cov_b: (n, 3, 3) covariance of each, normalised.
        baseline_m: of the rig.
        guess: (4, 4) expected pose of b in a.
        common_sigma: standard deviation of a bias that all points share in each of the three, normalised: it does not
            average out, however many points there are.
        correlation: by how much the points are fewer than they seem.

    Returns:
        The motion, its residual in units of the expected deviation (1 = as expected), or None when too few agree.
    """
    if len(a) < _MIN_POINTS:
        return None
    a_from_b, structure = guess, b.copy()
    weight, normal, by_bias, scale = np.zeros(len(a)), np.eye(6), np.zeros((6, 3)), 1.0
    for _ in range(iterations):
        predicted, by_point, by_motion = transfer(structure, a_from_b, baseline_m)
        error = a - predicted - np.einsum("nij,nj->ni", by_point, b - structure)
        information = np.linalg.inv(cov_a + by_point @ cov_b @ by_point.transpose(0, 2, 1))
        size = np.sqrt(np.einsum("ni,nij,nj->n", error, information, error) / 3)
        scale = max(float(np.median(size)) / 0.888, 1e-3)  # root of the median of chi2 with 3 degrees, over 3
        weight = _huber(size, scale, cut=4.0)
        projected = by_motion.transpose(0, 2, 1) @ information
        normal = np.einsum("n,nij,njk->ik", weight, projected, by_motion)
        twist = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weight, projected, error))
        by_bias = np.linalg.solve(normal, np.einsum("n,nij->ij", weight, projected)) * common_sigma
        left = np.einsum("nij,nj->ni", information, error - by_motion @ twist)
        structure = b + np.einsum("nij,nkj,nk->ni", cov_b, by_point, left)
        structure[:, 2] = np.maximum(structure[:, 2], 1e-4)
        a_from_b = a_from_b @ geometry.exp(twist)
    n_points = int(np.count_nonzero(weight))
    cov = np.asarray(np.linalg.inv(normal) * max(scale, 0.3) ** 2 * correlation + by_bias @ by_bias.T, np.float64)
    return None if n_points < _MIN_POINTS else Motion(a_from_b, cov, n_points, scale)


def transfer(z_b: Array, a_from_b: Array, baseline_m: float) -> tuple[Array, Array, Array]:
    """(x, y, disparity) in a of points measured in b; derivatives by the point (n, 3, 3) and the motion (n, 3, 6)."""
    rotation, translation = a_from_b[:3, :3], a_from_b[:3, 3]
    disparity = z_b[:, 2]
    ray = np.column_stack([z_b[:, :2], np.ones(len(z_b))])
    q = ray @ rotation.T + disparity[:, None] * translation / baseline_m  # the point in a, times disparity / baseline
    top = np.column_stack([q[:, :2], disparity])
    z_a = top / q[:, 2:]
    q_by_point = np.empty((len(z_b), 3, 3))
    q_by_point[:, :, :2] = rotation[:, :2]
    q_by_point[:, :, 2] = translation / baseline_m
    q_by_motion = np.empty((len(z_b), 3, 6))
    for k in range(3):
        q_by_motion[:, :, k] = np.cross(np.eye(3)[k], ray) @ rotation.T
        q_by_motion[:, :, 3 + k] = disparity[:, None] * rotation[:, k] / baseline_m
    by_point = _quotient(q_by_point, z_a, q[:, 2], np.array([0.0, 0.0, 1.0]))
    by_motion = _quotient(q_by_motion, z_a, q[:, 2], np.zeros(6))
    return z_a, by_point, by_motion


def _quotient(q_by: Array, z_a: Array, q3: Array, disparity_by: Array) -> Array:
    """Derivative of (q1, q2, disparity) / q3 from that of q (n, 3, m) and of the disparity (m,)."""
    top_by = q_by.copy()
    top_by[:, 2] = disparity_by
    return (top_by - z_a[:, :, None] * q_by[:, 2:3]) / q3[:, None, None]
