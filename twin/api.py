"""The public functions of the package, each of which does what the command of its name does.

A scene is a name in scenes/, a file, or a `Scenario`. Values of its keys are set by sections, as in
`twin.run("reef", plan={"tracks": 1}, seed=3)`, by a mapping of dotted keys, or by strings `key=value`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin.errors import ScenarioError, SurveyAborted, TwinError

if TYPE_CHECKING:
    from twin.app.look import ViewLayers
    from twin.core.geometry import Array
    from twin.planning.summary import PlanSummary
    from twin.planning.vehicle_limits import VehicleLimits
    from twin.recordings.replay import ReplayOptions, ReplayResult
    from twin.report.run_result import RunResult
    from twin.scenario.model import Scenario
    from twin.studies.runner import StudyResult
    from twin.tuning.rounds import TuningResult

Overrides = Sequence[str] | Mapping[str, Any]


def load_scenario(
    path: str | Path, overrides: Overrides = (), allow_plugins: bool = False, **sections: Any
) -> Scenario:
    """Returns the validated scenario of a file.

    Args:
        path: a TOML file, or the name of a scenario in scenes/.
        overrides: values that replace those of the file: strings `key=value`, or a mapping of dotted keys.
        allow_plugins: whether a plug-in may be named as module:Class, which runs code of any module that can be
            imported; the names of installed entry points are always allowed.
        sections: sections or top-level keys with their values, e.g. `plan={"tracks": 1}, seed=3`.

    Raises:
        ScenarioError: there is no such scenario, or a file or a value is invalid. The message lists the errors of files
            as `FILE:LINE: key: problem (allowed: ...)` and those of overrides in lines that begin with `--set`.
    """
    from twin.scenario.file import load_scenario

    return load_scenario(path, [*_texts(overrides), *_texts(sections)], allow_plugins)


def run(
    scene: str | Path | Scenario, out: str | Path | None = None, overrides: Overrides = (),
    resume: bool = False, checkpoint_s: float | None = None, **sections: Any,
) -> RunResult:  # fmt: skip
    """Runs a survey and writes its run folder; returns status, metrics, trajectories and maps.

    Args:
        out: run folder to write, new or empty; default: the first of runs/NAME-SEED, runs/NAME-SEED-2, ... that is new.
        overrides, sections: values of keys, as in `load_scenario`.
        resume: whether to continue a survey that was killed, from the last checkpoint in its folder, which is `out` or
            `scene` itself. A checkpoint is a pickle, which can run any code: resume only in a folder that you trust.
        checkpoint_s: wall time between checkpoints [s]; 0: none; default: 60, or so much that they take 1 % of the
            time.

    Raises:
        ScenarioError: the survey cannot be carried out as described; nothing was written.
        TwinError: the run folder is not empty, another process writes it, it or metrics.json cannot be written, the
            world cannot be created, or a checkpoint is damaged or belongs to another scenario, file or program.
    """
    from twin import survey
    from twin.app.outputs import resumed, run_folder

    file, folder = scene, None if out is None else Path(out)
    if resume and isinstance(scene, str | Path):
        file, folder = resumed(scene, folder)
    scenario = _scenario(file, overrides, sections)
    return survey.run(scenario, folder or run_folder(scenario, resume), resume=resume, checkpoint_s=checkpoint_s)


def plan(
    scene: str | Path | Scenario, picture: str | Path | None = None, overrides: Overrides = (), **sections: Any
) -> PlanSummary:
    """Returns the predicted properties of a survey's plan over its floor, without a simulation.

    Args:
        picture: PNG file to draw the plan into.
        overrides, sections: values of keys, as in `load_scenario`.

    Raises:
        ScenarioError: the survey cannot be planned as described.
        TwinError: the picture cannot be written.
    """
    from twin.app.outputs import output_file, writing
    from twin.planning import drawing, summary
    from twin.world.mission import prepare

    scenario = _scenario(scene, overrides, sections)
    file = None if picture is None else output_file(Path(picture))
    plan = summary.summarise(prepare(scenario))
    if file is not None:
        with writing(file):
            drawing.draw(plan, file)
    return plan


def vehicle(
    scene: str | Path | Scenario, picture: str | Path | None = None, overrides: Overrides = (), **sections: Any
) -> VehicleLimits:
    """Returns the limits of the vehicle of a scenario, and the energy of its survey, without a simulation.

    Args:
        picture: PNG file to draw speed, power and the greatest current into.
        overrides, sections: values of keys, as in `load_scenario`.

    Raises:
        ScenarioError: the survey cannot be planned as described.
        TwinError: the vehicle is kinematic, its plug-in fails, or the picture cannot be written.
    """
    from twin.app.outputs import output_file, writing
    from twin.planning import drawing, vehicle_limits
    from twin.world.mission import prepare

    scenario = _scenario(scene, overrides, sections)
    if scenario.vehicle.dynamics == "kinematic":
        raise TwinError("vehicle.dynamics", "a kinematic vehicle has no forces", '"rigid"')
    file = None if picture is None else output_file(Path(picture))
    try:
        limits = vehicle_limits.vehicle_limits(prepare(scenario))
    except SurveyAborted as error:  # of a controller of another package
        raise TwinError("vehicle", str(error), "a controller that flies it") from None
    if file is not None:
        with writing(file):
            drawing.draw_vehicle(scenario.vehicle, limits, file)
    return limits


def look(
    scene: str | Path | Scenario, at_m: tuple[float, float, float] | None = None, sheet: str | Path | None = None,
    overrides: Overrides = (), twist_body: Array | None = None, **sections: Any,
) -> ViewLayers:  # fmt: skip
    """Returns the stereo pair at one position, and every layer of light in its left image.

    Args:
        at_m: position of the left camera in the world [m]; default: the centre of the survey area, at its altitude.
        sheet: PNG file to draw all layers into.
        overrides, sections: values of keys, as in `load_scenario`.
        twist_body: (6,) [angular, linear] velocity of the body in its own axes during the exposure [rad/s, m/s];
            default: at rest.

    Raises:
        ScenarioError: the survey cannot be prepared as described.
        TwinError: the position is outside of the terrain or below it, the scenario has no exposure time for the
            velocity, the sheet cannot be written, or this machine cannot render.
    """
    from twin.app import look_sheet
    from twin.app.look import render_view
    from twin.app.outputs import output_file, writing
    from twin.world.mission import prepare

    scenario = _scenario(scene, overrides, sections)
    file = None if sheet is None else output_file(Path(sheet))
    view = render_view(prepare(scenario), at_m, twist_body)
    if file is not None:
        with writing(file):
            look_sheet.draw(scenario, view, file)
    return view


def load_run(folder: str | Path) -> RunResult:
    """Returns a finished survey from its run folder; raises TwinError if it is none, damaged, or not finished."""
    from twin.report.run_result import RunResult

    return RunResult.of_folder(folder)


def compare(*runs: str | Path | RunResult) -> dict[str, Any]:
    """Returns metrics side by side and the keys that differ in the scenarios; raises TwinError if one is not valid."""
    from twin.report import run_comparison

    return run_comparison.as_json(run_comparison.load_runs([_folder(run) for run in runs]))


def map_products(run: str | Path | RunResult, level_m: float | None = None) -> dict[str, Any]:
    """Returns what `twin products --json` prints; `level_m` is that of the volume, by default low; raises TwinError."""
    from twin.products.pages import products_of

    return products_of(_folder(run), level_m).tree


def map_change(first: str | Path | RunResult, second: str | Path | RunResult, scale_m: float = 0.2) -> dict[str, Any]:
    """Returns what `twin change --json` prints, for changes of the size `scale_m`; raises TwinError."""
    from twin.products.pages import change_of

    return change_of(_folder(first), _folder(second), scale_m).tree


def export(run: str | Path | RunResult, formats: str | Sequence[str], out: str | Path | None = None) -> dict[str, Any]:
    """Writes a run, or the planned path of a scenario, in the formats of other programs; returns the files by format.

    Args:
        run: a run or its folder; for the formats of a planned path, also the name or file of a scenario.
        formats: names of formats, as `twin export --list` prints them.
        out: folder to write; default: the folder `export` in the run folder, for a planned path `runs`.

    Raises:
        TwinError: a format is unknown, the run lacks contents that it needs, or a file cannot be written.
    """
    from twin.exports import command

    names = [formats] if isinstance(formats, str) else list(formats)
    return command.export_any(_folder(run), names, None if out is None else Path(out))


def study(
    file: str | Path, out: str | Path, jobs: int | None = None, resume: bool = False, budget: str | None = None
) -> StudyResult:
    """Runs the surveys of a study file and returns their analysis; the folder has tables, figures and a report.

    Args:
        file: study file, or the name of a study in scenes/studies/.
        out: folder to write.
        jobs: number of surveys that run at once; default: one per core.
        resume: run only the surveys whose results are missing in the folder.
        budget: time after which surveys are stopped, e.g. "2h"; default: no limit.

    Raises:
        TwinError: the study is invalid, the budget is too small for one survey, or the folder has other contents or
            cannot be written.
    """
    from twin.app import study_command

    options = study_command.StudyOptions(Path(out), jobs, resume=resume, budget=budget)
    return study_command.fly_study(str(file), options)[0]


def tune(
    file: str | Path, out: str | Path, jobs: int | None = None, resume: bool = False, budget: str | None = None
) -> TuningResult:
    """Searches the plan that a study file asks for; the arguments and errors are those of `study`."""
    from twin.app import study_command

    options = study_command.StudyOptions(Path(out), jobs, resume=resume, budget=budget)
    return study_command.fly_search(str(file), options)[0]


def replay(
    dataset: str | Path, out: str | Path, options: ReplayOptions | None = None,
    resume: bool = False, checkpoint_s: float | None = None,
) -> ReplayResult:  # fmt: skip
    """Runs the estimators on a recorded stereo data set and writes a run folder; see docs/replay.md.

    Args:
        dataset: folder or ROS 2 bag of the data set.
        out: run folder to write, new or empty.
        options: calibration, truth, alignment and settings (`twin.recordings.replay.ReplayOptions`).
        resume: whether to continue a replay that was killed, from the last checkpoint in `out`; as in `run`.
        checkpoint_s: wall time between checkpoints [s], as in `run`.

    Raises:
        TwinError: the data set or one of its files cannot be used (nothing was written), or the run folder is not
            empty, is written by another process, or cannot be written.
    """
    from twin.recordings import replay as recorded

    return recorded.replay(Path(dataset), Path(out), options, resume=resume, checkpoint_s=checkpoint_s)


def _scenario(scene: str | Path | Scenario, overrides: Overrides, sections: Mapping[str, Any]) -> Scenario:
    """Returns a scenario as it is, or loads it; raises TwinError if values are given for a complete `Scenario`."""
    if isinstance(scene, str | Path):
        return load_scenario(scene, overrides, **sections)
    if overrides or sections:
        raise TwinError("scene", "is a Scenario, whose keys are set already", "values with a name or a file only")
    return scene


def _folder(run: str | Path | RunResult) -> Path:
    if not isinstance(run, str | Path) and not hasattr(run, "folder"):
        raise TwinError("run", "is a Scenario", "a run, a folder, or the name or file of a scenario")
    return Path(run) if isinstance(run, str | Path) else run.folder


def _texts(values: Overrides) -> Iterator[str]:
    """Yields values as strings `key=value` with TOML values; arrays and paths become lists and strings."""
    if not isinstance(values, Mapping):
        yield from values
        return
    for key, value in values.items():
        if isinstance(value, Mapping) and value and key != "require":
            yield from _texts({f"{key}.{name}": inner for name, inner in value.items()})
        elif value is not None:
            try:
                yield f"{key}={_toml(value).as_string()}"
            except ValueError as error:
                raise ScenarioError([f"{key}: {error} (allowed: a value of TOML)"]) from None


def _toml(value: Any) -> Any:
    import tomlkit

    if hasattr(value, "tolist"):
        return _toml(value.tolist())
    if isinstance(value, Mapping):
        table = tomlkit.inline_table()
        table.update({str(key): _toml(inner) for key, inner in value.items() if inner is not None})
        return table
    if isinstance(value, list | tuple):
        items = tomlkit.array()
        items.extend(_toml(inner) for inner in value)
        return items
    return tomlkit.item(str(value) if isinstance(value, Path) else value)
