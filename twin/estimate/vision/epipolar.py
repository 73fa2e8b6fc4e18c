"""Sub-pixel depth from two views: dense Lucas-Kanade along the epipolar lines, one kernel for stereo and for motion.

Depth is expressed as disparity of the stereo pair, d = f b / Z [px]: the exact two-view equations are linear in it, and
the plane that a surface patch is at first order stays a plane, d = c + a u + b v.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Stands for "no disparity" inside the kernels; so far off that no neighbour counts it as support.
NOTHING = np.float32(-1e4)
#: Neighbours support a pixel while their disparities differ by less than this [px]: beyond it lies another surface.
SUPPORT_PX = 1.2
#: Prior of the correction and of the plane's slope [px, px/px]: decides only where there is no texture.
PRIOR_PX, PRIOR_SLOPE = 0.5, 0.3
#: Taper of the window (standard deviation) in calm images and at most [px]; the median sigma that counts as calm [px].
SPREAD_PX, MAX_SPREAD_PX, CALM_SIGMA_PX = 1.5, 2.5, 0.08
#: Window in which brightness and contrast of the two images are made equal [px of images at half size].
BALANCE_PX = 13
#: Windows that correlate less are mismatches.
LEAST_CORRELATION = 0.4
#: Variance of the difference of two images by rounding to grey levels alone.
LEAST_NOISE = 1 / 6
#: Per unit of noise variance: weights of the priors, and what noise adds to the square of a slope.
_PRIORS = np.array([1 / PRIOR_PX**2, 1 / PRIOR_SLOPE**2, 1 / 8], np.float32)


class TwoView(NamedTuple):
    """Where a pixel of the reference image with disparity d lies in the other image: p = matrix [u, v, 1] + epipole d.

    Args:
        matrix: (3, 3) K R K^-1, the infinite homography other_from_reference.
        epipole: (3,) K t / (f b) [1/px].
    """

    matrix: Array
    epipole: Array


class Refinement(NamedTuple):
    """Refined disparity (H, W) [px], NaN where it failed, with its uncertainty and the images' noise [grey levels].

    Args:
        sigma_px: (H, W) standard deviation if the start was good to `PRIOR_PX`.
        gain: (H, W) share of an error of the start that the images corrected: 1 on texture, 0 where there is none.
        shared: by how much the noise of a window varies more than if pixels were independent; `sigma_px` is without.
    """

    disparity_px: Map
    sigma_px: Map
    gain: Map
    noise: float
    shared: float

    @property
    def own_sigma_px(self) -> Map:
        """(H, W) standard deviation as a measurement of its own, whatever the start was; infinite without texture."""
        return _own_sigma(self.sigma_px, self.gain) * np.float32(self.shared**0.5)


STEREO = TwoView(np.eye(3), np.array([-1.0, 0.0, 0.0]))


def two_view(other_from_reference: Array, matrix: Array, baseline_m: float) -> TwoView:
    """The two-view equations of a relative pose (4, 4) for cameras K = matrix (3, 3)."""
    focal_baseline = matrix[0, 0] * baseline_m
    rotation, translation = other_from_reference[:3, :3], other_from_reference[:3, 3]
    return TwoView(matrix @ rotation @ np.linalg.inv(matrix), matrix @ translation / focal_baseline)


def refine(reference: Map, other: Map, disparity_px: Map, view: TwoView, iterations: int = 2) -> Refinement:
    """Moves each disparity to where the other image matches best, by least squares over a Gaussian window.

    With the other image O warped by the current disparities d, a pixel says  e = d_true - d = (I - O) / (dO/dd). A
    plane through the d + e of a window, weighted with (dO/dd)^2 and the window's taper, gives the disparity at its
    centre: unbiased on slopes, free of the pixel-locking of the integer search; neighbours on another surface do not
    count. Brightness and contrast of O are first balanced locally: veil and lamps look different from another place.
    The variance is the least-squares one for the noise found in the residuals nearby (dark and even parts of an image
    have less), raised where a window's own residuals are larger. Where noise is strong, the last window grows. Slopes
    that noise alone could make count as none. `own_sigma_px` is the error's within 15 % in clear water; where noise is
    a fifth and a half of the contrast, errors (mismatches and all) are 1.3 and 1.7 times that.

    Args:
        reference, other: (H, W) float32 grey images.
        disparity_px: (H, W) float32, NaN where unknown.
        view: where the other image sees a disparity.
    """
    fitted = np.where(np.isfinite(disparity_px), disparity_px, NOTHING).astype(np.float32)
    sigma, gain, excess, noise_variance, shared, spread_px = fitted, fitted, fitted, 1.0, 1.0, SPREAD_PX
    for _ in range(iterations):
        residual, slope, seen = _balanced_warp(reference, other, fitted, view)
        fitted = np.where(seen, fitted, NOTHING)
        noise_variance = _noise_variance(residual, seen)
        noise = _local_noise(residual, seen, noise_variance)
        fit = _fit_planes(fitted, residual, slope, noise, _taper(spread_px), np.float32(SUPPORT_PX), _PRIORS)
        shared = _shared(np.asarray(residual - slope * (fit[0] - fitted), np.float32), seen, noise_variance)
        fitted, weight, gain, excess = fit
        sigma = np.sqrt(weight * np.maximum(excess, noise))
        spread_px = _spread(_own_sigma(sigma, gain), fitted, spread_px)
    known = (fitted > NOTHING) & (excess < 2 * (1 - LEAST_CORRELATION) * _contrast(reference))
    return Refinement(
        np.where(known, fitted, np.nan).astype(np.float32),
        np.where(known, sigma, np.nan).astype(np.float32),
        np.where(known, gain, np.nan).astype(np.float32),
        float(noise_variance**0.5),
        shared,
    )


def _own_sigma(sigma: Map, gain: Map) -> Map:
    return np.asarray(sigma / np.maximum(gain, 1e-6), np.float32)


def _spread(sigma: Map, fitted: Map, spread_px: float) -> float:
    """The window that the noise calls for: larger where the median uncertainty is above `CALM_SIGMA_PX`."""
    typical = sigma[::4, ::4][fitted[::4, ::4] > NOTHING]
    if typical.size == 0:
        return spread_px
    return float(np.clip(SPREAD_PX * np.sqrt(np.median(typical) / CALM_SIGMA_PX), SPREAD_PX, MAX_SPREAD_PX))


def _contrast(image: Map) -> Map:
    """Local variance of an image, over a window like that of the fit."""
    mean = cv2.boxFilter(image, -1, (7, 7))
    return np.maximum(cv2.boxFilter(image * image, -1, (7, 7)) - mean * mean, 0)


def _balanced_warp(reference: Map, other: Map, disparity: Map, view: TwoView) -> tuple[Map, Map, Mask]:
    """Residual I - O, slope dO/dd and which pixels O reaches; local mean and deviation of the warped O are made I's."""
    warped, slope = np.zeros_like(reference), np.zeros_like(reference)
    reached = _warp(reference, other, disparity, view.matrix, view.epipole, warped, slope)
    seen = reached.astype(np.float32)
    gain, offset = (
        cv2.resize(layer, reference.shape[::-1], interpolation=cv2.INTER_LINEAR)
        for layer in _balance(reference[::2, ::2], warped[::2, ::2], seen[::2, ::2])
    )
    return np.asarray((reference - gain * warped - offset) * seen, np.float32), slope, reached


