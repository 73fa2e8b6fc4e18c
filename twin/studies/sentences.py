"""Text of the study report: metrics, confidence intervals, and the sentences that summarise the results."""

import sys
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from twin.judge.verdict import more_is_better
from twin.report.html import Paragraph, lines_of, render_paragraphs, render_text
from twin.report.number_formats import DASH, metric_value, percent, unit_of
from twin.report.words import words
from twin.studies.analysis import StudyAnalysis, count_similar
from twin.studies.answers import Answer, KeyLimit, rounded
from twin.studies.conditions import condition_lines, varied_in_words
from twin.studies.statistics import LEVEL, Interval, Proportion


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


def limits_in_words(limits: Mapping[str, float]) -> list[str]:
    return [
        f"{words(metric)} {'at least' if more_is_better(metric) else 'at most'} {metric_value(metric, limit)}"
        for metric, limit in limits.items()
    ]


def paragraphs(analysis: StudyAnalysis) -> list[Paragraph]:
    """Returns what a study answers, how sure it is, what changes it most, what it assumes and what it does not say."""
    study, different = analysis.study, analysis.warning[~analysis.duplicate]
    known = {
        "analysis": analysis,
        "study": study,
        "n": int(analysis.evaluated.sum()),
        "limits": limits_in_words(analysis.limits),
        "seek": answer_lines(analysis, [study.seek] if study.seek else []),
        "verdict": requirement_verdict(analysis),
        "refused": _refusals(analysis, analysis.refused & ~analysis.unmodelled),
        "unmodelled": _refusals(analysis, analysis.unmodelled),
        "n_warned": f"{int((different != '').sum())} of {len(different)}",
        "influences": analysis.influences[:2],
        "varied": varied_in_words(study),
        "conditions": condition_lines(study),
        "sentences": sys.modules[__name__],
    }
    return render_paragraphs("study_answer.txt.j2", known, "twin.studies")


def headline(analysis: StudyAnalysis) -> str:
    return lines_of(paragraphs(analysis))


def answer_lines(analysis: StudyAnalysis, keys: Sequence[str] | None = None) -> list[str]:
    """Returns the answer for each key (None: every varied one); empty without a required pass probability."""
    required, limits = analysis.required_probability, analysis.key_limits
    idle = {key for key, regression in analysis.regressions.items() if not regression.worst}
    return [
        answer_sentences(key, answers, required, limits.get(key), key in idle)
        for key, answers in analysis.answers.items()
        if keys is None or key in keys
    ]


def answer_sentences(
    key: str, answers: list[Answer], required: float | None, limit: KeyLimit | None = None, idle: bool = False
) -> str:
    """Returns the limit of a key, and its flown values at which enough surveys pass, too few, or more must be flown."""
    by_verdict = {name: [one for one in answers if one.verdict == name] for name in ("passes", "fails", "undecided")}
    known = {"key": key, "answers": answers, "required": required, "limit": limit, "idle": idle, **by_verdict}
    known |= {"level": LEVEL, "infinity": np.inf, "rounded": rounded, "sentences": sys.modules[__name__]}
    return " ".join(render_text("key_answer.txt.j2", known, "twin.studies").split())


def unit_text(key: str) -> str:
    return f" {unit_of(key)}".rstrip()


def more_needed(undecided: list[Answer]) -> str:
    """Returns what would decide some ranges or values that are not decided."""
    numbers = np.array([answer.more_surveys for answer in undecided])
    if np.isinf(numbers).any():
        if any(answer.unknown for answer in undecided):
            return "some of the results are unknown: --resume flies failed surveys, --render-refused refused ones"
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


def _refusals(analysis: StudyAnalysis, chosen: NDArray[np.bool_]) -> tuple[str, str, str] | None:
    """Returns numbers of samples and surveys among the chosen ones (n,), verb, and most frequent reason, if any."""
    if not chosen.any():
        return None
    n = len(np.unique(analysis.numbers("sample")[chosen]))
    count = f"{counted(n, 'sample')} ({counted(int(chosen.sum()), 'survey')})"
    return count, "is" if n == 1 else "are", next(iter(count_similar(analysis.reason[chosen])))
