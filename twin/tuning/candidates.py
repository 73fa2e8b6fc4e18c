"""Candidate plans of a search: their surveys, objectives, pass probability, and the Pareto front.

All candidates are flown with the same samples and seeds. Finalists, the plans to be confirmed, are flown again
with new samples and seeds. The plans to be verified are then flown as rendered surveys, with further samples and seeds.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.errors import ScenarioError, TwinError
from twin.judge.map_error import CAUSES, INFINITE_WITH_HOLES, with_completeness
from twin.judge.verdict import meets_limit, more_is_better
from twin.scenario.file import input_files, read_tree
from twin.scenario.model import Scenario
from twin.studies.analysis import count_similar
from twin.studies.conditions import in_sea_trial
from twin.studies.flight import Row, failure_reason, has_passed, refused_row
from twin.studies.results_log import key_of
from twin.studies.statistics import Proportion, trials_to_show, wilson_interval
from twin.studies.study_file import MAX_VERIFY, Study, TuningConfig
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
_FORGIVEN = 2  # rendered surveys of a plan that may fail before it is given up
VISIBILITY = "water.visibility_m"
_ALWAYS = ("timing.simulated_s", "map.le90_area_m", VISIBILITY)  # reported in any case
_PENALTY = 1e9  # objective of a candidate without a finite median; Optuna does not accept infinity

Values = dict[str, Any]  #: a plan: the value of each searched key


class SurveyScore(NamedTuple):
    """Part of a survey's result that the search uses."""

    status: str
    passed: bool
    metrics: dict[str, float | None]  #: objectives and metrics with a limit, with their completeness metrics
    warning: str
    scenario_hash: str
    reason: str  #: why the survey did not pass; empty if it did
    unmodelled: bool  #: whether only the surrogate refuses it
    causes: dict[str, float | None]  #: `map.*_error_m` by cause, without `map.`


class Candidate(NamedTuple):
    number: int  #: of the trial
    values: Values
    objectives: tuple[float, ...]
    pass_probability: Proportion
    shortfall: float  #: required minus achieved pass probability; 0 or negative if the plan is feasible
    #: (name, median) of each completeness metric that is reported in addition to the objectives; NaN without a value
    completeness: tuple[tuple[str, float], ...] = ()

    @property
    def least_shortfall(self) -> float:
        """Returns the shortfall if every survey passes whose result is unknown, because the surrogate refuses it."""
        return self.shortfall - (self.pass_probability.most - self.pass_probability.value)

    @property
    def has_metrics(self) -> bool:
        """Returns whether every objective has a finite value; a metric has none without a completed survey."""
        return max(abs(value) for value in self.objectives) < _PENALTY


def tuning_config(study: Study) -> TuningConfig:
    """Returns the section [tune] of a study; raises TwinError if the study has none."""
    if study.tune is None:
        raise TwinError(str(study.source.path), "has no section [tune]", "a study with a section [tune]")
    return study.tune


def required_probability(study: Study) -> float:
    """Returns the pass probability that a plan must reach: that of the study, or else 0.5."""
    return _DEFAULT_PROBABILITY if study.probability is None else study.probability


def confirmation_of(study: Study) -> Study:
    """Returns the study that confirms a plan: `tune.confirm` times as many surveys as in the search, with new seeds.

    Sampled keys have as many more design points, which are new, each with its own seeds: with shared seeds, samples of
    a key with few values would repeat surveys, and all samples would be on the same few floors. Designs that need a
    power of 2 as number of samples are replaced by "lhs" for another number. Without sampled keys, or with the design
    "grid", the samples stay the same, with more seeds.
    """
    sampling, n_axes = study.sampling, len(study.axes(listed=False))
    count = "samples" if n_axes else "seeds"
    n = (getattr(sampling, count) or 1) * tuning_config(study).confirm
    update: dict[str, Any] = {"seed": sampling.seed + _CONFIRM_SEEDS, "paired": False, count: n}
    if n_axes and sampling.method in _POWER_OF_2 and n & (n - 1):
        update |= {"method": "lhs", "samples": n * (n_axes + 2) if sampling.method == "saltelli" else n}
    return study.model_copy(update={"sampling": sampling.model_copy(update=update)})


