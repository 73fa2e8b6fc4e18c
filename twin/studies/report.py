"""Report of a study: the self-contained page study.html."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.user_files import read_text
from twin.report.html import render_page
from twin.studies import agreement, agreement_report, wording
from twin.studies.analysis import StudyAnalysis
from twin.studies.figures import draw_all
from twin.studies.statistics import RESAMPLES
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
        "agreement": compared,
        "agreement_report": agreement_report,
        "agreement_figure": None if compared is None else agreement_report.figure_uri(analysis),
        "analysis": analysis,
        "wording": wording,
        "headline": wording.headline(study, analysis),
        "sensitivities": [s for s in analysis.sensitivities if np.isfinite(s.correlation.value) or s.explained > 0],
        "figures": draw_all(analysis),
        "refused_samples": analysis.refused_samples[:MAX_REFUSED],
        "resamples": RESAMPLES,
        "text": read_text(study.source.path),
        "version": version("seabed-twin"),
    }
