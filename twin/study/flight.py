"""Flies one survey of a study, keeps the requested output files, and returns its row of results."""

from __future__ import annotations

import platform
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from twin.errors import ScenarioError, TwinError
from twin.study.surveys import Survey

Row = dict[str, Any]
#: Files of a run folder that are kept, for each value of the study's `keep`.
KEPT_FILES = {"metrics": ("metrics.json",), "report": ("metrics.json", "report.html", "scenario.resolved.toml")}
#: Outputs that a run writes, for each value of the study's `keep`; outputs that would be deleted are not written.
OUTPUTS = {"none": None, "metrics": None, "report": ("report",), "all": ("report", "recording")}


def fly(survey: Survey) -> Row:
    """Flies a survey into its folder and returns its row of results.

    The run writes to a hidden folder, which is renamed at the end: a folder with its final name is complete.
    """
    import cv2

    from twin import survey as single_survey

    cv2.setNumThreads(1)
    start = time.perf_counter()
    for leftover in survey.folder.parent.glob(f".{survey.folder.name}.*"):
        shutil.rmtree(leftover, ignore_errors=True)  # files of an attempt that was killed
    scratch = survey.folder.with_name(f".{survey.folder.name}.{uuid4().hex[:8]}")
    try:
        metrics = single_survey.run(survey.scenario, scratch, outputs=OUTPUTS[survey.keep]).metrics
        _move_kept_files(scratch, survey)
    except ScenarioError as error:
        return row_of(survey, "refused", "; ".join(error.lines))
    except (TwinError, OSError) as error:
        return row_of(survey, "failed", str(error))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    row = row_of(survey, _status(metrics), metrics["reason"]) | {"warning": metrics["warning"]} | flatten(metrics)
    return row | {"timing.survey_s": time.perf_counter() - start, "timing.host": platform.node()}


def _move_kept_files(scratch: Path, survey: Survey) -> None:
    """Deletes the files that `survey.keep` excludes and renames the folder `scratch` to its final name."""
    shutil.rmtree(survey.folder, ignore_errors=True)
    if survey.keep == "none":
        return
    if survey.keep != "all":
        for entry in scratch.iterdir():
            if entry.name not in KEPT_FILES[survey.keep]:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    scratch.replace(survey.folder)


def _status(metrics: Mapping[str, Any]) -> str:
    """Returns the status of the run, or "failed" if an I/O error or a signal ended it."""
    computer_failure = metrics["reason"].startswith(("[Errno", "interrupted"))
    return "failed" if computer_failure else metrics["status"]


def row_of(survey: Survey, status: str, reason: str) -> Row:
    """Returns the columns that every row has: sample, seed, scenario hash, status, reason and varied keys.

    Args:
        status: "complete"; "aborted" if the survey ended early; "refused" if its scenario cannot be flown; "failed" if
            the program or the computer failed, which leaves the survey without a result.
    """
    identity = {"sample": survey.sample, "seed": survey.seed, "scenario_hash": survey.scenario_hash}
    return identity | {"status": status, "reason": reason} | {f"vary.{k}": v for k, v in survey.values.items()}


def has_passed(row: Row) -> bool:
    """Returns whether the survey was completed and met every requirement."""
    verdicts = (value for name, value in row.items() if name.startswith("require.") and name.endswith(".passed"))
    return row["status"] == "complete" and all(verdicts)


def flatten(metrics: Mapping[str, Any]) -> Row:
    """Returns the values in the sections of metrics.json by dotted name, e.g. "map.le90_m".

    Names of measured run times begin with "timing.". Values outside the sections, such as the status, are left out.
    """
    row: Row = {}
    for section, value in metrics.items():
        if section == "tracks":
            for track in value:
                for name, entry in track.items():
                    prefix = "timing." if name == "ga_ms" else ""
                    row[f"{prefix}tracks.{track['track']}.{name}"] = entry
        elif isinstance(value, Mapping):
            row.update(_leaves(value, section + "."))
    return row


def _leaves(tree: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value
