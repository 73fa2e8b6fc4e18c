"""Command line `twin`: parses arguments and calls the function that implements the command.

Exit status: 0 success; 1 the survey failed or missed a requirement; 2 invalid input or missing system library;
130 interrupted.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.app import console
from twin.errors import TwinError

if TYPE_CHECKING:
    from twin.scenario.model import Scenario
    from twin.session.conclusion import RunResult

app = typer.Typer(
    help="Digital twin of an underwater stereo survey: simulates it and compares trajectory and map with the truth.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

reproductions = typer.Typer(help="Reproduce experiments of Negahdaripour & Madjidi (2003).", no_args_is_help=True)
app.add_typer(reproductions, name="reproduce")

SceneArgument = Annotated[
    str, typer.Argument(metavar="SCENE", help="Scenario: a name in scenes/ or the path of a TOML file.")
]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")]
SetOption = Annotated[
    list[str],
    typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the scenario, as in plan.tracks=2; repeatable."),
]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Seed of all random numbers.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder to write. Default: runs/NAME-SEED.")]
PictureOption = Annotated[Path | None, typer.Option("--out", help="PNG to write. Default: runs/NAME-plan.png.")]
SheetOption = Annotated[Path | None, typer.Option("--out", help="PNG to write. Default: runs/NAME-look.png.")]
TurbidityOutOption = Annotated[Path, typer.Option("--out", help="Folder to write.")]
AtOption = Annotated[
    str | None,
    typer.Option("--at", metavar="X,Y,Z", help="Position of the left camera [m]. Default: centre of the survey."),
]
LiveOption = Annotated[bool, typer.Option("--live", help="Show the survey in Rerun while it runs.")]
FitArgument = Annotated[
    list[str] | None, typer.Argument(metavar="FILE", help="Studies of rendered surveys. Default: the built-in ones.")
]
ModelOption = Annotated[
    Path, typer.Option("--out", help="Error model to write (TOML), for the key imaging.error_model.")
]
RunsOption = Annotated[Path, typer.Option("--runs", help="Folder of the rendered surveys; finished ones are reused.")]
StudyArgument = Annotated[
    str, typer.Argument(metavar="FILE", help="Study: a name in scenes/studies/ or the path of a TOML file.")
]
StudyOutOption = Annotated[Path | None, typer.Option("--out", help="Folder to write. Default: runs/study-NAME.")]
TuneOutOption = Annotated[Path | None, typer.Option("--out", help="Folder to write. Default: runs/tune-NAME.")]
JobsOption = Annotated[
    int | None,
    typer.Option("--jobs", min=1, help="Parallel surveys, each a process or a SLURM job. Default: one per core."),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Run on the Dask cluster at this address, e.g. tcp://host:8786, or on new SLURM jobs with the word slurm.",
    ),
]
ResumeOption = Annotated[
    bool, typer.Option("--resume", help="Run only surveys that are missing in the folder or failed.")
]
LinesOption = Annotated[bool, typer.Option("--live", help="Print a line for each finished survey.")]
SummaryOption = Annotated[bool, typer.Option("--json", help="Print only a summary, as JSON.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print only the metrics, as JSON.")]


def main() -> None:
    """Runs the command line; prints a TwinError and exits with status 2 if one is raised."""
    try:
        app()
    except TwinError as error:
        console.print_error(str(error))
        sys.exit(2)


@app.command()
def demo(out: OutOption = None) -> None:
    """Run a small complete survey (under 2 minutes) and print its key figures."""
    result = _run_survey("quickstart", [], out, live=False)
    console.print_metrics(result.metrics)
    console.print_outputs(result.folder)
    raise typer.Exit(exit_status(result))


@app.command()
def run(
    scene: SceneArgument,
    overrides: SetOption = [],  # noqa: B006 (typer copies it)
    seed: SeedOption = None,
    out: OutOption = None,
    live: LiveOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run one survey and write its folder: map, trajectories, report, recording, metrics."""
    result = _run_survey(scene, overrides + ([] if seed is None else [f"seed={seed}"]), out, live)
    if as_json:
        print(json.dumps(result.metrics, indent=1))
    else:
        console.print_metrics(result.metrics)
        console.print_outputs(result.folder)
    raise typer.Exit(exit_status(result))


@app.command()
def plan(
    scene: SceneArgument,
    overrides: SetOption = [],  # noqa: B006 (typer copies it)
    out: PictureOption = None,
) -> None:
    """Print the predicted properties of a survey plan and draw the plan, without simulation."""
    from twin.app import plan as planning
    from twin.scenario.file import load_scenario
    from twin.world.mission import prepare

    mission = prepare(load_scenario(scene, overrides))
    console.print_table(f"Plan of {mission.scenario.name}", planning.numbers(mission))
    print(f"Picture: {planning.draw(mission, out or Path(f'runs/{mission.scenario.name}-plan.png'))}")


