"""Formats of `twin export`: the table of all formats, and the checks of a request."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from twin.errors import TwinError
from twin.exchange.export_format import ExportFormat
from twin.exchange.image_formats import IMAGE_FORMATS
from twin.exchange.map_formats import MAP_FORMATS
from twin.exchange.run_contents import POSES, RunContents

#: All formats by name, in the order in which `twin export --list` shows them.
FORMATS: dict[str, ExportFormat] = IMAGE_FORMATS | MAP_FORMATS

_MISSING = {
    "images": ("has no images", 'a run of a scenario with record = "all" (every frame) or "keyframes"'),
    "pairs": ("has no stereo pairs", 'a run of a scenario with record = "all" or "keyframes"'),
    "poses": ("has neither a true nor a final trajectory", "a run with trajectory_truth.tum or trajectory_final.tum"),
    "map": ("has no elevation map", "a run with dem.tif"),
    "truth": ("has no true trajectory", "a simulated run, or a replay with --truth"),
    "world": (
        "has no simulated world or no frames/truth.npz",
        "a run of `twin run` with rendered images, whose record is not none",
    ),
}


def chosen_formats(names: Sequence[str]) -> list[str]:
    """Returns the names of the requested formats without repetitions.

    Each element of `names` is the name of a format, or several names separated by commas.

    Raises:
        TwinError: a name is unknown, or no format is named.
    """
    parts = [part.strip() for name in names for part in name.split(",") if part.strip()]
    for part in parts:
        if part not in FORMATS:
            close = difflib.get_close_matches(part, FORMATS, 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise TwinError("--to", f"{part[:40]!r} is not a format{hint}", ", ".join(FORMATS))
    if not parts:
        raise TwinError("--to", "is missing", ", ".join(FORMATS))
    return list(dict.fromkeys(parts))


def check_needs(name: str, contents: RunContents) -> None:
    """Raises TwinError if the run lacks contents that the format called `name` needs."""
    has = {
        "images": bool(contents.frames),
        "pairs": bool(contents.pairs),
        "poses": not contents.trajectories.keys().isdisjoint(POSES),
        "map": contents.elevation is not None,
        "truth": "truth" in contents.trajectories,
        "world": contents.true_layers is not None,
    }
    for need in sorted(FORMATS[name].needs):
        if not has[need]:
            problem, allowed = _MISSING[need]
            raise TwinError(f"--to {name}", f"{contents.folder} {problem}", allowed)
