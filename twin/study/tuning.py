"""A good plan: candidates are chosen, flown in the same conditions and judged; the best are flown again, afresh."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin.errors import ScenarioError, TwinError
from twin.judge.require import more_is_better
from twin.scenario.file import read_tree
from twin.scenario.model import Scenario
from twin.study.campaign import fly_all, open_folder
from twin.study.design import Sample, samples
from twin.study.engine import Engine
from twin.study.flight import Row, fly, has_passed
from twin.study.ledger import write_parquet
from twin.study.progress import Progress
from twin.study.search import Search
from twin.study.statistics import Interval, wilson
from twin.study.study_file import Study, Tuning
from twin.study.surveys import Survey, keys, sampled, surveys_of, told

_LEAST_SHARE = 0.5  # that must pass where the study does not say
_FRESH = 1_000_000  # added to the seed where a finalist is flown again
_WORST = 1e9  # of an objective where no survey was complete; Optuna has no infinity


class Flown(NamedTuple):
    """What a search keeps of a survey."""

    status: str
    passed: bool
    figures: dict[str, float | None]


class Candidate(NamedTuple):
    """A plan that was tried: the values chosen, its objectives, the share of surveys that pass, and what it lacks."""

    number: int
    values: dict[str, Any]
    objectives: tuple[float, ...]
    share: Interval
    lack: float  #: of the share that is required; at most 0 is enough

    @property
    def has_result(self) -> bool:
        """Whether any survey was complete, so that it has figures."""
        return max(abs(value) for value in self.objectives) < _WORST


class Tuned(NamedTuple):
    """A search that is over: every candidate, those flown afresh, and the plan recommended as flown afresh."""

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
    progress: Progress,
    function: Callable[[Survey], Row] = fly,
) -> Tuned:
    """Searches as `[tune]` says; what the folder has already is not flown again. Ctrl-C ends it early.

    Raises:
        TwinError: there is no [tune]; the folder is taken, cannot be written, or belongs to another search.
        ScenarioError: an end of the search is no valid scenario. Nothing was flown.
    """
    plan = plan_of(study)
    check_ends(study, plan)
    ledger = open_folder(folder, resume, ())
    flights = Flights(study, plan, folder, ledger.rows())

    def flown(way: Flights, candidates: dict[int, dict[str, Any]]) -> bool:
        def write(row: Row) -> None:
            ledger.add(row)
            way.keep(row)

        return fly_all(study, way.missing(candidates), write, engine, progress, function)

    search, tried, interrupted = Search(study, plan, folder), [], False
    progress.begin(plan.trials * flights.n_surveys)
    while not interrupted and (batch := search.next()):
        interrupted = not flown(flights, {p.number: p.values for p in batch})
        for proposal in batch if not interrupted else ():
            candidate = flights.judge(proposal.number, proposal.values)
            search.tell(proposal, candidate.objectives, candidate.lack)
    tried = [flights.judge(number, values) for number, values in search.finished()]

    afresh, finalists, recommended = flights.afresh(ledger.rows()), [], None
    front = best(tried, plan)
    first, end = 0, len(front)
    while first < end and not interrupted:  # the better in the first objective, the riskier: halved again and again
        middle = (first + end) // 2
        chosen = front[middle]
        progress.begin(progress.total + afresh.n_surveys)
        if interrupted := not flown(afresh, {chosen.number: chosen.values}):
            break
        finalists.append(afresh.judge(chosen.number, chosen.values))
        if finalists[-1].lack <= 0:
            recommended, end = finalists[-1], middle
        else:
            first = middle + 1
    scenario = flights.scenario(recommended) if recommended else None
    ledger.flush()
    write_parquet(ledger.table(), folder / "results.parquet")
    return Tuned(tried, finalists, recommended, scenario, interrupted)


def plan_of(study: Study) -> Tuning:
    """What is searched. Raises TwinError."""
    if study.tune is None:
        raise TwinError(str(study.source.path), "there is no section [tune]", "a study that searches")
    return study.tune


class Flights:
    """The surveys of candidates: the same conditions and the same seeds for each."""

    def __init__(self, study: Study, plan: Tuning, folder: Path, rows: Iterable[Row]):
        self.study, self.plan, self.folder = study, plan, folder
        self.base, self.conditions = read_tree(study.base), list(samples(study))
        self.n_surveys = len(list(keys(study)))
        self._flown: dict[tuple[int, int], Flown] = {}
        for row in rows:
            self.keep(row)

    def afresh(self, rows: Iterable[Row]) -> Flights:
        """The same with other draws and other seeds, and more of them."""
        sampling = self.study.sampling
        more = "seeds" if sampling.samples is None else "samples"
        fresh = {"seed": sampling.seed + _FRESH, more: (getattr(sampling, more) or 1) * self.plan.confirm}
        study = self.study.model_copy(update={"sampling": sampling.model_copy(update=fresh)})
        return Flights(study, self.plan, self.folder, rows)

    def keep(self, row: Row) -> None:
        """Remembers what a search needs of a row."""
        figures = {name: row.get(name) for name in self.plan.objectives}
        self._flown[row["sample"], row["seed"]] = Flown(row["status"], has_passed(row), figures)

    def surveys(self, number: int, values: dict[str, Any]) -> Iterator[Survey]:
        """What a candidate flies."""
        for condition in self.conditions:
            mixed = Sample(number * len(self.conditions) + condition.number, condition.draw, values | condition.values)
            yield from surveys_of(self.study, self.folder, mixed, sampled(self.study, self.base, mixed))

    def missing(self, candidates: dict[int, dict[str, Any]]) -> Iterator[Survey]:
        """The surveys of these candidates that were not flown, or failed."""
        for number, values in candidates.items():
            for survey in self.surveys(number, values):
                if survey.key not in self._flown or self._flown[survey.key].status == "failed":
                    yield survey

    def judge(self, number: int, values: dict[str, Any]) -> Candidate:
        """What its surveys say of a candidate; those that failed say nothing."""
        flown = [self._flown[survey.key] for survey in self.surveys(number, values)]
        ended = [one for one in flown if one.status != "failed"]
        share = wilson(sum(one.passed for one in ended), len(ended))
        required = _LEAST_SHARE if self.study.probability is None else self.study.probability
        lack = required - share.value if ended else 1.0
        return Candidate(
            number, values, tuple(self._objective(name, ended) for name in self.plan.objectives), share, lack
        )

    def _objective(self, name: str, ended: list[Flown]) -> float:
        """Risk, or the median of a metric over the surveys that were complete."""
        if name == "risk":
            return 1.0 - sum(one.passed for one in ended) / len(ended) if ended else 1.0
        figures = [one.figures[name] for one in ended if one.status == "complete"]
        known = [figure for figure in figures if figure is not None]
        return float(np.median(known)) if known else -_WORST if more_is_better(name) else _WORST

    def scenario(self, candidate: Candidate) -> Scenario:
        """The plan as a scenario, in the conditions of the study's own scenario."""
        return sampled(self.study, self.base, Sample(0, 0, candidate.values))


def check_ends(study: Study, plan: Tuning) -> None:
    """Builds the scenario at each end of what is searched. Raises ScenarioError with all faults, each once."""
    base, faults = read_tree(study.base), []
    condition = next(samples(study))
    for key, spread in plan.search.items():
        for value in spread.values:
            try:
                sampled(study, base, condition._replace(values={key: value} | condition.values))
            except ScenarioError as error:
                faults += error.lines
    if faults:
        raise ScenarioError(told(faults))


def best(candidates: list[Candidate], plan: Tuning) -> list[Candidate]:
    """Of those that pass often enough, the ones that no other beats; the best in the first objective first."""
    kept = [candidate for candidate in candidates if candidate.lack <= 0]
    signs = np.array([-1.0 if more_is_better(name) else 1.0 for name in plan.objectives])
    front = [one for one in kept if not any(_beats(other, one, signs) for other in kept)]
    return sorted(front, key=lambda one: (tuple(signs * one.objectives), one.number))


def _beats(one: Candidate, other: Candidate, signs: Any) -> bool:
    """Whether it is nowhere worse and somewhere better."""
    mine, theirs = signs * one.objectives, signs * other.objectives
    return bool((mine <= theirs).all() and (mine < theirs).any())
