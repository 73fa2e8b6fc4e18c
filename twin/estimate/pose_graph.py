"""Pose graphs: the poses X that agree best with the motions Z measured between them, the core of the alignment (P15).

F(X) = sum over links of rho(|log(Z_ij^-1 X_i^-1 X_j)|), lengths in units of the link's covariance; rho is r^2 / 2, or
Huber's function. Gauss-Newton on gtsam's factors minimises it, Levenberg-Marquardt where that leads
up. Without good poses to start from, the start is chordal (Carlone et al. 2015): rotations by linear least squares,
then positions. Raw odometry is none on a hard graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from twin.estimate import marginals as selected
from twin.geometry import Array
from twin.records import Link

#: A step that lowers F as the linear equations foretell, but for so little, ends the search: what the next one could
#: gain is of that size or less, which moves no pose by more than 0.05 of its standard deviation.
_BEYOND_LINEAR = 5e-4
_MANY = 2500  # poses from which on nested dissection saves more than it costs
_HELD_SIGMA = 1e-6  # of the first pose [rad, m]


Eliminated = gtsam.GaussianBayesTree | gtsam.GaussianBayesNet


class Solved(NamedTuple):
    """Poses (4, 4) by number, and the value of F."""

    poses: dict[int, Array]
    cost: float


def solve(links: Sequence[Link], start: dict[int, Array] | None = None, huber: float | None = None) -> Solved:
    """Solves a pose graph; its lowest number stays where it starts.

    Args:
        links: measured motions, every pose held by them.
        start: (4, 4) pose of every number; by the chordal start, from the identity, if None.
        huber: residual [standard deviations] from which a link counts linearly; least squares if None.
    """
    values = chordal_start(links) if start is None else _values(start)
    numbers = sorted(values.keys())
    graph = _held(numbers[0], values.atPose3(numbers[0]))
    for factor in between_factors(links, huber):
        graph.add(factor)
    values = optimise(graph, values).values
    return Solved({number: values.atPose3(number).matrix() for number in numbers}, graph.error(values))


def chordal_start(links: Sequence[Link]) -> gtsam.Values:
    """Poses to start from, found from the links alone; the lowest number is at the identity."""
    graph = _held(min(link.i for link in links), gtsam.Pose3())
    for factor in between_factors(links):
        graph.add(factor)
    return gtsam.InitializePose3.initialize(graph)


def between_factors(links: Sequence[Link], huber: float | None = None) -> list[gtsam.BetweenFactorPose3]:
    """A factor for each link, with Huber's weight from this many standard deviations on."""
    kernel = None if huber is None else gtsam.noiseModel.mEstimator.Huber.Create(huber)
    return [
        gtsam.BetweenFactorPose3(link.i, link.j, gtsam.Pose3(link.i_from_j), _noise(link.cov, kernel)) for link in links
    ]


def gaussian(cov: Array) -> gtsam.noiseModel.Gaussian:
    """Noise of this covariance, made symmetric to the last bit."""
    return gtsam.noiseModel.Gaussian.Covariance((cov + cov.T) / 2)


class Optimum(NamedTuple):
    """The values that minimise F, whether they were reached, and what the graph was eliminated to at the last step."""

    values: gtsam.Values
    reached: bool
    eliminated: Eliminated

    def marginals(self, numbers: Sequence[int]) -> Array:
        """(n, 6, 6) covariance of poses [rotation, translation] (rad, m), each in its own axes."""
        if isinstance(self.eliminated, gtsam.GaussianBayesNet):
            covs = selected.marginals(self.eliminated)
            return np.array([covs[number] for number in numbers]).reshape(-1, 6, 6)
        return np.array([self.eliminated.marginalCovariance(number) for number in numbers]).reshape(-1, 6, 6)


def optimise(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, iterations: int = 100, last: Sequence[int] | None = ()
) -> Optimum:
    """The nearest minimum by Gauss-Newton; where its step leads up, by Levenberg-Marquardt.

    Args:
        last: numbers of the few poses whose marginals will be wanted: eliminated last, theirs cost nothing. None: all,
            for which the graph is eliminated variable by variable, not by the quicker tree.

    Raises:
        RuntimeError: the factors do not hold every variable.
    """
    order, values, cost = _order(graph, start, last), start, graph.error(start)
    reached, eliminated = False, gtsam.GaussianBayesTree()
    while iterations > 0 and not reached:
        del eliminated  # one at a time is enough to hold
        eliminated = _eliminated(graph.linearize(values), order, by_variable=last is None)
        step = eliminated.optimize()
        moved, expected = values.retract(step), eliminated.error(gtsam.VectorValues.Zero(step))
        moved_cost, iterations = graph.error(moved), iterations - 1
        if moved_cost > cost + _BEYOND_LINEAR:
            moved, expected = _damped(graph, values, order, iterations), 0.0
            moved_cost = graph.error(moved)
        reached = abs(cost - moved_cost - expected) < _BEYOND_LINEAR
        values, cost = moved, moved_cost
    return Optimum(values, reached, eliminated)


def _eliminated(linear: gtsam.GaussianFactorGraph, order: gtsam.Ordering, by_variable: bool) -> Eliminated:
    return linear.eliminateSequential(order) if by_variable else linear.eliminateMultifrontal(order)


def _damped(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, order: gtsam.Ordering, iterations: int
) -> gtsam.Values:
    """The nearest minimum by Levenberg-Marquardt."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0)
    parameters.setAbsoluteErrorTol(_BEYOND_LINEAR)
    parameters.setMaxIterations(iterations)
    parameters.setOrdering(order)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def _order(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, last: Sequence[int] | None) -> gtsam.Ordering:
    """The order of elimination.

    What has a letter for its name (a beacon, a scale error) comes last: first, it would join all poses that share it.
    """
    if values.size() > _MANY:
        return gtsam.Ordering.MetisNonlinearFactorGraph(graph)
    shared = [key for key in values.keys() if gtsam.symbolChr(key)]
    return gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, [*(last or ()), *shared])


def chi2(factors: Sequence[gtsam.BetweenFactorPose3], values: gtsam.Values, huber: float | None = None) -> Array:
    """(n,) squared residual of each link in units of its covariance, before the weight of its kernel."""
    losses = np.array([factor.error(values) for factor in factors])
    if huber is None:
        return 2 * losses
    return np.where(losses <= huber**2 / 2, 2 * losses, (losses / huber + huber / 2) ** 2)


def _values(poses: dict[int, Array]) -> gtsam.Values:
    values = gtsam.Values()
    for number, pose in poses.items():
        values.insert(number, gtsam.Pose3(pose))
    return values


def _held(number: int, pose: gtsam.Pose3) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(number, pose, gtsam.noiseModel.Isotropic.Sigma(6, _HELD_SIGMA)))
    return graph


def _noise(cov: Array, kernel: gtsam.noiseModel.mEstimator.Base | None) -> gtsam.noiseModel.Base:
    return gaussian(cov) if kernel is None else gtsam.noiseModel.Robust.Create(kernel, gaussian(cov))
