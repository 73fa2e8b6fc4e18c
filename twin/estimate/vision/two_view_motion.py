"""Estimation of camera motion: from flow with known depth, or jointly with the structure from two stereo pairs.

A motion is the pose of the later camera in the earlier one, or its twist [w, t] (rad, m). Coordinates are normalised as
in `observation_equations`. Equation numbers are those of Negahdaripour & Madjidi 2003.
"""

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import DisparityOffset, DistortionError, YawEffect
from twin.estimate.vision.image_errors import change_by_distortion, image_errors
from twin.estimate.vision.observation_equations import (
    LinearisedObservations,
    PairMeasurements,
    PixelLocking,
    adjust_structure,
    change_by_yaw,
    image_jacobian,
    linearise,
    motion_normal_equations,
    normal_equations,
    transfer,
)
from twin.kernels import kernel

HUBER = 1.5
#: Prior standard deviation of the amplitude of pixel locking (`patches.locking_shifts`) [px]: the root mean square of
#: 0.010, 0.006, 0.004 and 0, as measured against the truth over two generated reefs, a flat floor and gravel.
_LOCKING_SIGMA_PX = 0.006
MAX_LOCKING_PX = 3 * _LOCKING_SIGMA_PX  #: largest plausible estimate of the amplitude
_MIN_POINTS = 12
_ITERATIONS = 6  # most Gauss-Newton iterations of `pair_motion`
_CONVERGED = 1e-2  # the iteration ends after a step smaller than this many standard deviations
_CLOSED_FORMS = 4  # iterations of `exact_depth_motion`
CUTOFF = 4.0  # residuals of `pair_motion` beyond this many standard deviations have zero weight
_PRIOR_POINTS = 50  # weight of the expected covariance of the scores in `_scatter_cov`, as a number of points
_MIN_SCALE = 0.3  # smallest factor on reported standard deviations, for noise-free data
_NORMALISED_MEDIANS = 0.680, 0.888  # sqrt(median of chi2 / 3) for 2 and 3 degrees of freedom
_NO_LOCKING = PixelLocking(np.zeros((0, 3)), np.zeros((0, 3)))


class Motion(NamedTuple):
    """An estimated motion."""

    a_from_b: Array  #: (4, 4) pose of the later camera b in the earlier camera a
    cov: Array  #: (6, 6) covariance of the motion [rotation, translation] (rad, m), in the axes of b
    n_points: int  #: number of inliers
    #: robust standard deviation of the residuals, divided by its expected value (`pair_motion`) or in grey levels
    #: (`mosaic`); infinite for a predicted motion.
    residual: float
    closed_form: Array | None = None  #: (4, 4) motion by eq. 2 from which the estimation started, if it did
    disparity_offset: DisparityOffset | None = None  #: offset of all disparities, if it is estimated (`pair_motion`)
    yaw: YawEffect | None = None  #: yaw between the cameras, as `disparity_offset`
    distortion: DistortionError | None = None  #: error of k1, estimated together with the yaw
    #: (6, 18) correction of the motion by the coefficients of `image_errors` (rad, m), as `yaw.by_yaw`.
    by_image_errors: Array | None = None


class PairMotionSettings(NamedTuple):
    """Stochastic model of `pair_motion`."""

    #: standard deviation of the biases of x, y and disparity, each of which is the same at all points; normalised.
    common_sigma: float = 0.0
    variance_inflation: float = 1.0  #: factor on the covariance for correlated points (`matching.variance_inflation`)
    n_measured: int = 3  #: coordinates measured in pair a: 3, or 2 if its disparity is unknown, of large variance
    #: with this, the amplitude of pixel locking is estimated together with the motion.
    locking: PixelLocking | None = None
    half_size: Array | None = None  #: that of `image_errors`; with it, their effect is computed


_DEFAULT_SETTINGS = PairMotionSettings()


def closed_form_motion(x: Array, y: Array, depth: Array, flow: Array, weight: Array) -> Array:
    """Returns the weighted least-squares twist (6,) of the camera from flow (n, 2) and depth (n,), eq. (2)."""
    normal, right = normal_equations(image_jacobian(x, y, depth), weight, flow)
    return np.asarray(np.linalg.solve(normal, right), np.float64)


def exact_depth_motion(a: Array, b: Array, baseline_m: float, guess: Array) -> Array | None:
    """Returns the pose (4, 4) of the later stereo pair b in the earlier one a, taking the depth from b as exact.

    Iterates the closed form, eq. (2), from `guess` (4, 4), with Huber weights that are 0 beyond five standard
    deviations. Depth errors bias the estimate. Points (n, 3) are normalised (x, y, disparity); the disparity in a is
    not used. None if there are too few points or inliers, a point is behind camera a, or the iteration diverges.
    """
    try:
        motion = _iterate_closed_form(a, b, baseline_m, guess)
    except np.linalg.LinAlgError:  # singular normal equations
        return None
    return motion if motion is not None and np.isfinite(motion).all() else None


