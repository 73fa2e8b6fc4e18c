"""Rectification of single images onto the pixels of an orthomosaic, by the estimated heights and poses.

The colours of all views of a pixel are averaged with the weights w = r exp(-K tan^2(n)): n is the angle of the line of
sight from the vertical; r rises from 0.001 at the border of the image to 1 at 12 pixels from it; K (`SHARPNESS`) is so
large that the view nearest to nadir, where errors of height displace least, dominates. Saturated pixels have exp(-60)
times the weight. Pixels hidden by nearer floor are not used.
"""

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.interpolation import catmull_rom_weights
from twin.core.records import Array, Image, Map, MapGrid, StereoRig
from twin.core.threads import in_row_bands
from twin.kernels import kernel

#: K of the weight. Between two cameras 0.15 heights apart, the seam (10 % to 90 % of the weight) is 0.06 heights wide:
#: 17 pixels of an image with a focal length of 277 px.
SHARPNESS = 240.0
_SATURATED = 60.0  # added to -log w where a pixel of the image is saturated; -log w of a view 27 deg from nadir
_NEGLIGIBLE = 7.0  # a view for which exp(-K tan^2(n)) is less than exp(-this) times the best weight is not added
_RAMP_PX, _LEAST_RAMP = 12.0, 1e-3  # width of the ramp at the border of the image, and its value at the border
_HIDDEN_SHARE = 0.02  # a pixel is hidden if floor at the same pixel of the image is nearer by more than this fraction


class OrthoLayers(NamedTuple):
    """Part of an orthomosaic in progress."""

    grid: MapGrid  #: grid of the pixels of this part
    height_m: Map  #: (rows, cols) height of each pixel, NaN where unknown
    colour: Map  #: (rows, cols, 3) sum of the colours, multiplied by their weights w / exp(-best)
    weight: Map  #: (rows, cols) sum of the weights w / exp(-best)
    best: Map  #: (rows, cols) smallest value of -log w so far; inf without a view


def empty_layers(grid: MapGrid, height_m: Map) -> OrthoLayers:
    shape = grid.rows, grid.cols
    best = np.full(shape, np.inf, np.float32)
    return OrthoLayers(grid, height_m, np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32), best)


def footprint(world_from_camera: Array, rig: StereoRig, heights_m: tuple[float, float]) -> Array:
    """Returns the bounds (west, south, east, north) [m] of all floor between two heights that an image can show."""
    # infinite if the camera is not above the lowest floor or a corner ray does not point downwards
    u, v = np.array([-0.5, rig.width_px - 0.5]), np.array([-0.5, rig.height_px - 0.5])
    corners = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = np.column_stack([rig.normalised(corners), np.ones(4)]) @ world_from_camera[:3, :3].T
    to_lowest_m, to_highest_m = (world_from_camera[2, 3] - height_m for height_m in heights_m)
    if to_lowest_m <= 0 or (rays[:, 2] >= -1e-3).any():
        return np.array([-np.inf, -np.inf, np.inf, np.inf])
    per_down = -rays[:, :2] / rays[:, 2:]
    at = world_from_camera[:2, 3] + np.concatenate([per_down * to_lowest_m, per_down * max(to_highest_m, 0.0)])
    return np.concatenate([at.min(axis=0), at.max(axis=0)])


def add_view(
    layers: OrthoLayers, rgb: Map, saturated: Image, world_from_camera: Array, rig: StereoRig,
    heights_m: tuple[float, float],
) -> None:  # fmt: skip
    """Adds an image (H, W, 3) at a pose (4, 4) in map axes; `saturated` (H, W) is 1 where a colour is not reliable."""
    grid = layers.grid
    bounds = _pixels_within(footprint(world_from_camera, rig, heights_m), grid)
    if bounds[0] >= bounds[1] or bounds[2] >= bounds[3]:
        return
    camera_from_world = geometry.inverse(world_from_camera)
    north_west = np.array([grid.west_m + grid.cell_m / 2, grid.north_m - grid.cell_m / 2, 0.0])
    rotation = camera_from_world[:3, :3]
    steps = np.column_stack([rotation[:, 0] * grid.cell_m, -rotation[:, 1] * grid.cell_m, rotation[:, 2]])
    view = (
        np.ascontiguousarray(steps),
        rotation @ (north_west - world_from_camera[:3, 3]),
        np.append(world_from_camera[:3, 3] - north_west, grid.cell_m),
        np.array([rig.focal_px, rig.cx_px, rig.cy_px]),
    )
    nearest = np.full(saturated.shape, np.inf, np.float32)
    _mark_nearest(layers.height_m, *bounds, *view, nearest)
    top, blended = bounds[0], (*bounds[2:], *view, rgb, saturated, nearest)
    in_row_bands(lambda first, end: _blend(*layers[1:], top + first, top + end, *blended), bounds[1] - top)


