"""Classes of height errors: by slope, height of the cameras or number of keyframes, and those of standards.

The standards are the orders of IHO S-44 edition 6.1.0 (2022) and the vertical classes of ASPRS edition 2 (2023).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twin.core.records import Array
from twin.judge.summary_statistics import mean, percentile, rms

#: Table 1 of S-44: order, a [m] and b of the total vertical uncertainty (TVU) sqrt(a^2 + (b depth)^2), and total
#: horizontal uncertainty (THU) [m] with the share of the depth to be added; all at 95 %.
IHO_ORDERS = (
    ("Exclusive Order", 0.15, 0.0075, 1.0, 0.0),
    ("Special Order", 0.25, 0.0075, 2.0, 0.0),
    ("Orders 1a and 1b", 0.5, 0.013, 5.0, 0.05),
    ("Order 2", 1.0, 0.023, 20.0, 0.1),
)
ASPRS_CHECK_POINTS = 30  #: smallest number of check points of an accuracy class


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


class OrderCheck(NamedTuple):
    """Uncertainties that an order of S-44 allows at a depth, and whether heights reach its TVU (None: not assessed)."""

    order: str
    tvu_m: float
    thu_m: float
    reached: bool | None


def iho_orders(depth_m: float, error95_m: float | None) -> list[OrderCheck]:
    """Returns all orders at a depth of water, for a 95th percentile of the absolute height errors (None: unknown)."""
    allowed = [(order, math.hypot(a, b * depth_m), c + d * depth_m) for order, a, b, c, d in IHO_ORDERS]
    return [OrderCheck(*one, None if error95_m is None else error95_m <= one[1]) for one in allowed]


def asprs_vertical_class_cm(rmse_m: float | None, check_points: int) -> float | None:
    """Returns the smallest vertical class, in steps of 1 mm [cm], for exact check points; None if not assessed."""
    if rmse_m is None or check_points < ASPRS_CHECK_POINTS:
        return None
    return math.ceil(round(1000 * rmse_m, 6)) / 10
