"""Albedo of steep parts of the floor by triplanar mapping: textures projected horizontally, see `twin.terrains.walls`.

The texture is filtered over the footprint of the pixel on the facet: trilinearly between levels (Williams 1983), at
several places along the major axis (McCormack et al. 1999, Feline). The steep pixels of a row pass through short loops
without branches.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.height_field import rises
from twin.core.records import Image
from twin.imaging.scene import pixel_rows as px
from twin.imaging.scene.texture_levels import TextureLevels, add_samples, level_of, levels_of
from twin.kernels import kernel
from twin.terrains import Terrain

Coordinates = NDArray[np.floating]
MOST_SAMPLES = 4  #: largest number of samples along the major axis of a footprint
_FAST = {"contract", "arcp", "nsz", "reassoc"}


class WallSurface(NamedTuple):
    """Steep parts of a floor for the compiled kernels."""

    number: NDArray[np.int32]  # (ny - 1, nx - 1), weights: (n, 2, 2, 2): see `twin.terrains.walls.Walls`
    weights: NDArray[np.float32]
    texture: TextureLevels
    per_m: np.float32  # texels per metre
    length: np.float32  # length of the texture [texels]


NO_WALLS = WallSurface(
    np.zeros((0, 0), np.int32), np.zeros((0, 2, 2, 2), np.float32), levels_of(np.zeros((2, 2, 3), np.uint8)),
    np.float32(1), np.float32(2),
)  # fmt: skip


def wall_surface(terrain: Terrain) -> WallSurface:
    """Returns the steep parts of a floor; without cells if its texture is projected from above everywhere."""
    walls = terrain.walls
    if walls is None:
        return NO_WALLS
    length = np.float32(walls.texture.shape[1])
    levels = levels_of(walls.texture.image)
    return WallSurface(walls.number, walls.weights, levels, length / np.float32(walls.length_m), length)


def paint_walls_from_above(
    terrain: Terrain, surface: WallSurface, albedo: Image, x_m: Coordinates, y_m: Coordinates, step_m: float
) -> None:
    """Blends the texture of the walls into a parallel view (rows, cols, 3) of a floor from above, in place."""
    # x (cols,) and y (rows,) of its pixels [m] are `step_m` apart
    floor = terrain.height_m, terrain.highest_m, terrain.spacing_m
    _paint_from_above(surface, *floor, albedo, x_m - terrain.west_m, y_m - terrain.south_m, np.float32(step_m))


@kernel(fastmath=_FAST, error_model="numpy")
def _paint_from_above(surface, height, highest, spacing, albedo, east, north, step):
    n_rows, n_cols = surface.number.shape
    if n_rows == 0:
        return
    work, weight = np.empty((px.N_ROWS, east.size), np.float32), np.ones(east.size, np.float32)
    cells, total = np.empty((6, east.size), np.int32), np.empty(3 * east.size, np.float32)
    zero, per_m = np.float32(0), np.float32(1 / spacing)
    for v in range(north.size):
        row, n = north[v] / spacing, 0
        if not 0 <= row <= n_rows:
            continue
        r = min(int(row), n_rows - 1)
        for u in range(east.size):
            col = east[u] / spacing
            c = min(max(int(col), 0), n_cols - 1)
            if not 0 <= col <= n_cols or surface.number[r, c] < 0:
                continue
            south_west, s, t = height[r, c], np.float32(col - c), np.float32(row - r)
            to_east, to_north = rises(south_west, height[r, c + 1], height[r + 1, c], height[r + 1, c + 1], s, t)
            cells[0, n], cells[1, n] = u, surface.number[r, c]
            work[px.EAST, n], work[px.NORTH, n], work[px.COL, n], work[px.ROW, n] = east[u], north[v], s, t
            work[px.BELOW, n] = np.float32(highest - south_west) - s * to_east - t * to_north
            work[px.ACROSS_X, n], work[px.ACROSS_Y, n], work[px.ACROSS_Z, n] = step, zero, -step * to_east * per_m
            work[px.DOWN_X, n], work[px.DOWN_Y, n], work[px.DOWN_Z, n] = zero, step, -step * to_north * per_m
            n += 1
        total[:] = 0
        add_walls(surface, work, cells, n, weight, total)
        for k in range(n):
            u = cells[0, k]
            for band in range(3):
                albedo[v, u, band] = np.uint8(total[3 * u + band] + weight[u] * albedo[v, u, band] + np.float32(0.5))
            weight[u] = 1


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def add_walls(surface, work, cells, n, weight, total):
    """Adds the colours of walls to n listed pixels of a row (3 W,), and takes their share from its weights (W,)."""
    # rows of `cells` (6, W) int32: columns of the pixels in the image, numbers of their cells in `surface.weights`;
    # `work` (N_ROWS, W) has their rows EAST to DOWN_Z (`pixel_rows`)
    zero, one, half = np.float32(0), np.float32(1), np.float32(0.5)
    along_x, along_y, at, share = work[px.AT_X], work[px.AT_Y], cells[2], work[px.SHARE]
    for i in range(n):
        s, t, w = work[px.COL, i], work[px.ROW, i], surface.weights[cells[1, i]]
        sw, se, nw, ne = (one - s) * (one - t), s * (one - t), (one - s) * t, s * t
        x = sw * w[0, 0, 0] + se * w[0, 1, 0] + nw * w[1, 0, 0] + ne * w[1, 1, 0]
        y = sw * w[0, 0, 1] + se * w[0, 1, 1] + nw * w[1, 0, 1] + ne * w[1, 1, 1]
        work[px.WEIGHT_X, i], work[px.WEIGHT_Y, i] = x, y
        weight[cells[0, i]] = max(one - abs(x) - abs(y), zero)
    for axis in range(2):  # projection along x, then along y
        _footprints(work[px.ACROSS_Y - axis], work[px.DOWN_Y - axis], work, surface.per_m, n)
        for k in range(MOST_SAMPLES):
            m = 0
            for i in range(n):
                part, samples = work[px.WEIGHT_X + axis, i], work[px.SAMPLES, i]
                by = np.float32(k) - half * (samples - one)
                along = work[px.NORTH - axis, i] * surface.per_m + by * work[px.MAJOR_ALONG, i]
                along_x[m] = along if part > zero else surface.length - along
                along_y[m] = work[px.BELOW, i] * surface.per_m + by * work[px.MAJOR_BELOW, i]
                work[px.AT_LEVEL, m], at[m] = work[px.LEVEL, i], cells[0, i]
                share[m] = abs(part) / samples
                m += np.int64((part != zero) & (np.float32(k) < samples))
            if m == 0:
                break
            add_samples(
                surface.texture, along_x, along_y, work[px.AT_LEVEL], share, at, m, work[px.SPARE :], cells[3:], total
            )


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _footprints(across, down, work, per_m, n):
    """Fills the rows MAJOR_ALONG to SAMPLES, and LEVEL, of `work`: the filter of the pixels."""
    # the squared axes of the footprint are the eigenvalues of J J^T, J (2, 2) the displacement in the texture to the
    # next pixels; there are as many samples along the major axis as it is longer than the minor
    zero, one, half, most = np.float32(0), np.float32(1), np.float32(0.5), np.float32(MOST_SAMPLES)
    for i in range(n):
        a, b, c, d = across[i] * per_m, work[px.ACROSS_Z, i] * per_m, down[i] * per_m, work[px.DOWN_Z, i] * per_m
        aa, ab, bb, area = a * a + c * c, a * b + c * d, b * b + d * d, a * d - b * c
        difference = half * (aa - bb)
        major = half * (aa + bb) + np.sqrt(difference * difference + ab * ab)
        ratio = major / np.sqrt(max(area * area, max(major, np.float32(1e-12))))
        samples = min(max(np.floor(ratio + half), one), most)
        along, below = (major - bb, ab) if difference > zero else (ab, major - aa)
        step = np.sqrt(major / max(along * along + below * below, np.float32(1e-20))) / samples
        work[px.MAJOR_ALONG, i], work[px.MAJOR_BELOW, i], work[px.SAMPLES, i] = step * along, step * below, samples
        work[px.LEVEL, i] = major / (samples * samples)
    level_of(work[px.LEVEL, :n])
