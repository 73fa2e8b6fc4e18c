"""Registration of small image patches between images, to a few thousandths of a pixel.

Inverse compositional Gauss-Newton, coarse to fine (Baker & Matthews 2004), with cubic B-splines (Unser 1999). Remedies
of systematic errors: each patch is warped by the plane that stereo measures around its point (unwarped, slopes bias the
rotation between legs by 0.4 mrad); gradients of brightness and contrast are nuisance parameters that are projected out,
because the lamps move (0.01 px); B-splines halve the bias of cubic convolution (0.014 px).
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.interpolation import bspline_weights
from twin.core.records import Map, Mask
from twin.kernels import kernel

_ITERATIONS = 12
_CONVERGED_PX = 0.002
_COARSE_CONVERGED_PX = 0.1  # convergence limit at the coarse levels, whose result a finer level refines
_MAX_SHIFT_PX = 3.0
_MIN_CORRELATION = 0.7  # patches of different floor rarely correlate by more than 0.5
_NOISE_LOSS = 1.2  # 2 / (1 + 2/3): interpolation removes a third of the target's noise variance from the residual
_BORDER_PX, _ROUNDING_PX = 1e-5, 4e-6  # width of the border of an image where rounding errors matter, and their bound
_REASSOCIATE = {"reassoc", "contract", "nsz"}  # fastmath flags that let sums be vectorised
_NUISANCES = 6  # brightness, contrast, and the linear gradients of both in column and row


class PatchTemplates(NamedTuple):
    """Patches of one image at one pyramid level, prepared for matching: n patches of m pixels each."""

    half: int  #: half side of a patch, (side - 1) / 2 [px]
    #: (n, 2) patch centre, rounded to a pixel of its pyramid level, minus the point [px of the full image].
    offset: Array
    #: (n,) sum of squared deviations of the grey levels from the patch's mean; 0 if the patch cannot be matched,
    #: because it is too uniform, or not inside the image with a margin of one pixel.
    energy: Array
    gradient: Map  #: (n, 2, m) image gradient, with the nuisance parameters projected out
    nuisance: Map  #: (n, 6, m) orthonormal basis of the nuisance parameters (`_NUISANCES`)


class PatchMatches(NamedTuple):
    """Positions of n patches in a target image."""

    points: Array  #: (n, 2) positions in the target [px]
    ok: Mask  #: (n,) bool, true if the match converged and its correlation with the template is above 0.7
    #: (n, 2, 2) covariance of the position due to the noise of one image, half of that of both, in the pixels and axes
    #: of the source image [px^2]; estimated from the texture and the residuals.
    cov: Array


def pyramid(image: Map, levels: int) -> list[Map]:
    """Returns the image (height, width), followed by `levels` coarser images, each half the size of the previous."""
    images = [image]
    for _ in range(levels):
        images.append(np.asarray(cv2.pyrDown(images[-1]), np.float32))
    return images


def extract_templates(images: Sequence[Map], points: NDArray[np.floating], patch_px: int) -> list[PatchTemplates]:
    """Returns the patches of side `patch_px` (odd) around points (n, 2) at whole pixels, at each level of a pyramid."""
    levels = []
    for level, image in enumerate(images):
        centres = np.round(points / 2.0**level).astype(np.int64)
        offset = centres * 2.0**level - points  # the patch is centred on a whole pixel of its level
        energy, gradient, nuisance = _extract(image, centres, patch_px // 2)
        levels.append(PatchTemplates(patch_px // 2, offset, energy, gradient, nuisance))
    return levels


def spline_coefficients(images: Sequence[Map]) -> list[Map]:
    """Returns the coefficients (H, W) of the cubic B-spline of each image; the filter is truncated at 7 px."""
    kernel = np.sqrt(3.0) * (np.sqrt(3.0) - 2) ** np.abs(np.arange(-7, 8))
    kernel /= kernel.sum()
    return [np.asarray(cv2.sepFilter2D(i, cv2.CV_32F, kernel, kernel), np.float32) for i in images]


def match_templates(
    templates: Sequence[PatchTemplates], target: Sequence[Map], guess: NDArray[np.floating], warp: Array
) -> PatchMatches:
    """Matches patches of one image in another, from the coarsest common level of the pyramids down to the full image.

    `templates` and `target` are patches and spline coefficients per pyramid level, `guess` (n, 2) expected positions in
    the target [px], accurate to about two pixels of the coarsest level, `warp` (n, 2, 2) the derivative of target
    pixels with respect to source pixels over each patch.
    """
    points, warp = guess.astype(np.float64), np.ascontiguousarray(warp)  # one memory layout: `_match` is compiled once
    correlation, cov = np.full(len(guess), -1.0), np.zeros((len(guess), 2, 2))
    for level in reversed(range(min(len(templates), len(target)))):
        scale, tolerance = 2.0**level, _COARSE_CONVERGED_PX if level else _CONVERGED_PX
        half, offset, energy, gradient, nuisance = templates[level]
        offset = np.einsum("nij,nj->ni", warp, offset)
        start = (points + offset) / scale
        centres, correlation, cov = _match(energy, gradient, nuisance, target[level], start, warp, half, tolerance)
        matched = correlation > _MIN_CORRELATION
        shift = centres * scale - offset - points
        if level and matched.any():  # unmatched patches, e.g. those cut off by the border, get the median shift
            shift[~matched] = np.median(shift[matched], axis=0)
            matched[:] = True
        points[matched] += shift[matched]
    return PatchMatches(points, correlation > _MIN_CORRELATION, cov)


def disparity_slope(disparity_px: Map, points: NDArray[np.floating], patch_px: int) -> Array:
    """Returns the gradient (n, 2) by column and row of a plane fitted to the disparities around points; 0: unknown."""
    return _slope(disparity_px, np.round(points).astype(np.int64), patch_px // 2)


def locking_shifts(pixels: NDArray[np.floating], warp: Array, patch_px: int) -> Array:
    """Returns the shifts (n, 2) [px] of positions `pixels` (n, 2) due to pixel locking with an amplitude of 1 px."""
    # at column u and row v, -A sin(2 pi u) and -A sin(2 pi v) (Schreier, Braasch & Sutton 2000, Opt. Eng. 39); where a
    # patch of side s is warped, its pixels' biases partly cancel: A along an image axis is multiplied by sinc(s d1)
    # sinc(s d2), with (d1, d2) the row for this axis of "warp minus identity"
    varying = np.sinc(patch_px * (warp - np.eye(2)))
    return -np.sin(2 * np.pi * pixels) * varying[:, :, 0] * varying[:, :, 1]


@kernel
def _slope(disparity, points, half):
    out = np.zeros((len(points), 2))
    for k in range(len(points)):
        u0, v0 = points[k]
        centre = disparity[v0, u0]
        if np.isnan(centre):
            continue
        limit = 1.0 + 0.4 * half  # a pixel whose disparity differs by more belongs to another surface
        n = su = sv = sd = suu = suv = svv = sud = svd = 0.0
        for v in range(max(v0 - half, 0), min(v0 + half + 1, disparity.shape[0])):
            for u in range(max(u0 - half, 0), min(u0 + half + 1, disparity.shape[1])):
                d = disparity[v, u] - centre
                if not abs(d) < limit:
                    continue
                x, y = float(u - u0), float(v - v0)
                n += 1
                su += x
                sv += y
                sd += d
                suu += x * x
                suv += x * y
                svv += y * y
                sud += x * d
                svd += y * d
        if n < 2 * half * half:
            continue
        suu -= su * su / n
        suv -= su * sv / n
        svv -= sv * sv / n
        sud -= su * sd / n
        svd -= sv * sd / n
        det = suu * svv - suv * suv
        if det > 1e-3 * suu * svv:
            out[k, 0] = (svv * sud - suv * svd) / det
            out[k, 1] = (suu * svd - suv * sud) / det
    return out


@kernel
def _extract(source, centres, half):
    count, m = len(centres), (2 * half + 1) ** 2
    energy = np.zeros(count)
    gradient, nuisance = np.empty((count, 2, m), np.float32), np.empty((count, _NUISANCES, m), np.float32)
    height, width = source.shape
    rows = np.empty((_NUISANCES + 2, m))
    for k in range(count):
        u, v = centres[k]
        if half < u < width - half - 1 and half < v < height - half - 1:
            energy[k] = _prepare(source, u, v, half, rows)
            nuisance[k] = rows[:_NUISANCES]
            gradient[k] = rows[_NUISANCES:]
    return energy, gradient, nuisance


@kernel(forceinline=True, fastmath=_REASSOCIATE)
def _prepare(source, u0, v0, half, rows):
    """Writes the nuisance basis (rows 0 to 5) and projected gradient (6 and 7) to `rows` (8, m); returns the energy."""
    side = 2 * half + 1
    mean = 0.0
    for i in range(side):
        for j in range(side):
            v, u, m = v0 + i - half, u0 + j - half, i * side + j
            rows[1, m] = source[v, u]
            rows[6, m] = (float(source[v, u + 1]) - float(source[v, u - 1])) / 2
            rows[7, m] = (float(source[v + 1, u]) - float(source[v - 1, u])) / 2
            mean += source[v, u]
    mean /= side * side
    energy = 0.0
    for i in range(side):
        for j in range(side):
            m = i * side + j
            contrast = rows[1, m] - mean
            energy += contrast * contrast
            rows[0, m] = 1.0
            rows[1, m] = contrast
            rows[2, m] = j - half
            rows[3, m] = i - half
            rows[4, m] = (j - half) * contrast
            rows[5, m] = (i - half) * contrast
    for q in range(_NUISANCES + 2):
        for p in range(min(q, _NUISANCES)):
            dot = _dot(rows[q], rows[p])
            for m in range(side * side):
                rows[q, m] -= dot * rows[p, m]
        if q < _NUISANCES:
            norm2 = _dot(rows[q], rows[q])
            if norm2 < 1e-6:
                return 0.0
            for m in range(side * side):
                rows[q, m] /= np.sqrt(norm2)
    return energy


@kernel(forceinline=True, fastmath=_REASSOCIATE)
def _dot(a, b):
    total = 0.0
    for m in range(len(a)):
        total += float(a[m]) * float(b[m])
    return total


@kernel(forceinline=True, fastmath=True)
def _sample(spline, u0, v0, warp, half, values):
    """Writes the target's spline at the pixels of a patch, warped around (u0, v0), to `values`; single precision."""
    side, width = 2 * half + 1, spline.shape[1]
    flat = spline.ravel()
    uu, uv, vu, vv = np.float32(warp[0, 0]), np.float32(warp[0, 1]), np.float32(warp[1, 0]), np.float32(warp[1, 1])
    column, row = np.int32(u0), np.int32(v0)
    u_fraction, v_fraction = np.float32(u0 - column), np.float32(v0 - row)
    one, two, three, down = np.uint32(1), np.uint32(2), np.uint32(3), np.uint32(width)
    # positions at the border of the image are moved inwards, by more than the rounding errors of single precision
    if u0 - half * (abs(warp[0, 0]) + abs(warp[0, 1])) < 1.0 + _BORDER_PX:
        u_fraction += np.float32(_ROUNDING_PX)
    if v0 - half * (abs(warp[1, 0]) + abs(warp[1, 1])) < 1.0 + _BORDER_PX:
        v_fraction += np.float32(_ROUNDING_PX)
    for i in range(side):
        y = np.float32(i - half)
        for j in range(side):
            x = np.float32(j - half)
            u, v = u_fraction + uu * x + uv * y, v_fraction + vu * x + vv * y
            iu, iv = np.int32(np.floor(u)), np.int32(np.floor(v))
            a0, a1, a2, a3 = bspline_weights(u - np.float32(iu))
            b0, b1, b2, b3 = bspline_weights(v - np.float32(iv))
            r0 = np.uint32((row + iv - 1) * width + column + iu - 1)
            r1 = r0 + down
            r2 = r1 + down
            r3 = r2 + down
            values[i * side + j] = (
                b0 * (a0 * flat[r0] + a1 * flat[r0 + one] + a2 * flat[r0 + two] + a3 * flat[r0 + three])
                + b1 * (a0 * flat[r1] + a1 * flat[r1 + one] + a2 * flat[r1 + two] + a3 * flat[r1 + three])
                + b2 * (a0 * flat[r2] + a1 * flat[r2 + one] + a2 * flat[r2 + two] + a3 * flat[r2 + three])
                + b3 * (a0 * flat[r3] + a1 * flat[r3 + one] + a2 * flat[r3 + two] + a3 * flat[r3 + three])
            )


