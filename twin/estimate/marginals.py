"""Marginal covariances of an eliminated graph: as much of the inverse as the elimination touched, and no more.

Elimination leaves, variable by variable, R x + S p = d with the parents p that are eliminated later. Variables that
follow one another with the same parents form a supernode, whose rows are taken together: from the last one back,
cov(x, p) = -W cov(p, p) and cov(x, x) = (R'R)^-1 - cov(x, p) W' with W = R^-1 S (Takahashi et al. 1973). The covariance
of the parents is at hand: they all belong to, or are parents of, the supernode of the one eliminated first among them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from twin.geometry import Array

Columns = NDArray[np.int64]


class _Row(NamedTuple):
    """A variable of the eliminated graph, its parents in the order of their columns in S, and who has R and S."""

    key: int
    parents: tuple[int, ...]
    conditional: gtsam.GaussianConditional


class _Supernode(NamedTuple):
    """Variables in the order of their elimination, and the number of the supernode with the first of their parents."""

    rows: list[_Row]
    above: int | None

    @property
    def parents(self) -> tuple[int, ...]:
        return self.rows[-1].parents


class _Joint:
    """Covariance of a supernode's variables and of their parents, by that of the supernode above, which has these."""

    def __init__(self, node: _Supernode, above: _Joint | None):
        matrices = [row.conditional.R() for row in node.rows]
        sizes = {row.key: len(r) for row, r in zip(node.rows, matrices, strict=True)}
        n = sum(sizes.values())
        if above is not None:
            sizes |= {key: len(above.place[key]) for key in node.parents}
        ends = np.cumsum([0, *sizes.values()])
        self.place = {key: np.arange(a, b) for key, a, b in zip(sizes, ends, ends[1:], strict=False)}
        self.cov = np.empty((ends[-1], ends[-1]))
        eliminated = np.zeros((n, ends[-1]))
        for row, r in zip(node.rows, matrices, strict=True):
            own = self.place[row.key]
            eliminated[own[:, None], own] = r
            eliminated[own[:, None], self._columns(row.parents)] = row.conditional.S()
        inverse = solve_triangular(eliminated[:, :n], np.eye(n), check_finite=False)
        self.cov[:n, :n] = inverse @ inverse.T
        if above is not None:
            weight = inverse @ eliminated[:, n:]
            self.cov[n:, n:] = above.part(node.parents)
            self.cov[:n, n:] = -weight @ self.cov[n:, n:]
            self.cov[n:, :n] = self.cov[:n, n:].T
            self.cov[:n, :n] -= self.cov[:n, n:] @ weight.T

    def part(self, keys: Sequence[int]) -> Array:
        """What it says of some of the variables."""
        columns = self._columns(keys)
        return self.cov[columns[:, None], columns]

    def _columns(self, keys: Sequence[int]) -> Columns:
        return np.concatenate([self.place[key] for key in keys]) if keys else np.empty(0, np.int64)


def marginals(net: gtsam.GaussianBayesNet) -> dict[int, Array]:
    """Covariance (d, d) of each variable."""
    supernodes = _supernodes([_row(net.at(k)) for k in reversed(range(net.size()))])
    below = Counter(node.above for node in supernodes)
    joints: dict[int | None, _Joint] = {}
    found: dict[int, Array] = {}
    for number, node in enumerate(supernodes):
        joint = joints[number] = _Joint(node, joints.get(node.above))
        found |= {row.key: joint.part([row.key]) for row in node.rows}
        below[node.above] -= 1
        for done in (number, node.above):
            if not below[done]:
                joints.pop(done, None)
    return found


def _row(conditional: gtsam.GaussianConditional) -> _Row:
    key, *parents = conditional.keys()
    return _Row(key, tuple(parents), conditional)


def _supernodes(rows: Sequence[_Row]) -> list[_Supernode]:
    """All supernodes, from the last one eliminated back, of rows in that order."""
    turn = {row.key: -k for k, row in enumerate(rows)}
    home: dict[int | None, int] = {}
    supernodes: list[_Supernode] = []
    for row in rows:
        first = min(row.parents, key=turn.__getitem__, default=None)
        above = home.get(first)
        if above is not None and _follows(row, first, supernodes[above].rows[0]):
            supernodes[above].rows.insert(0, row)
            home[row.key] = above
        else:
            home[row.key] = len(supernodes)
            supernodes.append(_Supernode([row], above))
    return supernodes


def _follows(row: _Row, first: int | None, last: _Row) -> bool:
    """Whether a row has no other parents than the one eliminated next and that one's."""
    return last.key == first and len(row.parents) == 1 + len(last.parents)
