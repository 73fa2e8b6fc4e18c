"""Command line `twin`: parses arguments and calls the function that implements the command.

Exit status: 0 success; 1 a survey is not complete, a requirement is missed (with `twin plan --strict`: the plan is
expected to miss one), no plan is recommended, or a study has no result, cannot be written or finds that surrogate and
rendered surveys disagree; 2 invalid input, a file that cannot be read or written, a study of which every survey is
refused, missing system library or failed check of the machine; 130 interrupted by Ctrl-C; 143 terminated by SIGTERM.
`twin view` returns the status of the viewer.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.app import console, outputs
from twin.app.termination import INTERRUPTED, sigterm_as_interrupt
from twin.core.output_folder import sole_writer
from twin.errors import TwinError

if TYPE_CHECKING:
    from twin.recordings.replay import ReplayResult
    from twin.report.run_result import RunResult

app = typer.Typer(
    help="Digital twin of an underwater stereo survey: simulates it and compares trajectory and map with the truth.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

reproductions = typer.Typer(
    help="Reproduce experiments of Negahdaripour & Madjidi (2003); compare the light model with its reference.",
    no_args_is_help=True,
)
app.add_typer(reproductions, name="reproduce")

# In help texts, a bracket is escaped, because Rich takes words in brackets for style tags.
SceneArgument = Annotated[
    str, typer.Argument(metavar="SCENE", help="Scenario: a name in scenes/ or the path of a TOML file.")
]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")]
RunsArgument = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of two to eight runs.")]
PageOption = Annotated[Path, typer.Option("--out", help="HTML page to write.")]
SetOption = Annotated[
    list[str],
    typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the scenario, as in plan.tracks=2; repeatable."),
]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Seed of all random numbers.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder to write. Default: runs/NAME-SEED.")]
PictureOption = Annotated[Path | None, typer.Option("--out", help="PNG to write. Default: runs/NAME-plan.png.")]
SheetOption = Annotated[Path | None, typer.Option("--out", help="PNG to write. Default: runs/NAME-look.png.")]
QuickOption = Annotated[bool, typer.Option("--quick", help="Use smaller plans, images or selections of cases.")]
WalksOption = Annotated[
    int, typer.Option("--walks", min=64, help="Largest number of random walks for a value of light.")
]
PhaseOption = Annotated[
    str,
    typer.Option("--phase", help="Phase function for lamps, in model and reference: a value of water.phase_function."),
]
ResultsArgument = Annotated[Path, typer.Argument(metavar="FILE", help="results.json of `twin reproduce all`.")]
ChapterPageOption = Annotated[Path | None, typer.Option("--page", help="Markdown page whose chapter is replaced.")]
TurbidityOutOption = Annotated[Path, typer.Option("--out", help="Folder to write.")]
AtOption = Annotated[
    str | None,
    typer.Option("--at", metavar="X,Y,Z", help="Position of the left camera \\[m]. Default: centre of the survey."),
]
TwistOption = Annotated[
    str | None,
    typer.Option(
        "--twist",
        metavar="VX,VY,VZ,WX,WY,WZ",
        help="Velocity of the vehicle during the exposure: forward, left, up \\[m/s], and about these axes \\[deg/s]. "
        "Default: at rest.",
    ),
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
    typer.Option(
        "--jobs", min=1, max=1024, help="Parallel surveys, each a process or a SLURM job. Default: one per core."
    ),
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
VerifyOption = Annotated[
    int | None,
    typer.Option(
        "--verify",
        min=0,
        max=1000,
        metavar="N",
        help="Rendered surveys of a plan before it is recommended; 0: none. Default: tune.verify of the study.",
    ),
]
CheckOption = Annotated[
    int | None,
    typer.Option(
        "--verify",
        min=0,
        max=1000,
        metavar="N",
        help="Also fly rendered surveys for the N surrogate surveys closest to the limits. Default: none.",
    ),
]
ExtrapolateOption = Annotated[
    bool,
    typer.Option(
        "--extrapolate",
        help="Fly surrogate surveys outside the range of the error model's fit, with a warning, instead of refusing.",
    ),
]
LinesOption = Annotated[bool, typer.Option("--live", help="Print a line for each finished survey.")]
DatasetArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET", help="Stereo data set: EuRoC/ASL, KITTI, left/ and right/, or a ROS 2 bag (MCAP, db3)."
    ),
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option("--calibration", metavar="FILE", help="OpenCV, Kalibr, ROS, ORB-SLAM3, or COLMAP cameras.txt."),
]
TruthOption = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="FILE|TOPIC",
        help="True poses, only for the comparison: TUM, KITTI or EuRoC; or the topic of a ROS 2 bag that has them.",
    ),
]
TrueMapOption = Annotated[
    Path | None,
    typer.Option(
        "--true-map",
        metavar="FILE",
        help="True heights in the frame of the true poses (GeoTIFF), only for the comparison of the map.",
    ),
]
TopicsOption = Annotated[
    str | None,
    typer.Option("--topics", metavar="LEFT,RIGHT", help="Image topics of a ROS 2 bag. Default: its only stereo pair."),
]
AidingOption = Annotated[
    bool, typer.Option("--aiding/--no-aiding", help="Use recorded readings of pressure, attitude and DVL.")
]
EstimatorOption = Annotated[
    str | None,
    typer.Option(
        "--estimator",
        metavar="NAME",
        help="Estimator of another package, module:Class or its entry point. Default: the estimators of the twin.",
    ),
]
AlignOption = Annotated[
    str,
    typer.Option("--align", metavar="NAME", help="Alignment with the truth before the comparison: first, se3 or none."),
]
BayerOption = Annotated[
    str | None, typer.Option("--bayer", metavar="PATTERN", help="Raw images: RGGB, GRBG, GBRG or BGGR.")
]
PreviewOption = Annotated[
    bool, typer.Option("--preview", help="Only draw the first stereo pair: matches, disparity, light before and after.")
]
ReplayOutOption = Annotated[
    Path | None, typer.Option("--out", help="Folder to write (--preview: PNG). Default: runs/NAME-replay.")
]
AllowPluginsOption = Annotated[
    bool,
    typer.Option("--allow-plugins", help="Load plug-ins named as module:Class, which run code of any module."),
]
KindArgument = Annotated[str, typer.Argument(metavar="KIND", help="controller, estimator, terrain or reader.")]
PluginFolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="New folder; names the package.")]
SummaryOption = Annotated[bool, typer.Option("--json", help="Print only a summary, as JSON.")]
PlanJsonOption = Annotated[bool, typer.Option("--json", help="Print only the predicted properties, as JSON.")]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="Exit with status 1 if a requirement is expected to be missed.")
]
OptionalRunArgument = Annotated[Path | None, typer.Argument(metavar="RUN", help="Folder of a run.")]
FormatOption = Annotated[
    list[str], typer.Option("--to", metavar="FORMAT", help="Format to write; repeatable, or separated by commas.")
]
ExportOutOption = Annotated[Path | None, typer.Option("--out", help="Folder to write. Default: RUN/export.")]
CrsOption = Annotated[str | None, typer.Option("--crs", help="CRS of the exported coordinates, as in EPSG:32633.")]
OriginOption = Annotated[
    str | None,
    typer.Option("--origin", metavar="E,N,H", help="Scene origin in --crs; H is its elevation \\[m], by default 0."),
]
JpegOption = Annotated[
    int | None, typer.Option("--jpeg", metavar="QUALITY", help="Write images as JPEG of this quality, 1 to 100.")
]
ListOption = Annotated[bool, typer.Option("--list", help="List the formats.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print only the metrics, as JSON.")]


def main() -> None:
    """Runs the command line; a TwinError is printed on stderr and ends the program with exit status 2."""
    console.accept_any_text()
    console.hide_log_failures()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `one_blas_thread`; read when numpy is imported, after this
    with sigterm_as_interrupt():
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
    extrapolate: ExtrapolateOption = False,
    allow_plugins: AllowPluginsOption = False,
) -> None:
    """Run one survey and write its folder: map, trajectories, report, recording, metrics."""
    options = ([] if seed is None else [f"seed={seed}"]) + (["imaging.extrapolate=true"] if extrapolate else [])
    result = _run_survey(scene, overrides + options, out, live, allow_plugins)
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
    as_json: PlanJsonOption = False,
    strict: StrictOption = False,
    allow_plugins: AllowPluginsOption = False,
) -> None:
    """Print the predicted properties of a survey plan over its floor and draw the plan, without simulation."""
    from twin.planning import drawing
    from twin.planning import summary as plan_summary
    from twin.scenario.file import load_scenario
    from twin.world.mission import prepare

    scenario = load_scenario(scene, overrides, allow_plugins)
    file = outputs.output_file(out or Path(f"runs/{outputs.file_stem(scenario.name)}-plan.png"))
    summary = plan_summary.summarise(prepare(scenario))
    with outputs.writing(file):
        drawing.draw(summary, file)
    if as_json:
        print(json.dumps(plan_summary.as_json(summary, str(file)), indent=1))
    else:
        console.print_plan(summary)
        print(f"Picture: {file}")
    raise typer.Exit(1 if strict and not summary.meets_requirements else 0)


@app.command()
def look(
    scene: SceneArgument,
    overrides: SetOption = [],  # noqa: B006 (typer copies it)
    at: AtOption = None,
    twist: TwistOption = None,
    out: SheetOption = None,
    as_json: SummaryOption = False,
    allow_plugins: AllowPluginsOption = False,
) -> None:
    """Render the stereo pair at one position, draw its light components on one sheet, and print the image quality."""
    from twin.app import look as viewing
    from twin.app import look_sheet
    from twin.scenario.file import load_scenario
    from twin.world.mission import prepare

    position_m = None if at is None else viewing.parse_position(at)
    twist_body = None if twist is None else viewing.parse_twist(twist)
    scenario = load_scenario(scene, overrides, allow_plugins)
    file = outputs.output_file(out or Path(f"runs/{outputs.file_stem(scenario.name)}-look.png"))
    mission = prepare(scenario)
    view = viewing.render_view(mission, position_m, twist_body)
    with outputs.writing(file):
        sheet = look_sheet.draw(mission.scenario, view, file)
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

    outputs.output_file(out / "turbidity.png")
    _require_rendering()
    with sole_writer(out, used=True), outputs.writing(out):
        summary = experiment.write(experiment.render_levels(), out)
    if as_json:
        print(json.dumps(summary, indent=1))
    else:
        console.print_table(f"Block at {summary['range_m']:.2f} m in green light", experiment.table(summary))
        print(f"Sheet: {out / 'turbidity.png'}")


@reproductions.command()
def light(
    out: TurbidityOutOption = Path("runs/light"),
    quick: QuickOption = False,
    walks: WalksOption = 1_500_000,
    phase: PhaseOption = "sea",
    as_json: SummaryOption = False,
) -> None:
    """Compare the light of lamps and sun in the images with a Monte Carlo simulation of any order of scattering."""
    from twin.reproduce import daylight
    from twin.reproduce import light as comparison

    outputs.output_file(out / "light.png")
    selection = comparison.QUICK if quick else comparison.ALL
    found = list(comparison.cells(selection, walks, phase))
    under_sun = list(daylight.daylight_cells(daylight.QUICK_DAYLIGHT if quick else daylight.ALL_DAYLIGHT, walks))
    with sole_writer(out, used=True), outputs.writing(out):
        summary = comparison.write(found, out) | {"daylight": daylight.write_daylight(under_sun, out)}
    if as_json:
        print(json.dumps(summary, indent=1))
    else:
        console.print_table("Light model and reference, green band", comparison.table(found))
        console.print_table("Daylight, light model and reference, green band", daylight.daylight_table(under_sun))
        print(f"Sheet: {out / 'light.png'}")


def _reproduce(name: str, out: Path, quick: bool, as_json: bool) -> None:
    """Runs one experiment of the paper, and prints its tables or, as JSON, its results."""
    from twin.reproduce.catalogue import EXPERIMENTS

    outputs.output_file(out / f"{name}.json")
    _require_rendering()
    with sole_writer(out, used=True), outputs.writing(out):
        exhibit = EXPERIMENTS[name](out, quick)
    if as_json:
        print(json.dumps(exhibit.as_dict(), indent=1))
        return
    for table in exhibit.tables:
        console.print_table(table.title, list(table.rows))
    print(f"Figures: {', '.join(str(out / figure.file) for figure in exhibit.figures)}")


@reproductions.command()
def paper(
    out: TurbidityOutOption = Path("runs/paper-mission"), quick: QuickOption = False, as_json: SummaryOption = False
) -> None:
    """Fly the paper's mission of 25 tracks with and without alignment (Figs. 4 to 7); takes hours without --quick."""
    _reproduce("paper", out, quick, as_json)


