"""Tests of the tiled raster against an array in memory."""

import numpy as np
import pytest

from twin.estimate.vision.tiles import TILE_SIDE, TiledRaster


def test_windows_across_tiles_are_read_as_written_even_from_disk(tmp_path):
    rng = np.random.default_rng(0)
    raster, half = TiledRaster(2, tmp_path / "tiles", max_tiles=3), 2 * TILE_SIDE
    expected = np.full((2, 2 * half, 2 * half), np.nan, np.float32)
    for _ in range(40):
        row, col = rng.integers(-half, half - 300, 2)
        rows, cols = rng.integers(1, 300, 2)
        window = rng.normal(size=(2, rows, cols)).astype(np.float32)
        raster.write(row, col, window)
        expected[:, half + row : half + row + rows, half + col : half + col + cols] = window
        assert len(raster._tiles) <= 3
    np.testing.assert_array_equal(raster.read(-half, -half, 2 * half, 2 * half), expected)
    assert any((tmp_path / "tiles").iterdir())


def test_unwritten_cells_are_nan_and_need_no_memory(tmp_path):
    raster = TiledRaster(1, tmp_path)
    assert np.isnan(raster.read(-1000, 5000, 700, 700)).all()
    assert not raster._tiles


def test_cleared_cells_are_nan_and_their_files_are_deleted(tmp_path):
    raster = TiledRaster(1, tmp_path, max_tiles=1)
    raster.write(0, 0, np.ones((1, 10, 3 * TILE_SIDE), np.float32))
    raster.clear()
    assert np.isnan(raster.read(0, 0, 10, 3 * TILE_SIDE)).all()
    assert not list(tmp_path.iterdir())


def test_an_empty_window_is_empty(tmp_path):
    assert TiledRaster(1, tmp_path).read(5, 5, 0, 0).shape == (1, 0, 0)


def test_a_full_disk_raises_an_error(tmp_path, monkeypatch):
    def raise_disk_full(*_):
        raise OSError(28, "No space left on device")

    raster = TiledRaster(1, tmp_path, max_tiles=1)
    monkeypatch.setattr(np, "save", raise_disk_full)
    with pytest.raises(OSError, match="No space left"):
        raster.write(0, 0, np.ones((1, 10, 3 * TILE_SIDE), np.float32))
