"""Results of a study for readers: the pages study.html and agreement.md, and the summary that `--json` prints."""

import math
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from twin.core.templates import filled
from twin.core.user_files import read_text
from twin.report.html import render_page
from twin.report.style import FIGURE_STYLE
from twin.studies import agreement, sentences, study_figures
from twin.studies.analysis import StudyAnalysis
from twin.studies.statistics import RESAMPLES

_MAX_REFUSED = 50  # largest number of refused samples that the report lists
_STATUSES = ("complete", "degraded", "aborted", "refused", "failed")


def write_report(analysis: StudyAnalysis, page: Path) -> None:
    compared = agreement.agreement(analysis)
    context = {
        "study": analysis.study,
        "agreement": agreement,
        "compared": compared,
        "analysis": analysis,
        "sentences": sentences,
        "paragraphs": sentences.paragraphs(analysis),
        "sensitivities": [s for s in analysis.sensitivities if np.isfinite(s.correlation.value) or s.explained > 0],
        "figures": study_figures.draw_all(analysis, compared is not None),
        "refused_samples": analysis.refused_samples[:_MAX_REFUSED],
        "resamples": RESAMPLES,
        "text": read_text(analysis.study.source.path),
        "version": version("seabed-twin"),
    }
    page.write_text(render_page("twin.studies", "study.html.j2", context), encoding="utf-8")


def write_agreement(analysis: StudyAnalysis, folder: Path) -> None:
    """Writes agreement.md, with the command and the table, and its figure, if the study has an agreement."""
    result, study = agreement.agreement(analysis), analysis.study
    if result is None:
        return
    with matplotlib.rc_context(FIGURE_STYLE):
        study_figures.agreement_of_pairs(analysis).savefig(folder / "agreement.png", bbox_inches="tight")
    context = {"study": study, "agreement": agreement, "result": result, "sentences": sentences}
    (folder / "agreement.md").write_text(filled("twin.studies", "agreement.md.j2", context), encoding="utf-8")


def summary(analysis: StudyAnalysis, identity: Mapping[str, Any]) -> dict[str, Any]:
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
            "agreement": compared
            and {
                "agrees": compared.agrees,
                "pairs": compared.pairs,
                "verdicts": compared.verdicts._asdict() | {"agrees": compared.verdicts_agree},
                "metrics": {one.metric: one._asdict() | {"agrees": one.agrees} for one in compared.metrics},
            },
            "answers": analysis.answers,
            "key_limits": analysis.key_limits,
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


def json_tree(value: Any) -> Any:
    """Returns a value as JSON values: named tuples as objects, numbers that are not finite as null."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {key: json_tree(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [json_tree(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
