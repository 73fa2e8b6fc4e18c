"""The surveys of a study: each sample as a checked scenario, once for each seed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from twin.errors import ScenarioError, TwinError
from twin.scenario.file import read_tree, with_values
from twin.scenario.model import Scenario, Source
from twin.study.design import Sample, samples, seeds
from twin.study.study_file import Study, named_keys

_MOST_FAULTS = 20


class Survey(NamedTuple):
    """One survey of a study: its sample, what varies, the scenario to fly, its folder and what is to stay of it."""

    sample: int
    seed: int
    values: dict[str, Any]
    scenario: Scenario
    scenario_hash: str
    folder: Path
    keep: str

    @property
    def key(self) -> tuple[int, int]:
        return self.sample, self.seed


class SampleSource(Source):
    """Tells a fault of a sampled scenario at the key of the study that brought it about."""

    sample: int
    given: dict[str, str]  #: where in the study a key of the scenario is given

    def fault(self, error: TwinError) -> str:
        key = error.field
        while key not in self.given and "." in key:
            key = key.rpartition(".")[0]
        place = self.given.get(key, "scenario")
        if place.endswith(key):  # its own line, as "vary.plan.tracks"
            said = TwinError(place + error.field.removeprefix(key), error.problem, error.allowed)
        else:
            said = TwinError(place, str(error))
        return f"{super().fault(said)} in sample {self.sample}"


def surveys(study: Study, folder: Path) -> Iterator[Survey]:
    """Every survey of the study, sample by sample.

    Raises:
        ScenarioError: the faults of a sample.
    """
    base = read_tree(study.base)
    for sample in samples(study):
        yield from surveys_of(study, folder, sample, sampled(study, base, sample))


def surveys_of(study: Study, folder: Path, sample: Sample, scenario: Scenario) -> Iterator[Survey]:
    """The surveys of one sample: a seed each."""
    for seed in seeds(study, sample):
        flown = scenario.model_copy(update={"seed": seed})
        place = folder / "runs" / f"{sample.number:05d}_s{seed}"
        yield Survey(sample.number, seed, sample.values, flown, flown.fingerprint(), place, study.keep)


def keys(study: Study) -> Iterator[tuple[int, int]]:
    """Sample and seed of every survey."""
    return ((sample.number, seed) for sample in samples(study) for seed in seeds(study, sample))


def sampled(study: Study, base: Mapping[str, Any], sample: Sample) -> Scenario:
    """The scenario of a sample. Raises ScenarioError with every fault, told with the study's lines."""
    given = {key: place for place, key in named_keys(study)}
    source = SampleSource(path=study.source.path, lines=study.source.lines, sample=sample.number, given=given)
    tree = dict(base) | ({"require": study.limits} if study.limits else {})
    return with_values(tree, study.set | sample.values, source)


def check_samples(study: Study) -> None:
    """Builds the scenario of every sample. Raises ScenarioError with the faults of all, each place once."""
    base, faults = read_tree(study.base), []
    for sample in samples(study):
        try:
            sampled(study, base, sample)
        except ScenarioError as error:
            faults += error.lines
    if faults:
        raise ScenarioError(told(faults))


def told(faults: Iterable[str]) -> list[str]:
    """Faults of many samples, each place and key once, with the number of further samples."""
    places: dict[str, list[str]] = {}
    for fault in faults:
        places.setdefault(": ".join(fault.split(": ")[:2]), []).append(fault)
    lines = [same[0] + (f" and {len(same) - 1} more" if len(same) > 1 else "") for same in places.values()]
    return lines[:_MOST_FAULTS] + ([f"... and {len(lines) - _MOST_FAULTS} more"] if len(lines) > _MOST_FAULTS else [])
