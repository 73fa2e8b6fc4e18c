"""Nearest element of a sorted sequence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array


def nearest_index(sorted_s: Array, times_s: Array) -> NDArray[np.int64]:
    """Returns the index (n,) of the element of the sorted times (m,) that is nearest to each of the times (n,) [s].

    The sorted times must not be empty. Of two elements at the same distance, the earlier one is chosen.
    """
    after = np.clip(np.searchsorted(sorted_s, times_s), 1, max(len(sorted_s) - 1, 1))
    last = len(sorted_s) - 1
    low, high = np.minimum(after - 1, last), np.minimum(after, last)
    return np.where(np.abs(sorted_s[high] - times_s) < np.abs(sorted_s[low] - times_s), high, low)
