"""A finished survey: its metrics, and its trajectories and maps, which are read from the run folder when needed."""

from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twin.core.optional_packages import optional
from twin.core.records import Trajectory
from twin.core.user_files import is_file
from twin.errors import TwinError
from twin.judge.verdict import numbers_of

if TYPE_CHECKING:
    import pandas

    from twin.report.run_folder import Raster, Run

_KEY_FIGURES = (
    ("final position error (RMSE)", "trajectory.final.ate_rmse_m"),
    ("map error (LE90)", "map.le90_m"),
    ("map error of the asked area (LE90)", "map.le90_area_m"),
)


@dataclass(frozen=True)
class RunResult:
    """Outcome of a survey: status ("complete", "degraded" or "aborted"), contents of metrics.json, run folder."""

    status: str
    metrics: dict[str, Any]
    folder: Path

    @classmethod
    def of_folder(cls, folder: str | Path) -> "RunResult":
        """Returns the outcome in a run folder; raises TwinError if it is damaged, unfinished or no run folder."""
        from twin.report.run_folder import load_run  # imported here: it needs rasterio

        run = load_run(folder)
        if run.metrics is None:
            raise TwinError(str(folder), "has no metrics.json: the survey has not finished", "a finished run")
        result = cls(run.metrics["status"], run.metrics, run.folder)
        vars(result)["contents"] = run
        return result

    @classmethod
    def of_finished(cls, folder: Path, description: str) -> "RunResult | None":
        """Returns the outcome of a run that was killed after its end; None if it has not ended.

        Raises TwinError if the finished run is another one: its scenario.resolved.toml is not `description`.
        """
        if not is_file(folder / "metrics.json"):
            return None
        result, file = cls.of_folder(folder), folder / "scenario.resolved.toml"
        if not is_file(file) or file.read_text(encoding="utf-8") != description:
            raise TwinError("--resume", f"{folder} has another run, which is finished", "the folder of the same run")
        return result

    @cached_property
    def contents(self) -> "Run":
        from twin.report.run_folder import load_run

        return load_run(self.folder)

    @property
    def trajectories(self) -> dict[str, Trajectory]:
        """Returns the camera's trajectories in the world: truth, f2f, online, final, reference."""
        return self.contents.trajectories

    @property
    def maps(self) -> "dict[str, Raster]":
        """Returns the maps dem, dem_sigma, dem_truth, dem_error [m] and mosaic; row 0 is the northernmost."""
        return self.contents.rasters

    @property
    def errors_m(self) -> NDArray[np.float64]:
        """Returns the errors (n, 3) [m] of the final camera positions in the world, for the frames of the survey."""
        if not {"final", "truth"} <= self.trajectories.keys():
            raise TwinError(str(self.folder), "has no final or no true trajectory", "a run with both")
        final, truth = self.trajectories["final"], self.trajectories["truth"]
        rows = np.searchsorted(truth.times_s, final.times_s)
        return final.positions - truth.positions[np.minimum(rows, len(truth) - 1)]

    def to_dataframe(self) -> "pandas.DataFrame":
        """Returns time, true, online, final positions, final error [m] by frame, as known; TwinError without pandas."""
        pandas = optional("pandas", "notebook", "to_dataframe")
        paths = {name: self.trajectories[name] for name in ("final", "online", "truth") if name in self.trajectories}
        table = pandas.DataFrame({"time_s": next((path.times_s for path in paths.values()), np.zeros(0))})
        for name in reversed(paths):
            for axis, values in zip("xyz", paths[name].positions.T, strict=True):
                table[f"{name}_{axis}_m"] = pandas.Series(values)
        if {"final", "truth"} <= paths.keys():
            table["error_m"] = np.linalg.norm(self.errors_m, axis=1)
        return table

    def _repr_html_(self) -> str:
        values = [(name, numbers_of(self.metrics).get(metric)) for name, metric in _KEY_FIGURES]
        texts = [(name, "unknown" if value is None else f"{1000 * value:.2f} mm") for name, value in values]
        rows = "".join(f"<tr><td>{name}</td><td>{text}</td></tr>" for name, text in texts)
        warnings = "".join(f"<li>{escape(text)}</li>" for text in self.metrics.get("warnings", ()))
        report = (self.folder / "report.html").absolute()
        link = f'<a href="{report.as_uri()}">report</a>' if report.exists() else ""
        seed = "" if self.metrics["seed"] is None else f", seed {self.metrics['seed']}"
        title = f"{escape(self.metrics['name'])}{seed}: {self.status}"
        return f"<b>{title}</b> {link}<table>{rows}</table><ul>{warnings}</ul>"
