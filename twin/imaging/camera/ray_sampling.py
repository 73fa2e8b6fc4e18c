"""Sampling of a rendered image along the rays of the true pixels: lens, port and rolling shutter in one resampling.

A pixel of the raw image has a ray o + s d in the axes of the rendered camera. A rolling shutter exposes row v of h at t
= readout (v / (h - 1) - 1/2) after mid-exposure, when a camera with twist xi has moved by exp(xi t). The ray meets the
floor of depth z at the column f d_x / d_z + f (o_x - o_z d_x / d_z) / z from the principal point; rows alike. This is
solved by iteration for a whole row, from the depths that the rays of the previous row meet.
"""

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.records import Array, Depth, Radiance
from twin.core.resample import Positions, spline_coefficients, spline_row, unpack
from twin.core.threads import in_row_bands
from twin.kernels import kernel

INTERSECTION_STEPS = 4  # maximum; each multiplies the error by the parallax times the slope of the floor
INTERSECTION_PX = 1e-2  # the iteration ends when a step is shorter; the remaining error is a few percent of that step


class RowMotion(NamedTuple):
    """Motion of a camera while the rows of an image are exposed one after the other."""

    twist: Array  # (6,) [angular, linear] velocity of the camera in its own axes [rad/s, m/s]
    readout_s: float  # time from the first sampled row of the raw image to the last
    focal_px: float  # focal length of the rendered image
    principal_px: tuple[float, float]  # (2,) column and row of its principal point


def sample_rays(
    light: Radiance, depth: Depth, positions: Positions, parallax_px_m: Positions | None = None,
    motion: RowMotion | None = None,
) -> Radiance:  # fmt: skip
    """Returns the radiance (h, w, 3) where the rays of pixels meet the floor, from an image (H, W, 3) and depth [m].

    A ray that crosses the plane of depth zero at distance p [m] from the camera centre is imaged f p / z away from its
    vanishing point, a position (h, w, 2) [px], z being the depth there; 1 / z, linear on a plane, is interpolated
    bilinearly. The parallax (h, w, 2) is f p in columns and rows [px m]; None = 0. Border pixels are repeated.
    """
    out, near = np.empty((*positions.shape[:2], 3), np.float32), np.reciprocal(depth)
    moves = None if motion is None else (np.ascontiguousarray(motion.twist, np.float64), *motion[1:])
    scene = spline_coefficients(light), near, positions, parallax_px_m, moves
    in_row_bands(lambda first, end: _sample_rays(*scene, out, first, end), len(positions))
    return out


@kernel
def _sample_rays(source, near, positions, parallax, motion, out, first, end):
    n = out.shape[1]
    rays, cells, weights = np.empty((8, n), np.float32), np.empty(n, np.int32), np.empty((8, n), np.float32)
    for v in range(first, end):
        if parallax is None and motion is None:
            unpack(positions[v].reshape(-1), rays[0], rays[1])
        else:
            _hit_row(near, positions, parallax, motion, v, v == first, rays, cells)
        filled = out[v].reshape(-1)
        spline_row(source, rays[0], rays[1], weights, cells, filled)
        for k in range(filled.size):
            filled[k] = max(filled[k], np.float32(0.0))  # beside an edge, a spline can pass below zero


