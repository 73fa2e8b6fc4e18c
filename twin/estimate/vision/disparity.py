"""Dense stereo disparity with its uncertainty (part P12 of the method): a semi-global search, then refinement."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import StereoRig
from twin.estimate.vision import epipolar

Gray = NDArray[np.uint8]
Map = NDArray[np.float32]

#: Block of the semi-global search [px]: 5 finds more than 3 in veiled water; after refinement edges are as sharp.
BLOCK_PX = 5
#: Surfaces of fewer pixels are mismatches.
SPECKLE_PX = 60
#: Window of the contrast normalisation before the search [share of the image's width]: lamps and veil vary slowly. A
#: small one (25 px) carries the grey of a near object to what lies beside it, differently in the two cameras.
WINDOW = 1 / 7
#: The two cameras' searches agree on a pixel to within this [px]; else one of them does not see it.
AGREE_PX = 1.0
#: What refinement cannot know (interpolation, relief inside the window): never claim less than this [px].
FLOOR_PX = 0.03
#: Widest search [share of the image's width].
WIDEST = 0.4
#: A disparity less certain than this is none [px], were the noise of pixels independent: beyond are mismatches.
LIMIT_PX = 1.0


class Disparity(NamedTuple):
    """Disparity (H, W) float32 [px] and its standard deviation (H, W) float32 [px]; NaN where there is none."""

    disparity_px: Map
    sigma_px: Map

    def surer_than(self, sigma_px: float) -> Disparity:
        """The same without what is less certain."""
        sure = self.sigma_px < sigma_px
        nothing = np.float32(np.nan)
        return Disparity(np.where(sure, self.disparity_px, nothing), np.where(sure, self.sigma_px, nothing))


def dense_disparity(left: Gray, right: Gray, max_disparity_px: int) -> Disparity:
    """Disparity of every left pixel that both cameras see.

    Semi-global matching (Hirschmueller 2008, three-way) finds it to a pixel, on locally normalised contrast, once from
    each eye: what the two do not agree on is half-occluded or a mismatch. Its sub-pixel part locks to whole pixels
    (bias 0.02 px, spread 0.17 px on a rendered reef), so `epipolar.refine` replaces it (bias 0.002 px, spread 0.06 px).
    Sigma is that of the refinement as a measurement of its own, so that it grows where texture fades into noise.

    Args:
        left, right: (H, W) uint8 rectified grey images.
        max_disparity_px: largest disparity searched.
    """
    coarse = search_both(_flattened(left), _flattened(right), max_disparity_px)
    fine = epipolar.refine(left.astype(np.float32), right.astype(np.float32), coarse, epipolar.STEREO)
    sigma = np.hypot(fine.own_sigma_px, np.float32(FLOOR_PX))
    return Disparity(fine.disparity_px, sigma).surer_than(LIMIT_PX * fine.shared**0.5)


class Reach:
    """How far to search: up to the largest disparity of the last pair and a margin (P12), wide at first or if fixed."""

    def __init__(self, rig: StereoRig, fixed_px: int | None = None):
        self._fixed = fixed_px is not None
        self._widest = fixed_px or int(WIDEST * rig.width_px)
        self.max_disparity_px = self._widest

    def see(self, disparity_px: Map) -> None:
        """Adapts to the pair just matched; a pair without any disparity widens the search again."""
        known = disparity_px[np.isfinite(disparity_px)]
        if not self._fixed:
            wanted = 1.3 * np.quantile(known, 0.995) + 8 if known.size > 100 else self._widest
            self.max_disparity_px = min(int(wanted), self._widest)


def search(left: Gray, right: Gray, max_disparity_px: int) -> Map:
    """Semi-global disparity (H, W) [px] of images of even contrast, NaN where none is: good to a fifth of a pixel.

    Padded on the left, so that the margin is only as wide as each pixel's own disparity.
    """
    count = -(-max_disparity_px // 16) * 16
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2,
        P2=32 * BLOCK_PX**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        speckleWindowSize=SPECKLE_PX,
        speckleRange=1,
        mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )
    padded = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher.compute(*padded)[:, count:].astype(np.float32) / np.float32(16)
    column = np.arange(left.shape[1], dtype=np.float32)
    disparity[(disparity < 0) | (disparity > column)] = np.nan
    return disparity.astype(np.float32)


def search_both(left: Gray, right: Gray, max_disparity_px: int) -> Map:
    """`search` of the left image, kept where that of the right one sees the same."""
    found = search(left, right, max_disparity_px)
    mirrored = search(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]), max_disparity_px)
    v, u = np.nonzero(np.isfinite(found))
    forth = found[v, u]
    # seen from the right, the pixel lies at u - d: at width - 1 - (u - d) of the mirrored image
    back = mirrored[v, np.minimum(left.shape[1] - 1 - u + np.rint(forth).astype(np.int64), left.shape[1] - 1)]
    agreed = np.full_like(found, np.nan)
    agreed[v, u] = np.where(np.abs(back - forth) <= AGREE_PX, forth, np.nan)
    return agreed


def _flattened(image: Gray) -> Gray:
    """Local contrast normalised, so that lamps and veil do not steer the search; less so where noise prevails."""
    window = (2 * int(image.shape[1] * WINDOW / 2) + 1,) * 2
    deviation = image.astype(np.float32)
    deviation -= cv2.boxFilter(deviation, -1, window)
    variance = cv2.boxFilter(deviation * deviation, -1, window)
    return np.clip(128 + 30 * deviation / np.sqrt(variance + 200), 0, 255).astype(np.uint8)
