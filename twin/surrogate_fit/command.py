"""`twin fit-surrogate`: from the words of the command line to a calibration on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.progress import track

from twin.app import console
from twin.study.study_file import load_study
from twin.study.surveys import surveys
from twin.surrogate import error_model_file
from twin.surrogate_fit.rendered_surveys import fit_to, note

DEFAULT = ("fit_reef", "fit_sun", "fit_paper")


def run(files: Sequence[str], out: Path, runs: Path) -> int:
    """Flies the rendered surveys of some studies that are not in `runs` yet, fits and writes the calibration.

    Raises:
        TwinError: a bad study, or too few surveys that could be flown.
    """
    model = error_model_file.load().model
    flown = [
        (s.scenario, s.folder) for file in files or DEFAULT for s in surveys(load_study(file), runs / Path(file).stem)
    ]
    notes = [note(scenario, folder, model) for scenario, folder in track(flown, "Rendered surveys")]
    found = fit_to(notes, model)
    error_model_file.save(found, out)
    console.table(
        f"Fit to {found.surveys} surveys", [(name, f"{value:.1%}", "") for name, value in found.misfit.items()]
    )
    print(f"Error model: {out}")
    return 0
