"""Check of a surrogate study: the surveys whose metrics lie closest to the limits are repeated with rendered images."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.judge.verdict import SIGNED, more_is_better
from twin.studies import sentences
from twin.studies.analysis import Mask, StudyAnalysis
from twin.studies.flight import has_passed
from twin.studies.results_log import key_of
from twin.studies.runner import Fleet, check_results, open_folder
from twin.studies.statistics import Array, Proportion, wilson_interval
from twin.studies.surveys import rendered, samples, surveys

FOLDER = "rendered"  #: subfolder of the results folder


class RenderedCheck(NamedTuple):
    """Verdicts of the rendered surveys and of the surrogate surveys with the same scenarios and seeds."""

    rendered: Mask  #: (n,) whether each rendered survey was completed and met every requirement
    surrogate: Mask  #: (n,) the same of the surrogate surveys
    interrupted: bool = False  #: whether Ctrl-C ended the check, so that some of the rendered surveys are missing
    has_limits: bool = True  #: whether the study has a limit, so that there are verdicts to check
    n_lost: int = 0  #: number of rendered surveys that were refused or failed, and therefore have no verdict

    @property
    def exit_status(self) -> int:
        """Returns 130 if the check was interrupted; 0 if `agrees` is true or the study has no limit; otherwise 1."""
        return 130 if self.interrupted else int(self.has_limits and not self.agrees)

    @property
    def pass_probability(self) -> Proportion:
        return wilson_interval(float(self.rendered.sum()), len(self.rendered))

    @property
    def agrees(self) -> bool:
        """Returns whether the fraction of surrogate surveys that passed lies in the interval of the rendered ones."""
        interval = self.pass_probability
        return len(self.rendered) > 0 and interval.low <= float(self.surrogate.mean()) <= interval.high

    def sentence(self) -> str:
        """Returns the result of the rendered surveys in one sentence, and another one if the check is incomplete."""
        partial = " The check was interrupted and is incomplete; --resume continues it." if self.interrupted else ""
        return self._result() + partial

    def _result(self) -> str:
        n = len(self.rendered)
        if not self.has_limits:
            return "No survey was flown rendered: the study has no limit in [require], so there is no verdict to check."
        if n == 0 and self.interrupted:
            return "No survey was flown rendered."
        if n == 0 and self.n_lost:
            return f"There is no verdict to check: {self.n_lost} rendered surveys were refused or failed."
        if n == 0:
            return "No survey was flown rendered: none of the surrogate surveys has a value of every required metric."
        same = int((self.rendered == self.surrogate).sum())
        passed = sentences.percent_interval(self.pass_probability)
        verdict = "agrees" if self.agrees else "does not agree"
        return (
            f"Of the {n} surveys closest to the limits, {int(self.rendered.sum())} pass when rendered ({passed}) and "
            f"{int(self.surrogate.sum())} with the surrogate, which {verdict}; {same} have the same verdict."
        )


def check(analysis: StudyAnalysis, n: int, folder: Path, fleet: Fleet) -> RenderedCheck:
    """Flies n rendered surveys and returns the comparison with the surrogate; finished rendered surveys are reused.

    They are written to the subfolder `FOLDER` of the study's folder. Ctrl-C ends the check early. Raises TwinError if
    the subfolder cannot be written or has results of another study, or the engine lost its connection; OSError if
    results cannot be written.
    """
    study, nearest = analysis.study, nearest_surveys(analysis, n)
    keys = [(int(analysis.numbers("sample")[k]), int(analysis.numbers("seed")[k])) for k in nearest]
    others = {sample.number for sample in samples(study)} - {number for number, _ in keys}  # some may be refused
    found = surveys(study, folder / FOLDER, without=others)
    chosen = {survey.key: rendered(survey) for survey in found if survey.key in keys}
    with open_folder(folder / FOLDER, True) as log:
        check_results(log, {key: survey.scenario_hash for key, survey in chosen.items()})
        done = log.done()
        missing = [key for key in keys if key not in done]
        fleet.progress.begin(fleet.progress.done + len(missing))
        completed = fleet.fly(study, (chosen[key] for key in missing), log.add)
        log.flush()
    rows = {key_of(row): row for row in log.rows()}
    flown = [k for k, key in enumerate(keys) if key in rows and rows[key]["status"] not in ("refused", "failed")]
    passed = np.array([has_passed(rows[keys[k]]) for k in flown], bool)
    n_lost = sum(key in rows for key in keys) - len(flown)
    surrogate = analysis.passed[nearest[np.array(flown, np.int64)]]
    return RenderedCheck(passed, surrogate, not completed, bool(analysis.limits), n_lost)


def summary(checked: RenderedCheck) -> dict[str, Any]:
    return {
        "surveys": len(checked.rendered),
        "rendered_passed": int(checked.rendered.sum()),
        "surrogate_passed": int(checked.surrogate.sum()),
        "same_verdict": int((checked.rendered == checked.surrogate).sum()),
        "agrees": checked.agrees,
        "interrupted": checked.interrupted,
    }


def nearest_surveys(analysis: StudyAnalysis, n: int) -> NDArray[np.int64]:
    """Returns the row numbers of the n surrogate surveys whose metrics are closest to the limits, the closest first.

    The distance of a metric from its limit is the number of surveys whose value lies between the two. Of a survey, the
    metric farthest beyond its limit counts, or else the one closest to it. Surveys without a finite value of every
    required metric are left out.
    """
    if not analysis.limits or not analysis.evaluated.any():
        return np.zeros(0, np.int64)
    is_surrogate = np.array([value == "surrogate" for value in analysis.rows["fidelity"].to_pylist()], bool)
    chosen = np.flatnonzero(analysis.evaluated & is_surrogate)
    values = {name: analysis.numbers(name)[chosen] for name in analysis.limits}
    values = {name: np.abs(found) if name in SIGNED else found for name, found in values.items()}
    excess = [_excess(values[name], limit) * (1 - 2 * more_is_better(name)) for name, limit in analysis.limits.items()]
    finite = np.isfinite(list(values.values())).all(axis=0)
    distance = np.abs(np.max(excess, axis=0))[finite]
    return chosen[finite][np.argsort(distance, kind="stable")][:n]


def _excess(values: Array, limit: float) -> Array:
    """Returns, for each of the values (n,), the number of values from it to a limit; negative below the limit."""
    ascending = np.sort(values)
    rank = (np.searchsorted(ascending, values, "left") + np.searchsorted(ascending, values, "right")) / 2
    return rank - np.searchsorted(ascending, limit, "right")
