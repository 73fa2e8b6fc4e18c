"""Registering small patches of the floor in another image to a few thousandths of a pixel.

What made matches err together, found against the twin's truth, and what is done about it here:

- A patch is a piece of a slanted surface, and another camera sees it sheared. Matched as a square it averages the
  relief over another piece of the floor than it came from (0.4 mrad between legs at 21 px). So the patch is warped by
  the plane that stereo sees under it: all images are matched over the same support.
- The lamps move with the vehicle, and a change of light across the patch shifts a match by about the texture's
  correlation length squared times its gradient (0.01 px on a lamp-lit reef, always backwards). So a ramp of
  brightness and a ramp of contrast are projected out.
- Interpolation favours some sub-pixel places, by 0.014 px with cubic convolution on a rendered reef. Cubic splines
  leave 0.0055 px on waves of 2.5 px and longer, on slightly smoothed images (`matching.gray`) 0.004 px.
- Made even by what lies around (`matching.normalise`), a place looks different from elsewhere: at the border, where
  less lies around, a match is off by 0.015 px over coarse texture, and legs tilt by 0.3 mrad each to the next. So grey
  levels are matched as they are; brightness and contrast are nuisances anyway.

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

Image = NDArray[np.float32]
Spline = NDArray[np.float32]
Array = NDArray[np.float64]

_ITERATIONS = 12
_CONVERGED_PX = 0.002
_COARSE_PX = 0.1  # enough where a finer level follows
_LARGEST_MOVE_PX = 3.0
_LEAST_CORRELATION = 0.7  # other places of the floor rarely correlate by more than a half over a whole patch
_UNSMOOTHED = 1.2  # interpolation takes a third of the target's noise out of the difference, not out of the error
_SUMS = {"reassoc", "contract", "nsz"}  # sums may run side by side
_NUISANCES = 6  # brightness and contrast, and a ramp of each in either direction


class Patches(NamedTuple):
    """Patches of one image, ready to be looked for in others; m pixels each.

    Args:
        half: half of the side, without the middle [px].
        ahead: (n, 2) of the patch's centre before the point it stands for [px of the finest level].
        energy: (n,) the patch's own variation; 0 where it is too even to be matched, or reaches over the edge.
        gradient: (n, 2, m) without what the nuisances explain.
        nuisance: (n, 6, m) orthonormal: brightness and contrast, and a ramp of each in either direction.
    """

    half: int
    ahead: Array
    energy: Array
    gradient: NDArray[np.float32]
    nuisance: NDArray[np.float32]


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
    """The image (height, width), and so many coarser ones, each of half the size."""
    images = [image]
    for _ in range(levels):
        images.append(np.asarray(cv2.pyrDown(images[-1]), np.float32))
    return images


def cut(images: Sequence[Image], points: NDArray[np.floating], patch_px: int) -> list[Patches]:
    """Patches to look for elsewhere, at every level of a pyramid.

    Args:
        points: (n, 2) patch centres in the finest image, at whole pixels.
        patch_px: side of the patch (odd), at every level.
    """
    levels = []
    for level, image in enumerate(images):
        centres = np.round(points / 2.0**level).astype(np.int64)
        ahead = centres * 2.0**level - points  # a coarse pixel's centre is not the point
        energy, gradient, nuisance = _cut(image, centres, patch_px // 2)
        levels.append(Patches(patch_px // 2, ahead, energy, gradient, nuisance))
    return levels


def splines(images: Sequence[Image]) -> list[Spline]:
    """Coefficients of the cubic B-spline through each image: a target of patches.

    The inverse filter's tail falls by 0.27 a pixel.
    """
    kernel = np.sqrt(3.0) * (np.sqrt(3.0) - 2) ** np.abs(np.arange(-7, 8))
    kernel /= kernel.sum()
    return [np.asarray(cv2.sepFilter2D(i, cv2.CV_32F, kernel, kernel), np.float32) for i in images]


def register(
    source: Sequence[Patches], target: Sequence[Spline], guess: NDArray[np.floating], warp: Array
) -> Registered:
    """Finds patches of one image in another, from the coarsest level that both have down to the full image.

    Args:
        guess: (n, 2) where they are expected in the target: within about two pixels of the coarsest level.
        warp: (n, 2, 2) derivative of the target's pixel by the source's over the patch.
    """
    found = guess.astype(np.float64)
    correlation, cov = np.full(len(guess), -1.0), np.zeros((len(guess), 2, 2))
    for level in reversed(range(min(len(source), len(target)))):
        scale, tolerance = 2.0**level, _COARSE_PX if level else _CONVERGED_PX
        half, ahead, energy, gradient, nuisance = source[level]
        ahead = np.einsum("nij,nj->ni", warp, ahead)
        start = (found + ahead) / scale
        at, correlation, cov = _register(energy, gradient, nuisance, target[level], start, warp, half, tolerance)
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
def _cut(source, centres, half):
    """Energy (n,), gradient (n, 2, m) and nuisances (n, 6, m) of patches."""
    count, m = len(centres), (2 * half + 1) ** 2
    energy = np.zeros(count)
    gradient, nuisance = np.empty((count, 2, m), np.float32), np.empty((count, _NUISANCES, m), np.float32)
    height, width = source.shape
    rows = np.empty((_NUISANCES + 2, m))
    for k in range(count):
        u, v = centres[k]
        if half < u < width - half - 1 and half < v < height - half - 1:
            energy[k] = _describe(source, u, v, half, rows)
            nuisance[k] = rows[:_NUISANCES]
            gradient[k] = rows[_NUISANCES:]
    return energy, gradient, nuisance


@njit(cache=True, nogil=True, forceinline=True, fastmath=_SUMS)
def _describe(source, u0, v0, half, rows):
    """Fills `rows` (8, m): the orthonormal nuisances of a patch, and its gradient without them. -> its energy"""
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
            size = _dot(rows[q], rows[q])
            if size < 1e-6:
                return 0.0
            for m in range(side * side):
                rows[q, m] /= np.sqrt(size)
    return energy


@njit(cache=True, nogil=True, forceinline=True, fastmath=_SUMS)
def _dot(a, b):
    """Sum of products, in double precision."""
    total = 0.0
    for m in range(len(a)):
        total += float(a[m]) * float(b[m])
    return total


@njit(cache=True, nogil=True, forceinline=True, fastmath=True)
def _weights(s):
    """Of four neighbours in a cubic B-spline, at a share s of the way between the middle two."""
    one, sixth = np.float32(1), np.float32(1 / 6)
    left, right = (one - s) * (one - s) * (one - s) * sixth, s * s * s * sixth
    middle = np.float32(2 / 3) - s * s * (one - s * np.float32(0.5))
    return left, middle, one - left - middle - right, right


@njit(cache=True, nogil=True, forceinline=True, fastmath=True)
def _sample(spline, u0, v0, warp, half, seen):
    """Fills the patch (m,) as the target shows it at this place, by cubic B-spline.

    Written for speed: single precision around the centre, and indexes that need no check for being negative.
    """
    side, width = 2 * half + 1, spline.shape[1]
    flat = spline.ravel()
    uu, uv, vu, vv = np.float32(warp[0, 0]), np.float32(warp[0, 1]), np.float32(warp[1, 0]), np.float32(warp[1, 1])
    column, row = np.int32(u0), np.int32(v0)
    u_rest, v_rest = np.float32(u0 - column), np.float32(v0 - row)
    o, t, h, down = np.uint32(1), np.uint32(2), np.uint32(3), np.uint32(width)
    for i in range(side):
        y = np.float32(i - half)
        for j in range(side):
            x = np.float32(j - half)
            u, v = u_rest + uu * x + uv * y, v_rest + vu * x + vv * y
            iu, iv = np.int32(np.floor(u)), np.int32(np.floor(v))
            a0, a1, a2, a3 = _weights(u - np.float32(iu))
            b0, b1, b2, b3 = _weights(v - np.float32(iv))
            r0 = np.uint32((row + iv - 1) * width + column + iu - 1)
            r1 = r0 + down
            r2 = r1 + down
            r3 = r2 + down
            seen[i * side + j] = (
                b0 * (a0 * flat[r0] + a1 * flat[r0 + o] + a2 * flat[r0 + t] + a3 * flat[r0 + h])
                + b1 * (a0 * flat[r1] + a1 * flat[r1 + o] + a2 * flat[r1 + t] + a3 * flat[r1 + h])
                + b2 * (a0 * flat[r2] + a1 * flat[r2 + o] + a2 * flat[r2 + t] + a3 * flat[r2 + h])
                + b3 * (a0 * flat[r3] + a1 * flat[r3 + o] + a2 * flat[r3 + t] + a3 * flat[r3 + h])
            )


@njit(cache=True, nogil=True, fastmath=_SUMS)
def _register(energies, gradients, nuisances, spline, guess, warps, half, tolerance):
    """Places (n, 2), correlations (n,) (-1: not found) and covariances (n, 2, 2) of patches at one level."""
    n = (2 * half + 1) ** 2
    height, width = spline.shape
    count = len(guess)
    found, correlation, cov = guess.copy(), np.full(count, -1.0), np.zeros((count, 2, 2))
    seen = np.empty(n, np.float32)
    for k in range(count):
        energy, gradient, nuisance = energies[k], gradients[k], nuisances[k]
        if energy == 0.0:
            continue
        huu, huv, hvv = _dot(gradient[0], gradient[0]), _dot(gradient[0], gradient[1]), _dot(gradient[1], gradient[1])
        det = huu * hvv - huv * huv
        if det <= 1e-6 * huu * hvv:
            continue
        warp = warps[k]
        reach_u = half * (abs(warp[0, 0]) + abs(warp[0, 1]))
        reach_v = half * (abs(warp[1, 0]) + abs(warp[1, 1]))
        u, v = guess[k]
        converged, alike, noise = False, -1.0, 0.0
        for _ in range(_ITERATIONS):
            converged = False
            if not (reach_u + 1 <= u < width - 2 - reach_u and reach_v + 1 <= v < height - 2 - reach_v):
                break
            _sample(spline, u, v, warp, half, seen)
            total, power, fitted = 0.0, _dot(seen, seen), 0.0
            for m in range(n):
                total += seen[m]
            ru, rv, gain = _dot(gradient[0], seen), _dot(gradient[1], seen), _dot(nuisance[1], seen)
            for q in range(_NUISANCES):
                dot = _dot(nuisance[q], seen)
                fitted += dot * dot
            variation = power - total * total / n
            if gain <= 0 or variation <= 0:
                break
            alike, scale = gain / np.sqrt(variation), np.sqrt(energy) / gain
            ru, rv = ru * scale, rv * scale
            du, dv = (hvv * ru - huv * rv) / det, (huu * rv - huv * ru) / det
            noise = max((power - fitted) * scale * scale - du * ru - dv * rv, 0.0)
            u -= warp[0, 0] * du + warp[0, 1] * dv
            v -= warp[1, 0] * du + warp[1, 1] * dv
            step = abs(du) + abs(dv)
            converged = step < 5 * tolerance
            if step < tolerance:
                break
        if converged and abs(u - guess[k, 0]) + abs(v - guess[k, 1]) < _LARGEST_MOVE_PX:
            found[k, 0], found[k, 1] = u, v
            correlation[k] = alike
            variance = _UNSMOOTHED * noise / (n - _NUISANCES - 2) / 2 / det  # half of the difference's is one image's
            cov[k, 0, 0], cov[k, 1, 1] = variance * hvv, variance * huu
            cov[k, 0, 1] = cov[k, 1, 0] = -variance * huv
    return found, correlation, cov
