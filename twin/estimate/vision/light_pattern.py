"""Light pattern of the cameras: the smooth part of the images that is due to lamps and backscatter.

It moves with the cameras. In turbid water dense matching would find its disparity instead of that of the floor, so it
is estimated from many keyframes and subtracted, unless the texture dominates.
"""

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from twin.core.geometry import Array
from twin.core.records import Image, Map, StereoRig

#: Degree of the polynomial along rows and columns. Texture is finer, so little of it is removed.
DEGREE = 6


def pattern_fit(pair: Sequence[Map] | Map) -> Array:
    """Returns the coefficients (2, d, d) of Legendre polynomials fitted to a pair, by degree along columns and rows."""
    rows, columns = (_fitting_matrix(n) for n in pair[0].shape)
    return np.array([rows @ image.astype(np.float64) @ columns.T for image in pair])


def pattern_coefficients(fits: Sequence[Array]) -> Array | None:
    """Returns the coefficients (2, d, d) of the light pattern from fits of keyframes, in chronological order.

    A coefficient is its mean m over the n keyframes times max(0, 1 - v / m^2) (positive-part shrinkage, James & Stein
    1961), which leaves texture and relief in the images. Images of neighbouring keyframes overlap, so the variance of
    the mean is v = (s^2 / n) (1 + r) / (1 - r), with the variance s^2 over the keyframes and the correlation r of
    consecutive ones.

    None for fewer than two keyframes, and if the sum of m^2 (without constants) does not exceed that of s^2: the floor
    in view then dominates the light, and the mean may be that of a part of the floor.
    """
    if len(fits) < 2:
        return None
    coefficients = np.array(fits)
    mean, deviation = coefficients.mean(axis=0), coefficients - coefficients.mean(axis=0)
    scatter = deviation.var(axis=0, ddof=1)
    if _power_without_mean(mean**2) <= _power_without_mean(scatter):
        return None
    variance = scatter * _images_per_independent_image(deviation) / len(fits)
    return np.asarray(np.maximum(1 - variance / np.maximum(mean**2, 1e-12), 0) * mean)


def light_pattern(coefficients: Array | None, shape: tuple[int, ...]) -> Map:
    """Returns the images (2, H, W) of a light pattern; zeros for None."""
    if coefficients is None:
        return np.zeros((2, *shape), np.float32)
    return np.array([_polynomials(shape[0]) @ side @ _polynomials(shape[1]).T for side in coefficients], np.float32)


def pattern_difference(a: Array | None, b: Array | None) -> float:
    """Returns the RMS difference of two light patterns, without constants, of the image that differs most."""
    difference = np.zeros((2, DEGREE + 1, DEGREE + 1))
    for sign, coefficients in ((1, a), (-1, b)):
        difference += 0 if coefficients is None else sign * coefficients
    norms = 1 / (2 * np.arange(DEGREE + 1) + 1)  # mean squares of the polynomials
    difference[:, 0, 0] = 0
    return float(np.sqrt(np.max(np.einsum("kij,i,j->k", difference**2, norms, norms))))


def _power_without_mean(squares: Array) -> float:
    return float(squares.sum() - squares[:, 0, 0].sum())


def _polynomials(n: int) -> Array:
    """Returns the values (n, `DEGREE` + 1) of the Legendre polynomials at n pixels that span the interval -1 to 1."""
    return np.asarray(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), DEGREE), np.float64)


@lru_cache(maxsize=8)
def _fitting_matrix(n: int) -> Array:
    return np.asarray(np.linalg.pinv(_polynomials(n)), np.float64)


def _images_per_independent_image(deviation: Array) -> float:
    """Returns (1 + r) / (1 - r), r the correlation (0 to 0.9) of consecutive keyframes' `deviation` (n, 2, d, d)."""
    power = np.sum(deviation[1:] ** 2 + deviation[:-1] ** 2) / 2
    r = float(np.clip(np.sum(deviation[1:] * deviation[:-1]) / max(power, 1e-12), 0.0, 0.9))
    return (1 + r) / (1 - r)


class MeanIllumination:
    """Light pattern in colour, the mean of all images added so far, and the gain that removes it from a map."""

    def __init__(self, rig: StereoRig) -> None:
        self._size = (rig.width_px, rig.height_px)
        self._sum = np.zeros((-(-rig.height_px // 4), -(-rig.width_px // 4), 3), np.float32)
        self._count = 0

    def add(self, rgb: Image) -> None:
        small = cv2.resize(rgb, self._sum.shape[1::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
        self._sum += cv2.blur(small, (9, 9))
        self._count += 1

    def gain(self) -> Map:
        """Returns the factor (H, W, 3) that makes the illumination of an image uniform, after at least one `add`."""
        mean = self._sum / self._count + 1
        return np.asarray(cv2.resize(mean.mean(axis=(0, 1)) / mean, self._size), np.float32)
