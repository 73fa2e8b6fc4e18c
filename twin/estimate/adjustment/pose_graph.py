"""Pose graphs: the poses X that agree best with the motions Z measured between them, the core of the alignment (P15).

F(X) = sum over links of rho(|log(Z_ij^-1 X_i^-1 X_j)|), lengths in units of the link's covariance, and over what is
said of single poses; rho is r^2 / 2, or Huber's function. Gauss-Newton minimises it, damped (Marquardt) where its step
leads up. Errors of poses are motions in their own axes, X exp(d).

What pairs share with all others (the scale of a log) is one unknown more, which borders the matrix of the poses: first
the poses as if it were known, then its own equation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import sparse

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link, Links, inverses
from twin.estimate.adjustment import block_cholesky, elimination
from twin.estimate.adjustment.elimination import Indices

#: A step that lowers F as the linear equations foretell, but for so little, ends the search: what the next one could
#: gain is of that size or less, which moves no pose by more than 0.05 of its standard deviation.
_BEYOND_LINEAR = 5e-4
_FIRST_DAMPING, _LEAST_DAMPING = 1e-4, 1e-6  # of the diagonal
_TOGETHER = 4096  # pairs whose derivatives are held at a time


class Single(NamedTuple):
    """What is said of one pose each.

    Args:
        at: (m,) which.
        information: (m, d, d).
        observe: residuals (m, d) of poses (m, 4, 4).
        derive: of poses and residuals the derivatives (m, d, 6) by the poses' motions.
    """

    at: Indices
    information: Array
    observe: Callable[[Array], Array]
    derive: Callable[[Array, Array], Array]


class Pairs(NamedTuple):
    """What is said of the motion between two poses each.

    Args:
        i, j: (m,) which.
        information: (m, d, d).
        observe: residuals (m, d) of i_from_j (m, 4, 4) and what is shared.
        derive: of these three the derivatives (m, d, 6) by the motions of j, (m, d) by what is shared, or None.
        huber: residual [standard deviations] from which one counts linearly; None: squares throughout.
    """

    i: Indices
    j: Indices
    information: Array
    observe: Callable[[Array, float], Array]
    derive: Callable[[Array, float, Array], tuple[Array, Array | None]]
    huber: float | None = None


class Graph(NamedTuple):
    """All that is said of n poses; deviation of what pairs share, about 0 (None: nothing is shared)."""

    n: int
    singles: Sequence[Single]
    pairs: Sequence[Pairs]
    shared_sigma: float | None = None


class State(NamedTuple):
    """Poses (n, 4, 4), and what pairs share."""

    poses: Array
    shared: float = 0.0


class _Seen(NamedTuple):
    """A graph at a state: F, residuals (m, d) of singles; of pairs residuals and weights (m,); their chi2 (m,)."""

    state: State
    cost: float
    singles: list[Array]
    pairs: list[tuple[Array, Array]]
    chi2: list[Array]


class _System(NamedTuple):
    """Normal equations beside the blocks between poses: blocks (n, 6, 6) on the diagonal, gradient (n, 6); border
    (n, 6), corner and gradient of what is shared."""

    diagonal: Array
    gradient: Array
    border: Array
    corner: float
    shared_gradient: float


class Optimum(NamedTuple):
    """The state that minimises F, the value of F, whether it was reached, and the equations of the last step.

    Args:
        chi2: (m,) squared residuals of each pairs in units of their covariance, before their weights.
        factor: of the poses' matrix.
        border: (n, 6) its solution for the border, and what the shared unknown's own equation then holds; None: nothing
            is shared.
    """

    state: State
    cost: float
    chi2: list[Array]
    reached: bool
    factor: block_cholesky.Factor
    border: tuple[Array, float] | None

    def into_marginals(self) -> Array:
        """(n, 6, 6) covariance of all poses [rotation, translation] (rad, m), each in its own axes.

        They take the place of the factor, which is used up.
        """
        return self._with_shared(self.factor.into_marginals(), slice(None))

    def marginal(self, k: int) -> Array:
        """(6, 6) of one."""
        return self._with_shared(self.factor.marginal(k)[None], slice(k, k + 1))[0]

    def _with_shared(self, covs: Array, rows: slice) -> Array:
        if self.border is None:
            return covs
        by_shared, information = self.border
        return covs + by_shared[rows, :, None] * by_shared[rows, None, :] / information


def optimise(graph: Graph, start: State, iterations: int = 100) -> Optimum:
    """The nearest minimum.

    Args:
        iterations: at most; at least one.

    Raises:
        LinAlgError: the graph does not hold every pose.
    """
    nobody = np.empty(0, np.int64)
    i, j = np.concatenate([nobody, *(p.i for p in graph.pairs)]), np.concatenate([nobody, *(p.j for p in graph.pairs)])
    matrix = block_cholesky.Matrix.room(elimination.analyse(graph.n, i, j))
    seen, damping, reached = _look(graph, start), 0.0, False
    while True:
        system = _equations(graph, seen, matrix)
        step = _step(matrix, system, damping)
        moved = State(_moved(seen.state.poses, step.poses), seen.state.shared + step.shared)
        expected = -0.5 * (np.sum(system.gradient * step.poses) + system.shared_gradient * step.shared)
        after, iterations = _look(graph, moved), iterations - 1
        if after.cost <= seen.cost + _BEYOND_LINEAR:
            reached = damping == 0 and abs(seen.cost - after.cost - expected) < _BEYOND_LINEAR
            seen, damping = after, damping / 10 if damping > _LEAST_DAMPING else 0.0
        else:
            damping = max(10 * damping, _FIRST_DAMPING)
        if reached or iterations <= 0:
            break
    if step.damping:  # covariances are those of the equations as they are
        step = _step(matrix, _equations(graph, seen, matrix), 0.0)
    return Optimum(seen.state, seen.cost, seen.chi2, reached, step.factor, step.border)


class _Step(NamedTuple):
    """The solution of damped equations, the factor of the poses' matrix, and the border as `Optimum` has it."""

    damping: float
    poses: Array
    shared: float
    factor: block_cholesky.Factor
    border: tuple[Array, float] | None


