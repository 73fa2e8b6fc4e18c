"""KITTI odometry folders (Geiger et al. 2012), read and written: rectified images, calib.txt, times.txt, true poses."""

from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Trajectory
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked
from twin.datasets.dataset import Dataset, StereoImages, value_or_error
from twin.datasets.image_copy import copy_images
from twin.datasets.plain_folder import image_files
from twin.datasets.run_contents import RunContents
from twin.datasets.text_files import read_table, text_rows
from twin.errors import TwinError

_SEQUENCE = "00"  # of an exported run


class KittiReader:
    """Reads a sequence of KITTI odometry: the colour images (image_2, image_3) or, without them, the grey ones."""

    name = "kitti"
    layout = "image_0 and image_1 (or image_2 and image_3), calib.txt and times.txt"

    def recognises(self, folder: Path) -> bool:
        return (folder / "calib.txt").is_file() and any((folder / f"image_{k}").is_dir() for k in (0, 2))

    def read(self, folder: Path) -> Dataset:
        """Returns the data set; raises TwinError if times.txt is missing, damaged or short, or images are not valid."""
        number = 2 if (folder / "image_2").is_dir() else 0
        left, right = (image_files(folder / f"image_{k}") for k in (number, number + 1))
        found = value_or_error(lambda: _calibration(folder / "calib.txt", number))
        calibration, body_from_left = (found, None) if isinstance(found, TwinError) else found
        times_s = read_table(folder / "times.txt", 1)[:, 0]
        names = sorted(left.keys() | right.keys())
        if not all(name.isdecimal() and int(name) < len(times_s) for name in names):
            problem = f"has {len(times_s)} times, but an image is called {names[-1][:40]}"
            raise TwinError(str(folder / "times.txt"), problem, "images that are numbered from 000000, one time each")
        frames = [StereoImages(float(times_s[int(name)]), left[name], right.get(name)) for name in sorted(left)]
        file = folder.parent.parent / "poses" / f"{folder.name}.txt"
        truth, notes = None, ()
        if file.is_file() and body_from_left is not None:
            truth = value_or_error(lambda: camera_poses(file, times_s, body_from_left))
        elif file.is_file():
            notes = (f"The true poses ({file.name}) are not used: the calibration of camera {number} is damaged.",)
        n_right_only = len(right.keys() - left.keys())
        return Dataset(folder, frames, calibration, truth, n_right_only, notes, times_s, body_from_left)


def camera_poses(file: Path, times_s: Array, body_from_left: Array | None) -> Trajectory:
    """Returns the poses of the left camera from lines with the first three rows of a pose of camera 0, one per time.

    `body_from_left` (4, 4) is the pose of the left camera in camera 0; None: both coincide. Raises TwinError if the
    file is damaged, or has more poses than there are times.
    """
    rows = read_table(file, 12)
    if len(rows) > len(times_s):
        raise TwinError(str(file), f"has {len(rows)} poses", f"up to {len(times_s)}, one per image")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    if not (np.abs(np.linalg.det(poses[:, :3, :3]) - 1) < 0.01).all():
        raise TwinError(str(file), "is not a list of poses", "12 numbers per line, a rotation and a translation")
    poses = geometry.nearest_rigid(poses)
    return Trajectory(times_s[: len(rows)], poses if body_from_left is None else poses @ body_from_left)


def _calibration(file: Path, number: int) -> tuple[StereoCalibration, Array]:
    """Returns the calibration of cameras `number` and `number` + 1, and the pose (4, 4) of the first in camera 0."""
    projections = {parts[0].rstrip(":"): parts[1:13] for _, parts in text_rows(file) if len(parts) >= 13}
    try:
        left, right = (np.array(projections[f"P{k}"], float).reshape(3, 4) for k in (number, number + 1))
        if not (np.isfinite([left, right]).all() and left[2, 2] and right[2, 2]):
            raise ValueError
        in_left, in_right = (np.linalg.solve(p[:, :3], p[:, 3]) for p in (left, right))
    except (KeyError, ValueError, np.linalg.LinAlgError):
        allowed = f"P{number} and P{number + 1}, each with 12 numbers"
        raise TwinError(str(file), "has no projection matrices of these cameras", allowed) from None
    left_camera, right_camera = (RecordedCamera(None, p[:, :3] / p[2, 2], np.zeros(0)) for p in (left, right))
    right_from_left = geometry.pose(np.eye(3), in_right - in_left)
    calibration = checked(StereoCalibration(left_camera, right_camera, right_from_left, file))
    return calibration, geometry.pose(np.eye(3), -in_left)


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the stereo pairs as `sequences/00` and, if the truth is known, its true poses as `poses/00.txt`.

    Images are in `image_2` (left) and `image_3` (right), numbered from 000000, the times [s] in `times.txt`. As in the
    benchmark, poses of the left camera are relative to the first one, in its axes (x right, y down, z forward).
    """
    sequence = folder / "sequences" / _SEQUENCE
    pairs = contents.pairs
    folders, numbers = {"left": "image_2", "right": "image_3"}, {frame.index: k for k, frame in enumerate(pairs)}
    copy_images(contents, lambda camera, frame: sequence / folders[camera] / f"{numbers[frame.index]:06d}", pairs)
    (sequence / "times.txt").write_text("".join(f"{frame.time_s:.9f}\n" for frame in pairs), encoding="utf-8")
    rig = contents.rig
    left, right = (np.column_stack([rig.matrix, [shift, 0, 0]]) for shift in (0, -rig.fx_px * rig.baseline_m))
    projections = (" ".join(f"{value:.12e}" for value in p.ravel()) for p in (left, right, left, right))
    text = "".join(f"P{k}: {projection}\n" for k, projection in enumerate(projections))
    (sequence / "calib.txt").write_text(text, encoding="utf-8")
    if "truth" not in contents.trajectories:
        return [sequence]
    poses = contents.trajectories["truth"].world_from_camera[[frame.index for frame in pairs]]
    file = folder / "poses" / f"{_SEQUENCE}.txt"
    file.parent.mkdir(parents=True, exist_ok=True)
    relative = geometry.inverse(poses[0]) @ poses
    np.savetxt(file, relative[:, :3].reshape(-1, 12), fmt="%.12e")
    return [sequence, file]
