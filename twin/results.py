"""What a survey leaves on disk: the run folder of DESIGN, metrics.json last."""

from __future__ import annotations

import json
import os
import platform
import resource
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twin import config, view
from twin.errors import TwinError
from twin.estimate.map_builder import KeyPointImages, build_map
from twin.estimate.pipeline import Navigator
from twin.exchange import geotiff, mesh, posegraph
from twin.judge.metrics import evaluate
from twin.judge.report import write_report
from twin.mission import Mission
from twin.records import ElevationMap, SurveyResult, Trajectory, Truth
from twin.timing import Stopwatch


class RunResult(NamedTuple):
    """A survey's outcome: "complete" or "aborted", its figures (metrics.json) and its folder."""

    status: str
    metrics: dict[str, Any]
    folder: Path


class Logbook:
    """Opens the run folder and notes what happens in it, a JSON object a line (log.jsonl)."""

    def __init__(self, folder: Path, mission: Mission):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = (folder / "log.jsonl").open("w", encoding="utf-8")
            (folder / "scenario.resolved.toml").write_text(config.dump_toml(mission.scenario), encoding="utf-8")
            (folder / "env.json").write_text(json.dumps(environment(), indent=1), encoding="utf-8")
        except OSError as error:
            raise TwinError("--out", f"{folder} cannot be written: {error}", "a folder with space in it") from None
        self.write("begun", name=mission.scenario.name, seed=mission.scenario.seed, filled=mission.terrain.n_filled)

    def __enter__(self) -> Logbook:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, event: str, **what: Any) -> None:
        """Adds a line; a full disk does not stop the survey here."""
        try:
            self._file.write(json.dumps({"event": event, **what}) + "\n")
            self._file.flush()
        except OSError:
            pass


def environment() -> dict[str, str]:
    """What the survey ran on."""
    names = ("mujoco", "numpy", "scipy", "opencv-python-headless", "numba", "gtsam", "rerun-sdk")
    return {
        "twin": version("seabed-twin"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.platform(),
        "cpus": str(os.cpu_count()),
    } | {name: version(name) for name in names}


def conclude(
    mission: Mission,
    folder: Path,
    navigator: Navigator,
    truth: Truth,
    watch: Stopwatch,
    begun: float,
    reason: str,
    log: Logbook,
    say: Callable[[str, float], None],
) -> RunResult:
    """Final alignment, map, judgement, report and recording; what fails on a full disk is told in `reason`."""
    result = navigator.finish()
    for link in navigator.dropped:
        log.write("link dropped", i=link.i, j=link.j, overlap=link.overlap, points=link.n_points)
    for alignment in result.alignments:
        log.write("aligned", **alignment._asdict())
    elevation = None
    if len(result.key_frames):
        with watch("map"):
            elevation = _map(mission, navigator, result, lambda share: say("map", share))
    wall_s = time.perf_counter() - begun
    status = "aborted" if reason else "complete"
    metrics = _judge(mission, result, elevation, truth, watch, wall_s, status, reason)
    say("report", 0.0)
    try:
        _write_files(mission, folder, result, elevation, truth, watch)
        _finish_folder(folder, metrics)
    except OSError as error:
        status, reason = "aborted", reason or str(error)
        metrics |= {"status": status, "reason": reason}
        _try_metrics(folder, metrics)
    log.write(status, reason=reason)
    return RunResult(status, metrics, folder)


def _map(mission: Mission, navigator: Navigator, result: SurveyResult, say: Callable[[float], None]) -> ElevationMap:
    poses = result.final.world_from_camera[result.key_frames]

    pairs = (KeyPointImages(*navigator.spool.pair(int(row))) for row in result.key_frames)
    return build_map(
        pairs, poses, result.node_cov, mission.rig, mission.grid, progress=lambda k: say(k / len(result.key_frames))
    )


def _judge(mission, result, elevation, truth, watch, wall_s, status, reason) -> dict[str, Any]:
    scenario = mission.scenario
    timing = {
        "wall_s": wall_s,
        "simulated_s": len(result.online) / mission.rig.frame_rate_hz,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "stages": watch.summary(),
    }
    identity = {
        "name": scenario.name,
        "seed": scenario.seed,
        "version": version("seabed-twin"),
        "scenario_hash": scenario.fingerprint(),
        "status": status,
        "reason": reason,
    }
    plan = {"overlap_along": scenario.plan.overlap_along, "overlap_across": scenario.plan.overlap_across}
    return evaluate(result, elevation, truth, mission.rig, plan, timing, identity, scenario.require)


def _write_files(
    mission: Mission,
    folder: Path,
    result: SurveyResult,
    elevation: ElevationMap | None,
    truth: Truth,
    watch: Stopwatch,
) -> None:
    reference = np.tile(mission.start, (len(truth.reference), 1, 1))
    reference[:, :3, 3] = truth.reference
    paths = {"truth": truth.trajectory, "f2f": result.f2f, "online": result.online, "final": result.final}
    for name, path in (paths | {"reference": Trajectory(truth.trajectory.times_s, reference)}).items():
        path.save(folder / f"trajectory_{name}.tum")
    posegraph.write(folder / "posegraph.g2o", result)
    index = {
        "frames": result.key_frames.tolist(),
        "tracks": result.track_of_key.tolist(),
        "n_per_key": mission.plan.n_frames_per_key,
        "timing_ms": {stage: watch.durations_ms(stage) for stage in ("f2f", "stereo")},
    }
    (folder / "keypoints" / "index.json").write_text(json.dumps(index))
    grid = mission.grid
    geotiff.write_layer(folder / "dem_truth.tif", truth.height_m, grid, "true elevation [m]")
    if elevation is not None:
        geotiff.write_map(folder, elevation)
        error_m = np.where(truth.seen, elevation.height_m - truth.height_m, np.nan).astype(np.float32)
        geotiff.write_layer(folder / "dem_error.tif", error_m, grid, "estimated minus true elevation [m]")
        mesh.write_glb(folder / "mesh.glb", elevation)


def _finish_folder(folder: Path, metrics: dict[str, Any]) -> None:
    """The metrics go beside first: report and recording are drawn from the folder; the real file comes last."""
    waiting = folder / ".metrics.json.part"
    waiting.write_text(json.dumps(metrics, indent=1), encoding="utf-8")
    write_report(folder, metrics)
    view.write_recording(folder, metrics)
    waiting.replace(folder / "metrics.json")


def _try_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    try:
        (folder / "metrics.json").write_text(json.dumps(metrics, indent=1), encoding="utf-8")
    except OSError:
        pass
