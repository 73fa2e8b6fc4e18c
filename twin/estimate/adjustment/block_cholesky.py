"""Cholesky factors of a sparse symmetric matrix of 6 x 6 blocks, and as much of its inverse as they tell.

Supernodal and right-looking (Davis 2006, chapter 4): a panel of nodes that is done subtracts its square from the panels
after it, so that beside the panels nothing is kept.

Marginals by Takahashi et al. (1973): from the last panel back, of W = L2 L1^-1 with L1 the panel's triangle, L2 the
rows below it, cov(below, own) = -cov(below) W and cov(own) = (L1 L1')^-1 + W' cov(below) W. The panels after it hold
all of cov(below) by then, in the place of their part of the factor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from twin.core import geometry
from twin.core.geometry import Array
from twin.estimate.adjustment.elimination import BLOCK as _D
from twin.estimate.adjustment.elimination import Structure

_LEAST_PIVOT = 1e-13  # of what stood on the diagonal: less is rounding, the node is not held


class Factor(NamedTuple):
    """L1^-1 over L2 of each panel, in one long array."""

    structure: Structure
    panels: Array

    def solve(self, right: Array) -> Array:
        """(n, 6) the solution for a right side (n, 6)."""
        s = self.structure
        x = np.empty_like(right)
        x[s.place] = right
        _substitute(s, self.panels, x.reshape(-1))
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

    def into_marginals(self) -> Array:
        """(n, 6, 6) all blocks on the inverse's diagonal. They take the place of the factor, which is used up."""
        s = self.structure
        found = np.empty((len(s.place), _D, _D))
        _invert(s, self.panels, found)
        return found[s.place]

    def _panel(self, panel: int) -> tuple[Array, Array]:
        """L1^-1 and L2."""
        matrix = _panel_of(self.structure, self.panels, panel)
        own = matrix.shape[1]
        return matrix[:own], matrix[own:]


class Matrix(NamedTuple):
    """A symmetric matrix, its blocks in the panels of the factor that it will become."""

    structure: Structure
    panels: Array

    @classmethod
    def room(cls, structure: Structure) -> Matrix:
        """One of this pattern; what is in it is not defined."""
        return cls(structure, np.empty(structure.at[-1]))

    def clear(self) -> None:
        """Sets all blocks to zero."""
        self.panels[:] = 0.0

    def add(self, first: int, blocks: Array) -> None:
        """Adds blocks (k, 6, 6) of the pairs from this one on."""
        _add(self.structure, first, blocks, self.panels)

    def factorise(self, diagonal: Array) -> Factor:
        """Its factor, with these blocks (n, 6, 6) on the diagonal. It takes the place of the matrix, which is used up.

        Raises:
            LinAlgError: it is not positive definite, to rounding.
        """
        s, whole = self.structure, np.empty((len(diagonal), _D))
        whole[s.place] = np.diagonal(diagonal, axis1=1, axis2=2)
        _put_diagonal(s, diagonal, self.panels)
        if not _eliminate(s, whole.reshape(-1), self.panels):
            raise np.linalg.LinAlgError("the matrix is not positive definite")
        return Factor(s, self.panels)


@njit(cache=True, nogil=True)
def _put_diagonal(s, diagonal, panels):
    for k in range(len(diagonal)):
        p = s.panel_of[s.place[k]]
        x = s.place[k] - s.first[p]
        geometry.put(_panel_of(s, panels, p)[_D * x : _D * x + _D, _D * x : _D * x + _D], diagonal[k])


@njit(cache=True, nogil=True)
def _add(s, start, blocks, panels):
    for k in range(len(blocks)):
        row, column = s.pairs[start + k]
        p = s.panel_of[column]
        width, x = s.first[p + 1] - s.first[p], column - s.first[p]
        y, panel = row - s.first[p], _panel_of(s, panels, p)
        if y >= width:
            y = width + np.searchsorted(s.rows[s.below[p] : s.below[p + 1]], row)
        for i in range(_D):
            for j in range(_D):
                panel[_D * y + i, _D * x + j] += blocks[k, j, i] if s.turned[start + k] else blocks[k, i, j]


@njit(cache=True, nogil=True)
def _panel_of(s, panels, p):
    """A panel as a matrix."""
    return panels[s.at[p] : s.at[p + 1]].reshape(-1, _D * (s.first[p + 1] - s.first[p]))


