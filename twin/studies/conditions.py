"""Conditions of a study's surveys: its rig, what is idealised, and the sea trial (scenes/conditions/sea_trial.toml)."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from twin.errors import ScenarioError
from twin.report.words import values_in_words
from twin.scenario.file import read_toml, read_tree
from twin.scenario.idealisations import idealisations
from twin.scenario.model_files import built_in
from twin.studies.distribution import Distribution
from twin.studies.study_file import Study, flat_keys, named_keys
from twin.studies.surveys import samples, scenario_of_sample


def in_sea_trial(study: Study) -> Study:
    """Returns a study with the conditions of the sea trial whose keys neither it nor its scenario sets.

    Varied conditions become random choices of the samples; without sampled keys, each has its middle value.
    """
    fixed, varied = _missing(study)
    if study.sampling.samples is None:
        fixed |= {key: law.values[len(law.values) // 2] for key, law in varied.items()}
        varied = {}
    return study.model_copy(update={"set": study.set | fixed, "vary": study.vary | varied})


def condition_lines(study: Study) -> list[str]:
    """Returns sentences on the rig, on what its scenario idealises, and on the sea trial, for the pages of results."""
    tree, flown = read_tree(study.scenario_file), study
    sea, search = "The surveys are not in the conditions of a sea trial.", ""
    if study.sea_trial or (study.sea_trial is None and study.tune is not None):
        which = "All surveys" if study.sea_trial else "The rendered surveys that verify a plan"
        search = "" if study.sea_trial else "In the search: "
        flown, (fixed, varied) = in_sea_trial(study) if study.sea_trial else study, _missing(study)
        keys = [values_in_words(key, [value]) for key, value in fixed.items()]
        keys += [values_in_words(key, law.bounds) for key, law in varied.items()]
        sea = f"{which} are in the conditions of a sea trial: {', '.join(keys) or 'as the study sets them'}."
    for sample in samples(flown):
        with suppress(ScenarioError):
            scenario = scenario_of_sample(flown, tree, sample)
            rig = f"Cameras: {scenario.rig.title or 'those of the scenario'}."
            ideal = " ".join(idealisations(scenario))
            return [rig, *([search + ideal] if ideal else []), sea]
    return [sea]


def varied_in_words(study: Study) -> list[str]:
    """Returns each key that a study varies, with the values between which it lies, e.g. "visibility 4 to 8 m"."""
    bounds = {key: law.bounds for key, law in study.vary.items()}
    for table in study.together:
        bounds |= dict(zip(table.keys, zip(*table.rows, strict=True), strict=True))
    return [values_in_words(key, values) for key, values in bounds.items()]


def _missing(study: Study) -> tuple[dict[str, Any], dict[str, Distribution]]:
    """Returns the fixed and the varied conditions of the sea trial that neither a study nor its scenario sets."""
    given, tree = {key for _, key in named_keys(study)}, read_tree(study.scenario_file)
    preset = read_toml(built_in("conditions")["sea_trial"])[0]
    fixed, varied = (
        {key: value for key, value in flat_keys(preset[part]) if key not in given and not _sets(tree, key)}
        for part in ("set", "vary")
    )
    return fixed, {key: Distribution.model_validate(law) for key, law in varied.items()}


def _sets(tree: Mapping[str, Any], key: str) -> bool:
    """Returns whether a scenario's tree sets a dotted key."""
    first, _, rest = key.partition(".")
    return first in tree and (not rest or (isinstance(tree[first], Mapping) and _sets(tree[first], rest)))
