from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.records import Map

TILE_SIDE = 256
_MAX_TILES = 64  # 50 MB with three layers; an image covers about 20 tiles


class TiledRaster:
    """Raster of float32 layers, NaN where unwritten; all but the last `max_tiles` tiles used are in `folder`."""

    def __init__(self, n_layers: int, folder: Path, max_tiles: int = _MAX_TILES):
        self.n_layers, self.folder, self.max_tiles = n_layers, folder, max_tiles
        self._tiles: OrderedDict[tuple[int, int], Map] = OrderedDict()
        self._spooled: set[tuple[int, int]] = set()

    def __getstate__(self) -> dict[str, Any]:
        on_disk = [(key, np.load(self._path(key))) for key in sorted(self._spooled - self._tiles.keys())]
        return vars(self) | {"_tiles": OrderedDict([*on_disk, *self._tiles.items()]), "_spooled": set()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        for stale in self.folder.glob("tile_*.npy"):
            stale.unlink()
        while len(self._tiles) > self.max_tiles:
            self._spool(*self._tiles.popitem(last=False))

    def read(self, row: int, col: int, rows: int, cols: int) -> Map:
        """Returns a copy (n_layers, rows, cols) of the window whose first cell is (row, col). Raises OSError."""
        window = np.full((self.n_layers, max(rows, 0), max(cols, 0)), np.nan, np.float32)
        for key, in_tile, in_window in _overlapping_tiles(row, col, rows, cols):
            if self._exists(key):
                window[in_window] = self._tile(key)[in_tile]
        return window

    def write(self, row: int, col: int, window: Map) -> None:
        """Writes a window (n_layers, rows, cols) whose first cell is (row, col). Raises OSError."""
        for key, in_tile, in_window in _overlapping_tiles(row, col, *window.shape[1:]):
            if self._exists(key) or not np.isnan(window[in_window]).all():
                self._tile(key)[in_tile] = window[in_window]

    def _exists(self, key: tuple[int, int]) -> bool:
        return key in self._tiles or key in self._spooled

    def clear(self) -> None:
        """Removes all tiles from memory and from disk."""
        self._tiles.clear()
        for key in self._spooled:
            self._path(key).unlink(missing_ok=True)
        self._spooled.clear()

    def _tile(self, key: tuple[int, int]) -> Map:
        """Returns a tile (n_layers, `TILE_SIDE`, `TILE_SIDE`), not a copy; loads or creates it if not in memory."""
        if key not in self._tiles:
            if key in self._spooled:
                self._tiles[key] = np.load(self._path(key))
            else:
                self._tiles[key] = np.full((self.n_layers, TILE_SIDE, TILE_SIDE), np.nan, np.float32)
            if len(self._tiles) > self.max_tiles:
                self._spool(*self._tiles.popitem(last=False))
        self._tiles.move_to_end(key)
        return self._tiles[key]

    def _spool(self, key: tuple[int, int], tile: Map) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        np.save(self._path(key), tile)
        self._spooled.add(key)

    def _path(self, key: tuple[int, int]) -> Path:
        return self.folder / f"tile_{key[0]}_{key[1]}.npy"


def _overlapping_tiles(
    row: int, col: int, rows: int, cols: int
) -> Iterator[tuple[tuple[int, int], tuple[slice, ...], tuple[slice, ...]]]:
    """Yields key (row // `TILE_SIDE`, col // `TILE_SIDE`) and overlap (slices of tile and window) of each tile."""
    for i in range(row // TILE_SIDE, -(-(row + rows) // TILE_SIDE)):
        for j in range(col // TILE_SIDE, -(-(col + cols) // TILE_SIDE)):
            top, left = max(row, i * TILE_SIDE), max(col, j * TILE_SIDE)
            bottom, right = min(row + rows, (i + 1) * TILE_SIDE), min(col + cols, (j + 1) * TILE_SIDE)
            first_row, first_col = i * TILE_SIDE, j * TILE_SIDE
            in_tile = (slice(top - first_row, bottom - first_row), slice(left - first_col, right - first_col))
            in_window = (slice(top - row, bottom - row), slice(left - col, right - col))
            yield (i, j), (slice(None), *in_tile), (slice(None), *in_window)
