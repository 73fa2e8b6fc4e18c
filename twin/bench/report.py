"""The benchmark: all rows and their accepted values."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from pydantic import Field

from twin.bench.measurement import N_ROUNDS, BenchmarkRow, alternate, child_ms, child_ms_and_peak_mb
from twin.bench.plain_renderer import PlainRenderer
from twin.bench.stages import SMALL, stage_rows
from twin.bench.surveys import folder_mb, study_row, surrogate_rows, survey_rows
from twin.core.timing import Stopwatch
from twin.scenario.file import load_scenario, read_toml, validated
from twin.scenario.model import Section, Source
from twin.session.assembly import open_world
from twin.world.mission import prepare

_SIZES = {f"{w}x{h}": (f"rig.image_width_px={w}", f"rig.image_height_px={h}") for w, h in ((320, 240), (640, 480))}
_LARGE = "terrain.size_m=[40.0,40.0]", "terrain.grid_m=0.02"  #: a floor of 2001 x 2001 nodes
_LIBRARIES = "import numpy, scipy.sparse, cv2, numba, pydantic"
_START = {
    "import": (("-c", "import twin.survey"), ("-c", _LIBRARIES), "import of its libraries"),
    "twin --help": (("-m", "twin", "--help"), ("-c", "import typer, rich.console"), "import of typer and rich"),
    "twin plan": (("-m", "twin", "plan", "quickstart"), ("-c", "import twin.survey"), "import of the survey"),
}


class AcceptedValue(Section):
    """Accepted median of a row: the ratio to its floor, or the value if it has none."""

    value: float = Field(ge=0)
    """the median"""
    better: Literal["lower", "higher", "same"] = "lower"
    """side on which there is no limit"""
    tolerance: float = Field(gt=0)
    """largest relative difference from the value"""

    def problem(self, row: BenchmarkRow) -> str:
        """Returns a line that names the row, its median and the limit if that is exceeded, else ""."""
        found, low, high = row.spread[0], self.value * (1 - self.tolerance), self.value * (1 + self.tolerance)
        if (found <= high or self.better == "higher") and (found >= low or self.better == "lower"):
            return ""
        return f"{row.name}: {found:.3g}, limit {high if found > high else low:.3g} (accepted: {self.value:g})"


class AcceptedValues(Section):
    rows: dict[str, AcceptedValue]
    """accepted values by name of the row"""

    def problems(self, rows: Sequence[BenchmarkRow]) -> list[str]:
        """Returns a line for each measured row that exceeds its limit."""
        measured = [row for row in rows if row.name in self.rows and len(row.values)]
        return [problem for row in measured if (problem := self.rows[row.name].problem(row))]


def read_accepted(file: Path) -> AcceptedValues:
    """Returns the accepted values of a TOML file; raises ScenarioError."""
    tree, lines = read_toml(file)
    return validated(tree, AcceptedValues, Source(path=file, lines=lines))


def measure(full: bool, progress: Callable[[str, float], None]) -> list[BenchmarkRow]:
    """Returns all rows; without `full`, those that take a few minutes."""
    parts: dict[str, Callable[[], Sequence[BenchmarkRow]]] = {
        "stages": lambda: stage_rows(partial(progress, "stages")),
        "survey": lambda: survey_rows("reef", "reef", SMALL, N_ROUNDS if full else 3),
        "surrogate": surrogate_rows,
        "processes": lambda: [*map(_start_row, _START), _opening_row("quickstart")],
    }
    if full:
        parts["large images"] = lambda: survey_rows("reef 640x480", "reef", (*SMALL, *_SIZES["640x480"]), N_ROUNDS)
        parts |= {one: partial(survey_rows, one, one, SMALL, 1) for one in ("quickstart", "coral_garden", "paper")}
        parts["opening"] = lambda: [_opening_row("paper"), _opening_row("reef", " 2001x2001", *_LARGE)]
        parts |= {"study": lambda: [study_row("turbidity")], "memory": _process_rows}
    rows = list[BenchmarkRow]()
    for k, (name, part) in enumerate(parts.items()):
        progress(name, k / len(parts))
        rows += part()
    return rows


def _start_row(name: str) -> BenchmarkRow:
    *commands, label = _START[name]
    ours, floor = np.array([[child_ms(*command) for command in commands] for _ in range(N_ROUNDS)]).T
    return BenchmarkRow(name, "ms", ours, label, floor)


def _opening_row(scene: str, size: str = "", *overrides: str) -> BenchmarkRow:
    scenario = load_scenario(scene, overrides)
    mission = prepare(scenario)
    ours, floor = alternate(
        lambda: open_world(prepare(scenario), Stopwatch()),
        lambda: PlainRenderer(mission.terrain, mission.rig).__exit__(),
    )
    return BenchmarkRow(f"opening {scene}{size}", "ms", ours, "mujoco.Renderer of its floor", floor)


def _process_rows() -> list[BenchmarkRow]:
    """Returns the rows of processes that fly small surveys, 25 tracks by the surrogate, and tracks of 2 m."""
    keys, short_tracks = _SIZES["320x240"], ("plan.area_m=[2.0,30.48]", 'record="none"')
    surrogate = _run("paper", *keys, "imaging.fidelity=surrogate", outputs=", outputs=None")
    long, short = (_run("paper", *keys, *short_tracks, f"plan.tracks={n}") for n in (25, 5))
    small = {f"memory of paper {size}": _run("paper", *SMALL, *keys)[1] for size, keys in _SIZES.items()}
    small["memory of reef 2001x2001"] = _run("reef", *SMALL, *_LARGE)[1]
    return [
        *(BenchmarkRow(name, "MB", [peak_mb]) for name, peak_mb in small.items()),
        BenchmarkRow("surrogate, 25 tracks", "ms", surrogate[:1]),
        BenchmarkRow("surrogate, 25 tracks: memory", "MB", surrogate[1:2]),
        BenchmarkRow("25 short tracks: memory", "MB", long[1:2], "5 short tracks", short[1:2]),
        BenchmarkRow("25 short tracks: run folder", "MB", long[2:]),
    ]


def _run(scene: str, *overrides: str, outputs: str = "") -> tuple[float, float, float]:
    """Returns processor time [ms], peak memory and run folder [MB] of a survey, with its report unless `outputs`."""
    with TemporaryDirectory(prefix="twin-") as temporary:
        arguments = f"twin.load_scenario({scene!r}, {[*overrides]}), pathlib.Path({temporary!r}) / 'run'{outputs}"
        use = child_ms_and_peak_mb(f"import pathlib, twin, twin.survey; twin.survey.run({arguments})")
        return *use, folder_mb(Path(temporary))


def table(rows: Sequence[BenchmarkRow]) -> list[tuple[str, ...]]:
    """Returns the rows as text, the header first."""
    text: list[tuple[str, ...]] = [("row", "value", "floor", "ratio", "min to max", "what the floor is")]
    for row in rows:
        values = [f"{np.median(part):.4g} {row.unit}" if len(part) else "" for part in (row.values, row.floors)]
        ratio = [f"{row.spread[0]:.3g}", "{1:.3g} to {2:.3g}".format(*row.spread)] if len(row.floors) else ["", ""]
        text.append((row.name, *values, *ratio, row.floor))
    return text


def as_json(rows: Sequence[BenchmarkRow], problems: Sequence[str]) -> dict[str, Any]:
    found = [{key: np.asarray(value).tolist() for key, value in row._asdict().items()} for row in rows]
    for fields, row in zip(found, rows, strict=True):
        fields["spread"] = dict(zip(("median", "min", "max"), row.spread, strict=False))
    return {"schema": "twin.bench/1", "rows": found, "problems": list(problems)}
