"""study.html: one self-contained page that tells what a study found."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from twin.report.html import render_page
from twin.study import wording
from twin.study.figures import draw_all
from twin.study.findings import Findings
from twin.study.statistics import RESAMPLES
from twin.study.study_file import Study


def write_report(study: Study, found: Findings, page: Path) -> None:
    """Writes the page."""
    page.write_text(render_page("twin.study", "study.html.j2", context(study, found)), encoding="utf-8")


def context(study: Study, found: Findings) -> dict[str, Any]:
    """All that the page shows."""
    return {
        "study": study,
        "found": found,
        "words": wording,
        "headline": wording.headline(study, found),
        "influences": [f for f in found.influences if np.isfinite(f.correlation.value) or f.explained > 0],
        "figures": draw_all(found),
        "resamples": RESAMPLES,
        "text": study.source.path.read_text(encoding="utf-8"),
        "version": version("seabed-twin"),
    }
