"""Elevation maps as coloured surfaces for the 3-D view, split into parts by the time of their first observation."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.height_field import map_slopes, raster_triangles
from twin.core.image_coverage import NOT_SHOWN, image_coverage
from twin.core.records import Array, Image, MapGrid, StereoRig
from twin.report.run_folder import Raster

#: Approximate largest number of vertices of a surface; maps with more cells are subsampled.
N_VERTICES = 100_000
#: Group number of a point that no camera observes.
NOT_OBSERVED = np.iinfo(np.int64).max


class Surface(NamedTuple):
    """A coloured triangle mesh, in the axes of the map or of the world."""

    points: Array  # (n, 3) vertices [m]; not finite where the map has no height
    normals: Array  # (n, 3) unit normals
    colours: NDArray[np.uint8]  # (n, 3) uint8 RGB
    triangles: NDArray[np.int64]  # (m, 3) vertex numbers


def floor_surface(raster: Raster) -> Surface:
    low, high = np.nanpercentile(raster.values, [1, 99]) if np.isfinite(raster.values).any() else (0.0, 1.0)
    shade = np.clip((raster.values - low) / max(high - low, 1e-6), 0, 1)
    grey = np.nan_to_num(110 + 90 * shade).astype(np.uint8)
    return _surface(raster, np.repeat(grey[..., None], 3, axis=2))


def map_surface(dem: Raster, mosaic: Raster | None) -> Surface:
    """Returns the estimated map in the colours of an orthomosaic of the same area, or else coloured by height."""
    if mosaic is not None and _covers_same_area(dem.grid, mosaic.grid):
        return _surface(dem, _colours_of_cells(mosaic, dem.grid))
    low, high = np.nanmin(dem.values, initial=np.inf), np.nanmax(dem.values, initial=-np.inf)
    level = np.nan_to_num(255 * (dem.values - low) / max(high - low, 1e-6)).astype(np.uint8)
    return _surface(dem, cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[..., ::-1])


def in_world(surface: Surface, map_from_world: Array) -> Surface:
    points = geometry.transform(geometry.inverse(map_from_world), surface.points)
    return surface._replace(points=points, normals=surface.normals @ map_from_world[:3, :3])


def _covers_same_area(cells: MapGrid, pixels: MapGrid) -> bool:
    """Returns whether grids have one north-west corner and size, up to a cell and a (reduced) pixel."""
    corner = np.array([pixels.west_m - cells.west_m, pixels.north_m - cells.north_m])
    size = np.array([pixels.cols, pixels.rows]) * pixels.cell_m - np.array([cells.cols, cells.rows]) * cells.cell_m
    tolerance_m = 1e-3 * min(cells.cell_m, pixels.cell_m)
    return bool((np.abs(corner) < tolerance_m).all() and (np.abs(size) < cells.cell_m + pixels.cell_m).all())


def _colours_of_cells(mosaic: Raster, cells: MapGrid) -> Image:
    """Returns the colours (rows, cols, 3) of an orthomosaic in the cells of a map, continued beyond its edges."""
    scale = mosaic.grid.cell_m / cells.cell_m
    size = max(round(mosaic.grid.cols * scale), 1), max(round(mosaic.grid.rows * scale), 1)
    colours = np.asarray(cv2.resize(mosaic.values, size, interpolation=cv2.INTER_AREA), np.uint8)
    missing = max(cells.rows - size[1], 0), max(cells.cols - size[0], 0)
    padded = np.pad(colours, ((0, missing[0]), (0, missing[1]), (0, 0)), mode="edge")
    return padded[: cells.rows, : cells.cols]


def _surface(raster: Raster, colours: Image) -> Surface:
    """Returns the mesh of a raster, subsampled to about `N_VERTICES`; all corners of its triangles have a height."""
    step = int(np.ceil(np.sqrt(raster.values.size / N_VERTICES)))
    x, y = raster.grid.centres()
    height = raster.values[::step, ::step]
    points = np.stack([*np.meshgrid(x[::step], y[::step]), height], axis=-1)
    east, north = map_slopes(height, step * raster.grid.cell_m)
    normals = np.nan_to_num(np.stack([-east, -north, np.ones_like(height)], axis=-1))
    unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    flat = points.reshape(-1, 3), unit.reshape(-1, 3), colours[::step, ::step].reshape(-1, 3)
    return Surface(*flat, raster_triangles(np.isfinite(height)))


def first_observed(points: Array, groups: Sequence[Array], rig: StereoRig) -> NDArray[np.int64]:
    """Returns the first group of poses (n_k, 4, 4) that views each world point (n, 3); `NOT_OBSERVED` if none does."""
    first = image_coverage(points, np.concatenate(groups), rig, baseline_m=0.0).first
    ends = np.cumsum([len(poses) for poses in groups])
    return np.where(first == NOT_SHOWN, NOT_OBSERVED, np.searchsorted(ends, first, "right"))


def submesh(surface: Surface, group: NDArray[np.int64], number: int) -> Surface:
    """Returns the triangles that camera group `number` completes, and their vertices."""
    triangles = surface.triangles[group[surface.triangles].max(axis=1, initial=-1) == number]
    used, renumbered = np.unique(triangles, return_inverse=True)
    parts = surface.points[used], surface.normals[used], surface.colours[used]
    return Surface(*parts, renumbered.reshape(-1, 3))