def _iterate_closed_form(a: Array, b: Array, baseline_m: float, guess: Array) -> Array | None:
    points = np.column_stack([b[:, :2], np.ones(len(b))]) * baseline_m / b[:, 2:]
    b_from_a, weight = geometry.inverse(guess), np.zeros(len(b))
    for _ in range(_CLOSED_FORMS if len(b) >= _MIN_POINTS else 0):
        xyz = geometry.transform(geometry.inverse(b_from_a), points)
        if np.any(xyz[:, 2] <= 0):
            return None
        x, y = xyz[:, 0] / xyz[:, 2], xyz[:, 1] / xyz[:, 2]
        residual = a[:, :2] - np.stack([x, y], axis=1)
        length = np.linalg.norm(residual, axis=1)
        sigma = max(float(np.median(length)) / 1.1774, 1e-7)  # median of a Rayleigh distribution
        weight = _huber_weights(length, sigma, 5.0)
        b_from_a = b_from_a @ geometry.exp(closed_form_motion(x, y, xyz[:, 2], residual, weight))
    return None if np.count_nonzero(weight) < _MIN_POINTS else geometry.inverse(b_from_a)


@kernel
def _huber_weights(size: Array, sigma: float, cutoff: float) -> Array:
    return np.minimum(1.0, HUBER * sigma / np.maximum(size, 1e-12)) * (size < cutoff * sigma)


def pair_motion(
    measured: PairMeasurements, baseline_m: float, guess: Array, settings: PairMotionSettings = _DEFAULT_SETTINGS
) -> Motion | None:
    """Estimates the motion between two stereo pairs jointly with the structure, which avoids errors-in-variables bias.

    Each pair measures z = (x, y, disparity) with covariance C; g transfers a point from b to a. With e = z_a - g(z_b)
    and G = dg/dz_b, the cost of a point is e' (C_a + G C_b G')^-1 e, linearised at the adjusted structure (mixed
    adjustment model, Mikhail 1976; eqs. 6 and 7 of Negahdaripour & Madjidi 2003), with Huber weights that are 0 beyond
    `CUTOFF`. `guess` (4, 4) is the initial pose of b in a.

    If the amplitude of pixel locking is not plausible (`MAX_LOCKING_PX`), as over a level floor where all points have
    nearly the same sub-pixel position, the motion is estimated without it. None if too few points or inliers, or if the
    iteration diverges, as it may if most points are wrong.
    """
    if len(measured.a) < _MIN_POINTS:
        return None
    try:
        motion = _adjust_pair(measured, baseline_m, guess, settings)
    except np.linalg.LinAlgError:  # singular normal equations
        return None
    if motion is None or not (np.isfinite(motion.a_from_b).all() and np.isfinite(motion.cov).all()):
        return None
    return motion


def _adjust_pair(
    measured: PairMeasurements, baseline_m: float, guess: Array, settings: PairMotionSettings
) -> Motion | None:
    """Returns the motion of `pair_motion`, which is not finite if the Gauss-Newton iteration diverges."""
    measured = PairMeasurements(*map(np.ascontiguousarray, measured))
    locking = PixelLocking(*map(np.ascontiguousarray, settings.locking or _NO_LOCKING))
    a_from_b, amplitude_px, structure, found = _iterate(
        measured, locking, guess.copy(), baseline_m, settings.n_measured
    )
    normals = _WeightedNormals(*found)
    if abs(amplitude_px) > MAX_LOCKING_PX:
        return _adjust_pair(measured, baseline_m, guess, settings._replace(locking=None))
    if np.count_nonzero(normals.weight) < _MIN_POINTS:
        return None
    motion = Motion(a_from_b, _pair_cov(normals, settings), int(np.count_nonzero(normals.weight)), normals.scale)
    if settings.n_measured < 3:
        return motion
    return motion._replace(
        disparity_offset=_disparity_offset(normals, settings),
        yaw=_yaw(normals, measured, settings),
        distortion=_distortion(normals, transfer(structure, a_from_b, baseline_m)[0], structure, settings),
        by_image_errors=_by_image_errors(normals, measured, settings),
    )


class _WeightedNormals(NamedTuple):
    """Normal equations of `pair_motion` at one iteration, for p unknowns."""

    observations: LinearisedObservations  #: linearised observations of n points
    weight: Array  #: (n,) robust weights
    scale: float  #: robust standard deviation of the residuals, divided by the expected one
    normal: Array  #: (p, p) normal matrix, `prior` included
    prior: Array  #: (p, p) prior information
    right: Array  #: (p,) right-hand side
    bias_jacobian: Array  #: (p, 3) derivative of `right` with respect to the common biases of x, y and disparity