@reproductions.command()
def tank1(
    out: TurbidityOutOption = Path("runs/tank1"), quick: QuickOption = False, as_json: SummaryOption = False
) -> None:
    """Survey objects in a tank with 130 stereo pairs on parallel legs (Figs. 9 and 10)."""
    _reproduce("tank1", out, quick, as_json)


@reproductions.command()
def tank2(
    out: TurbidityOutOption = Path("runs/tank2"), quick: QuickOption = False, as_json: SummaryOption = False
) -> None:
    """Survey objects in a tank with 61 stereo pairs on two loops that touch at the start (Figs. 11 and 12)."""
    _reproduce("tank2", out, quick, as_json)


@reproductions.command()
def budget(
    out: TurbidityOutOption = Path("runs/budget"), quick: QuickOption = False, as_json: SummaryOption = False
) -> None:
    """Measure the time of each module and compare it with the paper's budget at 30 Hz (section IV)."""
    _reproduce("budget", out, quick, as_json)


@reproductions.command("all")
def all_experiments(out: TurbidityOutOption = Path("runs/reproduce"), quick: QuickOption = False) -> None:
    """Run all experiments and write one page with every table and figure."""
    from twin.reproduce import catalogue

    outputs.output_file(out / catalogue.PAGE_FILE)
    _require_rendering()
    with sole_writer(out, used=True), outputs.writing(out):
        catalogue.run_all(out, quick, report=console.print_error)
    print(f"Page: {out / catalogue.PAGE_FILE}")


