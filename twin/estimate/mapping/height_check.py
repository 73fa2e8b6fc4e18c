"""Heights from two disjoint sets of keyframes, compared: a test of the map's standard deviations without the truth."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import ElevationMap

MIN_COMMON = 200  # cells with heights from both sets that a comparison needs
_ONE_WAY = 0.2  # a path with a smaller share of keyframes in one of the two directions has no legs there and back


def flown_back(positions_m: Array) -> NDArray[np.bool_]:
    """Returns which of the keyframes (n,) at positions (n, 3) were taken on the legs against the direction of most.

    Legs there and back are neighbours: they show a point at different field angles, so that errors of distortion and
    pose change their heights differently. Every other keyframe is chosen where the path has no such legs.
    """
    step_m = np.gradient(positions_m, axis=0)
    back = step_m @ np.linalg.svd(step_m, full_matrices=False)[2][0] < 0
    return back if _ONE_WAY <= back.mean() <= 1 - _ONE_WAY else np.arange(len(back)) % 2 == 1


def with_scatter(elevation: ElevationMap, one: ElevationMap, other: ElevationMap) -> ElevationMap:
    """Returns a map with the scatter of the heights from two disjoint sets of its keyframes, on its grid.

    The scatter is the RMS of their differences / standard deviation. If it is above 1, the standard deviations are
    multiplied by it, as by the scale factor of Birge (Phys. Rev. 40, 207, 1932). Unchanged with fewer than `MIN_COMMON`
    common cells.
    """
    ratio = (one.height_m - other.height_m) / np.hypot(one.sigma_m, other.sigma_m)
    ratio = ratio[np.isfinite(ratio)].astype(np.float64)
    if len(ratio) < MIN_COMMON:
        return elevation
    scatter = float(np.sqrt(np.mean(ratio**2)))
    return replace(elevation, sigma_m=elevation.sigma_m * np.float32(max(scatter, 1.0)), scatter=scatter)
