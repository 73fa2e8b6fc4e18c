"""Which samples a study flies: grids are gone through, everything else is drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from twin.study.spread import Array, equal_parts
from twin.study.study_file import METHODS, Study, Together

_DESIGN_STREAM = 0x57D1  # keeps the draws of samples apart from those within a survey of the same seed


class Sample(NamedTuple):
    """One setting: its number from 0, the row of the draws that it belongs to, and the value of every varied key."""

    number: int
    draw: int
    values: dict[str, Any]


def samples(study: Study) -> Iterator[Sample]:
    """All settings of a study, each draw with every cell of the grids.

    More samples of "random" or "sobol" begin with those of fewer.
    """
    axes = list(_drawn(study))
    cells = [dict(pairs for part in cell for pairs in part) for cell in product(*_gone_through(study))]
    shares = points(study.sampling.method, study.sampling.samples or 1, len(axes), study.sampling.seed)
    columns = [axis(shares[:, k]) for k, axis in enumerate(axes)]
    number = 0
    for draw in range(len(shares)):
        drawn = {key: value for column in columns for key, value in column[draw].items()}
        for cell in cells:
            values = drawn | cell
            yield Sample(number, draw, {key: values[key] for key in study.varied})
            number += 1


def seeds(study: Study, sample: Sample) -> list[int]:
    """The seeds that a sample is flown with: the same for all, or for all cells of its draw only."""
    plan = study.sampling
    first = plan.seed + (0 if plan.paired else sample.draw * plan.seeds)
    return [(first + k) % 2**32 for k in range(plan.seeds)]


def points(method: METHODS, n_points: int, n_axes: int, seed: int) -> Array:
    """(n, n_axes) points in the unit cube; n is n_points, of "saltelli" n_points (n_axes + 2)."""
    from scipy.stats import qmc  # takes a second, and workers never need it

    rng = np.random.default_rng([seed, _DESIGN_STREAM])
    if n_axes == 0 or method in ("random", "grid"):
        return rng.random((n_points, n_axes))
    if method == "saltelli":
        return _saltelli(np.asarray(qmc.Sobol(2 * n_axes, rng=rng).random(n_points)))
    cube = qmc.LatinHypercube(n_axes, rng=rng) if method == "lhs" else qmc.Sobol(n_axes, rng=rng)
    return np.asarray(cube.random(n_points))


def _saltelli(pairs: Array) -> Array:
    """A, B, and A with one column of B for each axis (Saltelli et al. 2010, Comput. Phys. Commun. 181, 259).

    Args:
        pairs: (n, 2 d) points of A and B side by side.

    Returns:
        (n (d + 2), d): the blocks one after another, as `statistics.sobol_indices` takes their outcomes.
    """
    a, b = np.hsplit(pairs, 2)
    blocks = [np.where(np.arange(a.shape[1]) == k, b, a) for k in range(a.shape[1])]
    return np.vstack([a, b, *blocks])


def axes_of(study: Study) -> list[str]:
    """What each drawn axis varies: a key, or keys that vary together."""
    alone = [key for key, spread in study.vary.items() if spread.is_drawn]
    return alone + [" + ".join(table.keys) for table in study.together]


def _drawn(study: Study) -> Iterator[Callable[[Array], list[dict[str, Any]]]]:
    """Of each axis that is drawn: from shares to values by key."""
    if study.sampling.method == "grid":
        return
    for key, spread in study.vary.items():
        if spread.is_drawn:
            yield lambda share, key=key, spread=spread: [{key: value} for value in spread.at(share)]
    for table in study.together:
        yield lambda share, table=table: [_row(table, k) for k in equal_parts(share, len(table.rows))]


def _gone_through(study: Study) -> Iterator[list[list[tuple[str, Any]]]]:
    """Of each axis of the grid: the values by key."""
    whole = study.sampling.method == "grid"
    for key, spread in study.vary.items():
        if whole or not spread.is_drawn:
            yield [[(key, value)] for value in spread.values]
    for table in study.together if whole else ():
        yield [list(_row(table, k).items()) for k in range(len(table.rows))]


def _row(table: Together, k: int) -> dict[str, Any]:
    return dict(zip(table.keys, table.rows[k], strict=True))
