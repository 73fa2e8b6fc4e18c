"""Surveys of a study: design points, samples of the varied keys, and the validated scenario of each sample."""

from collections.abc import Container, Iterable, Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.errors import ScenarioError, TwinError
from twin.scenario.file import read_tree, with_values
from twin.scenario.model import Scenario, Source
from twin.studies.study_file import SamplingMethod, Study, named_keys

_DESIGN_STREAM = 0x57D1  # separates the random numbers of the design from those of a survey with the same seed
_ORDER_STREAM = 0x57D2  # the same for the order of the samples
_MAX_ERRORS = 20


class Sample(NamedTuple):
    """Sample of the varied keys: its number, the index of its design point, and the value of every key."""

    number: int
    point: int
    values: dict[str, Any]


def samples(study: Study) -> Iterator[Sample]:
    """Yields each design point with every cell of the grids; more samples keep the first ("random", "sobol")."""
    sampled, listed, plan = study.axes(listed=False), study.axes(listed=True), study.sampling
    points = design_points(plan.method, plan.samples or 1, len(sampled), plan.seed)
    columns = [law.quantiles(points[:, k]) for k, law in enumerate(sampled.values())]
    cells = list(product(*(law.values for law in listed.values())))
    for number, (point, cell) in enumerate(product(range(len(points)), cells)):
        values: dict[str, Any] = {}
        for keys, value in zip([*sampled, *listed], [*(column[point] for column in columns), *cell], strict=True):
            values |= {keys: value} if isinstance(keys, str) else dict(zip(keys, value, strict=True))
        yield Sample(number, point, {key: values[key] for key in study.varied_keys})


def seeds_of_sample(study: Study, sample: Sample) -> list[int]:
    """Returns the seeds of a sample: the same for all if `sampling.paired`, else those of its design point."""
    plan = study.sampling
    first = plan.seed + (0 if plan.paired else sample.point * plan.seeds)
    return [(first + k) % 2**32 for k in range(plan.seeds)]


def design_points(method: SamplingMethod, n_points: int, n_axes: int, seed: int) -> Array:
    """Returns points (n, n_axes) in the unit cube; n is n_points, with "saltelli" n_points (n_axes + 2)."""
    # Saltelli's design (2010, Comput. Phys. Commun. 181, 259): blocks A, B and, for each axis, A with its column from B
    from scipy.stats import qmc  # the import takes a second, and workers do not need it

    rng = np.random.default_rng([seed, _DESIGN_STREAM])
    if n_axes == 0 or method in ("random", "grid"):
        return rng.random((n_points, n_axes))
    if method == "saltelli":
        a, b = np.hsplit(np.asarray(qmc.Sobol(2 * n_axes, rng=rng).random(n_points)), 2)
        return np.vstack([a, b, *(np.where(np.arange(n_axes) == k, b, a) for k in range(n_axes))])
    sampler = qmc.LatinHypercube(n_axes, rng=rng) if method == "lhs" else qmc.Sobol(n_axes, rng=rng)
    return np.asarray(sampler.random(n_points))


class Survey(NamedTuple):
    """One survey of a study."""

    sample: int  #: number of the sample
    seed: int
    values: dict[str, Any]  #: values of the varied keys
    scenario: Scenario
    scenario_hash: str
    folder: Path  #: run folder
    keep: str  #: a key of `flight.KEPT`

    @property
    def key(self) -> tuple[int, int]:
        return self.sample, self.seed


class SampleSource(Source):
    """Source of a sample's scenario: errors are at the line of the study file that sets the key, else of `scenario`."""

    sample: int
    given: dict[str, str]  #: for each scenario key, its dotted name in the study file

    def describe(self, error: TwinError) -> str:
        key = error.field
        while key not in self.given and "." in key:
            key = key.rpartition(".")[0]
        study_key = self.given.get(key, "scenario")
        if study_key.endswith(key):  # e.g. "vary.plan.tracks", which has its own line
            in_study = TwinError(study_key + error.field.removeprefix(key), error.problem, error.allowed)
        else:
            in_study = TwinError(study_key, str(error))
        return f"{super().describe(in_study)} in sample {self.sample}"


def surveys(study: Study, folder: Path, without: Container[int] = (), shuffled: bool = False) -> Iterator[Survey]:
    """Yields every survey, by sample, or `shuffled` (the first represent all); ScenarioError if one is not valid."""
    base, planned = read_tree(study.scenario_file), samples(study)
    if shuffled:
        in_order = list(planned)
        order = np.random.default_rng([study.sampling.seed, _ORDER_STREAM]).permutation(len(in_order))
        planned = (in_order[k] for k in order)
    for sample in planned:
        if sample.number not in without:
            yield from surveys_of_sample(study, folder, sample, scenario_of_sample(study, base, sample))


def surveys_of_sample(study: Study, folder: Path, sample: Sample, scenario: Scenario) -> Iterator[Survey]:
    for seed in seeds_of_sample(study, sample):
        seeded = scenario.model_copy(update={"seed": seed})
        run_folder = folder / "runs" / f"{sample.number:05d}_s{seed}"
        yield Survey(sample.number, seed, sample.values, seeded, seeded.fingerprint(), run_folder, study.keep)


def rendered(survey: Survey) -> Survey:
    """Returns a survey with rendered images, its number and seed unchanged."""
    imaging = survey.scenario.imaging.model_copy(update={"fidelity": "rendered"})
    scenario = survey.scenario.model_copy(update={"imaging": imaging})
    return survey._replace(scenario=scenario, scenario_hash=scenario.fingerprint())


def survey_keys(study: Study) -> Iterator[tuple[int, int]]:
    """Yields (sample, seed) of every survey."""
    return ((sample.number, seed) for sample in samples(study) for seed in seeds_of_sample(study, sample))


def scenario_of_sample(study: Study, base: Mapping[str, Any], sample: Sample) -> Scenario:
    """Returns `base` with a sample's values, [set] and limits; raises ScenarioError with all errors and their lines."""
    given = {key: study_key for study_key, key in named_keys(study)}
    source = SampleSource(**dict(study.source), sample=sample.number, given=given)
    tree = dict(base) | ({"require": study.limits} if study.limits else {})
    return with_values(tree, study.set | sample.values, source)


def refusals(study: Study) -> dict[int, str]:
    """Returns {sample number: errors} of the invalid samples; raises ScenarioError, each key once, if none is valid."""
    base, refused, errors, planned = read_tree(study.scenario_file), {}, [], list(samples(study))
    for sample in planned:
        try:
            scenario_of_sample(study, base, sample)
        except ScenarioError as error:
            refused[sample.number] = "; ".join(error.lines)
            errors += error.lines
    if len(refused) == len(planned):
        none = f"{study.source.path}: none of the {len(planned)} samples can be flown; nothing was flown"
        raise ScenarioError([*merge_errors(errors), none])
    return refused


def merge_errors(errors: Iterable[str]) -> list[str]:
    """Returns the first error of each line and key of the study file, of at most 20, and how many others there are."""
    by_key: dict[str, list[str]] = {}
    for error in errors:
        by_key.setdefault(": ".join(error.split(": ")[:2]), []).append(error)
    lines = [same[0] + (f" and {len(same) - 1} more" if len(same) > 1 else "") for same in by_key.values()]
    return lines[:_MAX_ERRORS] + ([f"... and {len(lines) - _MAX_ERRORS} more"] if len(lines) > _MAX_ERRORS else [])
