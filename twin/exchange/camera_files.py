"""Export of the true and the believed calibration in the file formats of OpenCV, Kalibr (with IMU) and COLMAP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from twin.core import geometry
from twin.exchange.run_contents import CameraIntrinsics, RecordedImu, RigCalibration, RunContents


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the calibration in the formats of OpenCV, Kalibr and COLMAP; returns the folders `believed` and `true`.

    The believed calibration is that of the estimators, with which the images were rectified. The true calibration
    describes the same rectified images: if the believed one has errors, these images still have some distortion and
    the cameras some relative rotation. If the true calibration is not known, only `believed` is written. Runs with an
    IMU also get imu.yaml (Kalibr).
    """
    written = []
    for name, rig in (("believed", contents.believed), ("true", contents.true)):
        if rig is not None:
            target = folder / name
            target.mkdir(exist_ok=True)
            write_opencv(target / "opencv.yaml", rig)
            write_kalibr(target / "kalibr.yaml", rig, with_imu=contents.imu is not None)
            write_colmap_cameras(target, rig)
            if contents.imu is not None:
                write_kalibr_imu(target / "imu.yaml", contents.imu)
            written.append(target)
    return written


def write_opencv(file: Path, rig: RigCalibration) -> None:
    """Writes an OpenCV file: M1, D1, M2, D2, R, T, image_width, image_height, residual_px.

    1 is the left camera, 2 the right one; R and T [m] are the pose of the left camera in the axes of the right one.
    """
    right_from_left = geometry.inverse(rig.left_from_right)
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    try:
        storage.write("image_width", rig.left.size_px[0])
        storage.write("image_height", rig.left.size_px[1])
        matrices = {
            "M1": rig.left.matrix,
            "D1": rig.left.distortion.reshape(1, -1),
            "M2": rig.right.matrix,
            "D2": rig.right.distortion.reshape(1, -1),
            "R": right_from_left[:3, :3],
            "T": right_from_left[:3, 3:],
        }
        for name, matrix in matrices.items():
            storage.write(name, np.ascontiguousarray(matrix))
        storage.write("residual_px", rig.residual_px)
    finally:
        storage.release()


def write_kalibr(file: Path, rig: RigCalibration, with_imu: bool = False) -> None:
    """Writes a Kalibr camchain: cam0 is the left camera, cam1 the right one, with T_cn_cnm1.

    The coefficient k3 is left out, because Kalibr's model radtan has none. With an IMU, whose axes are those of the
    body, each camera also has T_cam_imu.
    """
    right_from_left = geometry.inverse(rig.left_from_right)
    left_from_body = geometry.inverse(rig.body_from_left)
    tree = {"cam0": _kalibr_camera(rig.left, "cam0"), "cam1": _kalibr_camera(rig.right, "cam1")}
    tree["cam1"]["T_cn_cnm1"] = right_from_left.tolist()
    if with_imu:
        tree["cam0"]["T_cam_imu"] = left_from_body.tolist()
        tree["cam1"]["T_cam_imu"] = (right_from_left @ left_from_body).tolist()
    file.write_text(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None), encoding="utf-8")


def write_kalibr_imu(file: Path, imu: RecordedImu) -> None:
    """Writes the imu.yaml of Kalibr: noise densities, random walks, rate, and topic (as in the ROS 2 bag of `ros2`)."""
    tree = {"rostopic": "/imu/data_raw", "update_rate": float(imu.rate_hz), **imu.noise._asdict()}
    file.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")


def _kalibr_camera(camera: CameraIntrinsics, name: str) -> dict[str, Any]:
    """Returns the entry of one camera in a Kalibr camchain; `name` is "cam0" or "cam1"."""
    matrix = camera.matrix
    return {
        "camera_model": "pinhole",
        "intrinsics": [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])],
        "distortion_model": "radtan",
        "distortion_coeffs": [float(value) for value in camera.distortion[:4]],
        "resolution": list(camera.size_px),
        "rostopic": f"/{name}/image_raw",
    }


def write_colmap_cameras(folder: Path, rig: RigCalibration) -> None:
    """Writes cameras.txt and rigs.txt of COLMAP: camera 1 (left) is the reference of rig 1, camera 2 is the right."""
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines += [f"{k} {_colmap_camera(camera)}" for k, camera in ((1, rig.left), (2, rig.right))]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    pose = colmap_pose(geometry.inverse(rig.left_from_right))
    header = "# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (TYPE, ID, HAS_POSE, POSE)"
    (folder / "rigs.txt").write_text(f"{header}\n1 2 CAMERA 1 CAMERA 2 1 {pose}\n", encoding="utf-8")


def colmap_pose(camera_from_world: np.ndarray) -> str:
    """Returns a pose (4, 4) as text in the order of COLMAP: QW QX QY QZ TX TY TZ."""
    values = [*geometry.quaternion_wxyz(camera_from_world[:3, :3]), *camera_from_world[:3, 3]]
    return " ".join(f"{value:.17g}" for value in values)


def _colmap_camera(camera: CameraIntrinsics) -> str:
    """Returns model, size and parameters of a camera as text; in COLMAP, the corner of the first pixel is at (0, 0)."""
    (width, height), matrix, distortion = camera.size_px, camera.matrix, camera.distortion
    values = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5]
    model = "PINHOLE"
    if distortion.any():
        model = "FULL_OPENCV"
        values += [*distortion, 0.0, 0.0, 0.0]
    return f"{model} {width} {height} " + " ".join(f"{value:.17g}" for value in values)
