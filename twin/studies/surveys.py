"""Surveys of a study: the validated scenario of each sample, flown once per seed."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from twin.errors import ScenarioError, TwinError
from twin.scenario.file import read_tree, with_values
from twin.scenario.model import Scenario, Source
from twin.studies.design import Sample, samples, seeds_of_sample
from twin.studies.study_file import Study, named_keys

_MAX_ERRORS = 20


class Survey(NamedTuple):
    """One survey of a study.

    Args:
        sample: number of the sample.
        seed: seed of the survey.
        values: values of the varied keys.
        scenario: scenario with these values and this seed.
        scenario_hash: fingerprint of the scenario.
        folder: run folder.
        keep: which files of the run folder to keep; see `flight.KEPT_FILES`.
    """

    sample: int
    seed: int
    values: dict[str, Any]
    scenario: Scenario
    scenario_hash: str
    folder: Path
    keep: str

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
