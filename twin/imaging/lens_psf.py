"""Point spread function of a lens: diffraction, aberrations, lateral colour and depth of field.

The image of a point is described by the modulation transfer function (MTF), the contrast at a spatial frequency nu
relative to that at frequency 0. A lens of f-number N without aberrations has, in light of wavelength l (Goodman,
Introduction to Fourier Optics, section 6.3; Hopkins 1955), with s = nu l N,

    MTF = 2 / pi (arccos(s) - s sqrt(1 - s^2)),    0 for s > 1

Aberrations are described by a Gaussian of standard deviation sigma in the image, MTF = exp(-2 pi^2 sigma^2 nu^2). Both
may differ between the colour bands, as may the scale of the image (lateral colour).

A point at depth z is imaged as a disc of the diameter (circle of confusion)

    c = A f |1/z - 1/s|

for a lens with an aperture of diameter A, focused at depth s, with f the focal length in water [px] (thin lens; the
focal length is neglected against s). Light is gathered with the disc of the receiving pixel, so the blur of a near
object does not spread over the background.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.records import StereoRig
from twin.imaging.bands import CENTRE_NM
from twin.imaging.port import pinhole
from twin.imaging.row_parallel import in_row_bands
from twin.scenario.model import LensConfig, Scenario, SensorConfig

Array = NDArray[np.float64]
Radiance = NDArray[np.float32]
Depth = NDArray[np.float32]

REACH_PX = 4  # the kernel of the MTF has 2 REACH_PX + 1 pixels a side; an even number
GRID = 64  # samples of the MTF from which the kernel is computed
MTF_ERROR = 5e-3  # separable terms of the kernel are added until the MTF is within this of the closed form
PATTERN_PX = 64  # pixels for which the weights of a row, which repeat for R, G, B, are stored
NEAREST_FOCUS_M = 0.05  # nearest depth in focus
SMALL_PX = 3.0  # largest circle of confusion for the 3 x 3 kernel
NEGLIGIBLE_PX = 0.1  # circles of confusion up to this diameter are ignored: their variance is below 0.001 px^2


class Defocus(NamedTuple):
    """Aperture diameter [m], and the inverse of the depth in focus [1/m]; 0 = infinity."""

    aperture_m: float
    focus_per_m: float

    def confusion_px(self, focal_px: float, depth_m: Array) -> Array:
        """Returns the diameters of the circles of confusion [px] at depths of any shape [m]."""
        return self.aperture_m * focal_px * np.abs(1 / depth_m - self.focus_per_m)


def defocus_of(scenario: Scenario, rig: StereoRig) -> Defocus | None:
    """Returns aperture and focus of the lenses; None if the scenario has no depth of field.

    The aperture is the focal length in air divided by the f-number.

    Args:
        scenario: lens, port and sensor.
        rig: the rendered cameras, with the focal length in water.
    """
    lens, sensor = scenario.lens, scenario.sensor
    if sensor is None or not lens.focus_m:
        return None
    air_focal_m = rig.focal_px / pinhole(scenario.port).focal_ratio * sensor.pixel_um * 1e-6
    return Defocus(air_focal_m / sensor.f_number, 1 / lens.focus_m)


def diffraction_mtf(cycles_per_px: Array, wavelength_nm: float, sensor: SensorConfig) -> Array:
    """Returns the MTF of a lens without aberrations at spatial frequencies of any shape [cycles/px]."""
    s = np.abs(cycles_per_px) / sensor.pixel_um * wavelength_nm * 1e-3 * sensor.f_number
    s = np.minimum(s, 1.0)
    return 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))


class LensPsf:
    """Point spread function of both lenses; applied to the light in the rendered image.

    Args:
        scenario: lens, port and sensor; without a sensor there is neither diffraction nor depth of field.
        rig: the rendered cameras.
    """

    def __init__(self, scenario: Scenario, rig: StereoRig):
        lens = scenario.lens
        self._defocus, self._focal_px = defocus_of(scenario, rig), rig.focal_px
        self._taps = _taps(lens, scenario.sensor, rig.width_px)
        self._scales = _Magnified(lens, rig) if any(lens.lateral_colour) else None

    def out_of_focus(self, light: Radiance, depth: Depth) -> Radiance:
        """Returns the radiance (H, W, 3) with the blur due to the depth of field.

        Args:
            light: (H, W, 3) radiance.
            depth: (H, W) depth [m].
        """
        if self._defocus is None:
            return light
        extremes = np.array([depth.min(), depth.max()], np.float64)
        if self._defocus.confusion_px(self._focal_px, extremes).max() <= NEGLIGIBLE_PX:
            return light
        near, out = np.reciprocal(depth), np.empty_like(light)
        scale, focus = np.float32(self._defocus.aperture_m * self._focal_px), np.float32(self._defocus.focus_per_m)
        flat, filled = light.reshape(len(light), -1), out.reshape(len(light), -1)
        in_row_bands(lambda first, end: _defocus(flat, near, scale, focus, filled, first, end), len(light))
        return out

    def transfer(self, light: Radiance) -> Radiance:
        """Returns the radiance (H, W, 3) after diffraction, aberrations and lateral colour."""
        rows = len(light)
        if self._taps is not None:
            out, taps = np.empty_like(light), self._taps
            flat, filled = np.ascontiguousarray(light).reshape(rows, -1), out.reshape(rows, -1)
            in_row_bands(lambda first, end: _convolve(flat, taps[0], taps[1], filled, first, end), rows)
            light = out
        return light if self._scales is None else self._scales.apply(light)


def mtf(lens: LensConfig, sensor: SensorConfig | None, band: int, cycles_per_px: Array) -> Array:
    """Returns the MTF of diffraction and aberrations in a band (0 red) at frequencies of any shape [cycles/px]."""
    share = np.exp(-2 * (np.pi * lens.blur_px[band] * cycles_per_px) ** 2)
    return share * diffraction_mtf(cycles_per_px, CENTRE_NM[band], sensor) if lens.diffraction and sensor else share


def _taps(
    lens: LensConfig, sensor: SensorConfig | None, width_px: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Returns the kernels of the MTF as separable terms: weights along columns and rows, (terms, REACH_PX + 1, 3 W).

    The last axis repeats the weights of R, G, B for all pixels of a row. None if the lens does not blur.
    """
    if not lens.diffraction and not any(lens.blur_px):
        return None
    bands = [_separable(_kernel(lens, sensor, band)) for band in range(3)]
    terms = max(len(band) for band in bands)
    down, across = np.zeros((2, terms, REACH_PX + 1, 3))
    for k, band in enumerate(bands):
        for i, (value, vector) in enumerate(band):
            down[i, :, k], across[i, :, k] = value * vector[REACH_PX:], vector[REACH_PX:]
    return np.tile(down, (1, 1, width_px)).astype(np.float32), np.tile(across, (1, 1, width_px)).astype(np.float32)


