"""Simulation-first digital twin of an underwater stereo survey."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from twin.scenario.model import Scenario
    from twin.session.conclusion import RunResult

__all__ = ["load_scenario", "run"]

# OpenBLAS reads this when numpy is imported. Threads slow down small matrices: with two threads, the final alignment
# of 25 tracks takes more than twice as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def load_scenario(path: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Reads a scenario.

    Args:
        path: a TOML file, or a name in scenes/.
        overrides: strings `key=value` that replace values of the file, for example `plan.tracks=2`.

    Raises:
        ScenarioError: lists every error, each as `FILE:LINE: key: problem (allowed: ...)`.
    """
    from twin.scenario.file import load_scenario

    return load_scenario(path, overrides)


def run(scenario: Scenario, out: str | Path) -> RunResult:
    """Runs a survey and writes its run folder.

    Args:
        scenario: the survey, from `load_scenario`.
        out: folder to write.

    Returns:
        Status and metrics of the survey.

    Raises:
        ScenarioError: the survey cannot be carried out as described; nothing was written.
    """
    from twin import survey

    return survey.run(scenario, Path(out))
