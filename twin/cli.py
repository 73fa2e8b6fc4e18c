"""Command line `twin`: parses arguments and calls the function that implements the command.

Exit status: 0 success; 1 a survey is not complete, a requirement is missed (with `twin plan --strict`: the plan is
expected to miss one), no plan is recommended, or a study has no result, cannot be written or finds that surrogate and
rendered surveys disagree; 2 invalid input, a file that cannot be read or written, a study of which every survey is
refused, missing system library or failed check of the machine; 130 interrupted by Ctrl-C; 143 terminated by SIGTERM.
`twin view` returns the status of the viewer.
"""

import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from twin import api
from twin.app import console, outputs
from twin.core.interrupts import INTERRUPTED, sigterm_as_interrupt
from twin.core.output_folder import sole_writer
from twin.core.user_files import resolved
from twin.errors import TwinError

if TYPE_CHECKING:
    from twin.products.pages import Results
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


def option(text: str, metavar: str | None = None, flag: str = "", **limits: Any) -> Any:
    return typer.Option(*([flag] if flag else []), metavar=metavar, help=text, **limits)


def argument(text: str, metavar: str) -> Any:
    return typer.Argument(metavar=metavar, help=text)


# Arguments and options of several commands. In help texts, a bracket is escaped, because Rich takes words in brackets
# for style tags.
Scene = Annotated[str, argument("Scenario: a name in scenes/ or the path of a TOML file.", "SCENE")]
RunFolder = Annotated[Path, argument("Folder of a run.", "RUN")]
Overrides = Annotated[
    list[str], option("Override a key of the scenario, as in plan.tracks=2; repeatable.", "KEY=VALUE", flag="--set")
]
RunOut = Annotated[Path | None, option("Folder to write. Default: runs/NAME-SEED.")]
Resume = Annotated[
    bool, option("Continue from the last checkpoint in --out; resume only in a folder that you trust.", flag="--resume")
]
CheckpointS = Annotated[
    float | None,
    option("Seconds between checkpoints; 0: none. Default: 60, or so much that they take 1 % of the time.", "N", min=0),
]
OutFolder = Annotated[Path, option("Folder to write.")]
Quick = Annotated[bool, option("Use smaller plans, images or selections of cases.", flag="--quick")]
Jobs = Annotated[
    int | None, option("Parallel surveys, each a process or a SLURM job. Default: one per core.", min=1, max=1024)
]
Extrapolate = Annotated[
    bool,
    option(
        "Fly surrogate surveys outside the range of the error model's fit, with a warning, instead of refusing.",
        flag="--extrapolate",
    ),
]
AllowPlugins = Annotated[
    bool, option("Load plug-ins named as module:Class, which run code of any module.", flag="--allow-plugins")
]
MetricsJson = Annotated[bool, option("Print only the metrics, as JSON.", flag="--json")]
SummaryJson = Annotated[bool, option("Print only a summary, as JSON.", flag="--json")]


def main() -> None:
    """Runs the command line; a TwinError is printed on stderr and ends the program with exit status 2."""
    console.prepare_streams()
    _set_up_openblas()
    with sigterm_as_interrupt():
        try:
            console.refuse_little_memory()
            with console.machine_errors():
                app()
        except TwinError as error:
            console.print_error(str(error))
            sys.exit(2)


