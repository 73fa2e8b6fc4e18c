"""Calibration files of Kalibr (cam0 is the left camera): camchain, single cameras of EuRoC folders, imu.yaml."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from twin.core import geometry
from twin.core.geometry import Array
from twin.datasets.calibration import RecordedCamera, StereoCalibration, camera_matrix, distortion_kind, rigid
from twin.datasets.calibration_values import numbers_of, refuse_unknown, size_of, table_of
from twin.datasets.run_contents import RecordedImu
from twin.errors import TwinError

_COEFFICIENTS = "distortion_coeffs", "distortion_coefficients"  # of Kalibr, and of sensor.yaml in EuRoC folders
_READ = ("camera_model", "intrinsics", "distortion_model", "resolution", *_COEFFICIENTS)
_IRRELEVANT = (
    "cam_overlaps", "rostopic", "T_cam_imu", "T_imu_cam", "timeshift_cam_imu", "sensor_type", "comment", "camera_id",
    "rate_hz", "T_BS", "T_cn_cnm1",
)  # fmt: skip


def read_camchain(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns a camchain by T_cn_cnm1, else T_imu_cam of both (OpenVINS); TwinError without cam1, or if wrong."""
    if "cam1" not in tree:
        raise TwinError(str(file), "has one camera only, so it has no baseline", "cam0 and cam1 with T_cn_cnm1")
    refuse_unknown((key for key in tree if not re.fullmatch(r"cam\d", str(key))), file)
    left, right = (camera_of(tree[name], file) for name in ("cam0", "cam1"))
    if "T_cn_cnm1" not in tree["cam1"] and "T_imu_cam" in tree["cam1"]:
        return rig_of([left, right], [tree[name].get("T_imu_cam") for name in ("cam0", "cam1")], "T_imu_cam", file)
    return StereoCalibration(left, right, pose_of(tree["cam1"], "T_cn_cnm1", file), file)


def rig_of(cameras: Sequence[RecordedCamera], poses: Sequence[Any], key: str, file: Path) -> StereoCalibration:
    """Returns the rig of two cameras, given the pose of each in common axes, under `key` in the file."""
    left, right = (rigid(numbers_of(pose, file, key, (4, 4)), key, file) for pose in poses)
    return StereoCalibration(cameras[0], cameras[1], geometry.inverse(right) @ left, file)


def camera_of(table: Any, file: Path) -> RecordedCamera:
    """Returns the camera in a table of a camchain or EuRoC sensor.yaml; raises TwinError for a wrong value or model."""
    table = table_of(table, file)
    if ("distortion_model" in table) != any(name in table for name in _COEFFICIENTS):
        problem = "has a distortion model without coefficients, or coefficients without a model"
        raise TwinError(str(file), problem, "both or none of distortion_model and distortion_coeffs")
    coefficients = next((table[name] for name in _COEFFICIENTS if name in table), None)
    refuse_unknown((key for key in table if key not in _READ + _IRRELEVANT), file)
    size = size_of(table.get("resolution"), file)
    if (model := str(table.get("camera_model", "pinhole"))) not in ("pinhole", "ds"):
        allowed = "pinhole with radtan or equidistant, ds"
        raise TwinError(str(file), f"camera model {model[:40]!r} is not supported", allowed)
    *sphere, fx, fy, cx, cy = numbers_of(table.get("intrinsics"), file, "intrinsics", (6 if model == "ds" else 4,))
    if sphere:
        return RecordedCamera(size, camera_matrix(fx, fy, cx, cy), np.array(sphere), "double_sphere")
    distortion = numbers_of([] if coefficients is None else coefficients, file, "distortion_coeffs").ravel()
    kind = distortion_kind(table.get("distortion_model", "radtan"), file)
    return RecordedCamera(size, camera_matrix(fx, fy, cx, cy), distortion, kind)


def pose_of(table: Any, key: str, file: Path) -> Array:
    """Returns the matrix (4, 4) of a pose, which may be no rigid motion; raises TwinError if it is missing."""
    return numbers_of(table_of(table, file).get(key), file, key, (4, 4))


def write_camchain(file: Path, rig: StereoCalibration, body_from_left: Array | None = None) -> None:
    """Writes a camchain, with T_cam_imu if there is an IMU (in body axes), and `_radtan` distortions."""
    tree = {name: _table(camera, name) for name, camera in (("cam0", rig.left), ("cam1", rig.right))}
    tree["cam1"]["T_cn_cnm1"] = rig.right_from_left.tolist()
    if body_from_left is not None:
        left_from_body = geometry.inverse(body_from_left)
        tree["cam0"]["T_cam_imu"] = left_from_body.tolist()
        tree["cam1"]["T_cam_imu"] = (rig.right_from_left @ left_from_body).tolist()
    file.write_text(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None), encoding="utf-8")


def _table(camera: RecordedCamera, name: str) -> dict[str, Any]:
    matrix = camera.matrix
    return {
        "camera_model": "pinhole",
        "intrinsics": [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])],
        "distortion_model": "radtan",
        "distortion_coeffs": _radtan(camera).tolist(),
        "resolution": list(camera.size_px or ()),
        "rostopic": f"/{name}/image_raw",
    }


def _radtan(camera: RecordedCamera) -> Array:
    """Returns k1, k2, p1, p2; k1 and k2 take over what they can of k3, which Kalibr does not have, in the image."""
    found, k3 = np.array(camera.distortion[:4], np.float64), float(np.append(camera.distortion, 0.0)[4])
    if k3 and camera.size_px is not None:
        r = np.linspace(0, np.linalg.norm(np.array(camera.size_px) / np.diag(camera.matrix)[:2]) / 2, 100)
        found[:2] += np.linalg.lstsq(np.stack([r**3.5, r**5.5], axis=1), k3 * r**7.5)[0]  # weight: pixels at r
    return found


def write_imu(file: Path, imu: RecordedImu) -> None:
    """Writes imu.yaml: noise densities, random walks, rate, and the topic in the ROS 2 bag of the same run."""
    tree = {"rostopic": "/imu/data_raw", "update_rate": float(imu.rate_hz), **imu.noise._asdict()}
    file.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
