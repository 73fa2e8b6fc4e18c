"""Surveys of a study: design points, samples of the varied keys, and the validated scenario of each sample."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin.errors import ScenarioError, TwinError
from twin.scenario.file import read_tree, with_values
from twin.scenario.model import Scenario, Source
from twin.studies.distribution import Array, equal_bins
from twin.studies.study_file import JointValues, SamplingMethod, Study, named_keys

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


_MAX_ERRORS = 20


class Survey(NamedTuple):
    """One survey of a study."""

    sample: int  #: number of the sample
    seed: int  #: seed of the survey
    values: dict[str, Any]  #: values of the varied keys
    scenario: Scenario  #: scenario with these values and this seed
    scenario_hash: str  #: fingerprint of the scenario
    folder: Path  #: run folder
    keep: str  #: which files of the run folder to keep; see `flight.KEPT_FILES`

    @property
    def key(self) -> tuple[int, int]:
        """Returns (sample, seed), which identifies a survey within its study."""
        return self.sample, self.seed


class SampleSource(Source):
    """Source of a sample's scenario: locates an error in it at the line of the study file that sets the faulty key.

    An error in a key that the study does not set is located at the line of the key `scenario`.
    """

    sample: int
    given: dict[str, str]  #: for each scenario key, its dotted name in the study file

    def describe(self, error: TwinError) -> str:
        """Returns the error as `FILE:LINE: key: problem (allowed: ...)`, followed by the number of the sample."""
        key = error.field
        while key not in self.given and "." in key:
            key = key.rpartition(".")[0]
        study_key = self.given.get(key, "scenario")
        if study_key.endswith(key):  # e.g. "vary.plan.tracks", which has its own line
            in_study = TwinError(study_key + error.field.removeprefix(key), error.problem, error.allowed)
        else:
            in_study = TwinError(study_key, str(error))
        return f"{super().describe(in_study)} in sample {self.sample}"


def surveys(study: Study, folder: Path, without: Container[int] = ()) -> Iterator[Survey]:
    """Yields every survey of the study, sample by sample.

    Raises:
        ScenarioError: the scenario of a sample is not valid.
    """
    base = read_tree(study.scenario_file)
    for sample in (sample for sample in samples(study) if sample.number not in without):
        yield from surveys_of_sample(study, folder, sample, scenario_of_sample(study, base, sample))


def surveys_of_sample(study: Study, folder: Path, sample: Sample, scenario: Scenario) -> Iterator[Survey]:
    """Yields the surveys of one sample: one per seed."""
    for seed in seeds_of_sample(study, sample):
        seeded = scenario.model_copy(update={"seed": seed})
        run_folder = folder / "runs" / f"{sample.number:05d}_s{seed}"
        yield Survey(sample.number, seed, sample.values, seeded, seeded.fingerprint(), run_folder, study.keep)


def survey_keys(study: Study) -> Iterator[tuple[int, int]]:
    """Yields (sample, seed) of every survey."""
    return ((sample.number, seed) for sample in samples(study) for seed in seeds_of_sample(study, sample))


def scenario_of_sample(study: Study, base: Mapping[str, Any], sample: Sample) -> Scenario:
    """Returns the validated scenario of a sample.

    The limits of the study, if it has any, replace the section [require] of the scenario file.

    Args:
        sample: the sample, whose values replace those of `base` and of the section [set] of the study.

    Raises:
        ScenarioError: lists every error of the scenario, each with a line of the study file.
    """
    given = {key: study_key for study_key, key in named_keys(study)}
    source = SampleSource(**dict(study.source), sample=sample.number, given=given)
    tree = dict(base) | ({"require": study.limits} if study.limits else {})
    return with_values(tree, study.set | sample.values, source)


def refusals(study: Study) -> dict[int, str]:
    """Returns {sample number: errors, as one text} of the samples whose scenario is not valid.

    Raises:
        ScenarioError: no sample is valid; lists the errors of all samples, each key once.
    """
    base, refused, errors, count = read_tree(study.scenario_file), {}, [], 0
    for sample in samples(study):
        count += 1
        try:
            scenario_of_sample(study, base, sample)
        except ScenarioError as error:
            refused[sample.number] = "; ".join(error.lines)
            errors += error.lines
    if len(refused) == count:
        none = f"{study.source.path}: none of the {count} samples can be flown; nothing was flown"
        raise ScenarioError([*merge_errors(errors), none])
    return refused


def merge_errors(errors: Iterable[str]) -> list[str]:
    """Returns the first error of each line and key of the study file, with the number of further errors of that key.

    The list is limited to 20 keys; if there are more, its last line states how many were left out.
    """
    by_key: dict[str, list[str]] = {}
    for error in errors:
        by_key.setdefault(": ".join(error.split(": ")[:2]), []).append(error)
    lines = [same[0] + (f" and {len(same) - 1} more" if len(same) > 1 else "") for same in by_key.values()]
    return lines[:_MAX_ERRORS] + ([f"... and {len(lines) - _MAX_ERRORS} more"] if len(lines) > _MAX_ERRORS else [])
