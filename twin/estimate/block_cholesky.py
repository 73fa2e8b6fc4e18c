"""Cholesky factors of a sparse symmetric matrix of 6 x 6 blocks, and as much of its inverse as they tell.

Supernodal and right-looking (Davis 2006, chapter 4): nodes that follow one another in the elimination with the same
nodes after them share a panel, a dense matrix. A panel that is done subtracts its square from the panels after it, so
that beside the panels nothing is kept. The order is the least degree that SuperLU finds.

Marginals by Takahashi et al. (1973): from the last panel back, of W = L2 L1^-1 with L1 the panel's triangle, L2 the
rows below it, cov(below, own) = -cov(below) W and cov(own) = (L1 L1')^-1 + W' cov(below) W. What is below is in the
panel of the first node below, or below that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from twin.geometry import Array

Indices = NDArray[np.int64]

_D = 6  # of a block
_WIDEST = 12  # nodes of a panel: its triangle is inverted by plain loops
_ZEROS = 8  # blocks that a node may bring into a panel for nothing
_LEAST_PIVOT = 1e-13  # of what stood on the diagonal: less is rounding, the node is not held


class Structure(NamedTuple):
    """Where everything lies, of one pattern; places count nodes in the order of their elimination.

    Args:
        place: (n,) of each node.
        first: (s + 1,) first place of each panel.
        below, rows: places below panel s are rows[below[s] : below[s + 1]], rising.
        at: (s + 1,) where panels begin in one long array; (own + below, own) blocks each, row by row.
        panel_of: (n,) by place.
        pairs: (m, 2) row and column of each block off the diagonal, by place, the row later.
        turned: (m,) which of them are given the other way round.
    """

    place: Indices
    first: Indices
    below: Indices
    rows: Indices
    at: Indices
    panel_of: Indices
    pairs: Indices
    turned: NDArray[np.bool_]

    def below_of(self, panel: int) -> Indices:
        """Places below a panel, rising."""
        return self.rows[self.below[panel] : self.below[panel + 1]]

    def above(self, panel: int) -> int | None:
        """The panel of the first node below: eliminated later, it knows of all others below."""
        below = self.below_of(panel)
        return int(self.panel_of[below[0]]) if len(below) else None

    def columns(self, panel: int, places: Indices) -> Indices:
        """Where these places lie among a panel's nodes and those below it."""
        first, end = self.first[panel], self.first[panel + 1]
        return np.where(places < end, places - first, end - first + np.searchsorted(self.below_of(panel), places))


def analyse(n: int, i: Indices, j: Indices) -> Structure:
    """The structure of a matrix of n x n blocks with blocks (i, j) (m,) off the diagonal; a pair may come twice."""
    place = _least_degree(n, i, j)
    panels = _panels(n, np.minimum(place[i], place[j]).tolist(), np.maximum(place[i], place[j]).tolist())
    again = np.empty(n, np.int64)  # a panel's nodes one after the other
    again[[node for own, _ in panels for node in own]] = np.arange(n)
    place = again[place]
    first = np.cumsum([0] + [len(own) for own, _ in panels])
    rows = [np.sort(again[list(after)]) for _, after in panels]
    below = np.cumsum([0] + [len(row) for row in rows])
    width = np.diff(first)
    at = np.cumsum(np.append(0, _D * _D * width * (width + np.diff(below))))
    pairs = np.column_stack([np.maximum(place[i], place[j]), np.minimum(place[i], place[j])])
    panel_of = np.repeat(np.arange(len(panels)), width)
    every_row = np.concatenate([np.empty(0, np.int64), *rows])
    return Structure(place, first, below, every_row, at, panel_of, pairs, place[i] < place[j])


