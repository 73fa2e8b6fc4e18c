"""Stereo calibration of MATLAB's Computer Vision Toolbox: jsonencode(toStruct(stereoParams))."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from twin.core import geometry
from twin.datasets.calibration import RecordedCamera, StereoCalibration
from twin.datasets.calibration_values import metres_of, numbers_of, table_of


def read_struct(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration; raises TwinError for a missing or a wrong field.

    MATLAB multiplies row vectors, x2 = x1 R + t, so that R is the transposed rotation of OpenCV.
    """
    tables = [table_of(tree.get(key), file) for key in ("CameraParameters1", "CameraParameters2")]
    rotation = numbers_of(tree.get("RotationOfCamera2"), file, "RotationOfCamera2", (3, 3)).T
    translation = numbers_of(tree.get("TranslationOfCamera2"), file, "TranslationOfCamera2", (3,))
    metres = metres_of(tables[0].get("WorldUnits"), "WorldUnits", file)
    left, right = (_camera(table, file) for table in tables)
    return StereoCalibration(left, right, geometry.pose(rotation, metres * translation), file, unit="stated")


def _camera(table: Mapping[str, Any], file: Path) -> RecordedCamera:
    """Returns a camera of MATLAB, where the centre of the first pixel is at (1, 1)."""
    key = "K" if "K" in table else "IntrinsicMatrix"  # K: since R2022b; the other one is transposed
    given = numbers_of(table.get(key), file, key, (3, 3))
    matrix = (given if key == "K" else given.T) - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    radial = numbers_of(table.get("RadialDistortion"), file, "RadialDistortion").ravel()
    p1, p2 = numbers_of(table.get("TangentialDistortion"), file, "TangentialDistortion", (2,))
    height, width = numbers_of(table.get("ImageSize"), file, "ImageSize", (2,)).astype(int).tolist()
    return RecordedCamera((width, height), matrix, np.array([*radial[:2], p1, p2, *radial[2:]]))