def most_rendered(study: Study) -> int:
    """Returns the largest number of rendered surveys of a plan; see `tune.verify`."""
    verify = tuning_config(study).verify
    if verify is not None:
        return verify
    return int(min(trials_to_show(required_probability(study), _FORGIVEN), MAX_VERIFY))


def rendered_of(study: Study) -> Study:
    """Returns the study of the rendered surveys of a plan: random samples of `most_rendered`, each with its own seed.

    They are flown in the conditions of the sea trial, unless `sea_trial` is set. The first ones stay the same if there
    are more. Without a number of samples in the study, each cell of the grids has as many seeds instead.
    """
    if study.sea_trial is None:
        study = in_sea_trial(study)
    sampling, config = study.sampling, tuning_config(study)
    update: dict[str, Any] = {"seed": sampling.seed + _RENDER_SEEDS, "paired": False, "seeds": 1}
    update["seeds" if sampling.samples is None else "samples"] = max(most_rendered(study), 1)  # with 0, none is flown
    if sampling.samples is not None:
        update["method"] = "random"
    changes = {
        "sampling": sampling.model_copy(update=update),
        "set": study.set | {"imaging.fidelity": "rendered"},
        "keep": config.keep or study.keep,
        "timeout_s": config.timeout_s,
    }
    return study.model_copy(update=changes)


def value_at(scenario: Scenario, key: str) -> Any:
    """Returns the value of a dotted key of a scenario; None if its section is absent."""
    value: Any = scenario
    for part in key.split("."):
        value = value[int(part)] if isinstance(value, list | tuple) else getattr(value, part, None)
    return value


