"""Supernodal Cholesky factorisation of a sparse symmetric matrix of 6 x 6 blocks, and blocks of its inverse.

Right-looking (Davis 2006, chapter 4). A finished panel (see `elimination`) stores L1^-1 above L2: L1 is the lower
triangular block in the panel's own rows, L2 the nonzero rows below.

Blocks of the inverse cov are computed from the last panel to the first, in place (Takahashi et al. 1973): with W = L2
L1^-1, cov(below, own) = -cov(below) W and cov(own) = (L1 L1')^-1 + W' cov(below) W.

In the kernels, s is the `SymbolicFactor`, `panels` the values of all panels, p the number of a panel, and `_D` the
number of rows of a block.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.estimate.adjustment.elimination import BLOCK as _D
from twin.estimate.adjustment.elimination import SymbolicFactor
from twin.kernels import kernel

_MIN_RELATIVE_PIVOT = 1e-13  # relative to the original diagonal entry; a smaller pivot counts as zero


class CholeskyFactor(NamedTuple):
    symbolic: SymbolicFactor  #: sparsity pattern and memory layout
    panels: Array  #: values of all panels in one long array; a panel holds L1^-1 above L2

    def solve(self, right: Array) -> Array:
        s = self.symbolic
        x = np.empty_like(right)
        x[s.permutation] = right
        _solve_in_place(s, self.panels, x.reshape(-1))
        return x[s.permutation]

    def sample(self, normals: Array) -> Array:
        """Returns m vectors L^-T z (n, 6, m), of covariance the inverse matrix, from normal numbers z (m, n, 6)."""
        s = self.symbolic
        x = np.ascontiguousarray(normals.reshape(len(normals), -1).T)
        _solve_transposed_in_place(s, self.panels, x)
        return x.reshape(-1, _D, len(normals))[s.permutation]

    def inverse_block(self, node: int) -> Array:
        """Returns the diagonal block (6, 6) of the inverse matrix that belongs to a node."""
        # y'y with y = L^-1 e, e the node's columns of the identity; only its panel and the ancestors of that contribute
        s = self.symbolic
        right, block = np.zeros((len(s.permutation), _D, _D)), np.zeros((_D, _D))
        right[s.permutation[node]] = np.eye(_D)
        panel: int | None = int(s.panel_of[s.permutation[node]])
        while panel is not None:
            matrix = _panel_matrix(s, self.panels, panel)
            own = matrix.shape[1]
            y = matrix[:own] @ right[s.panel_start[panel] : s.panel_start[panel + 1]].reshape(-1, _D)
            right[s.rows_below(panel)] -= (matrix[own:] @ y).reshape(-1, _D, _D)
            block += y.T @ y
            panel = s.parent(panel)
        return block

    def invert_in_place(self) -> Array:
        """Returns all diagonal blocks (n, 6, 6) of the inverse. Overwrites the factor, which cannot be used again."""
        s = self.symbolic
        blocks = np.empty((len(s.permutation), _D, _D))
        _invert(s, self.panels, blocks)
        return blocks[s.permutation]


class BlockMatrix(NamedTuple):
    """Symmetric block matrix, stored with the memory layout of its Cholesky factor."""

    symbolic: SymbolicFactor  #: sparsity pattern and memory layout
    panels: Array  #: values of all panels in one long array, modified in place

    def add(self, first: int, blocks: Array) -> None:
        """Adds blocks (k, 6, 6) to the k off-diagonal blocks from index `first`, in the order given to `analyse`."""
        _add(self.symbolic, first, blocks, self.panels)

    def factorise(self, diagonal: Array) -> CholeskyFactor:
        """Returns the Cholesky factor with diagonal blocks (n, 6, 6), in place of the matrix. Raises LinAlgError."""
        s, original = self.symbolic, np.empty((len(diagonal), _D))
        original[s.permutation] = np.diagonal(diagonal, axis1=1, axis2=2)
        _set_diagonal(s, diagonal, self.panels)
        if not _factorise(s, original.reshape(-1), self.panels):
            raise np.linalg.LinAlgError("the matrix is not positive definite")
        return CholeskyFactor(s, self.panels)


@kernel
def _set_diagonal(s, diagonal, panels):
    for k in range(len(diagonal)):
        p = s.panel_of[s.permutation[k]]
        x = s.permutation[k] - s.panel_start[p]
        geometry.copy_into(_panel_matrix(s, panels, p)[_D * x : _D * x + _D, _D * x : _D * x + _D], diagonal[k])


@kernel
def _add(s, start, blocks, panels):
    for k in range(len(blocks)):
        row, column = s.off_diagonal[start + k]
        p = s.panel_of[column]
        width, x = s.panel_start[p + 1] - s.panel_start[p], column - s.panel_start[p]
        y, panel = row - s.panel_start[p], _panel_matrix(s, panels, p)
        if y >= width:
            y = width + np.searchsorted(s.rows[s.row_start[p] : s.row_start[p + 1]], row)
        for i in range(_D):
            for j in range(_D):
                panel[_D * y + i, _D * x + j] += blocks[k, j, i] if s.transposed[start + k] else blocks[k, i, j]


@kernel
def _panel_matrix(s, panels, p):
    return panels[s.offset[p] : s.offset[p + 1]].reshape(-1, _D * (s.panel_start[p + 1] - s.panel_start[p]))


@kernel
def _factorise(s, original, panels):
    """Factorises the matrix in place; False if it is not positive definite. `original` (6 n,) is its diagonal."""
    for p in range(len(s.panel_start) - 1):
        n, panel = _D * (s.panel_start[p + 1] - s.panel_start[p]), _panel_matrix(s, panels, p)
        inverse = np.zeros((n, n))
        if not _invert_root(panel[:n], original[_D * s.panel_start[p] : _D * s.panel_start[p + 1]], inverse):
            return False
        geometry.copy_into(panel[:n], inverse)
        if len(panel) > n:
            below, positions = np.dot(panel[n:], inverse.T), s.rows[s.row_start[p] : s.row_start[p + 1]]
            geometry.copy_into(panel[n:], below)
            start = 0
            while start < len(positions):
                end, ancestor, at = _next_ancestor(s, positions, start)
                product = np.dot(below[_D * start :], below[_D * start : _D * end].T)
                _subtract(product, at, _panel_matrix(s, panels, ancestor))
                start = end
    return True


@kernel
def _invert_root(matrix, original, inverse):
    """Fills `inverse` with that of the Cholesky factor; False where a pivot is tiny relative to `original` (n,)."""
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
        if not pivot > _MIN_RELATIVE_PIVOT * original[i]:
            return False
        per_pivot = 1 / np.sqrt(pivot)
        for k in range(i):
            for m in range(k + 1):
                inverse[i, m] -= root[i, k] * inverse[k, m]
        for m in range(i):
            inverse[i, m] *= per_pivot
        inverse[i, i] = per_pivot
    return True


@kernel
def _next_ancestor(s, positions, start):
    """Finds the panel p that holds positions[start:end]: returns `end`, p and block rows of positions[start:] in p."""
    p, end = s.panel_of[positions[start]], start
    while end < len(positions) and positions[end] < s.panel_start[p + 1]:
        end += 1
    at, row = np.empty(len(positions) - start, np.int64), s.row_start[p]
    for k in range(start, len(positions)):
        if k < end:
            at[k - start] = positions[k] - s.panel_start[p]
        else:
            while s.rows[row] != positions[k]:
                row += 1
            at[k - start] = s.panel_start[p + 1] - s.panel_start[p] + row - s.row_start[p]
    return end, p, at


@kernel
def _subtract(product, at, panel):
    """Subtracts the lower block triangle of `product` (6 m, 6 w) from a panel, at its block rows `at` (m,)."""
    for b in range(len(at)):
        for a in range(min(b + 1, product.shape[1] // _D)):
            for i in range(_D):
                for k in range(_D):
                    panel[_D * at[b] + i, _D * at[a] + k] -= product[_D * b + i, _D * a + k]


@kernel
def _gather(panel, at, width):
    """Returns a copy (6 m, 6 width) of a panel's blocks in the block rows `at` (m,) and block columns at[:width]."""
    part = np.empty((_D * len(at), _D * width))
    for b in range(len(at)):
        for a in range(width):
            for i in range(_D):
                for k in range(_D):
                    part[_D * b + i, _D * a + k] = panel[_D * at[b] + i, _D * at[a] + k]
    return part


