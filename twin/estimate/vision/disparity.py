"""Dense stereo disparity with its uncertainty: semi-global matching, followed by sub-pixel refinement."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image, Map
from twin.core.threads import in_pair
from twin.estimate.vision import epipolar

#: Block size of semi-global matching [px]. In turbid water, more pixels are matched with a block of 5 px than with one
#: of 3 px; the refinement restores the sharpness of edges.
BLOCK_PX = 5
SPECKLE_PX = 60  #: connected regions of at most this many pixels are removed as mismatches
#: Width of the window of the contrast normalisation before matching, as a fraction of the image width. It can be large,
#: because illumination and backscatter vary slowly; in a small one, the mean near an object depends on the background.
NORMALISATION_WINDOW = 1 / 7
CONSISTENCY_PX = 1.0  #: largest difference between left-to-right and right-to-left disparity [px]; above: occlusion
MIN_SIGMA_PX = 0.03  #: of errors that the refinement does not model (interpolation, relief inside the window) [px]
MAX_DISPARITY_FRACTION = 0.4  #: largest disparity that is searched, as a fraction of the image width
_SEARCH_STEP_PX = 16  # the number of disparities that are searched is a multiple of this
#: Images are reduced by this factor to find the range of disparities; smallest number of known ones; quantile of them,
#: and relative and absolute [px] margin beyond it at both ends.
_REDUCTION, _LEAST_KNOWN, _QUANTILE, _MARGIN, _MARGIN_PX = 4, 100, 0.001, 0.1, 8
MAX_SIGMA_PX = 1.0  #: of a valid disparity, computed as if pixel noise were independent [px]


class Disparity(NamedTuple):
    """Disparity of every pixel of a left image, with its standard deviation."""

    disparity_px: Map  #: (H, W) float32 disparity [px], NaN where unknown
    sigma_px: Map  #: (H, W) float32 standard deviation of the disparity [px], NaN where unknown

    def with_sigma_below(self, sigma_px: float | Map) -> Disparity:
        """Returns the disparity, NaN where its standard deviation is not below a limit, one or one per pixel [px]."""
        accepted = self.sigma_px < sigma_px
        unknown = np.float32(np.nan)
        return Disparity(np.where(accepted, self.disparity_px, unknown), np.where(accepted, self.sigma_px, unknown))


class DenseMatch(NamedTuple):
    """Disparity of a stereo pair before and after the refinement."""

    coarse_px: Map  #: (H, W) float32 disparity accurate to about 0.2 px [px], NaN where unknown
    fine: Disparity

    @property
    def best_px(self) -> Map:
        """Returns the refined disparity (H, W) [px], or the coarse one where that is unknown."""
        return np.where(np.isfinite(self.fine.disparity_px), self.fine.disparity_px, self.coarse_px)

    def packed(self) -> NDArray[np.uint16]:
        """Returns whole numbers (2, H, W): best disparities in equal steps, sigmas of the fine ones as halves."""
        steps = np.rint(np.nan_to_num(self.best_px) / _step_px(self.best_px.shape[1]))
        return np.stack([steps.astype(np.uint16), self.fine.sigma_px.astype(np.float16).view(np.uint16)])

    @classmethod
    def unpacked(cls, packed: NDArray[np.uint16]) -> DenseMatch:
        """Returns what was packed; the coarse disparity is the best one."""
        sigma_px = packed[1].view(np.float16).astype(np.float32)
        best_px = np.where(packed[0] > 0, packed[0] * _step_px(packed.shape[2]), np.float32(np.nan))
        return cls(best_px, Disparity(np.where(np.isnan(sigma_px), np.float32(np.nan), best_px), sigma_px))


def match_densely(left: Image | Map, right: Image | Map) -> DenseMatch:
    """Returns the disparity of the pixels of the left image that are matched in the right one; NaN elsewhere.

    Semi-global matching (Hirschmueller 2008; OpenCV, three path directions) of images (H, W) with locally normalised
    contrast, with a left-right check, is refined by `epipolar.refine` (bias on a rendered reef 0.002 instead of 0.02
    px). The standard deviation is that without the prior of the refinement.
    """
    coarse = _search_consistent(_normalise_contrast(left), _normalise_contrast(right))
    fine = epipolar.refine(left.astype(np.float32), right.astype(np.float32), coarse, epipolar.STEREO)
    sigma = np.hypot(fine.measurement_sigma_px, np.float32(MIN_SIGMA_PX))
    limit_px = MAX_SIGMA_PX * fine.variance_inflation**0.5
    return DenseMatch(coarse, Disparity(fine.disparity_px, sigma).with_sigma_below(limit_px))


def search_range(left: Image, right: Image) -> tuple[int, int]:
    """Returns the smallest and the largest disparity to search in images (H, W) of normalised contrast [px]."""
    # found in reduced images, at a fiftieth of the time; the whole range if too few pixels match there
    widest_px = int(MAX_DISPARITY_FRACTION * left.shape[1])
    size = left.shape[1] // _REDUCTION, left.shape[0] // _REDUCTION
    small_left, small_right = (
        np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8) for image in (left, right)
    )
    small_range = 0, -(-widest_px // _REDUCTION)
    found = search(small_left, small_right, small_range, SPECKLE_PX // _REDUCTION**2)
    known = found[np.isfinite(found)]
    if known.size < _LEAST_KNOWN:
        return 0, widest_px
    low, high = _REDUCTION * np.quantile(known, (_QUANTILE, 1 - _QUANTILE))
    return max(int(low * (1 - _MARGIN)) - _MARGIN_PX, 0), min(int(high * (1 + _MARGIN)) + _MARGIN_PX, widest_px)


def search(left: Image, right: Image, range_px: tuple[int, int], speckle_px: int = SPECKLE_PX) -> Map:
    """Returns the disparity (H, W) [px] by semi-global matching, accurate to about 0.2 px; NaN where unknown."""
    # images (H, W) of normalised contrast, padded on the left: otherwise the left margin, as wide as the largest
    # disparity searched, would have no disparity
    low, high = range_px
    count = -(-max(high - low, 1) // _SEARCH_STEP_PX) * _SEARCH_STEP_PX
    matcher = cv2.StereoSGBM.create(
        low, count, BLOCK_PX, P1=8 * BLOCK_PX**2, P2=32 * BLOCK_PX**2, disp12MaxDiff=1, preFilterCap=63,
        speckleWindowSize=speckle_px, speckleRange=1, mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    margin = low + count
    padded = [cv2.copyMakeBorder(image, 0, 0, margin, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher.compute(*padded)[:, margin:].astype(np.float32) / np.float32(16)
    column = np.arange(left.shape[1], dtype=np.float32)
    disparity[(disparity < low) | (disparity > column)] = np.nan
    return disparity.astype(np.float32)


def _search_consistent(left: Image, right: Image) -> Map:
    """Returns the disparity from `search`, with NaN at the pixels that fail the left-right consistency check."""
    range_px = search_range(left, right)
    flipped = np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1])
    disparity, mirrored = in_pair(lambda: search(left, right, range_px), lambda: search(*flipped, range_px))
    v, u = np.nonzero(np.isfinite(disparity))
    forward = disparity[v, u]
    # the right image shows the pixel at column u - d, which is width - 1 - (u - d) in the mirrored image
    backward = mirrored[v, np.minimum(left.shape[1] - 1 - u + np.rint(forward).astype(np.int64), left.shape[1] - 1)]
    consistent = np.full_like(disparity, np.nan)
    consistent[v, u] = np.where(np.abs(backward - forward) <= CONSISTENCY_PX, forward, np.nan)
    return consistent


def _step_px(width_px: int) -> np.float32:
    return np.float32((MAX_DISPARITY_FRACTION * width_px + _SEARCH_STEP_PX) / 65000)


def _normalise_contrast(image: Image | Map) -> Image:
    """Returns an image with normalised local mean and contrast; low contrast, mostly noise, is amplified less."""
    window = (2 * int(image.shape[1] * NORMALISATION_WINDOW / 2) + 1,) * 2
    centred = image.astype(np.float32)
    centred -= cv2.boxFilter(centred, -1, window)
    variance = cv2.boxFilter(centred * centred, -1, window)
    return np.clip(128 + 30 * centred / np.sqrt(variance + 200), 0, 255).astype(np.uint8)
