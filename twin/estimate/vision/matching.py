"""Even images, points worth matching, and following them from frame to frame by Lucas-Kanade.

Stereo and the links between keyframes need more than Lucas-Kanade gives: `patches.register`.
"""

from __future__ import annotations

from typing import Any, TypeVar

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Gray = NDArray[np.float32]
Points = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = TypeVar("Pixels", NDArray[np.uint8], NDArray[np.float32])

_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 25, 0.005)
_GRAY_PER_SIGMA = 36.0
_BANDS = np.full((1, 3), 1 / 3, np.float32)
_SMOOTH_PX = 0.5  # takes the finest detail, which sampling has folded, before it pulls matches towards whole pixels
_FLAT_GRAY = 2.0  # deviations below this are sensor noise, not texture
_ROUND_TRIP_PX = 0.5


def gray(rgb: Image, binning: int = 1) -> Gray:
    """Grey levels (height / binning, width / binning), hardly smoothed: what `patches` are registered on.

    Where pixels are taken together, noise rules, and the bands are taken together as well: their mean holds 1.14 times
    as much texture for its noise as luma over the coarse floor of `paper_coarse`, and its final error falls by a fifth.

    Args:
        rgb: (height, width, 3).
        binning: so many pixels become one along either side.
    """
    if binning == 1:
        levels = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    else:
        levels = cv2.transform(binned(rgb.astype(np.float32), binning), _BANDS)
    return np.asarray(cv2.GaussianBlur(levels, (3, 3), _SMOOTH_PX), np.float32)


def normalise(levels: Gray) -> Image:
    """Local mean and contrast of grey levels made even: the lamp pattern moves with the vehicle, none must track it.

    Returns:
        (height, width) uint8, local mean 128, local deviation about 36 grey levels. They depend on what lies around, at
        the border on less: nothing to be measured on to a hundredth of a pixel.
    """
    mean, square = _around(levels)
    even = np.empty(levels.shape, np.uint8)
    _even(levels.ravel(), mean.ravel(), square.ravel(), even.ravel())
    return even


def contrast(levels: Gray) -> float:
    """RMS contrast of what is matched: deviation of grey levels around a place over their mean, median over the image.

    Before it is made even by `normalise`. Noise counts as well: in the dark, and in thick water, little else is left.
    """
    mean, square = (level[::4, ::4] for level in _around(levels))
    deviation = np.sqrt(np.maximum(square - mean**2, 0))
    return float(np.median(deviation / np.maximum(mean, 1.0)))


