"""Command `twin fit-surrogate`: fits the surrogate's error model to rendered surveys."""

import os
from collections.abc import Sequence
from pathlib import Path

from rich.progress import track

from twin.app import console
from twin.core.output_folder import sole_writer
from twin.engines.engine import default_jobs
from twin.engines.worker import SINGLE_THREADED
from twin.studies.study_file import load_study
from twin.studies.surveys import surveys
from twin.surrogate import error_model_file
from twin.surrogate_fit.rendered_surveys import all_statistics, comparison_model, fit_to_surveys

DEFAULT_STUDIES = (
    "fit_range", "fit_edges", "fit_rough", "fit_across", "fit_reef", "fit_sun", "fit_paper", "fit_murky", "fit_binned",
    "fit_floors",
)  # fmt: skip


def run(files: Sequence[str], out: Path, runs: Path, jobs: int | None = None) -> None:
    """Runs the rendered surveys of the studies, fits the error model to their statistics and writes the model.

    Finished surveys in `runs` are reused; without files, the studies are `DEFAULT_STUDIES`. Raises TwinError if a study
    is invalid, or too few surveys are complete.
    """
    compared = comparison_model(error_model_file.load().model)
    rendered = [
        (s.scenario, s.folder)
        for file in files or DEFAULT_STUDIES
        for s in surveys(load_study(file), runs / Path(file).stem)
    ]
    os.environ.update(SINGLE_THREADED)  # of the new processes
    found = all_statistics(rendered, compared, jobs or default_jobs())
    with sole_writer(runs, "--runs", used=True):
        statistics = list(track(found, "Rendered surveys", total=len(rendered)))
    fitted = fit_to_surveys(statistics, compared)
    error_model_file.save(fitted, out)
    rows: list[tuple[str, ...]] = [(name, f"{value:.1%}") for name, value in fitted.misfit.items()]
    console.print_table(f"Fit to {fitted.n_surveys} surveys", rows)
    print(f"Error model: {out}")