class CandidateSurveys:
    """Surveys of the candidates, with the results obtained so far.

    Samples that are invalid with the original plan of the study's scenario are left out. Raises TwinError without a
    section [tune], ScenarioError if no sample is valid.
    """

    def __init__(self, study: Study, folder: Path, rows: Iterable[Row]):
        self.study, self.config, self.folder = study, tuning_config(study), folder
        self.base, refused = read_tree(study.scenario_file), refusals(study)
        self.conditions = [sample for sample in samples(study) if sample.number not in refused]
        #: numbers of samples of a plan; constant for rendered surveys, whose number may change on --resume
        self._n_samples = max(len(self.conditions) + len(refused), MAX_VERIFY)
        self.n_surveys = sum(len(seeds_of_sample(study, condition)) for condition in self.conditions)
        self.limits: dict[str, float] = study.limits or self.base.get("require", {})
        names = with_completeness([*self.config.objectives, *self.limits, *_ALWAYS])
        self.metrics = [name for name in names if name != "risk"]
        self._scores: dict[tuple[int, int], SurveyScore] = {}
        for row in rows:
            self.add(row)

    @property
    def original(self) -> Scenario:
        return scenario_of_sample(self.study, self.base, self.conditions[0])

    def scenario(self, values: Values) -> Scenario:
        """Returns the scenario of the study with a plan; varied keys keep their original values."""
        return scenario_of_sample(self.study, self.base, Sample(0, 0, values))

    def check_bounds(self) -> None:
        """Raises ScenarioError unless the first valid sample is valid at both bounds, or all values, of each key."""
        errors = []
        for sample in self._bounds():
            try:
                scenario_of_sample(self.study, self.base, sample)
            except ScenarioError as error:
                errors += error.lines
        if errors:
            raise ScenarioError(merge_errors(errors))

    def _bounds(self) -> Iterator[Sample]:
        """Yields the first valid sample with the bounds, and a value between them, or all values of each key."""
        sample = self.conditions[0]
        for key, law in self.config.search.items():
            for value in (*law.values, *law.quantiles(np.array([0.37]))):
                yield sample._replace(values={key: value} | sample.values)

    def input_files(self) -> Iterator[Path]:
        """Yields the input files of all valid samples, and of the values of the search."""
        for sample in (*self.conditions, *self._bounds()):
            yield from input_files(scenario_of_sample(self.study, self.base, sample))

    def add(self, row: Row) -> None:
        self._scores[key_of(row)] = SurveyScore(
            row["status"], has_passed(row), {name: row.get(name) for name in self.metrics}, row.get("warning") or "",
            row["scenario_hash"], failure_reason(row), bool(row.get("unmodelled")),
            {f"{cause}_error_m": row.get(f"map.{cause}_error_m") for cause in CAUSES},
        )  # fmt: skip

    def _samples(self, number: int, values: Values) -> Iterator[Sample]:
        for condition in self.conditions:
            yield Sample(number * self._n_samples + condition.number, condition.point, values | condition.values)

    def keys(self, number: int, values: Values, first: int | None = None) -> list[tuple[int, int]]:
        """Returns (sample, seed) of the first surveys of a plan (None: of all); the cells of grids take turns."""
        pairs = [(s, seed) for s in self._samples(number, values) for seed in seeds_of_sample(self.study, s)]
        pairs.sort(key=lambda pair: (pair[0].point, pair[1]))
        return [(sample.number, seed) for sample, seed in pairs[:first]]

    def surveys(self, number: int, values: Values, first: int | None = None) -> Iterator[Survey | Row]:
        """Yields the `first` surveys of a candidate; a refused row for a survey whose scenario is not valid."""
        wanted = set(self.keys(number, values, first))
        for sample in self._samples(number, values):
            seeds = [seed for seed in seeds_of_sample(self.study, sample) if (sample.number, seed) in wanted]
            try:
                scenario = scenario_of_sample(self.study, self.base, sample) if seeds else None
            except ScenarioError as error:
                yield from (refused_row(sample, seed, "; ".join(error.lines)) for seed in seeds)
                continue
            if scenario is not None:
                found = surveys_of_sample(self.study, self.folder, sample, scenario)
                yield from (survey for survey in found if survey.key in wanted)

    def missing(self, candidates: Mapping[int, Values], first: int | None = None) -> Iterator[Survey]:
        """Yields the surveys of candidates that have no result with the present scenario; records the refused ones."""
        for survey in (survey for plan in candidates.items() for survey in self.surveys(*plan, first)):
            if not isinstance(survey, Survey):
                self.add(survey)
            elif (score := self._result(survey.key)) is None or score.scenario_hash != survey.scenario_hash:
                yield survey

    def _result(self, key: tuple[int, int]) -> SurveyScore | None:
        """Returns the result of a survey; None if it was not flown or failed."""
        score = self._scores.get(key)
        return None if score is None or score.status == "failed" else score

    def scores(self, number: int, values: Values, first: int | None = None) -> list[SurveyScore]:
        """Returns the results of a candidate's surveys; those of the same scenario with the same seed count once."""
        known = [(key, score) for key in self.keys(number, values, first) if (score := self._result(key)) is not None]
        return list({(score.scenario_hash or key, key[1]): score for key, score in known}.values())

    def n_failed(self, number: int, values: Values, first: int | None = None) -> int:
        """Returns the number of a candidate's surveys that failed because of the computer or the program."""
        scores = (self._scores.get(key) for key in self.keys(number, values, first))
        return sum(score is not None and score.status == "failed" for score in scores)

    def warnings(self, plans: Iterable[Candidate]) -> dict[str, int]:
        """Returns {warning: number of surveys of the candidates that have it}; see `count_similar`."""
        scores = (score for plan in plans for score in self.scores(plan.number, plan.values))
        return count_similar(score.warning for score in scores if score.warning)

    def refusals(self, plans: Mapping[int, Values]) -> dict[str, int]:
        """Returns {reason of the first survey: number of plans whose surveys were all refused}; see `count_similar`."""
        of_plans = [self.scores(*plan) for plan in plans.items()]
        refused = [scores for scores in of_plans if {score.status for score in scores} == {"refused"}]
        return count_similar(scores[0].reason for scores in refused)

    def evaluate(self, number: int, values: Values, correction: PlanCorrection = NO_CORRECTION) -> Candidate:
        """Returns a candidate with its objectives and pass probability, corrected to those of rendered surveys.

        A refused survey counts as one that does not pass. If only the surrogate refuses it, its result is unknown: it
        may pass at the upper bound of the pass probability, and counts as the worst value of an objective.
        """
        scores = self.scores(number, values)
        n_passed = sum(self._passes(score, correction) for score in scores)
        passed, n_unknown = correction.pass_factor * n_passed, sum(score.unmodelled for score in scores)
        best = wilson_interval(min(passed + n_unknown, len(scores)), len(scores))
        passing = wilson_interval(passed, len(scores))._replace(high=best.high, most=best.value)
        shortfall = required_probability(self.study) - passing.value if scores else 1.0
        risk = 1.0 - passing.value if scores else 1.0
        corrected = {name: correction.apply(name, median_of(scores, name)) for name in self.metrics}
        objectives = tuple(risk if n == "risk" else _finite(n, corrected[n]) for n in self.config.objectives)
        further = [name for name in with_completeness(self.config.objectives) if name not in self.config.objectives]
        medians = ((name, median_of(scores, name)) for name in further)
        completeness = tuple((name, np.nan if value is None else value) for name, value in medians)
        return Candidate(number, values, objectives, passing, shortfall, completeness)

    def _passes(self, score: SurveyScore, correction: PlanCorrection) -> bool:
        if correction is NO_CORRECTION:
            return score.passed
        met = (meets_limit(n, correction.apply(n, score.metrics[n]), limit) for n, limit in self.limits.items())
        return score.status == "complete" and all(met)