def _around(levels: Gray) -> tuple[Gray, Gray]:
    """Mean and mean square in the window around each pixel, an eighth of the image wide."""
    size = (levels.shape[1] // 8 | 1,) * 2
    mean = cv2.boxFilter(levels, -1, size, borderType=cv2.BORDER_REFLECT)
    square = cv2.sqrBoxFilter(levels, -1, size, borderType=cv2.BORDER_REFLECT)
    return np.asarray(mean, np.float32), np.asarray(square, np.float32)


def binned(image: Pixels, by: int) -> Pixels:
    """The image (height, width, ...) with squares of `by` x `by` pixels averaged to one."""
    if by == 1:
        return image
    smaller: Any = cv2.resize(image, None, fx=1 / by, fy=1 / by, interpolation=cv2.INTER_AREA)
    return smaller


@njit(cache=True, nogil=True, fastmath=True)
def _even(gray, mean, square, even):
    """Fills `even` (n,) uint8 from grey levels, their local mean and local mean square."""
    low, high, middle = np.float32(0), np.float32(255), np.float32(128.5)
    for k in range(gray.size):
        deviation = np.sqrt(max(square[k] - mean[k] * mean[k], low)) + np.float32(_FLAT_GRAY)
        level = (gray[k] - mean[k]) / deviation * np.float32(_GRAY_PER_SIGMA) + middle
        even[k] = np.uint8(min(max(level, low), high))


def corners(image: Image, count: int, patch_px: int) -> Points:
    """Well-textured points, spread over the image, each with its whole patch inside, best first. -> (n, 2) float32 [px]

    Where texture is so coarse that there are not half as many corners as asked, points of a grid: between few corners
    lies most of what the image tells. Over texels of 12 px motions over three keyframes err by 4.5 mrad, with corners
    by 7.6.
    """
    height, width = image.shape
    margin, block = patch_px // 2 + 2, 7
    inside = np.zeros_like(image)
    inside[margin : height - margin, margin : width - margin] = 255
    spacing_px = 0.7 * np.sqrt(height * width / count)
    found = cv2.goodFeaturesToTrack(image, count, 0.01, spacing_px, mask=inside, blockSize=block)
    if found is None:
        return np.zeros((0, 2), np.float32)
    if len(found) < count / 2:
        step = max(int(spacing_px), 1)
        u, v = np.meshgrid(np.arange(margin, width - margin, step), np.arange(margin, height - margin, step))
        strength = cv2.cornerMinEigenVal(image, block)[v, u].ravel()
        best = np.argsort(-strength, kind="stable")[:count]
        return np.column_stack([u.ravel(), v.ravel()])[best].astype(np.float32)
    return np.asarray(found, np.float32).reshape(-1, 2)


def track(
    source: Image, target: Image, points: Points, guess: Points, patch_px: int, levels: int = 1
) -> tuple[Points, Mask]:
    """Where patches of one image are in another, by Lucas-Kanade there and back.

    Args:
        source, target: normalised images of one shape.
        points: (n, 2) [px] in the source.
        guess: (n, 2) [px], where they are expected in the target.
        patch_px: window.
        levels: pyramid levels above the full image.

    Returns:
        (n, 2) [px] in the target, and which came back within half a pixel and lie inside.
    """
    if len(points) == 0:
        return points.copy(), np.zeros(0, bool)
    points = points.astype(np.float32)
    found, there = _lucas_kanade(source, target, points, guess.astype(np.float32), patch_px, levels)
    returned, back = _lucas_kanade(target, source, found, points, patch_px, 0)
    round_trip_px = np.linalg.norm(returned - points, axis=1)
    return found, there & back & (round_trip_px < _ROUND_TRIP_PX) & inside(found, source.shape, patch_px // 2)


def _lucas_kanade(
    source: Image, target: Image, points: Points, guess: Points, patch_px: int, levels: int
) -> tuple[Points, Mask]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        points,
        guess.copy(),
        winSize=(patch_px, patch_px),
        maxLevel=levels,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(found, np.float32), np.asarray(status).ravel() > 0


def inside(points: NDArray[np.floating], shape: tuple[int, ...], margin_px: float) -> Mask:
    """Which points (n, 2) keep this distance from the image border."""
    x, y = points[:, 0], points[:, 1]
    return (x >= margin_px) & (y >= margin_px) & (x < shape[1] - margin_px) & (y < shape[0] - margin_px)


def correlation(points: NDArray[np.floating], patch_px: int) -> float:
    """By how much a covariance of independent points (n, 2) is too small: overlapping patches share their pixels.

    The variance of a mean grows by the mean sum of what each patch shares with all (itself included).
    """
    if len(points) == 0:
        return 1.0
    return _shared(np.ascontiguousarray(points, np.float64), float(patch_px)) / len(points)


@njit(cache=True, nogil=True)
def _shared(points, patch):
    """Sum over all pairs of square patches, each with itself too, of the share of a patch that both have."""
    total = float(len(points))
    for i in range(len(points)):
        for j in range(i):
            wide = 1 - abs(points[i, 0] - points[j, 0]) / patch
            high = 1 - abs(points[i, 1] - points[j, 1]) / patch
            if wide > 0 and high > 0:
                total += 2 * wide * high
    return total
