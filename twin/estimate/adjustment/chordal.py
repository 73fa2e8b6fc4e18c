"""Solution of a pose graph without initial poses, by chordal initialisation (Carlone et al. 2015).

Integrated odometry gives poor initial poses for a graph with large rotation errors. Chordal initialisation uses the
rotation R_ij and the translation t_ij of each link. It first solves R_j = R_i R_ij by linear least squares for
unconstrained 3 x 3 matrices R_i, replaces each by the nearest rotation, and then solves p_j = p_i + R_i t_ij for the
positions p_i.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from twin.core.geometry import Array
from twin.core.links import Link, Links
from twin.estimate.adjustment.elimination import Indices
from twin.estimate.adjustment.pose_graph import (
    FactorGraph,
    GraphState,
    matvec,
    motion_factors,
    optimise,
    prior_factors,
    transposed,
)

_ANCHOR_SIGMA = 1e-6  # prior standard deviation of the first pose [rad, m]


class PoseGraphSolution(NamedTuple):
    """Poses (4, 4) by node number at a local minimum of the cost F (see `pose_graph`), and the value of F there.

    `converged` is false if the iterations ended before the minimum was reached.
    """

    poses: dict[int, Array]
    cost: float
    converged: bool


def solve_pose_graph(
    links: Sequence[Link], start: dict[int, Array] | None = None, huber: float | None = None
) -> PoseGraphSolution:
    """Returns the poses that minimise the cost of a pose graph; the node with the lowest number keeps its initial pose.

    The minimum is the local one that `pose_graph.optimise` reaches from the initial poses.

    Args:
        links: measured motions; they have to connect all nodes.
        start: initial pose (4, 4) of every node, by node number; None: chordal initialisation, with the pose of the
            first node equal to the identity.
        huber: residual [standard deviations] above which the cost of a link grows linearly; None: least squares.

    Raises:
        RuntimeError: the links do not connect all nodes, and `start` is None.
        LinAlgError: the links do not connect all nodes of `start`.
    """
    start = chordal_start(links) if start is None else start
    numbers = sorted(start)
    poses = np.array([start[number] for number in numbers])
    anchor = prior_factors([0], poses[:1], np.eye(6)[None] * _ANCHOR_SIGMA**2)
    index_of = {number: k for k, number in enumerate(numbers)}
    graph = FactorGraph(len(poses), [anchor], [motion_factors(links, index_of, huber)])
    solution = optimise(graph, GraphState(poses))
    poses = dict(zip(numbers, solution.state.poses, strict=True))
    return PoseGraphSolution(poses, solution.cost, solution.converged)


def chordal_start(links: Sequence[Link]) -> dict[int, Array]:
    """Returns initial poses (4, 4) by node number, computed from the links alone.

    The pose of the node with the lowest number is the identity. In the equations of the rotations, a link is weighted
    by the inverse of the mean of its three rotation variances; in those of the positions, by the inverse of the mean of
    its three translation variances.

    Raises:
        RuntimeError: the links do not connect all nodes.
    """
    columns = Links.from_sequence(links)
    numbers = np.unique(np.concatenate([columns.i, columns.j])).tolist()
    index_of = {number: k for k, number in enumerate(numbers)}
    motion, cov = columns.i_from_j, columns.cov
    i, j = (np.array([index_of[number] for number in ends.tolist()]) for ends in (columns.i, columns.j))
    rotation_weights, translation_weights = (
        3 / np.trace(cov[:, a : a + 3, a : a + 3], axis1=1, axis2=2) for a in (0, 3)
    )
    j_from_i, zeros = transposed(motion[:, :3, :3]), np.zeros((len(links), 3, 3))
    u, _, v = np.linalg.svd(transposed(_least_squares(i, j, j_from_i, zeros, np.eye(3), rotation_weights)))
    u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, :3] = u @ v
    steps = matvec(poses[i, :3, :3], motion[:, :3, 3])[:, None]
    identities, origin = np.ones((len(links), 1, 1)), np.zeros((1, 3))
    poses[:, :3, 3] = _least_squares(i, j, identities, steps, origin, translation_weights)[:, 0]
    return dict(zip(numbers, poses, strict=True))


def _least_squares(i: Indices, j: Indices, by_i: Array, right: Array, first: Array, weights: Array) -> Array:
    """Returns the weighted least-squares solution x (n, d, 3) of the equations x_j = by_i x_i + right, x_0 = first.

    Args:
        i, j: (m,) indices of the unknowns of each equation.
        by_i: (m, d, d) coefficients of x_i.
        right: (m, d, 3) constant terms.
        first: (d, 3) value of x_0.
        weights: (m,) weights of the equations.
    """
    m, d, _ = right.shape
    row = np.arange(m * d).reshape(m, d)
    column_i, column_j = (d * k[:, None] + np.arange(d) for k in (i, j))
    entries = np.concatenate([np.ones(m * d), -by_i.ravel()])
    rows = np.concatenate([row.ravel(), np.repeat(row, d, axis=1).ravel()])
    columns = np.concatenate([column_j.ravel(), np.repeat(column_i[:, None], d, axis=1).ravel()])
    matrix = sparse.csc_array((entries, (rows, columns)), shape=(m * d, columns.max() + 1))
    fixed, free = matrix[:, :d], matrix[:, d:]
    weighted = free.T @ sparse.diags_array(np.repeat(weights, d))
    solution = splu((weighted @ free).tocsc()).solve(weighted @ (right.reshape(-1, 3) - fixed @ first))
    return np.concatenate([first, solution]).reshape(-1, d, 3)