@reproductions.command()
def chapter(file: ResultsArgument, page: ChapterPageOption = None) -> None:
    """Print the chapter of docs/paper.md that shows the results of `twin reproduce all`, or replace it in a page."""
    from twin.reproduce import catalogue, page_chapter

    exhibits, quick = catalogue.read_all(file)
    if page is None:
        print(page_chapter.chapter(exhibits, quick))
        return
    with outputs.writing(page, "--page"):
        page_chapter.update(page, exhibits, quick)


@app.command("fit-surrogate")
def fit_surrogate(
    files: FitArgument = None,
    out: ModelOption = Path("error_model.toml"),
    runs: RunsOption = Path("runs/fit-surrogate"),
    jobs: JobsOption = None,
) -> None:
    """Fit the error model of the surrogate to rendered surveys; finished surveys are reused."""
    from twin.app import fit_command

    outputs.output_file(out)
    outputs.output_file(runs / "study", "--runs")
    raise typer.Exit(fit_command.run(files or [], out, runs, jobs))


@app.command()
def study(
    file: StudyArgument,
    out: StudyOutOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    resume: ResumeOption = False,
    live: LinesOption = False,
    as_json: SummaryOption = False,
    verify: CheckOption = None,
    extrapolate: ExtrapolateOption = False,
    allow_plugins: AllowPluginsOption = False,
) -> None:
    """Run the surveys of a study and estimate the probability that a survey meets the requirements."""
    from twin.app import study_command

    if not scheduler:
        _require_rendering()
    options = study_command.StudyOptions(
        out, jobs, scheduler, resume, live, as_json, verify, extrapolate, allow_plugins
    )
    raise typer.Exit(study_command.run(file, options))


