"""Verification of a plan: the results of its rendered surveys, what they show, and how many more are needed."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from twin.judge.map_error import cause_shares
from twin.judge.summary_statistics import rms
from twin.report.number_formats import percent
from twin.studies.analysis import count_similar
from twin.studies.statistics import Proportion, exact_interval, trials_to_show
from twin.tuning.candidates import Candidate, CandidateSurveys, SurveyScore, median_of, required_probability
from twin.tuning.correction import PlanRatio, metric_ratio

_FIRST_SURVEYS = 3  # flown before it is looked at how many failed; then as many again


class Verification(NamedTuple):
    surrogate: Candidate  #: the plan, evaluated by surrogate surveys with new seeds
    required: float  #: pass probability that is to be shown
    most: int  #: largest number of rendered surveys of a plan
    surveys: int  #: number of rendered surveys flown
    n_passed: int  #: number of rendered surveys that were completed and met every requirement
    n_failed: int  #: number of rendered surveys without a result, because the computer or the program failed
    #: for each metric, the median (surrogate, rendered); None if no survey has a value
    medians: dict[str, tuple[float | None, float | None]]
    #: ratio rendered / surrogate of each median, and the fraction of the rendered surveys that were completed
    ratio: PlanRatio
    search_round: int  #: round of the search, from 0
    warnings: dict[str, int]  #: for each warning, the number of rendered surveys that have it
    reasons: dict[str, int]  #: for each reason, the number of rendered surveys that did not pass
    #: stated height error [m] of rendered surveys by its cause, and its share of the variance; see `cause_shares`
    causes: Mapping[str, tuple[float, float]] = MappingProxyType({})

    @property
    def probability(self) -> Proportion:
        return exact_interval(self.n_passed, self.surveys - self.n_failed, self.n_failed)

    @property
    def shown(self) -> bool:
        """Returns whether the lower bound of the pass probability reaches the required one."""
        return self.surveys > self.n_failed and self.probability.low >= self.required

    @property
    def needed(self) -> float:
        """Returns the number of rendered surveys that show the required pass probability, if no more of them fail."""
        return trials_to_show(self.required, self.surveys - self.n_passed)

    @property
    def rejected(self) -> bool:
        """Returns whether so many surveys failed that `most` of them cannot show the required pass probability."""
        n_missed = self.surveys - self.n_failed - self.n_passed
        return not self.shown and n_missed > 0 and self.needed > self.most

    def next_surveys(self) -> int:
        """Returns the number of rendered surveys to fly next: it doubles up to the needed one; 0 if that is the end."""
        if self.shown or self.rejected:
            return 0
        return int(min(max(_FIRST_SURVEYS, 2 * self.surveys), self.needed, self.most))

    def notice(self) -> str:
        return f"Plan {self.surrogate.number}: {self.counts()}; {self.state()}"

    def counts(self) -> str:
        failed = f", {self.n_failed} failed because of the computer or the program" if self.n_failed else ""
        return f"{self.n_passed} of {self.surveys} rendered surveys passed{failed}"

    def state(self) -> str:
        """Returns what the rendered surveys show, and how many would show the required pass probability."""
        required, low = percent(self.required), percent(self.probability.low)
        if self.shown:
            return f"with 95 % confidence at least {low} pass, {required} required"
        failures = "no more fails" if self.reasons else "none fails"
        enough = f"{self.needed:.0f} are needed if {failures}, at most {self.most} are flown"
        return f"{required} is not shown: lower bound {low} with 95 % confidence; {enough}"

    def why_not(self) -> str:
        """Returns why the plan is not recommended: the reasons of surveys that did not pass, or that too few flew."""
        reasons = "; ".join(f"{reason} ({n} of {self.surveys})" for reason, n in self.reasons.items())
        return reasons or self.state()


def verification_of(
    rendered: CandidateSurveys, confirmation: CandidateSurveys, surrogate: Candidate, search_round: int, surveys: int,
    most: int,
) -> Verification:  # fmt: skip
    """Returns the verification of a plan by its first rendered surveys."""
    number, values = surrogate.number, surrogate.values
    scores, predicted = rendered.scores(number, values, surveys), confirmation.scores(number, values)
    medians = {name: (median_of(predicted, name), median_of(scores, name)) for name in rendered.metrics}
    ratios = {name: metric_ratio(name, flown, expected) for name, (expected, flown) in medians.items()}
    n_complete = sum(score.status == "complete" for score in scores)
    n_failed = rendered.n_failed(number, values, surveys)
    return Verification(
        surrogate, required_probability(rendered.study), most, len(scores) + n_failed,
        sum(score.passed for score in scores), n_failed, medians,
        PlanRatio(values, ratios, n_complete / len(scores) if scores else 1.0), search_round,
        rendered.warnings([surrogate]), count_similar(score.reason for score in scores if not score.passed),
        _causes(scores),
    )  # fmt: skip


def _causes(scores: list[SurveyScore]) -> dict[str, tuple[float, float]]:
    names = scores[0].causes if scores else ()
    return cause_shares({name: rms(np.array([score.causes.get(name) or 0.0 for score in scores])) for name in names})
