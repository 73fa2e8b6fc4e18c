"""Results of a study for readers: the pages study.html and agreement.md, and the summary that `--json` prints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from twin.core.user_files import read_text
from twin.report.html import render_page
from twin.report.style import FIGURE_STYLE
from twin.studies import agreement, figures, wording
from twin.studies.analysis import StudyAnalysis
from twin.studies.statistics import RESAMPLES

_MAX_REFUSED = 50  # largest number of refused samples that the report lists
_STATUSES = ("complete", "degraded", "aborted", "refused", "failed")


def write_report(analysis: StudyAnalysis, page: Path) -> None:
    """Writes the report of a study to the file `page`."""
    compared = agreement.agreement(analysis)
    context = {
        "study": analysis.study,
        "agreement": agreement,
        "compared": compared,
        "analysis": analysis,
        "wording": wording,
        "headline": wording.headline(analysis),
        "sensitivities": [s for s in analysis.sensitivities if np.isfinite(s.correlation.value) or s.explained > 0],
        "figures": figures.draw_all(analysis, compared is not None),
        "refused_samples": analysis.refused_samples[:_MAX_REFUSED],
        "resamples": RESAMPLES,
        "text": read_text(analysis.study.source.path),
        "version": version("seabed-twin"),
    }
    page.write_text(render_page("twin.studies", "study.html.j2", context), encoding="utf-8")


def write_agreement(analysis: StudyAnalysis, folder: Path) -> None:
    """Writes agreement.md, with the command and the table, and its figure agreement.png to a folder.

    Writes nothing if the study compares no metrics or no pair of surveys has two results.
    """
    result, study = agreement.agreement(analysis), analysis.study
    if result is None:
        return
    with matplotlib.rc_context(FIGURE_STYLE):
        figures.agreement_of_pairs(analysis).savefig(folder / "agreement.png", bbox_inches="tight")
    limits = ", ".join(
        f"{wording.metric_name(name)} {wording.metric_value(name, v)}" for name, v in study.limits.items()
    )
    table = [agreement.HEADER, ("---",) * len(agreement.HEADER), *agreement.table(result)]
    lines = [
        "# Agreement of surrogate with rendered surveys", "",
        f"`twin study {study.name}` flies {study.n_surveys // 2} pairs of surveys, each rendered and with the "
        "surrogate, and writes this page and its figure to the results folder; `make agreement` copies them here. "
        f"Requirements of a survey: {limits}.", "",
        agreement.verdict_line(result), "", *(f"| {' | '.join(row)} |" for row in table), "", agreement.LIMITS, "",
        "![Surrogate against rendered values](agreement.png)", "",
        "Each dot is a pair with the same scenario and seed. Values at the upper or right edge are infinite.", "",
    ]  # fmt: skip
    (folder / "agreement.md").write_text("\n".join(lines), encoding="utf-8")


def summary(analysis: StudyAnalysis, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the summary of a study as JSON values, after those of `identity`."""
    compared = agreement.agreement(analysis)
    return json_tree(
        dict(identity)
        | {
            "surveys": len(analysis.status),
            **{name: int((analysis.status == name).sum()) for name in _STATUSES},
            "unmodelled": int(analysis.unmodelled.sum()),
            "duplicates": int(analysis.duplicate.sum()),
            "not_flown": analysis.not_flown,
            "passed": int(analysis.passed.sum()),
            "probability": analysis.pass_probability._asdict() | {"required": analysis.required_probability},
            "requirement_missed": analysis.requirement_missed,
            "seek": analysis.study.seek,
            "agreement": compared and _agreement(compared),
            "answers": analysis.answers,
            "metrics": {
                metric.name: {"surveys": metric.surveys, "median": metric.median, "bound_95_percent": metric.bound}
                for metric in analysis.metric_summaries
            },
            "failure_reasons": analysis.failure_reasons,
            "refusal_reasons": analysis.refusal_reasons,
            "refused_samples": analysis.refused_samples,
            "warnings": analysis.warning_counts,
        }
    )


def _agreement(result: agreement.Agreement) -> dict[str, Any]:
    metrics = {one.metric: one._asdict() | {"agrees": one.agrees} for one in result.metrics}
    for values in metrics.values():
        del values["metric"]
    verdicts = result.verdicts._asdict() | {"agrees": result.verdicts_agree}
    return {"agrees": result.agrees, "pairs": result.pairs, "verdicts": verdicts, "metrics": metrics}


def json_tree(value: Any) -> Any:
    """Returns a value as JSON values: named tuples as objects, numbers that are not finite as null."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {key: json_tree(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [json_tree(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