@app.command()
def tune(
    file: StudyArgument,
    out: TuneOutOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    resume: ResumeOption = False,
    live: LinesOption = False,
    as_json: SummaryOption = False,
    verify: VerifyOption = None,
    extrapolate: ExtrapolateOption = False,
    allow_plugins: AllowPluginsOption = False,
) -> None:
    """Optimise the plan as the tune section of a study defines it, and write the recommended plan as a scenario."""
    from twin.app import study_command

    if not scheduler:
        _require_rendering()
    options = study_command.StudyOptions(
        out, jobs, scheduler, resume, live, as_json, verify, extrapolate, allow_plugins
    )
    raise typer.Exit(study_command.tune(file, options))


@app.command()
def replay(
    dataset: DatasetArgument,
    calibration: CalibrationOption = None,
    truth: TruthOption = None,
    align: AlignOption = "first",
    bayer: BayerOption = None,
    out: ReplayOutOption = None,
    preview: PreviewOption = False,
    topics: TopicsOption = None,
    estimator: EstimatorOption = None,
    aiding: AidingOption = True,
    true_map: TrueMapOption = None,
    as_json: JsonOption = False,
    allow_plugins: AllowPluginsOption = False,
) -> None:
    """Run the estimators on recorded stereo images and write a run folder: map, trajectories, report, recording."""
    from twin.recordings import preview as previewing
    from twin.recordings import replay as recorded
    from twin.scenario.file import plugin_error

    if estimator is not None and ":" in estimator and not allow_plugins:
        raise plugin_error("--estimator", estimator, "estimators")
    alignment, pattern = recorded.alignment_name(align), recorded.bayer_pattern(bayer)
    pair = recorded.image_topics(topics)
    options = recorded.ReplayOptions(
        calibration, truth, alignment, pattern, topics=pair, estimator=estimator, aiding=aiding,
        true_map=true_map,
    )  # fmt: skip
    name = outputs.path_stem(dataset)
    if preview:
        file = outputs.output_file(out or Path(f"runs/{name}-preview.png"))
        if file.suffix.lower() not in (".png", ""):
            raise TwinError("--out", f"{file.suffix[:20]!r} is not the suffix of a sheet", ".png")
        opened = recorded.open_dataset(dataset, options)
        light = previewing.light_of(opened)
        with outputs.writing(file):
            previewing.draw(opened, light, file)
        console.print_table(f"First pair of {opened.name}", previewing.rows(opened, light))
        print(f"Sheet: {file}")
        return
    folder = outputs.new_folder(out) if out is not None else outputs.unused_folder(Path("runs") / f"{name}-replay")
    with console.replay_bar() as progress:
        result = recorded.replay(dataset, folder, options, progress)
    if as_json:
        print(json.dumps(result.metrics, indent=1))
    else:
        console.print_metrics(result.metrics)
        console.print_outputs(result.folder)
    raise typer.Exit(exit_status(result))


