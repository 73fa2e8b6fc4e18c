"""Registering small patches of the floor in another image to a few thousandths of a pixel.

What made matches err together, found against the twin's truth, and what is done about it here:

- A patch is a piece of a slanted surface, and another camera sees it sheared. Matched as a square it averages the
  relief over another piece of the floor than it came from (0.4 mrad between legs at 21 px). So the patch is warped by
  the plane that stereo sees under it: all images are matched over the same support.
- The lamps move with the vehicle, and a change of light across the patch shifts a match by about the texture's
  correlation length squared times its gradient (0.01 px on a lamp-lit reef, always backwards). So a ramp of
  brightness and a ramp of contrast are projected out.
- Interpolation favours some sub-pixel places (0.014 px with cubic convolution, 0.03 px with bilinear weights): splines
  on slightly smoothed images leave 0.003 px.

Inverse compositional Gauss-Newton with nuisances projected out (Baker & Matthews 2004), coarse to fine; cubic B-spline
interpolation (Unser 1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Spline = NDArray[np.float32]
Array = NDArray[np.float64]

_ITERATIONS = 12
_CONVERGED_PX = 0.002
_COARSE_PX = 0.1  # enough where a finer level follows
_LARGEST_MOVE_PX = 3.0
_LEAST_CORRELATION = 0.7  # other places of the floor rarely correlate by more than a half over a whole patch
_UNSMOOTHED = 1.2  # interpolation takes a third of the target's noise out of the difference, not out of the error
_NUISANCES = 6  # brightness and contrast, and a ramp of each in either direction


class Registered(NamedTuple):
    """Where patches were found.

    Args:
        points: (n, 2) [px] in the target.
        ok: (n,) bool, found: converged and alike.
        cov: (n, 2, 2) of a patch's place in one image, in the source's pixels [px^2], by the patch's texture and the
            noise that the two images differ by.
    """

    points: Array
    ok: NDArray[np.bool_]
    cov: Array


def pyramid(image: Image, levels: int) -> list[Image]:
    """The image (height, width), and so many coarser ones, each of half the size: a source of patches."""
    images = [image]
    for _ in range(levels):
        images.append(np.asarray(cv2.pyrDown(images[-1]), np.uint8))
    return images


def splines(images: Sequence[Image]) -> list[Spline]:
    """Coefficients of the cubic B-spline through each image: a target of patches.

    The inverse filter's tail falls by 0.27 a pixel.
    """
    kernel = np.sqrt(3.0) * (np.sqrt(3.0) - 2) ** np.abs(np.arange(-7, 8))
    kernel /= kernel.sum()
    return [np.asarray(cv2.sepFilter2D(i, cv2.CV_32F, kernel, kernel), np.float32) for i in images]


def register(
    source: Sequence[Image],
    target: Sequence[Spline],
    points: NDArray[np.floating],
    guess: NDArray[np.floating],
    warp: Array,
    patch_px: int,
) -> Registered:
    """Finds patches of one image in another, from the coarsest level that both have down to the full image.

    Args:
        points: (n, 2) patch centres in the source, at whole pixels.
        guess: (n, 2) where they are expected in the target: within about two pixels of the coarsest level.
        warp: (n, 2, 2) derivative of the target's pixel by the source's over the patch.
        patch_px: side of the patch (odd), at every level.
    """
    half, found = patch_px // 2, guess.astype(np.float64)
    correlation, cov = np.full(len(points), -1.0), np.zeros((len(points), 2, 2))
    for level in reversed(range(min(len(source), len(target)))):
        scale, tolerance = 2.0**level, _COARSE_PX if level else _CONVERGED_PX
        centres = np.round(points / scale).astype(np.int64)
        ahead = np.einsum("nij,nj->ni", warp, centres * scale - points)  # a coarse pixel's centre is not the point
        start = (found + ahead) / scale
        at, correlation, cov = _register(source[level], target[level], centres, start, warp, half, tolerance)
        better = correlation > _LEAST_CORRELATION
        moved = at * scale - ahead - found
        if level and better.any():  # those that the margin hides are off as the others are
            moved[~better] = np.median(moved[better], axis=0)
            better[:] = True
        found[better] += moved[better]
    return Registered(found, correlation > _LEAST_CORRELATION, cov)


def disparity_slope(disparity_px: NDArray[np.float32], points: NDArray[np.floating], patch_px: int) -> Array:
    """Slope (n, 2) [px per px, by column and row] of the plane through a disparity map under each patch; 0 if unknown.

    Args:
        disparity_px: (height, width), NaN where unknown.
        points: (n, 2) whole pixels inside.
        patch_px: side of the patch.
    """
    return _slope(disparity_px, np.round(points).astype(np.int64), patch_px // 2)


@njit(cache=True, nogil=True)
def _slope(disparity, points, half):
    out = np.zeros((len(points), 2))
    for k in range(len(points)):
        u0, v0 = points[k]
        centre = disparity[v0, u0]
        if np.isnan(centre):
            continue
        limit = 1.0 + 0.4 * half  # farther off is another surface
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


@njit(cache=True, nogil=True)
def _describe(source, u0, v0, half, gradient, nuisance):
    """Fills the orthonormal nuisances (6, n) of a patch and its gradient (2, n) without them.

    Returns the patch's own variation, 0 where it is too even to be matched.
    """
    side = 2 * half + 1
    n = side * side
    mean = 0.0
    for i in range(side):
        for j in range(side):
            v, u, m = v0 + i - half, u0 + j - half, i * side + j
            nuisance[1, m] = source[v, u]
            gradient[0, m] = (float(source[v, u + 1]) - float(source[v, u - 1])) / 2
            gradient[1, m] = (float(source[v + 1, u]) - float(source[v - 1, u])) / 2
            mean += source[v, u]
    mean /= n
    energy = 0.0
    for i in range(side):
        for j in range(side):
            m = i * side + j
            contrast = nuisance[1, m] - mean
            energy += contrast * contrast
            nuisance[0, m] = 1.0
            nuisance[1, m] = contrast
            nuisance[2, m] = j - half
            nuisance[3, m] = i - half
            nuisance[4, m] = (j - half) * contrast
            nuisance[5, m] = (i - half) * contrast
    for q in range(_NUISANCES + 2):
        row = nuisance[q] if q < _NUISANCES else gradient[q - _NUISANCES]
        for p in range(min(q, _NUISANCES)):
            dot = 0.0
            for m in range(n):
                dot += row[m] * nuisance[p, m]
            for m in range(n):
                row[m] -= dot * nuisance[p, m]
        if q < _NUISANCES:
            size = 0.0
            for m in range(n):
                size += row[m] * row[m]
            if size < 1e-6:
                return 0.0
            for m in range(n):
                row[m] /= np.sqrt(size)
    return energy


@njit(cache=True, nogil=True, fastmath=True)
def _sample(spline, u0, v0, warp, half, seen):
    """Fills the patch (n,) as the target shows it at this place, by cubic B-spline."""
    side = 2 * half + 1
    for i in range(side):
        for j in range(side):
            x, y = float(j - half), float(i - half)
            u, v = u0 + warp[0, 0] * x + warp[0, 1] * y, v0 + warp[1, 0] * x + warp[1, 1] * y
            iu, iv = int(u), int(v)
            s, t = np.float32(u - iu), np.float32(v - iv)
            one = np.float32(1)
            a0, a3 = (one - s) ** 3 / 6, s * s * s / 6
            a1 = np.float32(2 / 3) - s * s * (one - s / 2)
            a2 = one - a0 - a1 - a3
            b0, b3 = (one - t) ** 3 / 6, t * t * t / 6
            b1 = np.float32(2 / 3) - t * t * (one - t / 2)
            b2 = one - b0 - b1 - b3
            r0, r1, r2, r3 = spline[iv - 1], spline[iv], spline[iv + 1], spline[iv + 2]
            seen[i * side + j] = (
                b0 * (a0 * r0[iu - 1] + a1 * r0[iu] + a2 * r0[iu + 1] + a3 * r0[iu + 2])
                + b1 * (a0 * r1[iu - 1] + a1 * r1[iu] + a2 * r1[iu + 1] + a3 * r1[iu + 2])
                + b2 * (a0 * r2[iu - 1] + a1 * r2[iu] + a2 * r2[iu + 1] + a3 * r2[iu + 2])
                + b3 * (a0 * r3[iu - 1] + a1 * r3[iu] + a2 * r3[iu + 1] + a3 * r3[iu + 2])
            )


@njit(cache=True, nogil=True)
def _register(source, spline, points, guess, warps, half, tolerance):
    """Places (n, 2), correlations (n,) (-1: not found) and covariances (n, 2, 2) of patches at one level."""
    n = (2 * half + 1) ** 2
    height, width = spline.shape
    count = len(points)
    found, correlation, cov = guess.copy(), np.full(count, -1.0), np.zeros((count, 2, 2))
    seen, gradient, nuisance = np.empty(n), np.empty((2, n)), np.empty((_NUISANCES, n))
    for k in range(count):
        u0, v0 = points[k]
        if u0 <= half or v0 <= half or u0 >= source.shape[1] - half - 1 or v0 >= source.shape[0] - half - 1:
            continue
        energy = _describe(source, u0, v0, half, gradient, nuisance)
        if energy == 0.0:
            continue
        huu, huv, hvv = (gradient[0] ** 2).sum(), (gradient[0] * gradient[1]).sum(), (gradient[1] ** 2).sum()
        det = huu * hvv - huv * huv
        if det <= 1e-6 * huu * hvv:
            continue
        warp = warps[k]
        reach_u = half * (abs(warp[0, 0]) + abs(warp[0, 1]))
        reach_v = half * (abs(warp[1, 0]) + abs(warp[1, 1]))
        u, v = guess[k]
        step, alike, noise = np.inf, -1.0, 0.0
        for _ in range(_ITERATIONS):
            if not (reach_u + 1 <= u < width - 2 - reach_u and reach_v + 1 <= v < height - 2 - reach_v):
                step = np.inf
                break
            _sample(spline, u, v, warp, half, seen)
            total = power = ru = rv = fitted = gain = 0.0
            for m in range(n):
                total += seen[m]
                power += seen[m] * seen[m]
                ru += gradient[0, m] * seen[m]
                rv += gradient[1, m] * seen[m]
            for q in range(_NUISANCES):
                dot = 0.0
                for m in range(n):
                    dot += nuisance[q, m] * seen[m]
                fitted += dot * dot
                if q == 1:
                    gain = dot
            variation = power - total * total / n
            if gain <= 0 or variation <= 0:
                step = np.inf
                break
            alike, scale = gain / np.sqrt(variation), np.sqrt(energy) / gain
            ru, rv = ru * scale, rv * scale
            du, dv = (hvv * ru - huv * rv) / det, (huu * rv - huv * ru) / det
            noise = max((power - fitted) * scale * scale - du * ru - dv * rv, 0.0)
            u -= warp[0, 0] * du + warp[0, 1] * dv
            v -= warp[1, 0] * du + warp[1, 1] * dv
            step = abs(du) + abs(dv)
            if step < tolerance:
                break
        if step < 5 * tolerance and abs(u - guess[k, 0]) + abs(v - guess[k, 1]) < _LARGEST_MOVE_PX:
            found[k, 0], found[k, 1] = u, v
            correlation[k] = alike
            variance = _UNSMOOTHED * noise / (n - _NUISANCES - 2) / 2 / det  # half of the difference's is one image's
            cov[k, 0, 0], cov[k, 1, 1] = variance * hvv, variance * huu
            cov[k, 0, 1] = cov[k, 1, 0] = -variance * huv
    return found, correlation, cov
