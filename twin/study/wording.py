"""Text of the study report: metrics, confidence intervals, and the sentences that summarise the results."""

from __future__ import annotations

import numpy as np

from twin.judge.require import more_is_better
from twin.report.wording import DASH, length, percent, plain
from twin.study.analysis import KeyComparison, StudyAnalysis
from twin.study.statistics import LEVEL, Interval
from twin.study.study_file import Study

_METRIC_NAMES = {
    "trajectory.final.ate_rmse_m": "final trajectory error (ATE, RMSE)",
    "trajectory.online.ate_rmse_m": "online trajectory error (ATE, RMSE)",
    "map.le90_m": "map height error (LE90)",
    "map.completeness": "map completeness",
    "map.rmse_m": "map height error (RMSE)",
    "map.nmad_m": "map height error (NMAD)",
    "timing.simulated_s": "survey duration",
    "vision.points_median": "matched points (median)",
    "vision.points_p10": "matched points (10th percentile)",
    "vision.contrast_median": "image contrast (median)",
    "risk": "risk (fraction not passed)",
}


def metric_name(metric: str) -> str:
    """Returns the readable name of a metric, e.g. "map height error (LE90)", or else its dotted name."""
    return _METRIC_NAMES.get(metric, metric)


def metric_value(metric: str, value: float | None) -> str:
    """Returns the value of a metric with its unit; `risk` in percent."""
    if metric == "risk":
        return percent(value)
    if value is None or not np.isfinite(value):
        return DASH
    if metric.endswith("_m"):
        return length(value)
    return plain(float(value)) + (" s" if metric.endswith("_s") else "")


def metric_interval(metric: str, interval: Interval) -> str:
    """Returns the estimate of a metric with its confidence interval in brackets."""
    low, high = metric_value(metric, interval.low), metric_value(metric, interval.high)
    bounds = f" ({low} to {high})" if np.isfinite(interval.low) else ""
    return metric_value(metric, interval.value) + bounds


def metric_heading(metric: str) -> str:
    """Returns the readable name of a metric with a capital first letter."""
    name = metric_name(metric)
    return name[:1].upper() + name[1:]


def correlation(interval: Interval) -> str:
    """Returns a rank correlation with its confidence interval in brackets."""
    if not np.isfinite(interval.value):
        return DASH
    return f"{interval.value:+.2f} ({interval.low:+.2f} to {interval.high:+.2f})"


def percent_interval(interval: Interval) -> str:
    """Returns a fraction in percent with its confidence interval in brackets."""
    return f"{percent(interval.value)} ({percent(interval.low)} to {percent(interval.high)})"


def confidence(interval: Interval) -> str:
    """Returns a fraction in percent with its confidence interval and confidence level in brackets."""
    return f"{percent(interval.value)} ({_labelled(percent(interval.low), percent(interval.high))})"


def headline(study: Study, analysis: StudyAnalysis) -> str:
    """Returns the main results of a study: threshold of the `seek` key, pass probability, requirement met or not."""
    n = int(analysis.evaluated.sum())
    if n == 0:
        return "No survey could be evaluated." + _failed(analysis)
    return (
        f"{_threshold(study, analysis)}The pass probability is {confidence(analysis.pass_probability)}: "
        f"{int(analysis.passed.sum())} of {n} surveys {_passing(analysis)}."
        f"{_requirement(analysis)}{_main_reason(analysis)}{_failed(analysis)}{_warnings(analysis)}"
    )


def throughput(surveys: int, wall_s: float, worker_s: float) -> str:
    """Returns the number of surveys flown, their rate, and their mean run time.

    Args:
        surveys: number of surveys flown.
        wall_s: wall time [s].
        worker_s: sum of the run times on the workers [s].
    """
    return (
        f"{surveys} surveys in {wall_s:.0f} s, {60 * surveys / wall_s:.3g} per minute; "
        f"mean run time {worker_s / surveys:.2f} s"
    )


def _labelled(low: str, high: str) -> str:
    return f"{percent(LEVEL)} confidence interval: {low} to {high}"


