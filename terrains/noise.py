"""Random fields with detail at every scale, by summing octaves of noise."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def fractal_field(
    shape: tuple[int, int], coarsest_px: float, gain: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Fractional Brownian surface: octave k has details of coarsest_px / 2^k and amplitude gain^k.

    Args:
        shape: (rows, cols) of the field.
        coarsest_px: size of the coarsest details [cells].
        gain: ratio of the amplitudes of successive octaves, 2^-H for a Hurst exponent H.
    Returns:
        (rows, cols) float32 of zero mean and unit deviation.
    """
    total = np.zeros(shape, np.float32)
    amplitude, scale_px = 1.0, float(max(coarsest_px, 2.0))
    while scale_px >= 1.0:
        cells = [max(4, int(np.ceil(n / scale_px)) + 3) for n in shape]
        noise = rng.standard_normal(cells, dtype=np.float32)
        total += amplitude * _stretch(noise, shape, scale_px)
        amplitude, scale_px = amplitude * gain, scale_px / 2
    return (total - total.mean()) / total.std()


def _stretch(noise: NDArray[np.float32], shape: tuple[int, int], scale_px: float) -> NDArray[np.float32]:
    """Noise cells drawn out to scale_px each, smoothly."""
    affine = np.array([[1 / scale_px, 0, 1], [0, 1 / scale_px, 1]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    drawn = cv2.warpAffine(noise, affine, shape[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(drawn, np.float32)


def grain(shape: tuple[int, int], octaves: int, contrast: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Pink noise in 8 bits, the same contrast in every octave from single texels up, for vision at any range.

    Built from the coarse end, doubling the size each time, so that the cost is 4/3 of that of the finest octave.

    Args:
        contrast: deviation of one octave [grey levels].
    Returns:
        (rows, cols) uint8 around 128.
    """
    sizes = [tuple(-(-n // 2**k) for n in shape) for k in range(octaves)][::-1]
    value = np.full(sizes[0], 128, np.uint8)
    spread = contrast * np.sqrt(12) / 255  # uniform noise of 256 levels has deviation 256 / sqrt(12)
    for rows, cols in sizes:
        value = cv2.resize(value, (cols, rows), interpolation=cv2.INTER_LINEAR)
        noise = np.frombuffer(rng.bytes(rows * cols), np.uint8).reshape(rows, cols)
        value = cv2.addWeighted(value, 1.0, noise, spread, -128 * spread)
    return np.asarray(value, np.uint8)