def _kernel(lens: LensConfig, sensor: SensorConfig | None, band: int) -> Array:
    """Returns the kernel (2 REACH_PX + 1, 2 REACH_PX + 1) of a band, the inverse Fourier transform of its MTF.

    The light that falls outside is spread evenly over the kernel, so that its sum is 1: among the kernels of this size
    with sum 1, this one has the smallest mean square error of the MTF.
    """
    nu = np.fft.fftfreq(GRID)
    share = mtf(lens, sensor, band, np.hypot(nu, nu[:, None]))
    kernel = np.fft.fftshift(np.fft.ifft2(share).real)
    inside = slice(GRID // 2 - REACH_PX, GRID // 2 + REACH_PX + 1)
    kernel = kernel[inside, inside]
    return kernel + (1 - kernel.sum()) / kernel.size


def _separable(kernel: Array) -> list[tuple[float, Array]]:
    """Returns the largest eigenvalues and their eigenvectors of a symmetric kernel.

    The sum of eigenvalue times outer product of the eigenvector approximates the kernel within `MTF_ERROR` of its
    transform. The eigenvalues are scaled so that all elements of this sum add up to 1.
    """
    values, vectors = np.linalg.eigh(kernel)
    order, n = np.argsort(-np.abs(values)), 1
    while True:
        chosen = order[:n]
        total = np.einsum("k,ik,jk->ij", values[chosen], vectors[:, chosen], vectors[:, chosen])
        if np.abs(np.fft.fft2(total - kernel)).max() < MTF_ERROR or n == len(values):
            return [(values[k] / total.sum(), vectors[:, k]) for k in chosen]
        n += 1


class _Magnified:
    """Lateral colour: the images of the red and the blue band are magnified relative to the green one."""

    def __init__(self, lens: LensConfig, rig: StereoRig):
        red, blue = lens.lateral_colour
        scales = 1 + np.array([red, 0.0, blue])
        first, across = _taps_of(rig.width_px, rig.cx_px, scales)
        starts = np.flatnonzero(np.diff(first, prepend=first[0] - 1))  # runs of pixels with the same taps
        runs = np.column_stack([starts, np.append(starts[1:], rig.width_px), first[starts]])
        lines, down = _taps_of(rig.height_px, rig.cy_px, scales)
        self._tables = runs, np.ascontiguousarray(across.swapaxes(0, 1).reshape(len(across[0]), -1)), lines, down

    def apply(self, light: Radiance) -> Radiance:
        """Returns the radiance (H, W, 3) with the magnified red and blue bands."""
        out, tables = np.empty_like(light), self._tables
        flat, filled = np.ascontiguousarray(light).reshape(len(light), -1), out.reshape(len(light), -1)
        in_row_bands(lambda first, end: _magnify(flat, *tables, filled, first, end), len(light))
        return out


def _taps_of(n: int, middle_px: float, scales: Array) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Returns the taps of the magnification along an axis of n pixels, by cubic interpolation (Keys 1981).

    Args:
        n: number of pixels.
        middle_px: pixel that all bands share.
        scales: (3,) magnification of the bands.

    Returns:
        First tap of each pixel (n,) relative to it [px]; weights (n, taps, 3) of consecutive pixels for R, G, B.
    """
    at = middle_px + (np.arange(n) - middle_px) / scales[:, None]
    whole = np.floor(at)
    t = at - whole
    cubic = np.array(
        [-0.5 * t * (1 - t) ** 2, 1 - t**2 * (2.5 - 1.5 * t), 1 - (1 - t) ** 2 * (1 + 1.5 * t), -0.5 * (1 - t) * t**2]
    )
    offset = whole.astype(np.int64) - 1 - np.arange(n)  # of the first of the four taps of each band
    first = offset.min(axis=0)
    weights = np.zeros((n, int((offset - first).max()) + 4, 3))
    for band in range(3):
        for i in range(4):
            weights[np.arange(n), offset[band] - first + i, band] = cubic[i, band]
    return first, weights.astype(np.float32)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _convolve(light, down, across, out, first, end):
    """Fills rows `first` to `end` of `out` (H, 3 W) with the sum of separable convolutions of `light` (H, 3 W).

    `down` and `across` (terms, taps, 3 W) are the weights of `_taps` along columns and rows.
    """
    terms, n_taps, n = down.shape
    rows, reach = light.shape[0], n_taps - 1
    wide = np.empty(n + 6 * reach, np.float32)
    for v in range(first, end):
        filled = out[v]
        filled[:] = np.float32(0.0)
        for i in range(terms):
            middle = wide[3 * reach : 3 * reach + n]
            here, weight = light[v], down[i, 0]
            for k in range(n):
                middle[k] = weight[k] * here[k]
            for t in range(1, n_taps, 2):
                above, below = light[max(v - t, 0)], light[min(v + t, rows - 1)]
                higher, lower = light[max(v - t - 1, 0)], light[min(v + t + 1, rows - 1)]
                _add_pairs(above, below, down[i, t], higher, lower, down[i, t + 1], middle)
            for k in range(3 * reach):
                wide[k] = middle[k % 3]
                wide[3 * reach + n + k] = middle[n - 3 + k % 3]
            weight = across[i, 0]
            for k in range(n):
                filled[k] += weight[k] * middle[k]
            for t in range(1, n_taps, 2):
                left, right = wide[3 * (reach - t) :], wide[3 * (reach + t) :]
                _add_pairs(left, right, across[i, t], wide[3 * (reach - t - 1) :], right[3:], across[i, t + 1], filled)
        for k in range(n):
            filled[k] = max(filled[k], np.float32(0.0))


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract"})
def _add_pairs(before, after, weight, earlier, later, other_weight, out):
    """Adds two pairs of filter taps to `out` (n,): the sum of each pair of values (n,), times its weights (n,)."""
    for k in range(out.size):
        out[k] += weight[k] * (before[k] + after[k]) + other_weight[k] * (earlier[k] + later[k])


@njit(cache=True, nogil=True, fastmath={"contract"})
def _magnify(light, runs, across, lines, down, out, first, end):
    """Fills rows `first` to `end` of `out` (H, 3 W) with the magnified bands of `light`; see `_taps_of` for the taps.

    Args:
        light: (H, 3 W) radiance.
        runs: (k, 3) first and end column of each run of pixels with the same taps, and their first tap.
        across: (taps, 3 W) weights along the rows.
        lines: (H,) first tap of each row.
        down: (H, taps, 3) weights along the columns.
        out: (H, 3 W) array to fill.
        first, end: rows to fill.
    """
    rows, n = light.shape
    pad = 3 * max(-runs[:, 2].min(), runs[:, 2].max() + across.shape[0] - 1, 0)
    wide, pattern = np.empty(n + 2 * pad, np.float32), np.empty(3 * PATTERN_PX, np.float32)
    for v in range(first, end):
        between = wide[pad : pad + n]
        for i in range(down.shape[1]):
            red, green, blue = down[v, i, 0], down[v, i, 1], down[v, i, 2]
            for u in range(PATTERN_PX):
                pattern[3 * u], pattern[3 * u + 1], pattern[3 * u + 2] = red, green, blue
            line = light[min(max(v + lines[v] + i, 0), rows - 1)]
            for start in range(0, n, pattern.size):
                stop = min(start + pattern.size, n)
                _add_weighted(line[start:stop], pattern, between[start:stop], i == 0)
        for k in range(pad):
            wide[k], wide[pad + n + k] = between[k % 3], between[n - 3 + k % 3]
        for r in range(runs.shape[0]):
            start, stop = 3 * runs[r, 0], 3 * runs[r, 1]
            filled = out[v, start:stop]
            for i in range(across.shape[0]):
                shift = pad + 3 * (runs[r, 2] + i)
                _add_weighted(wide[shift + start : shift + stop], across[i, start:stop], filled, i == 0)
            for k in range(filled.size):
                filled[k] = max(filled[k], np.float32(0.0))


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract"})
def _add_weighted(values, weights, out, is_first):
    """Adds `values` times `weights` (at least n,) to `out` (n,), or replaces it if `is_first`."""
    if is_first:
        for k in range(out.size):
            out[k] = weights[k] * values[k]
    else:
        for k in range(out.size):
            out[k] += weights[k] * values[k]


@njit(cache=True, nogil=True)
def _defocus(light, near, scale, focus, out, first, end):
    """Fills rows `first` to `end` of `out` (H, 3 W) with `light` (H, 3 W), blurred by the disc of defocus.

    Args:
        near: (H, W) inverse depth [1/m].
        scale: diameter of the aperture times the focal length [px m]; this times the difference between the inverse
            depth and `focus` is the diameter of the disc [px].
        focus: inverse of the depth in focus [1/m].
    """
    rows, width = near.shape
    wide = np.empty(3 * width, np.float32)
    for v in range(first, end):
        most = np.float32(0.0)
        for u in range(width):
            c = scale * abs(near[v, u] - focus)
            most = max(most, c)
            wide[3 * u] = wide[3 * u + 1] = wide[3 * u + 2] = c
        short = most <= np.float32(SMALL_PX)
        _defocus_row(light[max(v - 1, 0)], light[v], light[min(v + 1, rows - 1)], wide, out[v])
        for u in range(0, width, max(width - 1, 1) if short else 1):
            if 0 < u < width - 1 and wide[3 * u] <= np.float32(SMALL_PX):
                continue
            _gather(light, v, u, wide[3 * u], rows, width, out[v, 3 * u : 3 * u + 3])


@njit(cache=True, nogil=True)
def _defocus_row(above, here, below, diameter, out):
    """Blurs a row (3 W,), except its first and last pixel, with the 3 x 3 kernel that has the moments of a disc.

    A disc of diameter c has the variance c^2 / 16 along each axis and the fourth moment <x^2 y^2> = c^4 / 384.
    """
    before, middle, after = slice(0, -6), slice(3, -3), slice(6, None)
    a0, a1, a2 = above[before], above[middle], above[after]
    b0, b1, b2 = here[before], here[middle], here[after]
    c0, c1, c2 = below[before], below[middle], below[after]
    diameter, out = diameter[middle], out[middle]
    for k in range(out.size):
        cc = min(diameter[k] * diameter[k], np.float32(SMALL_PX * SMALL_PX))
        both = cc * cc * np.float32(1 / 384)
        side, corner = np.float32(0.5) * (cc * np.float32(1 / 16) - both), np.float32(0.25) * both
        total = side * (b0[k] + b2[k] + a1[k] + c1[k]) + corner * (a0[k] + a2[k] + c0[k] + c2[k])
        out[k] = total + (np.float32(1.0) - np.float32(4.0) * (side + corner)) * b1[k]


@njit(cache=True, nogil=True)
def _gather(light, v, u, diameter, rows, width, out):
    """Writes to `out` (3,) the mean radiance over a disc with an antialiased edge around pixel (v, u)."""
    radius = np.float32(0.5) * diameter + np.float32(0.5)
    reach = int(radius)
    red = green = blue = total = np.float32(0.0)
    for j in range(-reach, reach + 1):
        row = light[min(max(v + j, 0), rows - 1)]
        for i in range(-reach, reach + 1):
            weight = min(radius - np.sqrt(np.float32(i * i + j * j)), np.float32(1.0))
            if weight > 0:
                at = 3 * min(max(u + i, 0), width - 1)
                red, green, blue = red + weight * row[at], green + weight * row[at + 1], blue + weight * row[at + 2]
                total += weight
    out[0], out[1], out[2] = red / total, green / total, blue / total
