"""Light pattern of the cameras: the smooth part of the images that lamps and backscatter fix to the cameras.

It does not move with the floor. In turbid water its gradient exceeds that of the texture of the floor, above all where
the light of the lamps ends, and a matcher that takes it for texture finds the disparity of the pattern. It is estimated
from the images of many keyframes, which share it, and subtracted before dense matching.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Map = NDArray[np.float32]

#: Degree, along the rows and along the columns, of the polynomial that describes the pattern. Texture is finer than the
#: pattern, so the polynomial removes little of it.
DEGREE = 6


class LightPattern(NamedTuple):
    """Light pattern of a stereo camera.

    Args:
        left, right: (H, W) float32 pattern in each image [grey levels].
    """

    left: Map
    right: Map


def light_pattern(pairs: Iterable[tuple[Map, Map]]) -> LightPattern | None:
    """Returns the light pattern of a survey; None for fewer than two stereo pairs.

    A product of Legendre polynomials is fitted to each image. A coefficient of the pattern is its mean m over the n
    images, multiplied by max(0, 1 - v / m^2), the positive-part estimator of James & Stein (1961), with v the variance
    of the mean. Coefficients that vary between the images as much as their mean, because texture and relief cause them,
    are therefore left in the images. Images of neighbouring keyframes overlap, so v = s^2 / n (1 + r) / (1 - r), with
    s^2 the variance of the coefficient over the images and r the correlation of consecutive images, as in a first-order
    autoregressive process.

    Args:
        pairs: (H, W) float32 grey levels of the left and the right image of keyframes, in their order.
    """
    fits, shape = [], (0, 0)
    for pair in pairs:
        shape = pair[0].shape
        rows, columns = (np.linalg.pinv(_polynomials(n)) for n in shape)
        fits.append([rows @ image.astype(np.float64) @ columns.T for image in pair])
    if len(fits) < 2:
        return None
    coefficients = np.array(fits)
    mean, deviation = coefficients.mean(axis=0), coefficients - coefficients.mean(axis=0)
    variance = deviation.var(axis=0, ddof=1) * _images_per_independent_image(deviation) / len(fits)
    kept = np.maximum(1 - variance / np.maximum(mean**2, 1e-12), 0) * mean
    left, right = (_polynomials(shape[0]) @ side @ _polynomials(shape[1]).T for side in kept)
    return LightPattern(left.astype(np.float32), right.astype(np.float32))


def _polynomials(n: int) -> Array:
    """Returns the Legendre polynomials (n, `DEGREE` + 1) at n pixels."""
    return np.asarray(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), DEGREE), np.float64)


def _images_per_independent_image(deviation: Array) -> float:
    """Returns (1 + r) / (1 - r), with r the correlation of consecutive images, limited to 0 <= r <= 0.9.

    Args:
        deviation: (n, 2, d, d) coefficients of the images, less their means.
    """
    power = np.sum(deviation[1:] ** 2 + deviation[:-1] ** 2) / 2
    r = float(np.clip(np.sum(deviation[1:] * deviation[:-1]) / max(power, 1e-12), 0.0, 0.9))
    return (1 + r) / (1 - r)
