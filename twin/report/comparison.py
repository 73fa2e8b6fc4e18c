"""Comparison of runs: a table of their metrics with differences, overlaid curves and one HTML page."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from twin.core.user_files import resolved
from twin.errors import TwinError
from twin.judge.require import numbers_of
from twin.report import wording
from twin.report.comparison_figures import RUN_COLOURS, draw_comparison
from twin.report.headline import badge, first_lines
from twin.report.html import render_page
from twin.report.run_folder import Run, load_run

#: Largest number of runs on one page; more curves cannot be told apart.
MOST_RUNS = 8


class ComparedQuantity(NamedTuple):
    """Metric that the comparison of runs shows in one row of its table."""

    name: str  # dotted, in metrics.json
    label: str
    text: Callable[[Any], str]  # returns a value as text, with its unit unless the label has it
    better: str = "less"  # or "more", or "" if neither smaller nor larger values are better


QUANTITIES = (
    ComparedQuantity("trajectory.f2f.ate_rmse_m", "position error, F2F only (RMSE)", wording.length),
    ComparedQuantity("trajectory.online.ate_rmse_m", "position error, online (RMSE)", wording.length),
    ComparedQuantity("trajectory.final.ate_rmse_m", "position error, final (RMSE)", wording.length),
    ComparedQuantity("trajectory.final.ate_max_m", "position error, final (maximum)", wording.length),
    ComparedQuantity("trajectory.final.z_rmse_m", "height error, final (RMSE)", wording.length),
    ComparedQuantity("trajectory.final.heading_rmse_deg", "heading error, final (RMSE)", wording.milliradians),
    ComparedQuantity("consistency.nees_position_mean", "NEES of the positions (mean; 3 is right)", wording.plain, ""),
    ComparedQuantity("map.le90_m", "LE90 of the map", wording.length),
    ComparedQuantity("map.nmad_m", "NMAD of the map", wording.length),
    ComparedQuantity("map.le90_area_m", "LE90 over the asked area", wording.length),
    ComparedQuantity("map.completeness", "completeness, observed floor", wording.percent, "more"),
    ComparedQuantity("map.completeness_area", "completeness, asked area", wording.percent, "more"),
    ComparedQuantity("orthomosaic.ce90_px", "CE90 of the orthomosaic [px]", wording.plain),
    ComparedQuantity("control.cross_track_rmse_m", "cross-track error (RMSE)", wording.length),
    ComparedQuantity("self_check.frames_lost", "frames without measured motion", wording.percent),
    ComparedQuantity("timing.frames", "frames", wording.plain, ""),
    ComparedQuantity("timing.keyframes", "keyframes", wording.plain, ""),
    ComparedQuantity("timing.wall_s", "computing time [s]", wording.plain),
    ComparedQuantity("timing.peak_rss_mb", "peak memory [MiB]", wording.plain),
)


class Cell(NamedTuple):
    """Value of one run in the table, and its difference from that of the first run; None if it is missing.

    `change` is the difference as text, for example "+1.2 mm (+10 %)"; "same" if it is 0; "" if it is None.
    `level` is "good" or "bad" if the value is better or worse than that of the first run; otherwise "".
    """

    value: float | None
    text: str
    difference: float | None = None
    change: str = ""
    level: str = ""


class Row(NamedTuple):
    """One quantity and its cells, one per run."""

    quantity: ComparedQuantity
    cells: list[Cell]


def load_runs(folders: Sequence[Path]) -> list[Run]:
    """Returns the runs in several folders.

    Raises:
        TwinError: there are fewer than two or more than `MOST_RUNS` folders, or one of them is given twice, is not a
            run folder, has a damaged file, or has no metrics.json because its survey is unfinished.
    """
    if not 2 <= len(folders) <= MOST_RUNS:
        raise TwinError("RUN", f"{len(folders)} runs", f"2 to {MOST_RUNS}")
    if len({resolved(folder) for folder in folders}) < len(folders):
        raise TwinError("RUN", "the same folder is given twice", "different folders")
    runs = [load_run(folder) for folder in folders]
    for run in runs:
        if not run.finished:
            raise TwinError(str(run.folder), "has no metrics.json: the survey is unfinished", "a finished run")
    return runs


def names_of(runs: Sequence[Run]) -> list[str]:
    """Returns distinct names of runs: the last parts of the paths of their folders, as few as make them distinct."""
    paths = [resolved(run.folder) for run in runs]
    for n in range(1, max(len(path.parts) for path in paths) + 1):
        names = ["/".join(path.parts[-n:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    raise AssertionError("the folders differ")


def table(runs: Sequence[Run]) -> list[Row]:
    """Returns the rows of all quantities that at least one run has."""
    rows: list[Row] = []
    numbers = [numbers_of(run.metrics or {}) for run in runs]
    for quantity in QUANTITIES:
        first, *others = [one.get(quantity.name) for one in numbers]
        if any(value is not None for value in (first, *others)):
            start = Cell(first, quantity.text(first))
            rows.append(Row(quantity, [start, *(_compared(quantity, value, first) for value in others)]))
    return rows


def scenario_differences(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Returns the keys of the scenario in which the runs differ, with the value in every run as JSON, or a dash."""
    flat = [dict(_flattened(run.scenario)) for run in runs]
    keys = sorted(set().union(*flat))
    texts = {key: [_json(one[key]) if key in one else wording.DASH for one in flat] for key in keys}
    return {key: values for key, values in texts.items() if len(set(values)) > 1}