def _finite(objective: str, value: float | None) -> float:
    if value is not None and np.isfinite(value):
        return value
    return -_PENALTY if more_is_better(objective) else _PENALTY


def median_of(scores: list[SurveyScore], name: str) -> float | None:
    """Returns the median of a metric over the complete surveys; None if none has a value."""
    # missing: infinite for `INFINITE_WITH_HOLES`; unknown: the worst, except for a duration
    complete = [score.metrics[name] for score in scores if score.status == "complete"]
    known = [np.inf if value is None and name in INFINITE_WITH_HOLES else value for value in complete]
    known = [value for value in known if value is not None]
    if not known:
        return None
    n_unknown = 0 if name.startswith("timing.") else sum(score.unmodelled for score in scores)
    return float(np.median([*known, *n_unknown * [-np.inf if more_is_better(name) else np.inf]]))


def cost_index(config: TuningConfig) -> int:
    """Returns the index of the objective that is the cost of a plan: the first duration, or else the first one."""
    costs = [k for k, name in enumerate(config.objectives) if name.startswith("timing.") and name.endswith("_s")]
    return costs[0] if costs else 0


def plan_cost(plan: Candidate, config: TuningConfig) -> float:
    return float(costs_of([plan], config)[0, cost_index(config)])


def costs_of(candidates: list[Candidate], config: TuningConfig) -> NDArray[np.float64]:
    """Returns the objectives (n, m) of n candidates, with a negative sign if larger values are better."""
    signs = [-1.0 if more_is_better(name) else 1.0 for name in config.objectives]
    return np.array([c.objectives for c in candidates]).reshape(-1, len(signs)) * signs


def pareto_front(candidates: list[Candidate], config: TuningConfig) -> list[Candidate]:
    """Returns the Pareto-optimal candidates among the feasible ones, cheapest first; see `cost_index`."""
    front = non_dominated([candidate for candidate in candidates if candidate.shortfall <= 0], config)
    costs, first = costs_of(front, config), cost_index(config)
    order = sorted(range(len(front)), key=lambda k: (costs[k, first], tuple(costs[k]), front[k].number))
    return [front[k] for k in order]


def non_dominated(candidates: list[Candidate], config: TuningConfig) -> list[Candidate]:
    """Returns the candidates to which no other is better in some objective and worse in none."""
    costs = costs_of(candidates, config)
    dominated = [((costs <= own).all(axis=1) & (costs < own).any(axis=1)).any() for own in costs]
    return [candidate for candidate, is_worse in zip(candidates, dominated, strict=True) if not is_worse]
