"""Text of the study report: metrics, confidence intervals, and the sentences that summarise the results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.judge.require import more_is_better
from twin.report.wording import DASH, length, percent, with_unit
from twin.studies.analysis import KeyComparison, StudyAnalysis, count_similar
from twin.studies.answers import Answer
from twin.studies.statistics import LEVEL, Interval
from twin.studies.study_file import Study

_METRIC_NAMES = {
    "trajectory.final.ate_rmse_m": "final trajectory error (ATE, RMSE)",
    "trajectory.online.ate_rmse_m": "online trajectory error (ATE, RMSE)",
    "map.le90_m": "map height error (LE90)",
    "map.completeness": "map completeness (observed floor)",
    "map.le90_area_m": "map height error over the asked area (LE90)",
    "map.completeness_area": "map completeness (asked area)",
    "map.rmse_m": "map height error (RMSE)",
    "map.sigma_ratio": "sigma ratio of the map (RMS of error / sigma)",
    "self_check.sigma_max_m": "largest standard deviation of a position",
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
    """Returns the value of a metric with its unit; `risk` in percent; a dash for None, NaN and infinity."""
    if metric == "risk":
        return percent(value)
    if value is None or not np.isfinite(value):
        return DASH
    if metric.endswith("_m"):
        return length(value)
    return with_unit(metric, float(value))


def metric_interval(metric: str, interval: Interval) -> str:
    """Returns the estimate of a metric, with its confidence interval in brackets unless the bounds are not finite."""
    low, high = metric_value(metric, interval.low), metric_value(metric, interval.high)
    bounds = f" ({low} to {high})" if np.isfinite(interval.low) else ""
    return metric_value(metric, interval.value) + bounds


def metric_heading(metric: str) -> str:
    """Returns the readable name of a metric with a capital first letter."""
    name = metric_name(metric)
    return name[:1].upper() + name[1:]


def correlation(interval: Interval) -> str:
    """Returns a rank correlation with its confidence interval in brackets; a dash if it is not finite."""
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
    """Returns the main results of a study as text.

    They are the answer for the key that `seek` of the study names, the pass probability, whether the requirement is
    met, the most frequent reason if no survey passed, the numbers of surveys that are not counted, and the most
    frequent warning. Without an evaluated survey, only the numbers of surveys that are not counted are given.
    """
    n = int(analysis.evaluated.sum())
    left_out = _refused(analysis) + _duplicates(analysis) + _failed(analysis) + _not_flown(analysis)
    if n == 0:
        return "No survey could be evaluated." + left_out
    sought = [] if study.seek is None else analysis.answers.get(study.seek, [])
    answer = answer_sentence(study.seek, sought, study.probability) + " " if study.seek and sought else ""
    return (
        f"{answer}The pass probability is {confidence(analysis.pass_probability)}: "
        f"{int(analysis.passed.sum())} of {n} surveys {_passing(analysis)}."
        f"{_requirement(analysis)}{_main_reason(analysis)}{left_out}{_warnings(analysis)}"
    )


def answer_lines(analysis: StudyAnalysis) -> list[str]:
    """Returns for each varied key a sentence on the values at which the required fraction of surveys passes.

    Empty without a required pass probability.
    """
    required = analysis.required_probability
    return [answer_sentence(key, answers, required) for key, answers in analysis.answers.items()]


def answer_sentence(key: str, answers: list[Answer], required: float | None) -> str:
    """Returns a sentence on the values of a key at which enough surveys pass, too few pass, or more must be flown.

    It names only values that were flown.

    Args:
        key: the varied key.
        answers: verdict for each range or value of the key.
        required: required pass probability.
    """
    if not answers:
        return f"{key}: no survey could be evaluated."
    passes, fails, undecided = (
        [answer for answer in answers if answer.verdict == verdict] for verdict in ("passes", "fails", "undecided")
    )
    constant = f"{key} has one value only. " if len(answers) == 1 and answers[0].low == answers[0].high else ""
    fraction = f"at least {percent(required)} of surveys pass"
    parts = []
    if passes:
        parts.append(f"{fraction} at {key} {_labels(passes)}")
    else:
        parts.append(f"no value of {key} is known at which {fraction}")
    if fails:
        parts.append(f"fewer pass at {_labels(fails)}")
    if undecided:
        n = sum(answer.surveys for answer in undecided)
        verb = "is" if len(undecided) == 1 else "are"
        unknown = sum(answer.unknown for answer in undecided)
        of_them = f", {unknown} of them unknown" if unknown else ""
        parts.append(f"{_labels(undecided)} {verb} not decided with {_count(n)}{of_them} ({_more(undecided)})")
    text = "; ".join(parts) + "."
    return constant + text[:1].upper() + text[1:]


def _labels(answers: list[Answer]) -> str:
    labels = [answer.label for answer in answers]
    return " and ".join([", ".join(labels[:-1]), labels[-1]]) if len(labels) > 1 else labels[0]


def _count(surveys: int) -> str:
    return f"{surveys} survey" + ("" if surveys == 1 else "s")


def _more(undecided: list[Answer]) -> str:
    """Returns a phrase with the number of further surveys that would decide all undecided answers.

    The number is rounded up to two significant digits. If it is infinite, the phrase gives the reason instead.
    """
    total = sum(answer.more_surveys for answer in undecided)
    if np.isinf(total):
        if any(answer.unknown for answer in undecided):
            return "no number of surveys by the surrogate is expected to decide it: some of the results are unknown"
        return "no finite number of surveys is expected to decide it: the observed fraction equals the required one"
    digit = 10 ** max(0, len(f"{total:.0f}") - 2)
    return f"about {int(np.ceil(total / digit)) * digit} more needed there"


def throughput(surveys: int, wall_s: float, worker_s: float) -> str:
    """Returns a phrase with the number of surveys flown, their rate, and their mean run time.

    Args:
        surveys: number of surveys flown.
        wall_s: wall time [s].
        worker_s: sum of the surveys' run times on the workers [s].
    """
    return (
        f"{surveys} surveys in {wall_s:.0f} s, {60 * surveys / wall_s:.3g} per minute; "
        f"mean run time {worker_s / surveys:.2f} s"
    )


def _labelled(low: str, high: str) -> str:
    return f"{percent(LEVEL)} confidence interval: {low} to {high}"


def _warnings(analysis: StudyAnalysis) -> str:
    """Returns a sentence, after a space, on the surveys that have a warning; "" if none has.

    It has their number, without surveys that repeat others, and the text of the most frequent warning.
    """
    different, texts = analysis.warning[~analysis.duplicate], list(analysis.warning_counts)
    warned = int((different != "").sum())
    return f" Warning in {warned} of {len(different)} surveys: {texts[0].rstrip('.')}." if texts else ""


def _main_reason(analysis: StudyAnalysis) -> str:
    """Returns a sentence with the most frequent reason why surveys did not pass; "" if a survey passed."""
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
    """Returns a sentence on whether the pass probability reaches the required one, and whether more surveys are needed.

    Returns "" if the study requires no pass probability.
    """
    required, passing = analysis.required_probability, analysis.pass_probability
    if required is None:
        return ""
    verdict = requirement_verdict(analysis)
    conclusive = passing.high < required or passing.low >= required or verdict == "not decided"
    doubt = "" if conclusive else ", but the confidence interval includes the required value (more surveys are needed)"
    where = " over all values of the varied keys" if analysis.study.seek is not None else ""
    return f" The required {percent(required)} is {verdict}{where}{doubt}."


def requirement_verdict(analysis: StudyAnalysis) -> str:
    """Returns whether the required fraction of the surveys passed; "not decided" if unknown results matter."""
    if not analysis.requirement_missed:
        return "met"
    is_possible = analysis.evaluated.any() and analysis.possible_fractions[1] >= (analysis.required_probability or 0.0)
    return "not decided" if is_possible else "not met"


def sample_count(n: int) -> str:
    """Returns a number of samples with its noun."""
    return "1 sample" if n == 1 else f"{n} samples"


def _refused(analysis: StudyAnalysis) -> str:
    """Returns sentences on the samples that cannot be flown or that only the surrogate refuses; "" without any."""
    sentences = ""
    if (refused := analysis.refused & ~analysis.unmodelled).any():
        n, verb = _refused_count(analysis, refused)
        sentences += f" {n} cannot be flown and {verb} not counted, e.g.: {_first_reason(analysis, refused)}."
    if analysis.unmodelled.any():
        n, verb = _refused_count(analysis, analysis.unmodelled)
        sentences += (
            f" {n} {verb} unknown, because the surrogate cannot simulate them: they count as not passed at the lower "
            'bound and as passed at the upper bound of the confidence intervals; imaging.fidelity = "rendered" flies '
            f"them; e.g.: {_first_reason(analysis, analysis.unmodelled)}."
        )
    return sentences


def _refused_count(analysis: StudyAnalysis, chosen: NDArray[np.bool_]) -> tuple[str, str]:
    """Returns a phrase with the numbers of the samples and of the chosen surveys (n,) in them, and the verb for it."""
    n = len(np.unique(analysis.numbers("sample")[chosen]))
    return f"{sample_count(n)} ({_count(int(chosen.sum()))})", "is" if n == 1 else "are"


def _first_reason(analysis: StudyAnalysis, chosen: NDArray[np.bool_]) -> str:
    """Returns the most frequent reason of the chosen surveys (n,)."""
    return next(iter(count_similar(analysis.reason[chosen])))


def _duplicates(analysis: StudyAnalysis) -> str:
    n = int(analysis.duplicate.sum())
    if not n:
        return ""
    repeat = "repeats another one" if n == 1 else "repeat others"
    return f" {_count(n)} {repeat} (same scenario, same seed) and {'is' if n == 1 else 'are'} not counted again."


def _not_flown(analysis: StudyAnalysis) -> str:
    n = analysis.not_flown
    return f" The study is not finished: {_count(n)} not flown yet; --resume continues it." if n else ""


def _failed(analysis: StudyAnalysis) -> str:
    n = int(analysis.failed.sum())
    if not n:
        return ""
    lowest = percent(float(analysis.passed.sum()) / (n + int(analysis.counted.sum())))
    subject, none, again = (
        ("1 more survey", "it had not", "it") if n == 1 else (f"{n} more surveys", "none of them had", "them")
    )
    return (
        f" {subject} failed because of the computer or the program and {'is' if n == 1 else 'are'} not counted; if "
        f"{none} passed, the pass probability would be {lowest}. Use --resume to fly {again} again."
    )


def superiority(comparison: KeyComparison) -> str:
    """Returns a phrase on whether a key has higher or lower values in surveys that did not pass than in the others."""
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
