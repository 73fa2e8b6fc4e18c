"""Sparse block Cholesky factorisation against dense linear algebra."""

import numpy as np
import pytest

from twin.estimate.adjustment import block_cholesky, elimination


def normal_equations(rng, n, i, j):
    """Returns normal equations of pairs (i, j) with the first node fixed.

    Returns:
        Diagonal blocks (n, 6, 6), off-diagonal blocks (m, 6, 6), and the dense matrix.
    """
    rows = np.eye(6) * np.array([1.0, -1.0])[:, None, None] + 0.2 * rng.normal(size=(len(i), 2, 6, 6))
    diagonal, dense = np.zeros((n, 6, 6)), np.zeros((n, 6, n, 6))
    off = rows[:, 0].transpose(0, 2, 1) @ rows[:, 1]
    for k, ends in enumerate(zip(i, j, strict=True)):
        for a, node in enumerate(ends):
            diagonal[node] += rows[k, a].T @ rows[k, a]
        dense[i[k], :, j[k]] += off[k]
        dense[j[k], :, i[k]] += off[k].T
    diagonal[0] += np.eye(6)
    dense[np.arange(n), :, np.arange(n)] += diagonal
    return diagonal, off, dense.reshape(6 * n, 6 * n)


def chain(n):
    return np.arange(n - 1), np.arange(1, n)


def lawnmower(rows, cols):
    """Returns pairs along parallel legs, and between neighbouring legs."""
    k = np.arange(rows * cols)
    along, across = k[k % cols > 0], k[k >= cols]
    return np.concatenate([along - 1, across - cols]), np.concatenate([along, across])


def random_graph(n):
    """Returns a chain and random pairs in both orders, some of them twice."""
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, n, (2, 4 * n))
    i, j = i[i != j], j[i != j]
    return np.concatenate([chain(n)[0], i, j[:9]]), np.concatenate([chain(n)[1], j, i[:9]])


NETWORKS = {
    "one node": (1, (np.empty(0, int), np.empty(0, int))),
    "chain": (40, chain(40)),
    "lawnmower": (96, lawnmower(8, 12)),
    "random": (50, random_graph(50)),
    "complete": (30, np.triu_indices(30, 1)),
}


def factor_of(symbolic, diagonal, off):
    matrix = block_cholesky.BlockMatrix(symbolic, np.empty(symbolic.offset[-1]))
    matrix.panels[:] = np.nan  # initial values are not used
    matrix.panels[:] = 0.0
    matrix.add(0, off[:3])
    matrix.add(3, off[3:])
    return matrix.factorise(diagonal)


@pytest.fixture(params=NETWORKS, ids=list(NETWORKS))
def factored(request):
    n, (i, j) = NETWORKS[request.param]
    diagonal, off, dense = normal_equations(np.random.default_rng(1), n, i, j)
    return factor_of(elimination.analyse(n, i, j), diagonal, off), dense


def test_the_solution_satisfies_the_dense_equations(factored):
    factor, dense = factored
    right = np.random.default_rng(2).normal(size=len(dense))
    solution = factor.solve(right.reshape(-1, 6))
    np.testing.assert_allclose(dense @ solution.ravel(), right, atol=1e-9)


def test_inverse_blocks_are_those_of_the_dense_inverse(factored):
    factor, dense = factored
    n = len(dense) // 6
    expected = np.linalg.inv(dense).reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n)]
    for node in {0, n // 2, n - 1}:
        np.testing.assert_allclose(factor.inverse_block(node), expected[node], atol=1e-9 * np.abs(expected).max())
    blocks = factor.invert_in_place()
    # the dense inverse is exact to the condition number (1e9) times 1e-16 only
    np.testing.assert_allclose(blocks, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def test_samples_of_unit_vectors_are_a_root_of_the_dense_inverse(factored):
    factor, dense = factored
    units = np.eye(len(dense)).reshape(len(dense), -1, 6)
    root = factor.sample(units).reshape(dense.shape)
    expected = np.linalg.inv(dense)
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def test_fill_in_of_a_lawnmower_survey_is_below_3_percent_of_the_dense_triangle():
    n, (i, j) = 1200, lawnmower(20, 60)
    symbolic = elimination.analyse(n, i, j)
    assert symbolic.offset[-1] / 36 < 0.03 * n * (n + 1) / 2


def test_a_graph_of_two_components_is_factorised():
    i, j = np.array([0, 2]), np.array([1, 3])
    diagonal, off, dense = normal_equations(np.random.default_rng(3), 4, i, j)
    diagonal[2] += np.eye(6)
    dense[12:18, 12:18] += np.eye(6)
    factor = factor_of(elimination.analyse(4, i, j), diagonal, off)
    np.testing.assert_allclose(factor.inverse_block(3), np.linalg.inv(dense)[18:, 18:], rtol=1e-9)


@pytest.mark.parametrize("fixed", [0, 7])
def test_a_network_without_a_fixed_node_is_reported_as_singular(fixed):
    """Relative measurements alone do not change when all poses move together."""
    n, (i, j) = 12, chain(12)
    off = np.tile(-np.eye(6), (n - 1, 1, 1))
    diagonal = np.tile(2 * np.eye(6), (n, 1, 1))
    diagonal[[0, -1]] = np.eye(6)
    symbolic = elimination.analyse(n, i, j)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        factor_of(symbolic, diagonal, off)
    diagonal[fixed] += 1e-6 * np.eye(6)
    factor_of(symbolic, diagonal, off)
