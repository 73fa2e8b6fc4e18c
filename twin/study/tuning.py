"""Search for a survey plan.

All candidates are flown with the same samples and seeds; finalists are evaluated again with new samples and seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin.errors import ScenarioError, TwinError
from twin.judge.require import more_is_better
from twin.scenario.file import read_tree
from twin.scenario.model import Scenario
from twin.study.design import Sample, samples
from twin.study.engine import Engine
from twin.study.flight import Row, fly, has_passed
from twin.study.progress import StudyProgress
from twin.study.results_log import write_parquet
from twin.study.runner import fly_surveys, open_folder
from twin.study.search import Search
from twin.study.statistics import Interval, wilson_interval
from twin.study.study_file import Study, TuningConfig
from twin.study.surveys import Survey, merge_errors, scenario_of_sample, survey_keys, surveys_of_sample

_DEFAULT_PROBABILITY = 0.5  # required pass probability if the study does not set one
_SEED_OFFSET = 1_000_000  # added to the sampling seed of the study for the confirmation of finalists
_PENALTY = 1e9  # objective of a candidate without any complete survey; Optuna does not accept infinity


class SurveyScore(NamedTuple):
    """Part of a survey's result that the search uses: status, whether it passed, and the metrics to optimise."""

    status: str
    passed: bool
    metrics: dict[str, float | None]


class Candidate(NamedTuple):
    """An evaluated plan: trial number, value of each searched key, objectives, pass probability and its shortfall."""

    number: int
    values: dict[str, Any]
    objectives: tuple[float, ...]
    pass_probability: Interval
    shortfall: float  #: required minus achieved pass probability; 0 or negative if the plan is feasible

    @property
    def has_metrics(self) -> bool:
        """Returns whether every objective has a value, which requires at least one completed survey."""
        return max(abs(value) for value in self.objectives) < _PENALTY


class TuningResult(NamedTuple):
    """Result of a search.

    Args:
        candidates: all evaluated plans.
        finalists: plans that were evaluated again with new samples and seeds.
        recommended: the feasible finalist with the best first objective; None if there is none.
        scenario: scenario of the recommended plan.
        interrupted: whether Ctrl-C ended the search.
    """

    candidates: list[Candidate]
    finalists: list[Candidate]
    recommended: Candidate | None
    scenario: Scenario | None
    interrupted: bool


def tune(
    study: Study,
    folder: Path,
    resume: bool,
    engine: Engine,
    progress: StudyProgress,
    function: Callable[[Survey], Row] = fly,
) -> TuningResult:
    """Searches for the best plan as specified in `[tune]`, and writes results.parquet. Ctrl-C ends the search early.

    Args:
        folder: results folder, new or empty unless `resume` is set.
        resume: continue the search whose results are in the folder; its surveys are not flown again.
        function: flies one survey; must be importable by name on the workers.

    Raises:
        TwinError: the study has no [tune]; the folder is not empty, cannot be written, or belongs to another search.
        ScenarioError: the scenario is invalid at a bound of the search; nothing was flown.
    """
    config = tuning_config(study)
    check_bounds(study, config)
    log = open_folder(folder, resume, ())
    trial_surveys = CandidateSurveys(study, config, folder, log.rows())

    def fly_candidates(plan_surveys: CandidateSurveys, candidates: dict[int, dict[str, Any]]) -> bool:
        def add_row(row: Row) -> None:
            log.add(row)
            plan_surveys.add(row)

        return fly_surveys(study, plan_surveys.missing(candidates), add_row, engine, progress, function)

    search, interrupted = Search(study, config, folder), False
    progress.begin(config.trials * trial_surveys.n_surveys)
    while not interrupted and (batch := search.next_batch()):
        interrupted = not fly_candidates(trial_surveys, {p.number: p.values for p in batch})
        for proposal in batch if not interrupted else ():
            candidate = trial_surveys.evaluate(proposal.number, proposal.values)
            search.record(proposal, candidate.objectives, candidate.shortfall)
    candidates = [trial_surveys.evaluate(number, values) for number, values in search.finished()]

    confirmation, finalists, recommended = trial_surveys.confirmation(log.rows()), [], None
    front = pareto_front(candidates, config)
    first, end = 0, len(front)
    while first < end and not interrupted:  # bisection: a better first objective usually has a lower pass probability
        middle = (first + end) // 2
        chosen = front[middle]
        progress.begin(progress.total + confirmation.n_surveys)
        if interrupted := not fly_candidates(confirmation, {chosen.number: chosen.values}):
            break
        finalists.append(confirmation.evaluate(chosen.number, chosen.values))
        if finalists[-1].shortfall <= 0:
            recommended, end = finalists[-1], middle
        else:
            first = middle + 1
    scenario = trial_surveys.scenario(recommended) if recommended else None
    log.flush()
    write_parquet(log.table(), folder / "results.parquet")
    return TuningResult(candidates, finalists, recommended, scenario, interrupted)


def tuning_config(study: Study) -> TuningConfig:
    """Returns the section [tune] of a study.

    Raises:
        TwinError: the study has no section [tune].
    """
    if study.tune is None:
        raise TwinError(str(study.source.path), "has no section [tune]", "a study with a section [tune]")
    return study.tune