@kernel
def _invert(s, panels, diagonal):
    """Replaces the factor by the blocks of the inverse in its sparsity pattern; fills `diagonal` (n, 6, 6)."""
    for p in range(len(s.panel_start) - 2, -1, -1):
        panel, width = _panel_matrix(s, panels, p), s.panel_start[p + 1] - s.panel_start[p]
        n = _D * width
        own = np.dot(panel[:n].T, panel[:n])
        if len(panel) > n:
            weight, positions = np.dot(panel[n:], panel[:n]), s.rows[s.row_start[p] : s.row_start[p + 1]]
            product, start = np.zeros_like(weight), 0  # cov(below) W
            while start < len(positions):
                end, ancestor, at = _next_ancestor(s, positions, start)
                part = _gather(_panel_matrix(s, panels, ancestor), at, end - start)
                remaining, current = product[_D * start :], product[_D * start : _D * end]
                remaining += np.dot(part, weight[_D * start : _D * end])
                if end < len(positions):
                    current += np.dot(part[_D * (end - start) :].T, weight[_D * end :])
                start = end
            own += np.dot(weight.T, product)
            geometry.copy_into(panel[n:], -product)
        geometry.copy_into(panel[:n], own)
        for k in range(width):
            geometry.copy_into(diagonal[s.panel_start[p] + k], own[_D * k : _D * k + _D, _D * k : _D * k + _D])


@kernel
def _solve_in_place(s, panels, x):
    """Solves the factorised linear system; the right-hand side x (6 n,), in elimination order, becomes the solution."""
    for p in range(len(s.panel_start) - 1):
        own = x[_D * s.panel_start[p] : _D * s.panel_start[p + 1]]
        panel = _panel_matrix(s, panels, p)
        geometry.copy_into(own, np.dot(panel[: len(own)], own))
        if len(panel) > len(own):
            product = np.dot(panel[len(own) :], own)
            for k in range(s.row_start[p], s.row_start[p + 1]):
                for i in range(_D):
                    x[_D * s.rows[k] + i] -= product[_D * (k - s.row_start[p]) + i]
    _solve_transposed_in_place(s, panels, x)


@kernel
def _solve_transposed_in_place(s, panels, x):
    """Solves L' y = x for the transposed factor; x, (6 n,) or (6 n, m) in elimination order, becomes y."""
    for p in range(len(s.panel_start) - 2, -1, -1):
        own = x[_D * s.panel_start[p] : _D * s.panel_start[p + 1]]
        panel = _panel_matrix(s, panels, p)
        if len(panel) > len(own):
            below = np.empty((len(panel) - len(own), *x.shape[1:]))
            for k in range(s.row_start[p], s.row_start[p + 1]):
                part, row = below[_D * (k - s.row_start[p]) :], _D * s.rows[k]
                geometry.copy_into(part[:_D], x[row : row + _D])
            own -= np.dot(panel[len(own) :].T, below)
        geometry.copy_into(own, np.dot(panel[: len(own)].T, own))