@kernel(forceinline=True, error_model="numpy", fastmath={"contract"})
def _hit_row(near, positions, parallax, motion, v, is_first, rays, cells):
    """Fills rows 0, 1 of `rays` (8, w) with columns and rows where the rays of row v meet the floor."""
    # rows 2 and 3: vanishing points, 4 and 5: parallax, 6: inverse depth, where the next row starts
    rows, cols = near.shape
    x, y, base_x, base_y, slope_x, slope_y = rays[0], rays[1], rays[2], rays[3], rays[4], rays[5]
    inverse, part_x, part_y = rays[6], rays[0], rays[1]
    unpack(positions[v].reshape(-1), base_x, base_y)
    if parallax is None:
        slope_x[:] = np.float32(0.0)
        slope_y[:] = np.float32(0.0)
    else:
        unpack(parallax[v].reshape(-1), slope_x, slope_y)
    if motion is not None:
        twist, readout_s, focal, principal = motion
        then = geometry.exp(twist * (readout_s * (v / (positions.shape[0] - 1) - 0.5)))
        _move(then, np.float32(focal), np.float32(principal[0]), np.float32(principal[1]), rays)
    flat = near.reshape(-1)
    if is_first:
        for u in range(x.size):
            col = min(max(int(base_x[u]), 0), cols - 1)
            inverse[u] = flat[min(max(int(base_y[u]), 0), rows - 1) * cols + col]
    for _ in range(INTERSECTION_STEPS):
        _locate(base_x, base_y, slope_x, slope_y, inverse, rows, cols, part_x, part_y, cells)
        if not _look_up(flat, cols, cells, part_x, part_y, slope_x, slope_y, inverse):
            break
    for u in range(x.size):
        x[u], y[u] = base_x[u] + slope_x[u] * inverse[u], base_y[u] + slope_y[u] * inverse[u]


@kernel(forceinline=True, error_model="numpy", fastmath={"contract"})
def _move(pose, focal, cx, cy, rays):
    base_x, base_y, slope_x, slope_y = rays[2], rays[3], rays[4], rays[5]
    a, b, c, p = np.float32(pose[0, 0]), np.float32(pose[0, 1]), np.float32(pose[0, 2]), focal * np.float32(pose[0, 3])
    d, e, f, q = np.float32(pose[1, 0]), np.float32(pose[1, 1]), np.float32(pose[1, 2]), focal * np.float32(pose[1, 3])
    g, h, i, r = np.float32(pose[2, 0]), np.float32(pose[2, 1]), np.float32(pose[2, 2]), focal * np.float32(pose[2, 3])
    per_focal = np.float32(1.0) / focal
    for u in range(base_x.size):
        x, y = (base_x[u] - cx) * per_focal, (base_y[u] - cy) * per_focal
        per_z = np.float32(1.0) / (g * x + h * y + i)
        along_x, along_y = (a * x + b * y + c) * per_z, (d * x + e * y + f) * per_z
        shift_x, shift_y = a * slope_x[u] + b * slope_y[u] + p, d * slope_x[u] + e * slope_y[u] + q
        shift_z = g * slope_x[u] + h * slope_y[u] + r
        base_x[u], base_y[u] = focal * along_x + cx, focal * along_y + cy
        slope_x[u], slope_y[u] = shift_x - shift_z * along_x, shift_y - shift_z * along_y


@kernel(forceinline=True, error_model="numpy", fastmath={"contract"})
def _locate(base_x, base_y, slope_x, slope_y, inverse, rows, cols, part_x, part_y, cells):
    """Computes the square of four pixel centres that each ray falls in, and the position in the square."""
    zero, one, last_x, last_y = np.float32(0.0), np.float32(1.0), np.float32(cols - 2), np.float32(rows - 2)
    n_cols = np.int32(cols)
    for u in range(base_x.size):
        x, y = base_x[u] + slope_x[u] * inverse[u], base_y[u] + slope_y[u] * inverse[u]
        col, row = min(max(np.floor(x), zero), last_x), min(max(np.floor(y), zero), last_y)
        part_x[u], part_y[u] = min(max(x - col, zero), one), min(max(y - row, zero), one)
        cells[u] = np.int32(row) * n_cols + np.int32(col)


@kernel(forceinline=True, error_model="numpy", fastmath={"contract"})
def _look_up(near, cols, cells, part_x, part_y, slope_x, slope_y, inverse):
    """Replaces `inverse` by the inverse depth at the rays; returns how many move by more than `INTERSECTION_PX`."""
    n_moved, limit = 0, np.float32(INTERSECTION_PX)
    for u in range(cells.size):
        k, s, t = np.uint32(cells[u]), part_x[u], part_y[u]
        m = k + np.uint32(cols)
        above = near[k] + s * (near[k + np.uint32(1)] - near[k])
        below = near[m] + s * (near[m + np.uint32(1)] - near[m])
        met = above + t * (below - above)
        change = met - inverse[u]
        n_moved += abs(change * slope_x[u]) + abs(change * slope_y[u]) > limit
        inverse[u] = met
    return n_moved
