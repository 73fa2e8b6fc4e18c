"""Rows in order of time: an array that grows along its first axis, and the row nearest to a time."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

_INITIAL_CAPACITY = 2**17


class GrowingArray:
    """Contiguous rows of one shape (omitted for scalars); the capacity doubles when full, unused pages take no RAM."""

    def __init__(self, *shape: int, dtype: DTypeLike = float):
        self._buffer, self._n = np.empty((_INITIAL_CAPACITY, *shape), dtype), 0

    @classmethod
    def wrap(cls, rows: NDArray[Any]) -> "GrowingArray":
        """Returns a growing array that holds the rows (n, *shape) without a copy."""
        wrapped = cls.__new__(cls)
        wrapped._buffer, wrapped._n = rows, len(rows)
        return wrapped

    def __reduce__(self) -> tuple[Any, ...]:
        return self.wrap, (self.array,)

    def __len__(self) -> int:
        return self._n

    @property
    def array(self) -> NDArray[Any]:
        return self._buffer[: self._n]

    def append(self, rows: ArrayLike) -> None:
        rows = np.asarray(rows).reshape(-1, *self._buffer.shape[1:])
        end = self._n + len(rows)
        if end > len(self._buffer):
            grown = np.empty((max(end, 2 * len(self._buffer)), *self._buffer.shape[1:]), self._buffer.dtype)
            grown[: self._n] = self.array
            self._buffer = grown
        self._buffer[self._n : end], self._n = rows, end


def nearest_index(sorted_s: NDArray[np.float64], times_s: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the index (n,) of the sorted time (m >= 1) nearest to each time (n,) [s]; of two, the earlier."""
    after = np.clip(np.searchsorted(sorted_s, times_s), 1, max(len(sorted_s) - 1, 1))
    last = len(sorted_s) - 1
    low, high = np.minimum(after - 1, last), np.minimum(after, last)
    return np.where(np.abs(sorted_s[high] - times_s) < np.abs(sorted_s[low] - times_s), high, low)
