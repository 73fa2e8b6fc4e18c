"""Compiled kernels of `optics`: one row of pixels at a time, in loops that the compiler can vectorize.

A table lookup takes two loops: the first computes the cell and the fraction within it (`lookup`), the second reads.
"""

import numpy as np

from twin.core.vector_math import LOG2_E, sum_of_entries, two_to
from twin.imaging.scene.facets import UNIT
from twin.imaging.scene.materials import add_reflected
from twin.kernels import kernel

FAR_M = 1e6  # a pixel with a greater depth shows no floor
HIDDEN_STEPS = 127  # steps of the hidden share of scattered light in `optics.SceneView.lit`
RANGE_SCALE_M = 2.0  # scale of the tables with equal steps of r / (r + scale), r the range or the distance from a lamp
#: Columns and rows, each different, relative to the centre of a pixel, at which it samples the facets [px].
SAMPLES = np.array([(-7, -7), (-5, -1), (-3, 5), (-1, -5), (1, 1), (3, 7), (5, -3), (7, 3)], np.float32) / 16

_FAST = {"contract", "arcp", "nsz", "reassoc"}  # without "ninf": infinite depths must stay valid


@kernel(fastmath=_FAST, error_model="numpy")
def shade(
    albedo, depth, focal, lamps, beams, soft, lamp_loss, scatter_table, sky, facets, lit, material, objects, out,
    other, kept, place, first, end,
):  # fmt: skip
    """Computes the light of the floor and the backscatter in rows `first` to `end` - 1 of an image.

    An empty array stands for an effect that the image does not have, so that one compiled version serves all images;
    for `material` None, the compiler removes the code of materials. In the steps of the tables, r is the range from the
    camera, d the distance from a lamp, and the scale is `RANGE_SCALE_M`.

    Args:
        albedo: (H, W, 3) uint8, 255 = white.
        depth: (H, W) depth along the optical axis [m]; inf where there is no floor.
        lamps: (n, 10) position [m], beam axis, intensity [cd] and colour of each lamp, in the axes of the camera.
        beams: (n, m) relative intensity, at even steps of sqrt(1 - cos(angle)) from 0 to 1.
        soft: (n, 2, k, l, 4) `lamp_light.floor_tables`.
        lamp_loss: (3,) attenuation of the unscattered light of lamps on its way to the floor [1/m].
        scatter_table: (rows, cols, ranges, 4) backscatter on a coarse pixel grid, at even steps of r / (r + scale).
        sky: direction to the sun (3,) in the axes of the camera; beam (3, 2) [lx], [1/m], all other daylight (3, 10)
            [lx] and its change with depth (3, 2), as in `daylight.FloorDaylight`, with the quadratic form as xx, yy,
            zz, 2 xy, 2 xz, 2 yz, 2 x, 2 y, 2 z, 1; its reference depth and limits of the fit (3,) [m]; loss with range
            (2, 3) of lamp light and daylight [1/m]; caustics (m + 1, m + 1); (3, 4) map from camera axes to column and
            row of the caustics and depth [m].
        facets, lit, material, objects: see `optics.SceneView`.
        out: (H, W, 3) image, filled with the light of the floor that reaches the camera.
        other: (H, W, 3) image for the backscatter and the share `kept` of the floor; empty: backscatter goes to `out`.
        kept: (m, 4) share of the light of the floor that arrives without blur, at even steps of r / (r + scale).
        place: filled with the fractional row of `kept` for every second pixel of every second row.
    """
    height, width = depth.shape
    rows, cols, ranges, _ = scatter_table.shape
    to_sun, beam, diffuse, change, fitted, loss, caustics, surface = sky
    range_m, normal = np.empty(width, np.float32), np.empty((3, width), np.float32)
    lamp, light = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    backscatter, reflected = np.zeros((3, width), np.float32), np.zeros((3, width), np.float32)
    arriving = np.empty((3, width), np.float32)
    cells, parts = np.empty((2, width), np.int32), np.empty((2, width), np.float32)
    samples = np.empty((SAMPLES.shape[0] + 1, width), np.int32)
    lookup = cells[0], cells[1], parts[0], parts[1]
    row_table, shown = np.empty((cols, ranges, 4), np.float32), np.ones(width, np.uint8)
    sunny = beam[:, 0].max() > 0 or diffuse.max() > 0
    softened, shadowed, apart = soft.shape[0] > 0, lit.shape[0] > 0, other.shape[0] > 0
    for v in range(first, end):
        y = (np.float32(v) - np.float32(0.5) * np.float32(height - 1)) / focal
        if facets.normals.shape[0] == 0:
            _range_and_normal(depth, v, y, focal, range_m, normal)
        else:
            _range_and_facet_normal(facets, depth[v], y, focal, samples, cells[0], cells[1], lamp, range_m, normal)
        if objects.label.shape[0] > 0:
            _take_normals(objects, v, normal)
        light[:] = np.float32(0.0)
        reflected[:] = np.float32(0.0)
        for k in range(lamps.shape[0]):
            _illuminate(lamps[k], depth[v], y, focal, normal, lamp)
            if shadowed:
                for u in range(width):
                    shown[u] = lit[k, v, u] & np.uint8(1)
            if softened:
                _add_soft_lamp(lamps[k], soft[k], lamp, shown, material is None, lookup, light)
                if shadowed:
                    _hide_scattered(lamps[k], soft[k], lamp[0], lit[k, v], lookup, light)
            if material is not None or not softened:
                for u in range(width):
                    lamp[0, u] = lamp[0, u] if shown[u] else np.float32(0.0)
            if material is None and not softened:
                _add_lamp(lamps[k], beams[k], lamp_loss, lamp, lookup, light)
            elif material is not None:
                arriving[:] = np.float32(0.0)
                _add_lamp(lamps[k], beams[k], lamp_loss, lamp, lookup, arriving)
                add_reflected(material, lamps[k], albedo[v], depth[v], y, focal, normal, arriving, reflected)
        if lamps.shape[0]:
            _attenuate(loss[0], range_m, light)
            if material is not None:
                _attenuate(loss[0], range_m, reflected)
        if sunny:
            _sample_caustics(depth[v], y, focal, caustics, surface, lookup, lamp[0])
            _face_sun(depth[v], y, focal, to_sun, surface, normal, lamp)
            if lit.shape[0] > lamps.shape[0]:
                for u in range(width):
                    lamp[1, u] = lamp[1, u] if lit[lamps.shape[0], v, u] else np.float32(0.0)
            _add_daylight((beam, diffuse, change, fitted, loss[1]), normal, range_m, lamp, light)
        if ranges:
            _interpolate_rows(scatter_table, np.float32(v) * np.float32(rows - 1) / np.float32(height - 1), row_table)
            _interpolate_backscatter(row_table, range_m, lookup, backscatter)
        if not apart:
            reflected += backscatter
        _reflect(albedo[v], light, reflected, out[v])
        if apart:
            _join(out[v], v, kept, place, range_m, backscatter, lookup, other[v])


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _range_and_facet_normal(facets, here, y, focal, cells, stored, mixed, work, range_m, normal):
    """Computes range (W,) and upward normals (3, W) in camera axes, in a row of pixels; of several facets, the mean."""
    # at `SAMPLES`, on the plane of the central facet: the light of a matt facet is proportional to a component of its
    # normal
    normals, origin, grid, turn = facets
    zero, one, half, far = np.float32(0), np.float32(1), np.float32(0.5), np.float32(FAR_M)
    centre, flat, n_samples = half * np.float32(here.size - 1), normals.reshape(-1), SAMPLES.shape[0]
    z, along, down = work[0], work[1], work[2]  # depth, its relative decrease per pixel along the row and down
    for u in range(here.size):
        x = (np.float32(u) - centre) / focal
        range_m[u] = here[u] * np.sqrt(x * x + y * y + one) if here[u] < far else far
        z[u] = here[u] if here[u] < far else zero
        along[u], down[u] = zero, zero
    _cells_of_points(facets, (z, along, down), y, focal, (zero, zero), cells[n_samples])
    for u in range(here.size):
        stored[u] = flat[np.uint32(cells[n_samples, u])]
    for u in range(here.size):
        nx, ny, nz = _turned(turn, _unpacked(stored[u]))
        normal[0, u], normal[1, u], normal[2, u] = nx, ny, nz
        x = (np.float32(u) - centre) / focal
        per_px = one / (focal * min(x * nx + y * ny + nz, np.float32(-0.05)))
        along[u], down[u] = nx * per_px, ny * per_px
        mixed[u] = 0
    for k in range(n_samples):
        _cells_of_points(facets, (z, along, down), y, focal, (SAMPLES[k, 0], SAMPLES[k, 1]), cells[k])
        for u in range(here.size):
            mixed[u] |= cells[0, u] ^ cells[k, u]
    n = 0
    for u in range(here.size):
        several, mixed[n] = mixed[u] != 0, u
        n += several
    total, share = work, one / np.float32(n_samples)
    for i in range(n):
        total[0, i], total[1, i], total[2, i] = zero, zero, zero
    for k in range(n_samples):
        for i in range(n):
            stored[i] = flat[np.uint32(cells[k, mixed[i]])]
        for i in range(n):
            nx, ny, nz = _unpacked(stored[i])
            total[0, i] += nx * share
            total[1, i] += ny * share
            total[2, i] += nz * share
    for i in range(n):
        u = mixed[i]
        normal[0, u], normal[1, u], normal[2, u] = _turned(turn, (total[0, i], total[1, i], total[2, i]))


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _cells_of_points(facets, floor, y, focal, shift, cells):
    """Fills `cells` (W,) with the number of the facet that each pixel of a row shows at a point within the pixel."""
    normals, origin, grid, _ = facets
    z, along, down = floor
    rows, cols, _ = normals.shape
    zero, one, two, half = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
    west, south = -np.float32(origin[0]), -np.float32(origin[1])
    east, north = west + np.float32(cols - 1), south + np.float32(rows - 1)
    left, below = half * np.float32(z.size - 1) - shift[0], y + shift[1] / focal
    col_x, row_x, col_0, row_0 = grid[0, 0], grid[1, 0], grid[0, 3], grid[1, 3]
    col_z, row_z = grid[0, 1] * below + grid[0, 2], grid[1, 1] * below + grid[1, 2]
    per_row, first = np.float32(2 * cols), np.float32(2 * (np.int64(origin[1]) * cols + origin[0]))
    for u in range(z.size):
        depth = z[u] * (one - along[u] * shift[0] - down[u] * shift[1])
        x = (np.float32(u) - left) / focal
        col, row = depth * (col_x * x + col_z) + col_0, depth * (row_x * x + row_z) + row_0
        c, r = min(max(np.floor(col), west), east), min(max(np.floor(row), south), north)
        north_west = zero if col - c >= row - r else one
        cells[u] = np.int32(r * per_row + (two * c + north_west) + first)  # exact: there are fewer than 2^24 facets


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _unpacked(stored):
    """Returns the normal (x, y, z) of a stored normal, see `facets`."""
    bits, one, two, unit = np.int32(16), np.float32(1), np.float32(2), np.float32(1) / np.float32(UNIT)
    high, low = np.int32(stored >> bits), np.int32(np.int32(stored << bits) >> bits)
    a, b = np.float32(high) * unit, np.float32(low) * unit
    square = a * a + b * b
    per_n = one / (one + square)
    return two * a * per_n, two * b * per_n, (one - square) * per_n


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _turned(turn, vector):
    x, y, z = vector
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@kernel(forceinline=True, error_model="numpy")
def _take_normals(objects, v, normal):
    normals, labels = objects
    for u in range(labels.shape[1]):
        if labels[v, u]:
            normal[0, u], normal[1, u], normal[2, u] = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _range_and_normal(depth, v, y, focal, range_m, normal):
    """Computes range (W,) and unit normals (3, W), towards the camera, from the depth of a floor without facets."""
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


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _illuminate(lamp, here, y, focal, normal, out):
    """Fills `out` (3, W): illuminance by a lamp in clear water, sqrt(1 - cos(angle from its axis)), distance."""
    # 0 and 1 without floor, where it faces away, and more than 90 deg from the beam axis
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


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _add_lamp(lamp, beam, per_m, lamplight, lookup, light):
    """Adds to `light` (3, W) the illuminance by the unscattered light of a lamp."""
    steps, last = np.float32(beam.size - 1), np.int32(beam.size - 2)
    cell, _, share, _ = lookup
    for u in range(light.shape[1]):
        at = lamplight[1, u] * steps
        cell[u] = min(np.int32(at), last)
        share[u] = at - np.float32(cell[u])
    for u in range(light.shape[1]):
        i = np.uint32(cell[u])
        share[u] = lamplight[0, u] * (beam[i] + share[u] * (beam[i + np.uint32(1)] - beam[i]))
    for c in range(3):
        colour, by_path = lamp[7 + c], -np.float32(LOG2_E) * per_m[c]
        for u in range(light.shape[1]):
            light[c, u] += share[u] * colour * two_to(by_path * lamplight[2, u])


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _add_soft_lamp(lamp, soft, lamplight, lit, direct, lookup, light):
    """Adds to `light` (3, W) the illuminance by a lamp, by bilinear interpolation of its table `soft`, see `shade`."""
    one, scale = np.float32(1.0), np.float32(RANGE_SCALE_M)
    red, green, blue = lamp[7], lamp[8], lamp[9]
    _, n_rows, n_cols, _ = soft.shape
    rows, cols = np.float32(n_rows - 1), np.float32(n_cols - 1)
    last_r, last_c, stride = np.int32(n_rows - 2), np.int32(n_cols - 2), np.int32(4 * n_cols)
    cell, _, part_of_row, part_of_col = lookup
    all_light = np.int32(4 * n_rows * n_cols) if direct else np.int32(0)
    for u in range(light.shape[1]):
        at = lamplight[1, u] * rows
        row = min(np.int32(at), last_r)
        part_of_row[u] = min(at - np.float32(row), one)
        at = lamplight[2, u] * cols / (lamplight[2, u] + scale)
        col = min(np.int32(at), last_c)
        part_of_col[u] = min(at - np.float32(col), one)
        cell[u] = row * stride + np.int32(4) * col + (all_light if lit[u] else np.int32(0))
    flat = soft.reshape(-1)
    for u in range(light.shape[1]):
        i, w, s, e = np.uint32(cell[u]), part_of_row[u], part_of_col[u], lamplight[0, u]
        j, k = i + np.uint32(4), i + np.uint32(stride)
        m = k + np.uint32(4)
        shares = (one - w) * (one - s), (one - w) * s, w * (one - s), w * s
        r, g, b = sum_of_entries(flat, (i, j, k, m), shares)  # pyright: ignore
        light[0, u] += e * red * r
        light[1, u] += e * green * g
        light[2, u] += e * blue * b


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _hide_scattered(lamp, soft, lamplight, lit, lookup, light):
    """Subtracts the scattered light that relief hides (see `lit`) from `light` (3, W), after `_add_soft_lamp`."""
    one, per_step = np.float32(1.0), np.float32(1 / HIDDEN_STEPS)
    _, n_rows, n_cols, _ = soft.shape
    cell, _, part_of_row, part_of_col = lookup
    size, stride, flat = np.int32(4 * n_rows * n_cols), np.uint32(4 * n_cols), soft.reshape(-1)
    for u in range(light.shape[1]):
        hidden = lit[u] >> np.uint8(1)
        if hidden == 0:
            continue
        i, w, s = np.uint32(cell[u] % size), part_of_row[u], part_of_col[u]
        places = i, i + np.uint32(4), i + stride, i + stride + np.uint32(4)
        shares = (one - w) * (one - s), (one - w) * s, w * (one - s), w * s
        r, g, b = sum_of_entries(flat, places, shares)  # pyright: ignore
        e = lamplight[u] * np.float32(hidden) * per_step
        light[0, u] -= e * lamp[7] * r
        light[1, u] -= e * lamp[8] * g
        light[2, u] -= e * lamp[9] * b


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _attenuate(per_m, range_m, light):
    for c in range(3):
        by_range = -np.float32(LOG2_E) * per_m[c]
        for u in range(range_m.size):
            light[c, u] *= two_to(by_range * range_m[u])


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _sample_caustics(here, y, focal, caustics, surface, lookup, share):
    """Fills `share` (W,) with the daylight on the floor relative to its mean, for a row of pixels; 0 without floor."""
    half, one, zero, far = np.float32(0.5), np.float32(1.0), np.float32(0.0), np.float32(FAR_M)
    for u in range(here.size):
        share[u] = one if here[u] < far else zero
    if caustics.shape[0] == 0:
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


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _face_sun(here, y, focal, to_sun, surface, normal, daylight):
    """Fills row 1 of `daylight` (3, W) with row 0 times the cosine to the sun (least 0), row 2 with the depth [m]."""
    # Row 0 is relative to the mean (`_sample_caustics`); the normals of pixels without floor become 0.
    half, zero, far = np.float32(0.5), np.float32(0.0), np.float32(FAR_M)
    for u in range(here.size):
        there = here[u] < far
        z = here[u] if there else zero
        x = (np.float32(u) - half * np.float32(here.size - 1)) / focal * z
        nx, ny, nz = normal[0, u], normal[1, u], normal[2, u]
        nx, ny, nz = nx if there else zero, ny if there else zero, nz if there else zero
        normal[0, u], normal[1, u], normal[2, u] = nx, ny, nz
        facing = nx * to_sun[0] + ny * to_sun[1] + nz * to_sun[2]
        daylight[1, u] = daylight[0, u] * max(facing, zero)
        deep = surface[2, 0] * x + surface[2, 1] * (y * z) + surface[2, 2] * z + surface[2, 3]
        daylight[2, u] = max(deep, zero)


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _add_daylight(sky, normal, range_m, daylight, light):
    """Adds to `light` (3, W) the daylight on the floor, attenuated on the path to the camera."""
    beam, diffuse, change, fitted, loss = sky
    per_m, zero = np.float32(LOG2_E), np.float32(0.0)
    level, low, high = fitted[0], fitted[1], fitted[2]
    for c in range(3):
        sun, by_depth, by_range = beam[c, 0], -per_m * beam[c, 1], -per_m * loss[c]
        slope, square, form = per_m * change[c, 0], per_m * change[c, 1], diffuse[c]
        xx, yy, zz, xy, xz = form[0], form[1], form[2], form[3], form[4]
        yz, x, y, z, one = form[5], form[6], form[7], form[8], form[9]
        for u in range(range_m.size):
            nx, ny, nz = normal[0, u], normal[1, u], normal[2, u]
            rest = nx * (xx * nx + xy * ny + xz * nz + x) + ny * (yy * ny + yz * nz + y) + nz * (zz * nz + z) + one
            deep, lost = daylight[2, u], by_range * range_m[u]
            below = deep - level
            near = min(max(below, low), high)
            light[c, u] += daylight[1, u] * sun * two_to(by_depth * deep + lost) + daylight[0, u] * max(
                rest, zero
            ) * two_to(slope * below + square * near * near + lost)


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _interpolate_rows(table, row, out):
    """Fills `out` (cols, ranges, 4) with the backscatter at the fractional row `row` of `table`, by interpolation."""
    j = min(int(row), table.shape[0] - 2)
    w = row - np.float32(j)
    lower, upper, filled = table[j].reshape(-1), table[j + 1].reshape(-1), out.reshape(-1)
    for i in range(lower.size):
        filled[i] = lower[i] + w * (upper[i] - lower[i])


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _interpolate_backscatter(table, range_m, lookup, backscatter):
    """Fills `backscatter` (3, W) for a row of pixels by interpolation of `table` in column and range."""
    cols, ranges, _ = table.shape
    one, scale = np.float32(1.0), np.float32(RANGE_SCALE_M)
    n_cols, per_px = np.float32(cols - 1), one / np.float32(range_m.size - 1)
    last_c, last_r, stride = np.int32(cols - 2), np.int32(ranges - 2), np.int32(4 * ranges)
    cell, _, part_of_col, part_of_range = lookup
    for u in range(range_m.size):
        at = np.float32(u) * n_cols * per_px
        col = min(np.int32(at), last_c)
        part_of_col[u] = at - np.float32(col)
        at = range_m[u] * np.float32(ranges - 1) / (range_m[u] + scale)
        row = min(np.int32(at), last_r)
        part_of_range[u] = min(at - np.float32(row), one)
        cell[u] = col * stride + np.int32(4) * row
    flat = table.reshape(-1)
    for u in range(range_m.size):
        i, w, s = np.uint32(cell[u]), part_of_col[u], part_of_range[u]
        j, k = i + np.uint32(4), i + np.uint32(stride)
        m = k + np.uint32(4)
        shares = (one - w) * (one - s), (one - w) * s, w * (one - s), w * s
        backscatter[0, u], backscatter[1, u], backscatter[2, u] = sum_of_entries(flat, (i, j, k, m), shares)  # pyright: ignore


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _reflect(albedo, light, backscatter, out):
    """Fills `out` (W, 3) with the radiance of a Lambertian floor (an albedo of 255 is white) plus `backscatter`."""
    reflected = np.float32(1 / (255 * np.pi))
    white, filled = albedo.reshape(-1), out.reshape(-1)
    for u in range(out.shape[0]):
        filled[3 * u] = light[0, u] * (reflected * np.float32(white[3 * u])) + backscatter[0, u]
        filled[3 * u + 1] = light[1, u] * (reflected * np.float32(white[3 * u + 1])) + backscatter[1, u]
        filled[3 * u + 2] = light[2, u] * (reflected * np.float32(white[3 * u + 2])) + backscatter[2, u]


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def _join(floor, v, kept, place, range_m, backscatter, lookup, out):
    """Fills `out` (W, 3), row v of an image: backscatter, plus the share `kept`, if any, of the light of the floor."""
    # an even v also fills row v / 2 of `place`: the fractional row of `kept` for every second pixel
    of_row, shown = out.reshape(-1), floor.reshape(-1)
    if kept.shape[0] == 0:
        for u in range(range_m.size):
            red, green, blue = backscatter[0, u], backscatter[1, u], backscatter[2, u]
            of_row[3 * u], of_row[3 * u + 1], of_row[3 * u + 2] = red, green, blue
        return
    one, scale, steps = np.float32(1.0), np.float32(RANGE_SCALE_M), np.float32(kept.shape[0] - 1)
    last = np.int32(kept.shape[0] - 2)
    cell, _, part, _ = lookup
    for u in range(range_m.size):
        at = range_m[u] * steps / (range_m[u] + scale)
        cell[u] = min(np.int32(at), last)
        part[u] = min(at - np.float32(cell[u]), one)
    if v % 2 == 0:
        for u in range(place.shape[1]):
            place[v // 2, u] = np.float32(cell[2 * u]) + part[2 * u]
    flat = kept.reshape(-1)
    for u in range(range_m.size):
        i, w = np.uint32(4 * cell[u]), part[u]
        red, green, blue = sum_of_entries(flat, (i, i + np.uint32(4)), (one - w, w))  # pyright: ignore
        of_row[3 * u] = backscatter[0, u] + shown[3 * u] * red
        of_row[3 * u + 1] = backscatter[1, u] + shown[3 * u + 1] * green
        of_row[3 * u + 2] = backscatter[2, u] + shown[3 * u + 2] * blue
