"""Writes a run folder: scenario and log during the survey, results after the survey, metrics.json last."""

import ctypes
import gc
import json
import os
import platform
import shutil
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import llvmlite.binding
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_info

from twin.core import geometry
from twin.core.checkpoint import FOLDER as CHECKPOINTS
from twin.core.checkpoint import flushed_length, reopened
from twin.core.georeference import Georeference
from twin.core.interrupts import StageGuard
from twin.core.records import Array, ElevationMap, MapGrid, SurveyResult, Trajectory, Truth
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.exchange import posegraph
from twin.judge.metrics import SurveyedTask
from twin.judge.network_errors import motion_residuals
from twin.report.replay_description import RunDescription
from twin.scenario import file as scenario_file
from twin.scenario.model import Scenario

if TYPE_CHECKING:
    from twin.exchange.geotiff import OrthomosaicFile
    from twin.exchange.tiled_map import TiledMapFolder
    from twin.report.run_folder import Run

#: Optional outputs of `RunFolder.finish`: HTML report, Rerun recording.
OPTIONAL_OUTPUTS = ("report", "recording")
#: Glob patterns of the files that each interruptible stage of the writing creates.
_FILES = {"maps": ("*.tif", "task_*/*.tif", "mesh.glb"), "report": ("report.html",), "recording": ("run.rrd",)}
_ERROR_LAYER = "estimated minus true elevation [m]"  # description of the band of dem_error.tif
_LOG = "log.jsonl"
_RESERVE_BYTES = 4 * 2**20  # size of a file deleted before the results are written, to free space on a full disk


class PlannedTruth(NamedTuple):
    """Truth, cells of the maps, and planned initial pose world_from_camera (4, 4) of a simulated survey."""

    truth: Truth
    grid: MapGrid
    start: Array  # its rotation holds for the whole reference path, unless the truth has a planned heading per frame

    def reference(self) -> Trajectory:
        truth = self.truth
        planned = np.tile(self.start, (len(truth.reference), 1, 1))
        planned[:, :3, 3] = truth.reference
        if truth.reference_yaw is not None:
            planned[:, :3, :3] = geometry.rotations_of_down_camera(truth.reference_yaw)
        return Trajectory(truth.trajectory.times_s, planned)


@dataclass(frozen=True)
class SurveyRecord:
    """Results of a survey, complete or aborted, as `RunFolder.finish` writes them."""

    result: SurveyResult
    elevation: ElevationMap | None
    simulated: PlannedTruth | None  # None for recorded data
    n_frames_per_keyframe: int | None  # planned
    stopwatch: Stopwatch
    metrics: dict[str, Any]  # contents of metrics.json
    georeference: Georeference | None = None  # None: rasters are in scene coordinates
    tasks: Sequence[SurveyedTask] = ()  # their maps are written to task_1, task_2, ...
    has_orthomosaic: bool = False  # whether mosaic.tif exists; otherwise it is written with the cells of the map
    recorded_truth: Trajectory | None = None  # of all frames, in the world of the estimates
    recorded_heights_m: NDArray[np.float32] | None = None  # (rows, cols) along the axis of height of the map


