"""Ambiguity of matches: how well an image matches itself at another position."""

from __future__ import annotations

import cv2
import numpy as np

from twin.estimate.vision.matching import Image

_SMALLEST_WEIGHT = 0.2  # shifts with a smaller overlap of the tapers, relative to zero shift, are ignored


def repetition(image: Image, patch_px: int) -> float:
    """Returns the largest autocorrelation of an image, 0 to 1, at shifts of at least one patch side.

    Natural texture stays below 0.4. Repetitive texture (tiles, dots, a chequerboard) comes close to 1: a patch then has
    several equally good matches.

    Args:
        image: (height, width) normalised image (`matching.normalise`).
        patch_px: side of the matched patches; smaller shifts belong to the main peak.
    """
    height, width = image.shape
    taper = np.outer(np.hanning(height), np.hanning(width))
    values = (image.astype(np.float64) - image.mean()) * taper
    shape = [cv2.getOptimalDFTSize(2 * side) for side in (height, width)]
    correlation, weight = (
        np.fft.irfft2(np.abs(np.fft.rfft2(part, shape)) ** 2, shape)[: height // 2] for part in (values, taper)
    )
    if correlation[0, 0] <= 0:
        return 0.0
    rows, columns = np.mgrid[: correlation.shape[0], : correlation.shape[1]]
    columns = np.minimum(columns, shape[1] - columns)
    shifted = (np.hypot(rows, columns) >= patch_px) & (weight > _SMALLEST_WEIGHT * weight[0, 0])
    ratio = correlation[shifted] / weight[shifted] * (weight[0, 0] / correlation[0, 0])
    return float(np.clip(ratio.max(initial=0.0), 0.0, 1.0))
