"""Verification of a plan: results of its rendered surveys compared with the surrogate, and their expected run time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from twin.studies.flight import Row
from twin.studies.results_log import key_of
from twin.tuning.candidates import Candidate, CandidateSurveys, median_of
from twin.tuning.correction import PlanRatio, metric_ratio

# Run time of a rendered frame on one CPU core of 2025: 0.023 s for 320 x 240 pixels, 0.07 s for 640 x 480 pixels.
_FRAME_S = 0.008  # part that does not depend on the image size [s]
_MEGAPIXEL_S = 0.2  # part per megapixel of one camera's image [s]


class Verification(NamedTuple):
    surrogate: Candidate  #: the plan, evaluated by surrogate surveys with new seeds
    rendered: Candidate  #: the plan, evaluated by its rendered surveys
    surveys: int  #: number of rendered surveys required
    n_passed: int  #: number of rendered surveys that were completed and met every requirement
    n_failed: int  #: number of rendered surveys without a result, because the computer or the program failed
    #: for each metric, the median (surrogate, rendered); None if no survey has a value
    medians: dict[str, tuple[float | None, float | None]]
    #: ratio rendered / surrogate of each median, and the fraction of the rendered surveys that were completed
    ratio: PlanRatio
    search_round: int  #: round of the search, from 0
    warnings: dict[str, int]  #: for each warning, the number of rendered surveys that have it

    @property
    def passed(self) -> bool:
        return self.n_passed == self.surveys

    def notice(self) -> str:
        failed = f", {self.n_failed} failed because of the computer or the program" if self.n_failed else ""
        return f"Plan {self.surrogate.number}: {self.n_passed} of {self.surveys} rendered surveys passed{failed}"


def verification_of(
    rendered: CandidateSurveys, confirmation: CandidateSurveys, surrogate: Candidate, search_round: int
) -> Verification:
    number, values = surrogate.number, surrogate.values
    scores, predicted = rendered.scores(number, values), confirmation.scores(number, values)
    medians = {name: (median_of(predicted, name), median_of(scores, name)) for name in rendered.metrics}
    ratios = {name: metric_ratio(name, flown, expected) for name, (expected, flown) in medians.items()}
    n_complete, n_failed = sum(score.status == "complete" for score in scores), rendered.n_failed(number, values)
    return Verification(
        surrogate,
        rendered.evaluate(number, values),
        len(scores) + n_failed,
        sum(score.passed for score in scores),
        n_failed,
        medians,
        PlanRatio(values, ratios, n_complete / len(scores) if scores else 1.0),
        search_round,
        rendered.warnings([surrogate]),
    )


def expected_time(
    trials: CandidateSurveys, rendered: CandidateSurveys, plan: Candidate, rows: Iterable[Row]
) -> tuple[float, str]:
    """Returns the expected run time of a rendered survey of a plan on one CPU core [s], and how it was found.

    It is the longest simulated duration of the plan's surrogate surveys, times the run time per simulated second in
    the rendered surveys flown so far, or before the first one as estimated from frame rate and image size.
    """
    run_s = simulated_s = longest_s = 0.0
    own = set(trials.keys(plan.number, plan.values))
    for row in rows:
        duration_s = row.get("timing.simulated_s") or 0.0
        if row.get("fidelity") == "rendered" and duration_s:
            run_s, simulated_s = run_s + (row.get("timing.survey_s") or 0.0), simulated_s + duration_s
        if key_of(row) in own:
            longest_s = max(longest_s, duration_s)
    if run_s and simulated_s:
        return longest_s * run_s / simulated_s, "as measured"
    rig = rendered.scenario(plan.values).rig
    frame_s = _FRAME_S + _MEGAPIXEL_S * 1e-6 * rig.image_width_px * rig.image_height_px
    return longest_s * rig.frame_rate_hz * frame_s, "a rough estimate"


def duration(time_s: float) -> str:
    if time_s < 90:
        return f"{time_s:.0f} s"
    return f"{time_s / 60:.0f} min" if time_s < 5400 else f"{time_s / 3600:.1f} h"