def _set_up_openblas() -> None:
    """Sets one thread (`one_blas_thread`) and, if the processor has AVX2, its kernels: others round differently.

    OpenBLAS reads both when numpy is imported, which must be after this.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with suppress(OSError):  # not Linux
        if {"avx2", "fma"} <= set(Path("/proc/cpuinfo").read_text().split()):
            os.environ["OPENBLAS_CORETYPE"] = "Haswell"


@app.command()
def demo(out: RunOut = None) -> None:
    """Run a small complete survey (under 2 minutes) and print its key figures."""
    _conclude(_run_survey("quickstart", [], out, live=False))


@app.command()
def run(
    scene: Scene,
    overrides: Overrides = [],  # noqa: B006 (typer copies it)
    seed: Annotated[int | None, option("Seed of all random numbers.", min=0)] = None,
    out: RunOut = None,
    live: Annotated[bool, option("Show the survey in Rerun while it runs.", flag="--live")] = False,
    resume: Resume = False,
    checkpoint_s: CheckpointS = None,
    as_json: MetricsJson = False,
    extrapolate: Extrapolate = False,
    allow_plugins: AllowPlugins = False,
) -> None:
    """Run one survey and write its folder: map, trajectories, report, recording, metrics.

    With --resume, SCENE may be the folder of the survey that was killed.
    """
    options = ([] if seed is None else [f"seed={seed}"]) + (["imaging.extrapolate=true"] if extrapolate else [])
    _conclude(_run_survey(scene, overrides + options, out, live, allow_plugins, resume, checkpoint_s), as_json)


@app.command()
def render(
    scene: Scene,
    poses: Annotated[Path, option("Poses of the left camera in the world, with times: TUM.", "FILE")],
    overrides: Overrides = [],  # noqa: B006 (typer copies it)
    out: RunOut = None,
    allow_plugins: AllowPlugins = False,
) -> None:
    """Render stereo images and truth along a path, at the frame rate of the rig, for `twin export`."""
    from twin.exports.rendered_path import render_path

    scenario = api.load_scenario(scene, overrides, allow_plugins)
    folder = outputs.run_folder(scenario) if out is None else outputs.new_folder(out)
    with console.replay_bar() as progress:
        n = render_path(scenario, poses, folder, lambda share: progress("render", share))
    print(f"{n} stereo pairs: {folder / 'frames'}\nExact truth and data sets: twin export {folder} --list")


@app.command()
def plan(
    scene: Scene,
    overrides: Overrides = [],  # noqa: B006 (typer copies it)
    out: Annotated[Path | None, option("PNG to write. Default: runs/NAME-plan.png.")] = None,
    as_json: Annotated[bool, option("Print only the predicted properties, as JSON.", flag="--json")] = False,
    strict: Annotated[
        bool, option("Exit with status 1 if a requirement is expected to be missed.", flag="--strict")
    ] = False,
    allow_plugins: AllowPlugins = False,
) -> None:
    """Print the predicted properties of a survey plan over its floor and draw the plan, without simulation."""
    from twin.planning import summary as plan_summary

    scenario = api.load_scenario(scene, overrides, allow_plugins)
    file = out or Path(f"runs/{outputs.file_stem(scenario.name)}-plan.png")
    summary = api.plan(scenario, file)
    if as_json:
        print(json.dumps(plan_summary.as_json(summary, str(file)), indent=1))
    else:
        console.print_plan(summary)
        print(f"Picture: {file}")
    raise typer.Exit(1 if strict and not summary.meets_requirements else 0)


@app.command()
def vehicle(
    scene: Scene,
    overrides: Overrides = [],  # noqa: B006 (typer copies it)
    out: Annotated[Path | None, option("PNG to write. Default: runs/NAME-vehicle.png.")] = None,
    as_json: Annotated[bool, option("Print only the limits, as JSON.", flag="--json")] = False,
    allow_plugins: AllowPlugins = False,
) -> None:
    """Print trim, speeds, stopping distance, endurance and limits of a vehicle, and draw them, without simulation."""
    from twin.planning import vehicle_limits

    scenario = api.load_scenario(scene, overrides, allow_plugins)
    file = out or Path(f"runs/{outputs.file_stem(scenario.name)}-vehicle.png")
    limits = api.vehicle(scenario, file)
    tree, table = vehicle_limits.as_json(limits, str(file)), vehicle_limits.rows(limits)
    _show(as_json, tree, [(f"Vehicle of {scenario.name}: {limits.title}", table)], f"Picture: {file}")


@app.command()
def look(
    scene: Scene,
    overrides: Overrides = [],  # noqa: B006 (typer copies it)
    at: Annotated[
        str | None, option("Position of the left camera \\[m]. Default: centre of the survey.", "X,Y,Z")
    ] = None,
    twist: Annotated[
        str | None,
        option(
            "Velocity of the vehicle during the exposure: forward, left, up \\[m/s], and about these axes "
            "\\[deg/s]. Default: at rest.",
            "VX,VY,VZ,WX,WY,WZ",
        ),
    ] = None,
    out: Annotated[Path | None, option("PNG to write. Default: runs/NAME-look.png.")] = None,
    as_json: SummaryJson = False,
    allow_plugins: AllowPlugins = False,
) -> None:
    """Render the stereo pair at one position, draw its light components on one sheet, and print the image quality."""
    from twin.app import look as viewing

    position_m = None if at is None else viewing.parse_position(at)
    twist_body = None if twist is None else viewing.parse_twist(twist)
    scenario = api.load_scenario(scene, overrides, allow_plugins)
    file = out or Path(f"runs/{outputs.file_stem(scenario.name)}-look.png")
    quality = viewing.image_quality(api.look(scenario, position_m, file, twist_body=twist_body))
    tree = {"name": scenario.name, "sheet": str(file)} | quality
    _show(as_json, tree, [(f"View of {scenario.name}", viewing.quality_rows(quality))], f"Sheet: {file}")


@reproductions.command()
def turbidity(out: OutFolder = Path("runs/turbidity"), as_json: SummaryJson = False) -> None:
    """Render a block at five turbidities (Fig. 8 of Negahdaripour & Madjidi 2003) and plot contrast versus range."""
    from twin.reproduce import turbidity as experiment

    with _results_folder(out, "turbidity.png"):
        summary = experiment.write(experiment.render_levels(), out)
    title = f"Block at {summary['range_m']:.2f} m in green light"
    _show(as_json, summary, [(title, experiment.table(summary))], f"Sheet: {out / 'turbidity.png'}")


@reproductions.command()
def light(
    out: OutFolder = Path("runs/light"),
    quick: Quick = False,
    walks: Annotated[int, option("Largest number of random walks for a value of light.", min=64)] = 1_500_000,
    phase: Annotated[str, option(
        "Phase function for lamps, in model and reference: a value of water.phase_function.")] = "sea",
    as_json: SummaryJson = False,
) -> None:  # fmt: skip
    """Compare the light of lamps and sun in the images with a Monte Carlo simulation of any order of scattering."""
    from twin.reproduce.light import compare

    outputs.output_file(out / "light.png")
    found = compare(quick, walks, phase)
    with sole_writer(out, used=True), outputs.writing(out):
        summary = found.write(out)
    titles = "Light model", "Relief, light model", "Daylight, light model"
    tables = [
        (f"{title} and reference, green band", list(table.rows))
        for title, table in zip(titles, found.tables, strict=True)
    ]
    _show(as_json, summary, tables, f"Sheet: {out / 'light.png'}")


def _add_experiment(name: str, folder: str, text: str) -> None:
    @reproductions.command(name, help=text)
    def command(out: OutFolder = Path("runs") / folder, quick: Quick = False, as_json: SummaryJson = False) -> None:
        from twin.reproduce.catalogue import EXPERIMENTS

        with _results_folder(out, f"{name}.json"):
            exhibit = EXPERIMENTS[name](out, quick)
        figures = ", ".join(str(out / figure.file) for figure in exhibit.figures)
        tables = [(table.title, list(table.rows)) for table in exhibit.tables]
        _show(as_json, exhibit.as_dict(), tables, f"Figures: {figures}")


for _name, _folder, _text in (
    ("paper", "paper-mission",
     "Fly the paper's mission of 25 tracks with and without alignment (Figs. 4 to 7); takes hours without --quick."),
    ("tank1", "tank1", "Survey objects in a tank with 130 stereo pairs on parallel legs (Figs. 9 and 10)."),
    ("tank2", "tank2",
     "Survey objects in a tank with 61 stereo pairs on two loops that touch at the start (Figs. 11 and 12)."),
    ("budget", "budget",
     "Measure the time of each module and compare it with the paper's budget at 30 Hz (section IV)."),
):  # fmt: skip
    _add_experiment(_name, _folder, _text)


@reproductions.command("all")
def all_experiments(out: OutFolder = Path("runs/reproduce"), quick: Quick = False) -> None:
    """Run all experiments and write one page with every table and figure."""
    from twin.reproduce import catalogue
    from twin.reproduce.exhibit import PAGE_FILE

    with _results_folder(out, PAGE_FILE):
        catalogue.run_all(out, quick, report=console.print_error)
    print(f"Page: {out / PAGE_FILE}")


@reproductions.command()
def chapter(
    file: Annotated[Path, argument("results.json of `twin reproduce all`.", "FILE")],
    page: Annotated[Path | None, option("Markdown page whose chapter is replaced.")] = None,
) -> None:
    """Print the chapter of docs/paper.md that shows the results of `twin reproduce all`, or replace it in a page."""
    from twin.reproduce import exhibit

    exhibits, quick = exhibit.read_all(file)
    if page is None:
        print(exhibit.chapter(exhibits, quick))
        return
    with outputs.writing(page, "--page"):
        exhibit.update_chapter(page, exhibits, quick)


@app.command("fit-surrogate")
def fit_surrogate(
    files: Annotated[list[str] | None, argument(
        "Studies of rendered surveys. Default: the built-in ones.", "FILE")] = None,
    out: Annotated[Path, option(
        "Error model to write (TOML), for the key imaging.error_model.")] = Path("error_model.toml"),
    runs: Annotated[Path, option(
        "Folder of the rendered surveys; finished ones are reused.")] = Path("runs/fit-surrogate"),
    jobs: Jobs = None,
) -> None:  # fmt: skip
    """Fit the error model of the surrogate to rendered surveys; finished surveys are reused."""
    from twin.app import fit_command

    outputs.output_file(out)
    outputs.output_file(runs / "study", "--runs")
    fit_command.run(files or [], out, runs, jobs)


def _add_study_command(name: str, text: str, verify_text: str) -> None:
    """Adds the command `study` or `tune`, which have the same options."""

    @app.command(name, help=text)
    def command(
        file: Annotated[str, argument("Study: a name in scenes/studies/ or the path of a TOML file.", "FILE")],
        out: Annotated[Path | None, option(f"Folder to write. Default: runs/{name}-NAME.")] = None,
        jobs: Jobs = None,
        scheduler: Annotated[str | None, option(
            "Run on the Dask cluster at this address, e.g. tcp://host:8786, or on new SLURM jobs with the word slurm.",
            "ADDRESS")] = None,
        resume: Annotated[bool, option(
            "Run only surveys that are missing in the folder or failed.", flag="--resume")] = False,
        live: Annotated[bool, option("Print a line for each finished survey.", flag="--live")] = False,
        as_json: SummaryJson = False,
        verify: Annotated[int | None, option(verify_text, "N", min=0, max=1000)] = None,
        render_refused: Annotated[bool, option(
            "Fly rendered what only the surrogate refuses. Default: these results are unknown.",
            flag="--render-refused")] = False,
        budget: Annotated[str | None, option(
            "Stop the surveys after this time, e.g. 45m or 2h; --resume continues.", "TIME")] = None,
        extrapolate: Extrapolate = False,
        allow_plugins: AllowPlugins = False,
    ) -> None:  # fmt: skip
        from twin.app import study_command

        options = study_command.StudyOptions(
            out, jobs, scheduler, resume, live, verify, render_refused, budget, extrapolate, allow_plugins
        )
        raise typer.Exit({"study": study_command.study, "tune": study_command.tune}[name](file, options, as_json))


_add_study_command(
    "study",
    "Run the surveys of a study and estimate the probability that a survey meets the requirements.",
    "Also fly rendered surveys for the N surrogate surveys closest to the limits. Default: none.",
)
_add_study_command(
    "tune",
    "Optimise the plan as the tune section of a study defines it, and write the recommended plan as a scenario.",
    "Most rendered surveys of a plan; 0: none, and no plan is recommended. Default: tune.verify of the study.",
)


@app.command()
def replay(
    dataset: Annotated[Path, argument(
        "Stereo data set: EuRoC/ASL, KITTI, left/ and right/, or a ROS 2 bag (MCAP, db3).", "DATASET")],
    calibration: Annotated[Path | None, option(
        "OpenCV, Kalibr, ROS, ORB-SLAM3, or COLMAP cameras.txt.", "FILE")] = None,
    truth: Annotated[Path | None, option(
        "True poses, only for the comparison: TUM, KITTI or EuRoC; or the topic of a ROS 2 bag that has them.",
        "FILE|TOPIC")] = None,
    align: Annotated[str, option(
        "Alignment with the truth before the comparison: first, se3 or none.", "NAME")] = "first",
    bayer: Annotated[str | None, option("Raw images: RGGB, GRBG, GBRG or BGGR.", "PATTERN")] = None,
    out: Annotated[Path | None, option("Folder to write (--preview: PNG). Default: runs/NAME-replay.")] = None,
    preview: Annotated[bool, option(
        "Only draw the first stereo pair: matches, disparity, light before and after.", flag="--preview")] = False,
    topics: Annotated[str | None, option(
        "Image topics of a ROS 2 bag. Default: its only stereo pair.", "LEFT,RIGHT")] = None,
    estimator: Annotated[str | None, option(
        "Estimator of another package, module:Class or its entry point. Default: the estimators of the twin.",
        "NAME")] = None,
    aiding: Annotated[bool, option(
        "Use recorded readings of pressure, attitude and DVL.", flag="--aiding/--no-aiding")] = True,
    imu: Annotated[bool, option(
        "Predict the motion between frames by the recorded IMU, which is at the origin of the body.")] = False,
    true_map: Annotated[Path | None, option(
        "True heights in the frame of the true poses (GeoTIFF), only for the comparison of the map.", "FILE")] = None,
    rotation_sigma: Annotated[float | None, option(
        "Standard deviation of the rotation between the cameras since the calibration; estimates the yaw.",
        "DEG")] = None,
    frames: Annotated[str | None, option(
        "Frames of the data set to use, numbered from 0. Default: all.", "FIRST:END[:STEP]")] = None,
    baseline_sigma: Annotated[float | None, option(
        "The same of the distance between the cameras; estimates the baseline.", "MM")] = None,
    baseline: Annotated[float | None, option("Distance between the cameras. Default: the calibration's.", "M")] = None,
    field: Annotated[float | None, option("Horizontal field of view of the rectified images.", "DEG")] = None,
    resume: Resume = False,
    checkpoint_s: CheckpointS = None,
    as_json: MetricsJson = False,
    allow_plugins: AllowPlugins = False,
) -> None:  # fmt: skip
    """Run the estimators on recorded stereo images and write a run folder: map, trajectories, report, recording."""
    from twin.recordings import replay as recorded
    from twin.scenario.file import plugin_error

    if estimator is not None and ":" in estimator and not allow_plugins:
        raise plugin_error("--estimator", estimator, "estimators")
    options = recorded.ReplayOptions(
        calibration, truth, recorded.alignment_name(align), recorded.bayer_pattern(bayer),
        topics=recorded.image_topics(topics), estimator=estimator, aiding=aiding, true_map=true_map,
        rotation_sigma_deg=rotation_sigma, baseline_sigma_mm=baseline_sigma, imu=imu,
        frames=recorded.frame_numbers(frames), baseline_m=baseline, fov_deg=field,
    )  # fmt: skip
    name = outputs.file_stem(resolved(dataset).name)
    if preview:
        _preview(dataset, options, outputs.output_file(out or Path(f"runs/{name}-preview.png")))
        return
    folder = out or Path("runs") / f"{name}-replay"
    folder = outputs.new_folder(folder, used=resume) if out or resume else outputs.unused_folder(folder)
    with console.replay_bar() as progress:
        result = recorded.replay(dataset, folder, options, progress, resume, checkpoint_s)
    _conclude(result, as_json)


def _preview(dataset: Path, options: Any, file: Path) -> None:
    from twin.recordings import preview as previewing
    from twin.recordings import replay as recorded

    if file.suffix.lower() not in (".png", ""):
        raise TwinError("--out", f"{file.suffix[:20]!r} is not the suffix of a sheet", ".png")
    opened = recorded.open_dataset(dataset, options)
    light = previewing.light_of(opened)
    with outputs.writing(file):
        previewing.draw(opened, light, file)
    _show(False, None, [(f"First pair of {opened.name}", previewing.rows(opened, light))], f"Sheet: {file}")


@app.command()
def report(folder: RunFolder) -> None:
    """Write the report of a run again, from the files in its folder."""
    from twin.report.survey_page import write_report

    with outputs.writing(folder, "RUN"):
        print(f"Report: {write_report(folder)}")


@app.command()
def compare(
    folders: Annotated[list[Path], argument("Folders of two to eight runs.", "RUN...")],
    out: Annotated[Path, option("HTML page to write.")] = Path("runs/compare.html"),
    as_json: SummaryJson = False,
) -> None:
    """Compare runs: a table of metrics with differences from the first run, overlaid curves, one HTML page."""
    from twin.report import run_comparison

    runs = run_comparison.load_runs(folders)
    file = outputs.output_file(out)
    with outputs.writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(run_comparison.render(runs), encoding="utf-8")
    _show(as_json, run_comparison.as_json(runs), [("Comparison", run_comparison.text_rows(runs))], f"Page: {file}")


@app.command()
def products(
    folder: RunFolder,
    level_m: Annotated[float | None, option("Height of the lower plane.", "M", "--level", min=-1e5, max=1e5)] = None,
    out: Annotated[Path | None, option("Folder to write. Default: RUN/products.")] = None,
    as_json: SummaryJson = False,
) -> None:
    """Compute rugosity, slope, area and volume of a run's map, with their uncertainty: page, JSON file and GeoTIFFs."""
    from twin.products.pages import products_of

    _write_results(products_of(folder, level_m), out or folder / "products", as_json)