class RunFolder(AbstractContextManager["RunFolder"]):
    """Writer of a run folder and its log (log.jsonl, one JSON object per line). Use as a context manager.

    `scenario` is the resolved one, or the description of a run without one; `outputs` are the `OPTIONAL_OUTPUTS` to
    write at the end, None: metrics only. Raises TwinError if the folder cannot be written.
    """

    def __init__(
        self, folder: Path, scenario: Scenario | RunDescription, outputs: Collection[str] | None = OPTIONAL_OUTPUTS
    ):
        self.path, self._reserve, self._outputs = folder, folder / ".reserve", outputs
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._log = (folder / _LOG).open("w", encoding="utf-8")
            if outputs is not None:
                text = scenario.text if isinstance(scenario, RunDescription) else scenario_file.dump_toml(scenario)
                self._write("scenario.resolved.toml", text)
            self._write("env.json", json.dumps(environment(), indent=1))
            self._reserve.write_bytes(bytes(_RESERVE_BYTES))
        except OSError as error:
            shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)
            for name in (self._reserve.name, _LOG, "scenario.resolved.toml", "env.json"):
                with suppress(OSError):
                    (folder / name).unlink()
            raise TwinError("--out", f"{folder} cannot be written: {error}", "a writable folder with space") from None
        self.log("started", time_s=0.0, name=scenario.name, seed=scenario.seed)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_log": flushed_length(self._log)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._log = reopened(self.path / _LOG, state["_log"])
        self._reserve.write_bytes(bytes(_RESERVE_BYTES))

    def __exit__(self, *_: object) -> None:
        self._reserve.unlink(missing_ok=True)
        with suppress(OSError):  # on a full disk, closing repeats a write that failed
            self._log.close()

    def log(self, event: str, **fields: Any) -> None:
        """Adds a line to the log. Write errors (full disk) are ignored, so the survey continues."""
        try:
            self._log.write(json.dumps({"event": event, **fields}) + "\n")
            self._log.flush()
        except OSError:
            pass

    def finish(self, record: SurveyRecord, guard: StageGuard) -> dict[str, Any]:
        """Writes all results, metrics.json last, and returns the metrics as written.

        If a result cannot be written (full disk), the status becomes "aborted". An interrupt while maps, report or
        recording are written ends this stage only (`guard`): its files are deleted, except a finished orthomosaic, and
        the status becomes "aborted" with a reason that names the stage. Raises TwinError if metrics.json cannot be
        written.
        """
        try:
            return self._finish(record, guard)
        except OSError as error:
            problem = f"{self.path / 'metrics.json'} cannot be written: {error.strerror or error}"
            raise TwinError("--out", problem, "a writable folder with space") from None

    def _finish(self, record: SurveyRecord, guard: StageGuard) -> dict[str, Any]:
        metrics = record.metrics
        self._reserve.unlink(missing_ok=True)
        temporary = ".metrics.json.part"
        self._write(temporary, json.dumps(metrics, indent=1))
        try:
            if self._outputs is not None:
                self._write_trajectories(record)
                kept = ("mosaic.tif",) if record.has_orthomosaic else ()
                self._attempt(guard, "maps", lambda: self._write_maps(record), kept)
                from twin.report.run_folder import load_run

                written = cache(lambda: load_run(self.path, metrics))  # read once for both outputs
                for name in OPTIONAL_OUTPUTS:
                    if name in self._outputs:
                        self._attempt(guard, name, lambda name=name: _write_optional_output(name, written()))
        except (OSError, TwinError) as error:  # the latter: a file just written cannot be read
            guard.cause = guard.cause or str(error)
        if guard.reason:
            degraded = f"; {metrics['reason']}" if metrics["status"] == "degraded" else ""
            metrics = metrics | {"status": "aborted", "reason": guard.reason + degraded}
            self._write(temporary, json.dumps(metrics, indent=1))
        self.log(metrics["status"], reason=metrics["reason"])
        (self.path / temporary).replace(self.path / "metrics.json")
        return metrics

    @property
    def writes_maps(self) -> bool:
        return self._outputs is not None

    def orthomosaic_file(
        self, grid: MapGrid, georeference: Georeference | None
    ) -> "AbstractContextManager[OrthomosaicFile | None]":
        """Opens mosaic.tif for the tiles of an orthomosaic; the value of the context is None if no maps are written."""
        from twin.exchange.geotiff import OrthomosaicFile

        return OrthomosaicFile(self.path / "mosaic.tif", grid, georeference) if self.writes_maps else nullcontext()

    def tiled_map(self) -> "TiledMapFolder":
        from twin.exchange.tiled_map import TiledMapFolder

        return TiledMapFolder(self.path / "tiles")

    def _attempt(self, guard: StageGuard, stage: str, write: Callable[[], None], kept: Collection[str] = ()) -> None:
        """Writes the files of a stage (`_FILES`); deletes all but the `kept` ones if an interrupt ends it.

        First, memory that was freed before goes back to the system, where the C library can return it (glibc).
        """
        n_skipped = len(guard.skipped)
        gc.collect()
        with suppress(AttributeError, OSError, TypeError):
            ctypes.CDLL(None).malloc_trim(0)
        guard.attempt(stage, write)
        if len(guard.skipped) > n_skipped:
            for pattern in _FILES[stage]:
                for file in self.path.glob(pattern):
                    if file.relative_to(self.path).as_posix() not in kept:
                        file.unlink()

    def _write(self, name: str, text: str) -> None:
        (self.path / name).write_text(text, encoding="utf-8")

    def _write_trajectories(self, record: SurveyRecord) -> None:
        result = record.result
        paths = {"f2f": result.f2f, "online": result.online, "final": result.final}
        if record.simulated is not None:
            paths |= {"truth": record.simulated.truth.trajectory, "reference": record.simulated.reference()}
        elif record.recorded_truth is not None:
            paths["truth"] = record.recorded_truth
        for name, path in paths.items():
            path.save(self.path / f"trajectory_{name}.tum")
        posegraph.write(self.path / "posegraph.g2o", result)
        index = {
            "frames": result.keyframe_rows.tolist(),
            "tracks": result.track_of_keyframe.tolist(),
            "stereo_observations": [observation._asdict() for observation in result.stereo_observations],
            "n_frames_per_keyframe": record.n_frames_per_keyframe,
            "position_cov_m2": position_cov_m2(result).round(15).tolist(),
            "link_residuals": link_residuals(result).round(4).tolist(),
            "timing_ms": {stage: record.stopwatch.durations_ms(stage) for stage in ("f2f", "stereo")},
        }
        if record.elevation is not None:
            index["map_from_world"] = record.elevation.map_from_world.tolist()
        if record.simulated is not None:
            asked, grid = record.simulated.truth.asked, record.simulated.grid
            index["asked_m2"] = float(asked.sum()) * grid.cell_m**2
            index["asked_area_m"] = [ring.tolist() for ring in rings_around(asked, grid)]
        (self.path / "keyframes").mkdir(exist_ok=True)
        self._write("keyframes/index.json", json.dumps(index))

    def _write_maps(self, record: SurveyRecord) -> None:
        """Writes the rasters of truth, map and error, the mesh, and mosaic.tif if it does not exist yet."""
        from twin.exchange import geotiff, mesh

        elevation, origin = record.elevation, record.georeference
        if record.simulated is not None:
            truth, grid, _ = record.simulated
            geotiff.write_elevations(self.path / "dem_truth.tif", truth.height_m, grid, "true elevation [m]", origin)
            if truth.objects is not None and truth.overhung is not None:
                masks = {
                    "object, 1 + its number; 0: floor": truth.objects,
                    "1: floor below an overhang": truth.overhung,
                }
                geotiff.write_masks(self.path / "objects_truth.tif", masks, grid, origin)
            if elevation is not None:
                geotiff.write_layer(self.path / "dem_error.tif", _error_m(elevation, truth), grid, _ERROR_LAYER, origin)
        for number, task in enumerate(record.tasks, 1):
            if task.elevation is None:
                continue
            folder, cells = self.path / f"task_{number}", task.elevation.grid
            folder.mkdir(exist_ok=True)
            geotiff.write_map(folder, task.elevation, origin)
            geotiff.write_elevations(folder / "dem_truth.tif", task.truth.height_m, cells, "true elevation [m]", origin)
            error_m = _error_m(task.elevation, task.truth)
            geotiff.write_layer(folder / "dem_error.tif", error_m, cells, _ERROR_LAYER, origin)
        if record.recorded_heights_m is not None and elevation is not None:
            grid, true_m = elevation.grid, record.recorded_heights_m
            geotiff.write_elevations(self.path / "dem_truth.tif", true_m, grid, "true elevation [m]")
            geotiff.write_layer(self.path / "dem_error.tif", elevation.height_m - true_m, grid, _ERROR_LAYER)
        if elevation is not None:
            geotiff.write_map(self.path, elevation, origin, mosaic=not record.has_orthomosaic)
            mesh.write_glb(self.path / "mesh.glb", elevation)


