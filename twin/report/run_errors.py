"""Errors of the estimated trajectories of a run, with the alignment to the truth that its metrics use."""

from __future__ import annotations

from twin.judge.recorded import ALIGNMENTS, AlignmentName, recorded_errors
from twin.judge.trajectory_errors import PathErrors, path_errors
from twin.report.run_folder import Run


def run_alignment(run: Run) -> AlignmentName | None:
    """Returns the alignment of a replay with the recorded truth; None for a survey or a replay without evaluation."""
    name = ((run.metrics or {}).get("replay") or {}).get("alignment")
    return next((allowed for allowed in ALIGNMENTS if allowed == name), None)


def run_errors(run: Run, name: str) -> PathErrors:
    """Returns the errors of an estimate at the frames that have a true pose.

    The estimate of a replay is aligned with the truth by the method that its metrics state (`run_alignment`); any other
    estimate is anchored at the first true pose.

    Args:
        run: the run, with a true path.
        name: name of the estimate: "f2f", "online" or "final".
    """
    estimate, truth, alignment = run.trajectories[name], run.trajectories["truth"], run_alignment(run)
    return path_errors(estimate, truth) if alignment is None else recorded_errors(estimate, truth, alignment)
