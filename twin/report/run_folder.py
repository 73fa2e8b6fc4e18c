"""Reads a run folder. Only the scenario file is required; a folder without metrics.json is an unfinished survey."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.core.records import Array, Trajectory
from twin.core.user_files import is_file, path_problem, read_json, read_text, reading
from twin.errors import TwinError
from twin.exchange.geotiff import Raster, read_georeference, read_mosaic, read_raster
from twin.judge.recorded import ALIGNMENTS, AlignmentName, recorded_errors
from twin.judge.trajectory_errors import PathErrors, path_errors
from twin.report.run_files import OBSERVATION_KEYS, checked_index, checked_metrics, checked_scenario, conform
from twin.scenario.toml_text import parse_toml

TRAJECTORIES = ("truth", "f2f", "online", "final", "reference")
SCENARIO_FILE = "scenario.resolved.toml"
RASTERS = ("dem", "dem_sigma", "dem_repeatability", "dem_truth", "dem_error")


class Network(NamedTuple):
    positions: Array  # (n, 3) of the nodes in the world [m]
    edges: NDArray[np.int64]  # (m, 2) indices into `positions` of the two nodes of each link


class Keyframes(NamedTuple):
    """Contents of keyframes/index.json."""

    frames: NDArray[np.int64]  # (n,) frame number of each keyframe
    tracks: NDArray[np.int64]  # (n,) track of each keyframe, from 1
    n_frames_per_keyframe: int | None  # planned
    timing_ms: dict[str, Array]  # durations of all calls of some processing stages [ms]
    #: (m, 3) frame number, number of matched points and contrast (NaN without images) of each stereo observation,
    #: including those that gave no keyframe.
    stereo_observations: Array
    map_from_world: Array  # (4, 4) pose of the world in the frame of the maps (`ElevationMap.map_from_world`)
    asked_m2: float | None = None  # size of the asked area; None: not known
    asked_area_m: tuple[Array, ...] = ()  # rings (n, 2) around the asked area and its holes, in the map [m]
    position_cov_m2: Array = np.zeros((0, 3, 3))  # (n, 3, 3) of the final positions in the world; n = 0: not known
    link_residuals: Array = np.zeros(0)  # (m,) normalised residuals of the links; m = 0: not known


@dataclass(frozen=True)
class Run:
    """Contents of a run folder. A missing file is represented by a missing key, an empty table or array, or None."""

    folder: Path
    scenario: dict[str, Any]
    environment: dict[str, Any]
    metrics: dict[str, Any] | None
    trajectories: dict[str, Trajectory]
    rasters: dict[str, Raster]
    network: Network
    keyframes: Keyframes
    georeference: Georeference | None = None

    @property
    def finished(self) -> bool:
        return self.metrics is not None

    @property
    def times_s(self) -> Array:
        """Returns the times (n,) of all frames."""
        return max((path.times_s for path in self.trajectories.values()), key=len, default=np.zeros(0))

    @property
    def alignment(self) -> AlignmentName | None:
        """Returns the alignment of a replay with the recorded truth; None for a survey or without evaluation."""
        name = ((self.metrics or {}).get("replay") or {}).get("alignment")
        return next((allowed for allowed in ALIGNMENTS if allowed == name), None)

    def errors(self, name: str) -> PathErrors:
        """Returns the errors of "f2f", "online" or "final", aligned as the metrics say, or at the first true pose."""
        estimate, truth, alignment = self.trajectories[name], self.trajectories["truth"], self.alignment
        return path_errors(estimate, truth) if alignment is None else recorded_errors(estimate, truth, alignment)

    def image_file(self, frame: int, side: str) -> Path:
        return self.folder / "keyframes" / f"{frame:06d}_{side}.png"

    def frames_with_image(self) -> list[int]:
        return [int(f) for f in self.keyframes.frames if self.image_file(int(f), "left").is_file()]


def load_run(folder: str | Path, metrics: dict[str, Any] | None = None) -> Run:
    """Reads a run folder; `metrics` stand for a metrics.json that does not exist yet; raises TwinError if not valid."""
    folder = Path(folder)
    if problem := path_problem(folder):
        raise TwinError(ascii(str(folder))[1:-1][:200], problem, "the folder of a run")
    if not is_file(folder / SCENARIO_FILE):
        raise TwinError(str(folder), "is not a run folder", f"a folder with {SCENARIO_FILE}, written by `twin run`")
    tasks = sorted(folder.glob("task_[1-9]*"), key=lambda part: (len(part.name), part.name))
    return Run(
        folder,
        _read(folder / SCENARIO_FILE, lambda f: checked_scenario(parse_toml(read_text(f)))),
        _read_json(folder / "env.json", lambda given: conform(given, {})) or {},
        metrics or _read_json(folder / "metrics.json", checked_metrics),
        _read_existing({k: folder / f"trajectory_{k}.tum" for k in TRAJECTORIES}, Trajectory.load),
        _read_existing({k: folder / f"{k}.tif" for k in RASTERS}, read_raster)
        | _read_existing({f"{part.name}/{k}": part / f"{k}.tif" for part in tasks for k in RASTERS}, read_raster)
        | _read_existing({"mosaic": folder / "mosaic.tif"}, read_mosaic),
        _read_existing({"": folder / "posegraph.g2o"}, lambda f: _network(read_text(f))).get("", _network("")),
        _read_keyframes(folder / "keyframes" / "index.json"),
        _read_existing({"": folder / "dem.tif"}, read_georeference).get(""),
    )


def _network(text: str) -> Network:
    lines = [line.split(maxsplit=5) for line in text.splitlines()]
    nodes = [line for line in lines if line and line[0] == "VERTEX_SE3:QUAT"]
    pairs = [line[1:3] for line in lines if line and line[0] == "EDGE_SE3:QUAT"]
    row = {node[1]: k for k, node in enumerate(nodes)}
    positions = np.array([node[2:5] for node in nodes], dtype=float).reshape(-1, 3)
    return Network(positions, np.array([[row[i], row[j]] for i, j in pairs], dtype=np.int64).reshape(-1, 2))


def _read_keyframes(file: Path) -> Keyframes:
    index = _read_json(file, checked_index) or {}
    frames, tracks = (np.array(index.get(key, []), dtype=np.int64) for key in ("frames", "tracks"))
    timing_ms = {stage: np.array(values, dtype=float) for stage, values in index.get("timing_ms", {}).items()}
    rows = [[observation[key] for key in OBSERVATION_KEYS] for observation in index.get("stereo_observations", [])]
    stereo_observations = np.array(rows, float).reshape(-1, 3)
    map_from_world = np.array(index.get("map_from_world", np.eye(4)), float)
    rings = tuple(np.array(ring, float).reshape(-1, 2) for ring in index.get("asked_area_m", []))
    position_cov_m2 = np.array(index.get("position_cov_m2", []), float).reshape(-1, 3, 3)
    return Keyframes(
        frames, tracks, index.get("n_frames_per_keyframe"), timing_ms, stereo_observations, map_from_world,
        index.get("asked_m2"), rings, position_cov_m2, np.array(index.get("link_residuals", []), float),
    )  # fmt: skip


def _read_json(file: Path, checked: Callable[[Any], dict[str, Any]]) -> dict[str, Any] | None:
    return _read(file, lambda f: checked(read_json(f))) if file.is_file() else None


def _read_existing(files: dict[str, Path], reader: Any) -> dict[str, Any]:
    """Returns `reader(file)` for each file that exists and is not empty."""
    return {key: _read(file, reader) for key, file in files.items() if file.is_file() and file.stat().st_size > 0}


def _read(file: Path, reader: Any) -> Any:
    with reading(file, "", "an undamaged file, written by `twin run`"):
        return reader(file)
