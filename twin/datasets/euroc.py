"""EuRoC/ASL folders (Burri et al. 2016), read and written: mav0/cam0, mav0/cam1, true poses, readings of sensors.

In the files, times are in nanoseconds, and true poses are those of the body. In a `Dataset`, times are in seconds, and
true poses are those of the left camera (cam0).
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Frame, StereoRig, Trajectory
from twin.datasets.calibration import StereoCalibration, checked, is_rigid
from twin.datasets.dataset import Dataset, ImageTime, pair_by_time, trajectory_of, value_or_error
from twin.datasets.image_copy import copy_image
from twin.datasets.kalibr import camera_of, pose_of
from twin.datasets.run_contents import RecordedFrame, RunContents
from twin.datasets.sensor_folders import pose_table, read_folder, timestamp_ns, write_csv, write_readings, write_sensor
from twin.datasets.text_files import inside, read_table, read_yaml, text_rows
from twin.errors import TwinError

_CAMERAS = ("cam0", "cam1")
_TRUTH = ("state_groundtruth_estimate0", "pose_groundtruth", "vicon0")  # folders with true poses; the first is written
_TRUE_MAP = "dem_truth.tif"  # file of true heights in such a folder
_POSITIONS = "leica0"  # folder with true positions of a prism, without attitude


class EurocReader:
    """Reads folders in the EuRoC/ASL format."""

    name = "euroc"
    layout = "mav0/cam0 and mav0/cam1, each with data.csv, data/ and sensor.yaml"

    def recognises(self, folder: Path) -> bool:
        """Returns whether a folder, or its subfolder mav0, has the image lists (data.csv) of two cameras."""
        return all((_root(folder) / camera / "data.csv").is_file() for camera in _CAMERAS)

    def read(self, folder: Path) -> Dataset:
        """Returns the data set in a folder; raises TwinError if a list of images is damaged or leads out of it."""
        root = _root(folder)
        left, right = (_image_times(root / camera) for camera in _CAMERAS)
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
            folder,
            frames,
            value_or_error(lambda: _calibration(root)),
            truth,
            n_right_only,
            notes,
            np.array([image.time_s for image in left]),
            body_from_left,
            None if body_from_left is None else value_or_error(lambda: read_folder(root, body_from_left)),
            None if file is None or not file.with_name(_TRUE_MAP).is_file() else file.with_name(_TRUE_MAP),
        )


def camera_truth(file: Path, body_from_left: Array) -> Trajectory:
    """Returns the poses of the left camera from a file of true poses of the body.

    The columns are: time [ns], x, y, z [m], qw, qx, qy, qz.

    Raises:
        TwinError: the file is damaged or empty, or a quaternion is not of unit length.
    """
    rows = read_table(file, 8)
    body = trajectory_of(rows[:, 0] * 1e-9, rows[:, 1:4], rows[:, 4:8])
    if not len(rows) or body is None:
        raise TwinError(str(file), "is not a list of poses with unit quaternions", "timestamp, x, y, z, qw, qx, qy, qz")
    return Trajectory(body.times_s, body.world_from_camera @ body_from_left)


def _root(folder: Path) -> Path:
    """Returns the folder of the sensors: the subfolder mav0 or, without it, the folder itself."""
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _image_times(camera: Path) -> list[ImageTime]:
    """Returns the times and files of the images of a camera, in the order of data.csv."""
    images, source = [], camera / "data.csv"
    for number, parts in text_rows(source):
        if len(parts) < 2 or not re.fullmatch(r"\d{1,19}", parts[0].strip()):
            raise TwinError(f"{source}:{number}", "is not a time and a file name", "timestamp [ns],filename")
        images.append(ImageTime(int(parts[0]) * 1e-9, inside(camera / "data", parts[1].strip(), source)))
    return images


def _calibration(root: Path) -> StereoCalibration | None:
    """Returns the calibration from the files sensor.yaml of both cameras; None if one of the files is missing."""
    files = [root / camera / "sensor.yaml" for camera in _CAMERAS]
    if not all(file.is_file() for file in files):
        return None
    trees = [read_yaml(file) for file in files]
    left, right = (camera_of(tree, file) for tree, file in zip(trees, files, strict=True))
    body_from_left, body_from_right = (pose_of(tree, "T_BS", file) for tree, file in zip(trees, files, strict=True))
    return checked(StereoCalibration(left, right, geometry.inverse(body_from_right) @ body_from_left, files[1]))


def _body_from_left(root: Path) -> Array | None:
    """Returns the pose (4, 4) of cam0 in the body; None if cam0 has no sensor.yaml."""
    file = root / "cam0" / "sensor.yaml"
    if not file.is_file():
        return None
    pose = pose_of(read_yaml(file), "T_BS", file)
    if not is_rigid(pose):
        raise TwinError(str(file), "T_BS is not a rigid motion", "a rotation matrix and a translation [m]")
    return geometry.nearest_rigid(pose)


class EurocWriter:
    """Writes mav0 in a folder: the calibration of rectified images at once, then frames one by one, and the truth.

    All methods raise OSError if a file cannot be written; images are PNG or, with a quality (1 to 100), JPEG.
    """

    def __init__(self, folder: Path, rig: StereoRig, jpeg_quality: int | None = None):
        self.root, self._rig, self._quality = folder / "mav0", rig, jpeg_quality
        for camera, pose in zip(_CAMERAS, (np.eye(4), rig.left_from_right), strict=True):
            (self.root / camera / "data").mkdir(parents=True, exist_ok=True)
            write_csv(self.root / camera, "filename", [])
            tree = {
                "sensor_type": "camera",
                "T_BS": pose_table(rig.body_from_camera @ pose),
                "rate_hz": float(rig.frame_rate_hz),
                "resolution": [rig.width_px, rig.height_px],
                "camera_model": "pinhole",
                "intrinsics": [float(value) for value in (rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px)],
                "distortion_model": "radial-tangential",
                "distortion_coefficients": [0.0] * 4,
            }
            write_sensor(self.root / camera, tree)

    def add(self, frame: Frame) -> None:
        """Writes the images of a frame and adds them to the lists of images; the right image may be missing."""
        suffix = ".png" if self._quality is None else ".jpg"
        options = [] if self._quality is None else [cv2.IMWRITE_JPEG_QUALITY, self._quality]
        for camera, image in zip(_CAMERAS, (frame.left, frame.right), strict=True):
            if image is not None:
                name = f"{timestamp_ns(frame.time_s)}{suffix}"
                if not cv2.imwrite(str(self.root / camera / "data" / name), image[..., ::-1], options):
                    raise OSError(f"{name} cannot be written")
                self._list(camera, frame.time_s, name)

    def add_recorded(self, frame: RecordedFrame) -> None:
        """Copies the image files of a recorded frame; raises TwinError if one is truncated or not a PNG image."""
        for camera, file in zip(_CAMERAS, (frame.left, frame.right), strict=True):
            if file is not None:
                stem = self.root / camera / "data" / str(timestamp_ns(frame.time_s))
                self._list(camera, frame.time_s, copy_image(file, stem, self._quality).name)

    def _list(self, camera: str, time_s: float, name: str) -> None:
        with (self.root / camera / "data.csv").open("a", encoding="utf-8") as file:
            file.write(f"{timestamp_ns(time_s)},{name}\n")

    def add_truth(self, truth: Trajectory, true_map: Path | None = None) -> None:
        """Writes the poses of the body, given the true trajectory of the left camera, and copies the true heights."""
        folder = self.root / _TRUTH[0]
        folder.mkdir(exist_ok=True)
        world_from_body = truth.world_from_camera @ geometry.inverse(self._rig.body_from_camera)
        lines = []
        for time_s, pose in zip(truth.times_s, world_from_body, strict=True):
            values = [*pose[:3, 3], *geometry.quaternion_wxyz(pose[:3, :3])]
            lines.append(",".join([str(timestamp_ns(time_s)), *(f"{value:.12g}" for value in values)]))
        write_csv(folder, "x [m],y [m],z [m],qw [],qx [],qy [],qz []", lines)
        if true_map is not None:
            shutil.copyfile(true_map, folder / _TRUE_MAP)


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes images, calibration, readings and the truth, if known, to `folder`/mav0, and returns [`folder`/mav0].

    The readings are those of pressure sensor, AHRS, DVL and USBL at the recorded frames, and all readings of the IMU,
    as far as they were recorded. The truth consists of the poses of the body at all frames of the survey, including
    those without a recorded image, and of the true heights (dem_truth.tif), if the run has them.
    """
    writer = EurocWriter(folder, contents.rig, contents.jpeg_quality)
    for k, frame in enumerate(contents.frames):
        writer.add_recorded(frame)
        contents.progress((k + 1) / len(contents.frames))
    if "truth" in contents.trajectories:
        writer.add_truth(contents.trajectories["truth"], contents.true_map)
    write_readings(writer.root, contents)
    return [writer.root]
