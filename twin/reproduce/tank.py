"""Tank experiments of Negahdaripour & Madjidi (2003, section V-B): closure, sizes of objects, and predicted errors."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from numpy.typing import NDArray

from twin.judge.map_error import height_error
from twin.judge.summary_statistics import percentile
from twin.judge.trajectory_errors import path_errors
from twin.report.plotting import extent_of, png_figure
from twin.report.style import COLOURS
from twin.reproduce.exhibit import DASH, Exhibit, Figure, Row, Table, make_table, millimetres, percent, write_exhibit
from twin.reproduce.experiment_floors import OBJECTS
from twin.reproduce.tank_sizes import SizeRow, hidden_cells, measure
from twin.reproduce.tank_survey import QUICK, TankSurvey, closures, height_errors, survey_tank

Array = NDArray[np.floating]

BAD_M = 0.02  # a cell is bad if its height error is larger
WORST_SHARE = 0.2  # a bad cell counts as predicted if it is among this share of the cells, with the largest sigma
TITLES = {"tank1": "Tank test 1: 130 pairs on parallel legs", "tank2": "Tank test 2: two loops that touch at the start"}
#: Keys of the tables of each experiment.
TABLES = {"tank1": ("rows", "sizes", "map"), "tank2": ("rows", "closure", "sizes", "map")}
_CAPTION = (
    "Connections of the network over the mosaic, path before and after the global alignment, true and estimated "
    "height, logarithm of the predicted standard deviation, and absolute error of the height."
)


def run(name: str, folder: Path, quick: bool = False) -> Exhibit:
    """Surveys "tank1" or "tank2" (quick: at 320 x 240 pixels); writes NAME.json, NAME.png; returns the results."""
    with tempfile.TemporaryDirectory(prefix="twin-") as images:
        survey = survey_tank(name, Path(images), QUICK if quick else ())
    grid, height_m, final = survey.mission.grid, survey.elevation.height_m, survey.result.final.world_from_camera
    hidden = hidden_cells(height_m, grid, final[survey.result.keyframe_rows], survey.mission.rig)
    sizes = [measure(item, height_m, grid, hidden) for item in OBJECTS]
    tables = {
        "rows": _paper_table(survey),
        "closure": _closure_table(survey),
        "sizes": sizes_table(sizes),
        "map": _map_table(survey),
    }
    shown, figures = tuple(tables[key] for key in TABLES[name]), (Figure(f"{name}.png", _CAPTION),)
    exhibit = write_exhibit(Exhibit(name, TITLES[name], _text(survey), shown, figures), folder)
    draw(TITLES[name], survey, folder / f"{name}.png")
    return exhibit


def _text(survey: TankSurvey) -> str:
    rig, n, settings = survey.mission.rig, len(survey.path.planned_m), survey.mission.scenario.estimator_settings()
    ended = f" The final alignment is missing: {survey.ended}." if survey.ended else ""
    return (
        f"{n} stereo pairs of {rig.width_px} x {rig.height_px} pixels, 5 cm apart, 1.52 m (5 ft) above the floor of a "
        "tank; the track bends by 12 mm and jitters by 1 mm and 0.1 deg on each axis. Each pair is connected to up to "
        f"{settings.max_links} earlier ones with an overlap of 70 %, and all pairs are aligned "
        "together. The estimators start at the planned pose of the first pair; paths and heights are compared after "
        "the motion that maps the first estimated pose to the first true one. The light is uneven: the white PVC pipe "
        "is saturated, a third of the floor lies in the shade. Cells that an object hides in every pair count as "
        "floor; the height of the pipe is not measured where its crest is saturated."
        f"{ended}"
    )


def _paper_table(survey: TankSurvey) -> Table:
    rig, height_m = survey.mission.rig, float(survey.path.planned_m[0, 2])
    x, y = survey.path.planned_m[:, :2].T
    seen_m2 = survey.truth.seen.sum() * survey.mission.grid.cell_m**2
    errors = {key: path_errors(getattr(survey.result, key), survey.truth.trajectory) for key in ("f2f", "final")}
    bend = survey.result.final.positions[:, 1] - survey.path.planned_m[:, 1]
    bend_m = float(bend[np.abs(x - 0.2) < 0.05].mean() - bend[np.abs(x - 0.2) > 0.3].mean())
    n_pairs = "61" if survey.path.repeats else "130"
    rows = [
        ("", "paper", "ours"), ("stereo pairs", n_pairs, str(len(x))),
        ("distance to the floor", "about 1.5 m (5 ft)", f"{height_m:.2f} m"),
        ("pixel on the floor", "about 5 mm (0.2 in)", millimetres(height_m / rig.focal_px)),
        ("mapped area", "about 2 m2 (1 m x 2 m)", f"{seen_m2:.1f} m2"),
        ("connections", DASH, str(len(survey.result.links))),
        ("position error before alignment, largest", DASH, millimetres(float(errors["f2f"].distance_m.max()))),
        ("position error after alignment, largest", DASH, millimetres(float(errors["final"].distance_m.max()))),
        ("bend of the track, by the path after alignment", "seen, not measured", f"{millimetres(bend_m)} of 12 mm"),
    ]  # fmt: skip
    return make_table("rows", "The paper's figures", rows)


def _closure_table(survey: TankSurvey) -> Table:
    rows: list[Row] = [
        ("first frame repeated as", "before alignment", "online, with the mosaic", "after alignment", "limit")
    ]
    for k, errors_m in zip(survey.path.repeats, closures(survey.result, survey.path.repeats), strict=True):
        rows.append((f"frame {k + 1}", *map(millimetres, errors_m), "5 mm"))
    return make_table("closure", "Closure error (the paper: ground truth of its test, no figure given)", rows)


def sizes_table(sizes: Sequence[SizeRow]) -> Table:
    rows: list[Row] = [
        ("object", "along x, true / measured", "along y, true / measured", "height, true / measured", "largest error")
    ]
    for row in sizes:
        pairs = [
            f"{1e3 * true:.1f} / {DASH if np.isnan(found) else f'{1e3 * found:.1f}'}"
            for true, found in zip(row.true, row.measured, strict=True)
        ]
        largest_m = percentile([error for error in np.abs(row.errors_m) if np.isfinite(error)], 100)
        rows.append((row.name, *pairs, DASH if largest_m is None else f"{1e3 * largest_m:.1f}"))
    return make_table("sizes", "Sizes of the objects in the map, at half of their height [mm]", rows)


def _map_table(survey: TankSurvey) -> Table:
    error, unanchored = height_errors(survey), np.abs(height_error(survey.elevation, survey.truth))
    size, flagged = np.abs(error[np.isfinite(error)]), flagged_share(error, survey.elevation.sigma_m)
    rows = [
        ("", "paper", "ours"),
        ("cells with a height, of those seen by both cameras", DASH, percent(len(size) / survey.truth.seen.sum(), 1)),
        ("absolute height error: median", DASH, millimetres(float(np.median(size)))),
        ("absolute height error: 90th percentile", DASH, millimetres(float(np.percentile(size, 90)))),
        ("the same, not anchored at the first true pose: median", DASH, millimetres(float(np.nanmedian(unanchored)))),
        (f"cells off by more than {1e2 * BAD_M:g} cm", "some, at saturated pipes",
         percent(float((size > BAD_M).mean()), 2)),
        ("of these, among the worst fifth by sigma", "predicted, no figure given", percent(flagged)),
    ]  # fmt: skip
    return make_table("map", "Heights and their predicted errors", rows)


def flagged_share(error_m: Array, sigma_m: Array) -> float | None:
    """Returns the share of cells (rows, cols) worse than `BAD_M` among the 20 % of largest sigma; None if none is."""
    known = np.isfinite(error_m) & np.isfinite(sigma_m)
    bad = np.abs(error_m[known]) > BAD_M
    if not bad.any():
        return None
    sigma = sigma_m[known]
    return float((sigma[bad] > np.quantile(sigma, 1 - WORST_SHARE)).mean())


LEAST_M, LARGEST_M = 2e-4, 0.1  # limits of the logarithmic scale of sigma and error


def draw(title: str, survey: TankSurvey, file: Path) -> None:
    with png_figure(file, 13.0, 7.4) as figure:
        figure.suptitle(title, fontsize=12)
        panels = figure.subplots(2, 3)
        _network(panels[0, 0], survey)
        _paths(panels[1, 0], survey)
        heights, scale = Normalize(-0.01, float(survey.truth.height_m.max())), LogNorm(LEAST_M, LARGEST_M)
        error = np.maximum(np.abs(height_errors(survey)), LEAST_M)
        for axes, values, title, cmap, norm in (
            (panels[0, 1], survey.truth.height_m, "true height [m]", "viridis", heights),
            (panels[1, 1], survey.elevation.height_m, "height in the map [m]", "viridis", heights),
            (panels[0, 2], survey.elevation.sigma_m, "predicted sigma [m]", "magma", scale),
            (panels[1, 2], error, "absolute height error [m]", "magma", scale),
        ):
            image = axes.imshow(values, extent=extent_of(survey.mission.grid), cmap=cmap, norm=norm)
            axes.set(title=title)
            axes.set_facecolor("#dfe6ea")  # cells without a value
            axes.grid(visible=False)
            bar = figure.colorbar(image, ax=axes, shrink=0.7)
            if norm is scale:
                bar.ax.yaxis.set_major_formatter("{x:g}")


def _network(axes: Axes, survey: TankSurvey) -> None:
    links, positions = survey.result.links, survey.result.final.positions[survey.result.keyframe_rows]
    axes.imshow(survey.elevation.mosaic, extent=extent_of(survey.mission.grid))
    ends = np.stack([positions[links.i, :2], positions[links.j, :2]], axis=1)
    axes.add_collection(LineCollection(list(ends), colors=COLOURS["f2f"], linewidths=0.5, alpha=0.7))
    axes.plot(*positions[:, :2].T, ".", markersize=3, color=COLOURS["online"])
    axes.set(title=f"{len(positions)} keyframes, {len(links)} connections, mosaic", aspect="equal")
    axes.grid(visible=False)


def _paths(axes: Axes, survey: TankSurvey) -> None:
    shown = (
        (survey.path.planned_m, "reference", "as read on the track", 1.0),
        (survey.truth.trajectory.positions, "truth", "true", 4.0),
        (survey.result.f2f.positions, "f2f", "before alignment (F2F)", 1.2),
        (survey.result.final.positions, "final", "after alignment", 1.2),
    )
    for positions, role, label, width in shown:
        alpha = 0.35 if role == "truth" else 1.0
        axes.plot(*positions[:, :2].T, color=COLOURS[role], label=label, linewidth=width, alpha=alpha)
    axes.set(title="path of the left camera", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(fontsize=7, loc="upper right")
