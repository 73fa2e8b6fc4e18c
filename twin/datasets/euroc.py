"""EuRoC/ASL folders (Burri et al. 2016), read and written: mav0/cam0, mav0/cam1, true poses, readings of sensors.

In the files, times are in nanoseconds and true poses those of the body; in a `Dataset`, seconds and the left camera.
"""

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import StereoRig, Trajectory
from twin.datasets.calibration import SIGMAS, StereoCalibration, checked, rigid
from twin.datasets.calibration_values import numbers_of, table_of
from twin.datasets.dataset import Dataset, ImageTime, pair_by_time, trajectory_of, value_or_error
from twin.datasets.image_copy import copy_images
from twin.datasets.kalibr import camera_of, pose_of
from twin.datasets.run_contents import RecordedFrame, RunContents
from twin.datasets.sensor_folders import pose_table, read_folder, timestamp_ns, write_csv, write_readings, write_sensor
from twin.datasets.text_files import inside, read_table, read_yaml, text_rows
from twin.errors import TwinError

_ERROR = "calibration_error"  # key of our own, beside those of EuRoC, for standard deviations of the calibration
_CAMERAS = {"left": "cam0", "right": "cam1"}
_TRUTH = ("state_groundtruth_estimate0", "pose_groundtruth", "vicon0")  # folders with true poses; the first is written
_TRUE_MAP = "dem_truth.tif"  # file of true heights in such a folder
_POSITIONS = "leica0"  # folder with true positions of a prism, without attitude


class EurocReader:
    name = "euroc"
    layout = "mav0/cam0 and mav0/cam1, each with data.csv, data/ and sensor.yaml"

    def recognises(self, folder: Path) -> bool:
        return all((_root(folder) / camera / "data.csv").is_file() for camera in _CAMERAS.values())

    def read(self, folder: Path) -> Dataset:
        """Returns the data set in a folder; raises TwinError if a list of images is damaged or leads out of it."""
        root = _root(folder)
        left, right = (_image_times(root / camera) for camera in _CAMERAS.values())
        frames, n_right_only = pair_by_time(left, right)
        body = value_or_error(lambda: _body_from_left(root))
        body_from_left = None if isinstance(body, TwinError) else body
        truth, notes = None, ()
        file = next((root / name / "data.csv" for name in _TRUTH if (root / name / "data.csv").exists()), None)
        if file is not None and body_from_left is not None:
            truth = value_or_error(lambda: camera_truth(file, body_from_left))
        elif file is not None:
            notes = (f"The true poses ({file.parent.name}) are not used: the pose of cam0 in the body is unknown.",)
        elif (root / _POSITIONS / "data.csv").is_file():
            notes = (f"The true positions ({_POSITIONS}) are not used: they have no attitude.",)
        return Dataset(
            folder, frames, value_or_error(lambda: _calibration(root)), truth, n_right_only, notes,
            np.array([image.time_s for image in left]), body_from_left,
            None if body_from_left is None else value_or_error(lambda: read_folder(root, body_from_left)),
            None if file is None or not file.with_name(_TRUE_MAP).is_file() else file.with_name(_TRUE_MAP),
        )  # fmt: skip


def camera_truth(file: Path, body_from_left: Array) -> Trajectory:
    """Returns camera poses from those of body or marker (time [ns], x, y, z [m], qw, qx, qy, qz); TwinError if damaged.

    The pose of the marker in the body is `T_BS` of sensor.yaml next to data.csv; without it, it is the body.
    """
    rows = read_table(file, 8)
    body = trajectory_of(rows[:, 0] * 1e-9, rows[:, 1:4], rows[:, 4:8])
    if not len(rows) or body is None:
        raise TwinError(str(file), "is not a list of poses with unit quaternions", "timestamp, x, y, z, qw, qx, qy, qz")
    marker = file.with_name("sensor.yaml")
    if file.name == "data.csv" and marker.is_file() and "T_BS" in (tree := read_yaml(marker)):
        body_from_left = geometry.inverse(rigid(pose_of(tree, "T_BS", marker), "T_BS", marker)) @ body_from_left
    return Trajectory(body.times_s, body.world_from_camera @ body_from_left)


