"""Frames and readings of the IMU that a run folder keeps, for exports."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from twin.core.records import Array, ImuReadings, Readings
from twin.core.user_files import read_text, reading
from twin.datasets.run_contents import ImuNoise, RecordedFrame, RecordedImu
from twin.errors import TwinError
from twin.report.frame_recorder import IMU_COLUMNS, READING_COLUMNS
from twin.report.run_folder import SCENARIO_FILE, Run
from twin.scenario.model import Scenario
from twin.world.mission import motion_rate_hz

_LARGEST = 1e9  # largest number and largest time [s] of a frame


def recorded_frames(run: Run) -> tuple[RecordedFrame, ...]:
    """Returns the frames of a run whose left image was recorded, in the order of time.

    Without frames.csv, as in a replay, these are the keyframes with a recorded image; their times are those of the
    online trajectory or, if the run has none, of the true one. Raises TwinError if frames.csv is damaged or lacks a
    keyframe.
    """
    keyframes = set(run.keyframes.frames.tolist())
    folder = run.folder / "frames"
    table = folder / "frames.csv"
    if table.is_file():
        listed = _listed(table)
        if missing := keyframes - {row[0] for row in listed}:
            raise TwinError(str(table), f"has no line for the keyframe {min(missing)}", "a complete list of the frames")
    else:
        path = next((run.trajectories[key] for key in ("online", "truth") if key in run.trajectories), None)
        times = [] if path is None else path.times_s.tolist()
        listed = [(k, times[k], Readings()) for k in sorted(keyframes) if k < len(times)]
    found = []
    for index, time_s, readings in listed:
        left, right = (folder / side / f"{index:06d}.png" for side in ("left", "right"))
        if not left.is_file() and index in keyframes:
            left, right = (run.image_file(index, side) for side in ("left", "right"))
        if left.is_file():
            right = right if right.is_file() else None
            found.append(RecordedFrame(index, time_s, left, right, index in keyframes, readings))
    return tuple(found)


def _listed(table: Path) -> list[tuple[int, float, Readings]]:
    with reading(table, "", "an undamaged file, written by `twin run`"):
        lines = io.StringIO(read_text(table), newline="")
        rows = [_frame_row(row) for row in csv.DictReader(lines, strict=True)]
        _check_order("index", [row[0] for row in rows])
        _check_order("time_s", [row[1] for row in rows])
        return rows


def _check_order(name: str, values: Sequence[float]) -> None:
    column = np.array(values, np.float64)
    wrong = np.flatnonzero(~((np.diff(column, prepend=-1.0) > 0) & (column >= 0) & (column <= _LARGEST)))
    if len(wrong):
        shown = f"{column[wrong[0]]:g}"
        raise ValueError(f"line {wrong[0] + 2}: {name} is {shown}, not larger than before and from 0 to {_LARGEST:g}")


def _frame_row(row: dict[str, str]) -> tuple[int, float, Readings]:
    """Returns index, time and readings of a line of frames.csv; raises ValueError if it is damaged."""
    missing = [name for name in ("index", "time_s", *READING_COLUMNS) if name not in row]
    if missing:
        raise ValueError(f"the column {missing[0]} is missing")
    if None in row or None in row.values():
        raise ValueError(f"the line of frame {row['index'][:20]} is incomplete")
    cells = [row[name] for name in READING_COLUMNS]  # neither beacons nor readings of the IMU
    height, attitude, velocity, position = (_finite(cells[k:n]) for k, n in ((0, 1), (1, 4), (4, 7), (7, 10)))
    readings = Readings(None if height is None else float(height[0]), attitude, velocity, position)
    return int(row["index"]), float(row["time_s"]), readings


def _finite(cells: list[str]) -> Array | None:
    if not cells[0]:
        return None
    for cell in cells:
        if not math.isfinite(float(cell)):
            raise ValueError(f"{cell} is not a finite number")
    return np.array(cells, np.float64)


def missing_files(run: Run, scenario: Scenario, frames: Sequence[RecordedFrame]) -> list[str]:
    """Returns a sentence on each kind of file that a finished run of the scenario has but this run folder lacks."""
    if scenario.record == "none" or scenario.imaging.fidelity != "rendered":
        return []
    table, found = run.folder / "frames" / "frames.csv", []
    if not table.is_file():
        found.append(f"{table} is missing: only keyframes are exported, without readings of sensors.")
    elif scenario.record == "all" and (lost := len(_listed(table)) - len(frames)):
        n = lost + len(frames)
        found.append(f"{lost} of {n} left images of {run.folder} are missing; their frames are left out.")
    keyframes = set(run.keyframes.frames.tolist())
    if lost := len(keyframes - {frame.index for frame in frames if frame.right is not None}):
        found.append(f"{lost} of {len(keyframes)} keyframes of {run.folder} lack an image.")
    if scenario.imu is not None and not (run.folder / "frames" / "imu.csv").is_file():
        found.append(f"{run.folder / 'frames' / 'imu.csv'} is missing: the readings of the IMU are not exported.")
    return found


def recorded_imu(folder: Path, scenario: Scenario) -> RecordedImu | None:
    """Returns rate, noise and readings of frames/imu.csv, or None; TwinError if damaged, or the scenario has no IMU."""
    file = folder / "frames" / "imu.csv"
    if not file.is_file():
        return None
    if scenario.imu is None:
        problem = f"belongs to no sensor: {SCENARIO_FILE} has no section [imu]"
        raise TwinError(str(file), problem, "the files of one run")
    settings = scenario.imu
    with reading(file, "", "an undamaged file, written by `twin run`"):
        values = _imu_table(file)
    noise = ImuNoise(*(getattr(settings, name) for name in ImuNoise._fields))
    readings = ImuReadings(values[:, 0], values[:, 1:4], values[:, 4:])
    rate_hz = settings.rate_hz or motion_rate_hz(scenario)
    return RecordedImu(readings, rate_hz, noise, settings.accelerometer_bias_sigma_mps2)


def _imu_table(file: Path) -> Array:
    header, *lines = read_text(file).splitlines() or [""]
    if header != ",".join(IMU_COLUMNS):
        raise ValueError(f"its first line is {header[:60]!r}")
    rows = [line.split(",") for line in lines]
    wrong = next((k for k, row in enumerate(rows, 2) if len(row) != len(IMU_COLUMNS)), None)
    if wrong is not None:
        raise ValueError(f"line {wrong} is incomplete")
    table = np.array(rows, np.float64).reshape(-1, len(IMU_COLUMNS))
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if len(bad):
        raise ValueError(f"line {bad[0] + 2} has a value that is not finite")
    _check_order("time_s", table[:, 0].tolist())
    return table