@app.command()
def change(
    first: Annotated[Path, argument("Folder of the earlier run.", "RUN1")],
    second: Annotated[Path, argument("Folder of the later run.", "RUN2")],
    scale_m: Annotated[float, option("Size of changes to look for.", "M", "--scale", min=0.001, max=1000)] = 0.2,
    out: Annotated[Path, option("Folder to write.")] = Path("runs/change"),
    as_json: SummaryJson = False,
) -> None:
    """Find what has changed between two surveys of one scene, and from what size on a change would be found."""
    from twin.products.pages import change_of

    _write_results(change_of(first, second, scale_m), out, as_json)


@app.command()
def view(
    folder: RunFolder,
    web: Annotated[bool, option("Show it in a browser of this machine until Ctrl-C.", flag="--web")] = False,
) -> None:
    """Open the recording of a run in Rerun."""
    from twin.report.recording import open_viewer

    with outputs.writing(folder, "RUN"):
        raise typer.Exit(open_viewer(folder, web))


@app.command("new-plugin")
def new_plugin(
    kind: Annotated[str, argument("controller, estimator, terrain or reader.", "KIND")],
    folder: Annotated[Path, argument("New folder; names the package.", "DIR")],
) -> None:
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
    source: Annotated[
        str | None, argument("Folder of a run; a scenario for the formats of its planned path.", "RUN|SCENE")
    ] = None,
    to: Annotated[list[str], option("Format to write; repeatable, or separated by commas.", "FORMAT")] = [],  # noqa: B006 (typer copies it)
    overrides: Overrides = [],  # noqa: B006 (typer copies it)
    out: Annotated[Path | None, option("Folder to write. Default: RUN/export; for a scenario, runs.")] = None,
    crs: Annotated[str | None, option("CRS of the exported coordinates, as in EPSG:32633.")] = None,
    origin: Annotated[
        str | None, option("Scene origin in --crs; H is its elevation \\[m], by default 0.", "E,N,H")
    ] = None,
    jpeg: Annotated[int | None, option("Write images as JPEG of this quality, 1 to 100.", "QUALITY")] = None,
    show_list: Annotated[bool, option("List the formats.", flag="--list")] = False,
    allow_plugins: AllowPlugins = False,
) -> None:
    """Write a run, or the planned path of a scenario, in the formats of other programs."""
    from twin.exports import command as export_command

    if show_list:
        console.print_table("Formats of twin export", export_command.format_rows())
        return
    if source is None:
        raise TwinError("RUN", "is missing", "the folder of a run, a scenario, or --list")
    options = export_command.ExportOptions(crs, origin, jpeg, allow_plugins)
    with console.replay_bar() as progress:
        warnings: list[str] = []
        written = export_command.export_any(source, to, out, overrides, options, progress, warnings.append)
    for warning in warnings:
        print(f"Warning: {warning}", file=sys.stderr)
    for name, paths in written.items():
        print(f"{name}: {', '.join(map(str, paths))}")


