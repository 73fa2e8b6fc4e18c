"""Ambiguity of matches in repetitive texture, measured by the autocorrelation of the image."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from twin.core.geometry import Array
from twin.estimate.vision.matching import Image

_SMALLEST_WEIGHT = 0.2  # shifts with a smaller overlap of the tapers, relative to zero shift, are ignored


def repetition(image: Image, patch_px: int) -> float:
    """Returns the largest autocorrelation of an image, 0 to 1, at shifts of at least one patch side.

    Natural texture stays below 0.4. Repetitive texture (tiles, dots, a chequerboard) comes close to 1: a patch then has
    several equally good matches.

    Args:
        image: (height, width) normalised image (`matching.normalise`).
        patch_px: side of the matched patches [px]; smaller shifts belong to the main peak.
    """
    taper, weight = _taper(*image.shape)
    correlation = _autocorrelation((image.astype(np.float64) - image.mean()) * taper)
    if correlation[0, 0] <= 0:
        return 0.0
    rows, columns = np.mgrid[: weight.shape[0], : weight.shape[1]]
    columns = np.minimum(columns, weight.shape[1] - columns)
    shifted = (np.hypot(rows, columns) >= patch_px) & (weight > _SMALLEST_WEIGHT * weight[0, 0])
    ratio = correlation[shifted] / weight[shifted] * (weight[0, 0] / correlation[0, 0])
    return float(np.clip(ratio.max(initial=0.0), 0.0, 1.0))


@lru_cache(maxsize=4)
def _taper(height: int, width: int) -> tuple[Array, Array]:
    """Returns the taper (height, width), a Hann window, for images of this size, and its autocorrelation."""
    taper = np.outer(np.hanning(height), np.hanning(width))
    return taper, _autocorrelation(taper)


def _autocorrelation(values: Array) -> Array:
    """Returns the autocorrelation of zero-padded values (height, width), indexed by the shifts in row and in column.

    Row shifts are from 0 up to half the height; negative column shifts follow the positive ones, as in a discrete
    Fourier transform.
    """
    shape = [cv2.getOptimalDFTSize(2 * side) for side in values.shape]
    spectrum = np.abs(np.fft.rfft2(values, shape)) ** 2
    return np.asarray(np.fft.irfft2(spectrum, shape)[: values.shape[0] // 2], np.float64)
