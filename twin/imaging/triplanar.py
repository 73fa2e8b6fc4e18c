"""Albedo of steep parts of the floor by triplanar mapping: textures projected horizontally, see `terrains.walls`.

The albedo depends only on the point of the floor. Its texture is filtered over the pixel's footprint on the rendered
facet: trilinearly between levels of resolution (Williams 1983), at several places along the major axis of the
footprint, because walls are seen obliquely (anisotropic filter, McCormack et al. 1999, Feline).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from terrains import Terrain
from terrains.objects.texture_pyramid import textures_of
from twin.core.records import Image
from twin.imaging.row_parallel import in_row_bands

Array = NDArray[np.float64]

MOST_SAMPLES = 4  #: largest number of samples along the major axis of a footprint
LEAST_COSINE = 0.05  #: smallest cosine of the angle between ray and normal; smaller ones count as this value


class WallSurface(NamedTuple):
    """Steep parts of a floor for the compiled kernels.

    Args:
        height_m: (ny, nx) heights of the floor.
        number: (ny - 1, nx - 1), weights: (n, 2, 2, 2): see `terrains.walls.Walls`.
        texels: (n, 3), levels: (levels, 3): see `terrains.objects.texture_pyramid.Textures`.
        frame: west and south edge of the floor and spacing of its nodes [m]; length of the texture, height of its upper
            edge, and its rise [m].
    """

    height_m: NDArray[np.float32]
    number: NDArray[np.int32]
    weights: NDArray[np.float32]
    texels: NDArray[np.uint8]
    levels: NDArray[np.int64]
    frame: tuple[float, float, float, float, float, float]


def wall_surface(terrain: Terrain) -> WallSurface | None:
    """Returns the steep parts of a floor; None if it has none, or its texture is projected from above everywhere."""
    walls = terrain.walls
    if walls is None:
        return None
    texels, levels = textures_of([walls.texture])
    frame = terrain.west_m, terrain.south_m, terrain.spacing_m
    extent = walls.length_m, walls.high_m, max(walls.high_m - walls.low_m, 1e-6)
    heights = np.ascontiguousarray(terrain.height_m, np.float32)
    return WallSurface(heights, walls.number, walls.weights, texels, levels[0], tuple(map(float, (*frame, *extent))))


def paint_walls(
    surface: WallSurface, albedo: Image, depth: NDArray[np.float32], world_from_camera: Array, focal_px: float
) -> None:
    """Blends the texture of the walls into an image of the floor, in place.

    Args:
        surface: steep parts of the floor.
        albedo: (H, W, 3) uint8 albedo with the texture projected from above.
        depth: (H, W) depth of the floor along the optical axis [m]; inf where there is no floor.
        world_from_camera: (4, 4) pose of the camera; x right, y down, z forward.
        focal_px: focal length; the optical axis is at the centre of the image.
    """
    pose = np.ascontiguousarray(world_from_camera[:3], np.float64)
    in_row_bands(lambda first, end: _paint(surface, albedo, depth, pose, focal_px, first, end), len(depth))


def paint_walls_from_above(surface: WallSurface, albedo: Image, x_m: Array, y_m: Array, step_m: float) -> None:
    """Blends the texture of the walls into a parallel view of the floor from above, in place.

    Args:
        surface: steep parts of the floor.
        albedo: (rows, cols, 3) uint8 albedo with the texture projected from above.
        x_m: (cols,) x of the samples.
        y_m: (rows,) y of the samples.
        step_m: distance between the samples.
    """
    _paint_from_above(surface, albedo, x_m, y_m, step_m)


@njit(cache=True, nogil=True, error_model="numpy")
def _paint(surface, albedo, depth, pose, focal, first, end):
    """Compiled kernel of `paint_walls` for the rows first to end - 1."""
    height, width = depth.shape
    west, south, spacing, _, _, _ = surface.frame
    rows, cols = surface.number.shape
    ax, ay, az, bx, by, bz = pose[0, 0], pose[1, 0], pose[2, 0], pose[0, 1], pose[1, 1], pose[2, 1]
    for v in range(first, end):
        q = (v - 0.5 * (height - 1)) / focal
        x0, y0, z0 = q * bx + pose[0, 2], q * by + pose[1, 2], q * bz + pose[2, 2]
        for u in range(width):
            far = np.float64(depth[v, u])
            if not far < np.inf:
                continue
            p = (u - 0.5 * (width - 1)) / focal
            dx, dy = x0 + p * ax, y0 + p * ay
            col = (pose[0, 3] + far * dx - west) / spacing
            row = (pose[1, 3] + far * dy - south) / spacing
            c, r = min(max(int(col), 0), cols - 1), min(max(int(row), 0), rows - 1)
            if surface.number[r, c] < 0:
                continue
            east, north = _slope(surface.height_m, r, c, col - c, row - r, spacing)
            dz = z0 + p * az
            along = dz - east * dx - north * dy
            least = LEAST_COSINE * np.sqrt((1 + east * east + north * north) * (dx * dx + dy * dy + dz * dz))
            along = min(along, -least)  # the camera sees the upper side
            du = (az - east * ax - north * ay) / along
            dv = (bz - east * bx - north * by) / along
            size = far / focal
            across = size * (ax - dx * du), size * (ay - dy * du), size * (az - dz * du)
            down = size * (bx - dx * dv), size * (by - dy * dv), size * (bz - dz * dv)
            _blend(surface, albedo[v, u], (r, c, col - c, row - r), pose[2, 3] + far * dz, across, down)


@njit(cache=True, nogil=True, error_model="numpy")
def _paint_from_above(surface, albedo, x_m, y_m, step):
    """Compiled kernel of `paint_walls_from_above`."""
    west, south, spacing, _, _, _ = surface.frame
    rows, cols = surface.number.shape
    for i in range(y_m.size):
        row = (y_m[i] - south) / spacing
        r = min(max(int(row), 0), rows - 1)
        for j in range(x_m.size):
            col = (x_m[j] - west) / spacing
            c = min(max(int(col), 0), cols - 1)
            if surface.number[r, c] < 0 or row < 0 or row > rows or col < 0 or col > cols:
                continue
            s, t = col - c, row - r
            east, north = _slope(surface.height_m, r, c, s, t, spacing)
            z = surface.height_m[r, c] + spacing * (s * east + t * north)
            _blend(surface, albedo[i, j], (r, c, s, t), z, (step, 0.0, step * east), (0.0, step, step * north))


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def _slope(height, r, c, s, t, spacing):
    """Returns the slope towards east and north, rise over run, of the facet at (s, t) in cell (r, c)."""
    south_west, north_east = np.float64(height[r, c]), np.float64(height[r + 1, c + 1])
    if s >= t:
        middle = height[r, c + 1]
        return (middle - south_west) / spacing, (north_east - middle) / spacing
    middle = height[r + 1, c]
    return (north_east - middle) / spacing, (middle - south_west) / spacing


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def _blend(surface, colour, place, z, across, down):
    """Blends the texture of the walls into the colour (3,) of one pixel, in place.

    Args:
        surface: `WallSurface`.
        colour: albedo with the texture projected from above.
        place: row and column of the cell, and position in it towards east and north, 0 to 1.
        z: height of the point [m].
        across, down: displacement (x, y, z) of the point from this pixel to the next one along each axis [m].
    """
    r, c, s, t = place
    _, _, spacing, length, high, rise = surface.frame
    corner = surface.weights[surface.number[r, c]]
    sw, se, nw, ne = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    rest, red, green, blue = 1.0, 0.0, 0.0, 0.0
    for axis in range(2):
        weight = sw * corner[0, 0, axis] + se * corner[0, 1, axis] + nw * corner[1, 0, axis] + ne * corner[1, 1, axis]
        if weight == 0.0:
            continue
        along = (r + t) * spacing / length if axis == 0 else (c + s) * spacing / length
        sign = 1.0
        if weight < 0:
            weight, along, sign = -weight, 1 - along, -1.0
        k = 1 - axis
        footprint = sign * across[k] / length, -across[2] / rise, sign * down[k] / length, -down[2] / rise
        red1, green1, blue1 = _filtered(surface.texels, surface.levels, along, (high - z) / rise, footprint)
        red, green, blue = red + weight * red1, green + weight * green1, blue + weight * blue1
        rest -= weight
    if rest < 1:
        rest = max(rest, 0.0)
        colour[0] = np.uint8(rest * colour[0] + red + 0.5)
        colour[1] = np.uint8(rest * colour[1] + green + 0.5)
        colour[2] = np.uint8(rest * colour[2] + blue + 0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _filtered(texels, levels, along, below, footprint):
    """Returns red, green and blue of a texture, filtered over the footprint of a pixel.

    Args:
        texels, levels: see `WallSurface`.
        along, below: position in the texture, as a fraction of its columns and rows.
        footprint: change of `along` and of `below` to the next pixel across, and to the next pixel down.
    """
    _, rows, cols = levels[0]
    a, b, c, d = footprint[0] * cols, footprint[1] * rows, footprint[2] * cols, footprint[3] * rows
    # axes of the ellipse onto which [[a, c], [b, d]] maps the unit circle [texels]
    aa, ab, bb = a * a + c * c, a * b + c * d, b * b + d * d
    half = 0.5 * (aa - bb)
    square = 0.5 * (aa + bb) + np.sqrt(half * half + ab * ab)
    major, area = np.sqrt(square), abs(a * d - b * c)
    n, axis_along, axis_below = 1, 0.0, 0.0
    if major > 1:
        n = min(max(int(major / max(area / major, 1.0) + 0.5), 1), MOST_SAMPLES)
        axis_along, axis_below = (square - bb, ab) if half > 0 else (ab, square - aa)
        scale = major / (n * np.sqrt(axis_along * axis_along + axis_below * axis_below))
        axis_along, axis_below = axis_along * scale / cols, axis_below * scale / rows
    level = min(max(np.log2(major / n), 0.0), len(levels) - 1.001)
    fine = int(level)
    share = level - fine
    red, green, blue = 0.0, 0.0, 0.0
    for k in range(n):
        at, under = along + (k - 0.5 * (n - 1)) * axis_along, below + (k - 0.5 * (n - 1)) * axis_below
        r, g, b = _sample(texels, levels[fine], at, under)
        red, green, blue = red + (1 - share) * r, green + (1 - share) * g, blue + (1 - share) * b
        if share > 0:
            r, g, b = _sample(texels, levels[fine + 1], at, under)
            red, green, blue = red + share * r, green + share * g, blue + share * b
    return red / n, green / n, blue / n


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def _sample(texels, level, along, below):
    """Returns red, green and blue of a level, interpolated bilinearly; the texels of the edges continue beyond them."""
    first, rows, cols = level
    col, row = min(max(along * cols - 0.5, 0.0), cols - 1.0), min(max(below * rows - 0.5, 0.0), rows - 1.0)
    c, r = int(col), int(row)
    s, t = col - c, row - r
    upper = first + r * cols + c
    right = 1 if c + 1 < cols else 0
    lower = upper + cols if r + 1 < rows else upper
    nw, ne, sw, se = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    red = nw * texels[upper, 0] + ne * texels[upper + right, 0] + sw * texels[lower, 0] + se * texels[lower + right, 0]
    green = (
        nw * texels[upper, 1] + ne * texels[upper + right, 1] + sw * texels[lower, 1] + se * texels[lower + right, 1]
    )
    blue = nw * texels[upper, 2] + ne * texels[upper + right, 2] + sw * texels[lower, 2] + se * texels[lower + right, 2]
    return red, green, blue
