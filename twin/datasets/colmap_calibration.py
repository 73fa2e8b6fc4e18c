"""Calibration of a stereo rig in the text files of COLMAP: cameras.txt with rigs.txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.datasets.calibration import RecordedCamera, StereoCalibration, distortion_kind
from twin.datasets.calibration_values import camera_matrix, size_of
from twin.datasets.text_files import text_rows
from twin.errors import TwinError

#: COLMAP camera models: positions of fx, fy, cx, cy in their parameters, positions of the OpenCV coefficients of
#: distortion (None: zero), and kind of distortion.
_COLMAP: dict[str, tuple[tuple[int, int, int, int], tuple[int | None, ...], str]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), (), "radtan"),
    "PINHOLE": ((0, 1, 2, 3), (), "radtan"),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3, None, None, None), "radtan"),
    "RADIAL": ((0, 0, 1, 2), (3, 4, None, None), "radtan"),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7), "radtan"),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11), "radtan"),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7), "fisheye"),
}


def read_colmap(file: Path) -> StereoCalibration:
    """Returns the calibration in COLMAP's cameras.txt and in rigs.txt, which has the pose of the second camera.

    The left camera is the reference camera of the first rig in rigs.txt, in the same folder as cameras.txt; the right
    camera is the second camera of this rig.

    Raises:
        TwinError: there are fewer than two cameras or no rigs.txt, or a line of either file is not valid.
    """
    cameras = dict(_colmap_camera(file, number, parts) for number, parts in text_rows(file))
    rigs = file.with_name("rigs.txt")
    if len(cameras) < 2 or not rigs.is_file():
        raise TwinError(str(file), "has no baseline", "two cameras, and their rig in rigs.txt beside this file")
    number, parts = next(iter(text_rows(rigs)), (1, list[str]()))
    try:
        reference, second = int(parts[3]), int(parts[5])
        quaternion, translation = np.array(parts[7:11], float), np.array(parts[11:14], float)
        pose = geometry.pose(geometry.rotation_from_wxyz(quaternion), translation)
        return StereoCalibration(cameras[reference], cameras[second], pose, file)
    except (ValueError, IndexError, KeyError):
        allowed = "RIG_ID 2 CAMERA ID CAMERA ID 1 QW QX QY QZ TX TY TZ"
        raise TwinError(f"{rigs}:{number}", "is not the rig of two cameras", allowed) from None


def _colmap_camera(file: Path, number: int, parts: list[str]) -> tuple[int, RecordedCamera]:
    """Returns the identifier and the camera in a line of cameras.txt.

    In COLMAP, the corner of the first pixel is at (0, 0); in the returned camera, the centre of this pixel is at
    (0, 0).

    Args:
        file: cameras.txt, for messages.
        number: number of the line, from 1.
        parts: columns of the line.

    Raises:
        TwinError: the line is not a camera, or its lens model is not supported.
    """
    model = parts[1] if len(parts) > 1 else ""
    if model not in _COLMAP:
        raise TwinError(f"{file}:{number}", f"camera model {model[:40]!r} is not supported", ", ".join(_COLMAP))
    focal, distorted, kind = _COLMAP[model]
    count = 1 + max(*focal, *(k for k in distorted if k is not None))
    if len(parts) > 4 + count:
        problem = f"{model} has {len(parts) - 4} parameters: cameras of refractive COLMAP (a port) are not read"
        raise TwinError(f"{file}:{number}", problem, f"{count} parameters")
    try:
        values = [float(part) for part in parts[4:]]
        fx, fy, cx, cy = (values[k] for k in focal)
        distortion = np.array([0.0 if k is None else values[k] for k in distorted])
        size = size_of([int(parts[2]), int(parts[3])], file)
        camera = RecordedCamera(
            size, camera_matrix(fx, fy, cx - 0.5, cy - 0.5), distortion, distortion_kind(kind, file)
        )
        return int(parts[0]), camera
    except (ValueError, IndexError):
        raise TwinError(f"{file}:{number}", "is not a camera", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None
