"""Estimation of camera motion: from flow with known depth, or jointly with the structure from two stereo pairs.

A motion is the pose of the later camera in the earlier one, or its twist [w, t] (rad, m). Coordinates are normalised as
in `observation_equations`. Equation numbers are those of Negahdaripour & Madjidi 2003.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.estimate.vision.observation_equations import (
    PairMeasurements,
    adjust_structure,
    image_jacobian,
    linearise,
    motion_normal_equations,
    normal_equations,
)

_HUBER = 1.5
_MIN_POINTS = 12
_MEDIAN_NORMALISED = {2: 0.680, 3: 0.888}  # sqrt(median of chi2 / 3) by degrees of freedom


class Motion(NamedTuple):
    """An estimated motion.

    Args:
        a_from_b: (4, 4) pose of the later camera b in the earlier camera a.
        cov: (6, 6) covariance of the motion [rotation, translation], in the axes of b (rad, m).
        n_points: number of inliers.
        residual: robust standard deviation of the residuals: in normalised coordinates (`frame_motion`), or divided by
            its expected value (`pair_motion`).
        closed_form: (4, 4) closed-form motion (Negahdaripour & Madjidi 2003, eq. 2) that the estimate started from;
            None if it started from another motion.
    """

    a_from_b: Array
    cov: Array
    n_points: int
    residual: float
    closed_form: Array | None = None


class PairMotionSettings(NamedTuple):
    """Stochastic model and number of iterations of `pair_motion`.

    Args:
        common_sigma: standard deviation of a bias that all points share in each of x, y and disparity, normalised. Its
            effect does not average out over the points.
        variance_inflation: factor on the covariance for correlated points (`matching.variance_inflation`).
        n_measured: number of coordinates measured per point in pair a: 3, or 2 if the disparity in a is unknown and has
            a large variance in `cov_a`.
        iterations: number of Gauss-Newton iterations.
    """

    common_sigma: float = 0.0
    variance_inflation: float = 1.0
    n_measured: int = 3
    iterations: int = 6


_DEFAULT_SETTINGS = PairMotionSettings()


def closed_form_motion(x: Array, y: Array, depth: Array, flow: Array, weight: Array) -> tuple[Array, Array]:
    """Returns the weighted least-squares twist from flow and depth (Negahdaripour & Madjidi 2003, eq. 2).

    Args:
        x, y: (n,) normalised image coordinates.
        depth: (n,) depth [m].
        flow: (n, 2) displacement of the normalised coordinates.
        weight: (n,) weights of the points.

    Returns:
        Twist (6,) and normal matrix (6, 6).
    """
    normal, right = normal_equations(image_jacobian(x, y, depth), weight, flow)
    return np.asarray(np.linalg.solve(normal, right), np.float64), normal


def frame_motion(points: Array, observed: Array, guess: Array, iterations: int = 4) -> Motion | None:
    """Estimates the motion from 3-D points in one camera and their image positions in the next frame.

    Iterates eq. (2) of Negahdaripour & Madjidi 2003 with Huber weights.

    Args:
        points: (n, 3) positions in the earlier camera [m].
        observed: (n, 2) normalised coordinates in the later image.
        guess: (4, 4) initial pose of the later camera in the earlier one.
        iterations: number of Gauss-Newton iterations.

    Returns:
        The motion, or None if there are too few inliers or a point is behind the later camera.
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
        length = np.linalg.norm(residual, axis=1)
        sigma = max(float(np.median(length)) / 1.1774, 1e-7)  # median of a Rayleigh distribution
        weight = _huber_weights(length, sigma, cutoff=5.0)
        twist, normal = closed_form_motion(x, y, xyz[:, 2], residual, weight)
        a_from_b = a_from_b @ geometry.exp(twist)
    n_points = int(np.count_nonzero(weight))
    cov = np.asarray(np.linalg.inv(normal) * sigma**2, np.float64)
    return None if n_points < _MIN_POINTS else Motion(a_from_b, cov, n_points, sigma)


def exact_depth_motion(a: Array, b: Array, baseline_m: float, guess: Array) -> Array | None:
    """Estimates the motion between two stereo pairs with the depth from the later pair b taken as exact.

    This is the closed form of Negahdaripour & Madjidi 2003 (eq. 2), iterated with Huber weights. It is fast, but
    depth errors bias the estimate; the disparity in the earlier pair a is not used.

    Args:
        a, b: (n, 3) normalised (x, y, disparity) of the same points in the earlier and the later pair.
        baseline_m: baseline of the rig.
        guess: (4, 4) initial pose of b in a.

    Returns:
        (4, 4) pose of b in a, or None if there are too few inliers or a point is behind camera a.
    """
    points = np.column_stack([b[:, :2], np.ones(len(b))]) * baseline_m / b[:, 2:]
    motion = frame_motion(points, a[:, :2], geometry.inverse(guess))
    return None if motion is None else geometry.inverse(motion.a_from_b)


def _huber_weights(size: Array, sigma: float, cutoff: float) -> Array:
    """Returns Huber weights (n,) of residuals of these magnitudes (n,); zero beyond `cutoff` standard deviations."""
    return np.minimum(1.0, _HUBER * sigma / np.maximum(size, 1e-12)) * (size < cutoff * sigma)


def pair_motion(
    measured: PairMeasurements, baseline_m: float, guess: Array, settings: PairMotionSettings = _DEFAULT_SETTINGS
) -> Motion | None:
    """Estimates the motion between two stereo pairs jointly with the structure, which avoids errors-in-variables bias.

    Both pairs measure each point as z = (x, y, disparity); the true point in b is unknown. With e = z_a - g(z_b),
    G = dg/dz_b and A = dg/dmotion, the structure is eliminated: the cost is e' (C_a + G C_b G')^-1 e, linearised at the
    adjusted structure (mixed adjustment model, Mikhail 1976, as in eqs. 6 and 7 of Negahdaripour & Madjidi 2003).
    Residuals have Huber weights.

    Args:
        measured: points in the earlier pair a and the later pair b.
        baseline_m: baseline of the rig.
        guess: (4, 4) initial pose of b in a.
        settings: stochastic model and number of iterations.

    Returns:
        The motion, with its residual relative to the expected standard deviation (1 = as expected), or None if there
        are too few inliers.
    """
    n = len(measured.a)
    if n < _MIN_POINTS:
        return None
    a_from_b, structure = guess, measured.b.copy()
    weight, normal, bias_root, scale = np.zeros(n), np.eye(6), np.zeros((6, 3)), 1.0
    for _ in range(settings.iterations):
        observations = linearise(measured, structure, a_from_b, baseline_m)
        size = observations.normalised_residual
        scale = max(float(np.median(size)) / _MEDIAN_NORMALISED[settings.n_measured], 1e-3)
        weight = _huber_weights(size, scale, cutoff=4.0)
        normal, right, bias_jacobian = motion_normal_equations(observations, weight)
        twist = np.asarray(np.linalg.solve(normal, right), np.float64)
        bias_root = np.linalg.solve(normal, bias_jacobian) * settings.common_sigma
        structure = adjust_structure(observations, measured, twist)
        a_from_b = a_from_b @ geometry.exp(twist)
    n_points = int(np.count_nonzero(weight))
    noise_cov = np.linalg.inv(normal) * max(scale, 0.3) ** 2 * settings.variance_inflation
    cov = np.asarray(noise_cov + bias_root @ bias_root.T, np.float64)
    return None if n_points < _MIN_POINTS else Motion(a_from_b, cov, n_points, scale)
