"""The run folder on disk: opened before the flight, a log through it, everything else after it, metrics.json last."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Collection
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.records import ElevationMap, SurveyResult, Trajectory, Truth
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.exchange import posegraph
from twin.scenario import file as scenario_file
from twin.world.mission import Mission

PICTURES = ("report", "recording")
_RESERVE_BYTES = 4 * 2**20  # set aside so that a full disk leaves room for trajectories and metrics


class RunFolder:
    """A run's folder and its log (log.jsonl, a JSON object a line). Use as a context manager.

    Args:
        shows: which of `PICTURES` are drawn when all is over; in a study, drawing takes longer than a short flight.
            None: nobody stereo_observations at paths and maps either, and they are not written.

    Raises:
        TwinError: the folder cannot be written.
    """

    def __init__(self, folder: Path, mission: Mission, shows: Collection[str] | None = PICTURES):
        self.path, self._reserve, self._shows = folder, folder / ".reserve", shows
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._log = (folder / "log.jsonl").open("w", encoding="utf-8")
            self._write("scenario.resolved.toml", scenario_file.dump_toml(mission.scenario))
            self._write("env.json", json.dumps(environment(), indent=1))
            self._reserve.write_bytes(bytes(_RESERVE_BYTES))
        except OSError as error:
            raise TwinError("--out", f"{folder} cannot be written: {error}", "a folder with space in it") from None
        self.log("begun", name=mission.scenario.name, seed=mission.scenario.seed)
        if mission.terrain.n_filled:
            self.log("terrain holes filled", cells=mission.terrain.n_filled)

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self._reserve.unlink(missing_ok=True)
        self._log.close()

    def log(self, event: str, **what: Any) -> None:
        """Adds a line; a full disk does not stop the survey here."""
        try:
            self._log.write(json.dumps({"event": event, **what}) + "\n")
            self._log.flush()
        except OSError:
            pass

    def finish(
        self,
        mission: Mission,
        result: SurveyResult,
        elevation: ElevationMap | None,
        truth: Truth,
        watch: Stopwatch,
        metrics: dict[str, Any],
    ) -> dict[str, Any]:
        """Writes all that is left, and returns the metrics as they stand on disk.

        The metrics take their place first and their name last: report and recording are drawn from the folder, and a
        folder without metrics.json is an unfinished run. A full disk makes the survey "aborted".
        """
        self._reserve.unlink(missing_ok=True)
        waiting = ".metrics.json.part"
        self._write(waiting, json.dumps(metrics, indent=1))
        try:
            if self._shows is not None:
                self._write_paths(mission, result, truth, watch)
                self._write_maps(elevation, truth, mission)
                self._draw(self._shows, metrics)
        except OSError as error:
            metrics = metrics | {"status": "aborted", "reason": metrics["reason"] or str(error)}
            self._write(waiting, json.dumps(metrics, indent=1))
        (self.path / waiting).replace(self.path / "metrics.json")
        self.log(metrics["status"], reason=metrics["reason"])
        return metrics

    def _draw(self, shows: Collection[str], metrics: dict[str, Any]) -> None:
        """Report and recording; what draws them is loaded now."""
        if "report" in shows:
            from twin.report import survey_page

            survey_page.write_report(self.path, metrics)
        if "recording" in shows:
            from twin.report import recording

            recording.write_recording(self.path, metrics)

    def _write(self, name: str, text: str) -> None:
        (self.path / name).write_text(text, encoding="utf-8")

    def _write_paths(self, mission: Mission, result: SurveyResult, truth: Truth, watch: Stopwatch) -> None:
        """Trajectories, network and the index of the keyframes."""
        planned = np.tile(mission.start, (len(truth.reference), 1, 1))
        planned[:, :3, 3] = truth.reference
        paths = {"truth": truth.trajectory, "f2f": result.f2f, "online": result.online, "final": result.final}
        for name, path in (paths | {"reference": Trajectory(truth.trajectory.times_s, planned)}).items():
            path.save(self.path / f"trajectory_{name}.tum")
        posegraph.write(self.path / "posegraph.g2o", result)
        index = {
            "frames": result.keyframe_rows.tolist(),
            "tracks": result.track_of_keyframe.tolist(),
            "stereo_observations": [look._asdict() for look in result.stereo_observations],
            "n_frames_per_keyframe": mission.plan.n_frames_per_keyframe,
            "timing_ms": {stage: watch.durations_ms(stage) for stage in ("f2f", "stereo")},
        }
        (self.path / "keyframes").mkdir(exist_ok=True)
        self._write("keyframes/index.json", json.dumps(index))

    def _write_maps(self, elevation: ElevationMap | None, truth: Truth, mission: Mission) -> None:
        from twin.exchange import geotiff, mesh

        geotiff.write_layer(self.path / "dem_truth.tif", truth.height_m, mission.grid, "true elevation [m]")
        if elevation is None:
            return
        geotiff.write_map(self.path, elevation)
        error_m = np.where(truth.seen, elevation.height_m - truth.height_m, np.nan).astype(np.float32)
        geotiff.write_layer(self.path / "dem_error.tif", error_m, mission.grid, "estimated minus true elevation [m]")
        mesh.write_glb(self.path / "mesh.glb", elevation)


@cache
def environment() -> dict[str, str]:
    """What the survey ran on."""
    names = ("mujoco", "numpy", "scipy", "opencv-python-headless", "numba", "rerun-sdk")
    return {
        "twin": version("seabed-twin"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.platform(),
        "cpus": str(os.cpu_count()),
    } | {name: version(name) for name in names}
