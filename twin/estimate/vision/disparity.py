"""Dense stereo disparity with its uncertainty: semi-global matching, followed by sub-pixel refinement."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from twin.core.records import Image, Map, StereoRig
from twin.estimate.vision import epipolar

#: Block size of semi-global matching [px]. In turbid water, more pixels are matched with a block of 5 px than with one
#: of 3 px; the refinement restores the sharpness of edges.
BLOCK_PX = 5
SPECKLE_PX = 60  #: connected regions of at most this many pixels are removed as mismatches
#: Width of the window of the contrast normalisation before matching, as a fraction of the image width. It can be large,
#: because illumination and backscatter vary slowly; in a small one, the mean near an object depends on the background.
NORMALISATION_WINDOW = 1 / 7
#: Largest difference between left-to-right and right-to-left disparity [px]; above, occlusion or mismatch.
CONSISTENCY_PX = 1.0
#: Standard deviation of errors that the refinement does not model (interpolation, relief inside the window) [px].
MIN_SIGMA_PX = 0.03
MAX_DISPARITY_FRACTION = 0.4  #: largest disparity that is searched, as a fraction of the image width
#: Largest standard deviation of a valid disparity, computed as if pixel noise were independent [px].
MAX_SIGMA_PX = 1.0


class Disparity(NamedTuple):
    """Disparity of every pixel of a left image, with its standard deviation."""

    disparity_px: Map  #: (H, W) float32 disparity [px], NaN where unknown
    sigma_px: Map  #: (H, W) float32 standard deviation of the disparity [px], NaN where unknown

    def with_sigma_below(self, sigma_px: float | Map) -> Disparity:
        """Returns the disparity, NaN where its standard deviation is not below a limit, one or one per pixel [px]."""
        accepted = self.sigma_px < sigma_px
        unknown = np.float32(np.nan)
        return Disparity(np.where(accepted, self.disparity_px, unknown), np.where(accepted, self.sigma_px, unknown))


def dense_disparity(left: Image | Map, right: Image | Map, max_disparity_px: int) -> Disparity:
    """Returns the disparity of the pixels of the left image that are matched in the right one; NaN elsewhere.

    Semi-global matching (Hirschmueller 2008; OpenCV, three path directions) of images (H, W) with locally normalised
    contrast, with a left-right check, is refined by `epipolar.refine` (bias on a rendered reef 0.002 instead of 0.02
    px). The standard deviation is that without the prior of the refinement.
    """
    coarse = search_consistent(_normalise_contrast(left), _normalise_contrast(right), max_disparity_px)
    fine = epipolar.refine(left.astype(np.float32), right.astype(np.float32), coarse, epipolar.STEREO)
    sigma = np.hypot(fine.measurement_sigma_px, np.float32(MIN_SIGMA_PX))
    return Disparity(fine.disparity_px, sigma).with_sigma_below(MAX_SIGMA_PX * fine.variance_inflation**0.5)


class SearchRange:
    """Largest disparity to search: the widest one at first, then adapted to the disparities of the last pair."""

    def __init__(self, rig: StereoRig):
        self._widest_px = self.max_disparity_px = int(MAX_DISPARITY_FRACTION * rig.width_px)

    def update(self, disparity_px: Map) -> None:
        """Adapts the range to the disparities (H, W) of the last pair; sets the widest range if too few are known."""
        known = disparity_px[np.isfinite(disparity_px)]
        wanted = 1.3 * np.quantile(known, 0.995) + 8 if known.size > 100 else self._widest_px
        self.max_disparity_px = min(int(wanted), self._widest_px)


def search(left: Image, right: Image, max_disparity_px: int) -> Map:
    """Returns the disparity (H, W) [px] by semi-global matching, accurate to about 0.2 px; NaN where unknown.

    The images (H, W) have normalised contrast. They are padded on the left; otherwise the left margin, as wide as the
    search range (rounded up to a multiple of 16), would have no disparity.
    """
    count = -(-max_disparity_px // 16) * 16
    matcher = cv2.StereoSGBM.create(
        0, count, BLOCK_PX, P1=8 * BLOCK_PX**2, P2=32 * BLOCK_PX**2, disp12MaxDiff=1, preFilterCap=63,
        speckleWindowSize=SPECKLE_PX, speckleRange=1, mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    padded = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher.compute(*padded)[:, count:].astype(np.float32) / np.float32(16)
    column = np.arange(left.shape[1], dtype=np.float32)
    disparity[(disparity < 0) | (disparity > column)] = np.nan
    return disparity.astype(np.float32)


def search_consistent(left: Image, right: Image, max_disparity_px: int) -> Map:
    """Returns the disparity from `search`, with NaN at the pixels that fail the left-right consistency check."""
    disparity = search(left, right, max_disparity_px)
    mirrored = search(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]), max_disparity_px)
    v, u = np.nonzero(np.isfinite(disparity))
    forward = disparity[v, u]
    # the right image shows the pixel at column u - d, which is width - 1 - (u - d) in the mirrored image
    backward = mirrored[v, np.minimum(left.shape[1] - 1 - u + np.rint(forward).astype(np.int64), left.shape[1] - 1)]
    consistent = np.full_like(disparity, np.nan)
    consistent[v, u] = np.where(np.abs(backward - forward) <= CONSISTENCY_PX, forward, np.nan)
    return consistent


def _normalise_contrast(image: Image | Map) -> Image:
    """Returns an image with normalised local mean and contrast; low contrast, mostly noise, is amplified less."""
    window = (2 * int(image.shape[1] * NORMALISATION_WINDOW / 2) + 1,) * 2
    centred = image.astype(np.float32)
    centred -= cv2.boxFilter(centred, -1, window)
    variance = cv2.boxFilter(centred * centred, -1, window)
    return np.clip(128 + 30 * centred / np.sqrt(variance + 200), 0, 255).astype(np.uint8)
