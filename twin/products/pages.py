"""Results of `twin products` and `twin change`: from run folders to sentences, JSON, GeoTIFFs and pages."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from twin.core import geometry
from twin.core.records import MapGrid
from twin.errors import TwinError
from twin.exchange.geotiff import Raster, write_layer
from twin.judge.summary_statistics import finite_tree, mean
from twin.products.change import Change, change_between
from twin.products.registration import PARAMETERS, Heights
from twin.products.surface import Layer, block_means, slope_deg
from twin.products.survey_products import error_field_of_map, survey_products
from twin.report.html import Paragraph, render_page, render_paragraphs
from twin.report.map_figures import map_axes, scalar_map
from twin.report.plotting import WIDTH_IN, drawn, extent_of, hillshade
from twin.report.run_folder import SCENARIO_FILE, Run, load_run

_CHANGED_M = 1e-3  # true change above which a cell counts as changed
_LEAST_TRUE_CELLS = 10  # of a region of true change


class Results(NamedTuple):
    """Results of a command, ready to be written."""

    name: str  #: of the page and of the JSON file
    run: Run
    tree: dict[str, Any]  #: contents of the JSON file
    layers: dict[str, tuple[Raster, str, str]]  #: maps by name of the file, with a description and the unit
    variables: dict[str, Any]  #: of the templates
    outlined: Layer | None = None  #: mask of the cells of patches, on the grid of the layers

    @property
    def paragraphs(self) -> list[Paragraph]:
        return render_paragraphs("products.txt.j2", self.variables, "twin.products")

    def write(self, folder: Path) -> Path:
        """Writes page, JSON file and GeoTIFFs to a folder; returns the path of the page."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{self.name}.json").write_text(json.dumps(self.tree, indent=1), encoding="utf-8")
        for name, (raster, description, unit) in self.layers.items():
            band = f"{description} [{unit}]"
            write_layer(folder / f"{name}.tif", raster.values, raster.grid, band, self.run.georeference)
        shown = {"paragraphs": self.paragraphs, "figures": drawn({"maps": self.draw})}
        variables = self._asdict() | self.variables | shown
        page = folder / f"{self.name}.html"
        page.write_text(render_page("twin.products", "products.html.j2", variables), encoding="utf-8")
        return page

    def draw(self) -> Figure:
        """Returns maps of the surface and of all layers, with the outlines of the patches."""
        rows, surface = (len(self.layers) + 2) // 2, self.run.rasters["dem"]
        figure = Figure(figsize=(WIDTH_IN, 4.0 * rows))
        first, *others = figure.subplots(rows, 2, squeeze=False).ravel()
        map_axes(first, self.run).imshow(hillshade(surface.values, "viridis"), extent=extent_of(surface.grid))
        first.set_title("Elevation")
        for axes, (raster, title, unit) in zip(others, self.layers.values(), strict=False):
            limit, signed = float(np.nanquantile(np.abs(raster.values), 0.97)), np.nanmin(raster.values) < 0
            norm, colours = Normalize(-limit if signed else 0, limit), "RdBu" if signed else "magma"
            scalar_map(map_axes(axes, self.run), raster, title, colours, norm, unit)
            if self.outlined is not None and self.outlined.any():
                axes.contour(*raster.grid.centres(), self.outlined, [0.5], colors="k", linewidths=0.8)
        for axes in others[len(self.layers) :]:
            axes.set_axis_off()
        return figure


def products_of(folder: Path, level_m: float | None = None) -> Results:
    """Returns the products of a run; raises TwinError if it has no map with standard deviations, or a too small one."""
    run = load_run(folder)
    heights, rig = _heights(run, "RUN"), run.scenario.get("rig", {})
    if "final" not in run.trajectories:
        raise TwinError("RUN", f"{run.folder} has no trajectory_final.tum", "a finished run")
    if missing := {"hfov_deg", "image_width_px", "baseline_m"} - rig.keys():
        raise TwinError(f"RUN: {SCENARIO_FILE}: rig.{min(missing)}", "missing", "a file of `twin run` or `twin replay`")
    in_map = geometry.transform(run.keyframes.map_from_world, run.trajectories["final"].positions)
    above_floor_m = np.median(in_map[:, 2]) - np.nanmedian(heights.height_m)
    width_m = float(2 * above_floor_m * np.tan(np.deg2rad(rig["hfov_deg"]) / 2))
    errors = error_field_of_map(heights, width_m / rig["image_width_px"], width_m)
    baseline_sigma_mm = run.scenario.get("calibration_error", {}).get("baseline_sigma_mm", 0.0)
    products = survey_products(heights, errors, baseline_sigma_mm / 1000 / rig["baseline_m"], level_m)
    grain_m = products.best.grain_m
    slope = slope_deg(block_means(heights.height_m, round(grain_m / heights.grid.cell_m)), grain_m)
    coarse = MapGrid(heights.grid.west_m, heights.grid.north_m, grain_m, *slope.shape)
    layers = {
        "slope": (Raster(coarse, slope), f"slope, grain {grain_m:g} m", "deg"),
        "height_sigma": (Raster(heights.grid, heights.sigma_m), "standard deviation of the heights", "m"),
    }
    tree, variables, true = _tree(products), {"products": products, "truth": None}, run.rasters.get("dem_truth")
    if true is not None and true.grid == heights.grid:
        common = np.isfinite(heights.height_m) & np.isfinite(true.values)
        exact = errors._replace(sigma_m=np.zeros_like(errors.sigma_m), long_sigma_m=np.zeros_like(errors.sigma_m))
        given = {"compared": (heights.height_m, errors), "truth": (true.values, exact)}
        with suppress(TwinError):  # too few cells in common
            variables |= {
                name: survey_products(heights._replace(height_m=np.where(common, z, np.nan)), e, 0.0, products.level_m)
                for name, (z, e) in given.items()
            }
            tree |= {"truth": _tree(variables["truth"])}
    return Results("products", run, tree, layers, variables)


