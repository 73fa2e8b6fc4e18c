"""Calibration of a stereo rig from sensor_msgs/CameraInfo (REP 104), in messages or in files of ROS."""

import re
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked, distortion_kind, rigid
from twin.datasets.calibration_values import numbers_of, refuse_unknown
from twin.datasets.text_files import read_yaml
from twin.errors import TwinError

_SIZE_KEYS = "image_width", "image_height"  # in a file
_NUMBERS = {  # fields of a message, their keys in a file and their numbers of values
    "k": ("camera_matrix", (9,)),
    "d": ("distortion_coefficients", None),
    "r": ("rectification_matrix", (9,)),
    "p": ("projection_matrix", (12,)),
}


def stereo_calibration(
    left: Any, right: Any, rectified: bool, right_from_left: Array | None, file: Path
) -> StereoCalibration:
    """Returns the calibration in two messages CameraInfo; raises TwinError if they have no baseline or a wrong value.

    The projection matrices P of a pair refer to rectified axes, x_rectified = R x, and P_right[0, 3] = -fx baseline. A
    point x of the left camera is therefore at R_right^T (R_left x + (t, 0, 0)) in the right one, with t = P[0, 3] /
    P[0, 0] of the right camera minus that of the left one (definition of sensor_msgs/CameraInfo). P, not K and D, is
    the calibration of images that are `rectified`. Without a baseline in P, `right_from_left` (4, 4) of /tf_static is
    used.
    """
    cameras = [_camera(info, rectified, file) for info in (left, right)]
    turns = [np.eye(3) if rectified else _rotation(info, file) for info in (left, right)]
    offset_m = _offset_m(right, file) - _offset_m(left, file)
    if offset_m != 0:
        right_from_left = geometry.pose(turns[1].T @ turns[0], turns[1].T @ np.array([offset_m, 0.0, 0.0]))
    elif right_from_left is None:
        allowed = "P[3] = -fx * baseline of the right camera, or both cameras in /tf_static"
        raise TwinError(str(file), "has no baseline", allowed)
    return checked(StereoCalibration(cameras[0], cameras[1], right_from_left, file))


def _camera(info: Any, rectified: bool, file: Path) -> RecordedCamera:
    size = (int(info.width), int(info.height)) if info.width and info.height else None
    if rectified:
        return RecordedCamera(size, np.array(info.p, float).reshape(3, 4)[:, :3], np.zeros(0))
    distortion = np.array(info.d, float)
    if not distortion.any():
        distortion = np.zeros(0)
    kind = distortion_kind(info.distortion_model or "none", file)
    if kind == "fisheye":
        distortion = distortion[:4]
    part = info.roi.width not in (0, info.width) or info.roi.height not in (0, info.height)
    if part or info.binning_x > 1 or info.binning_y > 1:
        raise TwinError(str(file), "images of a region of interest or binned ones are not supported", "full images")
    return RecordedCamera(size, np.array(info.k, float).reshape(3, 3), distortion, kind)


def _rotation(info: Any, file: Path) -> Array:
    """Returns the rectifying rotation R (3, 3), the identity if it is not set; raises TwinError if it is none."""
    rotation = np.array(info.r, float).reshape(3, 3)
    if not rotation.any():
        return np.eye(3)
    return rigid(geometry.pose(rotation, np.zeros(3)), "R", file)[:3, :3]


def _offset_m(info: Any, file: Path) -> float:
    """Returns P[0, 3] / P[0, 0] [m]: minus the position of a camera along the baseline; 0 unless P[0, 0] > 0."""
    fx, shift = float(info.p[0]), float(info.p[3])
    if not np.isfinite([fx, shift]).all():
        raise TwinError(str(file), "P is not a set of finite numbers")
    return shift / fx if fx > 0 else 0.0


def read_pair(_: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration of two files camera_info, given either; raises TwinError if one is missing or wrong."""
    names = [re.sub("left|right", side, file.name, count=1, flags=re.IGNORECASE) for side in ("left", "right")]
    if names[0] == names[1]:
        raise TwinError(str(file), "is one camera of ROS, without the other one", "files called left and right")
    left, right = (_read_message(file.with_name(name)) for name in names)
    return stereo_calibration(left, right, False, None, file)


def _read_message(file: Path) -> SimpleNamespace:
    tree = read_yaml(file)
    known = {*_SIZE_KEYS, "camera_name", "distortion_model", *(key for key, _ in _NUMBERS.values())}
    refuse_unknown((key for key in tree if key not in known), file)
    numbers = {name: numbers_of(tree.get(key), file, key, shape).ravel() for name, (key, shape) in _NUMBERS.items()}
    width, height = numbers_of([tree.get(key) for key in _SIZE_KEYS], file, "the image size", (2,)).astype(int)
    return SimpleNamespace(
        **numbers, width=width, height=height, distortion_model=tree.get("distortion_model") or "missing",
        roi=SimpleNamespace(width=0, height=0), binning_x=0, binning_y=0,
    )  # fmt: skip