def _step(matrix: block_cholesky.Matrix, system: _System, damping: float) -> _Step:
    """Solves the bordered equations by the block below the corner; uses the matrix up."""
    diagonal = system.diagonal
    if damping:
        axes = np.arange(6)
        diagonal = diagonal.copy()
        diagonal[:, axes, axes] *= 1 + damping
    try:
        factor = matrix.factorise(diagonal)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError("not every pose is held") from None
    poses = factor.solve(-system.gradient)
    if not system.corner:
        return _Step(damping, poses, 0.0, factor, None)
    by_shared = -factor.solve(system.border)
    information = system.corner + float(np.sum(system.border * by_shared))
    shared = (-system.shared_gradient - float(np.sum(system.border * poses))) / information
    return _Step(damping, poses + by_shared * shared, shared, factor, (by_shared, information))


def _look(graph: Graph, state: State) -> _Seen:
    """What the graph is at a state."""
    cost = 0.0 if graph.shared_sigma is None else (state.shared / graph.shared_sigma) ** 2 / 2
    singles, pairs, chi2 = [], [], []
    for single in graph.singles:
        residuals = single.observe(state.poses[single.at])
        cost += float(_squares(residuals, single.information).sum()) / 2
        singles.append(residuals)
    for pair in graph.pairs:
        residuals = pair.observe(_between(state.poses, pair.i, pair.j), state.shared)
        chi2.append(_squares(residuals, pair.information))
        losses, weights = _robust(chi2[-1], pair.huber)
        cost += float(losses.sum())
        pairs.append((residuals, weights))
    return _Seen(state, cost, singles, pairs, chi2)


def _robust(chi2: Array, huber: float | None) -> tuple[Array, Array]:
    """Losses (m,) and weights (m,) of squared residuals."""
    if huber is None:
        return chi2 / 2, np.ones(len(chi2))
    length = np.sqrt(chi2)
    within = length <= huber
    weights = np.where(within, 1.0, huber / np.maximum(length, huber))
    return np.where(within, chi2 / 2, huber * (length - huber / 2)), weights


def _equations(graph: Graph, seen: _Seen, matrix: block_cholesky.Matrix) -> _System:
    """Normal equations of all residuals; the blocks between poses go into the matrix."""
    diagonal, gradient, border = np.zeros((graph.n, 6, 6)), np.zeros((graph.n, 6)), np.zeros((graph.n, 6))
    corner = 0.0 if graph.shared_sigma is None else graph.shared_sigma**-2
    shared_gradient = corner * seen.state.shared
    done = 0
    matrix.clear()
    for single, residuals in zip(graph.singles, seen.singles, strict=True):
        by_pose = single.derive(seen.state.poses[single.at], residuals)
        weighted = turned(by_pose) @ single.information
        diagonal += _summed(graph.n, single.at, weighted @ by_pose)
        gradient += _summed(graph.n, single.at, times(weighted, residuals))
    for pair, every in zip(graph.pairs, seen.pairs, strict=True):
        for first in range(0, len(pair.i), _TOGETHER):
            some = slice(first, first + _TOGETHER)
            i, j, information = pair.i[some], pair.j[some], pair.information[some]
            residuals, weights = (of_all[some] for of_all in every)
            i_from_j = _between(seen.state.poses, i, j)
            by_j, by_shared = pair.derive(i_from_j, seen.state.shared, residuals)
            across = np.empty((len(i), 6, 6))
            _add_pairs(i, j, by_j, information, weights, residuals, i_from_j, diagonal, across, gradient)
            matrix.add(done, across)
            done += len(i)
            if by_shared is not None:
                informed = weights[:, None] * times(information, by_shared)
                _add_border(i, j, by_j, informed, i_from_j, border)
                corner += float(np.sum(informed * by_shared))
                shared_gradient += float(np.sum(informed * residuals))
    return _System(diagonal, gradient, border, corner, shared_gradient)


