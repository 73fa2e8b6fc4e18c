"""Experimental design of a study: design points in the unit cube for the sampled keys, and full grids of values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from twin.studies.distribution import Array, equal_bins
from twin.studies.study_file import JointValues, SamplingMethod, Study

_DESIGN_STREAM = 0x57D1  # separates the random numbers of the design from those of a survey with the same seed


class Sample(NamedTuple):
    """Sample of the varied keys: its number (from 0), the index of its design point, and the value of every key."""

    number: int
    point: int
    values: dict[str, Any]


def samples(study: Study) -> Iterator[Sample]:
    """Yields all samples of a study: each design point combined with every cell of the grids.

    With the methods "random" and "sobol", the first samples stay the same if the number of samples is increased.
    """
    axes = list(_sampled_axes(study))
    cells = [dict(pairs for part in cell for pairs in part) for cell in product(*_grid_axes(study))]
    points = design_points(study.sampling.method, study.sampling.samples or 1, len(axes), study.sampling.seed)
    columns = [axis(points[:, k]) for k, axis in enumerate(axes)]
    number = 0
    for point in range(len(points)):
        sampled = {key: value for column in columns for key, value in column[point].items()}
        for cell in cells:
            values = sampled | cell
            yield Sample(number, point, {key: values[key] for key in study.varied_keys})
            number += 1


def seeds_of_sample(study: Study, sample: Sample) -> list[int]:
    """Returns the seeds of a sample: the same for all samples if `sampling.paired`, else those of its design point."""
    plan = study.sampling
    first = plan.seed + (0 if plan.paired else sample.point * plan.seeds)
    return [(first + k) % 2**32 for k in range(plan.seeds)]


def design_points(method: SamplingMethod, n_points: int, n_axes: int, seed: int) -> Array:
    """Returns points (n, n_axes) in the unit cube.

    n is n_points, or n_points (n_axes + 2) for "saltelli" with at least one axis.
    """
    from scipy.stats import qmc  # the import takes a second, and workers do not need it

    rng = np.random.default_rng([seed, _DESIGN_STREAM])
    if n_axes == 0 or method in ("random", "grid"):
        return rng.random((n_points, n_axes))
    if method == "saltelli":
        return _saltelli(np.asarray(qmc.Sobol(2 * n_axes, rng=rng).random(n_points)))
    sampler = qmc.LatinHypercube(n_axes, rng=rng) if method == "lhs" else qmc.Sobol(n_axes, rng=rng)
    return np.asarray(sampler.random(n_points))


def _saltelli(pairs: Array) -> Array:
    """Returns the Saltelli design: matrices A and B, and for each axis a copy of A with the axis's column from B.

    Saltelli et al. 2010, Comput. Phys. Commun. 181, 259.

    Returns:
        (n (d + 2), d), the matrices stacked in the order that `statistics.sobol_indices` expects.
    """
    a, b = np.hsplit(pairs, 2)
    blocks = [np.where(np.arange(a.shape[1]) == k, b, a) for k in range(a.shape[1])]
    return np.vstack([a, b, *blocks])


def axis_names(study: Study) -> list[str]:
    """Returns the name of each axis that methods other than "grid" sample.

    It is the key, or the jointly varied keys of a table, joined by " + ".
    """
    single = [key for key, distribution in study.vary.items() if distribution.is_sampled]
    return single + [" + ".join(table.keys) for table in study.together]


def _sampled_axes(study: Study) -> Iterator[Callable[[Array], list[dict[str, Any]]]]:
    """Yields for each sampled axis a function that converts coordinates (n,), 0 to 1, to n dicts {key: value}."""
    if study.sampling.method == "grid":
        return
    for key, distribution in study.vary.items():
        if distribution.is_sampled:
            yield lambda x, key=key, distribution=distribution: [{key: v} for v in distribution.quantiles(x)]
    for table in study.together:
        yield lambda x, table=table: [_row(table, k) for k in equal_bins(x, len(table.rows))]


def _grid_axes(study: Study) -> Iterator[list[list[tuple[str, Any]]]]:
    """Yields, for each axis of the grid, the list of its grid points; a point is a list of (key, value) pairs."""
    all_axes = study.sampling.method == "grid"
    for key, distribution in study.vary.items():
        if all_axes or not distribution.is_sampled:
            yield [[(key, value)] for value in distribution.values]
    for table in study.together if all_axes else ():
        yield [list(_row(table, k).items()) for k in range(len(table.rows))]


def _row(table: JointValues, k: int) -> dict[str, Any]:
    return dict(zip(table.keys, table.rows[k], strict=True))
