"""Files of the truth: poses as EuRoC/ASL (body), KITTI (camera 0) or TUM (left camera), heights as GeoTIFF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.raster_files import open_raster
from twin.core.records import Trajectory
from twin.datasets.dataset import Dataset
from twin.datasets.euroc import camera_truth
from twin.datasets.kitti import camera_poses
from twin.datasets.text_files import read_table, text_rows
from twin.errors import TwinError
from twin.judge.true_map import TrueMap
from twin.report.run_folder import MOST_CELLS, read_raster

_ALLOWED = "TUM (8 columns), KITTI (12 columns) or EuRoC (timestamp in ns and 7 or more columns, by commas)"
_HEIGHT_GRID = "a GeoTIFF of one band with heights [m], north up, in the frame of the true poses"


def read_true_map(file: Path) -> TrueMap:
    """Returns the true heights in a GeoTIFF: as `twin run` writes them (dem_truth.tif), or in the frame of the poses.

    Raises:
        TwinError: the file cannot be read, has several bands or too many cells, or knows no height.
    """
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

    Args:
        file: EuRoC/ASL data.csv (poses of the body), KITTI poses (of camera 0, one line per frame), or TUM (poses of
            the left camera: time x y z qx qy qz qw).
        dataset: data set, for the times of a KITTI file (those of all frames, with or without a left image) and for the
            pose of the left camera in the body or in camera 0. If this pose is unknown, the left camera is assumed to
            coincide with the body or with camera 0.

    Raises:
        TwinError: the file cannot be read, is damaged, or is of none of these kinds.
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
        return camera_truth(file, np.eye(4) if dataset.body_from_left is None else dataset.body_from_left)
    if columns == 8:
        return _tum(file)
    raise TwinError(str(file), f"has {columns} columns", _ALLOWED)


def _tum(file: Path) -> Trajectory:
    """Returns the poses in a TUM trajectory file.

    Raises:
        TwinError: the file cannot be read, or a quaternion is not of unit length.
    """
    values = read_table(file, 8)
    if not (np.abs(np.linalg.norm(values[:, 4:], axis=1) - 1) < 0.01).all():
        raise TwinError(str(file), "has quaternions that are not of unit length", "time x y z qx qy qz qw")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = geometry.rotation_from_wxyz(values[:, [7, 4, 5, 6]]), values[:, 1:4]
    return Trajectory(values[:, 0], poses)
