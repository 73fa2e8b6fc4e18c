"""Reads a run folder. Only the scenario file is required; a folder without metrics.json is an unfinished survey."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Trajectory
from twin.core.user_files import is_file, path_problem, read_json, read_text, reading
from twin.errors import TwinError
from twin.exchange.geotiff import Raster, read_mosaic, read_raster
from twin.report.run_files import checked_environment, checked_index, checked_metrics, checked_scenario
from twin.scenario.toml_text import parse_toml

TRAJECTORIES = ("truth", "f2f", "online", "final", "reference")
SCENARIO_FILE = "scenario.resolved.toml"
_OBSERVATION_KEYS = ("row", "n_points", "contrast")  # columns of `Keyframes.stereo_observations`
RASTERS = ("dem", "dem_sigma", "dem_truth", "dem_error")


class Network(NamedTuple):
    """The keyframe network.

    Args:
        positions: (n, 3) positions of the nodes in the world [m].
        edges: (m, 2) indices into `positions` of the two nodes of each link.
    """

    positions: Array
    edges: NDArray[np.int64]


class Keyframes(NamedTuple):
    """Contents of keyframes/index.json.

    Args:
        frames: (n,) frame number of each keyframe.
        tracks: (n,) track of each keyframe, from 1.
        n_frames_per_keyframe: planned frames from one keyframe to the next; None if unknown.
        timing_ms: for some processing stages, the duration of each call in chronological order [ms].
        stereo_observations: (m, 3) frame number, number of matched points and contrast (NaN without images) of each
            stereo observation, including those that gave no keyframe.
        map_from_world: (4, 4) pose of the world in the frame of the maps (`ElevationMap.map_from_world`).
    """

    frames: NDArray[np.int64]
    tracks: NDArray[np.int64]
    n_frames_per_keyframe: int | None
    timing_ms: dict[str, Array]
    stereo_observations: Array
    map_from_world: Array


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

    @property
    def finished(self) -> bool:
        """Returns whether the survey has finished, i.e. has metrics."""
        return self.metrics is not None

    def image_file(self, frame: int, side: str) -> Path:
        """Returns the path of an image of a keyframe; `side` is "left" or "right"."""
        return self.folder / "keyframes" / f"{frame:06d}_{side}.png"

    def frames_with_image(self) -> list[int]:
        """Returns the frame numbers of the keyframes whose left image exists."""
        return [int(f) for f in self.keyframes.frames if self.image_file(int(f), "left").is_file()]


def load_run(folder: str | Path, metrics: dict[str, Any] | None = None) -> Run:
    """Reads a run folder.

    Args:
        folder: the run folder.
        metrics: contents of metrics.json, given while that file does not exist yet; None: read from the file.

    Raises:
        TwinError: `folder` is not a run folder, or one of its files is damaged.
    """
    folder = Path(folder)
    if problem := path_problem(folder):
        raise TwinError(ascii(str(folder))[1:-1][:200], problem, "the folder of a run")
    if not is_file(folder / SCENARIO_FILE):
        raise TwinError(str(folder), "is not a run folder", f"a folder with {SCENARIO_FILE}, written by `twin run`")
    return Run(
        folder,
        _read(folder / SCENARIO_FILE, lambda f: checked_scenario(parse_toml(read_text(f)))),
        _read_json(folder / "env.json", checked_environment) or {},
        metrics or _read_json(folder / "metrics.json", checked_metrics),
        _read_existing({k: folder / f"trajectory_{k}.tum" for k in TRAJECTORIES}, Trajectory.load),
        _read_existing({k: folder / f"{k}.tif" for k in RASTERS}, read_raster)
        | _read_existing({"mosaic": folder / "mosaic.tif"}, read_mosaic),
        _read_existing({"network": folder / "posegraph.g2o"}, read_network).get("network", _empty_network()),
        _read_keyframes(folder / "keyframes" / "index.json"),
    )


def read_network(file: Path) -> Network:
    """Reads the node positions and the edges of a g2o pose graph (SE3:QUAT).

    Raises:
        KeyError: an edge names a node that the file does not contain.
        ValueError: a number or an edge is damaged.
    """
    lines = [line.split() for line in read_text(file).splitlines()]
    nodes = [line for line in lines if line and line[0] == "VERTEX_SE3:QUAT"]
    pairs = [line[1:3] for line in lines if line and line[0] == "EDGE_SE3:QUAT"]
    row = {node[1]: k for k, node in enumerate(nodes)}
    positions = np.array([node[2:5] for node in nodes], dtype=float).reshape(-1, 3)
    return Network(positions, np.array([[row[i], row[j]] for i, j in pairs], dtype=np.int64).reshape(-1, 2))


def _empty_network() -> Network:
    """Returns a network without nodes."""
    return Network(np.zeros((0, 3)), np.zeros((0, 2), dtype=np.int64))


def _read_keyframes(file: Path) -> Keyframes:
    """Reads keyframes/index.json.

    If the file is missing, the arrays are empty, except `map_from_world`, which is the identity.
    """
    index = _read_json(file, checked_index) or {}
    frames, tracks = (np.array(index.get(key, []), dtype=np.int64) for key in ("frames", "tracks"))
    timing_ms = {stage: np.array(values, dtype=float) for stage, values in index.get("timing_ms", {}).items()}
    observations = [
        [observation[key] for key in _OBSERVATION_KEYS] for observation in index.get("stereo_observations", [])
    ]
    stereo_observations = np.array(observations, float).reshape(-1, 3)
    map_from_world = np.array(index.get("map_from_world", np.eye(4)), float)
    return Keyframes(frames, tracks, index.get("n_frames_per_keyframe"), timing_ms, stereo_observations, map_from_world)


def _read_json(file: Path, checked: Callable[[Any], dict[str, Any]]) -> dict[str, Any] | None:
    """Returns the contents of a JSON file, passed through `checked`; None if the file does not exist."""
    return _read(file, lambda f: checked(read_json(f))) if file.is_file() else None


def _read_existing(files: dict[str, Path], reader: Any) -> dict[str, Any]:
    """Returns `reader(file)` for each file that exists and is not empty, by the key of the file."""
    return {key: _read(file, reader) for key, file in files.items() if file.is_file() and file.stat().st_size > 0}


def _read(file: Path, reader: Any) -> Any:
    """Returns `reader(file)`; raises TwinError if the file cannot be read."""
    with reading(file, "", "an undamaged file, written by `twin run`"):
        return reader(file)
