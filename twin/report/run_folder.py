"""Reading a run folder: whatever of it is there; a folder without metrics.json is an unfinished survey."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError

from twin.core.records import Array, MapGrid, StereoObservation, Trajectory
from twin.errors import TwinError

TRAJECTORIES = ("truth", "f2f", "online", "final", "reference")
SCENARIO_FILE = "scenario.resolved.toml"
RASTERS = ("dem", "dem_sigma", "dem_truth", "dem_error", "mosaic")


class Raster(NamedTuple):
    """A map of the run: its grid and values, (rows, cols) with NaN for holes or (rows, cols, 3) RGB."""

    grid: MapGrid
    values: NDArray[Any]


class Network(NamedTuple):
    """The keyframe network: node positions (n, 3) [m], edges (m, 2) as rows of the nodes."""

    positions: Array
    edges: NDArray[np.int64]


class Keyframes(NamedTuple):
    """Keyframes as spooled: frame rows, tracks, frames per keyframe; durations [ms] of stages, call by call.

    Args:
        stereo_observations: (n, 3) frame row, matched points and contrast (NaN without images) of every look with both cameras.
    """

    frames: NDArray[np.int64]
    tracks: NDArray[np.int64]
    n_frames_per_keyframe: int | None
    timing_ms: dict[str, Array]
    stereo_observations: Array


@dataclass(frozen=True)
class Run:
    """What a run folder holds; missing files are missing keys, empty arrays or None."""

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
        return self.metrics is not None

    def image_file(self, frame: int, eye: str) -> Path:
        """The spooled image of a keyframe; eye is "left" or "right"."""
        return self.folder / "keyframes" / f"{frame:06d}_{eye}.png"

    def imaged_frames(self) -> list[int]:
        """Key-point frames whose left image is there."""
        return [int(f) for f in self.keyframes.frames if self.image_file(int(f), "left").is_file()]


def load_run(folder: str | Path, metrics: dict[str, Any] | None = None) -> Run:
    """Reads a run folder; `metrics` stand in for a metrics.json that is still to be written.

    Raises:
        TwinError: it is no run folder, or one of its files is broken.
    """
    folder = Path(folder)
    if not (folder / SCENARIO_FILE).is_file():
        raise TwinError(str(folder), "is no run folder", "a folder with scenario.resolved.toml, as `twin run` writes")
    return Run(
        folder,
        _read(folder / SCENARIO_FILE, lambda f: tomllib.loads(f.read_text(encoding="utf-8"))),
        _read_json(folder / "env.json") or {},
        metrics or _read_json(folder / "metrics.json"),
        _read_present({k: folder / f"trajectory_{k}.tum" for k in TRAJECTORIES}, Trajectory.load),
        _read_present({k: folder / f"{k}.tif" for k in RASTERS}, read_raster),
        _read_present({"it": folder / "posegraph.g2o"}, read_network).get("it", _no_network()),
        _read_keyframes(folder / "keyframes" / "index.json"),
    )


def read_raster(file: Path) -> Raster:
    """A GeoTIFF, row 0 = north; nodata becomes NaN.

    Raises:
        ValueError: its cells are no squares along east and north.
    """
    with rasterio.open(file) as source:
        transform, bands = source.transform, source.read(masked=source.count == 1)
        if transform.b or transform.d or transform.a <= 0 or not np.isclose(transform.a, -transform.e, rtol=1e-6):
            raise ValueError("it is rotated or has oblong cells")
        grid = MapGrid(transform.c, transform.f, transform.a, source.height, source.width)
    if len(bands) == 1:
        return Raster(grid, bands[0].astype(float).filled(np.nan))
    return Raster(grid, np.moveaxis(bands[:3], 0, 2))


def read_network(file: Path) -> Network:
    """Nodes and edges of a g2o pose graph (SE3:QUAT)."""
    lines = [line.split() for line in file.read_text(encoding="utf-8").splitlines()]
    nodes = [line for line in lines if line and line[0] == "VERTEX_SE3:QUAT"]
    pairs = [line[1:3] for line in lines if line and line[0] == "EDGE_SE3:QUAT"]
    row = {node[1]: k for k, node in enumerate(nodes)}
    positions = np.array([node[2:5] for node in nodes], dtype=float).reshape(-1, 3)
    return Network(positions, np.array([[row[i], row[j]] for i, j in pairs], dtype=np.int64).reshape(-1, 2))


def _no_network() -> Network:
    return Network(np.zeros((0, 3)), np.zeros((0, 2), dtype=np.int64))


def _read_keyframes(file: Path) -> Keyframes:
    index = _read_json(file) or {}
    frames, tracks = (np.array(index.get(key, []), dtype=np.int64) for key in ("frames", "tracks"))
    timing_ms = {stage: np.array(values, dtype=float) for stage, values in index.get("timing_ms", {}).items()}
    stereo_observations = [
        [look[key] for key in StereoObservation._fields] for look in index.get("stereo_observations", [])
    ]
    return Keyframes(
        frames,
        tracks,
        index.get("n_frames_per_keyframe"),
        timing_ms,
        np.array(stereo_observations, float).reshape(-1, 3),
    )


def _read_json(file: Path) -> Any:
    return _read(file, lambda f: json.loads(f.read_text(encoding="utf-8"))) if file.is_file() else None


def _read_present(files: dict[str, Path], reader: Any) -> dict[str, Any]:
    """Reads those of the files that are there and hold anything."""
    return {key: _read(file, reader) for key, file in files.items() if file.is_file() and file.stat().st_size > 0}


def _read(file: Path, reader: Any) -> Any:
    try:
        return reader(file)
    except (OSError, ValueError, KeyError, IndexError, RasterioError) as error:
        raise TwinError(str(file), f"cannot be read: {error}", "a file of this run, unharmed") from None
