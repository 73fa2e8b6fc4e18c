"""Pose graphs without poses to start from: the chordal start (Carlone et al. 2015), and the minimum next to it.

Raw odometry is no start on a hard graph. Of rotations, R_j = R_i R_ij as of any matrices, by linear least squares; the
nearest rotations to what that gives; then positions, p_j = p_i + R_i t_ij.
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
from twin.estimate.adjustment.pose_graph import Graph, State, given, motions, optimise, times, turned

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
    start = chordal_start(links) if start is None else start
    numbers = sorted(start)
    poses = np.array([start[number] for number in numbers])
    held = given([0], poses[:1], np.eye(6)[None] * _HELD_SIGMA**2)
    places = {number: k for k, number in enumerate(numbers)}
    found = optimise(Graph(len(poses), [held], [motions(links, places, huber)]), State(poses))
    return Solved(dict(zip(numbers, found.state.poses, strict=True)), found.cost)


def chordal_start(links: Sequence[Link]) -> dict[int, Array]:
    """Poses (4, 4) to start from, found from the links alone; the lowest number is at the identity.

    Links weigh by their covariance's mean, of rotation and of translation.
    """
    columns = Links.of(links)
    numbers = np.unique(np.concatenate([columns.i, columns.j])).tolist()
    places = {number: k for k, number in enumerate(numbers)}
    motion, cov = columns.i_from_j, columns.cov
    i, j = (np.array([places[number] for number in ends.tolist()]) for ends in (columns.i, columns.j))
    of_turns, of_ways = (3 / np.trace(cov[:, a : a + 3, a : a + 3], axis1=1, axis2=2) for a in (0, 3))
    turns, nothing = turned(motion[:, :3, :3]), np.zeros((len(links), 3, 3))
    u, _, v = np.linalg.svd(turned(_least_squares(i, j, turns, nothing, np.eye(3), of_turns)))
    u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, :3] = u @ v
    ways = times(poses[i, :3, :3], motion[:, :3, 3])[:, None]
    poses[:, :3, 3] = _least_squares(i, j, np.ones((len(links), 1, 1)), ways, np.zeros((1, 3)), of_ways)[:, 0]
    return dict(zip(numbers, poses, strict=True))


def _least_squares(i: Indices, j: Indices, by_i: Array, right: Array, first: Array, weights: Array) -> Array:
    """(n, d, 3) the x that best keep x_j = by_i x_i + right, of (m, d, d) and (m, d, 3), with x_0 = first (d, 3)."""
    m, d, _ = right.shape
    row = np.arange(m * d).reshape(m, d)
    column_i, column_j = (d * k[:, None] + np.arange(d) for k in (i, j))
    entries = np.concatenate([np.ones(m * d), -by_i.ravel()])
    rows = np.concatenate([row.ravel(), np.repeat(row, d, axis=1).ravel()])
    columns = np.concatenate([column_j.ravel(), np.repeat(column_i[:, None], d, axis=1).ravel()])
    matrix = sparse.csc_array((entries, (rows, columns)), shape=(m * d, columns.max() + 1))
    known, free = matrix[:, :d], matrix[:, d:]
    weighted = free.T @ sparse.diags_array(np.repeat(weights, d))
    rest = splu((weighted @ free).tocsc()).solve(weighted @ (right.reshape(-1, 3) - known @ first))
    return np.concatenate([first, rest]).reshape(-1, d, 3)
