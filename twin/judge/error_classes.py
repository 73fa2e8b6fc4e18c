"""Height errors by class of another quantity, such as slope, height of the cameras or number of keyframes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twin.core.records import Array
from twin.judge.summary_statistics import mean, percentile, rms


class ErrorClass(NamedTuple):
    """Height errors of the cells with low <= value < high."""

    low: float
    high: float
    share: float  #: of the cells with an error
    bias_m: float | None
    le90_m: float | None  #: 90th percentile of the absolute error
    sigma_ratio: float | None  #: RMS of error / sigma


def error_classes(error_m: Array, sigma_m: Array, values: Array, edges: Sequence[float]) -> list[ErrorClass]:
    """Returns the height errors by classes of values between successive edges; classes without cells are left out.

    error_m, sigma_m and values are (rows, cols); cells in which one of them is NaN are in no class.
    """
    known = np.isfinite(error_m) & (sigma_m > 0) & np.isfinite(values)
    error, sigma, value = error_m[known], sigma_m[known], values[known]
    classes = []
    for low, high in zip(edges, edges[1:], strict=False):
        inside = (value >= low) & (value < high)
        if inside.any():
            e = error[inside]
            parts = mean(e), percentile(np.abs(e), 90), rms(e / sigma[inside])
            classes.append(ErrorClass(low, high, float(inside.mean()), *parts))
    return classes
