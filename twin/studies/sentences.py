"""Text of the study report: metrics, confidence intervals, and the sentences that summarise the results."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from twin.judge.verdict import more_is_better
from twin.report.number_formats import DASH, length, percent, with_unit
from twin.studies.analysis import StudyAnalysis, count_similar
from twin.studies.answers import Answer, KeyLimit, rounded
from twin.studies.statistics import LEVEL, Interval, Proportion
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
    return _METRIC_NAMES.get(metric, metric)


def metric_heading(metric: str) -> str:
    name = metric_name(metric)
    return name[:1].upper() + name[1:]


def metric_value(metric: str, value: float | None) -> str:
    """Returns the value of a metric with its unit; `risk` in percent; a dash for None, NaN and infinity."""
    if metric == "risk":
        return percent(value)
    if value is None or not np.isfinite(value):
        return DASH
    return length(value) if metric.endswith("_m") else with_unit(metric, float(value))


def metric_interval(metric: str, interval: Interval) -> str:
    """Returns the estimate of a metric, with its confidence interval in brackets if it has one."""
    value, low, high = ("unbounded" if np.isinf(number) else metric_value(metric, number) for number in interval)
    return f"{value} ({low} to {high})" if not np.isnan(interval.low) else value


def correlation(interval: Interval) -> str:
    if not np.isfinite(interval.value):
        return DASH
    return f"{interval.value:+.2f} ({interval.low:+.2f} to {interval.high:+.2f})"


def fraction(proportion: Interval | Proportion) -> str:
    """Returns a proportion in percent; if some outcomes are unknown, its smallest and largest possible value."""
    most = proportion.most if isinstance(proportion, Proportion) else proportion.value
    return percent(proportion.value) + (f" to {percent(most)}" if most > proportion.value else "")


def percent_interval(interval: Interval | Proportion, label: str = "") -> str:
    """Returns a fraction in percent with its confidence interval, after a label, in brackets."""
    return f"{fraction(interval)} ({label}{percent(interval.low)} to {percent(interval.high)})"


def confidence(interval: Interval | Proportion) -> str:
    return percent_interval(interval, f"{percent(LEVEL)} confidence interval: ")


def counted(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def answer(analysis: StudyAnalysis) -> str:
    """Returns what a study found in one sentence without terms of statistics; "" without an evaluated survey."""
    if not analysis.evaluated.any():
        return ""
    share, required = analysis.pass_probability, analysis.required_probability
    of_100 = f"about {100 * share.value:.0f} (between {100 * share.low:.0f} and {100 * share.high:.0f})"
    wanted = f", where {100 * required:g} are required" if required is not None else ""
    kept = " and ".join(limits_in_words(analysis.limits))
    return f"Of 100 such surveys, {of_100} are completed{f' and keep {kept}' if kept else ''}{wanted}."


def limits_in_words(limits: Mapping[str, float]) -> list[str]:
    return [
        f"{metric_name(metric)} {'at least' if more_is_better(metric) else 'at most'} {metric_value(metric, limit)}"
        for metric, limit in limits.items()
    ]


def headline(analysis: StudyAnalysis) -> str:
    """Returns the main results of a study as text; without an evaluated survey, only which surveys are not counted."""
    n, study = int(analysis.evaluated.sum()), analysis.study
    left_out = [*_refused(analysis), *_duplicates(analysis), *_failed(analysis)]
    if n_left := analysis.not_flown:
        left_out.append(f"The study is not finished: {counted(n_left, 'survey')} not flown yet; --resume continues it.")
    if n == 0:
        return " ".join(["No survey could be evaluated.", *left_out])
    limits = limits_in_words(analysis.limits)
    completed = "were completed" + (" with " + " and ".join(limits) if limits else "")
    result = (
        f"The pass probability is {confidence(analysis.pass_probability)}: "
        f"{int(analysis.passed.sum())} of {n} surveys {completed}."
    )
    answers = answer_lines(analysis, [study.seek] if study.seek else [])
    reasons = [] if analysis.passed.any() else analysis.failure_reasons[:1]
    conclusions = [*_requirement(analysis), *(f"The most frequent reason: {one.reason}." for one in reasons)]
    different, warnings = analysis.warning[~analysis.duplicate], list(analysis.warning_counts)[:1]
    n_warned = int((different != "").sum())
    warned = [f"Warning in {n_warned} of {len(different)} surveys: {text.rstrip('.')}." for text in warnings]
    return " ".join([*answers, result, *conclusions, *left_out, *warned])


def answer_lines(analysis: StudyAnalysis, keys: Sequence[str] | None = None) -> list[str]:
    """Returns the answer for each key (None: every varied one); empty without a required pass probability."""
    required, limits = analysis.required_probability, analysis.key_limits
    idle = {key for key, regression in analysis.regressions.items() if not regression.worst}
    return [
        " ".join(
            [
                *([f"No influence of {key} is shown."] if key in idle else []),
                answer_sentence(key, answers, required),
                *limit_sentences(limits.get(key), required),
            ]
        )
        for key, answers in analysis.answers.items()
        if keys is None or key in keys
    ]


def limit_sentences(limit: KeyLimit | None, required: float | None) -> list[str]:
    """Returns a sentence on the limit of a key, if it has one, with its confidence interval."""
    if limit is None or (np.isinf(limit.low) and np.isinf(limit.high)):
        return []
    ends = (limit.low, limit.high)
    if np.isfinite(ends).all():
        interval = f"{rounded(limit.low)} to {rounded(limit.high)}"
    else:
        interval = f"below {rounded(limit.high)}" if np.isfinite(limit.high) else f"above {rounded(limit.low)}"
    value = f"is {rounded(limit.value)}, with" if np.isfinite(limit.value) else "lies in"
    side = "above" if limit.rises else "below"
    return [f"The limit, {side} which {percent(required)} pass, {value} the {percent(LEVEL)} interval {interval}."]


def answer_sentence(key: str, answers: list[Answer], required: float | None) -> str:
    """Returns a sentence on the flown values of a key at which enough surveys pass, too few, or more must be flown."""
    passes, fails, undecided = (
        [answer for answer in answers if answer.verdict == verdict] for verdict in ("passes", "fails", "undecided")
    )
    constant = f"{key} has one value only. " if len(answers) == 1 and answers[0].low == answers[0].high else ""
    fraction = f"at least {percent(required)} of surveys pass"
    parts = [f"no value of {key} is known at which {fraction}"]
    if passes:
        parts = [f"{fraction} at {key} {_labels(passes)}"]
    if fails:
        parts.append(f"fewer pass at {_labels(fails)}")
    if undecided:
        n, verb = sum(answer.surveys for answer in undecided), "is" if len(undecided) == 1 else "are"
        unknown = sum(answer.unknown for answer in undecided)
        of_them = f", {unknown} of them unknown" if unknown else ""
        more = more_needed(undecided)
        parts.append(f"{_labels(undecided)} {verb} not decided with {counted(n, 'survey')}{of_them} ({more})")
    text = "; ".join(parts) + "."
    return constant + text[:1].upper() + text[1:]


def _labels(answers: list[Answer]) -> str:
    *first, last = (answer.label for answer in answers)
    return f"{', '.join(first)} and {last}" if first else last


def more_needed(undecided: list[Answer]) -> str:
    """Returns what would decide some ranges or values that are not decided."""
    numbers = np.array([answer.more_surveys for answer in undecided])
    if np.isinf(numbers).any():
        if any(answer.unknown for answer in undecided):
            return "some of the results are unknown: --render-refused flies them"
        return "no finite number of surveys is expected to decide it: the observed fraction equals the required one"
    if np.isnan(numbers).any():
        return "more surveys there narrow it"
    total = float(numbers.sum())
    digit = 10 ** max(0, len(f"{total:.0f}") - 2)
    return f"about {int(np.ceil(total / digit)) * digit} more needed there"


def throughput(surveys: int, wall_s: float, worker_s: float) -> str:
    return (
        f"{surveys} surveys in {wall_s:.0f} s, {60 * surveys / wall_s:.3g} per minute; "
        f"mean run time {worker_s / surveys:.2f} s"
    )


def requirement_verdict(analysis: StudyAnalysis) -> str:
    """Returns whether the required fraction of the surveys passed; "not decided" if unknown results matter."""
    if not analysis.requirement_missed:
        return "met"
    is_possible = analysis.evaluated.any() and analysis.pass_probability.most >= (analysis.required_probability or 0.0)
    return "not decided" if is_possible else "not met"


# Each of the following functions returns sentences of the headline, none if there is nothing to say.


def _requirement(analysis: StudyAnalysis) -> list[str]:
    required, passing = analysis.required_probability, analysis.pass_probability
    if required is None:
        return []
    verdict = requirement_verdict(analysis)
    conclusive = passing.high < required or passing.low >= required or verdict == "not decided"
    doubt = "" if conclusive else ", but the confidence interval includes the required value (more surveys are needed)"
    where = " over all values of the varied keys" if analysis.study.seek is not None else ""
    return [f"The required {percent(required)} is {verdict}{where}{doubt}."]


def _refused(analysis: StudyAnalysis) -> list[str]:
    sentences = []
    if (refused := analysis.refused & ~analysis.unmodelled).any():
        n, verb, reason = _refusals(analysis, refused)
        sentences.append(f"{n} cannot be flown and {verb} not counted, e.g.: {reason}.")
    if analysis.unmodelled.any():
        n, verb, reason = _refusals(analysis, analysis.unmodelled)
        sentences.append(
            f"{n} {verb} unknown, because the surrogate cannot simulate them: they count as not passed at the lower "
            "bound and as passed at the upper bound of the confidence intervals; --render-refused flies them rendered; "
            f"e.g.: {reason}."
        )
    if n := analysis.n_rendered:
        sentences.append(f"{counted(n, 'survey')} that the surrogate refuses {'is' if n == 1 else 'are'} rendered.")
    return sentences


def _refusals(analysis: StudyAnalysis, chosen: NDArray[np.bool_]) -> tuple[str, str, str]:
    """Returns numbers of samples and surveys among the chosen ones (n,), verb, and most frequent reason."""
    n = len(np.unique(analysis.numbers("sample")[chosen]))
    count = f"{counted(n, 'sample')} ({counted(int(chosen.sum()), 'survey')})"
    return count, "is" if n == 1 else "are", next(iter(count_similar(analysis.reason[chosen])))


def _duplicates(analysis: StudyAnalysis) -> list[str]:
    n = int(analysis.duplicate.sum())
    repeat, verb = ("repeats another one", "is") if n == 1 else ("repeat others", "are")
    return [f"{counted(n, 'survey')} {repeat} (same scenario, same seed) and {verb} not counted again."] if n else []


def _failed(analysis: StudyAnalysis) -> list[str]:
    n = int(analysis.failed.sum())
    if not n:
        return []
    subject, result, again = (
        ("1 survey", "its result is", "it") if n == 1 else (f"{n} surveys", "their results are", "them")
    )
    return [
        f"{subject} failed because of the computer or the program, so {result} unknown; --resume flies {again} again."
    ]


def seeds_note(study: Study) -> str:
    sampling = study.sampling
    if not sampling.paired:
        return "Each design point has its own seeds, i.e. its own floor and noise."
    same = f"the same {sampling.seeds} seeds" if sampling.seeds > 1 else f"the same seed ({sampling.seed})"
    return (
        f"All samples use {same}, so they are compared on the same floor and with the same noise; more seeds show "
        "the variation between floors."
    )
