"""Comparison of runs: a table of their metrics with differences, overlaid curves and one HTML page.

Each figure function returns None if no run has the data that its figure shows.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from twin.core.user_files import resolved
from twin.errors import TwinError
from twin.judge.map_error import INFINITE_WITH_HOLES
from twin.judge.verdict import leaves, more_is_better, numbers_of
from twin.report.headline import badge, first_lines
from twin.report.html import render_page, render_paragraphs
from twin.report.number_formats import DASH, is_fraction, metric_value, ratio
from twin.report.plotting import WIDTH_IN, add_coordinates, drawn, legend_beside, log_axis, log_scale, one_panel
from twin.report.run_folder import Run, load_run
from twin.report.style import COLOURS
from twin.report.words import words

#: Largest number of runs on one page; more curves cannot be told apart.
MOST_RUNS = 8
#: Colours of the runs in their order (Okabe & Ito palette, with grey in place of yellow).
RUN_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5d6d76", "#000000")
#: Line styles of the runs: coinciding curves stay visible.
_RUN_STYLES = ("-", "--", "-.", ":") * 2
#: Sections of the scenario that make another survey, of another floor or plan.
_OF_SURVEY = ("seed", "scene_seed", "terrain", "objects", "plan")
#: Runs, each with the style of its curves.
Styled = Sequence[tuple[Run, dict[str, Any]]]


#: Metrics that the table compares, in the order of its rows.
QUANTITIES = (
    "map.le90_area_m", "map.completeness_area", "trajectory.final.ate_rmse_m", "trajectory.f2f.ate_rmse_m",
    "trajectory.online.ate_rmse_m", "trajectory.final.ate_max_m", "trajectory.final.z_rmse_m",
    "trajectory.final.heading_rmse_deg", "consistency.nees_position_mean", "map.le90_m", "map.nmad_m",
    "map.completeness", "orthomosaic.ce90_px", "control.cross_track_rmse_m", "self_check.frames_lost", "timing.frames",
    "timing.keyframes", "timing.wall_s", "timing.peak_rss_mb",
)  # fmt: skip
_SLIGHT = 0.01  #: difference from the first run that is neither good nor bad, relative or of a fraction
#: Those of which neither smaller nor larger values are better.
NEUTRAL = ("consistency.nees_position_mean", "timing.frames", "timing.keyframes")


class Cell(NamedTuple):
    """Value of one run in the table, its difference from the first as text, and "good", "bad" or "" for it."""

    value: float | None
    text: str
    difference: float | None = None
    change: str = ""
    level: str = ""


class Row(NamedTuple):
    name: str  #: of the metric, dotted
    cells: list[Cell]


def load_runs(folders: Sequence[Path]) -> list[Run]:
    """Returns the runs in folders; raises TwinError unless they are 2 to `MOST_RUNS` different, valid and finished."""
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
    numbers = [numbers_of(run.metrics or {}) for run in runs]
    for one in numbers:
        if one.get("map.completeness_area") is not None:
            one |= {name: np.inf for name in INFINITE_WITH_HOLES if one.get(name) is None}
    values = {name: [one.get(name) for one in numbers] for name in QUANTITIES}
    return [
        Row(name, [_compared(name, value, found[0] if k else None) for k, value in enumerate(found)])
        for name, found in values.items()
        if any(value is not None for value in found)
    ]


def scenario_differences(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Returns the keys of the scenario in which the runs differ, with the value in every run as JSON, or a dash."""
    flat = [dict(_leaves(run.scenario)) for run in runs]
    keys = sorted(set().union(*flat))
    texts = {key: [json.dumps(one[key], default=str) if key in one else DASH for one in flat] for key in keys}
    return {key: [_shortened(one) for one in values] for key, values in texts.items() if len(set(values)) > 1}


