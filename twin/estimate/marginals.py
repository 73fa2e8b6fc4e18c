"""Marginal covariances of a linearised graph: as much of the inverse as the elimination touched, and no more.

Elimination leaves, variable by variable, R x + S p = d with the parents p that are eliminated later. From the last one
back, cov(x, p) = -W cov(p, p) and cov(x, x) = (R'R)^-1 - cov(x, p) W' with W = R^-1 S (Takahashi et al. 1973). The
covariance of all parents is at hand: they stand together in the block of the one eliminated first among them. Where
variables follow one another with the same parents they share a block, which only grows.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from twin.geometry import Array

Columns = NDArray[np.int64]


class _Row(NamedTuple):
    """A variable of the eliminated graph: R (d, d), its parents in the order of their columns in S (d, k)."""

    key: int
    r: Array
    parents: tuple[int, ...]
    s: Array


class _Block:
    """Joint covariance of the variables that it has taken in, first to last."""

    def __init__(self) -> None:
        self.cov, self.size = np.empty((0, 0)), 0
        self._place: dict[int, Columns] = {}

    def columns(self, keys: Collection[int]) -> Columns:
        """Where the numbers of these variables stand."""
        return np.concatenate([self._place[k] for k in keys])

    def part(self, keys: Collection[int]) -> _Block:
        """A block of some of the variables."""
        columns, part = self.columns(keys), _Block()
        part.cov, part.size = self.cov[columns[:, None], columns], len(columns)
        ends = np.cumsum([len(self._place[k]) for k in keys])
        part._place = dict(zip(keys, np.split(np.arange(part.size), ends[:-1]), strict=True))
        return part

    def append(self, key: int, cov: Array, cross: Array) -> None:
        """Takes a variable in: its covariance (d, d), and (d, n) with what the block has so far."""
        n, d = self.size, len(cov)
        if n + d > len(self.cov):
            grown = np.empty((max(2 * n, n + d),) * 2)
            grown[:n, :n] = self.cov[:n, :n]
            self.cov = grown
        self.cov[n : n + d, :n], self.cov[:n, n : n + d], self.cov[n : n + d, n : n + d] = cross, cross.T, cov
        self._place[key], self.size = np.arange(n, n + d), n + d


def marginals(graph: gtsam.GaussianFactorGraph, order: gtsam.Ordering, wanted: Collection[int]) -> dict[int, Array]:
    """Covariance (d, d) of each of the variables `wanted`; quickest where `order` has them last.

    Raises:
        RuntimeError: the factors do not hold every variable.
    """
    net = graph.eliminateSequential(order)
    rows = [_row(net.at(k)) for k in range(net.size())]
    owner, start = _owners(rows)
    last_use = {block: k for k in reversed(range(len(rows))) for block in (owner[k], start[k])}
    blocks: dict[int, _Block] = {}
    found: dict[int, Array] = {}
    for k in reversed(range(len(rows))):
        if len(found) == len(wanted):
            break
        row = rows[k]
        if owner[k] == k:
            from_block = start[k]
            blocks[k] = _Block() if from_block is None else blocks[from_block].part(row.parents)
        cov = _take_in(row, blocks[owner[k]])
        if row.key in wanted:
            found[row.key] = cov
        for block in {owner[k], start[k]}:
            if last_use[block] == k:
                blocks.pop(block, None)
    return found


def _take_in(row: _Row, block: _Block) -> Array:
    """The covariance of a variable all of whose parents make up the block, which it joins."""
    n = block.size
    inverse = solve_triangular(row.r, np.eye(len(row.r)))
    own, cross = inverse @ inverse.T, np.empty((len(row.r), 0))
    if n:
        weight = np.zeros((len(row.r), n))
        weight[:, block.columns(row.parents)] = inverse @ row.s
        cross = -weight @ block.cov[:n, :n]
        own = own - cross @ weight.T
    block.append(row.key, own, cross)
    return own


def _row(conditional: gtsam.GaussianConditional) -> _Row:
    key, *parents = conditional.keys()
    return _Row(key, conditional.R(), tuple(parents), conditional.S())


def _owners(rows: list[_Row]) -> tuple[list[int], list[int | None]]:
    """For each variable the one whose block it joins (itself: a new one), and the one whose block that starts from.

    One variable may go on in the block of its first parent: one whose parents are all that is in it.
    """
    turn = {row.key: k for k, row in enumerate(rows)}
    owner = list(range(len(rows)))
    start: list[int | None] = [None] * len(rows)
    taken: set[int] = set()
    for k in reversed(range(len(rows))):
        parents = [turn[key] for key in rows[k].parents]
        if not parents:
            continue
        first = min(parents)
        if first not in taken and len(parents) == 1 + len(rows[first].parents):
            taken.add(first)
            owner[k] = owner[first]
        else:
            start[k] = owner[first]
    return owner, start
