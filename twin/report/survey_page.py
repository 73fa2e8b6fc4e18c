"""report.html: one self-contained page that tells how a survey went, rebuilt from its run folder alone."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.judge.budget import budget
from twin.judge.stages import stage_rows
from twin.report import wording
from twin.report.figures import draw_all
from twin.report.html import render_page
from twin.report.images import jpeg_bytes, read_rgb
from twin.report.mesh_picture import surface_picture
from twin.report.run_folder import Run, load_run
from twin.report.style import COLOURS, ESTIMATES, LABELS

#: Longest side of a photograph in the report [px].
PHOTO_PX = 1400
SAMPLES = 4


def write_report(folder: Path, metrics: dict[str, Any] | None = None) -> Path:
    """Writes report.html into a run folder and returns its path.

    Args:
        folder: the run.
        metrics: its figures, where metrics.json is still to be written.

    Raises:
        TwinError: the folder is no run, or one of its files is broken.
    """
    page = Path(folder) / "report.html"
    page.write_text(render(load_run(folder, metrics)), encoding="utf-8")
    return page


def render(run: Run) -> str:
    """The page as HTML."""
    return render_page("twin.report", "survey_page.html.j2", context(run))


def context(run: Run) -> dict[str, Any]:
    """All that the page shows."""
    metrics = run.metrics or {}
    return {
        "name": metrics.get("name") or run.scenario.get("name") or run.folder.name,
        "finished": run.finished,
        "headline": wording.headline(run.metrics, run.scenario),
        "metrics": metrics,
        "cards": wording.key_figures(metrics),
        "estimates": [(key, LABELS[key], (metrics.get("trajectory") or {}).get(key)) for key in ESTIMATES],
        "stages": [(row, LABELS[row.stage]) for row in stage_rows(metrics, run.scenario)],
        "closed_form_verdict": wording.closed_form_verdict(metrics["links"]) if "links" in metrics else "",
        "budget": budget(metrics, run.scenario, run.keyframes.n_frames_per_keyframe) if metrics else [],
        "figures": draw_all(run),
        "mosaic": mosaic_photo(run),
        "surface": surface_photo(run),
        "samples": sample_photos(run),
        "scenario": (run.folder / "scenario.resolved.toml").read_text(encoding="utf-8"),
        "environment": {key: _text(value) for key, value in run.environment.items()},
        "colours": COLOURS,
    }


def mosaic_photo(run: Run) -> str | None:
    """The photo mosaic as an inlined JPEG, white where the map has a hole."""
    if "mosaic" not in run.rasters:
        return None
    mosaic = run.rasters["mosaic"].values
    return jpeg_uri(np.where(mosaic.any(axis=2, keepdims=True), mosaic, np.uint8(255)))


def surface_photo(run: Run) -> str | None:
    """The mesh of the map as an inlined JPEG."""
    picture = surface_picture(run.folder / "mesh.glb")
    return None if picture is None else jpeg_uri(picture)


def sample_photos(run: Run) -> list[tuple[int, str, str | None]]:
    """Frame number, left and right image of keyframes spread over the survey."""
    frames = run.imaged_frames()
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(SAMPLES, len(frames))).round().astype(int))
    return [(frames[k], *_pair(run, frames[k])) for k in chosen]


def _pair(run: Run, frame: int) -> tuple[str, str | None]:
    left, right = (read_rgb(run.image_file(frame, eye)) for eye in ("left", "right"))
    return (jpeg_uri(left) if left is not None else ""), (jpeg_uri(right) if right is not None else None)


def jpeg_uri(image: NDArray[np.uint8]) -> str:
    """An RGB image as an inlined JPEG."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg_bytes(image, PHOTO_PX)).decode()


def _text(value: Any) -> str:
    return json.dumps(value) if isinstance(value, Mapping | list) else str(value)