def _threshold(study: Study, analysis: StudyAnalysis) -> str:
    """Returns a sentence on the values of the `seek` key at which the required fraction of surveys pass, or ""."""
    if analysis.threshold is None:
        return ""
    limit, rising = analysis.threshold
    required = f"At least {percent(study.probability or 0)} of surveys pass"
    if np.isnan(limit.value):
        return ""
    if np.isinf(limit.value):
        return f"{required} at {'every' if (limit.value < 0) == rising else 'no'} value of {study.seek} in this study. "
    low, high = (plain(float(b)) if np.isfinite(b) else "outside the range of this study" for b in limit[1:])
    relation = "at least" if rising else "at most"
    return f"{required} if {study.seek} is {relation} {plain(limit.value)} ({_labelled(low, high)}). "


def _warnings(analysis: StudyAnalysis) -> str:
    """Returns a sentence with the number of surveys that have a warning and the first warning, or "" if none has."""
    warned = analysis.warning[analysis.warning != ""]
    return f" Warning in {len(warned)} of {len(analysis.warning)} surveys: {warned[0]}." if len(warned) else ""


def _main_reason(analysis: StudyAnalysis) -> str:
    """Returns a sentence with the most frequent reason of failure if no survey passed, else ""."""
    if analysis.passed.any() or not analysis.failure_reasons:
        return ""
    return f" The most frequent reason: {analysis.failure_reasons[0].reason}."


def _passing(analysis: StudyAnalysis) -> str:
    limits = [f"{metric_name(m)} {limit_relation(m)} {metric_value(m, v)}" for m, v in analysis.limits.items()]
    return "were completed" + (" with " + " and ".join(limits) if limits else "")


def limit_relation(metric: str) -> str:
    """Returns "at least" for a metric with a lower limit, "at most" for one with an upper limit."""
    return "at least" if more_is_better(metric) else "at most"


def _requirement(analysis: StudyAnalysis) -> str:
    """Returns a sentence on whether the pass probability reaches the required one, and whether this is certain."""
    required, passing = analysis.required_probability, analysis.pass_probability
    if required is None or analysis.study.seek is not None:
        return ""
    verdict = "not met" if analysis.requirement_missed else "met"
    conclusive = passing.high < required or passing.low >= required
    doubt = "" if conclusive else ", but the confidence interval includes the required value (more surveys are needed)"
    return f" The required {percent(required)} is {verdict}{doubt}."


def _failed(analysis: StudyAnalysis) -> str:
    n = int((~analysis.evaluated).sum())
    if not n:
        return ""
    lowest = percent(float(analysis.passed.sum()) / len(analysis.passed))
    return (
        f" {n} more surveys failed because of the computer or the program and are not counted; if none of them had "
        f"passed, the pass probability would be {lowest}. Use --resume to fly them again."
    )


def superiority(comparison: KeyComparison) -> str:
    """Returns a phrase on how the values of a key differ between surveys that did not pass and surveys that did."""
    higher = comparison.superiority >= 0.5
    probability = comparison.superiority if higher else 1 - comparison.superiority
    if probability < 0.6:
        return "no clear difference"
    return f"{'higher' if higher else 'lower'} in surveys that did not pass, in {percent(probability)} of pairs"


def independence_note(analysis: StudyAnalysis) -> str:
    """Returns a sentence on which surveys the confidence intervals assume to be independent."""
    n = len(np.unique(analysis.clusters))
    if n == analysis.rows.num_rows:
        return "The confidence intervals assume that the surveys are independent."
    name = analysis.cluster_name
    return (
        f"The confidence intervals assume that the {n} {name}s are independent; surveys of the same {name} may be "
        "correlated."
    )


def seeds_note(study: Study) -> str:
    """Returns a sentence on which surveys share their seeds, i.e. their floor and noise."""
    sampling = study.sampling
    if not sampling.paired:
        return "Each design point has its own seeds, i.e. its own floor and noise."
    same = f"the same {sampling.seeds} seeds" if sampling.seeds > 1 else f"the same seed ({sampling.seed})"
    return (
        f"All samples use {same}, so they are compared on the same floor and with the same noise; more seeds show "
        "the variation between floors."
    )
