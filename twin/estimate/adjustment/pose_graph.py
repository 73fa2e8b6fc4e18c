"""Factor graph of poses and its maximum-likelihood solution, the core of the global alignment.

The cost F is the sum of rho(r) over the binary and of r^2 / 2 over the unary factors, with r the norm of a whitened
residual, log(Z_ij^-1 X_i^-1 X_j) for a measured motion Z_ij, and rho either r^2 / 2 or Huber's loss. It is minimised by
Gauss-Newton, with Levenberg-Marquardt damping after a step that increased F; X exp(d) replaces X.

Parameters with a Gaussian prior may be shared by binary factors (scale error of the DVL, errors of the calibration).
They add rows and columns, the border, to the normal equations, which the Schur complement of the block of the poses
solves.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link, Links, symmetric_inverses
from twin.estimate.adjustment import block_cholesky, elimination
from twin.estimate.adjustment.elimination import Indices
from twin.kernels import kernel

#: A step that increases the cost by more than this is rejected. The iteration ends when the decrease of the cost by an
#: undamped step agrees with the prediction of the linear model to this tolerance. The next step could then decrease the
#: cost by about this amount, and would move no pose by more than 0.05 of its standard deviation.
_COST_TOLERANCE = 5e-4
_INITIAL_DAMPING, _MIN_DAMPING = 1e-4, 1e-6  # relative to the diagonal
_BATCH = 4096  # number of binary factors whose Jacobians are in memory at the same time


class UnaryFactors(NamedTuple):
    """Factors of one kind that each constrain one pose."""

    pose_index: Indices  #: (m,) index of the constrained pose
    information: Array  #: (m, d, d) information matrices
    residuals: Callable[[Array], Array]  #: function of the poses (m, 4, 4) that returns residuals (m, d)
    #: function of poses and residuals that returns the Jacobians (m, d, 6) with respect to the increment of the pose.
    jacobians: Callable[[Array, Array], Array]


#: Function of the relative poses i_from_j (m, 4, 4) of a slice of the links, and of this slice. It returns the
#: derivatives (m, 6, k) of the measured motions with respect to the shared parameters, in the axes of camera j, and the
#: values (m, k) of the parameters for which the motions are already corrected.
Effect = Callable[[Array, slice], tuple[Array, Array]]


class BinaryFactors(NamedTuple):
    """Factors of one kind that each constrain the relative pose of two nodes, and perhaps the k shared parameters."""

    #: i, j: (m,) indices of the two poses of each factor.
    i: Indices
    j: Indices
    information: Array  #: (m, d, d) information matrices
    #: function of i_from_j (m, 4, 4) and the shared parameters (k,) that returns residuals (m, d).
    residuals: Callable[[Array, Array], Array]
    #: function of i_from_j, the shared parameters and the residuals that returns the Jacobians (m, d, 6) with respect
    #: to the increment of pose j; called for a part of the factors at a time.
    jacobians: Callable[[Array, Array, Array], Array]
    huber: float | None = None  #: residual [standard deviations] above which the loss is linear; None: least squares
    #: function of i_from_j of a slice of the factors, this slice, and k, that returns the Jacobians (m, d, k) with
    #: respect to the shared parameters; None: there is no dependence.
    by_shared: Callable[[Array, slice, int], Array] | None = None


class SharedPrior(NamedTuple):
    """Gaussian prior of the k shared parameters, which are independent a priori."""

    mean: Array  #: (k,)
    sigma: Array  #: (k,) standard deviations


NOTHING_SHARED = SharedPrior(np.empty(0), np.empty(0))


class FactorGraph(NamedTuple):
    n_poses: int  #: number of poses
    unary: Sequence[UnaryFactors]
    binary: Sequence[BinaryFactors]
    shared: SharedPrior = NOTHING_SHARED


class GraphState(NamedTuple):
    """Values of all unknowns of a factor graph: poses (n, 4, 4) and shared parameters (k,)."""

    poses: Array
    shared: Array


class _Evaluation(NamedTuple):
    state: GraphState  #: state at which the graph is evaluated
    cost: float  #: value of F
    unary: list[Array]  #: residuals (m, d) of each kind of unary factors
    binary: list[tuple[Array, Array]]  #: residuals (m, d) and robust weights (m,) of each kind of binary factors
    chi2: list[Array]  #: squared norms (m,) of the whitened residuals of each kind of binary factors


class _NormalEquations(NamedTuple):
    """Normal equations in the Gauss-Newton approximation; a `BlockMatrix` holds their off-diagonal blocks."""

    diagonal: Array  #: (n, 6, 6) diagonal blocks
    gradient: Array  #: (n, 6) gradient of F with respect to the poses
    border: Array  #: (n, 6, k) mixed second derivatives of F with respect to the poses and the shared parameters
    corner: Array  #: (k, k) second derivatives of F with respect to the shared parameters
    shared_gradient: Array  #: (k,) derivatives of F with respect to the shared parameters


class Solution(NamedTuple):
    """Minimum of the cost of a factor graph; if not converged, the last accepted state of the iteration."""

    state: GraphState  #: poses and shared parameters at the minimum
    cost: float  #: F at the minimum
    #: squared norms (m,) of the whitened residuals of each kind of binary factors, without robust weights.
    chi2: list[Array]
    converged: bool  #: false if the iterations ended before the minimum was reached
    #: factor of the normal matrix of the poses, undamped, at the last linearisation.
    cholesky: block_cholesky.CholeskyFactor
    by_shared: Array  #: (n, 6, k) derivatives of the optimal poses with respect to the shared parameters
    shared_cov: Array  #: (k, k) marginal covariance of the shared parameters

    def marginals_in_place(self) -> Array:
        """Returns the covariances (n, 6, 6) of all poses (rad, m), in camera axes; overwrites the Cholesky factor."""
        return self._add_shared(self.cholesky.invert_in_place(), slice(None))

    def marginal(self, k: int) -> Array:
        return self._add_shared(self.cholesky.inverse_block(k)[None], slice(k, k + 1))[0]

    def sample(self, n_draws: int, rng: np.random.Generator) -> Array:
        """Returns errors (n, 6, n_draws) of all poses, drawn from their joint covariance; units as of the marginals."""
        n, root = len(self.state.poses), np.linalg.cholesky(self.shared_cov)
        normals = rng.standard_normal((n_draws, 6 * n + len(root)))
        return self.cholesky.sample(normals[:, : 6 * n].reshape(n_draws, n, 6)) + self.by_shared @ (
            root @ normals[:, 6 * n :].T
        )

    def _add_shared(self, covs: Array, rows: slice) -> Array:
        """Returns the covariances of the poses `rows`, plus the part due to the shared parameters."""
        by_shared = self.by_shared[rows]
        return covs + by_shared @ self.shared_cov @ by_shared.transpose(0, 2, 1)


def optimise(graph: FactorGraph, start: GraphState, max_iterations: int = 100) -> Solution:
    """Returns the solution reached from `start` by Gauss-Newton with Levenberg-Marquardt damping.

    It is a local minimum of the cost unless `max_iterations` steps, accepted or rejected, are reached; one is always
    made. Raises LinAlgError if the factors do not constrain every pose.
    """
    empty = np.empty(0, np.int64)
    i, j = np.concatenate([empty, *(f.i for f in graph.binary)]), np.concatenate([empty, *(f.j for f in graph.binary)])
    symbolic = elimination.analyse(graph.n_poses, i, j)
    matrix = block_cholesky.BlockMatrix(symbolic, np.empty(symbolic.offset[-1]))
    current, damping, converged = _evaluate(graph, start), 0.0, False
    while True:
        equations = _linearise(graph, current, matrix)
        step = _solve(matrix, equations, damping)
        trial = GraphState(retract(current.state.poses, step.poses), current.state.shared + step.shared)
        expected = -0.5 * (np.sum(equations.gradient * step.poses) + equations.shared_gradient @ step.shared)
        after, max_iterations = _evaluate(graph, trial), max_iterations - 1
        if after.cost <= current.cost + _COST_TOLERANCE:
            converged = bool(damping == 0 and abs(current.cost - after.cost - expected) < _COST_TOLERANCE)
            current, damping = after, damping / 10 if damping > _MIN_DAMPING else 0.0
        else:
            damping = max(10 * damping, _INITIAL_DAMPING)
        if converged or max_iterations <= 0:
            break
    if step.damping:  # marginal covariances follow from the undamped equations
        step = _solve(matrix, _linearise(graph, current, matrix), 0.0)
    return Solution(
        current.state, current.cost, current.chi2, converged, step.cholesky, step.by_shared, step.shared_cov
    )


class _Step(NamedTuple):
    damping: float  #: the diagonal of the pose block was multiplied by 1 + damping
    poses: Array  #: (n, 6) increments of the poses
    shared: Array  #: (k,) increments of the shared parameters
    #: cholesky, by_shared, shared_cov: as in `Solution`, but of the damped equations.
    cholesky: block_cholesky.CholeskyFactor
    by_shared: Array
    shared_cov: Array


def _solve(matrix: block_cholesky.BlockMatrix, equations: _NormalEquations, damping: float) -> _Step:
    """Solves the bordered normal equations by the Schur complement of the pose block. Overwrites `matrix`."""
    axes, diagonal = np.arange(6), equations.diagonal.copy()
    diagonal[:, axes, axes] *= 1 + damping
    try:
        cholesky = matrix.factorise(diagonal)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError("the factors do not constrain every pose") from None
    poses = cholesky.solve(-equations.gradient)
    by_shared = np.zeros_like(equations.border)
    for k in range(by_shared.shape[2]):
        by_shared[:, :, k] = -cholesky.solve(np.ascontiguousarray(equations.border[:, :, k]))
    information = equations.corner + np.einsum("nak,nal->kl", equations.border, by_shared)
    cov = symmetric_inverses(information[None])[0]
    shared = cov @ (-equations.shared_gradient - np.einsum("nak,na->k", equations.border, poses))
    return _Step(damping, poses + by_shared @ shared, shared, cholesky, by_shared, cov)


def _evaluate(graph: FactorGraph, state: GraphState) -> _Evaluation:
    cost = float(np.sum(((state.shared - graph.shared.mean) / graph.shared.sigma) ** 2)) / 2
    unary, binary, chi2 = [], [], []
    for factors in graph.unary:
        residuals = factors.residuals(state.poses[factors.pose_index])
        cost += float(_squared_norms(residuals, factors.information).sum()) / 2
        unary.append(residuals)
    for factors in graph.binary:
        residuals = factors.residuals(_relative_poses(state.poses, factors.i, factors.j), state.shared)
        chi2.append(_squared_norms(residuals, factors.information))
        losses, weights = _robust_loss(chi2[-1], factors.huber)
        cost += float(losses.sum())
        binary.append((residuals, weights))
    return _Evaluation(state, cost, unary, binary, chi2)


def _robust_loss(chi2: Array, huber: float | None) -> tuple[Array, Array]:
    """Returns losses rho (m,) and robust weights (m,) of squared whitened norms."""
    if huber is None:
        return chi2 / 2, np.ones(len(chi2))
    length = np.sqrt(chi2)
    inlier = length <= huber
    weights = np.where(inlier, 1.0, huber / np.maximum(length, huber))
    return np.where(inlier, chi2 / 2, huber * (length - huber / 2)), weights


def _linearise(graph: FactorGraph, current: _Evaluation, matrix: block_cholesky.BlockMatrix) -> _NormalEquations:
    """Returns the normal equations of all factors; fills `matrix` with the off-diagonal blocks."""
    n, shared = graph.n_poses, current.state.shared
    diagonal, gradient, border = np.zeros((n, 6, 6)), np.zeros((n, 6)), np.zeros((n, 6, len(shared)))
    corner = np.diag(graph.shared.sigma**-2)
    shared_gradient = corner @ (shared - graph.shared.mean)
    n_added = 0
    matrix.panels[:] = 0.0
    for factors, residuals in zip(graph.unary, current.unary, strict=True):
        by_pose = factors.jacobians(current.state.poses[factors.pose_index], residuals)
        weighted = by_pose.transpose(0, 2, 1) @ factors.information
        diagonal += _sum_by_index(n, factors.pose_index, weighted @ by_pose)
        gradient += _sum_by_index(n, factors.pose_index, _matvec(weighted, residuals))
    for factors, evaluated in zip(graph.binary, current.binary, strict=True):
        for first in range(0, len(factors.i), _BATCH):
            batch = slice(first, first + _BATCH)
            i, j, information = factors.i[batch], factors.j[batch], factors.information[batch]
            residuals, weights = (values[batch] for values in evaluated)
            i_from_j = _relative_poses(current.state.poses, i, j)
            by_j = factors.jacobians(i_from_j, shared, residuals)
            off_diagonal = np.empty((len(i), 6, 6))
            _add_binary(i, j, by_j, information, weights, residuals, i_from_j, diagonal, off_diagonal, gradient)
            matrix.add(n_added, off_diagonal)
            n_added += len(i)
            if factors.by_shared is not None and len(shared):
                by_shared = factors.by_shared(i_from_j, batch, len(shared))
                weighted = weights[:, None, None] * (information @ by_shared)
                _add_border(i, j, by_j, weighted, i_from_j, border)
                corner += np.einsum("mdk,mdl->kl", weighted, by_shared)
                shared_gradient += np.einsum("mdk,md->k", weighted, residuals)
    return _NormalEquations(diagonal, gradient, border, corner, shared_gradient)


@kernel
def _add_binary(first, second, by_j, information, weights, residuals, i_from_j, diagonal, off_diagonal, gradient):
    """Adds m binary factors to diagonal blocks (n, 6, 6) and gradients (n, 6); fills the blocks (i, j) (m, 6, 6)."""
    # the Jacobian with respect to the increment of pose i is J_i = -J_j Ad(j_from_i)
    n = residuals.shape[1]
    half, matrix, slope, to_i = np.empty((6, n)), np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    for m in range(len(first)):
        i, j, jacobian = first[m], second[m], by_j[m]
        for a in range(6):
            slope[a] = 0.0
            for k in range(n):
                half[a, k] = 0.0
                for b in range(n):
                    half[a, k] += weights[m] * jacobian[b, a] * information[m, b, k]
                slope[a] += half[a, k] * residuals[m, k]
            for b in range(a + 1):
                total = 0.0
                for k in range(n):
                    total += half[a, k] * jacobian[k, b]
                matrix[a, b] = matrix[b, a] = total
        geometry.copy_into(to_i, geometry.adjoint(geometry.inverse(i_from_j[m])).T)
        for a in range(6):
            for b in range(6):
                off_diagonal[m, a, b] = 0.0
                for k in range(6):
                    off_diagonal[m, a, b] -= to_i[a, k] * matrix[k, b]
                diagonal[j, a, b] += matrix[a, b]
                gradient[i, a] -= to_i[a, b] * slope[b]
            gradient[j, a] += slope[a]
        geometry.copy_into(diagonal[i], diagonal[i] + geometry.transform_covariance(to_i, matrix))


@kernel
def _add_border(first, second, by_j, weighted, i_from_j, border):
    """Adds the mixed derivatives of poses and shared parameters to `border`; weighted shared Jacobians (m, d, k)."""
    for m in range(len(first)):
        j_from_i = geometry.adjoint(geometry.inverse(i_from_j[m]))
        for s in range(weighted.shape[2]):
            slope = np.zeros(6)
            for d in range(weighted.shape[1]):
                slope += weighted[m, d, s] * by_j[m, d]
            for a in range(6):
                border[second[m], a, s] += slope[a]
                for b in range(6):
                    border[first[m], a, s] -= j_from_i[b, a] * slope[b]


def motion_factors(
    links: Sequence[Link], index_of: dict[int, int], huber: float | None = None, effect: Effect | None = None
) -> BinaryFactors:
    """Returns factors of measured motions; `effect` is that of the shared parameters on them, None: they have none."""
    columns = Links.from_sequence(links)
    measured, information = (np.ascontiguousarray(column) for column in (columns.i_from_j, columns.information))
    i, j = (np.array([index_of[number] for number in ends.tolist()], np.int64) for ends in (columns.i, columns.j))

    def residuals(i_from_j: Array, shared: Array) -> Array:
        found = pose_residuals(measured, i_from_j)
        if effect is None:
            return found
        derivatives, at = effect(i_from_j, slice(None))
        return found - np.einsum("mdk,mk->md", derivatives, shared - at)

    def by_shared(i_from_j: Array, batch: slice, _: int) -> Array:
        assert effect is not None
        return -effect(i_from_j, batch)[0]

    return BinaryFactors(
        i, j, information, residuals, lambda _, __, residuals: pose_residual_jacobians(residuals), huber,
        None if effect is None else by_shared,
    )  # fmt: skip


def prior_factors(pose_index: Sequence[int], poses: Array, covs: Array) -> UnaryFactors:
    """Returns unary factors of the poses `pose_index` (m,) with known means (m, 4, 4) and covariances (m, 6, 6)."""

    def residuals(estimated: Array) -> Array:
        return pose_residuals(poses, estimated)

    index, information = np.asarray(pose_index, np.int64), symmetric_inverses(covs)
    return UnaryFactors(index, information, residuals, lambda _, residuals: pose_residual_jacobians(residuals))


@kernel
def pose_residuals(measured, estimated):
    """Returns the residuals log(measured^-1 estimated) (m, 6) of m measured and m estimated poses (m, 4, 4)."""
    residuals = np.empty((len(estimated), 6))
    for k in range(len(estimated)):
        geometry.copy_into(residuals[k], geometry.log(geometry.compose(geometry.inverse(measured[k]), estimated[k])))
    return residuals


@kernel
def pose_residual_jacobians(residuals):
    """Returns the Jacobians (m, 6, 6) of `pose_residuals` (m, 6) with respect to increments of the estimated poses."""
    jacobians = np.empty((len(residuals), 6, 6))
    for k in range(len(residuals)):
        geometry.copy_into(jacobians[k], geometry.log_derivative(residuals[k]))
    return jacobians


@kernel
def retract(poses, increments):
    """Returns poses (n, 4, 4) moved by increments (n, 6) in their own axes."""
    moved = np.empty_like(poses)
    for k in range(len(poses)):
        geometry.copy_into(moved[k], geometry.compose(poses[k], geometry.exp(increments[k])))
    return moved


@kernel
def _relative_poses(poses, i, j):
    relative = np.empty((len(i), 4, 4))
    for k in range(len(i)):
        geometry.copy_into(relative[k], geometry.compose(geometry.inverse(poses[i[k]]), poses[j[k]]))
    return relative


def _matvec(matrices: Array, vectors: Array) -> Array:
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _squared_norms(residuals: Array, information: Array) -> Array:
    return np.sum(residuals * _matvec(information, residuals), axis=1)


def _sum_by_index(n: int, index: Indices, values: Array) -> Array:
    """Returns the sums (n, ...) of the values (m, ...) that have the same index, for the indices 0 to n - 1."""
    sums = np.zeros((n, *values.shape[1:]))
    np.add.at(sums, index, values)
    return sums
