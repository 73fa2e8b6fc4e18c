"""Camera motion from image motion: eqs. (1) and (2), and structure and motion together from two stereo pairs.

A motion is the pose of the later camera in the earlier one, or its twist [w, t] (rad, m); coordinates are normalised as
in `observation`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.estimate.vision.observation_equations import (
    adjust_structure,
    image_motion,
    linearise,
    normal_equations,
    weighted_normal_equations,
)

_HUBER = 1.5
_MIN_POINTS = 12
_MEDIAN_SIZE = {2: 0.680, 3: 0.888}  # roots of the median of chi2 with so many degrees of freedom, over 3


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


def closed_form_motion(x: Array, y: Array, depth: Array, flow: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares for [w, t] from flow (n, 2) and depth (n,), eq. (2). -> twist (6,), normal (6, 6)."""
    normal, right = normal_equations(image_motion(x, y, depth), weight, flow)
    return np.asarray(np.linalg.solve(normal, right), np.float64), normal


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
    told: int = 3,
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
        told: how many of its three numbers a tells of a point; the variance of others in `cov_a` is large.

    Returns:
        The motion, its residual in units of the expected deviation (1 = as expected), or None when too few agree.
    """
    if len(a) < _MIN_POINTS:
        return None
    a_from_b, structure = guess, b.copy()
    weight, normal, by_bias, scale = np.zeros(len(a)), np.eye(6), np.zeros((6, 3)), 1.0
    for _ in range(iterations):
        seen = linearise(a, b, structure, cov_a, cov_b, a_from_b, baseline_m)
        scale = max(float(np.median(seen.size)) / _MEDIAN_SIZE[told], 1e-3)
        weight = _huber(seen.size, scale, cut=4.0)
        normal, right, by_common = weighted_normal_equations(seen, weight)
        twist = np.asarray(np.linalg.solve(normal, right), np.float64)
        by_bias = np.linalg.solve(normal, by_common) * common_sigma
        structure = adjust_structure(seen, b, cov_b, twist)
        a_from_b = a_from_b @ geometry.exp(twist)
    n_points = int(np.count_nonzero(weight))
    cov = np.asarray(np.linalg.inv(normal) * max(scale, 0.3) ** 2 * correlation + by_bias @ by_bias.T, np.float64)
    return None if n_points < _MIN_POINTS else Motion(a_from_b, cov, n_points, scale)
