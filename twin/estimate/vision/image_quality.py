"""Quality of an image for matching: contrast, saturation, and ambiguity of repetitive texture."""

from functools import lru_cache

import cv2
import numpy as np

from twin.core.geometry import Array
from twin.estimate.vision.matching import Gray, Image, local_moments

MAX_REPETITION = 0.6  #: highest autocorrelation (`repetition`) of images whose matches are unambiguous
_FULL_SCALE = 255  # grey level of a saturated pixel
_SMALLEST_WEIGHT = 0.2  # shifts with a smaller overlap of the tapers, relative to zero shift, are ignored


def saturated_fraction(image: Image) -> float:
    """Returns the fraction of the pixel values of an image (H, W, 3) that are at full scale, 0 to 1."""
    return float(np.count_nonzero(image == _FULL_SCALE)) / image.size


def contrast(levels: Gray) -> float:
    """Returns the median over the image of standard deviation / mean around a pixel; image noise is included."""
    mean, square = (moment[::4, ::4] for moment in local_moments(levels))
    sigma = np.sqrt(np.maximum(square - mean**2, 0))
    return float(np.median(sigma / np.maximum(mean, 1.0)))


def repetition(image: Image, patch_px: int) -> float:
    """Returns the highest peak of the autocorrelation of a normalised image at shifts of at least one patch side."""
    # the largest value within a patch, so larger shadows and bright areas are none; natural texture stays below 0.4,
    # repetitive texture, whose matches are ambiguous, comes close to 1
    taper, weight = _taper(*image.shape)
    correlation = _autocorrelation((image.astype(np.float64) - image.mean()) * taper)
    if correlation[0, 0] <= 0:
        return 0.0
    known = weight > _SMALLEST_WEIGHT * weight[0, 0]
    ratio = np.where(known, correlation, 0.0) / np.where(known, weight, 1.0) * (weight[0, 0] / correlation[0, 0])
    ahead = np.fft.fftshift(ratio, axes=1)[:, 1:] if ratio.shape[1] % 2 == 0 else np.fft.fftshift(ratio, axes=1)
    both = np.vstack([ahead[patch_px:0:-1, ::-1], ahead]).astype(np.float32)  # symmetric about the zero shift
    rows, columns = np.nonzero(both == cv2.dilate(both, np.ones((patch_px | 1, patch_px | 1), np.uint8)))
    far = np.hypot(rows - patch_px, columns - (ahead.shape[1] // 2)) >= patch_px
    return float(np.clip(both[rows[far], columns[far]].max(initial=0.0), 0.0, 1.0))


@lru_cache(maxsize=4)
def _taper(height: int, width: int) -> tuple[Array, Array]:
    """Returns a Hann window (height, width) and its autocorrelation."""
    taper = np.outer(np.hanning(height), np.hanning(width))
    return taper, _autocorrelation(taper)


def _autocorrelation(values: Array) -> Array:
    """Returns the autocorrelation of zero-padded values, in the order of a Fourier transform, for row shifts from 0."""
    shape = [cv2.getOptimalDFTSize(2 * side) for side in values.shape]
    spectrum = np.abs(np.fft.rfft2(values, shape)) ** 2
    return np.asarray(np.fft.irfft2(spectrum, shape)[: values.shape[0] // 2], np.float64)
