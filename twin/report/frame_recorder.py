"""Recorded frames of a run: images written during the flight, with times, sensor readings and true poses."""

import csv
from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal, TextIO

import cv2
import numpy as np

from twin.core.checkpoint import flushed_length, reopened
from twin.core.records import Array, Frame, Image, Readings
from twin.core.series import GrowingArray

Record = Literal["none", "keyframes", "all"]
#: Last columns of frames/frames.csv; an empty cell is a missing reading.
READING_COLUMNS = ("pressure_z_m", "roll_rad", "pitch_rad", "yaw_rad", "forward_mps", "left_mps", "up_mps",
                   "usbl_x_m", "usbl_y_m", "usbl_z_m")  # fmt: skip
#: Columns of frames/imu.csv.
IMU_COLUMNS = ("time_s", "rate_x_radps", "rate_y_radps", "rate_z_radps", "specific_force_x_mps2",
               "specific_force_y_mps2", "specific_force_z_mps2")  # fmt: skip
#: Columns of `Frame.exposure` in frames/frames.csv, after index, time_s and stereo; empty if the cameras report none.
EXPOSURE_COLUMNS = ("exposure_r", "exposure_g", "exposure_b")
_FRAMES, _IMU = "frames.csv", "imu.csv"
_MOST_WAITING = 8  # frames whose images wait to be written; a survey waits for the disk beyond this number
#: PNG in half the time of the default filters and strategy; the files are 6 % larger.
_PNG = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB),
]


class FrameRecorder(AbstractContextManager["FrameRecorder"]):
    """Writes frames to the folder `frames` of a run while the survey is flown. Use as a context manager.

    `frames.csv` has index, time, exposure and sensor readings (without beacons and IMU) of every frame, and whether it
    has a stereo pair; `imu.csv` the readings of the IMU in body axes; `truth.npz` true poses, velocities and thrusts in
    double precision. With `record` = "all", `left` and `right` have the images as PNG files; with "keyframes" they are
    those in `keyframes`; with "none", nothing is written. OSError if the folder cannot be written, or on exit an image.
    """

    def __init__(self, folder: Path, record: Record):
        self._folder, self._record = folder / "frames", record
        self._poses, self._twists = GrowingArray(4, 4), GrowingArray(6)
        self._thrusts: list[Array] = []
        self._writer = ThreadPoolExecutor(1)  # compresses while the next frame is rendered
        self._waiting: deque[Future[None]] = deque()
        self._tables: dict[str, TextIO] = {}
        if record != "none":
            self._folder.mkdir(parents=True, exist_ok=True)
            self._add_rows(_FRAMES, [["index", "time_s", "stereo", *EXPOSURE_COLUMNS, *READING_COLUMNS]])
        if record == "all":
            for side in ("left", "right"):
                (self._folder / side).mkdir(exist_ok=True)

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state after all images have been written; of the two tables, their lengths [bytes]."""
        for written in self._waiting:  # which stay, so that their errors also end the flight
            written.result()
        lengths = {name: flushed_length(file) for name, file in self._tables.items()}
        return vars(self) | {"_writer": None, "_tables": lengths}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._writer = ThreadPoolExecutor(1)
        self._tables = {name: reopened(self._folder / name, length) for name, length in state["_tables"].items()}

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._writer.shutdown()
        for file in self._tables.values():
            file.close()
        if self._record != "none":
            truth = {"world_from_camera": self._poses.array, "twist_body": self._twists.array}
            if self._thrusts:
                truth["thrust_n"] = np.array(self._thrusts)
            np.savez(self._folder / "truth.npz", allow_pickle=False, **truth)
        if kind is None:
            for written in self._waiting:
                written.result()

    def add(self, frame: Frame, world_from_camera: Array, twist_body: Array, thrust_n: Array | None = None) -> None:
        """Adds a frame; raises OSError if an earlier image could not be written, for example on a full disk.

        The true pose (4, 4) is that of the left camera, `twist_body` (6,) the true [angular, linear] velocity in body
        axes [rad/s, m/s], `thrust_n` (n,) the thrust of each thruster [N].
        """
        if self._record == "none":
            return
        self._poses.append(world_from_camera)
        self._twists.append(np.asarray(twist_body, np.float64))
        if thrust_n is not None:
            self._thrusts.append(thrust_n)
        exposure = ["", "", ""] if frame.exposure is None else [repr(float(value)) for value in frame.exposure]
        stereo = int(frame.right is not None)
        cells = [frame.index, repr(float(frame.time_s)), stereo, *exposure, *_cells(frame.readings)]
        self._add_rows(_FRAMES, [cells])
        if frame.readings.imu is not None:
            if _IMU not in self._tables:
                self._add_rows(_IMU, [IMU_COLUMNS])
            table = np.column_stack(frame.readings.imu).tolist()
            self._add_rows(_IMU, ([repr(value) for value in row] for row in table))
        if self._record == "all":
            while len(self._waiting) >= _MOST_WAITING or (self._waiting and self._waiting[0].done()):
                self._waiting.popleft().result()
            self._waiting.append(self._writer.submit(self._write, frame.index, frame.left, frame.right))

    def _add_rows(self, name: str, rows: Iterable[Sequence[object]]) -> None:
        if name not in self._tables:
            self._tables[name] = (self._folder / name).open("w", newline="", encoding="utf-8")
        csv.writer(self._tables[name]).writerows(rows)

    def _write(self, index: int, left: Image, right: Image | None) -> None:
        for side, image in (("left", left), ("right", right)):
            if image is not None:
                data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _PNG)[1]
                (self._folder / side / f"{index:06d}.png").write_bytes(data.tobytes())


def _cells(readings: Readings) -> list[str]:
    """Returns the readings as strings, one for each of `READING_COLUMNS`; empty for a missing reading."""
    groups = ((readings.pressure_z_m, 1), (readings.ahrs_rpy_rad, 3), (readings.dvl_mps, 3), (readings.usbl_m, 3))
    return [
        text
        for values, count in groups
        for text in ([""] * count if values is None else [repr(float(value)) for value in np.atleast_1d(values)])
    ]


def remove_keyframe_images(folder: Path) -> None:
    """Deletes the images of the keyframes of a run; the index of the keyframes stays."""
    for file in (folder / "keyframes").glob("*_*.png"):
        file.unlink(missing_ok=True)