def _balance(image: Map, other: Map, seen: Map) -> tuple[Map, Map]:
    """Gain and offset that give `other` the local mean and deviation of `image`; at half size, they vary slowly."""
    count = _mean(seen) + 1e-3
    mean_i, mean_o = _mean(image * seen) / count, _mean(other * seen) / count
    power_i, power_o = _mean(image * image * seen) / count, _mean(other * other * seen) / count
    floor = 4.0  # grey levels squared: no texture, no balancing
    gain = np.sqrt((np.maximum(power_i - mean_i**2, 0) + floor) / (np.maximum(power_o - mean_o**2, 0) + floor))
    return gain.astype(np.float32), (mean_i - gain * mean_o).astype(np.float32)


def _mean(image: Map) -> Map:
    return np.asarray(cv2.boxFilter(image, -1, (BALANCE_PX, BALANCE_PX)), np.float32)


def _taper(spread_px: float) -> Map:
    half = int(np.ceil(2 * spread_px))
    return np.exp(-0.5 * (np.arange(-half, half + 1) / spread_px) ** 2).astype(np.float32)


def _noise_variance(residual: Map, seen: Mask) -> float:
    """Variance of the residuals, robustly (normal consistent), never below that of rounding to grey levels."""
    sample = np.abs(residual[::2, ::2][seen[::2, ::2]])
    if sample.size < 100:
        return 1.0
    return max(float(1.4826 * np.median(sample)) ** 2, LEAST_NOISE)


