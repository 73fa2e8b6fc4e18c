"""Digital twin of an underwater stereo survey: simulation, estimators, and evaluation against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twin.recordings.replay import ReplayOptions, ReplayResult
    from twin.scenario.model import Scenario
    from twin.session.conclusion import RunResult
    from twin.session.stepped_world import SteppedWorld as World

__all__ = ["World", "load_scenario", "replay", "run"]


def __getattr__(name: str) -> Any:
    """Returns `twin.World`, which is imported at its first use because it needs the simulator.

    Raises:
        AttributeError: the module has no attribute of this name.
    """
    if name == "World":
        from twin.session.stepped_world import SteppedWorld

        return SteppedWorld
    raise AttributeError(f"module 'twin' has no attribute {name!r}")


def load_scenario(path: str | Path, overrides: Sequence[str] = (), allow_plugins: bool = False) -> Scenario:
    """Returns the validated scenario of a file.

    Args:
        path: a TOML file, or the name of a scenario in scenes/.
        overrides: strings `key=value` that replace values of the file, for example `plan.tracks=2`.
        allow_plugins: whether the file and the overrides may name a plug-in as module:Class, which runs code of any
            module that can be imported; the names of installed entry points are always allowed.

    Raises:
        ScenarioError: there is no such scenario, or a file or an override is invalid. The message lists the errors of
            files as `FILE:LINE: key: problem (allowed: ...)` and those of overrides in lines that begin with `--set`.
    """
    from twin.scenario.file import load_scenario

    return load_scenario(path, overrides, allow_plugins)


def run(scenario: Scenario, out: str | Path) -> RunResult:
    """Runs a survey and writes its run folder.

    Args:
        scenario: the survey, from `load_scenario`.
        out: run folder to write, new or empty.

    Returns:
        Status, metrics and run folder of the survey.

    Raises:
        ScenarioError: the survey cannot be carried out as described; nothing was written.
        TwinError: the run folder is not empty, another process writes it, it or metrics.json cannot be written, or the
            world cannot be created.
    """
    from twin import survey

    return survey.run(scenario, Path(out))


def replay(dataset: str | Path, out: str | Path, options: ReplayOptions | None = None) -> ReplayResult:
    """Runs the estimators on a recorded stereo data set and writes a run folder; see docs/replay.md.

    Args:
        dataset: folder or ROS 2 bag of the data set.
        out: run folder to write, new or empty.
        options: calibration, truth, alignment and settings (`twin.recordings.replay.ReplayOptions`).

    Returns:
        Status, metrics and run folder of the replay, the trajectories and the map.

    Raises:
        TwinError: the data set or one of its files cannot be used (nothing was written), or the run folder is not
            empty, is written by another process, or cannot be written.
    """
    from twin.recordings import replay as recorded

    return recorded.replay(Path(dataset), Path(out), options)