@app.command()
def look(
    scene: SceneArgument,
    overrides: SetOption = [],  # noqa: B006 (typer copies it)
    at: AtOption = None,
    out: SheetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Render the stereo pair at one position, draw its light components as one sheet, and print the image quality."""
    from twin.app import look as viewing
    from twin.app import look_sheet
    from twin.scenario.file import load_scenario
    from twin.world.mission import prepare

    position_m = None if at is None else viewing.parse_position(at)
    mission = prepare(load_scenario(scene, overrides))
    view = viewing.render_view(mission, position_m)
    sheet = look_sheet.draw(mission.scenario, view, out or Path(f"runs/{mission.scenario.name}-look.png"))
    quality = viewing.image_quality(view)
    if as_json:
        print(json.dumps({"name": mission.scenario.name, "sheet": str(sheet)} | quality, indent=1))
    else:
        console.print_table(f"View of {mission.scenario.name}", viewing.quality_rows(quality))
        print(f"Sheet: {sheet}")


@reproductions.command()
def turbidity(out: TurbidityOutOption = Path("runs/turbidity"), as_json: SummaryOption = False) -> None:
    """Render a block at five turbidities (Fig. 8 of Negahdaripour & Madjidi 2003) and plot contrast versus range."""
    from twin.reproduce import turbidity as experiment

    _require_rendering()
    summary = experiment.write(experiment.render_levels(), out)
    if as_json:
        print(json.dumps(summary, indent=1))
    else:
        console.print_table(f"Block at {summary['range_m']:.2f} m in green light", experiment.table(summary))
        print(f"Sheet: {out / 'turbidity.png'}")


@app.command("fit-surrogate")
def fit_surrogate(
    files: FitArgument = None,
    out: ModelOption = Path("error_model.toml"),
    runs: RunsOption = Path("runs/fit-surrogate"),
) -> None:
    """Fit the error model of the surrogate to rendered surveys; finished surveys are reused."""
    from twin.app import fit_command

    raise typer.Exit(fit_command.run(files or [], out, runs))


@app.command("calibrate", hidden=True, context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def calibrate() -> None:
    """Old name of fit-surrogate."""
    raise TwinError("calibrate", "renamed to fit-surrogate")


@app.command()
def study(
    file: StudyArgument,
    out: StudyOutOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    resume: ResumeOption = False,
    live: LinesOption = False,
    as_json: SummaryOption = False,
) -> None:
    """Run the surveys of a study and estimate the probability that a survey meets the requirements."""
    from twin.app import study_command

    if not scheduler:
        _require_rendering()
    raise typer.Exit(study_command.run(file, study_command.StudyOptions(out, jobs, scheduler, resume, live, as_json)))


@app.command()
def tune(
    file: StudyArgument,
    out: TuneOutOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    resume: ResumeOption = False,
    live: LinesOption = False,
    as_json: SummaryOption = False,
) -> None:
    """Optimise the plan as the tune section of a study defines it, and write the recommended plan as a scenario."""
    from twin.app import study_command

    if not scheduler:
        _require_rendering()
    raise typer.Exit(study_command.tune(file, study_command.StudyOptions(out, jobs, scheduler, resume, live, as_json)))


@app.command()
def report(folder: RunArgument) -> None:
    """Write the report of a run again, from the files in its folder."""
    from twin.report.survey_page import write_report

    print(f"Report: {write_report(folder)}")


@app.command()
def view(folder: RunArgument) -> None:
    """Open the recording of a run in Rerun."""
    from twin.report.recording import open_viewer

    raise typer.Exit(open_viewer(folder))


@app.command()
def doctor() -> None:
    """Check rendering, packages and disk, and print how to fix a failure."""
    from twin.app.doctor import check_machine

    checks = check_machine(Path.cwd())
    for check in checks:
        print(check)
    raise typer.Exit(0 if all(check.ok for check in checks) else 2)


@app.command()
def schema() -> None:
    """Print the JSON schema of the scenario, for completion in editors."""
    from twin.scenario.model import Scenario

    print(json.dumps(Scenario.model_json_schema(), indent=1))


def exit_status(result: RunResult) -> int:
    """Returns the exit status of a survey: 130 interrupted; 1 failed or requirement missed; 0 otherwise."""
    if result.metrics["reason"] == "interrupted":
        return 130
    missed = [r for r in result.metrics["require"].values() if not r["passed"]]
    return 1 if result.status != "complete" or missed else 0


def _run_survey(scene: str, overrides: list[str], out: Path | None, live: bool) -> RunResult:
    """Runs one survey with a progress bar."""
    from twin.scenario.file import load_scenario

    scenario = load_scenario(scene, overrides)
    folder = _new_folder(scenario, out)
    _require_rendering()
    from twin import survey  # imported here because it needs OpenGL

    with console.progress_bar() as progress:
        return survey.run(scenario, folder, progress, live)


def _require_rendering() -> None:
    """Ends the command with exit status 2 if this machine cannot render."""
    from twin.app.doctor import check_rendering

    check = check_rendering()
    if not check.ok:
        console.print_error(str(check))
        raise typer.Exit(2)


def _new_folder(scenario: Scenario, out: Path | None) -> Path:
    """Returns the folder to write: `out`, or the first unused one of runs/NAME-SEED, runs/NAME-SEED-2, ..."""
    if out is not None:
        return _writable(out)
    first = Path("runs") / f"{scenario.name}-{scenario.seed}"
    folder, count = first, 1
    while folder.exists() and not _empty(folder):
        count += 1
        folder = first.with_name(f"{first.name}-{count}")
    return _writable(folder)


def _writable(folder: Path) -> Path:
    """Returns the folder. Raises TwinError unless it is new or empty and can be written."""
    parent = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    if folder.exists() and not _empty(folder):
        raise TwinError("--out", f"{folder} is not empty", "a new or an empty folder")
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise TwinError("--out", f"{parent} is not writable", "a writable folder")
    return folder


def _empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())