def as_json(runs: Sequence[Run]) -> dict[str, Any]:
    """Returns the comparison as JSON: runs, metrics with differences from the first run, scenario differences."""
    metrics = [run.metrics or {} for run in runs]
    return {
        "runs": [
            {"name": name, "folder": str(run.folder), "status": one.get("status"), "reason": one.get("reason")}
            for name, run, one in zip(names_of(runs), runs, metrics, strict=True)
        ],
        "metrics": {
            row.name: {
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
    rows = [(words(row.name), *(f"{cell.text}  {cell.change}".rstrip() for cell in row.cells)) for row in table(runs)]
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
        "differences": differences,
        "other_surveys": [key for key in differences if key.split(".")[0] in _OF_SURVEY],
        "figures": draw_comparison(runs, names),
    }
    answer = {"paragraphs": render_paragraphs("comparison_answer.txt.j2", variables, "twin.report")}
    return render_page("twin.report", "comparison.html.j2", variables | answer)


def draw_comparison(runs: Sequence[Run], names: Sequence[str]) -> dict[str, str]:
    """Returns the PNG data URI of each figure whose data at least one run contains, by name of the figure."""
    styles = [
        {"color": colour, "linestyle": style, "label": name}
        for name, colour, style in zip(names, RUN_COLOURS, _RUN_STYLES, strict=False)
    ]
    functions = {"errors": error_curves, "paths": path_curves, "heights": height_error_curves}
    return drawn(functions, list(zip(runs, styles, strict=True)))


def error_curves(runs: Styled) -> Figure | None:
    """Returns curves of the position error over the length of the true path: online above, final below."""
    figure = Figure(figsize=(WIDTH_IN, 5.0))
    panels = figure.subplots(2, 1, sharex=True)
    for axes, estimate in zip(panels, ("online", "final"), strict=True):
        for run, style in runs:
            if "truth" in run.trajectories and estimate in run.trajectories:
                errors = run.errors(estimate)
                axes.plot(errors.travelled_m, errors.distance_m, **style)
        log_scale(axes)
        axes.set(ylabel=f"position error, {estimate} [m]")
    panels[1].set_xlabel("length of the true path [m]")
    if not panels[0].lines and not panels[1].lines:
        return None
    (panels[0] if panels[0].lines else panels[1]).legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0))
    return figure


def path_curves(runs: Styled) -> Figure | None:
    """Returns a plan view of the final trajectories over the true path of the first run that has one."""
    if not any("final" in run.trajectories for run, _ in runs):
        return None
    figure, axes = one_panel(4.4)
    axes.set_aspect("equal", adjustable="datalim")
    truth = next((run.trajectories["truth"] for run, _ in runs if "truth" in run.trajectories), None)
    if truth is not None:
        x, y, _ = truth.positions.T
        axes.plot(x, y, color=COLOURS["truth"], linewidth=5, alpha=0.25, label="true path")
    for run, style in runs:
        if "final" in run.trajectories:
            x, y, _ = run.trajectories["final"].positions.T
            axes.plot(x, y, linewidth=1.1, **style)
    axes.set(xlabel="x (east) [m]", ylabel="y (north) [m]")
    origins = {run.georeference for run, _ in runs}
    add_coordinates(axes, origins.pop() if len(origins) == 1 else None)
    legend_beside(axes)
    return figure


def height_error_curves(runs: Styled) -> Figure | None:
    """Returns the cumulative distributions of the absolute height error of the map cells, with a line at 90 %."""
    figure, axes = one_panel(3.4)
    share = np.linspace(2, 99.8, 490)  # both tails are long on a logarithmic axis
    for run, style in runs:
        size_m = np.abs(run.rasters["dem_error"].values) if "dem_error" in run.rasters else np.zeros(0)
        size_m = size_m[np.isfinite(size_m)]
        if len(size_m):
            axes.plot(np.percentile(size_m, share), share, **style)
    if not axes.lines:
        return None
    axes.axhline(90, color=COLOURS["limit"], linewidth=0.8)
    axes.set(xlabel="absolute height error [m]", ylabel="cells up to this error [%]", ylim=(0, 100))
    log_axis(axes.xaxis)
    legend_beside(axes)
    return figure


def _compared(name: str, value: float | None, first: float | None) -> Cell:
    text = "infinite (holes)" if value == np.inf else metric_value(name, value)
    if value is None or first is None:
        return Cell(None if value == np.inf else value, text)
    if np.inf in (value, first):
        changes = ("same", "") if value == first else ("better", "good") if first == np.inf else ("worse", "bad")
        return Cell(None if value == np.inf else value, text, None, *changes)
    difference = value - first
    if difference == 0:
        return Cell(value, text, difference, "same")
    is_slight = abs(difference) < _SLIGHT * (1.0 if is_fraction(name) else abs(first))
    level = "" if name in NEUTRAL or is_slight else "good" if (difference > 0) == more_is_better(name) else "bad"
    if is_fraction(name):
        return Cell(value, text, difference, f"{100 * difference:+.2g} %", level)
    change = f"{'+' if difference > 0 else '-'}{metric_value(name, abs(difference))}"
    if first > 0:
        factor = value / first
        change += f" ({100 * (factor - 1):+.0f} %)" if factor < 3 else f" ({ratio(factor)})"
    return Cell(value, text, difference, change, level)


def _leaves(scenario: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yields dotted keys and values of a scenario, of elements of a list of tables by their numbers."""
    for key, value in leaves(scenario):
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield from _leaves({key: {str(k): one for k, one in enumerate(value)}})
        else:
            yield key, value


def _shortened(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}..."
