"""Finite exposure time: motion blur, and the row delays of a rolling shutter.

A point at depth Z moves through the image by (Longuet-Higgins & Prazdny 1980; x, y are relative to the principal point
and the focal length f)

    du/dt = f ((x v_z - v_x) / Z + x y w_x - (1 + x^2) w_y + y w_z)
    dv/dt = f ((y v_z - v_y) / Z + (1 + y^2) w_x - x y w_y - x w_z)

Motion blur is the mean along a line centred on the pixel, the flow times the exposure time; a rolling shutter takes the
value at the pixel minus the flow times the delay of its row (or acts in `ray_sampling`). Pose and true depth refer to
mid-exposure of the middle row. The flow is constant during the exposure, a path has the depth of its own pixel, and
backscatter and lamp pattern are blurred like the floor behind them. Beyond the border the last pixel is repeated.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from twin.core.interpolation import catmull_rom_weights
from twin.core.records import Array, Depth, Radiance
from twin.core.resample import sum_row
from twin.core.threads import in_row_bands
from twin.kernels import kernel

SHORT_PX = 2.8  # largest column and row extent of a path for the 3 x 3 kernel; at sqrt(8) px its weights are equal


class ExposureMotion(NamedTuple):
    twist: Array  # (6,) [angular, linear] velocity of the camera in its own axes [rad/s, m/s]
    exposure_s: float  # exposure time of each row; 0 = no motion blur
    readout_s: float  # time from the first row of the rendered image to the last; 0 = global shutter
    rolls_later: bool = False  # the shutter is applied by `TrueCameras.sample`: the image is resampled only once


def integrate(light: Radiance, depth: Depth, focal_px: float, motion: ExposureMotion) -> Radiance:
    """Returns the radiance (H, W, 3) recorded by a moving camera from that at mid-exposure: shutter and blur."""
    if motion.readout_s and not motion.rolls_later:
        light = _moved(_apply_rolling_shutter, light, depth, focal_px, motion.twist, motion.readout_s)
    if motion.exposure_s:
        light = _moved(_blur_by_motion, light, depth, focal_px, motion.twist, motion.exposure_s)
    return light


def _moved(
    kernel: Callable[..., None], light: Radiance, depth: Depth, focal_px: float, twist: Array, time_s: float
) -> Radiance:
    out = np.empty_like(light)
    scene = light, depth, np.float32(focal_px), twist.astype(np.float32), np.float32(time_s), out
    in_row_bands(lambda first, end: kernel(*scene, first, end), len(light))
    return out


@kernel(inline="always")
def _flow(x, y, near, scale, twist):
    """Returns the optical flow (du, dv) at normalised coordinates x, y, with `near` = 1 / depth."""
    one = np.float32(1.0)
    du = (x * twist[5] - twist[3]) * near + x * y * twist[0] - (one + x * x) * twist[1] + y * twist[2]
    dv = (y * twist[5] - twist[4]) * near + (one + y * y) * twist[0] - x * y * twist[1] - x * twist[2]
    return scale * du, scale * dv


@kernel(error_model="numpy")
def _blur_by_motion(light, depth, focal, twist, exposure_s, out, first, end):
    height, width = depth.shape
    flat = light.reshape(-1, 3)
    values, filled = light.reshape(height, 3 * width), out.reshape(height, 3 * width)
    x, weights = np.empty(width, np.float32), np.empty((4, width), np.float32)
    of_bands = np.empty((4, 3 * width), np.float32)
    for u in range(width):
        x[u] = (np.float32(u) - np.float32(0.5) * np.float32(width - 1)) / focal
    for v in range(first, end):
        y = (np.float32(v) - np.float32(0.5) * np.float32(height - 1)) / focal
        short = _blur_weights(depth[v], x, y, focal * exposure_s, twist, weights)
        for k in range(4):
            _repeat_for_bands(weights[k], of_bands[k])
        _blur_row(values[max(v - 1, 0)], values[v], values[min(v + 1, height - 1)], of_bands, filled[v])
        for u in range(0, width, max(width - 1, 1) if short else 1):
            du, dv = _flow(x[u], y, np.float32(1.0) / depth[v, u], focal * exposure_s, twist)
            if abs(dv) >= abs(du):
                _average_along_path(flat, dv, du, v, u, height, width, width, 1, out[v, u])
            else:
                _average_along_path(flat, du, dv, u, v, width, height, 1, width, out[v, u])


@kernel(error_model="numpy")
def _blur_weights(depth, x, y, scale, twist, weights):
    """Computes weights (4, W) of `_blur_row`: row, column, falling, rising diagonal; returns if all are `SHORT_PX`."""
    # The 3 x 3 kernel has the moments of a uniform path (a, b) [px]: a^2 / 12, b^2 / 12, a b / 12, a^2 b^2 / 80.
    half, quarter, one, n_long = np.float32(0.5), np.float32(0.25), np.float32(1.0), 0
    across, down, falling, rising = weights[0], weights[1], weights[2], weights[3]
    for u in range(x.size):
        a, b = _flow(x[u], y, one / depth[u], scale, twist)
        n_long += max(abs(a), abs(b)) > np.float32(SHORT_PX)
        aa, bb, ab = a * a * np.float32(1 / 12), b * b * np.float32(1 / 12), a * b * np.float32(1 / 12)
        both = ab * ab * np.float32(144 / 80)
        across[u], down[u] = (aa - both) * half, (bb - both) * half
        falling[u], rising[u] = (both + ab) * quarter, (both - ab) * quarter
    return n_long == 0


@kernel
def _repeat_for_bands(values, out):
    for u in range(values.size):
        value = values[u]
        out[3 * u], out[3 * u + 1], out[3 * u + 2] = value, value, value


@kernel(forceinline=True, fastmath={"contract"})
def _blur_row(above, here, below, weights, out):
    """Blurs a row (3 W,), except its first and last pixel, with the kernel of `_blur_weights`, here (4, 3 W)."""
    before, middle, after = slice(0, -6), slice(3, -3), slice(6, None)
    a0, a1, a2 = above[before], above[middle], above[after]
    b0, b1, b2 = here[before], here[middle], here[after]
    c0, c1, c2 = below[before], below[middle], below[after]
    across, down, falling, rising = weights[0, 3:-3], weights[1, 3:-3], weights[2, 3:-3], weights[3, 3:-3]
    out = out[middle]
    for k in range(out.size):
        twice = np.float32(2.0) * b1[k]
        total = across[k] * (b0[k] + b2[k] - twice) + down[k] * (a1[k] + c1[k] - twice)
        total += falling[k] * (a0[k] + c2[k] - twice) + rising[k] * (c0[k] + a2[k] - twice)
        out[k] = max(b1[k] + total, np.float32(0.0))


@kernel(inline="always")
def _average_along_path(flat, length, aside, a, b, size_a, size_b, stride_a, stride_b, out):
    """Writes to `out` the mean radiance over a straight path centred on pixel (a, b), from an odd number of samples."""
    # The path extends by `length` along the first axis, a sample per pixel, and `aside`, not longer, along the second
    # [px]. The weight of the two ends gives the variance length^2 / 12.
    m = int(np.ceil(np.float32(0.5) * (np.sqrt(np.float32(1.0) + length * length) - np.float32(1.0))))
    here = flat[a * stride_a + b * stride_b]
    red, green, blue = here[0], here[1], here[2]
    if m > 0:
        tip = (length * length - np.float32(4 * m * (m - 1))) / np.float32(8 * m * (2 * m + 1))
        inner = (np.float32(1.0) - np.float32(2.0) * tip) / np.float32(2 * m - 1)
        red, green, blue = inner * red, inner * green, inner * blue
        slope = aside / length
        for k in range(1, m + 1):
            offset = slope * np.float32(k)
            j = int(np.floor(offset))
            w = catmull_rom_weights(offset - np.float32(j))
            share = tip if k == m else inner
            fore, back = min(a + k, size_a - 1) * stride_a, max(a - k, 0) * stride_a
            for i in range(4):
                weight = share * w[i]
                ahead = flat[fore + min(max(b + j + i - 1, 0), size_b - 1) * stride_b]
                behind = flat[back + min(max(b - j - i + 1, 0), size_b - 1) * stride_b]
                red += weight * (ahead[0] + behind[0])
                green += weight * (ahead[1] + behind[1])
                blue += weight * (ahead[2] + behind[2])
    zero = np.float32(0.0)
    out[0], out[1], out[2] = max(red, zero), max(green, zero), max(blue, zero)


@kernel(error_model="numpy", fastmath={"contract"})
def _apply_rolling_shutter(light, depth, focal, twist, readout_s, out, first, end):
    height, width = depth.shape
    zero, half = np.float32(0.0), np.float32(0.5)
    right, low = np.float32(width - 1), np.float32(height - 1)
    values, x = light.reshape(height, 3 * width), np.empty(width, np.float32)
    at_u, at_v = np.empty(width, np.float32), np.empty(width, np.float32)
    weights, cells = np.empty((8, width), np.float32), np.empty(width, np.int32)
    for u in range(width):
        x[u] = (np.float32(u) - half * right) / focal
    for v in range(first, end):
        scale = focal * readout_s * (np.float32(v) / low - half)
        y, line = (np.float32(v) - half * low) / focal, depth[v]
        for u in range(width):
            du, dv = _flow(x[u], y, np.float32(1.0) / line[u], scale, twist)
            at_u[u] = min(max(np.float32(u) - du, zero), right)
            at_v[u] = min(max(np.float32(v) - dv, zero), low)
        _cubic_weights(at_u, weights[0], weights[1], weights[2], weights[3])
        _cubic_weights(at_v, weights[4], weights[5], weights[6], weights[7])
        filled = out[v].reshape(-1)
        sum_row(values, at_u, at_v, weights, cells, filled)
        for k in range(filled.size):
            filled[k] = max(filled[k], zero)


@kernel(forceinline=True, fastmath={"contract"})
def _cubic_weights(at, before, here, after, last):
    for u in range(at.size):
        before[u], here[u], after[u], last[u] = catmull_rom_weights(at[u] - np.floor(at[u]))
