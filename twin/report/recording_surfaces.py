"""Elevation maps as coloured surfaces in pieces, for the 3-D view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, Image, StereoRig
from twin.report.run_folder import Raster

#: Most vertices of a surface; finer maps are thinned.
N_VERTICES = 100_000
NEVER = np.iinfo(np.int64).max


class Surface(NamedTuple):
    """Points (n, 3) [m], normals (n, 3), colours (n, 3) uint8 RGB, triangles (m, 3)."""

    points: Array
    normals: Array
    colours: NDArray[np.uint8]
    triangles: NDArray[np.int64]


def floor_surface(raster: Raster) -> Surface:
    """The true floor, in grey by height."""
    low, high = np.nanpercentile(raster.values, [1, 99]) if np.isfinite(raster.values).any() else (0.0, 1.0)
    shade = np.clip((raster.values - low) / max(high - low, 1e-6), 0, 1)
    grey = np.nan_to_num(110 + 90 * shade).astype(np.uint8)
    return _surface(raster, np.repeat(grey[..., None], 3, axis=2))


def map_surface(dem: Raster, mosaic: Raster | None) -> Surface:
    """The estimated map in the colours of the mosaic; without one, by height."""
    if mosaic is not None and mosaic.values.shape[:2] == dem.values.shape:
        return _surface(dem, mosaic.values)
    low, high = np.nanmin(dem.values, initial=np.inf), np.nanmax(dem.values, initial=-np.inf)
    level = np.nan_to_num(255 * (dem.values - low) / max(high - low, 1e-6)).astype(np.uint8)
    return _surface(dem, cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[..., ::-1])


def _surface(raster: Raster, colours: Image) -> Surface:
    """Every n-th cell as a vertex, two triangles between four neighbours that have a height."""
    step = int(np.ceil(np.sqrt(raster.values.size / N_VERTICES)))
    x, y = raster.grid.centres()
    height = raster.values[::step, ::step]
    points = np.stack([*np.meshgrid(x[::step], y[::step]), height], axis=-1)
    north, east = np.gradient(height, -step * raster.grid.cell_m, step * raster.grid.cell_m)
    normals = np.nan_to_num(np.stack([-east, -north, np.ones_like(height)], axis=-1))
    triangles = _triangles(np.isfinite(height))
    unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    flat = points.reshape(-1, 3), unit.reshape(-1, 3), colours[::step, ::step].reshape(-1, 3)
    return Surface(*flat, triangles)


def _triangles(there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Triangles (m, 3) between cells that are there, counter-clockwise from above (row 0 = north)."""
    index = np.arange(there.size).reshape(there.shape)
    nw, ne, sw, se = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    both = np.concatenate([np.stack([nw, sw, ne], -1).reshape(-1, 3), np.stack([ne, sw, se], -1).reshape(-1, 3)])
    return both[there.ravel()[both].all(axis=1)]


def first_seen(points: Array, stages: Sequence[Array], rig: StereoRig) -> NDArray[np.int64]:
    """(n,) number of the first stage with a camera (n_k, 4, 4) that has the point in its image; `NEVER` if none has."""
    stage = np.full(len(points), NEVER)
    waiting = np.flatnonzero(np.isfinite(points).all(axis=1))
    for number, poses in enumerate(stages):
        for pose in poses:
            inside = _in_image(points[waiting], pose, rig)
            stage[waiting[inside]] = number
            waiting = waiting[~inside]
    return stage


def _in_image(points: Array, world_from_camera: Array, rig: StereoRig) -> NDArray[np.bool_]:
    x, y, z = geometry.transform(geometry.inverse(world_from_camera), points).T
    reach_x, reach_y = rig.width_px / 2 / rig.focal_px, rig.height_px / 2 / rig.focal_px
    return (z > 0) & (np.abs(x) <= reach_x * z) & (np.abs(y) <= reach_y * z)


def piece(surface: Surface, stage: NDArray[np.int64], number: int) -> Surface:
    """The triangles that are complete from a stage on, with just their vertices."""
    triangles = surface.triangles[stage[surface.triangles].max(axis=1, initial=-1) == number]
    used, renumbered = np.unique(triangles, return_inverse=True)
    parts = surface.points[used], surface.normals[used], surface.colours[used]
    return Surface(*parts, renumbered.reshape(-1, 3))
