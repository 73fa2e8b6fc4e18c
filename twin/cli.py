"""The command `twin`: each command a few lines in front of a function that does the work.

Exit status: 0 done; 1 the survey failed or missed a requirement; 2 bad usage or scenario; 130 interrupted.
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
    help="A digital twin of an underwater stereo survey: fly one, and be told how far off it was.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

reproductions = typer.Typer(help="Run the paper's experiments again.", no_args_is_help=True)
app.add_typer(reproductions, name="reproduce")

SceneArgument = Annotated[str, typer.Argument(metavar="SCENE", help="A name in scenes/ or the path of a TOML file.")]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run.")]
SetOption = Annotated[
    list[str], typer.Option("--set", metavar="KEY=VALUE", help="Override a key, as plan.tracks=2; may be repeated.")
]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Seed of all randomness.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder to write; runs/NAME-SEED where not given.")]
PictureOption = Annotated[Path | None, typer.Option("--out", help="PNG to write; runs/NAME-plan.png where not given.")]
SheetOption = Annotated[Path | None, typer.Option("--out", help="PNG to write; runs/NAME-look.png where not given.")]
LadderOption = Annotated[Path, typer.Option("--out", help="Folder to write.")]
AtOption = Annotated[
    str | None, typer.Option("--at", metavar="X,Y,Z", help="Place of the left camera [m]; mid-survey where not given.")
]
LiveOption = Annotated[bool, typer.Option("--live", help="Show the survey in Rerun while it is flown.")]
FitArgument = Annotated[
    list[str] | None, typer.Argument(metavar="FILE", help="Studies of rendered surveys; the project's own if none.")
]
ModelOption = Annotated[Path, typer.Option("--out", help="TOML to write, for `imaging.error_model`.")]
RunsOption = Annotated[Path, typer.Option("--runs", help="Folder of what was flown for it.")]
StudyArgument = Annotated[
    str, typer.Argument(metavar="FILE", help="A study's TOML file, or a name in scenes/studies/.")
]
StudyOutOption = Annotated[Path | None, typer.Option("--out", help="Folder to write; runs/study-NAME if not given.")]
TuneOutOption = Annotated[Path | None, typer.Option("--out", help="Folder to write; runs/tune-NAME if not given.")]
JobsOption = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Surveys at a time, each a process (or a SLURM job); one a core.")
]
SchedulerOption = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Fly on this Dask cluster, as tcp://host:8786.")
]
SlurmOption = Annotated[bool, typer.Option("--slurm", help="Fly as jobs of a SLURM cluster (by dask-jobqueue).")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Fly only what is missing in the folder, or failed.")]
LinesOption = Annotated[bool, typer.Option("--live", help="Print a line for each survey that ends.")]
SummaryOption = Annotated[bool, typer.Option("--json", help="Print a summary as JSON and nothing else.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the metrics as JSON and nothing else.")]


def main() -> None:
    """Runs the command line; a fault of the user ends it with exit status 2 and a line for each."""
    try:
        app()
    except TwinError as error:
        console.fault(str(error))
        sys.exit(2)


@app.command()
def demo(out: OutOption = None) -> None:
    """Fly a small complete survey (under 2 minutes) and show its errors."""
    result = _survey("quickstart", [], out, live=False)
    console.errors(result.metrics)
    console.pictures(result.folder)
    raise typer.Exit(exit_status(result))


@app.command()
def run(
    scene: SceneArgument,
    overrides: SetOption = [],  # noqa: B006  typer copies it
    seed: SeedOption = None,
    out: OutOption = None,
    live: LiveOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fly one survey and leave its folder: map, trajectories, report, recording, metrics."""
    result = _survey(scene, overrides + ([] if seed is None else [f"seed={seed}"]), out, live)
    if as_json:
        print(json.dumps(result.metrics, indent=1))
    else:
        console.errors(result.metrics)
        console.pictures(result.folder)
    raise typer.Exit(exit_status(result))


@app.command()
def plan(
    scene: SceneArgument,
    overrides: SetOption = [],  # noqa: B006  typer copies it
    out: PictureOption = None,
) -> None:
    """Show the numbers and a picture of a survey; nothing is simulated."""
    from twin.app import plan as planning
    from twin.scenario.file import load_scenario
    from twin.world.mission import prepare

    mission = prepare(load_scenario(scene, overrides))
    console.table(f"Plan of {mission.scenario.name}", planning.numbers(mission))
    print(f"Picture: {planning.draw(mission, out or Path(f'runs/{mission.scenario.name}-plan.png'))}")


