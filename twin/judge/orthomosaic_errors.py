"""Errors of the orthomosaic against the true one: position, colour and resolution, tile by tile in bounded memory.

The displacement of patches is that of the peak of their normalised cross-correlation. The colour difference is
CIEDE2000 (Sharma, Wu & Dalal 2005, doi 10.1002/col.20070).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.ortho_tiles import OrthoTile
from twin.core.records import Array
from twin.judge.summary_statistics import finite_float, percentile

Layer = NDArray[np.float32]

PATCH_PX, SEARCH_PX = 32, 8  # side of the patches that are matched, and largest displacement
#: Unrelated patches reach a correlation of about 0.2 at the best displacement: the correlation of patches with about
#: 300 independent pixels has a standard deviation of 0.06.
LEAST_CORRELATION = 0.25
_COLOUR_STEP_PX = 3  # spacing of the pixels whose colour is compared
_BINS = np.linspace(0, 100, 10001)  # edges of the bins of the histogram of colour differences
#: X, Y, Z (rows) of the primaries R, G, B (columns) of ITU-R BT.709 with the white point D65, relative to Y of white
#: (IEC 61966-2-1).
_XYZ_FROM_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_25_TO_7 = 25.0**7
_LUMINANCE = _XYZ_FROM_RGB[1].astype(np.float32)
#: Distance from 10 % to 90 % of the edge response of a Gaussian blur, in standard deviations.
_EDGE_PER_SIGMA = 2 * 1.2815515655446004
#: Limits of the frequencies to which the blur is fitted: the highest frequency [1/px], and the smallest transfer as a
#: fraction of the largest.
_HIGHEST_FREQUENCY, _LEAST_TRANSFER = 0.4, 0.1


class OrthomosaicJudge:
    """Compares an orthomosaic with the true one; its colours only if they are `restored` to albedo."""

    def __init__(self, restored: bool):
        self._restored = restored
        self._pixel_m: float | None = None
        self._shifts: list[tuple[float, float]] = []
        self._n_patches = 0
        self._colours = np.zeros(len(_BINS) - 1, np.int64)
        self._spectra = np.zeros((2, PATCH_PX, PATCH_PX))
        self._n_asked, self._n_known = 0, 0

    def add(self, tile: OrthoTile, albedo: NDArray[np.float32], asked: NDArray[np.bool_]) -> None:
        """Adds the errors of a tile.

        `albedo` (rows, cols, 3) is the true one, 255 = white, NaN where there is no floor or an object lies on it;
        `asked` (rows, cols) marks the pixels in the asked area.
        """
        self._pixel_m = tile.grid.cell_m
        self._n_asked += int(asked.sum())
        self._n_known += int((asked & tile.known).sum())
        known = tile.known & np.isfinite(albedo[..., 0])
        if self._restored:  # the colour differences of some known pixels
            some = np.s_[::_COLOUR_STEP_PX, ::_COLOUR_STEP_PX]
            colours = (lab_of(picture[some][known[some]] / 255.0) for picture in (tile.rgba[..., :3], albedo))
            self._colours += np.histogram(np.minimum(ciede2000(*colours), _BINS[-1]), _BINS)[0]
        self._match(tile.rgba[..., :3] @ _LUMINANCE, np.nan_to_num(albedo) @ _LUMINANCE, known)

    def _match(self, shown: Layer, true: Layer, known: NDArray[np.bool_]) -> None:
        """Counts the patches that are known over the search range; adds displacement and spectra of those found."""
        n, m = PATCH_PX, SEARCH_PX
        for row in range(m, len(shown) - n - m + 1, n):
            for col in range(m, shown.shape[1] - n - m + 1, n):
                around = np.s_[row - m : row + n + m, col - m : col + n + m]
                if not known[around].all():
                    continue
                self._n_patches += 1
                patch = np.ascontiguousarray(shown[row : row + n, col : col + n], np.float32)
                shift = patch_shift(patch, np.ascontiguousarray(true[around], np.float32), LEAST_CORRELATION)
                if shift is None:
                    continue
                right_px, down_px = shift
                self._shifts.append((right_px, -down_px))
                right, down = round(right_px), round(down_px)
                same = true[row - down : row - down + n, col - right : col - right + n]
                self._spectra += np.array(transfer(patch, same, (right_px - right, down_px - down)))

    def metrics(self) -> dict[str, float | None]:
        """Returns `orthomosaic.*` of metrics.json; every value is None without an orthomosaic.

        pixel_m is the side of a pixel, coverage_area the fraction of the asked area that has a colour. ce90_m and
        ce90_px are the 90th percentile of the horizontal displacement of patches (circular error at 90 %), bias_east_m
        and bias_north_m the medians of its components, matched the fraction of the patches that were found.
        colour_difference_median and _p90 are percentiles of CIEDE2000 between restored and true albedo; None without
        restoration. edge_width_m is the distance over which the image of an edge of albedo rises from 10 % to 90 %, for
        the Gaussian blur that best fits the modulation transfer function between the true orthomosaic and this one.
        """
        pixel_m, shift = self._pixel_m, np.array(self._shifts).reshape(-1, 2)
        ce90_px = percentile(np.hypot(*shift.T), 90)
        east_px, north_px = (percentile(column, 50) for column in shift.T)
        values = {
            "pixel_m": pixel_m,
            "coverage_area": self._n_known / self._n_asked if self._n_asked else None,
            "ce90_m": _times(ce90_px, pixel_m),
            "ce90_px": ce90_px,
            "bias_east_m": _times(east_px, pixel_m),
            "bias_north_m": _times(north_px, pixel_m),
            "matched": len(shift) / self._n_patches if self._n_patches else None,
            "colour_difference_median": _percentile_of_counts(self._colours, 50),
            "colour_difference_p90": _percentile_of_counts(self._colours, 90),
            "edge_width_m": _times(_edge_width_px(*self._spectra), pixel_m),
        }
        return {name: finite_float(value) for name, value in values.items()}


def _edge_width_px(cross: Array, power: Array) -> float | None:
    """Returns the 10 % to 90 % edge width [px] of the Gaussian blur that best fits `cross` / `power` (n, n)."""
    # gain * exp(-2 (pi sigma f)^2) of the frequency f [1/px]; None with fewer than four usable frequencies
    n = len(power)
    f = np.hypot(np.fft.fftfreq(n), np.fft.fftfreq(n)[:, None])
    ring = np.rint(f * n).astype(int).ravel()
    total, true, frequency = (np.bincount(ring, values.ravel()) for values in (cross, power, f))
    frequency /= np.bincount(ring)
    used = (frequency > 1.5 / n) & (frequency < _HIGHEST_FREQUENCY) & (true > 0)
    ratio = np.divide(total, true, out=np.zeros_like(total), where=true > 0)
    used &= ratio > _LEAST_TRANSFER * ratio[used].max(initial=0.0)
    if used.sum() < 4:
        return None
    # ln(H) = ln(gain) - 2 (pi sigma)^2 f^2; the gain absorbs the unknown exposure of colours as seen
    terms = np.column_stack([np.ones(used.sum()), -2 * np.pi**2 * frequency[used] ** 2])
    weight = ratio[used]
    _, variance = np.linalg.lstsq(terms * weight[:, None], np.log(ratio[used]) * weight, rcond=None)[0]
    return float(_EDGE_PER_SIGMA * np.sqrt(max(variance, 0.0)))


def _percentile_of_counts(counts: NDArray[np.int64], percent: float) -> float | None:
    """Returns the upper edge of the bin of `_BINS` that contains a percentile (0 to 100); None without values."""
    if not counts.any():
        return None
    return float(_BINS[1 + np.searchsorted(np.cumsum(counts), percent / 100 * counts.sum())])


def _times(value: float | None, factor: float | None) -> float | None:
    return None if value is None or factor is None else value * factor


def patch_shift(patch: Layer, around: Layer, least_correlation: float) -> tuple[float, float] | None:
    """Returns the displacement [px] to the right and down of a patch (n, n) of an image against the second image.

    `around` (n + 2 m, n + 2 m) is the part of the second image with the same centre. The peak of the correlation is
    interpolated by a parabola along each axis. None if one of the two has no texture, if the peak is below
    `least_correlation` or at the border of the search range of m pixels, or if the correlation exceeds 90 % of the peak
    more than three rows or columns away from it.
    """
    if min(patch.std(), around.std()) < 1e-3:
        return None
    score = np.asarray(cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED), np.float64)
    row, col = np.unravel_index(score.argmax(), score.shape)
    peak, last = score[row, col], score.shape[0] - 1
    if not (0 < row < last and 0 < col < last) or peak < least_correlation:
        return None
    others = score.copy()
    others[max(row - 3, 0) : row + 4, max(col - 3, 0) : col + 4] = -1
    if others.max() > 0.9 * peak:
        return None
    down = row + _vertex(*score[row - 1 : row + 2, col]) - last / 2
    right = col + _vertex(*score[row, col - 1 : col + 2]) - last / 2
    return -float(right), -float(down)


def _vertex(before: float, at: float, after: float) -> float:
    """Returns the vertex of the parabola through values at -1, 0 and 1, of which that at 0 is largest."""
    curvature = before - 2 * at + after
    return 0.0 if curvature >= 0 else 0.5 * (before - after) / curvature


def transfer(patch: Layer, true: Layer, shift_px: tuple[float, float]) -> tuple[Array, Array]:
    """Returns the cross-spectrum (n, n) of a patch and the true patch, and the power spectrum (n, n) of the true patch.

    Both are weighted by a Hann window. The cross-spectrum is corrected for the displacement `shift_px`; its real part
    is returned. The ratio is the modulation transfer function.
    """
    n = len(patch)
    hann = np.hanning(n + 2)[1:-1]
    taper = hann * hann[:, None]
    first, second = (np.fft.fft2((picture - picture.mean()) * taper) for picture in (patch, true))
    f = np.fft.fftfreq(n)
    right_px, down_px = shift_px
    phase = np.exp(2j * np.pi * (f * right_px + f[:, None] * down_px))
    return np.real(first * phase * np.conj(second)), np.abs(second) ** 2


def lab_of(rgb: NDArray[np.floating]) -> Array:
    """Returns the CIELAB coordinates L*, a*, b* (..., 3) of linear RGB colours (..., 3), 1 = white (D65)."""
    relative = np.maximum(np.asarray(rgb, np.float64), 0) @ (_XYZ_FROM_RGB / _XYZ_FROM_RGB.sum(1, keepdims=True)).T
    edge = 6 / 29
    f = np.where(relative > edge**3, np.cbrt(relative), relative / (3 * edge**2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def ciede2000(first: Array, second: Array) -> Array:
    """Returns the CIEDE2000 differences (...) of pairs of CIELAB colours (..., 3); about 1 is barely visible."""
    l1, a1, b1 = np.moveaxis(np.asarray(first, np.float64), -1, 0)
    l2, a2, b2 = np.moveaxis(np.asarray(second, np.float64), -1, 0)
    mean_chroma = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    stretch = 1 + (1 - np.sqrt(mean_chroma**7 / (mean_chroma**7 + _25_TO_7))) / 2
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = np.arctan2(b1, stretch * a1) % (2 * np.pi), np.arctan2(b2, stretch * a2) % (2 * np.pi)
    coloured = c1 * c2 > 0
    turn = np.where(coloured, (h2 - h1 + np.pi) % (2 * np.pi) - np.pi, 0.0)
    across = np.where(h1 + h2 < 2 * np.pi, np.pi, -np.pi) * (np.abs(h2 - h1) > np.pi)
    hue = np.where(coloured, (h1 + h2) / 2 + across, h1 + h2)
    lightness, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    t = 1 - 0.17 * np.cos(hue - np.pi / 6) + 0.24 * np.cos(2 * hue)
    t += 0.32 * np.cos(3 * hue + np.pi / 30) - 0.20 * np.cos(4 * hue - np.deg2rad(63))
    s_l = 1 + 0.015 * (lightness - 50) ** 2 / np.sqrt(20 + (lightness - 50) ** 2)
    s_c, s_h = 1 + 0.045 * chroma, 1 + 0.015 * chroma * t
    rotation = -2 * np.sqrt(chroma**7 / (chroma**7 + _25_TO_7))
    rotation *= np.sin(np.deg2rad(60) * np.exp(-(((np.rad2deg(hue) - 275) / 25) ** 2)))
    dl, dc, dh = (l2 - l1) / s_l, (c2 - c1) / s_c, 2 * np.sqrt(c1 * c2) * np.sin(turn / 2) / s_h
    return np.sqrt(np.maximum(dl**2 + dc**2 + dh**2 + rotation * dc * dh, 0))
