"""report.html: a self-contained page about a survey, created from its run folder alone."""

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core.user_files import read_text
from twin.report.headline import REPLAY_ALIGNMENTS, badge, closed_form_comparison, first_lines, headline, key_figures
from twin.report.html import render_page
from twin.report.images import jpeg_bytes, read_rgb
from twin.report.input_rows import input_rows
from twin.report.mesh_picture import surface_picture
from twin.report.run_folder import SCENARIO_FILE, Run, load_run
from twin.report.stage_tables import PROCESSING_STAGES, stage_rows, stage_times
from twin.report.style import COLOURS, ESTIMATES, LABELS
from twin.report.survey_figures import draw_all

#: Longest side of an image in the report [px].
IMAGE_PX = 1400
#: Largest number of keyframes whose images are shown.
N_SAMPLES = 4


def write_report(folder: Path, metrics: dict[str, Any] | None = None) -> Path:
    """Writes report.html into a run folder and returns its path; arguments and errors are those of `load_run`."""
    return write_page(load_run(folder, metrics))


def write_page(run: Run) -> Path:
    file = run.folder / "report.html"
    file.write_text(render(run), encoding="utf-8")
    return file


def render(run: Run) -> str:
    return render_page("twin.report", "survey_page.html.j2", context(run))


def context(run: Run) -> dict[str, Any]:
    """Returns the variables of the HTML template, survey_page.html.j2."""
    metrics = run.metrics or {}
    has_links = "links" in metrics and not metrics.get("replay")
    return {
        "name": metrics.get("name") or run.scenario.get("name") or run.folder.name,
        "badge": badge(run.metrics),
        "first_lines": first_lines(metrics) if metrics else [],
        "headline": headline(run.metrics, run.scenario),
        "metrics": metrics,
        "input": input_rows(metrics.get("input") or {}),
        "key_figures": key_figures(metrics),
        "estimates": [(key, LABELS[key], (metrics.get("trajectory") or {}).get(key)) for key in ESTIMATES],
        "stages": [(row, LABELS[row.stage]) for row in stage_rows(metrics, run.scenario)],
        "closed_form_comparison": closed_form_comparison(metrics["links"]) if has_links else "",
        "stage_times": stage_times(metrics, run.scenario, run.keyframes.n_frames_per_keyframe) if metrics else [],
        "processing_stages": PROCESSING_STAGES,
        "figures": draw_all(run),
        "mosaic": mosaic_image(run),
        "surface": jpeg_uri(surface_picture(run.folder / "mesh.glb", run.keyframes.map_from_world)),
        "samples": sample_images(run),
        "alignment": REPLAY_ALIGNMENTS[run.alignment or "first"],
        "scenario": read_text(run.folder / SCENARIO_FILE),
        "environment": {key: _text(value) for key, value in run.environment.items()},
        "colours": COLOURS,
    }


def mosaic_image(run: Run) -> str | None:
    """Returns the orthomosaic as a JPEG data URI, white where it has no data; None if the run has no mosaic."""
    if "mosaic" not in run.rasters:
        return None
    mosaic = run.rasters["mosaic"].values
    return jpeg_uri(np.where(mosaic.any(axis=2, keepdims=True), mosaic, np.uint8(255)))


def sample_images(run: Run) -> list[tuple[int, str, str]]:
    """Returns frame number, left and right image (JPEG data URI, or "") of at most `N_SAMPLES` spread keyframes."""
    frames = run.frames_with_image()
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(N_SAMPLES, len(frames))).round().astype(int))
    samples = []
    for frame in (frames[k] for k in chosen):
        left, right = (jpeg_uri(read_rgb(run.image_file(frame, side))) for side in ("left", "right"))
        samples.append((frame, left, right))
    return samples


def jpeg_uri(image: NDArray[np.uint8] | None) -> str:
    if image is None:
        return ""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg_bytes(image, IMAGE_PX)).decode()


def _text(value: Any) -> str:
    return json.dumps(value) if isinstance(value, Mapping | list) else str(value)
