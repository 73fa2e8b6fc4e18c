"""report.html: a self-contained page about a survey, created from its run folder alone."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core.user_files import read_text
from twin.judge.height_classes import asprs_vertical_class_cm, iho_orders
from twin.judge.map_error import cause_shares
from twin.report.headline import REPLAY_ALIGNMENTS, badge, conditions, headline, input_rows, key_figures, problems
from twin.report.html import render_page, render_text
from twin.report.images import jpeg_bytes, read_rgb
from twin.report.mesh_picture import surface_picture
from twin.report.run_folder import SCENARIO_FILE, Run, load_run
from twin.report.stage_tables import PROCESSING_STAGES, stage_rows, stage_times
from twin.report.style import COLOURS, ESTIMATES, LABELS
from twin.report.survey_data import SurveyData, asked_area, errors_by_class, keyframe_coverage, survey_data
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
    file.write_text(render_page("twin.report", "survey_page.html.j2", context(run)), encoding="utf-8")
    return file


def context(run: Run) -> dict[str, Any]:
    """Returns the variables of the HTML template, survey_page.html.j2."""
    metrics = run.metrics or {}
    heights, depth_m = metrics.get("map") or {}, run.scenario.get("sun", {}).get("depth_m", 0.0)
    error = run.rasters.get("dem_error")
    check_points = 0 if error is None else int(np.isfinite(error.values).sum())
    coverage = keyframe_coverage(run)
    data = survey_data(run, coverage)
    return {
        "name": metrics.get("name") or run.scenario.get("name") or run.folder.name,
        "badge": badge(run.metrics),
        "problems": problems(metrics) if metrics else [],
        "conditions": conditions(run.scenario, (metrics.get("water") or {}).get("visibility_m")),
        "data": data,
        "asked": asked_area(run),
        "run": run,
        "causes": cause_shares(heights),
        "errors_by_class": errors_by_class(run, coverage),
        "orders": iho_orders(depth_m, heights.get("le95_m")),
        "check_points": check_points,
        "vertical_class_cm": asprs_vertical_class_cm(heights.get("rmse_m"), check_points),
        "files": {file.name for file in run.folder.iterdir()},
        "headline": answer(run, data),
        "metrics": metrics,
        "input": input_rows(metrics.get("input") or {}),
        "key_figures": key_figures(metrics),
        "estimates": [(key, LABELS[key], (metrics.get("trajectory") or {}).get(key)) for key in ESTIMATES],
        "stages": [(row, LABELS[row.stage]) for row in stage_rows(metrics, run.scenario)],
        "stage_times": stage_times(metrics, run.scenario, run.keyframes.n_frames_per_keyframe) if metrics else [],
        "processing_stages": PROCESSING_STAGES,
        "figures": draw_all(run, coverage),
        "surface": jpeg_uri(surface_picture(run.folder / "mesh.glb", run.keyframes.map_from_world)),
        "samples": sample_images(run),
        "alignment": REPLAY_ALIGNMENTS[run.alignment or "first"],
        "scenario": read_text(run.folder / SCENARIO_FILE),
        "environment": {key: v if isinstance(v, str) else json.dumps(v) for key, v in run.environment.items()},
        "colours": COLOURS,
    }


def answer(run: Run, data: SurveyData | None) -> str:
    """Returns what a survey reached, in words; of a replay or unfinished survey its headline."""
    if not run.metrics or run.metrics.get("replay"):
        return headline(run.metrics, run.scenario)
    known = {"metrics": run.metrics, "data": data, "asked": asked_area(run)}
    return " ".join(render_text("survey_answer.txt.j2", known).split())


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
