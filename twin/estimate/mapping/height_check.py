"""Heights from two disjoint sets of keyframes, compared: a test of the map's standard deviations without the truth."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import ElevationMap

MIN_COMMON = 200  # cells with heights from both sets that a comparison needs
_ONE_WAY = 0.2  # share of the keyframes in one of two directions below which a path has no legs there and back


def flown_back(positions_m: Array) -> NDArray[np.bool_]:
    """Returns which keyframes (n,) at positions (n, 3) are on legs back, or every other one without such legs."""
    # legs there and back show a point at different field angles, where errors of distortion and pose differ
    step_m = np.gradient(positions_m, axis=0)
    back = step_m @ np.linalg.svd(step_m, full_matrices=False)[2][0] < 0
    return back if _ONE_WAY <= back.mean() <= 1 - _ONE_WAY else np.arange(len(back)) % 2 == 1


def with_scatter(elevation: ElevationMap, one: ElevationMap, other: ElevationMap) -> ElevationMap:
    """Returns a map with the RMS difference / standard deviation of heights from two sets of keyframes, on its grid."""
    # it multiplies the standard deviations if above 1: the scale factor of Birge (Phys. Rev. 40, 207, 1932)
    ratio = (one.height_m - other.height_m) / np.hypot(one.sigma_m, other.sigma_m)
    if np.isfinite(ratio).sum() < MIN_COMMON:
        return elevation
    scatter = float(np.sqrt(np.nanmean(ratio.astype(np.float64) ** 2)))
    return replace(elevation, sigma_m=elevation.sigma_m * np.float32(max(scatter, 1.0)), scatter=scatter)