def _pixels_within(box_m: Array, grid: MapGrid) -> tuple[int, int, int, int]:
    """Returns first row, end row, first and end column of the pixels within a box (west, south, east, north) [m]."""
    west, south, east, north = box_m
    rows = np.clip([(grid.north_m - north) / grid.cell_m, (grid.north_m - south) / grid.cell_m + 1], 0, grid.rows)
    cols = np.clip([(west - grid.west_m) / grid.cell_m, (east - grid.west_m) / grid.cell_m + 1], 0, grid.cols)
    return int(rows[0]), int(rows[1]), int(cols[0]), int(cols[1])


@kernel(error_model="numpy")
def _mark_nearest(height, first, end, left, right, steps, origin, _, camera, nearest):
    """Writes to `nearest` (H, W) the smallest depth of the orthomosaic pixels that each image pixel shows, or inf."""
    focal, cx, cy = camera
    for i in range(first, end):
        for j in range(left, right):
            z = height[i, j]
            depth = origin[2] + j * steps[2, 0] + i * steps[2, 1] + z * steps[2, 2]
            if not depth > 0:
                continue
            per_z = focal / depth
            u = int(cx + per_z * (origin[0] + j * steps[0, 0] + i * steps[0, 1] + z * steps[0, 2]))
            v = int(cy + per_z * (origin[1] + j * steps[1, 0] + i * steps[1, 1] + z * steps[1, 2]))
            # two by two pixels of the image, as one may be smaller than a pixel of the orthomosaic
            for row in range(max(v, 0), min(v + 2, nearest.shape[0])):
                for col in range(max(u, 0), min(u + 2, nearest.shape[1])):
                    nearest[row, col] = min(nearest[row, col], np.float32(depth))


@kernel(error_model="numpy")
def _blend(
    height, colour, weight, best, first, end, left, right, steps, origin, camera_at, camera, image, clipped,
    nearest,
):  # fmt: skip
    """Adds the colours of an image to `colour`, `weight` and `best` (see `OrthoLayers`) in these rows and columns."""
    # columns of `steps` (3, 3): displacements in camera axes per column, row and metre of height; `origin` (3,): pixel
    # (0, 0) at height 0 in these axes; `camera_at` (4,): the camera relative to it, and the size of a pixel [m]
    focal, cx, cy = camera
    rows, cols, _ = image.shape
    east, north, up, cell = camera_at
    for i in range(first, end):
        for j in range(left, right):
            z = height[i, j]
            depth = origin[2] + j * steps[2, 0] + i * steps[2, 1] + z * steps[2, 2]
            if not depth > 0:
                continue
            dx, dy, dz = j * cell - east, -i * cell - north, up - z
            score = SHARPNESS * (dx * dx + dy * dy) / (dz * dz)
            if not score < best[i, j] + _NEGLIGIBLE:
                continue
            u = cx + focal / depth * (origin[0] + j * steps[0, 0] + i * steps[0, 1] + z * steps[0, 2])
            v = cy + focal / depth * (origin[1] + j * steps[1, 0] + i * steps[1, 1] + z * steps[1, 2])
            inside = min(min(u, cols - 1 - u), min(v, rows - 1 - v))
            if inside < 0 or depth > nearest[int(v + 0.5), int(u + 0.5)] * (1 + _HIDDEN_SHARE):
                continue
            score += _SATURATED * clipped[int(v + 0.5), int(u + 0.5)] - np.log(
                max(min(inside / _RAMP_PX, 1.0), _LEAST_RAMP)
            )
            if score < best[i, j]:
                scale = np.exp(score - best[i, j])
                weight[i, j] *= scale
                for k in range(3):
                    colour[i, j, k] *= scale
                best[i, j] = score
            w = np.float32(np.exp(best[i, j] - score))
            weight[i, j] += w
            _add_sample(image, u, v, w, colour[i, j])


@kernel(error_model="numpy")
def _add_sample(image, u, v, w, colour):
    """Adds w times the colour of an image at column u and row v, interpolated bicubically, to `colour` (3,)."""
    rows, cols, _ = image.shape
    i, j = int(v), int(u)
    down, across = catmull_rom_weights(np.float32(v - i)), catmull_rom_weights(np.float32(u - j))
    red = green = blue = np.float32(0.0)
    for a in range(4):
        row = image[min(max(i - 1 + a, 0), rows - 1)]
        for b in range(4):
            share = down[a] * across[b]
            pixel = row[min(max(j - 1 + b, 0), cols - 1)]
            red += share * pixel[0]
            green += share * pixel[1]
            blue += share * pixel[2]
    colour[0] += w * red
    colour[1] += w * green
    colour[2] += w * blue
