"""Writer of EuRoC/ASL folders: stereo images, calibration, sensor readings and true poses."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from twin.core import geometry
from twin.core.records import Frame, StereoRig, Trajectory
from twin.exchange.image_copy import copy_image
from twin.exchange.run_contents import RecordedFrame, RecordedImu, RunContents

#: Columns of imu0/data.csv as in the EuRoC data set: angular rates and specific forces of the sensor, in its axes.
_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_TRUTH = "state_groundtruth_estimate0"  # folder of the truth
_FIRST_NS = 1_000_000_000  # timestamp of a frame at 0 s; times in EuRoC data sets are never 0


class EurocWriter:
    """Writes an EuRoC/ASL folder: the calibration when the writer is created, then frames one by one, and the truth.

    Args:
        folder: folder to write; `mav0` is created in it.
        rig: calibration of the frames.
        jpeg_quality: quality of JPEG images, 1 to 100; None: PNG, without loss.

    Raises:
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path, rig: StereoRig, jpeg_quality: int | None = None):
        self.root, self.rig, self._quality = folder / "mav0", rig, jpeg_quality
        self._suffix = ".png" if jpeg_quality is None else ".jpg"
        for camera, pose in (("cam0", np.eye(4)), ("cam1", rig.left_from_right)):
            (self.root / camera / "data").mkdir(parents=True, exist_ok=True)
            self._write_sensor(camera, rig.body_from_camera @ pose)
            (self.root / camera / "data.csv").write_text("#timestamp [ns],filename\n", encoding="utf-8")

    def add(self, frame: Frame) -> None:
        """Writes the images of a frame and adds them to the lists of images; the right image may be missing.

        Raises:
            OSError: an image cannot be written.
        """
        for camera, image in (("cam0", frame.left), ("cam1", frame.right)):
            if image is not None:
                name = f"{timestamp_ns(frame.time_s)}{self._suffix}"
                options = [] if self._quality is None else [cv2.IMWRITE_JPEG_QUALITY, self._quality]
                if not cv2.imwrite(str(self.root / camera / "data" / name), image[..., ::-1], options):
                    raise OSError(f"{name} cannot be written")
                with (self.root / camera / "data.csv").open("a", encoding="utf-8") as file:
                    file.write(f"{timestamp_ns(frame.time_s)},{name}\n")

    def add_recorded(self, frame: RecordedFrame) -> None:
        """Copies the image files of a recorded frame and adds them to the lists; the right image may be missing.

        Raises:
            TwinError: an image is truncated or not a PNG image.
            OSError: an image cannot be read or written.
        """
        for camera, file in (("cam0", frame.left), ("cam1", frame.right)):
            if file is not None:
                stamp = timestamp_ns(frame.time_s)
                name = copy_image(file, self.root / camera / "data" / str(stamp), self._quality).name
                with (self.root / camera / "data.csv").open("a", encoding="utf-8") as lines:
                    lines.write(f"{stamp},{name}\n")

    def add_truth(self, truth: Trajectory) -> None:
        """Writes the poses of the body, given the true trajectory of the left camera."""
        folder = self.root / _TRUTH
        folder.mkdir(exist_ok=True)
        world_from_body = truth.world_from_camera @ geometry.inverse(self.rig.body_from_camera)
        lines = ["#timestamp [ns],x [m],y [m],z [m],qw [],qx [],qy [],qz []"]
        for time_s, pose in zip(truth.times_s, world_from_body, strict=True):
            values = [*pose[:3, 3], *geometry.quaternion_wxyz(pose[:3, :3])]
            lines.append(",".join([str(timestamp_ns(time_s)), *(f"{value:.12g}" for value in values)]))
        (folder / "data.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")

    def _write_sensor(self, camera: str, body_from_camera: np.ndarray) -> None:
        """Writes sensor.yaml of one camera; the images are rectified, so their distortion is zero."""
        rig = self.rig
        tree = {
            "sensor_type": "camera",
            "T_BS": _matrix(body_from_camera),
            "rate_hz": float(rig.frame_rate_hz),
            "resolution": [rig.width_px, rig.height_px],
            "camera_model": "pinhole",
            "intrinsics": [float(value) for value in (rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px)],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": [0.0] * 4,
        }
        text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None)
        (self.root / camera / "sensor.yaml").write_text(text, encoding="utf-8")


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes images, calibration, readings and the truth, if known, to `folder`/mav0, and returns [`folder`/mav0].

    The readings are those of pressure sensor, AHRS, DVL and USBL at the recorded frames, and all readings of the IMU,
    as far as they were recorded. The truth consists of the poses of the body at all frames of the survey, including
    those without a recorded image, and of the true heights (dem_truth.tif), if the run has them.

    Raises:
        TwinError: an image is truncated or not a PNG image.
        OSError: a file cannot be read or written.
    """
    writer = EurocWriter(folder, contents.rig, contents.jpeg_quality)
    for k, frame in enumerate(contents.frames):
        writer.add_recorded(frame)
        contents.progress((k + 1) / len(contents.frames))
    if "truth" in contents.trajectories:
        writer.add_truth(contents.trajectories["truth"])
        if contents.true_map is not None:
            shutil.copyfile(contents.true_map, writer.root / _TRUTH / "dem_truth.tif")
    _write_readings(writer.root, contents)
    if contents.imu is not None:
        _write_imu(writer.root / "imu0", contents.imu)
    return [writer.root]


def _write_readings(root: Path, contents: RunContents) -> None:
    """Writes the readings of each recorded sensor to the folder pressure0, ahrs0, dvl0 or usbl0 in `root`.

    `data.csv` has the times [ns] and the readings. `sensor.yaml` has their standard deviations (`sigma`) from the
    section [navigation] of the scenario; it is not written if the scenario states none or if one of them is 0.
    """
    navigation = contents.scenario.get("navigation", {})
    level_rad, heading_rad = (
        np.deg2rad(navigation.get(key, 0.0)) for key in ("attitude_sigma_deg", "heading_sigma_deg")
    )
    sensors = {
        "pressure0": (
            "height of the left camera above z = 0 [m]",
            lambda r: r.pressure_z_m,
            [navigation.get("pressure_sigma_m", 0.0)],
        ),
        "ahrs0": (
            "roll [rad],pitch [rad],yaw [rad]",
            lambda r: r.ahrs_rpy_rad,
            [level_rad, level_rad, heading_rad],
        ),
        "dvl0": (
            "forward [m s^-1],left [m s^-1],up [m s^-1]",
            lambda r: r.dvl_mps,
            [navigation.get("dvl_sigma_mps", 0.0)] * 3,
        ),
        "usbl0": ("x [m],y [m],z [m]", lambda r: r.usbl_m, [navigation.get("usbl_sigma_m", 0.0)] * 3),
    }
    for name, (columns, reading, sigmas) in sensors.items():
        rows = [(frame.time_s, reading(frame.readings)) for frame in contents.frames]
        lines = [
            ",".join([str(timestamp_ns(time_s)), *(f"{value:.12g}" for value in np.atleast_1d(values))])
            for time_s, values in rows
            if values is not None
        ]
        if lines:
            (root / name).mkdir(exist_ok=True)
            text = "\n".join([f"#timestamp [ns],{columns}", *lines, ""])
            (root / name / "data.csv").write_text(text, encoding="utf-8")
            if all(sigmas):
                tree = {"sensor_type": name[:-1], "sigma": [float(sigma) for sigma in sigmas]}
                (root / name / "sensor.yaml").write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")


def _write_imu(folder: Path, imu: RecordedImu) -> None:
    """Writes data.csv, with full precision, and sensor.yaml of the IMU, whose axes are those of the body."""
    folder.mkdir()
    values = np.hstack([imu.readings.rates_radps, imu.readings.specific_forces_mps2])
    with (folder / "data.csv").open("w", encoding="utf-8") as lines:
        lines.write(f"{_IMU_HEADER}\n")
        for time_s, row in zip(imu.readings.times_s, values.tolist(), strict=True):
            lines.write(",".join([str(timestamp_ns(time_s)), *map(repr, row)]) + "\n")
    tree = {"sensor_type": "imu", "T_BS": _matrix(np.eye(4)), "rate_hz": float(imu.rate_hz), **imu.noise._asdict()}
    if imu.accelerometer_bias_mps2 is not None:
        tree["accelerometer_bias_sigma"] = float(imu.accelerometer_bias_mps2)
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None)
    (folder / "sensor.yaml").write_text(text, encoding="utf-8")


def _matrix(pose: np.ndarray) -> dict[str, Any]:
    """Returns a pose (4, 4) in the form in which EuRoC's sensor.yaml states T_BS."""
    return {"cols": 4, "rows": 4, "data": [float(value) for value in pose.ravel()]}


def timestamp_ns(time_s: float) -> int:
    """Returns the timestamp [ns] of a time since the start of the survey: this time plus one second."""
    return _FIRST_NS + round(time_s * 1e9)
