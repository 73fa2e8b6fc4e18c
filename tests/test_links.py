"""Growing arrays, and links stored as columns."""

import numpy as np
import pytest

from twin.core import geometry
from twin.core.links import Link, Links
from twin.core.series import GrowingArray


def some_links(n):
    rng = np.random.default_rng(n)
    for k in range(n):
        root = rng.normal(size=(6, 6)) * 0.01
        motion, exact = geometry.exp(rng.normal(size=6)), geometry.exp(rng.normal(size=6)) if k % 3 else None
        yield Link(k, k + 2, motion, root @ root.T + np.eye(6) * 1e-4, 0.1 * k, 10 * k, 1 + k % 4, exact)


def assert_same(link, expected):
    assert (link.i, link.j, link.n_points, link.shared_by) == expected[:2] + expected[5:7]
    assert link.overlap == expected.overlap
    for name in ("i_from_j", "cov", "own_cov"):
        np.testing.assert_allclose(getattr(link, name), getattr(expected, name), rtol=1e-9)
    assert (link.closed_form is None) == (expected.closed_form is None)
    if expected.closed_form is not None:
        np.testing.assert_allclose(link.closed_form, expected.closed_form, rtol=1e-7)  # stored in single precision


def test_rows_are_unchanged_when_the_capacity_grows():
    numbers = np.arange(6.0).reshape(3, 2)
    rows = GrowingArray.wrap(numbers[:1].copy())
    for row in numbers[1:]:
        rows.append(row)
    rows.append(10 + numbers)
    np.testing.assert_array_equal(rows.array, np.concatenate([numbers, 10 + numbers]))


def test_links_are_returned_unchanged_one_by_one_and_as_columns():
    given = list(some_links(7))
    links = Links(given[:2])
    assert links.i.tolist() == [0, 1]
    links.add(given[2:5])
    links.add(given[5:])
    assert len(links) == 7
    for link, expected in zip(links, given, strict=True):
        assert_same(link, expected)
    assert [last.i for last in links[-2:]] == [5, 6]
    assert links.j.tolist() == [link.j for link in given]
    np.testing.assert_allclose(links.information @ links.cov, np.tile(np.eye(6), (7, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(links.own_cov, [link.own_cov for link in given], rtol=1e-9)


def test_selected_links_keep_all_their_fields_and_the_original_is_unchanged():
    given, mask = list(some_links(9)), np.arange(9) % 2 == 0
    links = Links(given)
    selected = links.select(mask)
    for link, expected in zip(selected, given[::2], strict=True):
        assert_same(link, expected)
    selected.add(given[1:2])
    assert selected.i.tolist() == [0, 2, 4, 6, 8, 1] and len(links) == 9
    closed, forms = Links(given).by_closed_form
    assert closed.tolist() == [k % 3 != 0 for k in range(9)]
    expected = [link.closed_form for link in given if link.closed_form is not None]
    np.testing.assert_allclose(forms, expected, rtol=1e-7)


def test_an_empty_selection_has_empty_columns():
    none = Links().select(np.zeros(0, bool))
    assert len(none) == 0 and none.cov.shape == none.own_cov.shape == (0, 6, 6) and none.i_from_j.shape == (0, 4, 4)
    with pytest.raises(IndexError):
        none[0]
