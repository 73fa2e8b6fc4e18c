"""Albedo of steep parts of the floor by triplanar mapping: textures projected horizontally, see `twin.terrains.walls`.

The texture is filtered over the footprint of the pixel on the facet: trilinearly between levels (Williams 1983), at
several places along the major axis (McCormack et al. 1999, Feline). The steep pixels of a row pass through short loops
without branches. A colour is one integer with a lane of 21 bits per band; the weights of all samples add up to WHOLE.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.height_field import rises
from twin.core.records import Array, Image
from twin.core.threads import in_row_bands
from twin.kernels import kernel
from twin.terrains import Terrain

MOST_SAMPLES = 4.0  #: largest number of samples along the major axis of a footprint
LEAST_COSINE = 0.05  #: smallest cosine of the angle between ray and normal; smaller ones count as this value
LEVELS = 6  #: levels of resolution: the coarsest texels are 32 times as large as the finest
WHOLE = 4096  #: sum of the weights of a pixel
_GREEN, _BLUE, _LANE, _SHIFT = np.uint64(21), np.uint64(42), np.uint64(0xFF), np.uint64(12)
_HALF = np.uint64(WHOLE // 2 * (1 | 1 << 21 | 1 << 42))
_FAR_M = np.float32(1e6)  # depths beyond this are infinite
_FAST = {"contract", "arcp", "nsz", "reassoc"}  # without "ninf": infinite depths must stay valid
(_COL, _ROW, _EAST, _NORTH, _X, _Y, _ACROSS_X, _ACROSS_Y, _ACROSS_Z, _DOWN_X, _DOWN_Y, _DOWN_Z, _BELOW,
 _MAJOR_ALONG, _MAJOR_BELOW, _SAMPLES, _LEVEL, _N_WORK) = range(18)  # fmt: skip


class WallSurface(NamedTuple):
    """Steep parts of a floor for the compiled kernels. All coordinates are texels of the texture of the walls."""

    height: NDArray[np.float32]  # (ny, nx) float32 heights of the floor below its highest point
    number: NDArray[np.int32]  # (ny - 1, nx - 1), weights: (n, 2, 2, 2): see `twin.terrains.walls.Walls`
    weights: NDArray[np.float32]
    texels: NDArray[np.uint64]  # (n,) uint64 colours of all levels, row by row
    levels: NDArray[np.int64]  # (LEVELS, 3) first texel, rows and columns of each level, finest first
    spacing: np.float32  # distance between the nodes, length of the texture [texels]
    length: np.float32
    corner_m: Array  # (2,) x and y of the south-west corner of the floor [m]
    high_m: float  # greatest height of the floor [m]
    texel_m: float  # side of a texel [m]


def wall_surface(terrain: Terrain) -> WallSurface | None:
    """Returns the steep parts of a floor; None if it has none, or its texture is projected from above everywhere."""
    walls = terrain.walls
    if walls is None:
        return None
    texels, levels = _levels(walls.texture)
    texel_m = walls.length_m / walls.texture.shape[1]
    height = ((walls.high_m - terrain.height_m.astype(np.float64)) / texel_m).astype(np.float32)
    spacing, length = np.float32(terrain.spacing_m / texel_m), np.float32(walls.texture.shape[1])
    corner_m = np.array([terrain.west_m, terrain.south_m])
    weights = walls.number, walls.weights
    return WallSurface(height, *weights, texels, levels, spacing, length, corner_m, walls.high_m, texel_m)


def _levels(texture: Image) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """Returns `texels` and `levels` of a texture (h, w, 3), continued beyond its lower and right edge."""
    period = 2 ** (LEVELS - 1)
    bottom, right = (period + -n % period for n in texture.shape[:2])
    image = cv2.copyMakeBorder(texture, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    table, blocks, first = np.zeros((LEVELS, 3), np.int64), [], 0
    for k in range(LEVELS):
        table[k] = first, *image.shape[:2]
        red, green, blue = (image[..., band].ravel().astype(np.uint64) for band in range(3))
        blocks.append(red | green << _GREEN | blue << _BLUE)
        first += len(red)
        image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return np.concatenate(blocks), table


def paint_walls(
    surface: WallSurface, albedo: Image, depth: NDArray[np.float32], world_from_camera: Array, focal_px: float
) -> None:
    """Blends the texture of the walls into the albedo (H, W, 3) of a centred pinhole camera, in place."""
    pose = np.array(world_from_camera[:3]) / surface.texel_m  # east, north and down from the highest point [texels]
    pose[:2, 3] -= surface.corner_m / surface.texel_m
    pose[2] = -pose[2]
    pose[2, 3] += surface.high_m / surface.texel_m
    origin = np.floor(pose[:2, 3] / surface.spacing)  # columns and rows relative to the camera need only float32
    origin = np.clip(origin, 0, np.array(surface.number.shape[::-1]) - 1)
    pose[:2, 3] -= origin * np.float64(surface.spacing)
    view, cell = pose.astype(np.float32), origin.astype(np.int64)
    focal = np.float32(focal_px)
    in_row_bands(lambda first, end: _paint(surface, albedo, depth, view, cell, focal, first, end), len(depth))


def paint_walls_from_above(
    surface: WallSurface, albedo: Image, x_m: NDArray[np.floating], y_m: NDArray[np.floating], step_m: float
) -> None:
    """Blends the texture of the walls into a parallel view of the floor from above, in place."""
    spacing_m = float(surface.spacing) * surface.texel_m
    columns, rows = (x_m - surface.corner_m[0]) / spacing_m, (y_m - surface.corner_m[1]) / spacing_m
    _paint_from_above(surface, albedo, columns, rows, np.float32(step_m / surface.texel_m))


@kernel(fastmath=_FAST, error_model="numpy")
def _paint(surface, albedo, depth, view, origin, focal, first, end):
    height, width = depth.shape
    work, steep = np.empty((_N_WORK, width), np.float32), np.empty((3, width), np.int32)
    total, used = np.empty(width, np.uint64), np.empty(width, np.int64)
    for v in range(first, end):
        y = (np.float32(v) - np.float32(0.5) * np.float32(height - 1)) / focal
        n = _find(surface, depth[v], y, view, origin, focal, work, steep)
        if n == 0:
            continue
        _place(surface, origin, work, steep, n)
        _project(depth[v], y, view, focal, surface.spacing, work, steep, n)
        _blend(surface, albedo[v], work, steep, n, total, used)


@kernel(fastmath=_FAST, error_model="numpy")
def _paint_from_above(surface, albedo, columns, rows, step):
    """Compiled kernel of `paint_walls_from_above`; columns and rows are in cells, the step in texels."""
    n_rows, n_cols = surface.number.shape
    work, steep = np.empty((_N_WORK, columns.size), np.float32), np.empty((3, columns.size), np.int32)
    total, used = np.empty(columns.size, np.uint64), np.empty(columns.size, np.int64)
    for v in range(rows.size):
        r, n = min(max(int(np.floor(rows[v])), 0), n_rows - 1), 0
        if not 0 <= rows[v] <= n_rows:
            continue
        for u in range(columns.size):
            c = min(max(int(np.floor(columns[u])), 0), n_cols - 1)
            steep[0, n], steep[1, n], steep[2, n] = u, c, r
            work[_COL, n], work[_ROW, n] = np.float32(columns[u] - c), np.float32(rows[v] - r)
            if 0 <= columns[u] <= n_cols and surface.number[r, c] >= 0:
                n += 1
        _place(surface, np.zeros(2, np.int64), work, steep, n)
        for i in range(n):
            c, r, east, north = steep[1, i], steep[2, i], work[_EAST, i], work[_NORTH, i]
            work[_BELOW, i] = surface.height[r, c] + surface.spacing * (work[_COL, i] * east + work[_ROW, i] * north)
            work[_ACROSS_X, i], work[_ACROSS_Y, i], work[_ACROSS_Z, i] = step, 0.0, step * east
            work[_DOWN_X, i], work[_DOWN_Y, i], work[_DOWN_Z, i] = 0.0, step, step * north
        _blend(surface, albedo[v], work, steep, n, total, used)


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _find(surface, depth, y, view, origin, focal, work, steep):
    """Finds the pixels of a row that show steep cells; returns their number.

    Fills `steep` (3, W) with their columns, and the columns and rows of their cells; _COL and _ROW with positions.
    """
    rows, cols = surface.number.shape
    zero, one, half = np.float32(0), np.float32(1), np.float32(0.5)
    per_cell = one / surface.spacing
    west, south = -np.float32(origin[0]), -np.float32(origin[1])
    east, north = west + np.float32(cols - 1), south + np.float32(rows - 1)
    col_x, row_x = view[0, 0] * per_cell, view[1, 0] * per_cell
    col_0, row_0 = view[0, 3] * per_cell, view[1, 3] * per_cell
    col_z, row_z = (view[0, 1] * y + view[0, 2]) * per_cell, (view[1, 1] * y + view[1, 2]) * per_cell
    centre = half * np.float32(depth.size - 1)
    col, row, column, line = work[_EAST], work[_NORTH], work[_X], work[_Y]  # filled anew by `_place`
    for u in range(depth.size):
        z = depth[u] if depth[u] < _FAR_M else zero
        x = (np.float32(u) - centre) / focal
        at, up = z * (col_x * x + col_z) + col_0, z * (row_x * x + row_z) + row_0
        col[u], row[u] = at, up
        column[u] = min(max(np.floor(at), west), east)
        line[u] = min(max(np.floor(up), south), north)
    n, first = 0, np.int64(origin[1]) * cols + origin[0]
    flat = surface.number.reshape(-1)
    for u in range(depth.size):
        c, r = np.int64(column[u]), np.int64(line[u])
        steep[0, n], steep[1, n], steep[2, n] = u, c + origin[0], r + origin[1]
        work[_COL, n], work[_ROW, n] = col[u] - column[u], row[u] - line[u]
        n += (flat[first + r * cols + c] >= 0) & (depth[u] < _FAR_M)
    return n


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _place(surface, origin, work, steep, n):
    """Fills the rows _EAST and _NORTH of `work` with the slopes of the facets, _X and _Y with the signed weights."""
    height, number, weights = surface.height, surface.number, surface.weights
    per_cell = np.float32(1) / surface.spacing
    one = np.float32(1)
    for i in range(n):
        c, r, s, t = steep[1, i], steep[2, i], work[_COL, i], work[_ROW, i]
        south_west, south_east = height[r, c], height[r, c + 1]
        north_west, north_east = height[r + 1, c], height[r + 1, c + 1]
        east, north = rises(south_west, south_east, north_west, north_east, s, t)
        work[_EAST, i], work[_NORTH, i] = east * per_cell, north * per_cell
        w = weights[number[r, c]]
        sw, se, nw, ne = (one - s) * (one - t), s * (one - t), (one - s) * t, s * t
        work[_X, i] = sw * w[0, 0, 0] + se * w[0, 1, 0] + nw * w[1, 0, 0] + ne * w[1, 1, 0]
        work[_Y, i] = sw * w[0, 0, 1] + se * w[0, 1, 1] + nw * w[1, 0, 1] + ne * w[1, 1, 1]


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _project(depth, y, view, focal, spacing, work, steep, n):
    """Fills the rows _ACROSS_X to _BELOW of `work`: displacement on the facet to the next pixel along both axes.

    The facet is the plane through the point with the normal N = (east, north, -1) in the axes east, north, down. With
    the ray d of a pixel at the depth z, and d' its change to the next pixel, the point moves by z (d' - d N.d' / N.d).
    """
    ax, ay, az, bx, by, bz = view[0, 0], view[1, 0], view[2, 0], view[0, 1], view[1, 1], view[2, 1]
    x0, y0, z0 = view[0, 1] * y + view[0, 2], view[1, 1] * y + view[1, 2], view[2, 1] * y + view[2, 2]
    one, half, least, down_0 = np.float32(1), np.float32(0.5), np.float32(LEAST_COSINE), view[2, 3]
    centre, per_px, far, px = half * np.float32(depth.size - 1), one / focal, work[_MAJOR_ALONG], work[_MAJOR_BELOW]
    for i in range(n):
        px[i], far[i] = np.float32(steep[0, i]), depth[steep[0, i]]
    for i in range(n):
        x = (px[i] - centre) * per_px
        dx, dy, dz = x0 + x * ax, y0 + x * ay, z0 + x * az
        east, north = work[_EAST, i], work[_NORTH, i]
        smallest = least * np.sqrt((one + east * east + north * north) * (dx * dx + dy * dy + dz * dz))
        along = one / max(dz - east * dx - north * dy, smallest)  # the camera sees the upper side
        size = far[i] * per_px
        du, dv = (az - east * ax - north * ay) * along, (bz - east * bx - north * by) * along
        work[_ACROSS_X, i], work[_DOWN_X, i] = size * (ax - dx * du), size * (bx - dx * dv)
        work[_ACROSS_Y, i], work[_DOWN_Y, i] = size * (ay - dy * du), size * (by - dy * dv)
        work[_ACROSS_Z, i], work[_DOWN_Z, i] = size * (az - dz * du), size * (bz - dz * dv)
        work[_BELOW, i] = down_0 + far[i] * dz


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _blend(surface, albedo, work, steep, n, total, used):
    texels, levels, spacing, length = surface.texels, surface.levels, surface.spacing, surface.length
    for i in range(n):
        total[i], used[i] = np.uint64(0), 0
    for axis in range(2):  # projection along x, then along y
        _footprints(work[_ACROSS_Y - axis], work[_DOWN_Y - axis], work, n)
        for i in range(n):
            weight = work[_X + axis, i]
            if weight == 0:
                continue
            cell, part = steep[2 - axis, i], work[_ROW - axis, i]
            along, turned = (np.float32(cell) + part) * spacing, np.float32(1)
            if weight < 0:
                weight, along, turned = -weight, length - along, -turned
            total[i], used[i] = _filtered(texels, levels, weight, along, turned, work, i, total[i], used[i])
    for i in range(n):
        if used[i] > 0:
            u = steep[0, i]
            own = np.uint64(albedo[u, 0]) | np.uint64(albedo[u, 1]) << _GREEN | np.uint64(albedo[u, 2]) << _BLUE
            mixed = total[i] + own * np.uint64(max(WHOLE - used[i], 0)) + _HALF
            albedo[u, 0] = mixed >> _SHIFT & _LANE
            albedo[u, 1] = mixed >> (_GREEN + _SHIFT) & _LANE
            albedo[u, 2] = mixed >> (_BLUE + _SHIFT) & _LANE


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _footprints(across, down, work, n):
    """Fills the rows _MAJOR_ALONG to _LEVEL of `work`: the filter of the pixels.

    With J the (2, 2) displacement in the texture to the next pixels, the squared axes of the footprint are the
    eigenvalues of J J^T. There are as many samples along the major axis as it is longer than the minor.
    """
    zero, one, half, most = np.float32(0), np.float32(1), np.float32(0.5), np.float32(MOST_SAMPLES)
    size = work[_LEVEL]
    for i in range(n):
        a, b, c, d = across[i], work[_ACROSS_Z, i], down[i], work[_DOWN_Z, i]
        aa, ab, bb, area = a * a + c * c, a * b + c * d, b * b + d * d, a * d - b * c
        difference = half * (aa - bb)
        major = half * (aa + bb) + np.sqrt(difference * difference + ab * ab)
        ratio = major / np.sqrt(max(area * area, max(major, np.float32(1e-12))))
        samples = min(max(np.floor(ratio + half), one), most)
        along, below = (major - bb, ab) if difference > zero else (ab, major - aa)
        step = np.sqrt(major / max(along * along + below * below, np.float32(1e-20))) / samples
        work[_MAJOR_ALONG, i], work[_MAJOR_BELOW, i], work[_SAMPLES, i] = step * along, step * below, samples
        size[i] = max(major / (samples * samples), one)
    bits = size.view(np.int32)
    for i in range(n):  # log2 from exponent and mantissa, linear within an octave
        size[i] = half * (np.float32(bits[i]) * np.float32(2**-23) - np.float32(127))


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _filtered(texels, levels, weight, along, turned, work, i, total, used):
    samples, level = np.int64(work[_SAMPLES, i]), min(work[_LEVEL, i], np.float32(LEVELS - 1.001))
    fine = np.int64(level)
    each = np.int64(weight * np.float32(WHOLE) / work[_SAMPLES, i] + np.float32(0.5))
    coarser = np.int64(np.float32(each) * (level - np.float32(fine)) + np.float32(0.5))
    step_along, step_below = work[_MAJOR_ALONG, i] * turned, work[_MAJOR_BELOW, i]
    start = np.float32(0.5) * (work[_SAMPLES, i] - np.float32(1))
    along, below = along - start * step_along, work[_BELOW, i] - start * step_below
    for _ in range(samples):
        total += _sample(texels, levels, fine, along, below, each - coarser)
        total += _sample(texels, levels, fine + 1, along, below, coarser)
        along, below = along + step_along, below + step_below
    return total, used + samples * each


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _sample(texels, levels, level, along, below, weight):
    """Returns `weight` times the colour of a level at a point [finest texels], interpolated bilinearly."""
    first, rows, cols = levels[level, 0], levels[level, 1], levels[level, 2]
    zero, half, scale = np.float32(0), np.float32(0.5), np.float32(1) / np.float32(1 << level)
    col = min(max(along * scale - half, zero), np.float32(cols - 2))
    row = min(max(below * scale - half, zero), np.float32(rows - 2))
    c, r = np.int64(col), np.int64(row)
    across, down = col - np.float32(c), (row - np.float32(r)) * np.float32(weight)
    low = np.int64(down + half)
    low_right = np.int64(down * across + half)
    high_right = min(np.int64((np.float32(weight) - down) * across + half), weight - low)
    upper = np.uint64(first + r * cols + c)  # signed indices would be tested for negative ones
    lower_left, one = upper + np.uint64(cols), np.uint64(1)
    return (
        texels[upper] * np.uint64(weight - low - high_right)
        + texels[upper + one] * np.uint64(high_right)
        + texels[lower_left] * np.uint64(low - low_right)
        + texels[lower_left + one] * np.uint64(low_right)
    )