@app.command()
def report(folder: RunArgument) -> None:
    """Write the report of a run again, from the files in its folder."""
    from twin.report.survey_page import write_report

    with outputs.writing(folder, "RUN"):
        print(f"Report: {write_report(folder)}")


@app.command()
def compare(folders: RunsArgument, out: PageOption = Path("runs/compare.html"), as_json: SummaryOption = False) -> None:
    """Compare runs: a table of metrics with differences from the first run, overlaid curves, one HTML page."""
    from twin.report import comparison

    runs = comparison.load_runs(folders)
    file = outputs.output_file(out)
    with outputs.writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(comparison.render(runs), encoding="utf-8")
    if as_json:
        print(json.dumps(comparison.as_json(runs), indent=1))
    else:
        console.print_table("Comparison", comparison.text_rows(runs))
        print(f"Page: {file}")


@app.command()
def view(folder: RunArgument) -> None:
    """Open the recording of a run in Rerun."""
    from twin.report.recording import open_viewer

    with outputs.writing(folder, "RUN"):
        raise typer.Exit(open_viewer(folder))


@app.command("new-plugin")
def new_plugin(kind: KindArgument, folder: PluginFolderArgument) -> None:
    """Write a package with a working plug-in (controller, estimator, terrain or reader) and its test."""
    from twin.plugin import skeleton

    chosen = skeleton.plugin_kind(kind)
    with outputs.writing(outputs.new_folder(folder, "DIR"), "DIR"):
        written = skeleton.write(chosen, folder)
    for file in written:
        print(file)
    print(f"Next: pip install -e {folder}; pytest {folder / 'tests'}")


