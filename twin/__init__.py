"""A simulation-first digital twin of an underwater stereo survey."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from twin.scenario.model import Scenario
    from twin.session.conclusion import RunResult

__all__ = ["load_scenario", "run"]

# Read when numpy is loaded. Its threads wait for each other over matrices as small as ours: with two, the last
# alignment of 25 tracks takes more than twice as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def load_scenario(path: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file, or a name in scenes/, with `key=value` overrides.

    Raises:
        ScenarioError: every fault of the file, each as `FILE:LINE: key: what is wrong`.
    """
    from twin.scenario.file import load_scenario

    return load_scenario(path, overrides)


def run(scenario: Scenario, out: str | Path) -> RunResult:
    """Flies a survey and leaves a run folder at `out`.

    Raises:
        ScenarioError: the survey cannot be flown as asked; nothing was written.
    """
    from twin import survey

    return survey.run(scenario, Path(out))
