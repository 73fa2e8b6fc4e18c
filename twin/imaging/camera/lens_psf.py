"""Point spread function of a lens: diffraction, aberrations, lateral colour and depth of field.

The modulation transfer function (MTF) of a lens of f-number N at the spatial frequency nu and the wavelength l is, with
x = nu l N (Goodman, Introduction to Fourier Optics, section 6.3; Hopkins 1955),

    MTF = 2 / pi (arccos(x) - x sqrt(1 - x^2)),    0 for x > 1

times exp(-2 pi^2 sigma^2 nu^2) for aberrations. A point at depth z is imaged as a disc of the diameter A f |1/z - 1/s|,
with the aperture A, the depth s in focus and the focal length f in water [px] (thin lens). A pixel gets the mean light
over the disc of its own depth.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Depth, Radiance, StereoRig
from twin.core.threads import QUICK, in_row_bands
from twin.errors import TwinError
from twin.imaging.camera.port import pinhole
from twin.imaging.light.spectra import CENTRE_NM
from twin.kernels import kernel
from twin.scenario.model import LensConfig, Scenario, SensorConfig

_AIRY_UM = 1.22 * CENTRE_NM[0] * 1e-3  # radius of the Airy disc of red light at f/1
REACH_PX = 4  # the kernel of the MTF has 2 REACH_PX + 1 pixels along each side; `_add_across` is written for 4
TAPS = 4  # taps of cubic interpolation
GRID = 64  # samples of the MTF along each axis, from which the kernel is computed
MTF_ERROR = 5e-3  # separable terms are added until their transform is within this of that of the kernel
NEAREST_FOCUS_M = 0.05  # smallest depth to which a lens can be focused
SMALL_PX = 3.0  # largest circle of confusion for the 3 x 3 kernel
NEGLIGIBLE_PX = 0.1  # circles of confusion up to this diameter are ignored: their variance is below 0.001 px^2


class Defocus(NamedTuple):
    """Aperture diameter [m], and the inverse of the depth in focus [1/m], 0 for a lens focused at infinity."""

    aperture_m: float
    focus_per_m: float

    def confusion_px(self, focal_px: float, depth_m: Array) -> Array:
        """Returns the diameters of the circles of confusion [px] at depths of any shape [m]."""
        return self.aperture_m * focal_px * np.abs(1 / depth_m - self.focus_per_m)


def defocus_of(scenario: Scenario, rig: StereoRig) -> Defocus | None:
    """Returns aperture (focal length in air / f-number) and focus; None without a sensor, or if `lens.focus_m` is 0."""
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
    """Point spread function of both lenses; without a sensor there is neither diffraction nor depth of field."""

    def __init__(self, scenario: Scenario, rig: StereoRig):
        lens = scenario.lens
        self._defocus, self._focal_px = defocus_of(scenario, rig), rig.focal_px
        self._taps = _taps(lens, scenario.sensor)
        self._scales = _magnification(lens, rig) if any(lens.lateral_colour) else None

    def out_of_focus(self, light: Radiance, depth: Depth) -> Radiance:
        """Returns the radiance (H, W, 3) with defocus blur at depths (H, W) [m]; `light` itself if negligible."""
        if self._defocus is None:
            return light
        extremes = np.array([depth.min(), depth.max()], np.float64)
        if self._defocus.confusion_px(self._focal_px, extremes).max() <= NEGLIGIBLE_PX:
            return light
        near, out = np.reciprocal(depth), np.empty_like(light)
        scale, focus = np.float32(self._defocus.aperture_m * self._focal_px), np.float32(self._defocus.focus_per_m)
        _run(_defocus, len(light), light.reshape(len(light), -1), near, scale, focus, out.reshape(len(light), -1))
        return out

    def transfer(self, light: Radiance) -> Radiance:
        """Returns the radiance (H, W, 3) after diffraction, aberrations and lateral colour, at least 0."""
        if self._taps is None and self._scales is None:
            return light
        rows, width = light.shape[:2]
        bands, out = np.empty((rows, 3, width), np.float32), np.empty((rows, 3 * width), np.float32)
        _run(_split_rows, rows, np.ascontiguousarray(light).reshape(rows, -1), bands)
        if self._taps is not None:
            sharp, bands = bands, np.empty_like(bands)
            _run(_convolve, rows, sharp, *self._taps, bands)
        if self._scales is None:
            _run(_join_rows, rows, bands, out)
        else:
            _run(_magnify, rows, bands, *self._scales, out)
        return out.reshape(rows, width, 3)


def _run(kernel: Callable[..., None], rows: int, *scene: Any) -> None:
    in_row_bands(lambda first, end: kernel(*scene, first, end), rows, QUICK)


def mtf(lens: LensConfig, sensor: SensorConfig | None, band: int, cycles_per_px: Array) -> Array:
    """Returns the MTF of a lens in a band (0 red, 1 green, 2 blue) at frequencies of any shape [cycles/px]."""
    share = np.exp(-2 * (np.pi * lens.blur_px[band] * cycles_per_px) ** 2)
    return share * diffraction_mtf(cycles_per_px, CENTRE_NM[band], sensor) if lens.diffraction and sensor else share


def _taps(lens: LensConfig, sensor: SensorConfig | None) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Returns the point spread functions as sums of products, two arrays (3, terms, REACH_PX + 1); None: no blur."""
    # symmetric kernels from the centre outwards, along columns and along rows
    if not lens.diffraction and not any(lens.blur_px):
        return None
    bands = [_separable(_kernel(lens, sensor, band)) for band in range(3)]
    terms = max(len(band) for band in bands)
    down, across = np.zeros((2, 3, terms, REACH_PX + 1), np.float32)
    for k, band in enumerate(bands):
        for i, (value, vector) in enumerate(band):
            down[k, i], across[k, i] = value * vector[REACH_PX:], vector[REACH_PX:]
    return down, across


