"""Maps in tiles: a long path needs tiles where images are, and the tiles together are the undivided map."""

from functools import partial

import numpy as np
import pytest
import rasterio
import recorded_datasets as recorded
import seafloor_scene as scene

import twin
from twin.core import geometry
from twin.core.records import StereoRig, SurveyResult, Trajectory
from twin.estimate import EstimatorSettings, Navigator, pipeline
from twin.estimate.mapping.footprint import footprint_grid, footprint_tiles, steps_between
from twin.recordings.replay import ReplayOptions

RIG = StereoRig(320, 240, 277.0, 0.15, 5.0)


def flown(positions):
    """Returns the result of a survey with keyframes at positions (n, 2), 2 m above the floor."""
    poses = np.array([scene.down_camera(x, y, 2.0) for x, y in positions])
    n = len(poses)
    path, rows = Trajectory(np.arange(float(n)), poses), np.arange(n)
    return SurveyResult(path, path, path, rows, np.ones(n, np.int64), np.zeros((n, 6, 6)), np.full(n, 2.0))


def test_the_tiles_of_a_diagonal_transect_grow_with_its_length_and_not_with_its_square():
    """A kilometre at 45 degrees: the rectangle has 1e9 cells; the tiles along the path at most 3 per tile side."""
    counts = []
    for length_m in (250.0, 500.0, 1000.0):
        along = np.arange(0, length_m, 0.5) / 2**0.5
        result = flown(np.column_stack([along, along]))
        grid = footprint_grid(result, RIG, np.inf)
        tiles = footprint_tiles(result, RIG, most_cells=1e7)
        counts.append(len(tiles))
        assert len(tiles) <= 3 * (1 + grid.cols / 1024) and grid.rows * grid.cols > 5e7
        assert all(tile.grid.cell_m == grid.cell_m and tile.grid.rows * tile.grid.cols <= 1024**2 for tile in tiles)
    assert counts[2] < 2.3 * counts[1] < 5.3 * counts[0]
    assert footprint_grid(result, RIG).cell_m > 3 * grid.cell_m  # what an undivided map costs


def test_every_point_of_an_image_lies_in_a_tile_that_knows_the_image():
    rng = np.random.default_rng(0)
    result = flown(np.cumsum(rng.normal(size=(200, 2)), axis=0))
    tiles = footprint_tiles(result, RIG, most_cells=1, side=100)
    pixels = rng.uniform([0, 0], [319, 239], (20, 2))
    rays = np.column_stack([RIG.normalised(pixels), np.ones(20)])
    for number, pose in enumerate(result.final.world_from_camera):
        for x, y, _ in geometry.transform(pose, rays * 2.0):
            inside = [
                tile for tile in tiles
                if 0 <= (x - tile.grid.west_m) / tile.grid.cell_m < tile.grid.cols
                and 0 <= (tile.grid.north_m - y) / tile.grid.cell_m < tile.grid.rows
            ]  # fmt: skip
            assert len(inside) == 1 and number in inside[0].keyframes


def test_a_map_within_the_limit_has_no_tiles():
    result = flown([(0.0, 0.0), (1.0, 0.5)])
    assert footprint_tiles(result, RIG) == []


def test_steps_over_keyframes_that_a_tile_does_not_show_add_up():
    cov = np.arange(1.0, 7)[:, None, None] * np.eye(6)
    found = steps_between(cov, np.array([1, 2, 5]))
    np.testing.assert_array_equal(found[:, 0, 0], [2, 3, 4 + 5 + 6])
    np.testing.assert_array_equal(steps_between(cov, np.array([3]))[:, 0, 0], [4])


@pytest.mark.long
def test_the_tiles_together_are_the_undivided_map(monkeypatch):
    """Cells at the start of the keyframes of a tile lack what earlier keyframes propagate: a part of their noise."""
    path = recorded.poses(16, step_m=0.08)
    with Navigator(recorded.RIG, EstimatorSettings(), path[0]) as navigator:
        for frame in recorded.frames(path):
            navigator.update(frame)
        result = navigator.finish()
        whole = navigator.build_map(result)
        assert list(navigator.build_tiles(result)) == []
        monkeypatch.setattr(pipeline, "footprint_tiles", partial(footprint_tiles, most_cells=1, side=48))
        tiles = list(navigator.build_tiles(result))
    assert len(tiles) >= 4 and min(len(tile.keyframes) for tile, _ in tiles) < len(result.keyframe_rows)
    height = np.full(whole.height_m.shape, np.nan, np.float32)
    for _, part in tiles:
        row = round((whole.grid.north_m - part.grid.north_m) / whole.grid.cell_m)
        col = round((part.grid.west_m - whole.grid.west_m) / whole.grid.cell_m)
        height[row : row + part.grid.rows, col : col + part.grid.cols] = part.height_m
    known, tiled = np.isfinite(whole.height_m), np.isfinite(height)
    assert (known != tiled).mean() < 0.01
    difference_m = np.abs(whole.height_m - height)[known & tiled]
    assert np.median(difference_m) < 1e-4 and np.percentile(difference_m, 99) < 0.01


@pytest.mark.long
def test_a_replay_whose_map_is_enlarged_writes_tiles_that_read_as_one(monkeypatch, tmp_path):
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(recorded.poses(12, step_m=0.06)))
    whole = twin.replay(folder, tmp_path / "whole", ReplayOptions(outputs=()))
    assert not (tmp_path / "whole" / "tiles").exists() and "tiles" not in whole.metrics["replay"]
    monkeypatch.setattr(pipeline, "footprint_tiles", partial(footprint_tiles, most_cells=1, side=40))
    found = twin.replay(folder, tmp_path / "run", ReplayOptions(outputs=()))
    tiles = tmp_path / "run" / "tiles"
    assert found.status == "complete" and found.metrics["replay"]["tiles"] == len(list(tiles.glob("mosaic_*.tif")))
    with rasterio.open(tiles / "dem.vrt") as tiled, rasterio.open(tmp_path / "run" / "dem.tif") as undivided:
        height = undivided.read(1)
        window = tiled.window(*undivided.bounds).round_offsets().round_lengths()
        together = tiled.read(1, window=window, boundless=True, fill_value=np.nan)
        assert tiled.transform.a == pytest.approx(undivided.transform.a)
    both = np.isfinite(height) & np.isfinite(together)
    assert both.mean() > 0.95 * np.isfinite(height).mean()
    assert np.median(np.abs(height - together)[both]) < 1e-4
    with rasterio.open(tiles / "mosaic.vrt") as colours:
        assert colours.count == 3 and (colours.read() > 0).any()


@pytest.mark.long
def test_an_interrupt_of_the_tiles_keeps_the_map_and_the_finished_tiles(monkeypatch, tmp_path):
    def one_and_interrupt(self, result):
        yield next(iter(complete(self, result)))
        raise KeyboardInterrupt

    complete = Navigator.build_tiles
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(recorded.poses(8, step_m=0.06)))
    monkeypatch.setattr(pipeline, "footprint_tiles", partial(footprint_tiles, most_cells=1, side=40))
    monkeypatch.setattr(Navigator, "build_tiles", one_and_interrupt)
    found = twin.replay(folder, tmp_path / "run", ReplayOptions(outputs=()))
    assert found.status == "aborted" and found.metrics["reason"] == "interrupted; tiles skipped"
    assert found.elevation is not None
