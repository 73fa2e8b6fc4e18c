"""The formulas of `optics`, compiled: a row of pixels at a time, in steps that a processor does for many at once.

Where a table is looked up, a first loop over the row finds the cell and how far in it (`places`), a second one reads:
the first is then done for many pixels at once. Rows of colours are indexed as they lie in memory, for the same reason.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from twin.imaging.powers import LOG2_E, two_to

PATH_STEP_M, PATH_MAX_M = 0.01, 80.0  # of the tables of transmission
FAR_M = 1e6  # no floor beyond
RANGE_SCALE_M = 2.0  # of the table of the veil: even steps of r / (r + scale)

_FAST = {"contract", "arcp", "nsz", "reassoc"}  # infinities keep their meaning


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def shade(albedo, depth, focal, lamps, beams, transmission, veil, sky, out, lit, veil_out, first, end):
    """Fills rows `first` to `end` of `out` (H, W, 3) with radiance.

    Where `veil_out` is given, the veil goes there. What is None is compiled away.

    Args:
        lamps: (n, 10) position, axis, intensity, colour.
        beams: (n, m) share of the intensity on the axis over even steps of sqrt(1 - cos) of the angle off it, 0 to 1.
        transmission: (3, m) over even steps of path.
        veil: (rows, cols, 3, ranges) over a coarse grid of pixels and even r / (r + scale).
        sky: daylight at the surface (3,); its loss by depth and by path to the eye (2, 3) [1/m]; pattern of the waves
            (n + 1, n + 1), or None; (3, 4) column and row in it and depth below the surface, by place in the eye.
        lit: (n, H, W), or None.
    """
    height, width = depth.shape
    rows, cols, _, ranges = veil.shape
    daylight, loss, waves, ground = sky
    way, normal = np.empty(width, np.float32), np.empty((3, width), np.float32)
    lamp, light = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    haze, dark = np.zeros((3, width), np.float32), np.zeros((3, width), np.float32)
    cells, parts = np.empty((2, width), np.int32), np.empty((2, width), np.float32)
    places = cells[0], cells[1], parts[0], parts[1]
    veil_of_row = np.empty((cols, 3, ranges), np.float32)
    sunny = daylight.max() > 0
    for v in range(first, end):
        y = (np.float32(v) - np.float32(0.5) * np.float32(height - 1)) / focal
        _surface(depth, v, y, focal, way, normal)
        light[:] = np.float32(0.0)
        if sunny:
            _cast_waves(depth[v], y, focal, waves, ground, places, lamp[0])
            _add_daylight(depth[v], y, focal, daylight, loss, ground, way, lamp[0], light)
        for k in range(lamps.shape[0]):
            _shine(lamps[k], depth[v], y, focal, normal, lamp)
            if lit is not None:
                for u in range(width):
                    lamp[0, u] = lamp[0, u] if lit[k, v, u] else np.float32(0.0)
            _add_lamp(lamps[k], beams[k], transmission, way, lamp, places, light)
        if ranges:
            _blend_rows(veil, np.float32(v) * np.float32(rows - 1) / np.float32(height - 1), veil_of_row)
            _look_into_veil(veil_of_row, way, places, haze)
        if veil_out is None:
            _reflect(albedo[v], light, haze, out[v])
        else:
            _reflect(albedo[v], light, dark, out[v])
            of_row = veil_out[v].reshape(-1)
            for u in range(width):
                of_row[3 * u], of_row[3 * u + 1], of_row[3 * u + 2] = haze[0, u], haze[1, u], haze[2, u]


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _surface(depth, v, y, focal, way, normal):
    """Range of a row's floor, and its unit normal (3, W) towards the eye, from the gradient of depth in the image.

    Of the slopes to both neighbours the smaller counts: an edge of the floor does not bend the surface beside it.
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
        way[u] = z * np.sqrt(x * x + y * y + one) if z < far else far


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _shine(lamp, here, y, focal, normal, out):
    """Of a lamp over a row: illuminance in clear water by an even beam, sqrt(1 - cos) off its axis, distance."""
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
def _add_lamp(lamp, beam, transmission, back, lamplight, places, light):
    """Adds to `light` (3, W) what a lamp of this beam sends to the floor, on its way there and back."""
    one, per_step = np.float32(1.0), np.float32(1 / PATH_STEP_M)
    red, green, blue = lamp[7], lamp[8], lamp[9]
    steps, last_b = np.float32(beam.size - 1), np.int32(beam.size - 2)
    last = np.int32(transmission.shape[1] - 2)
    at_beam, at_path, part_of_beam, part_of_path = places
    for u in range(back.size):
        at = lamplight[1, u] * steps
        at_beam[u] = min(np.int32(at), last_b)
        part_of_beam[u] = at - np.float32(at_beam[u])
        at = (lamplight[2, u] + back[u]) * per_step
        at_path[u] = min(np.int32(at), last)
        part_of_path[u] = min(at - np.float32(at_path[u]), one)
    for u in range(back.size):
        i, w = np.uint32(at_beam[u]), part_of_beam[u]
        e = lamplight[0, u] * (beam[i] + w * (beam[i + np.uint32(1)] - beam[i]))
        i, w = np.uint32(at_path[u]), part_of_path[u]
        j = i + np.uint32(1)
        light[0, u] += e * red * (transmission[0, i] + w * (transmission[0, j] - transmission[0, i]))
        light[1, u] += e * green * (transmission[1, i] + w * (transmission[1, j] - transmission[1, i]))
        light[2, u] += e * blue * (transmission[2, i] + w * (transmission[2, j] - transmission[2, i]))


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _cast_waves(here, y, focal, waves, ground, places, share):
    """Fills `share` (W,) with the light of a row's floor against the mean: 0 where no floor is."""
    half, one, zero, far = np.float32(0.5), np.float32(1.0), np.float32(0.0), np.float32(FAR_M)
    for u in range(here.size):
        share[u] = one if here[u] < far else zero
    if waves is None:
        return
    last, stride = np.int32(waves.shape[0] - 2), np.uint32(waves.shape[0])
    at, _, to_east, to_north = places
    for u in range(here.size):
        z = here[u] if here[u] < far else zero
        x, down = (np.float32(u) - half * np.float32(here.size - 1)) / focal * z, y * z
        col = ground[0, 0] * x + ground[0, 1] * down + ground[0, 2] * z + ground[0, 3]
        row = ground[1, 0] * x + ground[1, 1] * down + ground[1, 2] * z + ground[1, 3]
        left, low = np.floor(col), np.floor(row)
        to_east[u], to_north[u] = col - left, row - low
        at[u] = (np.int32(low) & last) * np.int32(stride) + (np.int32(left) & last)
    flat = waves.reshape(-1)
    for u in range(here.size):
        i, w = np.uint32(at[u]), to_east[u]
        k = i + stride
        south = flat[i] + w * (flat[i + np.uint32(1)] - flat[i])
        north = flat[k] + w * (flat[k + np.uint32(1)] - flat[k])
        share[u] *= south + to_north[u] * (north - south)


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _add_daylight(here, y, focal, daylight, loss, ground, back, share, light):
    """Adds to `light` (3, W) the daylight that falls on a row's floor, by a share of each pixel, on its way back."""
    half, zero, far = np.float32(0.5), np.float32(0.0), np.float32(FAR_M)
    for c in range(3):
        surface, by_depth, by_way = daylight[c], -np.float32(LOG2_E) * loss[0, c], -np.float32(LOG2_E) * loss[1, c]
        for u in range(here.size):
            z = here[u] if here[u] < far else zero
            x = (np.float32(u) - half * np.float32(here.size - 1)) / focal * z
            deep = max(ground[2, 0] * x + ground[2, 1] * (y * z) + ground[2, 2] * z + ground[2, 3], zero)
            light[c, u] += share[u] * surface * two_to(by_depth * deep + by_way * back[u])


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _blend_rows(veil, row, out):
    """The table of the veil for one row of pixels: between two rows of the grid."""
    j = min(int(row), veil.shape[0] - 2)
    w = row - np.float32(j)
    lower, upper = veil[j], veil[j + 1]
    for i in range(lower.shape[0]):
        for c in range(3):
            for r in range(lower.shape[2]):
                out[i, c, r] = lower[i, c, r] + w * (upper[i, c, r] - lower[i, c, r])


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _look_into_veil(veil, way, places, haze):
    """The veil (3, W) in front of a row's floor.

    Each band is the same mean of four, in the order in which images have been made since the first, to the last bit.
    """
    cols, _, ranges = veil.shape
    one, scale = np.float32(1.0), np.float32(RANGE_SCALE_M)
    n_cols, per_px = np.float32(cols - 1), one / np.float32(way.size - 1)
    last_c, last_r = np.int32(cols - 2), np.int32(ranges - 2)
    at_col, at_range, part_of_col, part_of_range = places
    for u in range(way.size):
        at = np.float32(u) * n_cols * per_px
        at_col[u] = min(np.int32(at), last_c)
        part_of_col[u] = at - np.float32(at_col[u])
        at = way[u] * np.float32(ranges - 1) / (way[u] + scale)
        at_range[u] = min(np.int32(at), last_r)
        part_of_range[u] = min(at - np.float32(at_range[u]), one)
    for u in range(way.size):
        i, w = np.uint32(at_col[u]), part_of_col[u]
        k, s = np.uint32(at_range[u]), part_of_range[u]
        j, m = i + np.uint32(1), k + np.uint32(1)
        left = veil[i, 0, k] + s * (veil[i, 0, m] - veil[i, 0, k])
        right = veil[j, 0, k] + s * (veil[j, 0, m] - veil[j, 0, k])
        haze[0, u] = left + w * (right - left)
        left = veil[i, 1, k] + s * (veil[i, 1, m] - veil[i, 1, k])
        haze[1, u] = left + w * ((veil[j, 1, k] - left) + s * (veil[j, 1, m] - veil[j, 1, k]))
        left = veil[i, 2, k] + s * (veil[i, 2, m] - veil[i, 2, k])
        haze[2, u] = left + w * ((veil[j, 2, k] - left) + s * (veil[j, 2, m] - veil[j, 2, k]))


@njit(cache=True, nogil=True, forceinline=True, fastmath=_FAST, error_model="numpy")
def _reflect(albedo, light, haze, out):
    """Radiance (W, 3) of a Lambertian floor (albedo of 255) under this light, behind this veil."""
    reflected = np.float32(1 / (255 * np.pi))
    white, filled = albedo.reshape(-1), out.reshape(-1)
    for u in range(out.shape[0]):
        filled[3 * u] = light[0, u] * (reflected * np.float32(white[3 * u])) + haze[0, u]
        filled[3 * u + 1] = light[1, u] * (reflected * np.float32(white[3 * u + 1])) + haze[1, u]
        filled[3 * u + 2] = light[2, u] * (reflected * np.float32(white[3 * u + 2])) + haze[2, u]
