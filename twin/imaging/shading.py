"""Compiled kernels of `optics`: they process one row of pixels at a time, in loops that the compiler can vectorize.

A table lookup takes two loops over the row: the first computes the table cell and the fraction within the cell
(`lookup`), the second reads the table. This lets the compiler vectorize the first loop. For the same reason, pixels of
colour images are accessed in memory order.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from twin.imaging.powers import LOG2_E, two_to

PATH_STEP_M, PATH_MAX_M = 0.01, 80.0  # step and length of the transmission tables
FAR_M = 1e6  # a pixel with a greater depth shows no floor
RANGE_SCALE_M = 2.0  # scale of the backscatter table, whose steps are even in r / (r + scale), with r the range

_FAST = {"contract", "arcp", "nsz", "reassoc"}  # without "ninf": infinite depths must stay valid


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def shade(albedo, depth, focal, lamps, beams, transmission, scatter_table, sky, out, lit, scatter_out, first, end):
    """Fills rows `first` to `end` of `out` (H, W, 3) with radiance.

    If `scatter_out` (H, W, 3) is given, the backscatter is written to it instead of being added to `out`. The compiler
    removes the code for arguments that are None.

    Args:
        lamps: (n, 10) position [m], beam axis, intensity [cd] and colour of each lamp, in the axes of the camera.
        beams: (n, m) intensity relative to that on the axis, at even steps of sqrt(1 - cos(angle)), 0 to 1.
        transmission: (3, m) transmission at even steps of path length.
        scatter_table: (rows, cols, 3, ranges) backscatter on a coarse pixel grid, at even steps of r / (r + scale).
        sky: illuminance just below the surface (3,) [lx]; attenuation with depth and with range from the camera (2, 3)
            [1/m]; caustics (m + 1, m + 1) or None; (3, 4) map from a point in the camera axes to column and row in the
            caustics and depth below the surface.
        lit: (n, H, W) 0 where the floor blocks the light of a lamp, else 1; None = no shadows.
    """
    height, width = depth.shape
    rows, cols, _, ranges = scatter_table.shape
    daylight, loss, caustics, surface = sky
    range_m, normal = np.empty(width, np.float32), np.empty((3, width), np.float32)
    lamp, light = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    backscatter, dark = np.zeros((3, width), np.float32), np.zeros((3, width), np.float32)
    cells, parts = np.empty((2, width), np.int32), np.empty((2, width), np.float32)
    lookup = cells[0], cells[1], parts[0], parts[1]
    row_table = np.empty((cols, 3, ranges), np.float32)
    sunny = daylight.max() > 0
    for v in range(first, end):
        y = (np.float32(v) - np.float32(0.5) * np.float32(height - 1)) / focal
        _range_and_normal(depth, v, y, focal, range_m, normal)
        light[:] = np.float32(0.0)
        if sunny:
            _sample_caustics(depth[v], y, focal, caustics, surface, lookup, lamp[0])
            _add_daylight(depth[v], y, focal, daylight, loss, surface, range_m, lamp[0], light)
        for k in range(lamps.shape[0]):
            _illuminate(lamps[k], depth[v], y, focal, normal, lamp)
            if lit is not None:
                for u in range(width):
                    lamp[0, u] = lamp[0, u] if lit[k, v, u] else np.float32(0.0)
            _add_lamp(lamps[k], beams[k], transmission, range_m, lamp, lookup, light)
        if ranges:
            _interpolate_rows(scatter_table, np.float32(v) * np.float32(rows - 1) / np.float32(height - 1), row_table)
            _interpolate_backscatter(row_table, range_m, lookup, backscatter)
        if scatter_out is None:
            _reflect(albedo[v], light, backscatter, out[v])
        else:
            _reflect(albedo[v], light, dark, out[v])
            of_row = scatter_out[v].reshape(-1)
            for u in range(width):
                red, green, blue = backscatter[0, u], backscatter[1, u], backscatter[2, u]
                of_row[3 * u], of_row[3 * u + 1], of_row[3 * u + 2] = red, green, blue


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _range_and_normal(depth, v, y, focal, range_m, normal):
    """Computes range and unit normal (3, W) of the floor in a row of pixels; the normal points towards the camera.

    The normal is computed from the depth gradient. In each direction, the smaller of the depth differences to the two
    neighbours is used, so a depth edge does not tilt the normals next to it.
    """
    height, width = depth.shape
    one, half, beyond, far = np.float32(1.0), np.float32(0.5), np.float32(np.inf), np.float32(FAR_M)
    here, above, below = depth[v], depth[max(v - 1, 0)], depth[min(v + 1, height - 1)]
    first, last = v == 0, v == height - 1
    for u in range(width):
        z = here[u]
        x = (np.float32(u) - half * np.float32(width - 1)) / focal
        left = z - here[u - 1] if u > 0 else beyond
        right = here[u + 1] - z if u + 1 < width else beyond
        up = beyond if first else z - above[u]
        down = beyond if last else below[u] - z
        nx = focal * (left if abs(left) < abs(right) else right)
        ny = focal * (up if abs(up) < abs(down) else down)
        nz = -(z + x * nx + y * ny)
        per_n = one / np.sqrt(nx * nx + ny * ny + nz * nz)
        normal[0, u], normal[1, u], normal[2, u] = nx * per_n, ny * per_n, nz * per_n
        range_m[u] = z * np.sqrt(x * x + y * y + one) if z < far else far


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _illuminate(lamp, here, y, focal, normal, out):
    """Computes the illumination of the floor by a lamp for a row of pixels, without beam pattern and attenuation.

    Fills `out` (3, W): row 0 with the illuminance that an isotropic lamp would cause in clear water, row 1 with
    sqrt(1 - cos(angle from the beam axis)), row 2 with the distance from the lamp.
    """
    one, half, zero, far = np.float32(1.0), np.float32(0.5), np.float32(0.0), np.float32(FAR_M)
    x0, y0, z0, ax, ay, az, intensity = lamp[0], lamp[1], lamp[2], lamp[3], lamp[4], lamp[5], lamp[6]
    width = here.size
    for u in range(width):
        z = here[u]
        there = z < far
        z = z if there else one
        x = (np.float32(u) - half * np.float32(width - 1)) / focal
        dx, dy, dz = x * z - x0, y * z - y0, z - z0
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        per_d = one / distance
        facing = -(dx * normal[0, u] + dy * normal[1, u] + dz * normal[2, u]) * per_d
        along = (dx * ax + dy * ay + dz * az) * per_d
        lights = there & (facing > zero) & (along > zero)
        out[0, u] = intensity * facing * per_d * per_d if lights else zero
        out[1, u] = np.sqrt(max(one - along, zero)) if lights else one
        out[2, u] = distance


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _add_lamp(lamp, beam, transmission, range_m, lamplight, lookup, light):
    """Adds to `light` (3, W) the illuminance by a lamp, attenuated on the path from lamp to floor to camera."""
    one, per_step = np.float32(1.0), np.float32(1 / PATH_STEP_M)
    red, green, blue = lamp[7], lamp[8], lamp[9]
    steps, last_b = np.float32(beam.size - 1), np.int32(beam.size - 2)
    last = np.int32(transmission.shape[1] - 2)
    at_beam, at_path, part_of_beam, part_of_path = lookup
    for u in range(range_m.size):
        at = lamplight[1, u] * steps
        at_beam[u] = min(np.int32(at), last_b)
        part_of_beam[u] = at - np.float32(at_beam[u])
        at = (lamplight[2, u] + range_m[u]) * per_step
        at_path[u] = min(np.int32(at), last)
        part_of_path[u] = min(at - np.float32(at_path[u]), one)
    for u in range(range_m.size):
        i, w = np.uint32(at_beam[u]), part_of_beam[u]
        e = lamplight[0, u] * (beam[i] + w * (beam[i + np.uint32(1)] - beam[i]))
        i, w = np.uint32(at_path[u]), part_of_path[u]
        j = i + np.uint32(1)
        light[0, u] += e * red * (transmission[0, i] + w * (transmission[0, j] - transmission[0, i]))
        light[1, u] += e * green * (transmission[1, i] + w * (transmission[1, j] - transmission[1, i]))
        light[2, u] += e * blue * (transmission[2, i] + w * (transmission[2, j] - transmission[2, i]))


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _sample_caustics(here, y, focal, caustics, surface, lookup, share):
    """Fills `share` (W,) with the daylight on the floor relative to its mean, for a row of pixels; 0 without floor."""
    half, one, zero, far = np.float32(0.5), np.float32(1.0), np.float32(0.0), np.float32(FAR_M)
    for u in range(here.size):
        share[u] = one if here[u] < far else zero
    if caustics is None:
        return
    last, stride = np.int32(caustics.shape[0] - 2), np.uint32(caustics.shape[0])
    at, _, to_east, to_north = lookup
    for u in range(here.size):
        z = here[u] if here[u] < far else zero
        x, down = (np.float32(u) - half * np.float32(here.size - 1)) / focal * z, y * z
        col = surface[0, 0] * x + surface[0, 1] * down + surface[0, 2] * z + surface[0, 3]
        row = surface[1, 0] * x + surface[1, 1] * down + surface[1, 2] * z + surface[1, 3]
        left, low = np.floor(col), np.floor(row)
        to_east[u], to_north[u] = col - left, row - low
        at[u] = (np.int32(low) & last) * np.int32(stride) + (np.int32(left) & last)
    flat = caustics.reshape(-1)
    for u in range(here.size):
        i, w = np.uint32(at[u]), to_east[u]
        k = i + stride
        south = flat[i] + w * (flat[i + np.uint32(1)] - flat[i])
        north = flat[k] + w * (flat[k + np.uint32(1)] - flat[k])
        share[u] *= south + to_north[u] * (north - south)


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _add_daylight(here, y, focal, daylight, loss, surface, range_m, share, light):
    """Adds to `light` (3, W) the daylight on the floor, attenuated on the path to the camera.

    `share` (W,) is the daylight on the floor relative to its mean, see `_sample_caustics`.
    """
    half, zero, far = np.float32(0.5), np.float32(0.0), np.float32(FAR_M)
    for c in range(3):
        incident, by_depth, by_range = daylight[c], -np.float32(LOG2_E) * loss[0, c], -np.float32(LOG2_E) * loss[1, c]
        for u in range(here.size):
            z = here[u] if here[u] < far else zero
            x = (np.float32(u) - half * np.float32(here.size - 1)) / focal * z
            deep = max(surface[2, 0] * x + surface[2, 1] * (y * z) + surface[2, 2] * z + surface[2, 3], zero)
            light[c, u] += share[u] * incident * two_to(by_depth * deep + by_range * range_m[u])


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _interpolate_rows(table, row, out):
    """Fills `out` (cols, 3, ranges) with the backscatter for a row of pixels, interpolated between rows of `table`."""
    j = min(int(row), table.shape[0] - 2)
    w = row - np.float32(j)
    lower, upper = table[j], table[j + 1]
    for i in range(lower.shape[0]):
        for c in range(3):
            for r in range(lower.shape[2]):
                out[i, c, r] = lower[i, c, r] + w * (upper[i, c, r] - lower[i, c, r])


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _interpolate_backscatter(table, range_m, lookup, backscatter):
    """Fills `backscatter` (3, W) for a row of pixels by bilinear interpolation of `table` in column and range.

    The bands deliberately differ in the order of operations: another order would change the last bits of the images.
    """
    cols, _, ranges = table.shape
    one, scale = np.float32(1.0), np.float32(RANGE_SCALE_M)
    n_cols, per_px = np.float32(cols - 1), one / np.float32(range_m.size - 1)
    last_c, last_r = np.int32(cols - 2), np.int32(ranges - 2)
    at_col, at_range, part_of_col, part_of_range = lookup
    for u in range(range_m.size):
        at = np.float32(u) * n_cols * per_px
        at_col[u] = min(np.int32(at), last_c)
        part_of_col[u] = at - np.float32(at_col[u])
        at = range_m[u] * np.float32(ranges - 1) / (range_m[u] + scale)
        at_range[u] = min(np.int32(at), last_r)
        part_of_range[u] = min(at - np.float32(at_range[u]), one)
    for u in range(range_m.size):
        i, w = np.uint32(at_col[u]), part_of_col[u]
        k, s = np.uint32(at_range[u]), part_of_range[u]
        j, m = i + np.uint32(1), k + np.uint32(1)
        left = table[i, 0, k] + s * (table[i, 0, m] - table[i, 0, k])
        right = table[j, 0, k] + s * (table[j, 0, m] - table[j, 0, k])
        backscatter[0, u] = left + w * (right - left)
        left = table[i, 1, k] + s * (table[i, 1, m] - table[i, 1, k])
        backscatter[1, u] = left + w * ((table[j, 1, k] - left) + s * (table[j, 1, m] - table[j, 1, k]))
        left = table[i, 2, k] + s * (table[i, 2, m] - table[i, 2, k])
        backscatter[2, u] = left + w * ((table[j, 2, k] - left) + s * (table[j, 2, m] - table[j, 2, k]))


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _reflect(albedo, light, backscatter, out):
    """Fills `out` (W, 3) with the radiance of a Lambertian floor (an albedo of 255 is white) plus the backscatter."""
    reflected = np.float32(1 / (255 * np.pi))
    white, filled = albedo.reshape(-1), out.reshape(-1)
    for u in range(out.shape[0]):
        filled[3 * u] = light[0, u] * (reflected * np.float32(white[3 * u])) + backscatter[0, u]
        filled[3 * u + 1] = light[1, u] * (reflected * np.float32(white[3 * u + 1])) + backscatter[1, u]
        filled[3 * u + 2] = light[2, u] * (reflected * np.float32(white[3 * u + 2])) + backscatter[2, u]
