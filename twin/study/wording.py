"""What a study found, in plain sentences."""

from __future__ import annotations

import numpy as np

from twin.judge.require import more_is_better
from twin.report.wording import DASH, length
from twin.report.wording import plain as number
from twin.study.findings import Contrast, Findings
from twin.study.statistics import LEVEL, Interval
from twin.study.study_file import Study

_NAMES = {
    "trajectory.final.ate_rmse_m": "error of the final path (RMS)",
    "trajectory.online.ate_rmse_m": "error of the path as flown (RMS)",
    "map.le90_m": "map error that 90 % of heights keep (LE90)",
    "map.completeness": "completeness of the map",
    "map.rmse_m": "map error (RMS)",
    "map.nmad_m": "map error (NMAD)",
    "timing.simulated_s": "survey time",
    "vision.points_median": "matched points",
    "vision.points_p10": "matched points of the worst tenth",
    "vision.contrast_median": "contrast of the images",
}


def name_of(metric: str) -> str:
    """A metric in words where there are some."""
    return _NAMES.get(metric, metric)


def value_of(metric: str, value: float | None) -> str:
    """A figure in the unit that its name says."""
    if value is None or not np.isfinite(value):
        return DASH
    if metric.endswith("_m"):
        return length(value)
    return number(float(value)) + (" s" if metric.endswith("_s") else "")


def interval(metric: str, found: Interval) -> str:
    """A figure with the ends of its interval."""
    ends = f" ({value_of(metric, found.low)} to {value_of(metric, found.high)})" if np.isfinite(found.low) else ""
    return value_of(metric, found.value) + ends


def headed(metric: str) -> str:
    """A metric as a heading begins with it."""
    words = name_of(metric)
    return words[:1].upper() + words[1:]


def correlation(found: Interval) -> str:
    """A rank correlation with its interval."""
    return f"{found.value:+.2f} ({found.low:+.2f} to {found.high:+.2f})" if np.isfinite(found.value) else DASH


def percent(share: float) -> str:
    """A share; no rounding makes a few into none or nearly all into all."""
    if not np.isfinite(share):
        return DASH
    shown = 100 * share
    return f"{shown:.1f} %" if 0 < shown < 1 or 99 < shown < 100 else f"{shown:.0f} %"


def share(found: Interval) -> str:
    """A share with its interval; small samples put some below 0."""
    return f"{percent(found.value)} ({percent(found.low)} to {percent(found.high)})"


def passing_of(found: Interval) -> str:
    """A share with its confidence."""
    return f"{percent(found.value)} ({percent(LEVEL)} confidence: {percent(found.low)} to {percent(found.high)})"


def headline(study: Study, found: Findings) -> str:
    """The answer: how far the sought key may go, how probable it is that a survey passes, and what that means."""
    n = int(found.ended.sum())
    if n == 0:
        return "No survey ended, so nothing can be said." + _failed(found)
    passing = found.share
    return (
        f"{_sought(study, found)}A survey passes with a probability of {percent(passing.value)} ({percent(LEVEL)} "
        f"confidence: {percent(passing.low)} to {percent(passing.high)}): {int(found.passed.sum())} of {n} "
        f"{_passing(found)}.{_required(found)}{_reason(found)}{_failed(found)}{_beware(found)}"
    )


def pace(surveys: int, wall_s: float, worked_s: float) -> str:
    """How many surveys were flown in what time, and what each took of a worker."""
    each_s = worked_s / surveys
    return (
        f"{surveys} surveys in {wall_s:.0f} s, {60 * surveys / wall_s:.3g} a minute; each took a worker {each_s:.2f} s"
    )


def _sought(study: Study, found: Findings) -> str:
    """How far the sought key may go."""
    if found.sought is None:
        return ""
    limit, rising = found.sought
    wanted = f"At least {percent(study.probability or 0)} of surveys pass"
    if np.isnan(limit.value):
        return ""
    if np.isinf(limit.value):
        return f"{wanted} at {'every' if (limit.value < 0) == rising else 'no'} {study.seek} that was flown. "
    ends = " to ".join(number(float(end)) if np.isfinite(end) else "beyond what was flown" for end in limit[1:])
    bound = "at least" if rising else "at most"
    return f"{wanted} where {study.seek} is {bound} {number(limit.value)} ({percent(LEVEL)} confidence: {ends}). "


def _beware(found: Findings) -> str:
    """How many surveys to trust less, and the first of the warnings."""
    warned = found.warning[found.warning != ""]
    return f" Beware in {len(warned)} of {len(found.warning)}: {warned[0]}." if len(warned) else ""


def _reason(found: Findings) -> str:
    """Why, where none passed."""
    if found.passed.any() or not found.reasons:
        return ""
    return f" The most frequent reason: {found.reasons[0].reason}."


def _passing(found: Findings) -> str:
    kept = [f"{name_of(m)} {relation(m)} {value_of(m, limit)}" for m, limit in found.limits.items()]
    return "ended complete" + (" with " + " and ".join(kept) if kept else "")


def relation(metric: str) -> str:
    return "at least" if more_is_better(metric) else "at most"


def _required(found: Findings) -> str:
    """What that means for the share that is required, and whether the number of surveys decides it."""
    wanted, passing = found.required_share, found.share
    if wanted is None or found.study.seek is not None:
        return ""
    verdict = "missed" if found.missed else "met"
    decided = passing.high < wanted or passing.low >= wanted
    doubt = "" if decided else ", though so few surveys do not decide it"
    return f" Required are {percent(wanted)}: {verdict}{doubt}."


def _failed(found: Findings) -> str:
    n = int((~found.ended).sum())
    if not n:
        return ""
    least = percent(float(found.passed.sum()) / len(found.passed))
    return (
        f" {n} more failed by the machine or the program and do not count; if none of them would have passed, "
        f"the probability is {least}. --resume flies them again."
    )


def contrast_in_words(contrast: Contrast) -> str:
    """What tells surveys that did not pass from those that did."""
    higher = contrast.above >= 0.5
    often = contrast.above if higher else 1 - contrast.above
    if often < 0.6:
        return "hardly any difference"
    return f"{'higher' if higher else 'lower'} where not passed, in {percent(often)} of pairs"


def interval_note(found: Findings) -> str:
    """What the intervals take for independent."""
    n = len(np.unique(found.units))
    if n == found.rows.num_rows:
        return "The intervals take the surveys for independent of each other."
    return f"The intervals take the {n} {found.unit_name}s for independent of each other, surveys of one for alike."


def floors(study: Study) -> str:
    """How many floors and draws of noise the surveys share."""
    plan = study.sampling
    if not plan.paired:
        return "Each draw of the samples has seeds of its own: floor and noise differ."
    same = f"the same {plan.seeds} seeds" if plan.seeds > 1 else f"one seed ({plan.seed})"
    return (
        f"All samples share {same}, so that settings are compared on the same floor in the same noise; what another "
        "floor would do, more seeds show."
    )
