"""Formats of `twin export`, those of `formats.toml` and of the planned path, and the checks of a request."""

import difflib
import tomllib
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from twin.datasets.run_contents import POSES, RunContents
from twin.errors import TwinError


class ExportFormat(NamedTuple):
    """A format of `twin export`."""

    description: str  #: one line for the list of formats
    needs: Sequence[str]  #: contents without which the format cannot be written (`_NEEDS`)
    writer: str  #: module and function, imported when they are called, because writers need large packages

    def write(self, contents: RunContents, folder: Path) -> list[Path]:
        """Writes the contents to an existing folder; returns the files, or the folders with many files."""
        module, function = self.writer.split(":")
        return getattr(import_module(f"twin.{module}"), function)(contents, folder)


#: Formats of the planned path of a scenario: description, suffix, and writer in `path_files`.
PATH_FORMATS = {
    "qgc": ("planned path: mission of QGroundControl for ArduSub", ".plan", "write_qgc"),
    "kml": ("planned path: KML 2.2, a line for each track", ".kml", "write_kml"),
    "gpx": ("planned path: GPX 1.1, a route", ".gpx", "write_gpx"),
    "csv": ("planned path: waypoints in the scene, in its CRS and on WGS 84", ".csv", "write_csv"),
}
_TABLE = tomllib.loads(files("twin.exports").joinpath("formats.toml").read_text(encoding="utf-8"))
FORMATS = {name: ExportFormat(**fields) for name, fields in _TABLE.items()}


#: What a format may need: whether a run has it, the problem of one that has not, and a run that has it.
_NEEDS: dict[str, tuple[Callable[[RunContents], bool], str, str]] = {
    "images": (lambda run: bool(run.frames), "has no images",
               'a run of a scenario with record = "all" (every frame) or "keyframes"'),
    "pairs": (lambda run: bool(run.pairs), "has no stereo pairs",
              'a run of a scenario with record = "all" or "keyframes"'),
    "poses": (lambda run: not run.trajectories.keys().isdisjoint(POSES), "has neither a true nor a final trajectory",
              "a run with trajectory_truth.tum or trajectory_final.tum"),
    "map": (lambda run: run.elevation is not None, "has no elevation map", "a run with dem.tif"),
    "world": (lambda run: run.renders_again, "has no simulated world or no frames/truth.npz",
              "a run of `twin run` with rendered images, whose record is not none"),
}  # fmt: skip


def chosen_formats(names: Sequence[str]) -> list[str]:
    """Returns the formats in names, each once; a name may list several with commas; raises TwinError if unknown."""
    parts = [part.strip() for name in names for part in name.split(",") if part.strip()]
    known = [*FORMATS, *PATH_FORMATS]
    for part in parts:
        if part not in known:
            close = difflib.get_close_matches(part, known, 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise TwinError("--to", f"{part[:40]!r} is not a format{hint}", ", ".join(known))
    if not parts:
        raise TwinError("--to", "is missing", ", ".join(known))
    return list(dict.fromkeys(parts))


def check_needs(name: str, contents: RunContents) -> None:
    for need in sorted(FORMATS[name].needs):
        is_met, problem, allowed = _NEEDS[need]
        if not is_met(contents):
            raise TwinError(f"--to {name}", f"{contents.folder} {problem}", allowed)