@njit(cache=True, nogil=True)
def _eliminate(s, whole, panels):
    """Turns each panel into L1^-1 over L2; whether every node is held, by the diagonal (6 n,) as it was."""
    for p in range(len(s.first) - 1):
        n, panel = _D * (s.first[p + 1] - s.first[p]), _panel_of(s, panels, p)
        inverse = np.zeros((n, n))
        if not _invert_root(panel[:n], whole[_D * s.first[p] : _D * s.first[p + 1]], inverse):
            return False
        geometry.put(panel[:n], inverse)
        if len(panel) > n:
            rest, places = np.dot(panel[n:], inverse.T), s.rows[s.below[p] : s.below[p + 1]]
            geometry.put(panel[n:], rest)
            start = 0
            while start < len(places):
                end, above, at = _next_above(s, places, start)
                square = np.dot(rest[_D * start :], rest[_D * start : _D * end].T)
                _subtract(square, at, _panel_of(s, panels, above))
                start = end
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
def _next_above(s, places, start):
    """The end of those places below a panel, rising from `start`, that one panel has; which panel, and its rows of all.

    Rows (len(places) - start,) are counted in blocks: of its own places and of those below it.
    """
    p, end = s.panel_of[places[start]], start
    while end < len(places) and places[end] < s.first[p + 1]:
        end += 1
    at, row = np.empty(len(places) - start, np.int64), s.below[p]
    for k in range(start, len(places)):
        if k < end:
            at[k - start] = places[k] - s.first[p]
        else:
            while s.rows[row] != places[k]:
                row += 1
            at[k - start] = s.first[p + 1] - s.first[p] + row - s.below[p]
    return end, p, at


@njit(cache=True, nogil=True)
def _subtract(square, at, panel):
    """Takes blocks (lower half) from those of a panel in these rows, the first of which are also the columns."""
    for b in range(len(at)):
        for a in range(min(b + 1, square.shape[1] // _D)):
            for i in range(_D):
                for k in range(_D):
                    panel[_D * at[b] + i, _D * at[a] + k] -= square[_D * b + i, _D * a + k]


@njit(cache=True, nogil=True)
def _picked(panel, at, width):
    """Blocks of a panel in these rows, so many of which, the first, are also the columns."""
    part = np.empty((_D * len(at), _D * width))
    for b in range(len(at)):
        for a in range(width):
            for i in range(_D):
                for k in range(_D):
                    part[_D * b + i, _D * a + k] = panel[_D * at[b] + i, _D * at[a] + k]
    return part


@njit(cache=True, nogil=True)
def _invert(s, panels, diagonal):
    """Turns L1^-1 over L2 of each panel into the inverse's blocks there, and fills those on its diagonal (n, 6, 6)."""
    for p in range(len(s.first) - 2, -1, -1):
        panel, width = _panel_of(s, panels, p), s.first[p + 1] - s.first[p]
        n = _D * width
        own = np.dot(panel[:n].T, panel[:n])
        if len(panel) > n:
            weight, places = np.dot(panel[n:], panel[:n]), s.rows[s.below[p] : s.below[p + 1]]
            across, start = np.zeros_like(weight), 0
            while start < len(places):
                end, above, at = _next_above(s, places, start)
                part = _picked(_panel_of(s, panels, above), at, end - start)
                onwards, here = across[_D * start :], across[_D * start : _D * end]
                onwards += np.dot(part, weight[_D * start : _D * end])
                if end < len(places):
                    here += np.dot(part[_D * (end - start) :].T, weight[_D * end :])
                start = end
            own += np.dot(weight.T, across)
            geometry.put(panel[n:], -across)
        geometry.put(panel[:n], own)
        for k in range(width):
            geometry.put(diagonal[s.first[p] + k], own[_D * k : _D * k + _D, _D * k : _D * k + _D])


@njit(cache=True, nogil=True)
def _substitute(s, panels, x):
    """Solves in place, x (6 n,) by place: forwards by L, backwards by its transpose."""
    for p in range(len(s.first) - 1):
        own = x[_D * s.first[p] : _D * s.first[p + 1]]
        panel = _panel_of(s, panels, p)
        geometry.put(own, np.dot(panel[: len(own)], own))
        if len(panel) > len(own):
            known = np.dot(panel[len(own) :], own)
            for k in range(s.below[p], s.below[p + 1]):
                for i in range(_D):
                    x[_D * s.rows[k] + i] -= known[_D * (k - s.below[p]) + i]
    for p in range(len(s.first) - 2, -1, -1):
        own = x[_D * s.first[p] : _D * s.first[p + 1]]
        panel = _panel_of(s, panels, p)
        if len(panel) > len(own):
            later = np.empty(len(panel) - len(own))
            for k in range(s.below[p], s.below[p + 1]):
                for i in range(_D):
                    later[_D * (k - s.below[p]) + i] = x[_D * s.rows[k] + i]
            own -= np.dot(panel[len(own) :].T, later)
        geometry.put(own, np.dot(panel[: len(own)].T, own))