@njit(cache=True, nogil=True)
def _add_pairs(first, second, by_j, information, weights, residuals, i_from_j, diagonal, across, gradient):
    """Adds the normal equations of pairs to blocks and gradient of both their poses, and fills the blocks between.

    A motion d of i is one of -Ad(j_from_i) d of j.
    """
    n = residuals.shape[1]
    half, matrix, slope, to_i = np.empty((6, n)), np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    for m in range(len(first)):
        i, j, derivative = first[m], second[m], by_j[m]
        for a in range(6):
            slope[a] = 0.0
            for k in range(n):
                half[a, k] = 0.0
                for b in range(n):
                    half[a, k] += weights[m] * derivative[b, a] * information[m, b, k]
                slope[a] += half[a, k] * residuals[m, k]
            for b in range(a + 1):
                total = 0.0
                for k in range(n):
                    total += half[a, k] * derivative[k, b]
                matrix[a, b] = matrix[b, a] = total
        geometry.put(to_i, geometry.adjoint(geometry.inverse(i_from_j[m])).T)
        for a in range(6):
            for b in range(6):
                across[m, a, b] = 0.0
                for k in range(6):
                    across[m, a, b] -= to_i[a, k] * matrix[k, b]
                diagonal[j, a, b] += matrix[a, b]
                gradient[i, a] -= to_i[a, b] * slope[b]
            gradient[j, a] += slope[a]
        geometry.put(diagonal[i], diagonal[i] + geometry.sandwich(to_i, matrix))


@njit(cache=True, nogil=True)
def _add_border(first, second, by_j, informed, i_from_j, border):
    """Adds what pairs hold together of their poses and what is shared."""
    for m in range(len(first)):
        slope = np.zeros(6)
        for k in range(informed.shape[1]):
            slope += informed[m, k] * by_j[m, k]
        carry = geometry.adjoint(geometry.inverse(i_from_j[m]))
        for a in range(6):
            border[second[m], a] += slope[a]
            for b in range(6):
                border[first[m], a] -= carry[b, a] * slope[b]


def motions(links: Sequence[Link], places: dict[int, int], huber: float | None = None) -> Pairs:
    """What links say of the poses at these places, by number of their nodes."""
    columns = Links.of(links)
    measured, information = columns.i_from_j, columns.information
    i, j = (np.array([places[number] for number in ends.tolist()], np.int64) for ends in (columns.i, columns.j))

    def observe(i_from_j: Array, _: float) -> Array:
        return errors(measured, i_from_j)

    return Pairs(i, j, information, observe, lambda _, __, residuals: (log_derivatives(residuals), None), huber)


def given(at: Sequence[int], poses: Array, covs: Array) -> Single:
    """Poses (m, 4, 4) that are known with covariances (m, 6, 6) [rotation, translation], in their own axes."""
    return Single(
        np.asarray(at, np.int64), inverses(covs), lambda found: errors(poses, found),
        lambda _, residuals: log_derivatives(residuals),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def errors(measured, found):
    """log(measured^-1 found) of poses (m, 4, 4), (m, 6)."""
    residuals = np.empty((len(found), 6))
    for k in range(len(found)):
        geometry.put(residuals[k], geometry.log(geometry.compose(geometry.inverse(measured[k]), found[k])))
    return residuals


@njit(cache=True, nogil=True)
def log_derivatives(residuals):
    """Derivatives (m, 6, 6) of such errors (m, 6) by motions of what is found."""
    derivatives = np.empty((len(residuals), 6, 6))
    for k in range(len(residuals)):
        geometry.put(derivatives[k], geometry.log_derivative(residuals[k]))
    return derivatives


@njit(cache=True, nogil=True)
def _moved(poses, steps):
    moved = np.empty_like(poses)
    for k in range(len(poses)):
        geometry.put(moved[k], geometry.compose(poses[k], geometry.exp(steps[k])))
    return moved


@njit(cache=True, nogil=True)
def _between(poses, first, second):
    """(m, 4, 4) poses of the second in the first of pairs."""
    found = np.empty((len(first), 4, 4))
    for k in range(len(first)):
        geometry.put(found[k], geometry.compose(geometry.inverse(poses[first[k]]), poses[second[k]]))
    return found


def turned(matrices: Array) -> Array:
    """Each of matrices (m, a, b) transposed, a view."""
    return matrices.transpose(0, 2, 1)


def times(matrices: Array, vectors: Array) -> Array:
    """Matrices (m, a, b) times vectors (m, b), one by one: (m, a)."""
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _squares(residuals: Array, information: Array) -> Array:
    return np.sum(residuals * times(information, residuals), axis=1)


def _summed(n: int, at: Indices, values: Array) -> Array:
    """(n, ...) sums of the values (m, ...) that belong to each."""
    picks = sparse.csr_array((np.ones(len(at)), (at, np.arange(len(at)))), shape=(n, len(at)))
    return (picks @ values.reshape(len(at), int(np.prod(values.shape[1:])))).reshape(n, *values.shape[1:])
