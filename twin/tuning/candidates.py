"""Candidate plans of a search: their surveys, objectives, pass probability, and the Pareto front.

All candidates are flown with the same samples and seeds. Finalists, the plans to be confirmed, are flown again
with new samples and seeds. The plans to be verified are then flown as rendered surveys, with further samples and seeds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.errors import ScenarioError, TwinError
from twin.judge.map_error import INFINITE_WITH_HOLES, with_completeness
from twin.judge.require import meets_limit, more_is_better
from twin.scenario.file import read_tree
from twin.scenario.model import Scenario
from twin.studies.analysis import count_similar
from twin.studies.flight import Row, has_passed, refused_row
from twin.studies.statistics import Interval, wilson_interval
from twin.studies.study_file import Study, TuningConfig
from twin.studies.surveys import (
    Sample,
    Survey,
    merge_errors,
    refusals,
    samples,
    scenario_of_sample,
    seeds_of_sample,
    surveys_of_sample,
)
from twin.tuning.correction import NO_CORRECTION, PlanCorrection

_DEFAULT_PROBABILITY = 0.5  # required pass probability if the study does not set one
_POWER_OF_2 = ("sobol", "saltelli")  # designs that need a power of 2 as number of samples
_CONFIRM_SEEDS = 1_000_000  # added to the sampling seed of the study for the confirmation of finalists
_RENDER_SEEDS = 2_000_000  # added to it for the rendered surveys
_PENALTY = 1e9  # objective of a candidate without a finite median; Optuna does not accept infinity


class SurveyScore(NamedTuple):
    """Part of a survey's result that the search uses.

    `metrics` are the objectives and the metrics with a limit, with their completeness metrics, by name. `reason` states
    why the survey was refused; it is empty for other surveys. `unmodelled` is whether only the surrogate refuses it.
    """

    status: str
    passed: bool
    metrics: dict[str, float | None]
    warning: str = ""
    scenario_hash: str = ""
    reason: str = ""
    unmodelled: bool = False


class Candidate(NamedTuple):
    """An evaluated plan: trial number, value of each searched key, objectives, pass probability and its shortfall.

    `completeness` lists (name, median) of each completeness metric that is reported in addition to the objectives; the
    median is NaN if no completed survey has a value.
    """

    number: int
    values: dict[str, Any]
    objectives: tuple[float, ...]
    pass_probability: Interval
    shortfall: float  #: required minus achieved pass probability; 0 or negative if the plan is feasible
    completeness: tuple[tuple[str, float], ...] = ()

    @property
    def has_metrics(self) -> bool:
        """Returns whether every objective has a finite value; a metric has none without a completed survey."""
        return max(abs(value) for value in self.objectives) < _PENALTY


def tuning_config(study: Study) -> TuningConfig:
    """Returns the section [tune] of a study.

    Raises:
        TwinError: the study has no section [tune].
    """
    if study.tune is None:
        raise TwinError(str(study.source.path), "has no section [tune]", "a study with a section [tune]")
    return study.tune


def required_probability(study: Study) -> float:
    """Returns the pass probability that a plan must reach: that of the study, or else 0.5."""
    return _DEFAULT_PROBABILITY if study.probability is None else study.probability


class CandidateSurveys:
    """Surveys of the candidates, with the results obtained so far.

    All candidates are flown with the samples and seeds of the study. Samples that are invalid with the original plan of
    the study's scenario are left out.

    Args:
        study: study with the samples and seeds.
        config: section [tune] of the study.
        folder: results folder; the run folders are created in its subfolder `runs`.
        rows: rows of the surveys flown so far.

    Raises:
        ScenarioError: no sample is valid.
    """

    def __init__(self, study: Study, config: TuningConfig, folder: Path, rows: Iterable[Row]):
        self.study, self.config, self.folder = study, config, folder
        self.base, refused = read_tree(study.scenario_file), refusals(study)
        self.conditions = [sample for sample in samples(study) if sample.number not in refused]
        self._n_samples = len(self.conditions) + len(refused)
        self.n_surveys = sum(len(seeds_of_sample(study, condition)) for condition in self.conditions)
        self.limits: dict[str, float] = study.limits or self.base.get("require", {})
        self.metrics = [name for name in with_completeness([*config.objectives, *self.limits]) if name != "risk"]
        self._scores: dict[tuple[int, int], SurveyScore] = {}
        for row in rows:
            self.add(row)

    def confirmation(self, rows: Iterable[Row]) -> CandidateSurveys:
        """Returns the surveys that confirm a plan: `tune.confirm` times as many as in the search, with new seeds.

        Sampled keys have `tune.confirm` times as many design points, which are new, each with its own seeds: with
        shared seeds, samples of a key with few values would repeat surveys, and all samples would be on the same few
        floors. The designs "sobol" and "saltelli" need a power of 2 as number of samples; for another number, the
        samples are those of "lhs". Without sampled keys, or with the design "grid", the samples stay the same, with
        `tune.confirm` times as many seeds.
        """
        sampling = self.study.sampling
        n_axes = len(self.study.axes(listed=False))
        count = "samples" if sampling.method != "grid" and n_axes > 0 else "seeds"
        n = (getattr(sampling, count) or 1) * self.config.confirm
        update: dict[str, Any] = {"seed": sampling.seed + _CONFIRM_SEEDS, "paired": False, count: n}
        if count == "samples" and sampling.method in _POWER_OF_2 and n & (n - 1):
            points = n * (n_axes + 2) if sampling.method == "saltelli" else n
            update |= {"method": "lhs", "samples": points}
        study = self.study.model_copy(update={"sampling": sampling.model_copy(update=update)})
        return CandidateSurveys(study, self.config, self.folder, rows)

    def rendered(self, rows: Iterable[Row]) -> CandidateSurveys:
        """Returns the rendered surveys that verify a plan: `tune.verify` new design points, each with its own seed.

        Each design point is combined with every cell of the grids. Without a number of samples in the study, i.e. with
        the design "grid" or without sampled keys, each cell has `tune.verify` seeds instead.
        """
        sampling, config = self.study.sampling, self.config
        update: dict[str, Any] = {"seed": sampling.seed + _RENDER_SEEDS, "paired": False, "seeds": 1}
        update["seeds" if sampling.samples is None else "samples"] = max(config.verify, 1)  # with 0, none is flown
        if sampling.method in _POWER_OF_2:
            update["method"] = "lhs"
        changes = {
            "sampling": sampling.model_copy(update=update),
            "set": self.study.set | {"imaging.fidelity": "rendered"},
            "keep": config.keep or self.study.keep,
            "timeout_s": config.timeout_s,
        }
        return CandidateSurveys(self.study.model_copy(update=changes), config, self.folder, rows)

    @property
    def uses_surrogate(self) -> bool:
        """Returns whether the surveys are flown by the surrogate, judged by the first valid sample."""
        return self._original.imaging.fidelity == "surrogate"

    @property
    def fingerprint(self) -> str:
        """Returns the hash of the scenario of the first valid sample with the original plan."""
        return self._original.fingerprint()

    @property
    def _original(self) -> Scenario:
        """Returns the scenario of the first valid sample with the original plan."""
        return scenario_of_sample(self.study, self.base, self.conditions[0])

    def add(self, row: Row) -> None:
        """Adds the result of a survey, which replaces an earlier result with the same sample and seed."""
        metrics = {name: row.get(name) for name in self.metrics}
        reason = row["reason"] if row["status"] == "refused" else ""
        warning, identity, unmodelled = row.get("warning") or "", row["scenario_hash"], bool(row.get("unmodelled"))
        score = SurveyScore(row["status"], has_passed(row), metrics, warning, identity, reason, unmodelled)
        self._scores[row["sample"], row["seed"]] = score

    def _is_done(self, survey: Survey) -> bool:
        """Returns whether the survey has a result with its scenario hash."""
        score = self._scores.get(survey.key)
        return score is not None and score.status != "failed" and score.scenario_hash == survey.scenario_hash

    def _samples(self, number: int, values: dict[str, Any]) -> Iterator[Sample]:
        """Yields the samples of a candidate: the searched values combined with each valid sample of the study."""
        for condition in self.conditions:
            yield Sample(number * self._n_samples + condition.number, condition.point, values | condition.values)

    def surveys(self, number: int, values: dict[str, Any]) -> Iterator[Survey | Row]:
        """Yields the surveys of a candidate; for a survey whose scenario is not valid, the row of a refused survey."""
        for sample in self._samples(number, values):
            try:
                scenario = scenario_of_sample(self.study, self.base, sample)
            except ScenarioError as error:
                for seed in seeds_of_sample(self.study, sample):
                    yield refused_row(sample, seed, "; ".join(error.lines))
                continue
            yield from surveys_of_sample(self.study, self.folder, sample, scenario)

    def missing(self, candidates: Mapping[int, dict[str, Any]]) -> Iterator[Survey]:
        """Yields the surveys of the candidates that have not been flown with the present scenario or have failed.

        A survey whose scenario is not valid is not yielded, but recorded as refused.
        """
        for number, values in candidates.items():
            for survey in self.surveys(number, values):
                if not isinstance(survey, Survey):
                    self.add(survey)
                elif not self._is_done(survey):
                    yield survey

    def scores(self, number: int, values: dict[str, Any]) -> list[SurveyScore]:
        """Returns the results of a candidate's surveys that were flown or refused.

        Surveys that failed are left out. Surveys of the same scenario with the same seed are identical and count once.
        """
        known = [(key, self._scores[key]) for key in self.keys(number, values) if self._has_result(key)]
        return list({(score.scenario_hash or key, key[1]): score for key, score in known}.values())

    def n_failed(self, number: int, values: dict[str, Any]) -> int:
        """Returns the number of surveys of a candidate without a result: they failed or were not flown."""
        return sum(not self._has_result(key) for key in self.keys(number, values))

    def _has_result(self, key: tuple[int, int]) -> bool:
        return key in self._scores and self._scores[key].status != "failed"

    def keys(self, number: int, values: dict[str, Any]) -> list[tuple[int, int]]:
        """Returns the list of (sample, seed) of every survey of a candidate."""
        return [(s.number, seed) for s in self._samples(number, values) for seed in seeds_of_sample(self.study, s)]

    def warnings(self, plans: Iterable[Candidate]) -> dict[str, int]:
        """Returns {warning: number of surveys of the given candidates that have it}, the most frequent first.

        Warnings that differ only in numbers count as one; see `count_similar`.
        """
        scores = (score for plan in plans for score in self.scores(plan.number, plan.values))
        return count_similar(score.warning for score in scores if score.warning)

    def refusals(self, plans: Mapping[int, dict[str, Any]]) -> dict[str, int]:
        """Returns {reason: number of plans whose surveys were all refused for it}, the most frequent first.

        The reason of a plan is that of its first survey; reasons that differ only in numbers count as one.
        """
        reasons = []
        for number, values in plans.items():
            scores = self.scores(number, values)
            if scores and all(score.status == "refused" for score in scores):
                reasons.append(scores[0].reason)
        return count_similar(reasons)

    def evaluate(self, number: int, values: dict[str, Any], correction: PlanCorrection = NO_CORRECTION) -> Candidate:
        """Returns a candidate with its objectives and pass probability.

        A refused survey counts as one that does not pass; if only the surrogate refuses it, the upper bound of the pass
        probability counts it as one that passes. A failed survey is not counted.

        Args:
            correction: expected ratios of the results of rendered surveys to those of these surveys; by default all
                are 1.
        """
        scores = self.scores(number, values)
        n_passed = sum(self._passes(score, correction) for score in scores)
        passed, n_unknown = correction.pass_factor * n_passed, sum(score.unmodelled for score in scores)
        best = wilson_interval(min(passed + n_unknown, len(scores)), len(scores))
        passing = wilson_interval(passed, len(scores))._replace(high=best.high)
        shortfall = required_probability(self.study) - passing.value if scores else 1.0
        objectives = tuple(
            1.0 - passing.value if name == "risk" and scores else self._objective(name, scores, correction)
            for name in self.config.objectives
        )
        further = [name for name in with_completeness(self.config.objectives) if name not in self.config.objectives]
        medians = ((name, median_of(scores, name)) for name in further)
        completeness = tuple((name, np.nan if value is None else value) for name, value in medians)
        return Candidate(number, values, objectives, passing, shortfall, completeness)

    def _passes(self, score: SurveyScore, correction: PlanCorrection) -> bool:
        """Returns whether a survey passes after the correction of its metrics."""
        if correction is NO_CORRECTION:
            return score.passed
        corrected = {name: correction.apply(name, score.metrics[name]) for name in self.limits}
        met = (meets_limit(name, corrected[name], limit) for name, limit in self.limits.items())
        return score.status == "complete" and all(met)

    def _objective(self, name: str, scores: list[SurveyScore], correction: PlanCorrection) -> float:
        """Returns the corrected median of a metric over the completed surveys."""
        if name == "risk":
            return 1.0
        value = correction.apply(name, median_of(scores, name))
        if value is not None and np.isfinite(value):
            return value
        return -_PENALTY if more_is_better(name) else _PENALTY

    def scenario(self, candidate: Candidate) -> Scenario:
        """Returns the scenario of the study with the plan of a candidate; varied keys keep their original values.

        Raises:
            ScenarioError: this scenario is not valid.
        """
        return scenario_of_sample(self.study, self.base, Sample(0, 0, candidate.values))


def median_of(scores: list[SurveyScore], name: str) -> float | None:
    """Returns the median of a metric over the surveys with status "complete"; None if none has a value.

    A missing LE90 over the asked area counts as infinite, because the map then has too many holes.
    """
    complete = [score.metrics[name] for score in scores if score.status == "complete"]
    known = [np.inf if value is None and name in INFINITE_WITH_HOLES else value for value in complete]
    known = [value for value in known if value is not None]
    return float(np.median(known)) if known else None


def check_bounds(study: Study, config: TuningConfig) -> None:
    """Validates the scenario at both bounds, or at all listed values, of each searched key.

    The other searched keys keep their original values, and the varied keys have those of the first valid sample.

    Raises:
        ScenarioError: a scenario is not valid; lists the errors, each key once.
    """
    base, errors = read_tree(study.scenario_file), []
    condition = _first_valid_sample(study, base)
    for key, distribution in config.search.items():
        for value in distribution.values:
            try:
                scenario_of_sample(study, base, condition._replace(values={key: value} | condition.values))
            except ScenarioError as error:
                errors += error.lines
    if errors:
        raise ScenarioError(merge_errors(errors))


def _first_valid_sample(study: Study, base: Mapping[str, Any]) -> Sample:
    """Returns the first sample whose scenario is valid with the original plan; if none is, the first sample."""
    for sample in samples(study):
        with suppress(ScenarioError):
            scenario_of_sample(study, base, sample)
            return sample
    return next(samples(study))


def cost_index(config: TuningConfig) -> int:
    """Returns the index of the objective that is the cost of a plan.

    It is the first objective that is a duration, e.g. "timing.simulated_s", or else the first objective.
    """
    costs = [k for k, name in enumerate(config.objectives) if name.startswith("timing.") and name.endswith("_s")]
    return costs[0] if costs else 0


def pareto_front(candidates: list[Candidate], config: TuningConfig) -> list[Candidate]:
    """Returns the Pareto-optimal candidates among the feasible ones, cheapest first; see `cost_index`."""
    signs, cost = objective_signs(config), cost_index(config)
    front = non_dominated([candidate for candidate in candidates if candidate.shortfall <= 0], config)
    return sorted(front, key=lambda one: ((signs * one.objectives)[cost], tuple(signs * one.objectives), one.number))


def non_dominated(candidates: list[Candidate], config: TuningConfig) -> list[Candidate]:
    """Returns the candidates that no other candidate dominates, i.e. is better in some objective and worse in none."""
    signs = objective_signs(config)
    return [one for one in candidates if not any(_dominates(other, one, signs) for other in candidates)]


def objective_signs(config: TuningConfig) -> NDArray[np.float64]:
    """Returns the sign (n,) of each objective: -1 if larger values are better, else 1."""
    return np.array([-1.0 if more_is_better(name) else 1.0 for name in config.objectives])


def _dominates(one: Candidate, other: Candidate, signs: Any) -> bool:
    """Returns whether `one` is better than `other` in some objective and worse in none."""
    a, b = signs * one.objectives, signs * other.objectives
    return bool((a <= b).all() and (a < b).any())