def _write_optional_output(name: str, run: "Run") -> None:
    if name == "report":
        from twin.report import survey_page

        survey_page.write_page(run)
    else:
        from twin.report import recording

        recording.record_run(run)


def _error_m(elevation: ElevationMap, truth: Truth) -> NDArray[np.float32]:
    return np.where(truth.seen, elevation.height_m - truth.height_m, np.nan).astype(np.float32)


def position_cov_m2(result: SurveyResult) -> Array:
    """Returns the covariances (n, 3, 3) [m^2] of the final positions of keyframes in the world; 0 if not known."""
    rotation = result.final.world_from_camera[result.keyframe_rows[: len(result.node_cov)], :3, :3]
    cov = np.nan_to_num(result.node_cov[: len(rotation), 3:, 3:], posinf=0, neginf=0)
    return rotation @ cov @ rotation.transpose(0, 2, 1)


def link_residuals(result: SurveyResult) -> Array:
    """Returns the normalised residuals sqrt(r' C^-1 r / 6) (m,) of links; about 1 for consistent covariances.

    r is the residual at the final poses (`motion_residuals`) and C the covariance of the measurement.
    """
    links = result.links
    residuals = motion_residuals(links, result.final.world_from_camera[result.keyframe_rows])
    chi2 = links.shared_by * np.einsum("ni,nij,nj->n", residuals, links.information, residuals)
    return np.sqrt(np.clip(np.nan_to_num(chi2), 0, 1e12) / 6)


def rings_around(cells: NDArray[np.bool_], grid: MapGrid) -> list[Array]:
    """Returns closed rings (n, 2), x and y [m], around the cells (rows, cols) and around holes in them.

    They pass through the centres of the outermost cells.
    """
    found, _ = cv2.findContours(cells.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    corners = [cv2.approxPolyDP(contour, 1.0, True)[:, 0] for contour in found if len(contour) > 2]
    first = np.array([grid.west_m, grid.north_m]) + np.array([0.5, -0.5]) * grid.cell_m
    return [first + np.array([1, -1]) * grid.cell_m * np.vstack([ring, ring[:1]]) for ring in corners]


@cache
def environment() -> dict[str, str]:
    """Returns the contents of env.json: versions of this program, Python and the main packages, and the machine.

    On different processors, or with different kernels of linear algebra (`blas`), results are rounded differently.
    """
    return {
        "twin": version("seabed-twin"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.platform(),
        "cpus": str(os.cpu_count()),
        "processor": llvmlite.binding.get_host_cpu_name(),
        "blas": " ".join(sorted({str(blas.get("architecture")) for blas in threadpool_info()})),
    } | {name: version(name) for name in ("mujoco", "numpy", "scipy", "opencv-python-headless", "numba", "rerun-sdk")}