def _root(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _image_times(camera: Path) -> list[ImageTime]:
    images, source = [], camera / "data.csv"
    for number, parts in text_rows(source):
        if len(parts) < 2 or not re.fullmatch(r"\d{1,19}", parts[0].strip()):
            raise TwinError(f"{source}:{number}", "is not a time and a file name", "timestamp [ns],filename")
        images.append(ImageTime(int(parts[0]) * 1e-9, inside(camera / "data", parts[1].strip(), source)))
    return images


def _calibration(root: Path) -> StereoCalibration | None:
    files = [root / camera / "sensor.yaml" for camera in _CAMERAS.values()]
    if not all(file.is_file() for file in files):
        return None
    trees = [dict(table_of(read_yaml(file), file)) for file in files]
    error = trees[1].pop(_ERROR, None)
    left, right = (camera_of(tree, file) for tree, file in zip(trees, files, strict=True))
    body_from_left, body_from_right = (pose_of(tree, "T_BS", file) for tree, file in zip(trees, files, strict=True))
    calibration = StereoCalibration(left, right, geometry.inverse(body_from_right) @ body_from_left, files[1])
    if error is not None:
        given = table_of(error, files[1])
        sigmas = {key: float(numbers_of(given.get(key), files[1], f"{_ERROR}.{key}", (1,))[0]) for key in SIGMAS}
        calibration = replace(calibration, **sigmas)
    return checked(calibration)


def _body_from_left(root: Path) -> Array | None:
    """Returns the pose (4, 4) of cam0 in the body; None if cam0 has no sensor.yaml."""
    file = root / "cam0" / "sensor.yaml"
    if not file.is_file():
        return None
    return rigid(pose_of(read_yaml(file), "T_BS", file), "T_BS", file)


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes images, calibration, readings and the truth, if known, to `folder`/mav0, and returns [`folder`/mav0].

    The truth has the poses of the body at all frames of the survey, also those without a recorded image, and the true
    heights (dem_truth.tif), if the run has them.
    """
    root, rig = folder / "mav0", contents.rig
    _write_camera(root / "cam0", rig, rig.body_from_camera)
    _write_camera(root / "cam1", rig, rig.body_from_camera @ rig.left_from_right, with_error=True)

    def stem(side: str, frame: RecordedFrame) -> Path:
        return root / _CAMERAS[side] / "data" / str(timestamp_ns(frame.time_s))

    images = copy_images(contents, stem)
    for side, camera in _CAMERAS.items():
        rows = [(image.frame.time_s, [image.file.name]) for image in images if image.camera == side]
        write_csv(root / camera, "filename", rows)
    if "truth" in contents.trajectories:
        _write_truth(root / _TRUTH[0], contents)
    write_readings(root, contents)
    return [root]


def _write_camera(folder: Path, rig: StereoRig, body_from_camera: Array, with_error: bool = False) -> None:
    (folder / "data").mkdir(parents=True, exist_ok=True)
    tree = {
        "sensor_type": "camera",
        "T_BS": pose_table(body_from_camera),
        "rate_hz": float(rig.frame_rate_hz),
        "resolution": [rig.width_px, rig.height_px],
        "camera_model": "pinhole",
        "intrinsics": [float(value) for value in (rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px)],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [0.0] * 4,
    }
    if with_error and (rig.yaw_sigma_rad or rig.baseline_sigma):
        sigmas = math.degrees(rig.yaw_sigma_rad), 1000 * rig.baseline_sigma * rig.baseline_m
        tree[_ERROR] = dict(zip(SIGMAS, sigmas, strict=True))
    write_sensor(folder, tree)


def _write_truth(folder: Path, contents: RunContents) -> None:
    folder.mkdir(exist_ok=True)
    truth, rows = contents.trajectories["truth"], []
    world_from_body = truth.world_from_camera @ geometry.inverse(contents.rig.body_from_camera)
    for time_s, pose in zip(truth.times_s, world_from_body, strict=True):
        values = [*pose[:3, 3], *geometry.quaternion_wxyz(pose[:3, :3])]
        rows.append((time_s, [f"{value:.12g}" for value in values]))
    write_csv(folder, "x [m],y [m],z [m],qw [],qx [],qy [],qz []", rows)
    if contents.true_map is not None:
        shutil.copyfile(contents.true_map, folder / _TRUE_MAP)
