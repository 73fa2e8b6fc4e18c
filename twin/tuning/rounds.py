"""Search for a survey plan with the surrogate; rendered surveys verify the cheapest plans before one is recommended."""

import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from twin.core.checkpoint import check_inputs
from twin.planning.summary import instructions
from twin.report.number_formats import duration, percent
from twin.scenario.model import Scenario
from twin.studies.flight import Row
from twin.studies.results_log import ResultsLog, key_of, write_parquet
from twin.studies.run_time import rendered_time
from twin.studies.runner import Fleet, open_folder
from twin.studies.study_file import Study
from twin.tuning.candidates import (
    Candidate,
    CandidateSurveys,
    Values,
    confirmation_of,
    most_rendered,
    non_dominated,
    pareto_front,
    plan_cost,
    rendered_of,
    tuning_config,
    value_at,
)
from twin.tuning.correction import correction_at
from twin.tuning.search import Search
from twin.tuning.verification import Verification, verification_of
from twin.world.mission import prepare

START = -1  #: number of the starting plan, that of the scenario
_START_SURVEYS = 3  # rendered surveys of the starting plan
_SEARCH_SHARE = 0.4  # of the budget, after which no further candidates are proposed


class OutOfTime(Exception):  # noqa: N818 (the end of the budget, not an error)
    """The budget is used up."""


class TuningResult(NamedTuple):
    study: Study
    #: all plans evaluated in the search; the surrogate's results are corrected by the rendered surveys, if any were
    #: flown
    candidates: list[Candidate]
    finalists: list[Candidate]  #: plans that were evaluated again with new samples and seeds, without correction
    verifications: list[Verification]  #: plans that were verified by rendered surveys, in the order of flight
    #: the cheapest plan whose rendered surveys show the required pass probability; None if there is none or the search
    #: was interrupted
    recommended: Candidate | None
    #: without a recommended plan, the one that comes closest: with the highest lower bound in rendered surveys that
    #: more of them could raise, or else confirmed by the surrogate; None if there is none
    unproven: Candidate | None
    scenario: Scenario | None  #: scenario of the recommended or unproven plan; None if there is none
    instructions: str  #: what this plan is to fly (`twin.planning.summary.instructions`)
    start: Verification | None  #: the plan of the scenario, if a plan is recommended and its surveys were flown
    interrupted: bool  #: whether Ctrl-C ended the search
    out_of_time: bool  #: whether the budget was used up
    #: whether the search used the surrogate, so its results need to be verified by rendered surveys
    needs_rendering: bool
    warnings: dict[str, int]  #: for each warning, the number of the finalists' surveys with new seeds that have it
    #: for each reason, the number of plans whose surveys were all refused in the search
    refused: Mapping[str, int] = MappingProxyType({})

    def verification(self, plan: Candidate | None) -> Verification | None:
        return next((v for v in self.verifications if plan and v.surrogate.number == plan.number), None)

    @property
    def failed_cheaper(self) -> Verification | None:
        """Returns the costliest plan flown rendered that is cheaper than the recommended one and was not shown."""
        if self.recommended is None:
            return None
        config = tuning_config(self.study)
        limit, cheaper = plan_cost(self.recommended, config), [v for v in self.verifications if not v.shown]
        cheaper = [v for v in cheaper if plan_cost(v.surrogate, config) < limit]
        return max(cheaper, key=lambda v: plan_cost(v.surrogate, config), default=None)


def tune(study: Study, folder: Path, resume: bool, fleet: Fleet) -> TuningResult:
    """Searches for the best plan as specified in `[tune]`, and writes results.parquet.

    Ctrl-C or the end of the budget ends the search early.

    Raises TwinError if there is no section [tune], the folder is not empty and `resume` is not set, is written by
    another process, cannot be written, or belongs to another search or scenario, or the engine lost its connection;
    ScenarioError, before any flight, if the scenario is invalid at a bound or in all samples; OSError if results cannot
    be written.
    """
    CandidateSurveys(study, folder, ()).check_bounds()
    with open_folder(folder, resume, search=True) as log:
        tuning, interrupted, out_of_time = Tuning(study, folder, fleet, log), False, False
        check_inputs(folder, tuning.trials.input_files())
        try:
            tuning.run()
        except KeyboardInterrupt:
            interrupted = True
        except OutOfTime:
            out_of_time = True
        log.flush()
        write_parquet(log.table(), folder / "results.parquet")
        return tuning.result(interrupted, out_of_time)


