"""Image normalisation, corners, and Lucas-Kanade tracking between frames (less accurate than `patches`)."""

from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core import resample
from twin.core.records import Image, Map, Mask
from twin.kernels import kernel

Gray = Map
Points = Map
Pixels = TypeVar("Pixels", Image, Map)

_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 25, 0.005)
_GRAY_PER_SIGMA = 36.0
_BANDS = np.full((1, 3), 1 / 3, np.float32)
_SMOOTH_PX = 0.5  # removes aliased detail, which biases matches towards whole pixels
_FLAT_GRAY = 2.0  # standard deviation of sensor noise [grey levels]; keeps uniform areas from being amplified
_FORWARD_BACKWARD_PX = 0.5


def luma(rgb: Image) -> Gray:
    """Returns the grey levels (H, W) of an image (H, W, 3), neither smoothed nor rounded to whole levels."""
    return np.asarray(cv2.cvtColor(rgb.astype(np.float32), cv2.COLOR_RGB2GRAY), np.float32)


def gray(rgb: Image | Gray, binning: int = 1) -> Gray:
    """Returns the slightly smoothed grey levels (H / binning, W / binning) in which patches are matched."""
    # luma without binning; with it the mean of the bands, as noise limits binned images (1.14 times the signal to
    # noise)
    if binning == 1:
        levels = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    else:
        levels = cv2.transform(binned(rgb.astype(np.float32), binning), _BANDS)
    return np.asarray(cv2.GaussianBlur(levels, (3, 3), _SMOOTH_PX), np.float32)


def normalise(levels: Gray) -> Image:
    """Returns grey levels (H, W) with local mean 128 and standard deviation 36, less where the texture is weak."""
    # they depend on the window around a pixel, so they do not permit matching to a hundredth of a pixel
    mean, square = local_moments(levels)
    normalised = np.empty(levels.shape, np.uint8)
    _normalise(levels.ravel(), mean.ravel(), square.ravel(), normalised.ravel())
    return normalised


def local_moments(levels: Gray) -> tuple[Gray, Gray]:
    """Returns the mean and the mean square (H, W) around each pixel, in a square window 1/8 as wide as the image."""
    size = (levels.shape[1] // 8 | 1,) * 2
    mean = cv2.boxFilter(levels, -1, size, borderType=cv2.BORDER_REFLECT)
    square = cv2.sqrBoxFilter(levels, -1, size, borderType=cv2.BORDER_REFLECT)
    return np.asarray(mean, np.float32), np.asarray(square, np.float32)


def binned(image: Pixels, by: int) -> Pixels:
    """Returns an image (H, W, ...) with squares of `by` x `by` pixels averaged; `by` divides both sides."""
    if by == 1:
        return image
    smaller: Any = cv2.resize(image, None, fx=1 / by, fy=1 / by, interpolation=cv2.INTER_AREA)
    return smaller


def scaled_rows(image: Image, scale: float) -> Image:
    """Returns an image (H, W, 3) resampled to int(H scale) rows; input row v becomes row (v + 0.5) scale - 0.5."""
    if scale == 1:
        return image
    rows, columns = int(image.shape[0] * scale), image.shape[1]
    positions = np.meshgrid(np.arange(columns), (np.arange(rows) + 0.5) / scale - 0.5)
    return resample.interpolate(image, np.stack(positions, axis=-1).astype(np.float32))


@kernel(fastmath=True)
def _normalise(gray, mean, square, normalised):
    low, high, middle = np.float32(0), np.float32(255), np.float32(128.5)
    for k in range(gray.size):
        sigma = np.sqrt(max(square[k] - mean[k] * mean[k], low)) + np.float32(_FLAT_GRAY)
        level = (gray[k] - mean[k]) / sigma * np.float32(_GRAY_PER_SIGMA) + middle
        normalised[k] = np.uint8(min(max(level, low), high))


def corners(image: Image, count: int, patch_px: int) -> Points:
    """Returns well-textured points (n, 2) [px] of a normalised image, the strongest first, not too near its border."""
    # corners, or for fewer than half of `count` (coarse texture, whose information lies between corners) the points of
    # a square grid with the strongest texture
    height, width = image.shape
    margin, block = patch_px // 2 + 2, 7
    inside = np.zeros_like(image)
    inside[margin : height - margin, margin : width - margin] = 255
    spacing_px = 0.7 * np.sqrt(height * width / count)
    detected = cv2.goodFeaturesToTrack(image, count, 0.01, spacing_px, mask=inside, blockSize=block)
    if detected is None:
        return np.zeros((0, 2), np.float32)
    if len(detected) < count / 2:
        step = max(int(spacing_px), 1)
        u, v = np.meshgrid(np.arange(margin, width - margin, step), np.arange(margin, height - margin, step))
        strength = cv2.cornerMinEigenVal(image, block)[v, u].ravel()
        best = np.argsort(-strength, kind="stable")[:count]
        return np.column_stack([u.ravel(), v.ravel()])[best].astype(np.float32)
    return np.asarray(detected, np.float32).reshape(-1, 2)


def track(
    source: Image, target: Image, points: Points, guess: Points, patch_px: int, levels: int = 1
) -> tuple[Points, Mask]:
    """Tracks points (n, 2) [px] between normalised images by Lucas-Kanade; also returns a mask (n,) of good ones."""
    # those with the window inside that are tracked back to within half a pixel
    if len(points) == 0:
        return points.copy(), np.zeros(0, bool)
    points = points.astype(np.float32)
    tracked, forward_ok = _lucas_kanade(source, target, points, guess.astype(np.float32), patch_px, levels)
    returned, backward_ok = _lucas_kanade(target, source, tracked, points, patch_px, 0)
    consistent = np.linalg.norm(returned - points, axis=1) < _FORWARD_BACKWARD_PX
    return tracked, forward_ok & backward_ok & consistent & inside(tracked, source.shape, patch_px // 2)


def _lucas_kanade(
    source: Image, target: Image, points: Points, guess: Points, patch_px: int, levels: int
) -> tuple[Points, Mask]:
    options = {"winSize": (patch_px, patch_px), "maxLevel": levels, "criteria": _CRITERIA}
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(source, target, points, guess.copy(), flags=flags, **options)
    return np.asarray(tracked, np.float32), np.asarray(status).ravel() > 0


def inside(points: NDArray[np.floating], shape: tuple[int, ...], margin_px: float) -> Mask:
    """Returns a mask (n,) of the points (n, 2) at least `margin_px` inside an image of `shape` (height, width, ...)."""
    x, y = points[:, 0], points[:, 1]
    return (x >= margin_px) & (y >= margin_px) & (x < shape[1] - margin_px) & (y < shape[0] - margin_px)


def variance_inflation(points: NDArray[np.floating], patch_px: int) -> float:
    """Returns the factor on a covariance computed as if the points (n, 2) [px] were independent; 1 without points."""
    # overlapping patches share pixels: the mean summed overlap of a patch with all (design effect, Kish 1965)
    if len(points) == 0:
        return 1.0
    return _summed_overlap(np.ascontiguousarray(points, np.float64), float(patch_px)) / len(points)


@kernel
def _summed_overlap(points, patch):
    """Returns the sum of the overlaps over all ordered pairs of patches of side `patch` [px], each with itself too."""
    total = float(len(points))
    for i in range(len(points)):
        for j in range(i):
            wide = 1 - abs(points[i, 0] - points[j, 0]) / patch
            high = 1 - abs(points[i, 1] - points[j, 1]) / patch
            if wide > 0 and high > 0:
                total += 2 * wide * high
    return total
