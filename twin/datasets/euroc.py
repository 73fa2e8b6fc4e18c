"""Reader of EuRoC/ASL folders (Burri et al. 2016): mav0/cam0, mav0/cam1, true poses, readings of sensors."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Trajectory
from twin.datasets.calibration import StereoCalibration, checked, is_rigid
from twin.datasets.calibration_files import camera_from_kalibr, pose_of
from twin.datasets.dataset import Dataset, ImageTime, pair_by_time, value_or_error
from twin.datasets.inertial import read_vertical
from twin.datasets.readings import RecordedReadings, read_folder
from twin.datasets.text_files import inside, read_table, read_yaml, text_rows
from twin.errors import TwinError

_TRUTH = ("state_groundtruth_estimate0", "pose_groundtruth", "vicon0")  # folders with true poses
_TRUE_MAP = "dem_truth.tif"  # file of true heights in such a folder, as `twin export` writes it
_POSITIONS = "leica0"  # folder with true positions of a prism, without attitude


class EurocReader:
    """Reads folders in the EuRoC/ASL format.

    In the files, times are in nanoseconds, and true poses are those of the body. In the returned `Dataset`, times are
    in seconds, and true poses are those of the left camera (cam0).
    """

    name = "euroc"
    layout = "mav0/cam0 and mav0/cam1, each with data.csv, data/ and sensor.yaml"

    def recognises(self, folder: Path) -> bool:
        """Returns whether a folder, or its subfolder mav0, has the image lists (data.csv) of two cameras."""
        return all((_root(folder) / camera / "data.csv").is_file() for camera in ("cam0", "cam1"))

    def read(self, folder: Path) -> Dataset:
        """Returns the data set in a folder.

        Raises:
            TwinError: a list of images is damaged or names a file outside of its folder.
        """
        root = _root(folder)
        left, right = (_image_times(root / camera) for camera in ("cam0", "cam1"))
        frames, n_right_only = pair_by_time(left, right)
        calibration = value_or_error(lambda: _calibration(root))
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
        times_s = np.array([image.time_s for image in left])
        readings = None if body_from_left is None else value_or_error(lambda: _readings(root, body_from_left))
        heights = None if file is None else file.with_name(_TRUE_MAP)
        return Dataset(
            folder, frames, calibration, truth, n_right_only, notes, times_s, body_from_left, readings,
            heights if heights is not None and heights.is_file() else None,
        )  # fmt: skip


def camera_truth(file: Path, body_from_left: np.ndarray) -> Trajectory:
    """Returns the poses of the left camera from a file of true poses of the body.

    Args:
        file: data.csv of the truth with the columns time [ns], x, y, z [m], qw, qx, qy, qz.
        body_from_left: (4, 4) pose of the left camera in the body.

    Raises:
        TwinError: the file is damaged or empty, or a quaternion is not of unit length.
    """
    rows = read_table(file, 8)
    norm = np.linalg.norm(rows[:, 4:8], axis=1)
    if not len(rows) or not (np.abs(norm - 1) < 0.01).all():
        raise TwinError(str(file), "is not a list of poses with unit quaternions", "timestamp, x, y, z, qw, qx, qy, qz")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = geometry.rotation_from_wxyz(rows[:, 4:8]), rows[:, 1:4]
    return Trajectory(rows[:, 0] * 1e-9, poses @ body_from_left)


def _readings(root: Path, body_from_left: Array) -> RecordedReadings | None:
    """Returns the readings in the folders of the sensors; None without any. The IMU is used without an attitude only.

    Raises:
        TwinError: a file is damaged, or a value is impossible.
    """
    found = read_folder(root, body_from_left)
    if found is not None and found.attitude is not None:
        return found
    notes: list[str] = []
    vertical = read_vertical(root, notes)
    if vertical is None and not notes:
        return found
    others = found or RecordedReadings(body_from_left)
    return others._replace(vertical=vertical, notes=(*others.notes, *notes))


def _root(folder: Path) -> Path:
    """Returns the folder of the sensors: the subfolder mav0 or, without it, the folder itself."""
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _image_times(camera: Path) -> list[ImageTime]:
    """Returns the times and files of the images of a camera, in the order of data.csv.

    Raises:
        TwinError: a line is not a time and a file name, or the name leads out of the folder `data` of the camera.
    """
    images, source = [], camera / "data.csv"
    for number, parts in text_rows(source):
        if len(parts) < 2 or not re.fullmatch(r"\d{1,19}", parts[0].strip()):
            raise TwinError(f"{source}:{number}", "is not a time and a file name", "timestamp [ns],filename")
        images.append(ImageTime(int(parts[0]) * 1e-9, inside(camera / "data", parts[1].strip(), source)))
    return images


def _calibration(root: Path) -> StereoCalibration | None:
    """Returns the calibration from the files sensor.yaml of both cameras; None if one of the files is missing.

    Raises:
        TwinError: a file is damaged, or the calibration cannot be used.
    """
    files = [root / camera / "sensor.yaml" for camera in ("cam0", "cam1")]
    if not all(file.is_file() for file in files):
        return None
    trees = [read_yaml(file) for file in files]
    left, right = (camera_from_kalibr(tree, file) for tree, file in zip(trees, files, strict=True))
    body_from_left, body_from_right = (pose_of(tree, "T_BS", file) for tree, file in zip(trees, files, strict=True))
    right_from_left = geometry.inverse(body_from_right) @ body_from_left
    return checked(StereoCalibration(left, right, right_from_left, files[1]))


def _body_from_left(root: Path) -> Array | None:
    """Returns the pose (4, 4) of cam0 in the body; None if cam0 has no sensor.yaml.

    Raises:
        TwinError: the file is damaged, or the pose is not a rigid motion.
    """
    file = root / "cam0" / "sensor.yaml"
    if not file.is_file():
        return None
    pose = pose_of(read_yaml(file), "T_BS", file)
    if not is_rigid(pose):
        raise TwinError(str(file), "T_BS is not a rigid motion", "a rotation matrix and a translation [m]")
    return geometry.nearest_rigid(pose)
