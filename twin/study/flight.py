"""One survey of a study: flown into its folder, thinned, and told in a row of flat figures."""

from __future__ import annotations

import platform
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from twin.errors import ScenarioError, TwinError
from twin.scenario.model import Scenario
from twin.study.surveys import Survey

Row = dict[str, Any]
#: What stays of a run's folder; what does not stay is not even drawn.
KEPT = {"metrics": ("metrics.json",), "report": ("metrics.json", "report.html", "scenario.resolved.toml")}
SHOWN = {"none": None, "metrics": None, "report": ("report",), "all": ("report", "recording")}


def check(scenario: Scenario) -> list[str]:
    """What stands in the way of flying this scenario."""
    from twin.world.mission import prepare

    try:
        prepare(scenario)
    except ScenarioError as error:
        return error.lines
    return []


def fly(survey: Survey) -> Row:
    """Flies a survey, leaves in its folder what is to stay, and tells it in a row.

    The folder takes its name last: one that is there is complete.
    """
    import cv2

    from twin import survey as flight

    cv2.setNumThreads(1)
    began = time.perf_counter()
    for left in survey.folder.parent.glob(f".{survey.folder.name}.*"):
        shutil.rmtree(left, ignore_errors=True)  # of an attempt that was killed
    scratch = survey.folder.with_name(f".{survey.folder.name}.{uuid4().hex[:8]}")
    try:
        metrics = flight.run(survey.scenario, scratch, shows=SHOWN[survey.keep]).metrics
        _thin(scratch, survey)
    except ScenarioError as error:
        return row_of(survey, "refused", "; ".join(error.lines))
    except (TwinError, OSError) as error:
        return row_of(survey, "failed", str(error))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    told = row_of(survey, _status(metrics), metrics["reason"]) | {"warning": metrics["warning"]} | flat(metrics)
    return told | {"timing.survey_s": time.perf_counter() - began, "timing.host": platform.node()}


def _thin(scratch: Path, survey: Survey) -> None:
    """Gives the folder its name, without what is not to stay."""
    shutil.rmtree(survey.folder, ignore_errors=True)
    if survey.keep == "none":
        return
    if survey.keep != "all":
        for entry in scratch.iterdir():
            if entry.name not in KEPT[survey.keep]:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    scratch.replace(survey.folder)


def _status(metrics: Mapping[str, Any]) -> str:
    """A survey that broke off for want of disk or by a signal says nothing about the sea: it has failed."""
    machine = metrics["reason"].startswith(("[Errno", "interrupted"))
    return "failed" if machine else metrics["status"]


def row_of(survey: Survey, status: str, reason: str) -> Row:
    """What every row begins with.

    `status`: "complete"; "aborted" (in flight) or "refused" (before it) by the survey itself; "failed" where program
    or machine did, so that it says nothing about the survey.
    """
    identity = {"sample": survey.sample, "seed": survey.seed, "scenario_hash": survey.scenario_hash}
    return identity | {"status": status, "reason": reason} | {f"vary.{k}": v for k, v in survey.values.items()}


def has_passed(row: Row) -> bool:
    """Whether the survey ended complete and kept every limit."""
    kept = (value for name, value in row.items() if name.startswith("require.") and name.endswith(".passed"))
    return row["status"] == "complete" and all(kept)


def flat(metrics: Mapping[str, Any]) -> Row:
    """The figures of metrics.json by dotted name; all that a clock decides is named timing."""
    row: Row = {}
    for section, value in metrics.items():
        if section == "tracks":
            for track in value:
                for name, figure in track.items():
                    head = "timing." if name == "ga_ms" else ""
                    row[f"{head}tracks.{track['track']}.{name}"] = figure
        elif isinstance(value, Mapping):
            row.update(_leaves(value, section + "."))
    return row


def _leaves(tree: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value