@app.command()
def bench(
    full: Annotated[bool, option("Also larger images, four scenes and memory.", flag="--full")] = False,
    against: Annotated[Path | None, option("Accepted values (TOML): status 1 if one is exceeded.", "FILE")] = None,
    as_json: Annotated[bool, option("Print only the rows, as JSON.", flag="--json")] = False,
) -> None:
    """Measure the cost of each stage as a ratio to that of the best library call or limit, side by side."""
    from twin.bench import report as benchmark

    accepted = against and benchmark.read_accepted(against)
    with console.replay_bar() as progress:
        rows = benchmark.measure(full, progress)
    problems = accepted.problems(rows) if accepted else []
    _show(as_json, benchmark.as_json(rows, problems), [("Benchmark", benchmark.table(rows))], "\n".join(problems))
    raise typer.Exit(1 if problems else 0)


@app.command()
def doctor() -> None:
    """Check packages and disk, and print how to fix a failure."""
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


def exit_status(result: "RunResult | ReplayResult") -> int:
    """Returns exit status 130 if interrupted; 1 if otherwise aborted, degraded, or missing a requirement; else 0."""
    if result.status == "aborted" and result.metrics["reason"].startswith("interrupted"):
        return INTERRUPTED
    missed = [r for r in result.metrics["require"].values() if not r["passed"]]
    return 1 if result.status != "complete" or missed else 0


