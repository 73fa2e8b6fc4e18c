"""Contents of a small run for tests of exports: an asymmetric map with an orthomosaic, and stereo frames over hills."""

from pathlib import Path

import cv2
import numpy as np
import recorded_datasets as recorded

from twin.core.ortho_tiles import OrthoTile, finer_grid
from twin.core.records import ElevationMap, MapGrid, Readings, Trajectory
from twin.datasets.run_contents import RecordedFrame, RunContents
from twin.exchange.geotiff import OrthomosaicFile

GRID = MapGrid(-1.0, 2.0, 0.05, 30, 44)
RED_CORNER = (0.25, 0.25)  # size [m] of the red patch in the north-west corner of the orthomosaic
FINER = 4  # pixels of the orthomosaic per cell


def height_at(x, y):
    """Returns the height [m]: no symmetry maps it to itself."""
    return 0.3 * x - 0.1 * y + 0.02 * x * y


def elevation():
    """Returns a map whose cell (3, 5) is unknown; green grows to the east, blue to the north, red is 40."""
    x, y = np.meshgrid(*GRID.centres())
    height = height_at(x, y).astype(np.float32)
    height[3, 5] = np.nan
    sigma = np.where(np.isnan(height), np.nan, 0.01 + 0.001 * (x - GRID.west_m)).astype(np.float32)
    return ElevationMap(GRID, height, sigma, colours(x, y))


def colours(x, y):
    """Returns the colours (..., 3) of the floor at positions [m], red in the north-west corner."""
    green, blue = (x - GRID.west_m) * 100, (y - GRID.north_m + 1.5) * 150
    red = np.where((x < GRID.west_m + RED_CORNER[0]) & (y > GRID.north_m - RED_CORNER[1]), 255, 40)
    return np.stack([red, green, blue], axis=-1).round().clip(0, 255).astype(np.uint8)


def write_orthomosaic(path: Path, georeference=None) -> Path:
    """Writes the orthomosaic, whose south-east corner of 8 x 8 pixels is transparent, and returns its path."""
    grid = finer_grid(GRID, GRID.cell_m / FINER)
    rgb = colours(*np.meshgrid(*grid.centres()))
    alpha = np.full(rgb.shape[:2], 255, np.uint8)
    alpha[-8:, -8:] = 0
    with OrthomosaicFile(path, grid, georeference) as file:
        file.write(OrthoTile(grid, 0, 0, np.dstack([rgb, alpha])))
    return path


def contents(folder: Path, **changed) -> RunContents:
    """Returns a run with a map; `changed` replaces fields."""
    rig = recorded.RIG
    given = {
        "folder": folder, "name": "small", "scenario": {}, "rig": rig, "true": None,
        "trajectories": {"final": Trajectory(np.zeros(1), np.eye(4)[None])},
        "elevation": elevation(),
    }  # fmt: skip
    return RunContents(**(given | changed))


def flown(folder: Path, n: int = 6, readings=lambda k: Readings(), **changed) -> RunContents:
    """Returns a run with n recorded stereo frames; its final trajectory is 1 cm east of the truth."""
    path, images = recorded.poses(n), folder / "frames"
    images.mkdir(parents=True)
    frames = []
    for frame in recorded.frames(path):
        files = [images / f"{frame.index:04d}_{side}.png" for side in ("left", "right")]
        for file, image in zip(files, (frame.left, frame.right), strict=True):
            cv2.imwrite(str(file), image[..., ::-1])
        frames.append(RecordedFrame(frame.index, frame.time_s, *files, True, readings(frame.index)))
    truth = recorded.trajectory(path)
    estimate = truth.world_from_camera.copy()
    estimate[:, 0, 3] += 0.01
    trajectories = {"truth": truth, "final": Trajectory(truth.times_s, estimate)}
    return contents(folder, frames=tuple(frames), trajectories=trajectories, elevation=None, **changed)