@app.command()
def export(
    folder: OptionalRunArgument = None,
    to: FormatOption = [],  # noqa: B006 (typer copies it)
    out: ExportOutOption = None,
    crs: CrsOption = None,
    origin: OriginOption = None,
    jpeg: JpegOption = None,
    show_list: ListOption = False,
    allow_plugins: AllowPluginsOption = False,
) -> None:
    """Write a run in the formats of other programs: data sets, camera models, truth, maps."""
    from twin.exports import command as export_command

    if show_list:
        console.print_table("Formats of twin export", export_command.format_rows())
        return
    if folder is None:
        raise TwinError("RUN", "is missing", "the folder of a run, or --list")
    target = folder / "export" if out is None else out
    options = export_command.ExportOptions(crs, origin, jpeg, allow_plugins)
    with console.replay_bar() as progress, outputs.writing(target):
        warnings: list[str] = []
        written = export_command.export(folder, to, target, options, progress, warnings.append)
    for warning in warnings:
        print(f"Warning: {warning}", file=sys.stderr)
    for name, paths in written.items():
        print(f"{name}: {', '.join(map(str, paths))}")


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


def exit_status(result: RunResult | ReplayResult) -> int:
    """Returns the exit status of a survey or a replay.

    130 if it was interrupted; 1 if aborted for another reason, degraded, or if it misses a requirement; otherwise 0.
    """
    if result.status == "aborted" and result.metrics["reason"].startswith("interrupted"):
        return INTERRUPTED
    missed = [r for r in result.metrics["require"].values() if not r["passed"]]
    return 1 if result.status != "complete" or missed else 0


def _run_survey(
    scene: str, overrides: list[str], out: Path | None, live: bool, allow_plugins: bool = False
) -> RunResult:
    """Loads and runs one survey with a progress bar; returns its result."""
    from twin.scenario.file import load_scenario

    scenario = load_scenario(scene, overrides, allow_plugins)
    _require_rendering()
    from twin import survey  # imported here because it needs OpenGL

    # last, because two surveys that begin at once must find different folders
    folder = outputs.run_folder(scenario) if out is None else outputs.new_folder(out)
    with console.progress_bar() as progress:
        return survey.run(scenario, folder, progress, live)


def _require_rendering() -> None:
    """Prints the reason and exits with status 2 if this machine cannot render."""
    from twin.app.doctor import check_rendering

    check = check_rendering()
    if not check.ok:
        console.print_error(str(check))
        raise typer.Exit(2)
