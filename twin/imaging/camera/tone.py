"""Tone curves: the level of an image as a function of the linear signal, both as fractions of full scale.

linear    V = L
srgb      V = 12.92 L for L <= 0.0031308, else 1.055 L^(1/2.4) - 0.055    (IEC 61966-2-1)
log       V = log2(1 + (2^n - 1) L) / n with n = LOG_STOPS
"""

from typing import Literal

import numpy as np

from twin.core.geometry import Array

ToneCurve = Literal["linear", "srgb", "log"]

LOG_STOPS = 6  # range of the logarithmic curve, in factors of two
SRGB_LINEAR, SRGB_SLOPE, SRGB_OFFSET, SRGB_GAMMA = 0.0031308, 12.92, 0.055, 2.4


def tone(signal: Array, curve: ToneCurve) -> Array:
    """Returns the image level of a linear signal of any shape; all curves but "linear" clip it to 0 to 1 first."""
    if curve == "linear":
        return signal
    clipped = np.clip(signal, 0.0, 1.0)
    if curve == "log":
        return np.log2(1 + (2**LOG_STOPS - 1) * clipped) / LOG_STOPS
    curved = (1 + SRGB_OFFSET) * clipped ** (1 / SRGB_GAMMA) - SRGB_OFFSET
    return np.where(clipped <= SRGB_LINEAR, SRGB_SLOPE * clipped, curved)


def linear_of(level: float, curve: ToneCurve) -> float:
    """Returns the linear signal whose image level is `level`; the inverse of `tone` from 0 to 1."""
    if curve == "linear":
        return level
    if curve == "log":
        return (2 ** (LOG_STOPS * level) - 1) / (2**LOG_STOPS - 1)
    if level <= SRGB_SLOPE * SRGB_LINEAR:
        return level / SRGB_SLOPE
    return ((level + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** SRGB_GAMMA
