"""Files of the truth that a user names: poses as EuRoC/ASL (body), KITTI (camera 0) or TUM (left camera), heights."""

from pathlib import Path

import numpy as np

from twin.core.records import Trajectory
from twin.core.user_files import open_raster
from twin.datasets import tum
from twin.datasets.dataset import Dataset
from twin.datasets.euroc import camera_truth
from twin.datasets.kitti import camera_poses
from twin.datasets.text_files import read_text, text_rows
from twin.errors import TwinError
from twin.exchange.geotiff import MOST_CELLS, read_raster
from twin.judge.recorded import TrueMap

_ALLOWED = "TUM (8 columns), KITTI (12 columns) or EuRoC (timestamp in ns and 7 or more columns, by commas)"
_HEIGHT_GRID = "a GeoTIFF of one band with heights [m], north up, in the frame of the true poses"


def read_true_map(file: Path) -> TrueMap:
    """Returns the heights in a GeoTIFF, of `twin run` or in the frame of the poses; raises TwinError if unusable."""
    with open_raster(file, "", _HEIGHT_GRID) as source:
        size = source.width * source.height
        if source.count != 1 or size > MOST_CELLS or (source.crs is not None and source.crs.is_geographic):
            problem = f"has {source.count} bands and {size} cells, CRS {str(source.crs)[:60]}"
            raise TwinError(str(file), problem, f"{_HEIGHT_GRID}, up to {MOST_CELLS} cells")
        grid, height_m = read_raster(file)
    if not np.isfinite(height_m).any():
        raise TwinError(str(file), "has no heights", _HEIGHT_GRID)
    return TrueMap(grid, height_m)


def read_truth(file: Path, dataset: Dataset) -> Trajectory:
    """Returns the true poses of the left camera, in the clock of the data set.

    The file is EuRoC/ASL data.csv (poses of the body), KITTI poses (of camera 0, one line per frame, with or without a
    left image), or TUM (poses of the left camera). Where the pose of the left camera in body or camera 0 is unknown,
    both are assumed to coincide. Raises TwinError if the file is damaged or of none of these kinds.
    """
    rows = text_rows(file)
    if not rows:
        raise TwinError(str(file), "has no poses", _ALLOWED)
    columns, first = len(rows[0][1]), rows[0][1][0].strip()
    if columns == 12:
        times_s = dataset.frame_times_s
        if times_s is None:
            times_s = np.array([frame.time_s for frame in dataset.images])
        return camera_poses(file, times_s, dataset.body_from_left)
    if columns >= 8 and first.isdecimal() and len(first) >= 16:
        if "," not in read_text(file):
            raise TwinError(str(file), f"has the time {first}", "seconds, as in TUM, or commas, as in EuRoC")
        return camera_truth(file, np.eye(4) if dataset.body_from_left is None else dataset.body_from_left)
    if columns == 8:
        return tum.read_trajectory(file)
    raise TwinError(str(file), f"has {columns} columns", _ALLOWED)