def change_of(first_folder: Path, second_folder: Path, scale_m: float) -> Results:
    """Returns the change from the first run to the second; `scale_m` is the size of changes that are looked for.

    Raises TwinError if a run has no map with standard deviations, or their maps cannot be compared.
    """
    first, second = load_run(first_folder), load_run(second_folder)
    heights, others = _heights(first, "RUN1", "repeatability"), _heights(second, "RUN2", "repeatability")
    cell_m, other_m = heights.grid.cell_m, others.grid.cell_m
    if not np.isclose(other_m, cell_m, rtol=1e-6):
        raise TwinError("RUN2", f"its map has cells of {other_m:g} m", f"those of RUN1, {cell_m:g} m")
    if second.georeference != first.georeference:
        raise TwinError("RUN2", "its scene has another CRS or origin than that of RUN1", "two surveys of one scene")
    change = change_between(heights, others, scale_m)
    titles = {
        "difference": (change.registration.difference_m, "change of height"),
        "detection_level": (change.detection_level_m, "level of detection of a cell (95 %)"),
        "detectable": (change.detectable_m, f"change of {scale_m:g} m x {scale_m:g} m found in 95 %"),
    }
    layers = {name: (Raster(heights.grid, values), title, "m") for name, (values, title) in titles.items()}
    known, truth, patches = np.isfinite(change.sigma_m), None, change.patches
    net, detectable_m = change.patch(known), finite_tree(np.nanquantile(change.detectable_m, [0.5, 0.9]))
    motion = zip(change.registration.values, np.sqrt(np.diag(change.registration.cov)), strict=True)
    tree = {
        "patches": _tree(patches),
        "net": _tree(net),
        "significant_cells": float(change.significant[known].mean()),
        "detectable_median_m": detectable_m[0],
        "registration_and_sigma": dict(zip(PARAMETERS, finite_tree(motion), strict=True)),
    }
    before, after = (run.rasters.get("dem_truth") for run in (first, second))
    if before is not None and after is not None and before.grid == after.grid == heights.grid:
        truth = tree["truth"] = judged(change, after.values - before.values)
    variables = {"change": change, "patches": patches, "net": net, "truth": truth, "second": second}
    variables |= {"scale_m": scale_m, "detectable_m": detectable_m}
    return Results("change", first, tree, layers, variables, change.labels > 0)


def judged(change: Change, true_m: Layer) -> dict[str, Any]:
    """Returns how a change agrees with the true one (rows, cols) [m]: regions found, false patches, volume errors."""
    cells = np.isfinite(change.sigma_m) & np.isfinite(true_m)
    true_m = np.where(cells, true_m, 0.0)
    changed, probability = np.abs(true_m) > _CHANGED_M, change.detection_probability(true_m)
    n, regions = cv2.connectedComponents(changed.astype(np.uint8))
    true = [regions == k for k in range(1, n) if (regions == k).sum() >= _LEAST_TRUE_CELLS]
    inside = [change.labels == k for k in range(1, change.labels.max() + 1)]
    volumes_m3 = [float(true_m[one].sum()) * change.grid.cell_m**2 for one in inside]
    pairs = zip(change.patches, volumes_m3, strict=True)
    return {
        "regions": len(true),
        "found": sum(bool(change.labels[one].any()) for one in true),
        "expected": float(sum(probability[one].max() for one in true)),
        "false_patches": sum(not changed[one].any() for one in inside),
        "false_cells": mean(change.significant[cells & ~changed]),
        "patch_volume_m3": volumes_m3,
        "volume_error_over_sigma": [(patch.volume_m3 - one) / patch.volume_sigma.total for patch, one in pairs],
    }


def _heights(run: Run, name: str, kind: str = "sigma") -> Heights:
    layers = "dem", f"dem_{kind}" if f"dem_{kind}" in run.rasters else "dem_sigma"
    for layer in layers:
        if layer not in run.rasters:
            raise TwinError(name, f"{run.folder} has no {layer}.tif", "a run with a map")
        if run.rasters[layer].grid != run.rasters["dem"].grid:
            raise TwinError(name, f"{run.folder}: {layer}.tif has other cells than dem.tif", "files of one run")
    return Heights(run.rasters["dem"].grid, *(run.rasters[layer].values for layer in layers))


def _tree(value: Any) -> Any:
    """Returns nested named tuples as nested dicts and lists for JSON."""
    if hasattr(value, "_asdict"):
        return {name: _tree(part) for name, part in value._asdict().items()}
    return [_tree(part) for part in value] if isinstance(value, tuple | list) else finite_tree(value)
