"""Orthomosaic: all keyframe images, rectified by the estimated map and poses, in one picture, made tile by tile."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.ortho_tiles import OrthoTile, finer_grid, tile_side_px, window
from twin.core.records import Array, ElevationMap, Exposure, Image, Map, MapGrid, Mask, StereoRig
from twin.core.threads import prefetched
from twin.estimate.mapping.exposure_balance import estimated_factors, patch_colours, patch_points, reported_factors
from twin.estimate.mapping.orthophoto import OrthoLayers, add_view, empty_layers, footprint

_MARGIN_PX = 64  # width of the margin around a tile, whose floor may hide pixels of the tile [px]
_FILLED_CELLS = 3  # small holes of the map have a colour up to this distance from mapped cells [cells]


class Views(NamedTuple):
    world_from_camera: Array  #: (n, 4, 4) poses of the cameras in the axes of the map
    depth_m: Array  #: (n,) median depth of the floor in each image [m]
    exposures: Sequence[Exposure | None]  #: exposure of each image, None where the cameras did not report it
    #: function that returns the image (H, W, 3) with a given number, from 0; its pixels are square.
    load: Callable[[int], Image]


class Restore(Protocol):
    """Removes the effects of lamps and water: returns the albedo (H, W, 3) float32, 255 = white; pose in map axes."""

    def __call__(self, image: Image, exposure: Exposure | None, world_from_camera: Array, /) -> Map: ...


def orthomosaic(
    views: Views, elevation: ElevationMap, rig: StereoRig, restore: Restore | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Iterator[OrthoTile]:  # fmt: skip
    """Yields all tiles of the orthomosaic, row by row from the north-west, also those without any colour.

    The pixels divide the cells of the map and are not larger than the median ground sample distance of the images.
    Without `restore`, colours are as seen, at equal exposure. `progress` is called with the finished fraction, 0 to 1.
    """
    grid = ortho_grid(views, elevation, rig)
    factors = np.ones((len(views.depth_m), 3)) if restore else _exposure_factors(views, elevation, rig)
    known_m = elevation.height_m[np.isfinite(elevation.height_m)]
    heights_m = (float(known_m.min()), float(known_m.max())) if known_m.size else (np.nan, np.nan)
    boxes = np.array([footprint(pose, rig, heights_m) for pose in views.world_from_camera]).reshape(-1, 4)
    side = tile_side_px(round(elevation.grid.cell_m / grid.cell_m))
    tiles = [(row, col) for row in range(0, grid.rows, side) for col in range(0, grid.cols, side)]
    parts = [_padded(grid, row, col, side) for row, col in tiles]
    touching = [_touching(boxes, part) for part in parts]
    n_done, n_all = 0, max(1, sum(map(len, touching)))
    for (row, col), part, numbers in zip(tiles, parts, touching, strict=True):
        layers = empty_layers(part, heights_of(elevation, part))
        prepared = prefetched(_colours(views, k, factors[k], restore) for k in numbers)
        for k, (rgb, saturated) in zip(numbers, prepared, strict=True):
            add_view(layers, rgb, saturated, views.world_from_camera[k], rig, heights_m)
            n_done += 1
            progress(n_done / n_all)
        rgba = _rgba(layers)
        del layers  # before the tile is written and judged
        yield OrthoTile(grid, row, col, rgba[_MARGIN_PX:-_MARGIN_PX, _MARGIN_PX:-_MARGIN_PX])


def ortho_grid(views: Views, elevation: ElevationMap, rig: StereoRig) -> MapGrid:
    return finer_grid(elevation.grid, float(np.median(views.depth_m)) / rig.focal_px)


def heights_of(elevation: ElevationMap, part: MapGrid) -> Map:
    """Returns the heights (rows, cols) [m] of a map at the pixels of a grid that divide its cells, by interpolation."""
    # small holes have the height of the nearest mapped cell; other holes and pixels outside are NaN
    grid, n = elevation.grid, round(elevation.grid.cell_m / part.cell_m)
    first = np.array([grid.north_m - part.north_m, part.west_m - grid.west_m]) / grid.cell_m
    row, col = np.floor(first + 1e-6).astype(int) - _FILLED_CELLS - 1
    rows, cols = (-(-size // n) + 2 * _FILLED_CELLS + 3 for size in (part.rows, part.cols))
    coarse = np.full((rows, cols), np.nan, np.float32)
    r0, r1, c0, c1 = max(row, 0), min(row + rows, grid.rows), max(col, 0), min(col + cols, grid.cols)
    if r0 < r1 and c0 < c1:
        coarse[r0 - row : r1 - row, c0 - col : c1 - col] = elevation.height_m[r0:r1, c0:c1]
    coarse, known = _filled(coarse)
    fine = cv2.resize(coarse, (cols * n, rows * n), interpolation=cv2.INTER_LINEAR)
    fine[cv2.resize(known.astype(np.uint8), (cols * n, rows * n), interpolation=cv2.INTER_NEAREST) == 0] = np.nan
    top, left = np.round((first - [row, col]) * n).astype(int)
    return np.ascontiguousarray(fine[top : top + part.rows, left : left + part.cols], np.float32)


def _filled(height: Map) -> tuple[Map, Mask]:
    """Returns heights with NaN replaced by the nearest known (0: none), and a mask of known cells and small holes."""
    unknown = np.isnan(height)
    if unknown.all():
        return np.zeros_like(height), ~unknown
    distance, labels = cv2.distanceTransformWithLabels(
        unknown.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(labels, np.int64)
    of_label = np.zeros(int(label.max()) + 1, np.float32)
    of_label[label[~unknown]] = height[~unknown]
    closed = cv2.morphologyEx((~unknown).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3)), iterations=_FILLED_CELLS)
    return of_label[label], (closed > 0) & (np.asarray(distance) <= _FILLED_CELLS)


def _exposure_factors(views: Views, elevation: ElevationMap, rig: StereoRig) -> Array:
    if (reported := reported_factors(views.exposures)) is not None:
        return reported
    points, poses = patch_points(elevation, rig, float(np.median(views.depth_m))), views.world_from_camera
    return estimated_factors(patch_colours(views.load(k), poses[k], rig, points) for k in range(len(poses)))


def _padded(grid: MapGrid, row: int, col: int, side: int) -> MapGrid:
    """Returns the grid of the pixels of a tile (smaller at east and south edges) and its margin of `_MARGIN_PX`."""
    rows, cols = min(side, grid.rows - row), min(side, grid.cols - col)
    return window(grid, row - _MARGIN_PX, col - _MARGIN_PX, rows + 2 * _MARGIN_PX, cols + 2 * _MARGIN_PX)


def _touching(boxes: Array, part: MapGrid) -> NDArray[np.int64]:
    """Returns the indices of the images whose footprints `boxes` (n, 4) overlap a part of the grid."""
    west, south, east, north = boxes.T
    east_m, south_m = part.west_m + part.cols * part.cell_m, part.north_m - part.rows * part.cell_m
    return np.flatnonzero((west < east_m) & (east > part.west_m) & (south < part.north_m) & (north > south_m))


def _colours(views: Views, k: int, factor: Array, restore: Restore | None) -> tuple[Map, Image]:
    """Returns an image, restored or multiplied by the factor (3,) of its exposure, and `saturated` of `add_view`."""
    image = views.load(int(k))
    saturated = cv2.dilate((image.max(axis=2) == 255).astype(np.uint8), np.ones((3, 3), np.uint8))
    if restore is None:
        rgb = image * factor.astype(np.float32)
    else:
        rgb = restore(image, views.exposures[k], views.world_from_camera[k])
    return rgb, np.asarray(saturated, np.uint8)


def _rgba(layers: OrthoLayers) -> Image:
    known = layers.weight > 0
    rgba = np.zeros((*known.shape, 4), np.uint8)
    rgba[known, :3] = np.clip(layers.colour[known] / layers.weight[known][:, None] + 0.5, 0, 255)
    rgba[known, 3] = 255
    return rgba