def _least_degree(n: int, i: Indices, j: Indices) -> Indices:
    """(n,) place of each node in the order of least degree."""
    off = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    pattern = ((off + off.T) > 0).astype(np.float64)
    dominant = sparse.diags_array(np.asarray(pattern.sum(axis=1)).ravel() + 1.0)
    found = splu((pattern + dominant).tocsc(), "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True})
    return found.perm_c.astype(np.int64)


def _panels(n: int, early: Sequence[int], late: Sequence[int]) -> list[tuple[list[int], set[int]]]:
    """Nodes of each panel and those below it, of pairs of nodes in an order of elimination.

    A panel comes right after all that it is above of: so few joint covariances are needed at a time.
    """
    after: list[set[int]] = [set() for _ in range(n)]
    for a, b in zip(early, late, strict=True):
        after[a].add(b)
    parent = [-1] * n
    for node in range(n):
        if after[node]:
            parent[node] = min(after[node])
            after[parent[node]] |= after[node]
            after[parent[node]].discard(parent[node])
    panels: list[list[int]] = []
    home = [0] * n
    for node in reversed(range(n)):
        above = panels[home[parent[node]]] if parent[node] >= 0 else []
        follows = above and above[-1] == parent[node] and len(above) < _WIDEST
        if follows and len(above) + len(after[above[0]]) - len(after[node]) <= _ZEROS:
            home[node] = home[parent[node]]
            above.append(node)
        else:
            home[node] = len(panels)
            panels.append([node])
    under: list[list[int]] = [[] for _ in panels]
    roots: list[int] = []
    for panel, own in enumerate(panels):
        (under[home[parent[own[0]]]] if parent[own[0]] >= 0 else roots).append(panel)
    last_to_first, waiting = [], roots
    while waiting:
        last_to_first.append(panels[waiting.pop()])
        waiting += under[home[last_to_first[-1][0]]]
    return [(own[::-1], after[own[0]]) for own in reversed(last_to_first)]


class Factor(NamedTuple):
    """L1^-1 over L2 of each panel, in one long array."""

    structure: Structure
    panels: Array

    def solve(self, right: Array) -> Array:
        """(n, 6) the solution for a right side (n, 6)."""
        s = self.structure
        x = np.empty_like(right)
        x[s.place] = right
        _substitute(s.first, s.below, s.rows, s.at, self.panels, x.reshape(-1))
        return x[s.place]

    def marginal(self, node: int) -> Array:
        """(6, 6) block of the inverse: of y = L^-1 e with e the node's columns, y'y; only the panels above meet e."""
        s = self.structure
        right, found = np.zeros((len(s.place), _D, _D)), np.zeros((_D, _D))
        right[s.place[node]] = np.eye(_D)
        panel: int | None = int(s.panel_of[s.place[node]])
        while panel is not None:
            inverse, rest = self._panel(panel)
            y = inverse @ right[s.first[panel] : s.first[panel + 1]].reshape(-1, _D)
            right[s.below_of(panel)] -= (rest @ y).reshape(-1, _D, _D)
            found += y.T @ y
            panel = s.above(panel)
        return found

    def marginals(self) -> Array:
        """(n, 6, 6) all blocks on the inverse's diagonal."""
        s = self.structure
        count = len(s.first) - 1
        below = Counter(s.above(panel) for panel in range(count))
        joints: dict[int | None, Array] = {}
        found = np.empty((len(s.place), _D, _D))
        for panel in reversed(range(count)):
            above = s.above(panel)
            joint = joints[panel] = self._joint(panel, above, joints.get(above))
            own = np.arange(s.first[panel + 1] - s.first[panel])
            found[s.first[panel] + own] = joint.reshape(len(joint) // _D, _D, -1, _D)[own, :, own]
            below[above] -= 1
            for done in (panel, above):  # what nobody below will ask is forgotten
                if not below[done]:
                    joints.pop(done, None)
        return found[s.place]

    def _panel(self, panel: int) -> tuple[Array, Array]:
        """L1^-1 and L2."""
        s = self.structure
        own = _D * int(s.first[panel + 1] - s.first[panel])
        matrix = self.panels[s.at[panel] : s.at[panel + 1]].reshape(-1, own)
        return matrix[:own], matrix[own:]

    def _joint(self, panel: int, above: int | None, of_above: Array | None) -> Array:
        """Covariance of a panel's nodes and of those below it, by that of the panel above, which has these."""
        inverse, rest = self._panel(panel)
        own = len(inverse)
        joint = np.empty((own + len(rest), own + len(rest)))
        joint[:own, :own] = inverse.T @ inverse
        if above is not None and of_above is not None:
            _pick(of_above, self.structure.columns(above, self.structure.below_of(panel)), joint[own:, own:])
            weight = rest @ inverse
            joint[own:, :own] = -joint[own:, own:] @ weight
            joint[:own, own:] = joint[own:, :own].T
            joint[:own, :own] -= weight.T @ joint[own:, :own]
        return joint


def factorise(structure: Structure, diagonal: Array, off: Array) -> Factor:
    """Factors of the matrix with blocks (n, 6, 6) on the diagonal and (m, 6, 6) off it.

    Raises:
        LinAlgError: it is not positive definite, to rounding.
    """
    s = structure
    panels, whole = np.zeros(s.at[-1]), np.empty((len(s.place), _D))
    whole[s.place] = np.diagonal(diagonal, axis1=1, axis2=2)
    _place(s.place, s.pairs, s.turned, s.first, s.below, s.rows, s.at, s.panel_of, diagonal, off, panels)
    if not _eliminate(s.first, s.below, s.rows, s.at, s.panel_of, whole.reshape(-1), panels):
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return Factor(structure, panels)


@njit(cache=True, nogil=True)
def _place(place, pairs, turned, first, below, rows, at, panel_of, diagonal, off, panels):
    """Adds the blocks of the matrix to the panels."""
    for k in range(len(diagonal)):
        p = panel_of[place[k]]
        width, x = first[p + 1] - first[p], place[k] - first[p]
        panel = panels[at[p] : at[p + 1]].reshape(-1, _D * width)
        panel[_D * x : _D * x + _D, _D * x : _D * x + _D] += diagonal[k]
    for k in range(len(off)):
        row, column = pairs[k]
        p = panel_of[column]
        width, x = first[p + 1] - first[p], column - first[p]
        y = row - first[p]
        if y >= width:
            y = width + np.searchsorted(rows[below[p] : below[p + 1]], row)
        panel = panels[at[p] : at[p + 1]].reshape(-1, _D * width)
        for i in range(_D):
            for j in range(_D):
                panel[_D * y + i, _D * x + j] += off[k, j, i] if turned[k] else off[k, i, j]


@njit(cache=True, nogil=True)
def _eliminate(first, below, rows, at, panel_of, whole, panels):
    """Turns each panel into L1^-1 over L2; whether every node is held, by the diagonal (6 n,) as it was."""
    for p in range(len(first) - 1):
        n = _D * (first[p + 1] - first[p])
        panel = panels[at[p] : at[p + 1]].reshape(-1, n)
        inverse = np.zeros((n, n))
        if not _invert_root(panel[:n], whole[_D * first[p] : _D * first[p + 1]], inverse):
            return False
        panel[:n] = inverse
        if len(panel) > n:
            panel[n:] = np.dot(panel[n:], inverse.T)
            square = np.dot(panel[n:], panel[n:].T)
            _subtract(square, rows[below[p] : below[p + 1]], first, below, rows, at, panel_of, panels)
    return True


@njit(cache=True, nogil=True)
def _invert_root(matrix, whole, inverse):
    """Fills `inverse` (n, n) with that of the lower triangular root of a matrix (n, n), of which the lower half counts.

    Row by row: what the rows before leave of a row is its part of the root. False where a pivot is but rounding of what
    had been on the diagonal (n,).
    """
    root = np.zeros_like(matrix)
    for i in range(len(matrix)):
        for k in range(i):
            total = matrix[i, k]
            for m in range(k):
                total -= root[i, m] * root[k, m]
            root[i, k] = total * inverse[k, k]
        pivot = matrix[i, i]
        for m in range(i):
            pivot -= root[i, m] * root[i, m]
        if not pivot > _LEAST_PIVOT * whole[i]:
            return False
        per_pivot = 1 / np.sqrt(pivot)
        for k in range(i):
            for m in range(k + 1):
                inverse[i, m] -= root[i, k] * inverse[k, m]
        for m in range(i):
            inverse[i, m] *= per_pivot
        inverse[i, i] = per_pivot
    return True


@njit(cache=True, nogil=True)
def _pick(matrix, blocks, out):
    """Fills `out` with rows and columns of these blocks of a matrix."""
    for a in range(len(blocks)):
        for i in range(_D):
            row, into = matrix[_D * blocks[a] + i], out[_D * a + i]
            for b in range(len(blocks)):
                for j in range(_D):
                    into[_D * b + j] = row[_D * blocks[b] + j]


@njit(cache=True, nogil=True)
def _subtract(square, places, first, below, rows, at, panel_of, panels):
    """Takes what a panel's square says of the places below it from the panels that have them."""
    start = 0
    while start < len(places):
        p = panel_of[places[start]]
        width, end = first[p + 1] - first[p], start
        while end < len(places) and places[end] < first[p + 1]:
            end += 1
        panel, row = panels[at[p] : at[p + 1]].reshape(-1, _D * width), below[p]
        for b in range(start, len(places)):
            y = places[b] - first[p]
            if y >= width:
                while rows[row] != places[b]:
                    row += 1
                y = width + row - below[p]
            for a in range(start, min(b + 1, end)):
                x = places[a] - first[p]
                for i in range(_D):
                    for j in range(_D):
                        panel[_D * y + i, _D * x + j] -= square[_D * b + i, _D * a + j]
        start = end


@njit(cache=True, nogil=True)
def _substitute(first, below, rows, at, panels, x):
    """Solves in place, x (6 n,) by place: forwards by L, backwards by its transpose."""
    for p in range(len(first) - 1):
        own = x[_D * first[p] : _D * first[p + 1]]
        panel = panels[at[p] : at[p + 1]].reshape(-1, len(own))
        own[:] = np.dot(panel[: len(own)], own)
        if len(panel) > len(own):
            known = np.dot(panel[len(own) :], own)
            for k in range(below[p], below[p + 1]):
                for i in range(_D):
                    x[_D * rows[k] + i] -= known[_D * (k - below[p]) + i]
    for p in range(len(first) - 2, -1, -1):
        own = x[_D * first[p] : _D * first[p + 1]]
        panel = panels[at[p] : at[p + 1]].reshape(-1, len(own))
        if len(panel) > len(own):
            later = np.empty(len(panel) - len(own))
            for k in range(below[p], below[p + 1]):
                later[_D * (k - below[p]) : _D * (k - below[p]) + _D] = x[_D * rows[k] : _D * rows[k] + _D]
            own -= np.dot(panel[len(own) :].T, later)
        own[:] = np.dot(panel[: len(own)].T, own)
