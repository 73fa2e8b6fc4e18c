"""Who is eliminated when: the order in which a sparse symmetric matrix is factored, and where its factors lie.

Nodes that follow one another in the elimination with the same nodes after them share a panel, a dense matrix of their
columns. The order is the least degree that SuperLU finds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

Indices = NDArray[np.int64]

BLOCK = 6  # numbers of a node: rows and columns of a block
_WIDEST = 12  # nodes of a panel: its triangle is inverted by plain loops
_ZEROS = 8  # blocks that a node may bring into a panel for nothing


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


def analyse(n: int, i: Indices, j: Indices) -> Structure:
    """The structure of a matrix of n x n blocks with blocks (i, j) (m,) off the diagonal; a pair may come twice."""
    place = _least_degree(n, i, j)
    panels = _panels(n, np.minimum(place[i], place[j]), np.maximum(place[i], place[j]))
    again = np.empty(n, np.int64)  # a panel's nodes one after the other
    again[[node for own, _ in panels for node in own]] = np.arange(n)
    place = again[place]
    first = np.cumsum([0] + [len(own) for own, _ in panels])
    rows = [np.sort(again[after]) for _, after in panels]
    below = np.cumsum([0] + [len(row) for row in rows])
    width = np.diff(first)
    at = np.cumsum(np.append(0, BLOCK * BLOCK * width * (width + np.diff(below))))
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


def _panels(n: int, early: Indices, late: Indices) -> list[tuple[list[int], Indices]]:
    """Nodes of each panel and those below it, of pairs of nodes in an order of elimination."""
    order = np.argsort(early, kind="stable")
    at, after = _fill(n, np.searchsorted(early[order], np.arange(n + 1)), late[order])
    count = np.diff(at).tolist()
    parent = [int(after[at[node]]) if count[node] else -1 for node in range(n)]
    panels: list[list[int]] = []
    home = [0] * n
    for node in reversed(range(n)):
        above = panels[home[parent[node]]] if parent[node] >= 0 else []
        follows = above and above[-1] == parent[node] and len(above) < _WIDEST
        if follows and len(above) + count[above[0]] - count[node] <= _ZEROS:
            home[node] = home[parent[node]]
            above.append(node)
        else:
            home[node] = len(panels)
            panels.append([node])
    return [(own[::-1], after[at[own[0]] : at[own[0] + 1]]) for own in reversed(panels)]


@njit(cache=True, nogil=True)
def _fill(n, start, later):
    """Those after each node that its elimination joins: after[at[k] : at[k + 1]], rising.

    Its own neighbours after it, later[start[k] : start[k + 1]], and those of all nodes whose first it is.
    """
    at, after, met = np.zeros(n + 1, np.int64), np.empty(4 * len(later) + n, np.int64), np.full(n, -1)
    last_under, one_before = np.full(n, -1), np.full(n, -1)  # of the nodes whose first each is
    for node in range(n):
        end = at[node]
        if len(after) < end + n:
            grown = np.empty(2 * len(after) + n, np.int64)
            for k in range(end):
                grown[k] = after[k]
            after = grown
        for k in range(start[node], start[node + 1]):
            if met[later[k]] != node:
                met[later[k]], after[end] = node, later[k]
                end += 1
        under = last_under[node]
        while under >= 0:
            for k in range(at[under] + 1, at[under + 1]):
                if met[after[k]] != node:
                    met[after[k]], after[end] = node, after[k]
                    end += 1
            under = one_before[under]
        after[at[node] : end].sort()
        at[node + 1] = end
        if end > at[node]:
            first = after[at[node]]
            one_before[node], last_under[first] = last_under[first], node
    return at, after[: at[n]]
