"""Table and figure of the agreement of surrogate with rendered surveys."""

from __future__ import annotations

import textwrap
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.report.figures import log_axis, to_data_uri
from twin.report.style import COLOURS, FIGURE_STYLE
from twin.report.wording import percent, plain
from twin.studies import agreement, wording
from twin.studies.agreement import Agreement, MetricAgreement
from twin.studies.analysis import StudyAnalysis
from twin.studies.figures import make_panels
from twin.studies.statistics import Array
from twin.studies.study_file import n_planned_surveys

HEADER = ("metric", "pairs", "rendered", "surrogate", "surrogate / rendered", "KS p", "verdict")
LIMITS = (
    f"Limits: medians within {percent(agreement.MEDIAN_LIMIT)} of each other, p of the two-sample Kolmogorov-Smirnov "
    f"test at least {percent(agreement.P_LIMIT)}, the same verdict in at least {percent(agreement.PASS_LIMIT)} of the "
    "pairs. In brackets: 95 % intervals, from a bootstrap of pairs and by Wilson's method."
)


def table(result: Agreement) -> list[tuple[str, ...]]:
    """Returns the rows of the table, one row per metric, with the columns `HEADER`."""
    return [_row(metric) for metric in result.metrics]


def verdict_line(result: Agreement) -> str:
    """Returns a sentence with the verdict and the fraction of the pairs whose surveys have the same verdict."""
    return (
        f"{'PASS' if result.agrees else 'FAIL'}: {result.pairs} pairs; both surveys pass or both do not pass in "
        f"{wording.percent_interval(result.verdicts)} of them ({_verdict(result.verdicts_agree)}; only the rendered "
        f"survey passes in {result.only_rendered}, only the surrogate survey in {result.only_surrogate})."
    )


def figure(analysis: StudyAnalysis) -> Figure:
    """Returns the figure: one plot per compared metric, with the surrogate values against the rendered ones."""
    with matplotlib.rc_context(FIGURE_STYLE):
        drawing, panels = make_panels(len(analysis.study.compare), columns=3)
        for metric, axes in zip(analysis.study.compare, panels, strict=True):
            _draw_pairs(axes, metric, *agreement.values_of_pairs(analysis, metric))
        return drawing


def figure_uri(analysis: StudyAnalysis) -> str:
    """Returns the figure as a PNG data URI."""
    with matplotlib.rc_context(FIGURE_STYLE):
        return to_data_uri(figure(analysis))


def write_document(analysis: StudyAnalysis, folder: Path) -> None:
    """Writes agreement.md, with the command and the table, and its figure agreement.png to a folder.

    Writes nothing if the study compares no metrics or no pair of surveys has two results.
    """
    result = agreement.agreement(analysis)
    if result is None:
        return
    with matplotlib.rc_context(FIGURE_STYLE):
        figure(analysis).savefig(folder / "agreement.png", bbox_inches="tight")
    (folder / "agreement.md").write_text(_markdown(analysis, result), encoding="utf-8")


def _markdown(analysis: StudyAnalysis, result: Agreement) -> str:
    study = analysis.study
    lines = [
        "# Agreement of surrogate with rendered surveys", "",
        f"`twin study {study.name}` flies {n_planned_surveys(study) // 2} pairs of surveys, each rendered and with the "
        "surrogate, and writes this page and its figure to the results folder; `make agreement` copies them here. "
        f"Requirements of a survey: {_requirements(study.limits)}.", "",
        verdict_line(result), "", *_markdown_table(result), "", LIMITS, "",
        "![Surrogate against rendered values](agreement.png)", "",
        "Each dot is a pair with the same scenario and seed. Values at the upper or right edge are infinite.",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _markdown_table(result: Agreement) -> list[str]:
    rows = [HEADER, ("---",) * len(HEADER), *table(result)]
    return [f"| {' | '.join(row)} |" for row in rows]


def _requirements(limits: dict[str, float]) -> str:
    return ", ".join(f"{wording.metric_name(name)} {wording.metric_value(name, v)}" for name, v in limits.items())


def _row(metric: MetricAgreement) -> tuple[str, ...]:
    ratio = metric.ratio
    return (
        wording.metric_name(metric.metric),
        str(metric.pairs),
        _value(metric.metric, metric.rendered),
        _value(metric.metric, metric.surrogate),
        f"{ratio.value:.2f} ({ratio.low:.2f} to {ratio.high:.2f})",
        f"{metric.p_value:.3f}",
        _verdict(metric.agrees),
    )


def _value(metric: str, value: float) -> str:
    if np.isinf(value):
        return "infinite"
    return wording.metric_value(metric, value) if metric.endswith("_m") else plain(value)


def _verdict(agrees: bool) -> str:
    return "agrees" if agrees else "does not agree"


def _draw_pairs(axes: Axes, metric: str, rendered: Array, surrogate: Array) -> None:
    """Plots surrogate against rendered values (n,), with the line of equal values and the limits on the medians.

    Infinite values are drawn at the edge. Without finite values, the axes stay empty.
    """
    finite = np.concatenate([rendered[np.isfinite(rendered)], surrogate[np.isfinite(surrogate)]])
    if len(finite) == 0:
        return
    low, high = float(finite.min()), float(finite.max())
    logarithmic = low > 0 and high > 5 * low
    edge = high * 1.3 if logarithmic else high + 0.05 * ((high - low) or 1.0)
    start = low / 1.3 if logarithmic else low - 0.05 * ((high - low) or 1.0)
    line, limit = np.linspace(start, edge, 50), 1 + agreement.MEDIAN_LIMIT
    axes.fill_between(line, line / limit, line * limit, color=COLOURS["reference"], alpha=0.25, linewidth=0)
    axes.plot(line, line, color=COLOURS["reference"])
    x, y = (np.minimum(values, edge) for values in (rendered, surrogate))
    axes.plot(x, y, "o", markersize=3.5, color=COLOURS["online"], alpha=0.7)
    if logarithmic:
        log_axis(axes.xaxis)
        log_axis(axes.yaxis)
    axes.set(xlim=(start, edge), ylim=(start, edge), xlabel="rendered", ylabel="surrogate")
    axes.set_title(textwrap.fill(wording.metric_name(metric), 30), fontsize=8)
