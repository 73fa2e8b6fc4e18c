"""Claims on the tiled raster, against a plain array that holds everything."""

import numpy as np
import pytest

from twin.estimate.vision.tiles import SIDE, TiledRaster


def test_windows_read_what_was_written_across_tiles_also_from_disk(tmp_path):
    rng = np.random.default_rng(0)
    raster, half = TiledRaster(2, tmp_path / "tiles", most_tiles=3), 2 * SIDE
    plain = np.full((2, 2 * half, 2 * half), np.nan, np.float32)
    for _ in range(40):
        row, col = rng.integers(-half, half - 300, 2)
        rows, cols = rng.integers(1, 300, 2)
        window = rng.normal(size=(2, rows, cols)).astype(np.float32)
        raster.write(row, col, window)
        plain[:, half + row : half + row + rows, half + col : half + col + cols] = window
        assert len(raster._tiles) <= 3
    np.testing.assert_array_equal(raster.read(-half, -half, 2 * half, 2 * half), plain)
    assert any((tmp_path / "tiles").iterdir())


def test_what_was_never_written_is_unknown_and_takes_no_memory(tmp_path):
    raster = TiledRaster(1, tmp_path)
    assert np.isnan(raster.read(-1000, 5000, 700, 700)).all()
    assert not raster._tiles


def test_cleared_cells_are_unknown_again_and_leave_no_file(tmp_path):
    raster = TiledRaster(1, tmp_path, most_tiles=1)
    raster.write(0, 0, np.ones((1, 10, 3 * SIDE), np.float32))
    raster.clear()
    assert np.isnan(raster.read(0, 0, 10, 3 * SIDE)).all()
    assert not list(tmp_path.iterdir())


def test_an_empty_window_is_empty(tmp_path):
    assert TiledRaster(1, tmp_path).read(5, 5, 0, 0).shape == (1, 0, 0)


def test_a_full_disk_is_an_error_not_a_hole(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    raster = TiledRaster(1, tmp_path, most_tiles=1)
    monkeypatch.setattr(np, "save", full)
    with pytest.raises(OSError, match="No space left"):
        raster.write(0, 0, np.ones((1, 10, 3 * SIDE), np.float32))