def _run_survey(
    scene: str | Path, overrides: list[str], out: Path | None, live: bool, allow_plugins: bool = False,
    resume: bool = False, checkpoint_s: float | None = None,
) -> "RunResult":  # fmt: skip
    if resume:
        scene, out = outputs.resumed(scene, out)
    scenario = api.load_scenario(scene, overrides, allow_plugins)
    from twin import survey  # imported here because it takes half a second

    # last, because two surveys that begin at once must find different folders
    folder = outputs.run_folder(scenario, resume) if out is None else outputs.new_folder(out, used=resume)
    console.note_first_use(scenario.imaging.fidelity)
    with console.progress_bar() as progress:
        return survey.run(scenario, folder, progress, live, resume=resume, checkpoint_s=checkpoint_s)


def _conclude(result: "RunResult | ReplayResult", as_json: bool = False) -> NoReturn:
    if as_json:
        print(json.dumps(result.metrics, indent=1))
    else:
        console.print_metrics(result.metrics)
        console.print_outputs(result.folder)
    raise typer.Exit(exit_status(result))


def _show(as_json: bool, tree: Any, tables: Iterable[tuple[str, list[tuple[str, ...]]]], last_line: str) -> None:
    if as_json:
        print(json.dumps(tree, indent=1))
        return
    for title, rows in tables:
        console.print_table(title, rows)
    print(last_line)


def _write_results(results: "Results", folder: Path, as_json: bool) -> None:
    from twin.report.html import lines_of

    with _results_folder(folder, f"{results.name}.html"):
        page = results.write(folder)
    _show(as_json, results.tree, [], f"{lines_of(results.paragraphs)}\nPage: {page}")


@contextmanager
def _results_folder(out: Path, file: str) -> Iterator[None]:
    """Locks a folder while results are written to it; checks the path of their main file before."""
    outputs.output_file(out / file)
    with sole_writer(out, used=True), outputs.writing(out):
        yield
