"""Arrays that grow at their end."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

_ROOM = 2**17


class Rows:
    """Rows of one shape, one after another in one array; its room doubles when it is full.

    It begins with what most surveys need: pages that nothing is written to take no memory, copies to new room do.
    """

    def __init__(self, *shape: int, kind: DTypeLike = float):
        self._room, self._n = np.empty((_ROOM, *shape), kind), 0

    @classmethod
    def of(cls, rows: NDArray[Any]) -> Rows:
        """These (n, *shape), and more to come."""
        made = cls.__new__(cls)
        made._room, made._n = rows, len(rows)
        return made

    def __len__(self) -> int:
        return self._n

    @property
    def array(self) -> NDArray[Any]:
        """All of them so far (n, *shape), a view."""
        return self._room[: self._n]

    def add(self, rows: ArrayLike) -> None:
        """Adds one row (*shape) or more (k, *shape)."""
        rows = np.asarray(rows).reshape(-1, *self._room.shape[1:])
        end = self._n + len(rows)
        if end > len(self._room):
            grown = np.empty((max(end, 2 * len(self._room)), *self._room.shape[1:]), self._room.dtype)
            grown[: self._n] = self.array
            self._room = grown
        self._room[self._n : end], self._n = rows, end
