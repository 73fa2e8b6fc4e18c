"""The formulas of `optics`, compiled: a row of pixels at a time, in steps that a processor does for many at once."""

from __future__ import annotations

import numpy as np
from numba import njit

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
        sky: daylight (3,); share of it (3, m) over even steps of depth, or None; pattern of the waves (n, n), or None;
            (3, 4) column and row in that pattern and depth below the surface, by place in the eye.
        lit: (n, H, W), or None.
    """
    height, width = depth.shape
    rows, cols, _, ranges = veil.shape
    daylight, down, waves, ground = sky
    way, normal = np.empty(width, np.float32), np.empty((3, width), np.float32)
    lamp, light = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    haze = np.zeros((3, width), np.float32)
    veil_of_row = np.empty((cols, 3, ranges), np.float32)
    sunny = daylight.max() > 0
    for v in range(first, end):
        y = (np.float32(v) - np.float32(0.5) * np.float32(height - 1)) / focal
        _surface(depth, v, y, focal, way, normal)
        light[:] = np.float32(0.0)
        if sunny:
            _add_daylight(depth[v], y, focal, daylight, down, waves, ground, transmission, way, light)
        for k in range(lamps.shape[0]):
            _shine(lamps[k], depth[v], y, focal, normal, lamp)
            if lit is not None:
                for u in range(width):
                    lamp[0, u] = lamp[0, u] if lit[k, v, u] else np.float32(0.0)
            _add_lamp(lamps[k], beams[k], transmission, way, lamp, light)
        if ranges:
            _blend_rows(veil, np.float32(v) * np.float32(rows - 1) / np.float32(height - 1), veil_of_row)
            _look_into_veil(veil_of_row, way, haze)
        if veil_out is None:
            _reflect(albedo[v], light, haze, out[v])
        else:
            _reflect(albedo[v], light, np.zeros((3, width), np.float32), out[v])
            for u in range(width):
                veil_out[v, u, 0], veil_out[v, u, 1], veil_out[v, u, 2] = haze[0, u], haze[1, u], haze[2, u]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
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


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
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


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _add_lamp(lamp, beam, transmission, back, lamplight, light):
    """Adds to `light` (3, W) what a lamp of this beam sends to the floor, on its way there and back."""
    one, per_step = np.float32(1.0), np.float32(1 / PATH_STEP_M)
    red, green, blue = lamp[7], lamp[8], lamp[9]
    steps, last_b = np.float32(beam.size - 1), np.int32(beam.size - 2)
    last = np.int32(transmission.shape[1] - 2)
    for u in range(back.size):
        at = lamplight[1, u] * steps
        i = np.uint32(min(np.int32(at), last_b))
        share = beam[i] + (at - np.float32(i)) * (beam[i + np.uint32(1)] - beam[i])
        e = lamplight[0, u] * share
        at = (lamplight[2, u] + back[u]) * per_step
        i = np.uint32(min(np.int32(at), last))
        j, w = i + np.uint32(1), min(at - np.float32(i), one)
        light[0, u] += e * red * (transmission[0, i] + w * (transmission[0, j] - transmission[0, i]))
        light[1, u] += e * green * (transmission[1, i] + w * (transmission[1, j] - transmission[1, i]))
        light[2, u] += e * blue * (transmission[2, i] + w * (transmission[2, j] - transmission[2, i]))


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _add_daylight(here, y, focal, daylight, down, waves, ground, transmission, back, light):
    """Adds to `light` (3, W) the daylight that falls on a row's floor, on its way back."""
    half, one, far, per_step = np.float32(0.5), np.float32(1.0), np.float32(FAR_M), np.float32(1 / PATH_STEP_M)
    last, width = np.int32(transmission.shape[1] - 2), here.size
    for u in range(width):
        z = here[u]
        if not z < far:
            continue
        x = (np.float32(u) - half * np.float32(width - 1)) / focal * z
        share = one
        if waves is not None:
            col = ground[0, 0] * x + ground[0, 1] * y * z + ground[0, 2] * z + ground[0, 3]
            row = ground[1, 0] * x + ground[1, 1] * y * z + ground[1, 2] * z + ground[1, 3]
            share = _of_pattern(waves, col, row)
        at = back[u] * per_step
        i = np.uint32(min(np.int32(at), last))
        j, w = i + np.uint32(1), min(at - np.float32(i), one)
        k, s = np.uint32(0), np.float32(0.0)
        if down is not None:
            deep = ground[2, 0] * x + ground[2, 1] * y * z + ground[2, 2] * z + ground[2, 3]
            deep = max(deep * per_step, np.float32(0.0))
            k = np.uint32(min(np.int32(deep), np.int32(down.shape[1] - 2)))
            s = min(deep - np.float32(k), one)
        for c in range(3):
            e = share * daylight[c]
            if down is not None:
                e *= down[c, k] + s * (down[c, k + np.uint32(1)] - down[c, k])
            light[c, u] += e * (transmission[c, i] + w * (transmission[c, j] - transmission[c, i]))


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy", inline="always")
def _of_pattern(waves, col, row):
    """Between four points of a pattern (n, n) that repeats itself; n is a power of two."""
    n = waves.shape[0]
    left, low = np.floor(col), np.floor(row)
    w, h = col - left, row - low
    i, k = np.uint32(np.int64(low) & (n - 1)), np.uint32(np.int64(left) & (n - 1))
    j, m = np.uint32((i + 1) & (n - 1)), np.uint32((k + 1) & (n - 1))
    lower = waves[i, k] + w * (waves[i, m] - waves[i, k])
    upper = waves[j, k] + w * (waves[j, m] - waves[j, k])
    return lower + h * (upper - lower)


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _blend_rows(veil, row, out):
    """The table of the veil for one row of pixels: between two rows of the grid."""
    j = min(int(row), veil.shape[0] - 2)
    w = row - np.float32(j)
    lower, upper = veil[j], veil[j + 1]
    for i in range(lower.shape[0]):
        for c in range(3):
            for r in range(lower.shape[2]):
                out[i, c, r] = lower[i, c, r] + w * (upper[i, c, r] - lower[i, c, r])


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _look_into_veil(veil, way, haze):
    """The veil (3, W) in front of a row's floor."""
    cols, _, ranges = veil.shape
    one, per_px, scale = np.float32(1.0), np.float32(cols - 1) / np.float32(way.size - 1), np.float32(RANGE_SCALE_M)
    last_c, last_r = np.int32(cols - 2), np.int32(ranges - 2)
    for u in range(way.size):
        at = np.float32(u) * per_px
        i = np.uint32(min(np.int32(at), last_c))
        w = at - np.float32(i)
        at = way[u] / (way[u] + scale) * np.float32(ranges - 1)
        k = np.uint32(min(np.int32(at), last_r))
        m, s = k + np.uint32(1), min(at - np.float32(k), one)
        j = i + np.uint32(1)
        for c in range(3):
            left = veil[i, c, k] + s * (veil[i, c, m] - veil[i, c, k])
            right = veil[j, c, k] + s * (veil[j, c, m] - veil[j, c, k])
            haze[c, u] = left + w * (right - left)


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _reflect(albedo, light, haze, out):
    """Radiance (W, 3) of a Lambertian floor (albedo of 255) under this light, behind this veil."""
    reflected = np.float32(1 / (255 * np.pi))
    for u in range(out.shape[0]):
        for c in range(3):
            out[u, c] = light[c, u] * (reflected * np.float32(albedo[u, c])) + haze[c, u]