@kernel
def _iterate(measured, locking, guess, baseline_m, n_measured):
    """Returns motion, amplitude of locking [px], structure, and `_WeightedNormals` before the last step."""
    a_from_b, amplitude_px, structure = guess, 0.0, measured.b
    for _ in range(_ITERATIONS):
        observations = linearise(measured, structure, a_from_b, baseline_m)
        if len(locking.a):
            observations = _with_locking(observations, locking, amplitude_px)
        normals = _weighted_normals(observations, amplitude_px, n_measured)
        update = np.linalg.solve(normals.normal, normals.right)
        structure = adjust_structure(observations, measured, update)
        a_from_b = geometry.compose(a_from_b, geometry.exp(update[:6]))  # pyright: ignore[reportArgumentType]
        amplitude_px += np.sum(update[6:])
        if np.sum(update * (normals.normal @ update)) < (_CONVERGED * normals.scale) ** 2:
            break
    return a_from_b, amplitude_px, structure, normals  # pyright: ignore[reportPossiblyUnboundVariable]


@kernel
def _with_locking(observations, locking, amplitude_px):
    """Returns the observations with pixel locking as seventh unknown, linearised and reduced at `amplitude_px`."""
    residual, n = observations.residual, len(locking.a)
    jacobian, size = np.empty((n, 3, 7)), np.empty(n)
    for i in range(n):
        for r in range(3):
            jacobian[i, r, :6] = observations.jacobian_motion[i, r]
            jacobian[i, r, 6] = locking.a[i, r]  # derivative of the predicted measurements by the amplitude
            for c in range(3):
                jacobian[i, r, 6] -= observations.jacobian_point[i, r, c] * locking.b[i, c]
            residual[i, r] -= jacobian[i, r, 6] * amplitude_px
        size[i] = np.sqrt(np.sum(residual[i] * (observations.information[i] @ residual[i])) / 3)
    return LinearisedObservations(residual, observations.jacobian_point, jacobian, observations.information, size)


@kernel
def _weighted_normals(observations, amplitude_px, n_measured):
    size = observations.normalised_residual
    scale = max(np.median(size) / _NORMALISED_MEDIANS[n_measured - 2], 1e-3)
    weight = _huber_weights(size, scale, CUTOFF)
    normal, right, bias_jacobian = motion_normal_equations(observations, weight)
    prior = np.zeros_like(normal)
    if len(normal) > 6:
        prior[6, 6] = (scale / _LOCKING_SIGMA_PX) ** 2  # weights are relative to residuals of variance scale^2
        right[6] -= prior[6, 6] * amplitude_px
    return _WeightedNormals(observations, weight, scale, normal + prior, prior, right, bias_jacobian)


def _pair_cov(normals: _WeightedNormals, settings: PairMotionSettings) -> Array:
    """Returns the covariance (6, 6) of the motion due to the noise of the points and to their common biases."""
    bias_root = np.linalg.solve(normals.normal, normals.bias_jacobian) * settings.common_sigma
    cov = _scatter_cov(normals, settings.n_measured) * settings.variance_inflation + bias_root @ bias_root.T
    return np.asarray(cov[:6, :6], np.float64)


def _disparity_offset(normals: _WeightedNormals, settings: PairMotionSettings) -> DisparityOffset | None:
    """Returns the offset of all disparities [focal lengths], an additional unknown of the last Gauss-Newton step."""
    # the derivative of the residual z_a - g(z_b) by an offset of both disparities is u - G u, with u the unit vector
    # along the disparity; None if the offset is not observable
    by_offset = np.array([0.0, 0.0, 1.0]) - normals.observations.jacobian_point[:, :, 2]
    found = _additional_unknown(normals, by_offset, settings)
    return None if found is None else DisparityOffset(*found[:2])


def _yaw(normals: _WeightedNormals, measured: PairMeasurements, settings: PairMotionSettings) -> YawEffect | None:
    """Returns the yaw of the right camera, as `_disparity_offset`, and its effect on the motion."""
    # the derivative is e_a - G e_b, with e of `change_by_yaw`
    moved = np.einsum("nij,nj->ni", normals.observations.jacobian_point, change_by_yaw(measured.b))
    found = _additional_unknown(normals, change_by_yaw(measured.a) - moved, settings)
    return None if found is None else YawEffect(*found)


