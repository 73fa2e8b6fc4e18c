"""Search for a survey plan with the surrogate; rendered surveys verify the cheapest plans before one is recommended."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from twin.scenario.model import Scenario
from twin.studies.flight import Row
from twin.studies.results_log import ResultsLog, write_parquet
from twin.studies.runner import Fleet, open_folder
from twin.studies.study_file import Study
from twin.tuning.candidates import (
    Candidate,
    CandidateSurveys,
    Values,
    confirmation_of,
    cost_index,
    costs_of,
    non_dominated,
    pareto_front,
    rendered_of,
)
from twin.tuning.correction import correction_at
from twin.tuning.search import Search
from twin.tuning.verification import Verification, duration, expected_time, verification_of


class TuningResult(NamedTuple):
    study: Study
    #: all plans evaluated in the search; the surrogate's results are corrected by the rendered surveys, if any were
    #: flown
    candidates: list[Candidate]
    finalists: list[Candidate]  #: plans that were evaluated again with new samples and seeds, without correction
    verifications: list[Verification]  #: plans that were verified by rendered surveys, in the order of flight
    #: the cheapest plan whose rendered surveys all passed or, if plans are not verified, the cheapest plan confirmed
    #: with new samples and seeds; None if there is none or the search was interrupted
    recommended: Candidate | None
    scenario: Scenario | None  #: scenario of the recommended plan; None if there is none
    interrupted: bool  #: whether Ctrl-C ended the search
    #: whether the search used the surrogate, so its results need to be verified by rendered surveys
    needs_rendering: bool
    warnings: dict[str, int]  #: for each warning, the number of the finalists' surveys with new seeds that have it
    #: for each reason, the number of plans whose surveys were all refused in the search
    refused: Mapping[str, int] = MappingProxyType({})

    @property
    def recommended_verification(self) -> Verification | None:
        chosen = self.recommended
        return next((v for v in self.verifications if chosen and v.surrogate.number == chosen.number), None)


def tune(study: Study, folder: Path, resume: bool, fleet: Fleet) -> TuningResult:
    """Searches for the best plan as specified in `[tune]`, and writes results.parquet. Ctrl-C ends the search early.

    Raises TwinError if there is no section [tune], the folder is not empty and `resume` is not set, is written by
    another process, cannot be written, or belongs to another search or scenario, or the engine lost its connection;
    ScenarioError, before any flight, if the scenario is invalid at a bound or in all samples; OSError if results cannot
    be written.
    """
    CandidateSurveys(study, folder, ()).check_bounds()
    with open_folder(folder, resume, search=True) as log:
        tuning, interrupted = Tuning(study, folder, fleet, log), False
        try:
            tuning.run()
        except KeyboardInterrupt:
            interrupted = True
        log.flush()
        write_parquet(log.table(), folder / "results.parquet")
        return tuning.result(interrupted)


class Tuning:
    """State of a search: the evaluated plans, the finalists (evaluated again with new seeds), and the verifications."""

    def __init__(self, study: Study, folder: Path, fleet: Fleet, log: ResultsLog):
        self.study, self.folder, self.fleet, self.log = study, folder, fleet, log
        studies = (study, confirmation_of(study), rendered_of(study))
        self.trials, self.confirmation, self.rendered = (CandidateSurveys(s, folder, log.rows()) for s in studies)
        self.config = self.trials.config
        self.needs_rendering = self.trials.original.imaging.fidelity == "surrogate"
        self.is_verifying = self.needs_rendering and self.config.verify > 0  # before a plan is recommended
        self.plans: dict[int, Values] = {}
        self.finalists: dict[int, Candidate] = {}
        self.verifications: dict[int, Verification] = {}
        self.confirmed: Candidate | None = None

    def run(self) -> None:
        """Runs the rounds of the search until a plan can be recommended or all rounds are done.

        Each round evaluates candidates, confirms the cheapest plans with new seeds, and flies their rendered surveys.
        The first round is the only one if no plan was verified in it. After a plan has passed, cheaper plans that the
        surrogate rejects are verified.
        """
        search_round = 0
        for search_round in range(1 + self.config.rounds):
            self._search(search_round)
            self._verify_front(search_round)
            if self.recommended or not self.verifications:
                break
        self._verify_cheaper(search_round)

    @property
    def recommended(self) -> Candidate | None:
        """Returns the cheapest plan that passed verification or, if plans are not verified, that was confirmed."""
        if not self.is_verifying:
            return self.confirmed
        passed = [v.surrogate._replace(shortfall=0.0) for v in self.verifications.values() if v.passed]
        return next(iter(pareto_front(passed, self.config)), None)

    def result(self, interrupted: bool) -> TuningResult:
        """Returns the result; an interrupted search recommends no plan."""
        recommended = None if interrupted else self.recommended
        return TuningResult(
            self.study,
            self._candidates(),
            list(self.finalists.values()),
            list(self.verifications.values()),
            recommended,
            self.trials.scenario(recommended.values) if recommended else None,
            interrupted,
            self.needs_rendering,
            self.confirmation.warnings(self.finalists.values()),
            self.trials.refusals(self.plans),
        )

    def _fly(self, surveys: CandidateSurveys, plans: dict[int, Values]) -> None:

        def add_row(row: Row) -> None:
            self.log.add(row)
            surveys.add(row)

        missing, progress = list(surveys.missing(plans)), self.fleet.progress
        progress.begin(progress.total + len(missing))
        if missing and not self.fleet.fly(surveys.study, missing, add_row):
            raise KeyboardInterrupt

    def _search(self, search_round: int) -> None:
        search = Search(self.study, self.config, self.folder, self.trials.original.fingerprint(), search_round)
        if search_round:
            search.add_earlier_candidates((c.values, c.objectives, c.shortfall) for c in self._candidates())
        while batch := search.next_batch():
            plans = {number: dict(trial.params) for number, trial in batch.items()}
            self._fly(self.trials, plans)
            for number, values in plans.items():
                candidate = self._evaluate(self.trials, number, values)
                search.record(batch[number], candidate.objectives, candidate.shortfall)
        self.plans |= search.finished()

    def _verify_front(self, search_round: int) -> None:
        """Verifies the cheapest confirmed plan by rendered surveys, and corrects the predictions for all plans.

        Repeats this until that plan has passed before, none is confirmed, or `config.plans` plans were verified.
        """
        for k in range(self.config.plans):
            self.confirmed = chosen = self._cheapest_confirmed()
            if chosen is None or not self.is_verifying or chosen.number in self.verifications:
                return
            self._verify(chosen, (self.config.rounds - search_round + 2) * self.config.plans - k, search_round)

    def _verify_cheaper(self, search_round: int) -> None:
        """Verifies plans cheaper than the recommended one, until one does not pass or `config.plans` were verified."""
        for k in range(self.config.plans if self.is_verifying else 0):
            if (cheaper := self._next_cheaper()) is None:
                return
            self._confirm(cheaper)
            self._verify(cheaper, self.config.plans - k, search_round)
            if not self.verifications[cheaper.number].passed:
                return

    def _next_cheaper(self) -> Candidate | None:
        """Returns the next plan to verify that is cheaper than the recommended one; None if there is none.

        The costs of all plans are the corrected results of the search. Of the cheaper plans that no other dominates and
        that are not verified, it has the smallest shortfall of the pass probability and, of those, the highest cost.
        """
        if (chosen := self.recommended) is None:
            return None

        def cost(plan: Candidate) -> float:
            return float(costs_of([plan], self.config)[0, cost_index(self.config)])

        most = cost(self._evaluate(self.trials, chosen.number, chosen.values))
        front = non_dominated([plan for plan in self._candidates() if cost(plan) < most], self.config)
        untried = [plan for plan in front if plan.number not in self.verifications]
        return min(untried, key=lambda plan: (plan.shortfall, -cost(plan)), default=None)

    def _verify(self, plan: Candidate, most_plans: int, search_round: int) -> None:
        """Announces and flies the rendered surveys of a plan, and keeps its verification."""
        progress, values = self.fleet.progress, {plan.number: plan.values}
        if n_missing := sum(1 for _ in self.rendered.missing(values)):
            survey_s, source = expected_time(self.trials, self.rendered, plan, self.log.rows())
            most = most_plans * self.rendered.n_surveys
            progress.print_line(
                f"Flying plan {plan.number} rendered: {n_missing} surveys of about {duration(survey_s)} on one core "
                f"each ({source}), {duration(n_missing * survey_s)} of core time; at most {most} surveys and "
                f"{duration(most * survey_s)} until the end of the search"
            )
        self._fly(self.rendered, values)
        found = verification_of(self.rendered, self.confirmation, self.finalists[plan.number], search_round)
        self.verifications[plan.number] = found
        progress.print_line(found.notice())

    def _cheapest_confirmed(self) -> Candidate | None:
        """Returns the cheapest confirmed plan of the front, if any; bisects it, as costlier plans usually pass more."""
        front, found = pareto_front(self._candidates(), self.config), None
        first, end = 0, len(front)
        while first < end:
            middle = (first + end) // 2
            confirmed = self._confirm(front[middle])
            if confirmed.shortfall <= 0:
                found, end = confirmed, middle
            else:
                first = middle + 1
        return found

    def _confirm(self, plan: Candidate) -> Candidate:
        """Flies a plan with new samples and seeds as a finalist, and returns its corrected evaluation."""
        number, values = plan.number, plan.values
        self._fly(self.confirmation, {number: values})
        self.finalists[number] = self.confirmation.evaluate(number, values)
        return self._evaluate(self.confirmation, number, values)

    def _candidates(self) -> list[Candidate]:
        return [self._evaluate(self.trials, number, values) for number, values in self.plans.items()]

    def _evaluate(self, surveys: CandidateSurveys, number: int, values: Values) -> Candidate:
        """Returns a plan's evaluation, corrected by the rendered surveys of all plans."""
        correction = correction_at(self.config.search, [v.ratio for v in self.verifications.values()], values)
        candidate = surveys.evaluate(number, values, correction)
        if (verification := self.verifications.get(number)) is None:
            return candidate
        return candidate._replace(shortfall=min(candidate.shortfall, 0.0) if verification.passed else 1.0)