def notes(differences: Mapping[str, Sequence[str]]) -> list[str]:
    """Returns sentences on the limits of a comparison with these `scenario_differences`."""
    survey = [key for key in differences if key.split(".")[0] in ("seed", "terrain", "objects", "plan")]
    sentences = ["A difference between two surveys is partly due to chance; twin study compares many seeds."]
    if survey:
        sentences.insert(0, f"The runs are surveys of different floors or plans: {', '.join(survey)}.")
    return sentences


def as_json(runs: Sequence[Run]) -> dict[str, Any]:
    """Returns the comparison as JSON: runs, metrics with differences from the first run, scenario differences."""
    metrics = [run.metrics or {} for run in runs]
    return {
        "runs": [
            {"name": name, "folder": str(run.folder), "status": one.get("status"), "reason": one.get("reason")}
            for name, run, one in zip(names_of(runs), runs, metrics, strict=True)
        ],
        "metrics": {
            row.quantity.name: {
                "values": [cell.value for cell in row.cells],
                "differences": [cell.difference for cell in row.cells],
            }
            for row in table(runs)
        },
        "scenario": scenario_differences(runs),
    }


def text_rows(runs: Sequence[Run]) -> list[tuple[str, ...]]:
    """Returns the table as text: names of the runs, their statuses, and one row per quantity with the differences."""
    statuses = [str((run.metrics or {}).get("status")) for run in runs]
    rows = [
        (row.quantity.label, *(f"{cell.text}  {cell.change}".rstrip() for cell in row.cells)) for row in table(runs)
    ]
    return [("", *names_of(runs)), ("status", *statuses), *rows]


def render(runs: Sequence[Run]) -> str:
    """Returns the page of a comparison as HTML."""
    names, differences = names_of(runs), scenario_differences(runs)
    variables = {
        "names": names,
        "colours": RUN_COLOURS[: len(runs)],
        "badges": [badge(run.metrics) for run in runs],
        "first_lines": [first_lines(run.metrics or {}) for run in runs],
        "rows": table(runs),
        "notes": notes(differences),
        "differences": differences,
        "figures": draw_comparison(runs, names),
    }
    return render_page("twin.report", "comparison.html.j2", variables)


def _compared(quantity: ComparedQuantity, value: float | None, first: float | None) -> Cell:
    """Returns the cell of a value that is compared with that of the first run."""
    text = quantity.text(value)
    if value is None or first is None:
        return Cell(value, text)
    difference = value - first
    if difference == 0:
        return Cell(value, text, difference, "same")
    better = {"less": difference < 0, "more": difference > 0}.get(quantity.better)
    level = "" if better is None else "good" if better else "bad"
    change = f"{'+' if difference > 0 else '-'}{quantity.text(abs(difference))}"
    if quantity.text is not wording.percent and first > 0:
        change += f" ({_relative(value / first)})"
    return Cell(value, text, difference, change, level)


def _relative(factor: float) -> str:
    """Returns the ratio of two values as text: as a change in percent, e.g. "+10 %", below 3, otherwise as a factor."""
    return f"{100 * (factor - 1):+.0f} %" if factor < 3 else wording.ratio(factor)


def _flattened(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the dotted keys and the values of nested tables; a list is one value."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flattened(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _json(value: Any) -> str:
    """Returns a value of a scenario as JSON, cut to 80 characters."""
    text = json.dumps(value, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."