def required_probability(study: Study) -> float:
    """Returns the pass probability that a plan must reach."""
    return _DEFAULT_PROBABILITY if study.probability is None else study.probability


class CandidateSurveys:
    """Surveys of the candidates, with the results obtained so far.

    All candidates are flown with the same samples and seeds, those of the study.
    """

    def __init__(self, study: Study, config: TuningConfig, folder: Path, rows: Iterable[Row]):
        self.study, self.config, self.folder = study, config, folder
        self.base, self.conditions = read_tree(study.scenario_file), list(samples(study))
        self.n_surveys = len(list(survey_keys(study)))
        self._scores: dict[tuple[int, int], SurveyScore] = {}
        for row in rows:
            self.add(row)

    def confirmation(self, rows: Iterable[Row]) -> CandidateSurveys:
        """Returns the surveys that confirm a finalist: `confirm` times as many, with new samples and seeds.

        Args:
            rows: rows of the surveys flown so far.
        """
        sampling = self.study.sampling
        count = "seeds" if sampling.samples is None else "samples"
        update = {"seed": sampling.seed + _SEED_OFFSET, count: (getattr(sampling, count) or 1) * self.config.confirm}
        study = self.study.model_copy(update={"sampling": sampling.model_copy(update=update)})
        return CandidateSurveys(study, self.config, self.folder, rows)

    def add(self, row: Row) -> None:
        """Adds the result of a survey."""
        metrics = {name: row.get(name) for name in self.config.objectives}
        self._scores[row["sample"], row["seed"]] = SurveyScore(row["status"], has_passed(row), metrics)

    def surveys(self, number: int, values: dict[str, Any]) -> Iterator[Survey]:
        """Yields the surveys of a candidate.

        Args:
            number: trial number of the candidate.
            values: value of each searched key.
        """
        for condition in self.conditions:
            index = number * len(self.conditions) + condition.number
            sample = Sample(index, condition.point, values | condition.values)
            scenario = scenario_of_sample(self.study, self.base, sample)
            yield from surveys_of_sample(self.study, self.folder, sample, scenario)

    def missing(self, candidates: dict[int, dict[str, Any]]) -> Iterator[Survey]:
        """Yields the surveys of the candidates (values by trial number) that have not been flown or have failed."""
        for number, values in candidates.items():
            for survey in self.surveys(number, values):
                if survey.key not in self._scores or self._scores[survey.key].status == "failed":
                    yield survey

    def evaluate(self, number: int, values: dict[str, Any]) -> Candidate:
        """Returns a candidate with its objectives and pass probability; surveys that failed are not counted.

        Args:
            number: trial number of the candidate.
            values: value of each searched key.
        """
        flown = [self._scores[survey.key] for survey in self.surveys(number, values)]
        scores = [score for score in flown if score.status != "failed"]
        passing = wilson_interval(sum(score.passed for score in scores), len(scores))
        shortfall = required_probability(self.study) - passing.value if scores else 1.0
        objectives = tuple(self._objective(name, scores) for name in self.config.objectives)
        return Candidate(number, values, objectives, passing, shortfall)

    def _objective(self, name: str, scores: list[SurveyScore]) -> float:
        """Returns an objective: the risk, or the median of a metric over the completed surveys."""
        if name == "risk":
            return 1.0 - sum(score.passed for score in scores) / len(scores) if scores else 1.0
        complete = [score.metrics[name] for score in scores if score.status == "complete"]
        known = [value for value in complete if value is not None]
        return float(np.median(known)) if known else -_PENALTY if more_is_better(name) else _PENALTY

    def scenario(self, candidate: Candidate) -> Scenario:
        """Returns the scenario of the study with the plan of a candidate; varied keys keep their original values."""
        return scenario_of_sample(self.study, self.base, Sample(0, 0, candidate.values))


def check_bounds(study: Study, config: TuningConfig) -> None:
    """Validates the scenario at both bounds, or at all listed values, of each searched key.

    Raises:
        ScenarioError: lists all errors, each key once.
    """
    base, errors = read_tree(study.scenario_file), []
    condition = next(samples(study))
    for key, distribution in config.search.items():
        for value in distribution.values:
            try:
                scenario_of_sample(study, base, condition._replace(values={key: value} | condition.values))
            except ScenarioError as error:
                errors += error.lines
    if errors:
        raise ScenarioError(merge_errors(errors))


def pareto_front(candidates: list[Candidate], config: TuningConfig) -> list[Candidate]:
    """Returns the Pareto-optimal candidates among the feasible ones, sorted by the first objective, best first."""
    feasible = [candidate for candidate in candidates if candidate.shortfall <= 0]
    signs = np.array([-1.0 if more_is_better(name) else 1.0 for name in config.objectives])
    front = [one for one in feasible if not any(_dominates(other, one, signs) for other in feasible)]
    return sorted(front, key=lambda one: (tuple(signs * one.objectives), one.number))


def _dominates(one: Candidate, other: Candidate, signs: Any) -> bool:
    """Returns whether `one` is better than `other` in some objective and worse in none."""
    a, b = signs * one.objectives, signs * other.objectives
    return bool((a <= b).all() and (a < b).any())
