"""Quantiles of the chi-square distribution, without `scipy.stats`, whose import takes half a second."""

from typing import Any

from numpy.typing import ArrayLike
from scipy.special import gammaincinv


def chi2_quantile(probability: ArrayLike, degrees_of_freedom: float) -> Any:
    """Returns the values that a chi-square distributed number does not exceed with these probabilities."""
    return 2 * gammaincinv(degrees_of_freedom / 2, probability)
