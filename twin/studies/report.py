"""Results of a study for readers: the self-contained page study.html, and the summary that `--json` prints."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.user_files import read_text
from twin.report.html import render_page
from twin.studies import agreement, figures, wording
from twin.studies.analysis import StudyAnalysis
from twin.studies.answers import Answer
from twin.studies.statistics import RESAMPLES, Interval
from twin.studies.study_file import Study

MAX_REFUSED = 50  #: largest number of refused samples that the report lists


def write_report(study: Study, analysis: StudyAnalysis, page: Path) -> None:
    """Writes the report of a study to the file `page`."""
    page.write_text(render_page("twin.studies", "study.html.j2", context(study, analysis)), encoding="utf-8")


def context(study: Study, analysis: StudyAnalysis) -> dict[str, Any]:
    """Returns the variables of the page template `study.html.j2`."""
    compared = agreement.agreement(analysis)
    return {
        "study": study,
        "agreement": agreement,
        "compared": compared,
        "analysis": analysis,
        "wording": wording,
        "headline": wording.headline(study, analysis),
        "sensitivities": [s for s in analysis.sensitivities if np.isfinite(s.correlation.value) or s.explained > 0],
        "figures": figures.draw_all(analysis, {} if compared is None else {"agreement": agreement.figure}),
        "refused_samples": analysis.refused_samples[:MAX_REFUSED],
        "resamples": RESAMPLES,
        "text": read_text(study.source.path),
        "version": version("seabed-twin"),
    }


_STATUSES = ("complete", "degraded", "aborted", "refused", "failed")


def summary(analysis: StudyAnalysis, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the summary of a study as JSON values."""
    probability = _as_dict(analysis.pass_probability) | {"required": analysis.required_probability}
    metrics = {
        metric.name: {
            "surveys": metric.surveys,
            "median": _as_dict(metric.median),
            "bound_95_percent": _as_dict(metric.bound),
        }
        for metric in analysis.metric_summaries
    }
    return dict(identity) | {
        "surveys": len(analysis.status),
        **{name: int((analysis.status == name).sum()) for name in _STATUSES},
        "unmodelled": int(analysis.unmodelled.sum()),
        "duplicates": int(analysis.duplicate.sum()),
        "not_flown": analysis.not_flown,
        "passed": int(analysis.passed.sum()),
        "probability": probability,
        "requirement_missed": analysis.requirement_missed,
        "seek": analysis.study.seek,
        "agreement": _agreement(analysis),
        "answers": {key: [_answer(answer) for answer in answers] for key, answers in analysis.answers.items()},
        "metrics": metrics,
        "failure_reasons": [reason._asdict() for reason in analysis.failure_reasons],
        "refusal_reasons": [reason._asdict() for reason in analysis.refusal_reasons],
        "refused_samples": [refused._asdict() for refused in analysis.refused_samples],
        "warnings": analysis.warning_counts,
    }


def _agreement(analysis: StudyAnalysis) -> dict[str, Any] | None:
    """Returns the agreement of surrogate with rendered surveys as JSON values; None if there is none to report."""
    result = agreement.agreement(analysis)
    if result is None:
        return None
    metrics = {
        m.metric: {
            "pairs": m.pairs,
            "rendered": _finite(m.rendered),
            "surrogate": _finite(m.surrogate),
            "ratio": _as_dict(m.ratio),
            "p_value": _finite(m.p_value),
            "agrees": m.agrees,
        }
        for m in result.metrics
    }
    verdicts = _as_dict(result.verdicts) | {"agrees": result.verdicts_agree}
    return {"agrees": result.agrees, "pairs": result.pairs, "verdicts": verdicts, "metrics": metrics}


def _answer(answer: Answer) -> dict[str, Any]:
    numbers = {name: _finite(getattr(answer, name)) for name in ("low", "high", "more_surveys")}
    return answer._asdict() | numbers | {"probability": _as_dict(answer.probability)}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _as_dict(interval: Interval) -> dict[str, float | None]:
    return {name: _finite(value) for name, value in interval._asdict().items()}
