"""Search for a survey plan with the surrogate; rendered surveys verify the cheapest plans before one is recommended."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from twin.scenario.model import Scenario
from twin.studies.flight import Row
from twin.studies.results_log import ResultsLog, write_parquet
from twin.studies.runner import Fleet, open_folder
from twin.studies.study_file import Study, TuningConfig
from twin.tuning.candidates import (
    Candidate,
    CandidateSurveys,
    check_bounds,
    cost_index,
    non_dominated,
    objective_signs,
    pareto_front,
    tuning_config,
)
from twin.tuning.correction import PlanCorrection, correction_at
from twin.tuning.search import Search
from twin.tuning.verification import Verification, expected_time, verification_of


class TuningResult(NamedTuple):
    """Result of a search."""

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
        """Returns the verification of the recommended plan; None if it was not verified or there is no plan."""
        chosen = self.recommended
        return next((v for v in self.verifications if chosen and v.surrogate.number == chosen.number), None)


def tune(study: Study, folder: Path, resume: bool, fleet: Fleet) -> TuningResult:
    """Searches for the best plan as specified in `[tune]`, and writes results.parquet. Ctrl-C ends the search early.

    Args:
        resume: continue the search whose results are in the folder; surveys with a result are not flown again.

    Raises:
        TwinError: the study has no section [tune]; the folder is not empty and `resume` is not set, is written by
            another process, cannot be written, or belongs to another search or scenario; or the engine lost its
            connection.
        ScenarioError: the scenario is invalid at a bound of the search, or in all samples; nothing was flown.
        OSError: the results cannot be written.
    """
    config, interrupted = tuning_config(study), False
    check_bounds(study, config)
    with open_folder(folder, resume, search=True) as log:
        tuning = Tuning(study, config, folder, fleet, log)
        try:
            tuning.run()
        except KeyboardInterrupt:
            interrupted = True
        log.flush()
        write_parquet(log.table(), folder / "results.parquet")
        return tuning.result(interrupted)


class Tuning:
    """State of a search: the evaluated plans, the finalists (evaluated again with new seeds), and the verifications."""

    def __init__(self, study: Study, config: TuningConfig, folder: Path, fleet: Fleet, log: ResultsLog):
        self.study, self.config, self.folder, self.fleet, self.log = study, config, folder, fleet, log
        self.trials = CandidateSurveys(study, config, folder, log.rows())
        self.confirmation = self.trials.confirmation(log.rows())
        self.rendered = self.trials.rendered(log.rows())
        self.needs_rendering = self.trials.uses_surrogate
        self.plans: dict[int, dict[str, Any]] = {}
        self.finalists: dict[int, Candidate] = {}
        self.verifications: dict[int, Verification] = {}
        self.confirmed: Candidate | None = None

    def run(self) -> None:
        """Runs the rounds of the search until a plan can be recommended or all rounds are done.

        Each round evaluates candidates, confirms the cheapest plans with new seeds, and flies their rendered surveys.
        The first round is the only one if no plan was verified in it. After a plan has passed, cheaper plans that the
        surrogate rejects are verified; see `_verify_cheaper`.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed.
            TwinError: the engine lost its connection, or the folder contains another search or another scenario.
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
        """Returns the cheapest plan that passed verification; the cheapest confirmed plan if plans are not verified.

        None if there is no such plan.
        """
        if not self.is_verifying:
            return self.confirmed
        passed = [v.surrogate._replace(shortfall=0.0) for v in self.verifications.values() if v.passed]
        return next(iter(pareto_front(passed, self.config)), None)

    @property
    def is_verifying(self) -> bool:
        """Returns whether rendered surveys verify plans before one is recommended."""
        return self.needs_rendering and self.config.verify > 0

    def result(self, interrupted: bool) -> TuningResult:
        """Returns the result of the search; an interrupted search recommends no plan."""
        recommended = None if interrupted else self.recommended
        return TuningResult(
            self._candidates(),
            list(self.finalists.values()),
            list(self.verifications.values()),
            recommended,
            self.trials.scenario(recommended) if recommended else None,
            interrupted,
            self.needs_rendering,
            self.confirmation.warnings(self.finalists.values()),
            self.trials.refusals(self.plans),
        )

    def _fly(self, surveys: CandidateSurveys, plans: dict[int, dict[str, Any]]) -> None:
        """Flies those surveys of the given plans that have no result yet.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed; the results obtained until then are logged.
        """

        def add_row(row: Row) -> None:
            self.log.add(row)
            surveys.add(row)

        missing, progress = list(surveys.missing(plans)), self.fleet.progress
        progress.begin(progress.total + len(missing))
        if missing and not self.fleet.fly(surveys.study, missing, add_row):
            raise KeyboardInterrupt

    def _search(self, search_round: int) -> None:
        """Evaluates the candidates of a round; the sampler starts from the corrected results of the earlier rounds."""
        search = Search(self.study, self.config, self.folder, self.trials.fingerprint, search_round)
        if search_round:
            search.add_earlier_candidates((c.values, c.objectives, c.shortfall) for c in self._candidates())
        while batch := search.next_batch():
            self._fly(self.trials, {proposal.number: proposal.values for proposal in batch})
            for proposal in batch:
                candidate = self._evaluate(self.trials, proposal.number, proposal.values)
                search.record(proposal, candidate.objectives, candidate.shortfall)
        self.plans |= dict(search.finished())

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
        if self.recommended is None:
            return None
        sign, cost = objective_signs(self.config), cost_index(self.config)
        recommended = self._evaluate(self.trials, self.recommended.number, self.recommended.values)
        most = recommended.objectives[cost] * sign[cost]
        cheaper = [c for c in self._candidates() if c.objectives[cost] * sign[cost] < most]
        front = [one for one in non_dominated(cheaper, self.config) if one.number not in self.verifications]
        return min(front, key=lambda one: (one.shortfall, -one.objectives[cost] * sign[cost]), default=None)

    def _verify(self, plan: Candidate, most_plans: int, search_round: int) -> None:
        """Flies the rendered surveys of a plan and compares them with its surrogate surveys."""
        self._announce(plan, most_plans)
        self._fly(self.rendered, {plan.number: plan.values})
        surrogate = self.finalists[plan.number]
        verification = verification_of(self.rendered, self.confirmation, surrogate, search_round)
        self.verifications[plan.number] = verification
        self.fleet.progress.print_line(verification.notice())

    def _announce(self, plan: Candidate, most_plans: int) -> None:
        """Prints the number and the expected run time of a plan's rendered surveys that are to be flown, if any."""
        if n_missing := sum(1 for _ in self.rendered.missing({plan.number: plan.values})):
            times = expected_time(self.trials, self.rendered, plan, self.log.rows())
            self.fleet.progress.print_line(times.notice(plan.number, n_missing, most_plans * self.rendered.n_surveys))

    def _cheapest_confirmed(self) -> Candidate | None:
        """Returns the cheapest plan of the Pareto front that reaches the required pass probability with new seeds.

        Bisects the front, because a more expensive plan usually has a higher pass probability. None if none is found.
        """
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
        """Flies a plan with new samples and seeds, adds it to the finalists, and returns its corrected evaluation."""
        number, values = plan.number, plan.values
        self._fly(self.confirmation, {number: values})
        self.finalists[number] = self.confirmation.evaluate(number, values)
        return self._evaluate(self.confirmation, number, values)

    def _candidates(self) -> list[Candidate]:
        """Returns all candidates evaluated so far, corrected by the rendered surveys."""
        return [self._evaluate(self.trials, number, values) for number, values in self.plans.items()]

    def _evaluate(self, surveys: CandidateSurveys, number: int, values: dict[str, Any]) -> Candidate:
        """Returns a plan's evaluation, with the surrogate's results corrected by the rendered surveys of all plans."""
        candidate = surveys.evaluate(number, values, self._correction(values))
        if (verification := self.verifications.get(number)) is None:
            return candidate
        return candidate._replace(shortfall=min(candidate.shortfall, 0.0) if verification.passed else 1.0)

    def _correction(self, values: dict[str, Any]) -> PlanCorrection:
        return correction_at(self.config.search, [v.ratio for v in self.verifications.values()], values)