def _kernel(lens: LensConfig, sensor: SensorConfig | None, band: int) -> Array:
    """Returns the kernel (2 REACH_PX + 1, 2 REACH_PX + 1) of a band, the inverse Fourier transform of its MTF."""
    if lens.diffraction and sensor is not None and (airy := _AIRY_UM * sensor.f_number / sensor.pixel_um) > REACH_PX:
        allowed = f"sensor.f_number up to {REACH_PX * sensor.pixel_um / _AIRY_UM:.3g}"
        raise TwinError("lens.diffraction", f"its disc has a radius of {airy:.1f} px", allowed)
    nu = np.fft.fftfreq(GRID)
    share = mtf(lens, sensor, band, np.hypot(nu, nu[:, None]))
    kernel = np.fft.fftshift(np.fft.ifft2(share).real)
    inside = slice(GRID // 2 - REACH_PX, GRID // 2 + REACH_PX + 1)
    kernel = kernel[inside, inside]
    return kernel + (1 - kernel.sum()) / kernel.size


def _separable(kernel: Array) -> list[tuple[float, Array]]:
    """Returns eigenvalues and eigenvectors whose outer products add up to a kernel within `MTF_ERROR`, of sum 1."""
    values, vectors = np.linalg.eigh(kernel)
    order, n = np.argsort(-np.abs(values)), 1
    while True:
        chosen = order[:n]
        total = np.einsum("k,ik,jk->ij", values[chosen], vectors[:, chosen], vectors[:, chosen])
        if np.abs(np.fft.fft2(total - kernel)).max() < MTF_ERROR or n == len(values):
            return [(values[k] / total.sum(), vectors[:, k]) for k in chosen]
        n += 1


def _magnification(lens: LensConfig, rig: StereoRig) -> tuple[NDArray[Any], ...]:
    """Returns the interpolation that magnifies red and blue relative to green (lateral colour)."""
    # Runs of pixels whose first tap has the same offset, (k, 4) band, first column, end column, offset; weights (3,
    # TAPS, W) along the rows; the offset (3, H) of the first tap of each row; weights (3, H, TAPS).
    red, blue = lens.lateral_colour
    scales = 1 + np.array([red, 0.0, blue])
    first, across = _taps_of(rig.width_px, rig.cx_px, scales)
    runs = []
    for band, taps in enumerate(first):
        starts = np.flatnonzero(np.diff(taps, prepend=taps[0] - 1))
        ends = np.append(starts[1:], rig.width_px)
        runs.append(np.column_stack([np.full(len(starts), band), starts, ends, taps[starts]]))
    across = np.ascontiguousarray(across.swapaxes(1, 2))
    return (np.concatenate(runs), across, *_taps_of(rig.height_px, rig.cy_px, scales))


def _taps_of(n: int, middle_px: float, scales: Array) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Returns the taps of the magnification along an axis of n pixels, by cubic interpolation (Keys 1981)."""
    at = middle_px + (np.arange(n) - middle_px) / scales[:, None]
    whole = np.floor(at)
    t = at - whole
    cubic = np.array(
        [-0.5 * t * (1 - t) ** 2, 1 - t**2 * (2.5 - 1.5 * t), 1 - (1 - t) ** 2 * (1 + 1.5 * t), -0.5 * (1 - t) * t**2]
    )
    return whole.astype(np.int64) - 1 - np.arange(n), np.ascontiguousarray(np.moveaxis(cubic, 0, 2), np.float32)


@kernel
def _split_rows(light, bands, first, end):
    for v in range(first, end):
        row, red, green, blue = light[v], bands[v, 0], bands[v, 1], bands[v, 2]
        for u in range(red.size):
            red[u], green[u], blue[u] = row[3 * u], row[3 * u + 1], row[3 * u + 2]


@kernel
def _join_rows(bands, out, first, end):
    for v in range(first, end):
        _join_row(bands[v, 0], bands[v, 1], bands[v, 2], out[v])


@kernel
def _join_row(red, green, blue, row):
    """Fills `row` (3 W,) with alternating R, G, B, at least 0."""
    zero = np.float32(0.0)
    for u in range(red.size):
        row[3 * u], row[3 * u + 1], row[3 * u + 2] = max(red[u], zero), max(green[u], zero), max(blue[u], zero)


@kernel
def _convolve(light, down, across, out, first, end):
    """Fills rows `first` to `end` - 1 of `out` (H, 3, W) with sums of separable convolutions of `light` (H, 3, W)."""
    rows, _, width = out.shape
    wide = np.empty(width + 2 * REACH_PX, np.float32)
    middle = wide[REACH_PX : REACH_PX + width]
    for v in range(first, end):
        for band in range(3):
            for i in range(down.shape[1]):
                weights = down[band, i]
                _weigh_line(light[v, band], weights[0], middle)
                for t in range(1, REACH_PX + 1, 2):
                    above, below = light[max(v - t, 0), band], light[min(v + t, rows - 1), band]
                    higher, lower = light[max(v - t - 1, 0), band], light[min(v + t + 1, rows - 1), band]
                    _add_pairs(above, below, weights[t], higher, lower, weights[t + 1], middle)
                for k in range(REACH_PX):
                    wide[k], wide[REACH_PX + width + k] = middle[0], middle[width - 1]
                _add_across(wide, across[band, i], out[v, band], i == 0)


@kernel(forceinline=True, fastmath={"contract"})
def _weigh_line(values, weight, out):
    for k in range(out.size):
        out[k] = weight * values[k]


@kernel(forceinline=True, fastmath={"contract"})
def _add_pairs(before, after, weight, earlier, later, other_weight, out):
    for k in range(out.size):
        out[k] += weight * (before[k] + after[k]) + other_weight * (earlier[k] + later[k])


@kernel(forceinline=True, fastmath={"contract"})
def _add_across(wide, weights, out, is_first):
    """Adds the convolution of `wide` (n + 2 REACH_PX,) with the symmetric kernel of `weights` to `out` (n,)."""
    a, b, c, d, e = wide[0:], wide[1:], wide[2:], wide[3:], wide[4:]
    f, g, h, i = wide[5:], wide[6:], wide[7:], wide[8:]
    w0, w1, w2, w3, w4 = weights[0], weights[1], weights[2], weights[3], weights[4]
    if is_first:
        for k in range(out.size):
            out[k] = np.float32(0.0)
    for k in range(out.size):
        near = w1 * (d[k] + f[k]) + w2 * (c[k] + g[k])
        out[k] += w0 * e[k] + near + (w3 * (b[k] + h[k]) + w4 * (a[k] + i[k]))


@kernel
def _magnify(light, runs, across, lines, down, out, first, end):
    rows, _, width = light.shape
    pad = max(-runs[:, 3].min(), runs[:, 3].max() + TAPS - 1, 0)
    wide, filled = np.empty((3, width + 2 * pad), np.float32), np.empty((3, width), np.float32)
    for v in range(first, end):
        for band in range(3):
            start, weights = v + lines[band, v], down[band, v]
            a, b = light[min(max(start, 0), rows - 1), band], light[min(max(start + 1, 0), rows - 1), band]
            c, d = light[min(max(start + 2, 0), rows - 1), band], light[min(max(start + 3, 0), rows - 1), band]
            middle = wide[band, pad : pad + width]
            _weighted_sum(a, b, c, d, weights[0], weights[1], weights[2], weights[3], middle)
            for k in range(pad):
                wide[band, k], wide[band, pad + width + k] = middle[0], middle[width - 1]
        for r in range(runs.shape[0]):
            band, start, stop, shift = runs[r, 0], runs[r, 1], runs[r, 2], pad + runs[r, 3]
            a, b = across[band, 0, start:stop], across[band, 1, start:stop]
            c, d = across[band, 2, start:stop], across[band, 3, start:stop]
            _weigh_across(wide[band, shift + start :], a, b, c, d, filled[band, start:stop])
        _join_row(filled[0], filled[1], filled[2], out[v])


@kernel(forceinline=True, fastmath={"contract"})
def _weighted_sum(a, b, c, d, of_a, of_b, of_c, of_d, out):
    for k in range(out.size):
        out[k] = of_a * a[k] + of_b * b[k] + of_c * c[k] + of_d * d[k]


@kernel(forceinline=True, fastmath={"contract"})
def _weigh_across(values, of_first, of_second, of_third, of_fourth, out):
    second, third, fourth = values[1:], values[2:], values[3:]
    for k in range(out.size):
        left = of_first[k] * values[k] + of_second[k] * second[k]
        out[k] = left + of_third[k] * third[k] + of_fourth[k] * fourth[k]


@kernel
def _defocus(light, near, scale, focus, out, first, end):
    """Fills rows of `out` (H, 3 W) with `light` (H, 3 W), blurred by the disc of defocus."""
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


@kernel
def _defocus_row(above, here, below, diameter, out):
    """Blurs a row (3 W,), not its ends, with 3 x 3 kernels of the moments of discs of `diameter` (3 W,) [px]."""
    # A disc of diameter c <= `SMALL_PX` has the variance c^2 / 16 along each axis and <x^2 y^2> = c^4 / 384.
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


@kernel
def _gather(light, v, u, diameter, rows, width, out):
    """Writes to `out` (3,) the mean of `light` (H, 3 W) over a disc with an antialiased edge around pixel (v, u)."""
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