@kernel(fastmath=_REASSOCIATE)
def _match(energies, gradients, nuisances, spline, guess, warps, half, tolerance):
    """Matches patches at one pyramid level, in its pixels, until a step (|column| + |row|) is below `tolerance`."""
    # gives positions (n, 2), correlations (n,), covariances (n, 2, 2); the guess, -1 and zeros where it failed
    n = (2 * half + 1) ** 2
    height, width = spline.shape
    count = len(guess)
    points, correlation, cov = guess.copy(), np.full(count, -1.0), np.zeros((count, 2, 2))
    values = np.empty(n, np.float32)
    for k in range(count):
        energy, gradient, nuisance = energies[k], gradients[k], nuisances[k]
        if energy == 0.0:
            continue
        huu, huv, hvv = _dot(gradient[0], gradient[0]), _dot(gradient[0], gradient[1]), _dot(gradient[1], gradient[1])
        det = huu * hvv - huv * huv
        if det <= 1e-6 * huu * hvv:
            continue
        warp = warps[k]
        extent_u = half * (abs(warp[0, 0]) + abs(warp[0, 1]))
        extent_v = half * (abs(warp[1, 0]) + abs(warp[1, 1]))
        u, v = guess[k]
        converged, similarity, noise = False, -1.0, 0.0
        for _ in range(_ITERATIONS):
            converged = False
            right, bottom = width - 2 - extent_u - _BORDER_PX, height - 2 - extent_v - _BORDER_PX
            if not (extent_u + 1 <= u < right and extent_v + 1 <= v < bottom):
                break
            _sample(spline, u, v, warp, half, values)
            total, power, fitted = 0.0, _dot(values, values), 0.0
            for m in range(n):
                total += values[m]
            ru, rv, gain = _dot(gradient[0], values), _dot(gradient[1], values), _dot(nuisance[1], values)
            for q in range(_NUISANCES):
                dot = _dot(nuisance[q], values)
                fitted += dot * dot
            variation = power - total * total / n
            if gain <= 0 or variation <= 0:
                break
            similarity, scale = gain / np.sqrt(variation), np.sqrt(energy) / gain
            ru, rv = ru * scale, rv * scale
            du, dv = (hvv * ru - huv * rv) / det, (huu * rv - huv * ru) / det
            noise = max((power - fitted) * scale * scale - du * ru - dv * rv, 0.0)
            u -= warp[0, 0] * du + warp[0, 1] * dv
            v -= warp[1, 0] * du + warp[1, 1] * dv
            step = abs(du) + abs(dv)
            converged = step < 5 * tolerance
            if step < tolerance:
                break
        if converged and abs(u - guess[k, 0]) + abs(v - guess[k, 1]) < _MAX_SHIFT_PX:
            points[k, 0], points[k, 1] = u, v
            correlation[k] = similarity
            variance = _NOISE_LOSS * noise / (n - _NUISANCES - 2) / 2 / det  # noise of one image: half the total
            cov[k, 0, 0], cov[k, 1, 1] = variance * hvv, variance * huu
            cov[k, 0, 1] = cov[k, 1, 0] = -variance * huv
    return points, correlation, cov
