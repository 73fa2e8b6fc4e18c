"""Pose graphs: the poses X that agree best with the motions Z measured between them, the core of the alignment (P15).

F(X) = sum over links of rho(|log(Z_ij^-1 X_i^-1 X_j)|), lengths in units of the link's covariance; rho is r^2 / 2, or
Huber's function. gtsam minimises it by Levenberg-Marquardt. Without good poses to start from, the start is chordal
(Carlone et al. 2015): rotations by linear least squares, then positions. Raw odometry is none on a hard graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from twin.estimate import marginals as selected
from twin.geometry import Array
from twin.records import Link

#: A step that lowers F by less ends the search: it moved no pose by more than 0.05 of its standard deviation, and the
#: next one, quadratically less, is not taken.
_LEAST_GAIN = 1e-3
_MANY = 2500  # poses from which on nested dissection saves more than it costs
_HELD_SIGMA = 1e-6  # of the first pose [rad, m]


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
    values, _ = optimise(graph, values)
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


def optimise(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, iterations: int = 100
) -> tuple[gtsam.Values, bool]:
    """The nearest minimum by Levenberg-Marquardt, and whether it was reached in so many iterations.

    Raises:
        RuntimeError: the factors do not hold every variable.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0)
    parameters.setAbsoluteErrorTol(_LEAST_GAIN)
    parameters.setMaxIterations(iterations)
    if start.size() > _MANY:
        parameters.setOrderingType("METIS")
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    return optimizer.optimize(), optimizer.iterations() < iterations


def chi2(factors: Sequence[gtsam.BetweenFactorPose3], covs: Array, values: gtsam.Values) -> Array:
    """(n,) squared residual of each link in units of its covariance (n, 6, 6), before any robust weight."""
    residuals = np.array([factor.unwhitenedError(values) for factor in factors]).reshape(-1, 6)
    return np.einsum("ni,ni->n", residuals, np.linalg.solve(covs, residuals[..., None])[..., 0])


def marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, numbers: Sequence[int]) -> Array:
    """(n, 6, 6) covariance of these poses [rotation, translation] (rad, m), each in its own axes.

    They are eliminated last, so that a few cost one elimination and no walk through the tree; and with them what has a
    letter for its name (a beacon, a scale error): eliminated first, it would join all poses that share it.
    """
    shared = [key for key in values.keys() if gtsam.symbolChr(key)]
    order = (
        gtsam.Ordering.MetisNonlinearFactorGraph(graph)
        if _MANY < len(numbers) == values.size()
        else gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, [*numbers, *shared])
    )
    covs = selected.marginals(graph.linearize(values), order, frozenset(numbers))
    return np.array([covs[number] for number in numbers]).reshape(-1, 6, 6)


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