class Tuning:
    """State of a search: the evaluated plans, the finalists (evaluated again with new seeds), and the verifications."""

    def __init__(self, study: Study, folder: Path, fleet: Fleet, log: ResultsLog):
        self.study, self.folder, self.fleet, self.log = study, folder, fleet, log
        studies = (study, confirmation_of(study), rendered_of(study))
        self.trials, self.confirmation, self.rendered = (CandidateSurveys(s, folder, log.rows()) for s in studies)
        self.config, self.begin_s = self.trials.config, time.time()
        self.needs_rendering = self.trials.original.imaging.fidelity == "surrogate"
        self.most = most_rendered(study)
        self.plans: dict[int, Values] = {}
        self.finalists: dict[int, Candidate] = {}
        self.verifications: dict[int, Verification] = {}
        self.confirmed: Candidate | None = None
        self.start: Verification | None = None

    def run(self) -> None:
        """Runs the rounds of the search until a plan can be recommended or all rounds are done.

        Each round evaluates candidates, confirms the cheapest plans with new seeds, and flies their rendered surveys.
        The first round is the only one if no plan was verified in it. After a plan was shown, the starting plan is
        flown rendered, and cheaper plans that the surrogate rejects are verified.
        """
        search_round = 0
        for search_round in range(1 + self.config.rounds):
            self._search(search_round)
            self._verify_front(search_round)
            if not self.verifications or not all(v.rejected for v in self.verifications.values()):
                break
        if self.recommended:
            self._fly_start()
            self._verify_cheaper(search_round)

    @property
    def recommended(self) -> Candidate | None:
        """Returns the cheapest plan that rendered surveys show to reach the required pass probability."""
        shown = [v.surrogate._replace(shortfall=0.0) for v in self.verifications.values() if v.shown]
        return next(iter(pareto_front(shown, self.config)), None)

    @property
    def unproven(self) -> Candidate | None:
        """Returns the plan with the best evidence among those that may still be shown, or else the confirmed one."""
        if not self.verifications:
            return self.confirmed
        best = max(self.verifications.values(), key=lambda v: (not v.rejected, v.probability.low))
        return None if best.rejected else best.surrogate

    def result(self, interrupted: bool, out_of_time: bool) -> TuningResult:
        """Returns the result; an interrupted search recommends no plan."""
        recommended = None if interrupted else self.recommended
        unproven = None if recommended or interrupted else self.unproven
        plan = recommended or unproven
        scenario = self.trials.scenario(plan.values) if plan else None
        return TuningResult(
            self.study, self._candidates(), list(self.finalists.values()), list(self.verifications.values()),
            recommended, unproven, scenario, instructions(prepare(scenario)) if scenario else "", self.start,
            interrupted, out_of_time, self.needs_rendering, self.confirmation.warnings(self.finalists.values()),
            self.trials.refusals(self.plans),
        )  # fmt: skip

    def _fly(self, surveys: CandidateSurveys, plans: dict[int, Values], first: int | None = None) -> None:
        """Flies the `first` surveys of plans (None: all) that have no result."""

        def add_row(row: Row) -> None:
            self.log.add(row)
            surveys.add(row)

        missing, progress = list(surveys.missing(plans, first)), self.fleet.progress
        if not missing:
            return
        progress.begin(progress.done + len(missing))
        if not self.fleet.fly(surveys.study, missing, add_row):
            raise KeyboardInterrupt
        if self.fleet.out_of_time:
            raise OutOfTime

    def _search(self, search_round: int) -> None:
        search = Search(self.study, self.config, self.folder, self.trials.original.fingerprint(), search_round)
        if search_round:
            search.add_earlier_candidates((c.values, c.objectives, c.shortfall) for c in self._candidates())
        search_end_s = self.begin_s + _SEARCH_SHARE * (self.fleet.end_s - self.begin_s)
        try:
            while time.time() < search_end_s and (batch := search.next_batch()):
                plans = {number: dict(trial.params) for number, trial in batch.items()}
                self._fly(self.trials, plans)
                for number, values in plans.items():
                    candidate = self._evaluate(self.trials, number, values)
                    search.record(batch[number], candidate.objectives, candidate.shortfall)
        finally:
            self.plans |= search.finished()

    def _verify_front(self, search_round: int) -> None:
        """Verifies the cheapest confirmed plan by rendered surveys, and corrects the predictions for all plans."""
        # until it was verified before, none is confirmed, or `config.plans` were; plans that may pass are verified if
        # the surrogate confirms none because it refuses some conditions
        for _ in range(self.config.plans):
            self.confirmed = self._cheapest_confirmed()
            chosen = self.confirmed or self._cheapest_possible()
            if chosen is None or not self.most or chosen.number in self.verifications:
                return
            self._verify(chosen, search_round)

    def _cheapest_possible(self) -> Candidate | None:
        """Returns the cheapest plan that may pass where the surrogate refuses it, after its confirmation."""
        candidates = [c for c in self._candidates() if c.number not in self.verifications]
        possible = [c for c in candidates if c.least_shortfall <= 0 < c.shortfall]
        chosen = min(possible, key=lambda plan: plan_cost(plan, self.config), default=None)
        return chosen and self._confirm(chosen)

    def _verify_cheaper(self, search_round: int) -> None:
        """Verifies plans cheaper than the recommended one, until one is not shown or `config.plans` were verified."""
        for _ in range(self.config.plans):
            if (cheaper := self._next_cheaper()) is None:
                return
            self._confirm(cheaper)
            self._verify(cheaper, search_round)
            if not self.verifications[cheaper.number].shown:
                return

    def _next_cheaper(self) -> Candidate | None:
        """Returns the next plan to verify that is cheaper than the recommended one; None if there is none."""
        # by corrected costs, of plans that none dominates: the smallest shortfall of the pass probability, then the
        # highest cost
        if (chosen := self.recommended) is None:
            return None

        most = plan_cost(self._evaluate(self.trials, chosen.number, chosen.values), self.config)
        front = non_dominated([p for p in self._candidates() if plan_cost(p, self.config) < most], self.config)
        untried = [plan for plan in front if plan.number not in self.verifications]
        return min(untried, key=lambda p: (p.least_shortfall, -plan_cost(p, self.config)), default=None)

    def _fly_start(self) -> None:
        """Flies the starting plan, in the conditions of the others, as a finalist and in a few rendered surveys."""
        given = {key: value_at(self.trials.original, key) for key in self.config.search}
        values = {key: value for key, value in given.items() if value is not None}
        self._fly(self.confirmation, {START: values})
        self._fly(self.rendered, {START: values}, _START_SURVEYS)
        self.start = self._verification(self.confirmation.evaluate(START, values), 0, _START_SURVEYS)

    def _verify(self, plan: Candidate, search_round: int) -> None:
        """Flies rendered surveys of a plan until they show the pass probability or cannot; also of an ended one."""
        found, count = self._verification(plan, search_round, 0), 0
        self._announce(plan, found)
        while (further := found.next_surveys()) > count:
            count = further
            try:
                self._fly(self.rendered, {plan.number: plan.values}, count)
            finally:
                found = self._verification(plan, search_round, count)
                if found.surveys:
                    self.verifications[plan.number] = found
            self.fleet.progress.print_line(found.notice())

    def _verification(self, plan: Candidate, search_round: int, surveys: int) -> Verification:
        surrogate = self.finalists.get(plan.number, plan)
        return verification_of(self.rendered, self.confirmation, surrogate, search_round, surveys, self.most)

    def _announce(self, plan: Candidate, found: Verification) -> None:
        """Prints how many rendered surveys of a plan show the required pass probability, and the time they take."""
        needed, own = min(int(found.needed), self.most), set(self.trials.keys(plan.number, plan.values))
        if not any(True for _ in self.rendered.missing({plan.number: plan.values}, needed)):
            return
        rows = list(self.log.rows())
        longest_s = max((row.get("timing.simulated_s") or 0.0 for row in rows if key_of(row) in own), default=0.0)
        survey_s, source = rendered_time(rows, self.rendered.scenario(plan.values), longest_s)
        self.fleet.progress.print_line(
            f"Flying plan {plan.number} rendered: {found.needed:.0f} surveys show that {percent(found.required)} pass, "
            f"if none fails, at most {self.most}; about {duration(survey_s)} on one core each ({source}), "
            f"{duration(needed * survey_s)} of core time"
        )

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
        return candidate._replace(shortfall=1.0 if verification.rejected else min(candidate.shortfall, 0.0))
