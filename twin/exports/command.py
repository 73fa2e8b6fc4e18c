"""The command `twin export`: reads a run from its folder and writes it in the formats of other programs."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.app.outputs import file_stem, new_folder, output_file, writing
from twin.core.georeference import Georeference
from twin.core.output_folder import sole_writer
from twin.core.records import ElevationMap, Image
from twin.datasets.run_contents import POSES, RecordedFrame, RunContents
from twin.errors import TwinError
from twin.exchange import geotiff
from twin.exchange.geotiff import Raster
from twin.exports import path_files
from twin.exports.camera_models import true_calibration
from twin.exports.formats import FORMATS, PATH_FORMATS, check_needs, chosen_formats
from twin.exports.planned_path import planned_path
from twin.exports.recorded_frames import missing_files, recorded_frames, recorded_imu
from twin.report.replay_description import replayed_rig
from twin.report.run_folder import SCENARIO_FILE, Run, load_run
from twin.scenario.file import load_scenario
from twin.world.mission import prepare


class ExportOptions(NamedTuple):
    """Options of an export."""

    crs: str | None = None  #: CRS of the exported coordinates, such as EPSG:32633; None: that of the run
    origin: str | None = None  #: scene origin as text, E,N or E,N,H in the CRS; None: that of the run
    jpeg_quality: int | None = None  #: quality of exported images as JPEG, 1 to 100; None: PNG
    allow_plugins: bool = False  #: run plug-ins that the scenario of the run names as module:Class, for the true layers


def export(
    folder: Path,
    names: Sequence[str],
    out: Path,
    options: ExportOptions = ExportOptions(),  # noqa: B008 (immutable)
    progress: Callable[[str, float], None] = lambda _, __: None,
    warn: Callable[[str], None] = lambda _: None,
) -> dict[str, list[Path]]:
    """Writes a run in several formats, each into the subfolder of `out` with the name of the format; returns the files.

    A subfolder appears when its format is complete; until then its files are in a hidden folder `.FORMAT.partial`,
    which an error or an interrupt removes. `progress` gets the name of a format and the completed fraction of it, 0 to
    1, and `warn` each sentence on a file that is missing in the run folder (`RunContents.notes`).

    Raises TwinError if a format, an option or the run folder is not valid, the run lacks contents that a format needs,
    or a subfolder is not empty or cannot be written; nothing was written. Or a package is missing, an image or the true
    poses are damaged, or a file has the name of the hidden folder; earlier formats were written.
    """
    chosen = chosen_formats(names)
    contents = run_contents(folder, options)
    for name in chosen:
        check_needs(name, contents)
        new_folder(out / name)
    written = {}
    with sole_writer(out, used=True):
        for name in chosen:
            with _completed(out / name) as unfinished:
                files = FORMATS[name].write(replace(contents, progress=partial(progress, name)), unfinished)
            written[name] = [out / name / file.relative_to(unfinished) for file in files]
    for note in contents.notes:
        warn(note)
    return written


@contextmanager
def _completed(folder: Path) -> Iterator[Path]:
    """Yields a hidden folder, which is renamed to `folder` at the end, or removed after an exception."""
    unfinished = folder.with_name(f".{folder.name}.partial")
    if unfinished.is_symlink() or unfinished.is_file():
        raise TwinError("--out", f"{unfinished} is in the way", "a folder without this file")
    if unfinished.exists():  # of an export that was killed
        shutil.rmtree(unfinished)
    unfinished.mkdir(parents=True)
    try:
        yield unfinished
        unfinished.replace(folder)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise


def export_any(
    source: str | Path, names: Sequence[str], out: Path | None, overrides: Sequence[str] = (),
    options: ExportOptions = ExportOptions(),  # noqa: B008 (immutable)
    progress: Callable[[str, float], None] = lambda _, __: None,
    warn: Callable[[str], None] = lambda _: None,
) -> dict[str, list[Path]]:  # fmt: skip
    """Writes a run (`export`), by default into its folder `export`, or the planned path of a scenario or a run.

    The formats decide which. The files of a path are named after the scenario; their folder is by default `runs`.
    Raises TwinError as `export`, or if the survey cannot be planned or has no place on the Earth.
    """
    folder, chosen = Path(source), chosen_formats(names)
    paths = [name for name in chosen if name in PATH_FORMATS]
    target = out or (Path("runs") if paths else folder / "export")
    if paths and paths != chosen:
        raise TwinError("--to", "has formats of a planned path and of a run", f"{', '.join(PATH_FORMATS)}, or others")
    if overrides and not paths:
        raise TwinError("--set", "has no effect on a run, which has been flown", ", ".join(PATH_FORMATS))
    with writing(target):
        if not paths:
            return export(folder, chosen, target, options, progress, warn)
        file = folder / SCENARIO_FILE if folder.is_dir() else source
        mission = prepare(load_scenario(file, overrides, options.allow_plugins))
        path = planned_path(mission, _given_georeference(options) or mission.terrain.georeference)
        files = {name: output_file(target / f"{file_stem(path.name)}{PATH_FORMATS[name][1]}") for name in paths}
        target.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            getattr(path_files, PATH_FORMATS[name][2])(path, file)
        return {name: [file] for name, file in files.items()}


def format_rows() -> list[tuple[str, ...]]:
    return [
        ("format", "contents", "needs"),
        *((name, form.description, ", ".join(sorted(form.needs))) for name, form in FORMATS.items()),
        *((name, description, "a scenario or a run") for name, (description, *_) in PATH_FORMATS.items()),
    ]


def run_contents(folder: Path, options: ExportOptions = ExportOptions()) -> RunContents:  # noqa: B008 (immutable)
    """Returns the contents of a run folder for the writers; raises TwinError if folder or options are not valid."""
    if options.jpeg_quality is not None and not 1 <= options.jpeg_quality <= 100:
        raise TwinError("--jpeg", f"{options.jpeg_quality} is not a quality", "1 to 100")
    run = load_run(folder)
    rig = replayed_rig(run.scenario)
    scenario = None if rig is not None else load_scenario(folder / SCENARIO_FILE, allow_plugins=True)
    rig = rig if scenario is None else scenario.believed_rig()
    assert rig is not None
    rendered = scenario is not None and scenario.imaging.fidelity == "rendered"
    frames = recorded_frames(run)
    _check_poses(run, frames)
    elevation, georeference, dem = _elevation(run), _given_georeference(options), folder / "dem.tif"
    if georeference is None and dem.is_file():
        georeference = geotiff.read_georeference(dem)
    return RunContents(
        folder=folder, name=str(run.scenario.get("name", folder.name)), scenario=run.scenario, rig=rig,
        true=None if scenario is None else true_calibration(scenario), trajectories=run.trajectories, frames=frames,
        imu=None if scenario is None else recorded_imu(folder, scenario), elevation=elevation,
        error_m=_layer(run, "dem_error", elevation),
        true_map=folder / "dem_truth.tif" if "dem_truth" in run.rasters else None,
        orthomosaic=folder / "mosaic.tif" if "mosaic" in run.rasters else None, georeference=georeference,
        jpeg_quality=options.jpeg_quality,
        notes=() if scenario is None else tuple(missing_files(run, scenario, frames)),
        renders_again=rendered and (folder / "frames" / "truth.npz").is_file(), allow_plugins=options.allow_plugins,
    )  # fmt: skip


def _check_poses(run: Run, frames: Sequence[RecordedFrame]) -> None:
    """Raises TwinError unless the true and final trajectories that exist have a pose per frame, at increasing times."""
    needed = max((one.index for one in frames), default=-1) + 1
    for name in POSES:
        if (path := run.trajectories.get(name)) is not None:
            file = str(run.folder / f"trajectory_{name}.tum")
            if len(path) < needed:
                raise TwinError(file, f"has {len(path)} poses", f"{needed}, one per frame")
            times_s = path.times_s
            if not (np.isfinite(times_s).all() and (np.diff(times_s) > 0).all() and (times_s >= 0).all()):
                raise TwinError(file, "has times that do not increase", "an undamaged file, written by `twin run`")


def _given_georeference(options: ExportOptions) -> Georeference | None:
    """Returns the position that --crs and --origin state; None without them; raises TwinError if not valid."""
    if options.origin is None and options.crs is None:
        return None
    if options.origin is None or options.crs is None:
        raise TwinError("--crs", "is given without --origin, or --origin without --crs", "both or none of them")
    try:
        east, north, *height = (float(part) for part in options.origin.split(","))
        if len(height) > 1 or not np.isfinite([east, north, *height]).all():
            raise ValueError
    except ValueError:
        problem = f"{options.origin[:60]!r} is not a position"
        raise TwinError("--origin", problem, "E,N or E,N,H in the CRS, as in 432000,5571000,-35") from None
    return geotiff.georeference_in(options.crs, (east, north, height[0] if height else 0.0))


def _elevation(run: Run) -> ElevationMap | None:
    if "dem" not in run.rasters:
        return None
    grid, height_m = run.rasters["dem"]
    sigma = run.rasters.get("dem_sigma")
    sigma_m = np.full(height_m.shape, np.nan) if sigma is None or sigma.grid != grid else sigma.values
    mosaic = _colours(run.rasters.get("mosaic"), run.rasters["dem"])
    heights = height_m.astype(np.float32), sigma_m.astype(np.float32)
    return ElevationMap(grid, *heights, mosaic, run.keyframes.map_from_world)


def _colours(mosaic: Raster | None, dem: Raster) -> Image:
    """Returns the mean colour (rows, cols, 3) of the orthomosaic over about each cell's area; black without data."""
    if mosaic is None:
        return np.zeros((*dem.values.shape, 3), np.uint8)
    if mosaic.grid == dem.grid:
        return mosaic.values.astype(np.uint8)
    side = max(1, round(dem.grid.cell_m / mosaic.grid.cell_m))
    smooth = cv2.blur(mosaic.values.astype(np.uint8), (side, side))
    x, y = dem.grid.centres()
    cols = np.floor((x - mosaic.grid.west_m) / mosaic.grid.cell_m).astype(int)
    rows = np.floor((mosaic.grid.north_m - y) / mosaic.grid.cell_m).astype(int)
    inside_rows, inside_cols = (rows >= 0) & (rows < mosaic.grid.rows), (cols >= 0) & (cols < mosaic.grid.cols)
    sampled = smooth[np.clip(rows, 0, mosaic.grid.rows - 1)][:, np.clip(cols, 0, mosaic.grid.cols - 1)]
    return np.where((inside_rows[:, None] & inside_cols)[..., None], sampled, np.uint8(0))


def _layer(run: Run, name: str, elevation: ElevationMap | None) -> NDArray[np.float32] | None:
    raster = run.rasters.get(name)
    if raster is None or elevation is None or raster.grid != elevation.grid:
        return None
    return raster.values.astype(np.float32)