def _shared(left: Map, seen: Mask, variance: float) -> float:
    """By how much neighbours that share their noise make that of a window vary more, by what the fit left of it.

    The colours of a Bayer mosaic are interpolated: taken as independent, sigma was 1.6 times too small.
    """
    noise = np.where(seen, np.clip(left, -3 * variance**0.5, 3 * variance**0.5), 0)
    power = float(np.mean(noise * noise)) + 1e-6
    along, across = (float(np.mean(a * b)) / power for a, b in ((noise[:, 1:], noise[:, :-1]), (noise[1:], noise[:-1])))
    return (1 + 2 * max(along, 0.0)) * (1 + 2 * max(across, 0.0))


def _local_noise(residual: Map, seen: Mask, most: float) -> Map:
    """(H, W) variance of the residuals around each pixel, at most that of the image: dark and even parts have less."""
    count = _mean(seen.astype(np.float32)) + 1e-3
    return np.clip(_mean(residual * residual) / count, LEAST_NOISE, most).astype(np.float32)


@njit(cache=True, nogil=True, inline="always")
def _cubic(a, b, c, e, t):
    """Catmull-Rom value and derivative at t between b and c."""
    c1 = 0.5 * (c - a)
    c2 = a - 2.5 * b + 2 * c - 0.5 * e
    c3 = 0.5 * (e - a) + 1.5 * (b - c)
    return b + t * (c1 + t * (c2 + t * c3)), c1 + t * (2 * c2 + 3 * t * c3)


@njit(cache=True, nogil=True, inline="always")
def _sample(image, x, y):
    """Bicubic value and gradient of an image at (x, y) inside it; beyond its border it goes on as at the border."""
    height, width = image.shape
    i, j = int(x), int(y)
    s, t = np.float32(x - i), np.float32(y - j)
    i0, i2, i3 = max(i - 1, 0), min(i + 1, width - 1), min(i + 2, width - 1)
    j0, j2, j3 = max(j - 1, 0), min(j + 1, height - 1), min(j + 2, height - 1)
    b, gb = _cubic(image[j, i0], image[j, i], image[j, i2], image[j, i3], s)
    if t == 0:  # stereo: the same row
        return b, gb, np.float32(0.5) * (image[j2, i] - image[j0, i])
    a, ga = _cubic(image[j0, i0], image[j0, i], image[j0, i2], image[j0, i3], s)
    c, gc = _cubic(image[j2, i0], image[j2, i], image[j2, i2], image[j2, i3], s)
    e, ge = _cubic(image[j3, i0], image[j3, i], image[j3, i2], image[j3, i3], s)
    value, gy = _cubic(a, b, c, e, t)
    return value, _cubic(ga, gb, gc, ge, t)[0], gy