@app.command()
def look(
    scene: SceneArgument,
    overrides: SetOption = [],  # noqa: B006  typer copies it
    at: AtOption = None,
    out: SheetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Look through the cameras at one place: the stereo pair, and all that the left image consists of, as one sheet."""
    from twin.app import look as looking
    from twin.app import look_sheet
    from twin.scenario.file import load_scenario
    from twin.world.mission import prepare

    place = None if at is None else looking.parse_place(at)
    mission = prepare(load_scenario(scene, overrides))
    seen = looking.look(mission, place)
    sheet = look_sheet.draw(mission.scenario, seen, out or Path(f"runs/{mission.scenario.name}-look.png"))
    figures = looking.figures(seen)
    if as_json:
        print(json.dumps({"name": mission.scenario.name, "sheet": str(sheet)} | figures, indent=1))
    else:
        console.table(f"Look at {mission.scenario.name}", looking.table(figures))
        print(f"Sheet: {sheet}")


@reproductions.command()
def turbidity(out: LadderOption = Path("runs/turbidity"), as_json: SummaryOption = False) -> None:
    """One object at five turbidity levels with histograms (the paper's Fig. 8), and contrast against range."""
    from twin.reproduce import turbidity as ladder

    _need_graphics()
    told = ladder.write(ladder.climb(), out)
    if as_json:
        print(json.dumps(told, indent=1))
    else:
        console.table(f"The block at {told['range_m']:.2f} m in green light", ladder.table(told))
        print(f"Sheet: {out / 'turbidity.png'}")


@app.command("fit-surrogate")
def fit_surrogate(
    files: FitArgument = None,
    out: ModelOption = Path("error_model.toml"),
    runs: RunsOption = Path("runs/fit-surrogate"),
) -> None:
    """Fit the surrogate's error model to rendered surveys; what was flown before is not flown again."""
    from twin.surrogate_fit import command

    raise typer.Exit(command.run(files or [], out, runs))


@app.command()
def study(
    file: StudyArgument,
    out: StudyOutOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    slurm: SlurmOption = False,
    resume: ResumeOption = False,
    live: LinesOption = False,
    as_json: SummaryOption = False,
) -> None:
    """Fly many surveys that differ in what the study varies, and tell how probable it is that one passes."""
    from twin.study import command

    if not (scheduler or slurm):
        _need_graphics()
    raise typer.Exit(command.run(file, command.Options(out, jobs, scheduler, slurm, resume, live, as_json)))


@app.command()
def tune(
    file: StudyArgument,
    out: TuneOutOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    slurm: SlurmOption = False,
    resume: ResumeOption = False,
    live: LinesOption = False,
    as_json: SummaryOption = False,
) -> None:
    """Search the plan that the section tune of a study asks for, and write the one recommended as a scenario."""
    from twin.study import command

    if not (scheduler or slurm):
        _need_graphics()
    raise typer.Exit(command.tune(file, command.Options(out, jobs, scheduler, slurm, resume, live, as_json)))


@app.command()
def report(folder: RunArgument) -> None:
    """Write the report of a run again from its folder."""
    from twin.report.survey_page import write_report

    print(f"Report: {write_report(folder)}")


@app.command()
def view(folder: RunArgument) -> None:
    """Open the recording of a run in Rerun."""
    from twin.report.recording import open_viewer

    raise typer.Exit(open_viewer(folder))


@app.command()
def doctor() -> None:
    """Tell what this machine renders with and what it lacks, with the line that installs it."""
    from twin.app.doctor import examine

    findings = examine(Path.cwd())
    for finding in findings:
        print(finding)
    raise typer.Exit(0 if all(finding.ok for finding in findings) else 2)


@app.command()
def schema() -> None:
    """Print the JSON schema of the scenario; editors complete from it."""
    from twin.scenario.model import Scenario

    print(json.dumps(Scenario.model_json_schema(), indent=1))


def exit_status(result: RunResult) -> int:
    """What the shell is told of a survey."""
    if result.metrics["reason"] == "interrupted":
        return 130
    missed = [r for r in result.metrics["require"].values() if not r["passed"]]
    return 1 if result.status != "complete" or missed else 0


def _survey(scene: str, overrides: list[str], out: Path | None, live: bool) -> RunResult:
    from twin.scenario.file import load_scenario

    scenario = load_scenario(scene, overrides)
    folder = _new_folder(scenario, out)
    _need_graphics()
    from twin import survey  # only now: it needs OpenGL

    with console.progress_bar() as progress:
        return survey.run(scenario, folder, progress, live)


def _need_graphics() -> None:
    """Ends the command where nothing can be drawn."""
    from twin.app.doctor import graphics

    drawing = graphics()
    if not drawing.ok:
        console.fault(str(drawing))
        raise typer.Exit(2)


def _new_folder(scenario: Scenario, out: Path | None) -> Path:
    """The folder to write: what was asked for, or the first of runs/NAME-SEED, runs/NAME-SEED-2, ... that is free."""
    if out is not None:
        return _checked(out)
    first = Path("runs") / f"{scenario.name}-{scenario.seed}"
    folder, count = first, 1
    while folder.exists() and not _empty(folder):
        count += 1
        folder = first.with_name(f"{first.name}-{count}")
    return _checked(folder)


def _checked(folder: Path) -> Path:
    parent = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    if folder.exists() and not _empty(folder):
        raise TwinError("--out", f"{folder} is there and not empty", "a new or an empty folder")
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise TwinError("--out", f"{parent} cannot be written to", "a folder that can")
    return folder


def _empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())
