"""Maps and cross-sections of the survey report. Each figure function returns None if its data are missing."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Normalize
from matplotlib.figure import Figure
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

from twin.core.records import Array
from twin.report.images import reduced
from twin.report.plotting import WIDTH_IN, add_coordinates, extent_of, height_scale, hillshade, legend_beside, one_panel
from twin.report.run_folder import Raster, Run
from twin.report.style import COLOURS
from twin.report.survey_data import KeyframeCoverage

#: Longest side of a map in a figure [cells]; maps with more cells are subsampled.
MAP_CELLS = 500
_MOSAIC_PX = 1000  # the same of the orthomosaic
#: The truth is drawn as a broad band below the estimates, so it remains visible where they coincide with it.
TRUE_STYLE = {"linewidth": 5.0, "alpha": 0.35}
_MOST_KEYFRAMES = 9  # largest number of keyframes per cell with a colour of its own


def coverage_map(run: Run, coverage: KeyframeCoverage | None) -> Figure | None:
    """Returns a map of the number of keyframes that show each cell with both cameras."""
    if coverage is None:
        return None
    figure, axes = one_panel(4.0)
    numbers = np.arange(1, _MOST_KEYFRAMES + 2)
    counts = np.where(coverage.keyframes > 0, np.minimum(coverage.keyframes, numbers[-1]), np.nan)
    norm = BoundaryNorm(np.append(numbers - 0.5, numbers[-1] + 0.5), 256)
    image = map_axes(axes, run).imshow(counts, cmap="viridis", norm=norm, extent=extent_of(coverage.grid))
    bar = figure.colorbar(image, ax=axes, label="keyframes", shrink=0.9)
    bar.set_ticks(numbers.tolist(), labels=[*map(str, numbers[:-1]), f">{_MOST_KEYFRAMES}"])
    return figure


def orthomosaic_map(run: Run) -> Figure | None:
    """Returns the orthomosaic, white where it has no data."""
    if "mosaic" not in run.rasters:
        return None
    mosaic = run.rasters["mosaic"]
    figure, axes = one_panel(6.4)
    axes = map_axes(axes, run)
    shown = np.where(mosaic.values.any(axis=2, keepdims=True), mosaic.values, np.uint8(255))
    axes.imshow(reduced(shown, _MOSAIC_PX), extent=extent_of(mosaic.grid))
    return figure


def elevation_maps(run: Run) -> Figure | None:
    """Returns hill-shaded maps of the true and the estimated elevation with the same colour scale, and contours."""
    titles = {"dem_truth": "True elevation", "dem": "Estimated elevation"}
    rasters = [(run.rasters[key], title) for key, title in titles.items() if key in run.rasters]
    if not rasters:
        return None
    scale = height_scale(np.concatenate([raster.values.ravel() for raster, _ in rasters]))
    step_m = round_below((scale[1] - scale[0]) / 6)
    figure = Figure(figsize=(WIDTH_IN, 4.0))
    panels = figure.subplots(1, len(rasters), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (raster, title) in zip(panels, rasters, strict=True):
        heights, extent = subsampled(raster), extent_of(raster.grid)
        map_axes(axes, run).imshow(hillshade(heights, "viridis", scale), extent=extent)
        levels = step_m * np.arange(np.ceil(scale[0] / step_m), scale[1] / step_m)
        if np.isfinite(heights).any() and len(levels):
            axes.contour(heights, levels, extent=extent, origin="upper", colors="k", linewidths=0.5, alpha=0.7)
        axes.set_title(f"{title}, contours every {step_m:g} m")
    figure.colorbar(ScalarMappable(Normalize(*scale), "viridis"), ax=panels, label="height [m]", shrink=0.8)
    return figure


def error_maps(run: Run) -> Figure | None:
    """Returns maps of the height error and of the estimated standard deviation."""
    if "dem_error" not in run.rasters or not np.isfinite(run.rasters["dem_error"].values).any():
        return None
    figure = Figure(figsize=(WIDTH_IN, 4.0))
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    limit = float(np.nanpercentile(np.abs(run.rasters["dem_error"].values), 98)) or 1e-3
    title = "Height error (estimated minus true)"
    scalar_map(map_axes(left, run), run.rasters["dem_error"], title, "RdBu_r", Normalize(-limit, limit))
    if "dem_sigma" in run.rasters:
        title = "Estimated standard deviation (sigma)"
        scalar_map(map_axes(right, run), run.rasters["dem_sigma"], title, "magma", Normalize(0, limit))
    return figure


def cross_sections(run: Run) -> Figure | None:
    """Returns heights, and errors with the band of 2 sigma, along two lines through the middle of the map."""
    if not {"dem", "dem_sigma"} <= run.rasters.keys() or not np.isfinite(run.rasters["dem"].values).any():
        return None
    figure = Figure(figsize=(WIDTH_IN, 4.4))
    panels = figure.subplots(2, 2, sharex="col", sharey="row", height_ratios=[3, 2])
    for (top, bottom), name, line in zip(panels.T, ("along", "across"), section_lines(run), strict=True):
        height_m, sigma_m = (sampled(run.rasters[key], line) for key in ("dem", "dem_sigma"))
        distance_m = np.linspace(-0.5, 0.5, len(line)) * np.linalg.norm(line[-1] - line[0])
        if "dem_truth" in run.rasters:
            true_m = sampled(run.rasters["dem_truth"], line)
            top.plot(distance_m, true_m, color=COLOURS["truth"], label="true", **TRUE_STYLE)
            bottom.plot(distance_m, 1000 * (height_m - true_m), color=COLOURS["final"])
        top.plot(distance_m, height_m, color=COLOURS["final"], label="estimated")
        bottom.fill_between(distance_m, -2000 * sigma_m, 2000 * sigma_m, color=COLOURS["online"], alpha=0.3)
        top.set_title(f"{name.capitalize()} the legs")
        bottom.set_xlabel("distance from the middle [m]")
    limit = 8000 * float(np.nanmedian(run.rasters["dem_sigma"].values)) or 1.0
    panels[0, 0].set_ylabel("height [m]")
    panels[1, 0].set(ylabel="error, 2 sigma [mm]", ylim=(-limit, limit))
    legend_beside(panels[0, 1])
    return figure


def section_lines(run: Run) -> list[Array]:
    """Returns points (n, 2) of the two lines along and across the legs through the middle of the asked area or map [m].

    Most of the path runs along the legs; their axis is the mean of the doubled directions of its steps.
    """
    grid, paths = run.rasters["dem"].grid, run.trajectories.values()
    steps = np.concatenate([np.zeros((1, 3)), *(np.diff(path.positions, axis=0) for path in paths)])
    turned = run.keyframes.map_from_world[:2, :3] @ steps.T
    angle = 0.5 * np.arctan2((2 * turned[0] * turned[1]).sum(), (turned[0] ** 2 - turned[1] ** 2).sum())
    along = np.array([np.cos(angle), np.sin(angle)])
    west, east, south, north = extent_of(grid)
    corners = np.concatenate([*run.keyframes.asked_area_m] or [np.array([[west, south], [east, north]])])
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    axes = along, np.array([-along[1], along[0]])
    reaches_m = (np.abs((corners - middle) @ axis).max() for axis in axes)
    steps_m = (np.arange(-reach_m, reach_m, grid.cell_m)[:, None] for reach_m in reaches_m)
    return [middle + step_m * axis for step_m, axis in zip(steps_m, axes, strict=True)]


def sampled(raster: Raster, points: Array) -> Array:
    """Returns the values (n,) of the cells that contain points (n, 2) [m]; NaN outside."""
    grid = raster.grid
    cols = np.floor((points[:, 0] - grid.west_m) / grid.cell_m).astype(int)
    rows = np.floor((grid.north_m - points[:, 1]) / grid.cell_m).astype(int)
    inside = (rows >= 0) & (rows < grid.rows) & (cols >= 0) & (cols < grid.cols)
    values = np.full(len(points), np.nan)
    values[inside] = raster.values[rows[inside], cols[inside]]
    return values


def task_maps(run: Run) -> Figure | None:
    """Returns hill-shaded maps of the tasks beside their height errors, one row for each task."""
    names = [name for name in run.rasters if name.startswith("task_") and name.endswith("/dem")]
    if not names:
        return None
    figure = Figure(figsize=(WIDTH_IN, 3.6 * len(names)))
    titles = [task["name"] for task in (run.metrics or {}).get("tasks", [])]
    for row, name in zip(figure.subplots(len(names), 2, squeeze=False), names, strict=True):
        number = int(name.removeprefix("task_").split("/")[0])
        title = titles[number - 1] if number <= len(titles) else name
        heights, error = run.rasters[name], run.rasters.get(name.replace("/dem", "/dem_error"))
        scale = height_scale(heights.values.ravel())
        width_m = heights.grid.cols * heights.grid.cell_m
        shaded = hillshade(subsampled(heights), "viridis", scale)
        map_axes(row[0], run, width_m).imshow(shaded, extent=extent_of(heights.grid))
        row[0].set_title(title)
        figure.colorbar(ScalarMappable(Normalize(*scale), "viridis"), ax=row[0], label="height [m]", shrink=0.8)
        if error is not None and np.isfinite(error.values).any():
            limit = float(np.nanpercentile(np.abs(error.values), 98)) or 1e-3
            scalar_map(map_axes(row[1], run, width_m), error, "Height error", "RdBu_r", Normalize(-limit, limit))
    return figure


def scalar_map(axes: Axes, raster: Raster, title: str, cmap: str, norm: Normalize, unit: str = "m") -> None:
    """Draws a raster with one band and its colour bar; cells without data are light grey."""
    image = axes.imshow(subsampled(raster), cmap=cmap, norm=norm, extent=extent_of(raster.grid))
    axes.set_title(title)
    axes.set_facecolor("#dfe6ea")
    figure = axes.get_figure()
    assert figure is not None
    figure.colorbar(image, ax=axes, label=f"[{unit}]", shrink=0.8, extend="both" if norm.vmin else "max")


def subsampled(raster: Raster) -> np.ndarray:
    """Returns every n-th row and column of a raster, with the smallest n for which no side exceeds `MAP_CELLS`."""
    step = int(np.ceil(max(raster.values.shape[:2]) / MAP_CELLS))
    return raster.values[::step, ::step]


def map_axes(axes: Axes, run: Run, width_m: float | None = None) -> Axes:
    """Returns axes of a map with the asked area and a scale bar for a map of this width, by default that of the DEM."""
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set(xlabel="east [m]", ylabel="north [m]")
    add_coordinates(axes, run.georeference)
    for ring in run.keyframes.asked_area_m:
        axes.plot(*ring.T, color="white", linewidth=2.2, zorder=3)
        axes.plot(*ring.T, color=COLOURS["limit"], linewidth=1.1, linestyle="--", zorder=3)
    if width_m is None and "dem" in run.rasters:
        west, east, *_ = extent_of(run.rasters["dem"].grid)
        width_m = east - west
    if width_m:
        bar_m = round_below(width_m / 4)
        axes.add_artist(AnchoredSizeBar(axes.transData, bar_m, f"{bar_m:g} m", "lower left", pad=0.35, borderpad=0.4))
    return axes


def round_below(value: float) -> float:
    """Returns the largest of 1, 2 and 5 times powers of 10 that does not exceed a positive value."""
    decade = 10.0 ** math.floor(math.log10(value))
    return decade * max(n for n in (1, 2, 5) if n * decade <= value * (1 + 1e-9))
