"""Random fields with detail at every scale: sums of octaves of noise."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def fractal_field(
    shape: tuple[int, int], coarsest_px: float, gain: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Generates an approximate fractional Brownian surface as a sum of octaves of interpolated random values.

    The random values of octave k are coarsest_px / 2^k cells apart, at least one cell; its amplitude is gain^k.

    Args:
        shape: (rows, cols) of the field.
        coarsest_px: distance between the random values of the coarsest octave [cells]; below 2, it is 2.
        gain: amplitude ratio of successive octaves, 2^-H for a Hurst exponent H.
    Returns:
        (rows, cols) float32 field with zero mean and unit standard deviation.
    """
    total = np.zeros(shape, np.float32)
    amplitude, scale_px = 1.0, float(max(coarsest_px, 2.0))
    while scale_px >= 1.0:
        cells = [max(4, int(np.ceil(n / scale_px)) + 3) for n in shape]
        noise = rng.standard_normal(cells, dtype=np.float32)
        total += amplitude * _upsample(noise, shape, scale_px)
        amplitude, scale_px = amplitude * gain, scale_px / 2
    return (total - total.mean()) / total.std()


def _upsample(noise: NDArray[np.float32], shape: tuple[int, int], scale_px: float) -> NDArray[np.float32]:
    """Upsamples noise by the factor scale_px with cubic interpolation; returns a field of the given shape."""
    affine = np.array([[1 / scale_px, 0, 1], [0, 1 / scale_px, 1]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    upsampled = cv2.warpAffine(noise, affine, shape[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(upsampled, np.float32)


def pink_noise(shape: tuple[int, int], octaves: int, contrast: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Generates 8-bit pink noise.

    The random values of every octave have the same standard deviation, so an image of a floor with this texture shows
    detail at any distance. Starting with the coarsest octave, the field is repeatedly doubled in size and the next
    octave is added.

    Args:
        shape: (rows, cols) of the result.
        octaves: number of octaves; the finest one has one random value per cell of the result.
        contrast: standard deviation of the random values of an octave, before interpolation [grey levels].
    Returns:
        (rows, cols) uint8 with a mean of about 128.
    """
    sizes = [tuple(-(-n // 2**k) for n in shape) for k in range(octaves)][::-1]
    value = np.full(sizes[0], 128, np.uint8)
    weight = contrast * np.sqrt(12) / 255  # uniform noise from 0 to 255 has the standard deviation 255 / sqrt(12)
    for rows, cols in sizes:
        value = cv2.resize(value, (cols, rows), interpolation=cv2.INTER_LINEAR)
        noise = np.frombuffer(rng.bytes(rows * cols), np.uint8).reshape(rows, cols)
        value = cv2.addWeighted(value, 1.0, noise, weight, -128 * weight)
    return np.asarray(value, np.uint8)
