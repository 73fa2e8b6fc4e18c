"""Flies one survey of a study, keeps the requested output files, and returns its row of results."""

import platform
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from twin.errors import ScenarioError, TwinError, UnmodelledError
from twin.judge.verdict import leaves
from twin.studies.surveys import Sample, Survey

Row = dict[str, Any]
#: For each value of `keep`: the argument `outputs` of `survey.run`, and the files that are kept; None: all of them.
KEPT: dict[str, tuple[tuple[str, ...] | None, tuple[str, ...] | None]] = {
    "none": (None, ()),
    "metrics": (None, ("metrics.json",)),
    "report": (("report",), ("metrics.json", "report.html", "scenario.resolved.toml")),
    "all": (("report", "recording"), None),
}


def fly(survey: Survey) -> Row:
    """Flies a survey, writes the files of its run folder that are kept, and returns its row of results.

    The row has the status "refused" if a ScenarioError was raised, with `unmodelled` if only the surrogate refuses the
    scenario, and "failed" after another TwinError or an OSError. The survey writes to a hidden folder that is renamed
    at the end, so a folder with the final name is complete.
    """
    import cv2

    from twin import survey as single_survey

    cv2.setNumThreads(1)
    start = time.perf_counter()
    for leftover in survey.folder.parent.glob(f".{survey.folder.name}.*"):
        shutil.rmtree(leftover, ignore_errors=True)  # files of an attempt that was killed
    scratch = survey.folder.with_name(f".{survey.folder.name}.{uuid4().hex[:8]}")
    try:
        metrics = single_survey.run(survey.scenario, scratch, outputs=KEPT[survey.keep][0]).metrics
        _move_kept_files(scratch, survey)
    except ScenarioError as error:
        unmodelled = {"unmodelled": True} if isinstance(error, UnmodelledError) else {}
        return row_of(survey, "refused", "; ".join(error.lines)) | unmodelled
    except (TwinError, OSError) as error:
        return row_of(survey, "failed", str(error))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    row = row_of(survey, _status(metrics), metrics["reason"]) | {"warning": metrics["warning"]} | flatten(metrics)
    return row | {"timing.survey_s": time.perf_counter() - start, "timing.host": platform.node()}


def _move_kept_files(scratch: Path, survey: Survey) -> None:
    """Deletes the files that are not kept and renames the folder `scratch` to its final name."""
    shutil.rmtree(survey.folder, ignore_errors=True)
    kept = KEPT[survey.keep][1]
    for entry in scratch.iterdir():
        if kept is not None and entry.name not in kept:
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    if kept != ():
        scratch.replace(survey.folder)


def _status(metrics: Mapping[str, Any]) -> str:
    """Returns the status of the run, or "failed" if an I/O error or a signal ended it or one of its stages."""
    reason = metrics["reason"]
    computer_failure = reason.startswith(("[Errno", "interrupted")) or reason.endswith(" skipped")
    return "failed" if computer_failure else metrics["status"]


def row_of(survey: Survey, status: str, reason: str) -> Row:
    """Returns a row without metrics: sample, seed, scenario hash, fidelity, status, reason, values of the varied keys.

    The status is "complete"; "degraded" if the survey was flown to its end but fails a check of the estimators;
    "aborted" if it ended early; "refused" if its scenario cannot be flown; "failed" if program or computer failed.
    """
    identity = {"scenario_hash": survey.scenario_hash, "fidelity": survey.scenario.imaging.fidelity}
    row = {"sample": survey.sample, "seed": survey.seed, **identity, "status": status, "reason": reason}
    return row | {f"vary.{name}": value for name, value in survey.values.items()}


def refused_row(sample: Sample, seed: int, reason: str) -> Row:
    """Returns the row of a survey whose scenario is not valid; its scenario hash is empty."""
    row = {"sample": sample.number, "seed": seed, "scenario_hash": "", "status": "refused", "reason": reason}
    return row | {f"vary.{name}": value for name, value in sample.values.items()}


def has_passed(row: Row) -> bool:
    verdicts = (value for name, value in row.items() if name.startswith("require.") and name.endswith(".passed"))
    return row["status"] == "complete" and all(verdicts)


def failure_reason(row: Row) -> str:
    """Returns why a survey did not pass, with its limits that were not met; "" if it passed."""
    if has_passed(row):
        return ""
    verdicts = {name[8:-7]: value for name, value in row.items() if name.startswith("require.") and ".passed" in name}
    return row["reason"] or "requirement not met: " + " and ".join(name for name, met in verdicts.items() if not met)


def flatten(metrics: Mapping[str, Any]) -> Row:
    """Returns the values in sections of metrics.json by dotted name, e.g. "map.le90_m"; run times begin "timing."."""
    row = {name: value for name, value in leaves(metrics) if "." in name}
    for track in metrics.get("tracks", ()):
        for name, value in track.items():
            row[f"{'timing.' if name == 'ga_ms' else ''}tracks.{track['track']}.{name}"] = value
    return row
