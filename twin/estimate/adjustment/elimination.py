"""Symbolic analysis of a sparse symmetric block matrix: elimination order, fill-in and storage of its Cholesky factor.

The order is SuperLU's multiple minimum degree order of A' + A. Nodes on a path of the elimination tree with nearly the
same pattern below the diagonal form a supernode, whose columns are one dense matrix, a panel.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from twin.core.records import Mask
from twin.kernels import kernel

Indices = NDArray[np.int64]

BLOCK = 6  # rows and columns of a block: degrees of freedom of a pose
_MAX_PANEL_NODES = 12  # the triangular block of a panel is inverted by loops, which are slow for larger matrices
_MAX_EXTRA_BLOCKS = 8  # explicit zero blocks that merging a node into a panel may add


class SymbolicFactor(NamedTuple):
    """Sparsity pattern and memory layout of a Cholesky factor; a position is an index in the elimination order."""

    permutation: Indices  #: (n,) position of each node
    panel_start: Indices  #: (s + 1,) panel p of s panels holds the positions panel_start[p] to panel_start[p + 1] - 1
    #: row_start, rows: (s + 1,), (r,) the positions of the nonzero block rows below panel p are rows[row_start[p] :
    #: row_start[p + 1]], ascending.
    row_start: Indices
    rows: Indices
    #: (s + 1,) index of the first element of each panel in one long array, and the length of this array. A panel is a
    #: row-major matrix, its block rows are its own positions and those below, its block columns its own positions.
    offset: Indices
    panel_of: Indices  #: (n,) number of the panel that holds each position
    off_diagonal: Indices  #: (m, 2) row and column position of each off-diagonal block, row > column
    transposed: Mask  #: (m,) true where a block (i, j) has to be transposed, as node i is eliminated before node j

    def rows_below(self, panel: int) -> Indices:
        return self.rows[self.row_start[panel] : self.row_start[panel + 1]]

    def parent(self, panel: int) -> int | None:
        """Returns the panel of the first position below this one, its parent in the elimination tree, or None."""
        below = self.rows_below(panel)
        return int(self.panel_of[below[0]]) if len(below) else None


def analyse(n: int, i: Indices, j: Indices) -> SymbolicFactor:
    """Returns the symbolic factor of n x n blocks with off-diagonal blocks (i, j), i not j; pairs may occur again."""
    permutation = _minimum_degree(n, i, j)
    panels = _supernodes(n, np.minimum(permutation[i], permutation[j]), np.maximum(permutation[i], permutation[j]))
    renumbered = np.empty(n, np.int64)  # makes the nodes of a panel consecutive
    renumbered[[node for own, _ in panels for node in own]] = np.arange(n)
    permutation = renumbered[permutation]
    panel_start = np.cumsum([0] + [len(own) for own, _ in panels])
    rows = [np.sort(renumbered[below]) for _, below in panels]
    row_start = np.cumsum([0] + [len(row) for row in rows])
    width = np.diff(panel_start)
    offset = np.cumsum(np.append(0, BLOCK * BLOCK * width * (width + np.diff(row_start))))
    row, column = np.maximum(permutation[i], permutation[j]), np.minimum(permutation[i], permutation[j])
    return SymbolicFactor(
        permutation=permutation, panel_start=panel_start, row_start=row_start,
        rows=np.concatenate([np.empty(0, np.int64), *rows]), offset=offset,
        panel_of=np.repeat(np.arange(len(panels)), width), off_diagonal=np.column_stack([row, column]),
        transposed=permutation[i] < permutation[j],
    )  # fmt: skip


def _minimum_degree(n: int, i: Indices, j: Indices) -> Indices:
    off = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    pattern = ((off + off.T) > 0).astype(np.float64)
    dominant = sparse.diags_array(np.asarray(pattern.sum(axis=1)).ravel() + 1.0)
    decomposition = splu((pattern + dominant).tocsc(), "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True})
    return decomposition.perm_c.astype(np.int64)


def _supernodes(n: int, early: Indices, late: Indices) -> list[tuple[list[int], Indices]]:
    """Returns by supernode its nodes and those of the rows below; nodes early < late (m,) are in elimination order."""
    order = np.argsort(early, kind="stable")
    start, below = _fill_in(n, np.searchsorted(early[order], np.arange(n + 1)), late[order])
    count = np.diff(start).tolist()
    parent = [int(below[start[node]]) if count[node] else -1 for node in range(n)]
    panels: list[list[int]] = []
    panel_of = [0] * n
    for node in reversed(range(n)):
        candidate = panels[panel_of[parent[node]]] if parent[node] >= 0 else []
        extends = candidate and candidate[-1] == parent[node] and len(candidate) < _MAX_PANEL_NODES
        if extends and len(candidate) + count[candidate[0]] - count[node] <= _MAX_EXTRA_BLOCKS:
            panel_of[node] = panel_of[parent[node]]
            candidate.append(node)
        else:
            panel_of[node] = len(panels)
            panels.append([node])
    return [(own[::-1], below[start[own[0]] : start[own[0] + 1]]) for own in reversed(panels)]


@kernel
def _fill_in(n, start, later):
    """Returns the rows below the diagonal of each column k: below[at[k] : at[k + 1]] (Davis 2006, chapter 4)."""
    at, below, marked_by = np.zeros(n + 1, np.int64), np.empty(4 * len(later) + n, np.int64), np.full(n, -1)
    last_child, previous_sibling = np.full(n, -1), np.full(n, -1)  # children of each node as linked lists
    for node in range(n):
        end = at[node]
        if len(below) < end + n:
            grown = np.empty(2 * len(below) + n, np.int64)
            for k in range(end):
                grown[k] = below[k]
            below = grown
        for k in range(start[node], start[node + 1]):
            if marked_by[later[k]] != node:
                marked_by[later[k]], below[end] = node, later[k]
                end += 1
        child = last_child[node]
        while child >= 0:
            for k in range(at[child] + 1, at[child + 1]):
                if marked_by[below[k]] != node:
                    marked_by[below[k]], below[end] = node, below[k]
                    end += 1
            child = previous_sibling[child]
        below[at[node] : end].sort()
        at[node + 1] = end
        if end > at[node]:
            parent = below[at[node]]
            previous_sibling[node], last_child[parent] = last_child[parent], node
    return at, below[: at[n]]