@njit(cache=True, nogil=True)
def _warp(reference, other, disparity, matrix, epipole, warped, slope):
    """Fills in the other image O warped to the reference and its slope dO/dd; returns which pixels it reaches.

    The gradient is the mean of both images': with one alone, its noise and the interpolation bias the answer.
    """
    height, width = reference.shape
    reached = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            d = disparity[v, u]
            if d < 0:
                continue
            px = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2] + epipole[0] * d
            py = matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2] + epipole[1] * d
            pz = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2] + epipole[2] * d
            if pz <= 0:
                continue
            x, y = px / pz, py / pz
            if not (0 <= x <= width - 1 and 0 <= y <= height - 1):
                continue
            value, gx, gy = _sample(other, x, y)
            rx = 0.5 * (reference[v, min(u + 1, width - 1)] - reference[v, max(u - 1, 0)])
            ry = 0.5 * (reference[min(v + 1, height - 1), u] - reference[max(v - 1, 0), u])
            gx = 0.5 * (gx + matrix[0, 0] * rx + matrix[0, 1] * ry)
            gy = 0.5 * (gy + matrix[1, 0] * rx + matrix[1, 1] * ry)
            warped[v, u] = value
            slope[v, u] = (gx * (epipole[0] - x * epipole[2]) + gy * (epipole[1] - y * epipole[2])) / pz
            reached[v, u] = True
    return reached


@njit(cache=True, nogil=True, forceinline=True, fastmath=True)
def _accumulate(sums, centre, disparity, residual, slope, i, j, weight, support):
    """Adds a row of neighbours at offset (i, j) to the normal equations; plain slices, so that it vectorises."""
    s0, s1, s2, s3, s4, s5 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    s6, s7, s8, s9, s10, s11 = sums[6], sums[7], sums[8], sums[9], sums[10], sums[11]
    for u in range(centre.size):
        e = disparity[u] - centre[u]
        w = weight if abs(e) < support else np.float32(0)
        wg = w * slope[u]
        m = wg * slope[u]
        q = m * e + wg * residual[u]
        mi, mj = m * i, m * j
        s0[u] += m
        s1[u] += mi
        s2[u] += mj
        s3[u] += mi * i
        s4[u] += mi * j
        s5[u] += mj * j
        s6[u] += q
        s7[u] += q * i
        s8[u] += q * j
        s9[u] += w * residual[u] * residual[u]
        s10[u] += w
        s11[u] += w * m


@njit(cache=True, nogil=True)
def _fit_planes(disparity, residual, slope, noise, taper, support, priors):
    """Disparity of the plane fitted around each pixel, its variance at unit noise, gain, the mean square residual."""
    height, width = disparity.shape
    half = taper.size // 2
    fitted = np.full((height, width), NOTHING, np.float32)
    weight = np.full((height, width), np.float32(np.inf))
    gain = np.ones((height, width), np.float32)
    excess = np.zeros((height, width), np.float32)
    sums = np.empty((12, width), np.float32)
    for v in range(height):
        sums[:] = 0
        for j in range(max(-half, -v), min(half, height - 1 - v) + 1):
            for i in range(-half, half + 1):
                lo, hi = max(0, -i), min(width, width - i)
                near = slice(lo + i, hi + i)
                _accumulate(
                    sums[:, lo:hi],
                    disparity[v, lo:hi],
                    disparity[v + j, near],
                    residual[v + j, near],
                    slope[v + j, near],
                    np.float32(i),
                    np.float32(j),
                    taper[j + half] * taper[i + half],
                    support,
                )
        for u in range(width):
            if disparity[v, u] < 0:
                continue
            p0, p1 = noise[v, u] * priors[0], noise[v, u] * priors[1]
            a00, a11, a22 = sums[0, u] + p0, sums[3, u] + p1, sums[5, u] + p1
            a01, a02, a12 = sums[1, u], sums[2, u], sums[4, u]
            c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
            det = a00 * c00 + a01 * c01 + a02 * c02
            step = (c00 * sums[6, u] + c01 * sums[7, u] + c02 * sums[8, u]) / det
            if abs(step) < 1:
                fitted[v, u] = disparity[v, u] + step
                # the taper's own loss is sum w^2 / sum w
                weight[v, u] = c00 / det * (sums[11, u] + p0) / a00
                # what noise alone adds to the slopes, mean and three deviations, informs of nothing
                by_noise = noise[v, u] * priors[2] * (sums[10, u] + 3 * np.sqrt(sums[10, u]))
                gain[v, u] = max(sums[0, u] - by_noise, 0.03 * sums[0, u]) / a00
                excess[v, u] = sums[9, u] / sums[10, u]
    return fitted, weight, gain, excess
