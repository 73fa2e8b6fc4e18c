"""Calibration files of ORB-SLAM3, OKVIS, VINS-Fusion (CamOdoCal) and Basalt; the first camera is the left one."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from twin.core import geometry
from twin.datasets.calibration import RecordedCamera, StereoCalibration, camera_matrix, distortion_kind
from twin.datasets.calibration_values import numbers_of, refuse_unknown, size_of, table_of
from twin.datasets.dataset import are_rotations
from twin.datasets.kalibr import rig_of
from twin.datasets.text_files import inside, read_yaml
from twin.errors import TwinError

_PINHOLE = ("fx", "fy", "cx", "cy")
#: Camera models of ORB-SLAM3, CamOdoCal and Basalt: lens model, keys of the camera matrix and of the distortion.
_MODELS = {
    "PinHole": ("radtan", _PINHOLE, ("k1", "k2", "p1", "p2", "k3")),
    "KannalaBrandt8": ("fisheye", _PINHOLE, ("k1", "k2", "k3", "k4")),
    "PINHOLE": ("radtan", _PINHOLE, ("k1", "k2", "p1", "p2")),
    "KANNALA_BRANDT": ("fisheye", ("mu", "mv", "u0", "v0"), ("k2", "k3", "k4", "k5")),
    "pinhole": ("radtan", _PINHOLE, ()),
    "pinhole-radtan8": ("radtan", _PINHOLE, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kb4": ("fisheye", _PINHOLE, ("k1", "k2", "k3", "k4")),
    "ds": ("double_sphere", _PINHOLE, ("xi", "alpha")),
}
#: Patterns of the keys that are read, and of those that do not matter.
_ORBSLAM = (
    r"Camera[12]\..*|Camera\.(type|width|height|fps|RGB|imageScale|newWidth|newHeight)|Stereo\.(T_c1_c2|ThDepth)"
    r"|(File|IMU|ORBextractor|Viewer|System|LoopClosing)\..*|loopClosing"
)
_OKVIS = "T_SC|image_dimension|distortion_(coefficients|type)|focal_length|principal_point|camera_type|slam_use"
_CAMODOCAL = "model_type|camera_name|image_(width|height)|(projection|distortion)_parameters"
_BASALT = "T_imu_(cam|marker)|intrinsics|resolution|(calib|imu|accel|gyro|mocap|T_mocap)_.*|vignette|cam_time.*|view_.*"
_IRRELEVANT = ("overlapping(Begin|End)", "rpmax")  # in a camera of ORB-SLAM3 or Basalt


def read_orbslam(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration of an ORB-SLAM3 file; Stereo.T_c1_c2 is the pose of the right camera in the left one."""
    _refuse_others(tree, _ORBSLAM, file)
    model, size = tree.get("Camera.type"), [tree.get("Camera.width"), tree.get("Camera.height")]
    unset = dict.fromkeys(("k1", "k2", "p1", "p2", "k3") if model == "PinHole" else (), 0.0)
    tables = (unset | {key[8:]: value for key, value in tree.items() if key.startswith(f"Camera{k}.")} for k in (1, 2))
    cameras = [_camera(model, table, size, file) for table in tables]
    return rig_of(cameras, [np.eye(4), tree.get("Stereo.T_c1_c2")], "Stereo.T_c1_c2", file)


def read_okvis(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the first two cameras of an OKVIS configuration, whose other tables are settings of the estimator."""
    cameras, tables = [], [table_of(one, file) for one in _two(tree, "cameras", file)]
    for table in tables:
        _refuse_others(table, _OKVIS, file)
        focal, centre = (numbers_of(table.get(key), file, key, (2,)) for key in ("focal_length", "principal_point"))
        lens = numbers_of(table.get("distortion_coefficients"), file, "distortion_coefficients").ravel()
        kind, size = distortion_kind(table.get("distortion_type"), file), size_of(table.get("image_dimension"), file)
        cameras.append(RecordedCamera(size, camera_matrix(*focal, *centre), lens, kind))
    return rig_of(cameras, [table.get("T_SC") for table in tables], "T_SC", file)


def read_vins(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration in a VINS-Fusion configuration and the two files of cameras (CamOdoCal) that it names."""
    cameras = []
    for key in ("cam0_calib", "cam1_calib"):
        if not isinstance(name := tree.get(key), str):
            raise TwinError(str(file), f"{key} is missing", "the file of a camera")
        source = inside(file.parent, name, file)
        camera = read_yaml(source)
        tables = [table_of(camera.get(f"{part}_parameters", {}), source) for part in ("projection", "distortion")]
        size = [camera.get("image_width"), camera.get("image_height")]
        cameras.append(_camera(camera.get("model_type"), {**tables[0], **tables[1]}, size, source))
        _refuse_others(camera, _CAMODOCAL, source)
    return rig_of(cameras, [tree.get("body_T_cam0"), tree.get("body_T_cam1")], "body_T_cam0 or body_T_cam1", file)


def read_basalt(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the first two cameras of a calibration that Basalt writes (JSON)."""
    content, cameras, poses = table_of(tree["value0"], file), [], []
    _refuse_others(content, _BASALT, file)
    found = (_two(content, key, file) for key in ("intrinsics", "resolution", "T_imu_cam"))
    for camera, size, pose in zip(*found, strict=True):
        table = table_of(camera, file)
        cameras.append(_camera(table.get("camera_type"), table_of(table.get("intrinsics"), file), size, file))
        numbers = [table_of(pose, file).get(key) for key in ("px", "py", "pz", "qw", "qx", "qy", "qz")]
        values = numbers_of(numbers, file, "T_imu_cam", (7,))
        if not are_rotations(values[3:]):
            raise TwinError(str(file), "T_imu_cam has a quaternion that is not of unit length", "qx, qy, qz, qw")
        poses.append(geometry.pose(geometry.rotation_from_wxyz(values[3:]), values[:3]))
    return rig_of(cameras, poses, "T_imu_cam", file)


def _camera(model: Any, values: Mapping[str, Any], size: Any, file: Path) -> RecordedCamera:
    if (name := str(model)) not in _MODELS:
        raise TwinError(str(file), f"camera model {name[:40]!r} is not supported", ", ".join(_MODELS))
    kind, matrix, lens = _MODELS[name]
    _refuse_others(values, "|".join(matrix + lens + _IRRELEVANT), file)
    numbers = [float(numbers_of(values.get(key), file, key, ())) for key in matrix + lens]
    return RecordedCamera(size_of(size, file), camera_matrix(*numbers[:4]), np.array(numbers[4:]), kind)


def _two(table: Mapping[str, Any], key: str, file: Path) -> list[Any]:
    if not isinstance(value := table.get(key), list) or len(value) < 2:
        raise TwinError(str(file), f"{key} is not a list of two cameras", "a left and a right camera")
    return value[:2]


def _refuse_others(table: Mapping[str, Any], known: str, file: Path) -> None:
    refuse_unknown((key for key in table if not re.fullmatch(known, str(key))), file)
