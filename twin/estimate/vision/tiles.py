"""A raster without bounds, cut into square tiles: the latest used in memory, the others on disk."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Layers = NDArray[np.float32]

SIDE = 256
_MOST_TILES = 64  # 50 MB of three layers: a footprint touches about 20


class TiledRaster:
    """Layers of float32 cells at any row and column, also negative ones; unwritten cells are NaN.

    Args:
        n_layers: values per cell.
        folder: where tiles go that are not at hand; made when needed.
        most_tiles: kept in memory.
    """

    def __init__(self, n_layers: int, folder: Path, most_tiles: int = _MOST_TILES):
        self.n_layers, self.folder, self.most_tiles = n_layers, folder, most_tiles
        self._tiles: OrderedDict[tuple[int, int], Layers] = OrderedDict()
        self._spooled: set[tuple[int, int]] = set()

    def read(self, row: int, col: int, rows: int, cols: int) -> Layers:
        """A copy (n_layers, rows, cols) of the window that begins at this cell."""
        window = np.full((self.n_layers, max(rows, 0), max(cols, 0)), np.nan, np.float32)
        for key, inside, outside in _pieces(row, col, rows, cols):
            if key in self._tiles or key in self._spooled:
                window[outside] = self._tile(key)[inside]
        return window

    def write(self, row: int, col: int, window: Layers) -> None:
        """Puts a window (n_layers, rows, cols) back. Raises OSError where the disk is full."""
        for key, inside, outside in _pieces(row, col, *window.shape[1:]):
            if key in self._tiles or key in self._spooled or not np.isnan(window[outside]).all():
                self._tile(key)[inside] = window[outside]

    def clear(self) -> None:
        """Forgets all cells."""
        self._tiles.clear()
        for key in self._spooled:
            self._path(key).unlink(missing_ok=True)
        self._spooled.clear()

    def _tile(self, key: tuple[int, int]) -> Layers:
        if key not in self._tiles:
            if key in self._spooled:
                self._tiles[key] = np.load(self._path(key))
            else:
                self._tiles[key] = np.full((self.n_layers, SIDE, SIDE), np.nan, np.float32)
            if len(self._tiles) > self.most_tiles:
                self._spool(*self._tiles.popitem(last=False))
        self._tiles.move_to_end(key)
        return self._tiles[key]

    def _spool(self, key: tuple[int, int], tile: Layers) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        np.save(self._path(key), tile)
        self._spooled.add(key)

    def _path(self, key: tuple[int, int]) -> Path:
        return self.folder / f"tile_{key[0]}_{key[1]}.npy"


def _pieces(
    row: int, col: int, rows: int, cols: int
) -> Iterator[tuple[tuple[int, int], tuple[slice, ...], tuple[slice, ...]]]:
    """Per tile that a window touches: its key, the part of it inside the window, and that part of the window."""
    for i in range(row // SIDE, -(-(row + rows) // SIDE)):
        for j in range(col // SIDE, -(-(col + cols) // SIDE)):
            top, left = max(row, i * SIDE), max(col, j * SIDE)
            bottom, right = min(row + rows, (i + 1) * SIDE), min(col + cols, (j + 1) * SIDE)
            inside = (slice(None), slice(top - i * SIDE, bottom - i * SIDE), slice(left - j * SIDE, right - j * SIDE))
            yield (i, j), inside, (slice(None), slice(top - row, bottom - row), slice(left - col, right - col))