def _distortion(
    normals: _WeightedNormals, points_a: Array, points_b: Array, settings: PairMotionSettings
) -> DistortionError | None:
    """Returns the error of k1, estimated with the yaw, which changes points at one depth in nearly the same way."""
    # derivatives at the adjusted points (n, 3): the noise of measured ones is correlated with the residuals, so that k1
    # was too large by 0.01 for a noise of 0.05 px, and grew with its square
    observations = normals.observations
    a, b = (np.stack([change_by_distortion(z), change_by_yaw(z)], axis=2) for z in (points_a, points_b))
    derivative = a - observations.jacobian_point @ b
    weighted = normals.weight[:, None, None] * (observations.information @ derivative)
    coupling = np.einsum("nrp,nrk->pk", observations.jacobian_motion, weighted)
    by_unknowns = np.linalg.solve(normals.normal, coupling)
    information = np.einsum("nrk,nrl->kl", derivative, weighted)
    remaining = information - coupling.T @ by_unknowns  # after elimination of the motion
    if np.any(np.linalg.eigvalsh(remaining) <= 0):
        return None
    cov = np.linalg.inv(remaining)
    score = np.einsum("nrk,nr->k", weighted, observations.residual) - by_unknowns.T @ normals.right
    variance = max(normals.scale, _MIN_SCALE) ** 2 * settings.variance_inflation * cov[0, 0]
    return DistortionError(float(cov[0] @ score), float(variance**0.5))


def _by_image_errors(
    normals: _WeightedNormals, measured: PairMeasurements, settings: PairMotionSettings
) -> Array | None:
    if settings.half_size is None:
        return None
    observations = normals.observations
    a, b = (image_errors(points, settings.half_size) for points in (measured.a, measured.b))
    weighted = normals.weight[:, None, None] * (observations.information @ (a - observations.jacobian_point @ b))
    coupling = np.einsum("nrp,nrk->pk", observations.jacobian_motion, weighted)
    return -np.linalg.solve(normals.normal, coupling)[:6]


def _additional_unknown(
    normals: _WeightedNormals, derivative: Array, settings: PairMotionSettings
) -> tuple[float, float, Array] | None:
    """Returns an unknown by its `derivative` (n, 3) of residuals, its sigma, and the motion (6,) per unit; or None."""
    observations, weight = normals.observations, normals.weight
    weighted = weight[:, None] * np.einsum("nrc,nr->nc", observations.information, derivative)
    coupling = np.einsum("nc,ncp->p", weighted, observations.jacobian_motion)
    information = float(np.sum(weighted * derivative))
    score = float(np.sum(weighted * observations.residual))
    by_unknowns = np.linalg.solve(normals.normal, coupling)
    remaining = information - float(coupling @ by_unknowns)  # after elimination of the other unknowns
    if remaining <= 1e-9 * information:
        return None
    variance = max(normals.scale, _MIN_SCALE) ** 2 * settings.variance_inflation / remaining
    return (score - float(by_unknowns @ normals.right)) / remaining, variance**0.5, -by_unknowns[:6]


@kernel
def _scatter_cov(normals, n_measured):
    """Returns the covariance (p, p) of the unknowns from the residuals of the individual points.

    Sandwich covariance of an M-estimator, M^-1 S M^-1 (Huber & Ronchetti 2009, section 7.6; White 1980). S sums the
    outer products of the scores w J' C^-1 e and so includes errors that C does not (relief, occlusions). M is the
    normal matrix times the mean derivative of the Huber function, (k - 1) / k in its linear part for k measured
    coordinates. S is scaled by k n / (k n - p) and averaged with its expectation for C times a common factor, which
    counts as 50 points. Prior information is added to M and, times the squared scale, to S.
    """
    observations, weight, scale = normals.observations, normals.weight, normals.scale
    size, n, p = observations.normalised_residual, np.count_nonzero(weight), len(normals.normal)
    information, scores = normals.normal - normals.prior, np.zeros((len(weight), p))
    for i in range(len(weight)):
        for r in range(3):
            weighted = 0.0
            for c in range(3):
                weighted += weight[i] * observations.information[i, r, c] * observations.residual[i, c]
            for k in range(p):
                scores[i, k] += observations.jacobian_motion[i, r, k] * weighted
    freedom = n_measured * n / max(n_measured * n - p, 1)
    mean_square = np.sum((weight * size) ** 2) / np.sum(weight)  # expected: n_measured / 3
    variance = max(mean_square * 3 / n_measured, _MIN_SCALE**2)
    scatter = freedom * (n * (scores.T @ scores) + _PRIOR_POINTS * variance * information) / (n + _PRIOR_POINTS)
    core = size < HUBER * scale
    efficiency = np.sum(weight * np.where(core, 1.0, 1 - 1 / n_measured)) / np.sum(weight)
    bread = np.linalg.inv(information * efficiency + normals.prior)
    return bread @ (scatter + normals.prior * scale**2) @ bread
