"""Folders of sensors in an EuRoC-like data set, read and written: pressure0, ahrs0, dvl0, usbl0, imu0.

`data.csv` has the time [ns] and the values, `sensor.yaml` their standard deviations (`sigma`: one number, or one per
value) or, for the IMU, its noise in the terms of Kalibr.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from twin.core.geometry import Array
from twin.core.records import ImuErrorModel
from twin.datasets import readings
from twin.datasets.calibration import rigid
from twin.datasets.kalibr import pose_of
from twin.datasets.readings import RecordedReadings, SensorQuantity, SensorSeries
from twin.datasets.run_contents import RecordedImu, RunContents
from twin.datasets.text_files import read_numbered_table, read_yaml
from twin.errors import TwinError

_LARGEST_DEVIATION = 100.0
_BIAS = "accelerometer_bias_sigma"  # of the bias of each specific force [m/s2]; not in EuRoC's own files
_WALK = "accelerometer_random_walk"
_DENSITIES = ("gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density")
_FIRST_NS = 1_000_000_000  # timestamp of a frame at 0 s; times in EuRoC data sets are never 0


#: Names of the columns of each sensor that is written, field of `Readings`, and keys of its standard deviations.
_WRITTEN = {
    "pressure0": ("height of the left camera above z = 0 [m]", "pressure_z_m", ("pressure_sigma_m",)),
    "ahrs0": (
        "roll [rad],pitch [rad],yaw [rad]",
        "ahrs_rpy_rad",
        ("attitude_sigma_deg", "attitude_sigma_deg", "heading_sigma_deg"),
    ),
    "dvl0": ("forward [m s^-1],left [m s^-1],up [m s^-1]", "dvl_mps", ("dvl_sigma_mps",) * 3),
    "usbl0": ("x [m],y [m],z [m]", "usbl_m", ("usbl_sigma_m",) * 3),
}
#: Columns of imu0/data.csv as in the EuRoC data set: angular rates and specific forces of the sensor, in its axes.
_IMU_COLUMNS = (
    "w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)


def read_folder(root: Path, body_from_left: Array) -> RecordedReadings | None:
    """Returns the readings in pressure0, ahrs0, dvl0 and imu0 and, without an attitude, the vertical; None without any.

    A sensor without standard deviations is not used, nor are readings with a value that is empty or not finite. Raises
    TwinError if a file is damaged, or a value is impossible.
    """
    notes: list[str] = []
    quantities = (readings.HEIGHT, readings.ATTITUDE, readings.VELOCITY)
    height, attitude, velocity = (_read_sensor(root / one.folder, one, notes) for one in quantities)
    vertical = inertial = None
    if (imu := _read_imu(root / readings.INERTIAL.folder, notes)) is not None:
        inertial = readings.in_body(*imu)
        if attitude is None:
            series, body_from_sensor, errors = imu
            turn = body_from_sensor[:3, :3]
            vertical = readings.vertical_series(readings.INERTIAL.folder, series, turn, errors, notes)
    if not notes and height is attitude is velocity is vertical is inertial is None:
        return None
    return RecordedReadings(body_from_left, height, attitude, velocity, vertical, tuple(notes), inertial)


def _read_sensor(folder: Path, quantity: SensorQuantity, notes: list[str]) -> SensorSeries | None:
    if not (folder / "data.csv").exists():
        return None
    sigmas = _read_sigmas(folder / "sensor.yaml", quantity.n)
    if sigmas is None:
        notes.append(f"The readings in {quantity.folder} are not used: sensor.yaml states no `sigma`.")
        return None
    return _read_csv(folder / "data.csv", quantity, sigmas, notes)


def _read_csv(file: Path, quantity: SensorQuantity, sigmas: Array, notes: list[str]) -> SensorSeries | None:
    lines, table = read_numbered_table(file, 1 + quantity.n, 1)
    times_s, values = table[:, 0] * 1e-9, table[:, 1:]
    recorded = SensorSeries(times_s, values, sigmas)
    return readings.checked_series(quantity, recorded, quantity.folder, lambda k: f"{file}:{lines[k]}", notes)


def _read_sigmas(file: Path, n: int) -> Array | None:
    value = read_yaml(file).get("sigma") if file.is_file() else None
    if value is None:
        return None
    try:
        given = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        given = np.zeros(0)
    if len(given) not in (1, n):
        raise TwinError(f"{file}: sigma", f"{str(value)[:60]!r} is not allowed", f"a number or {n} numbers")
    return np.broadcast_to(given, (n,)).copy()


def _read_imu(folder: Path, notes: list[str]) -> tuple[SensorSeries, Array, ImuErrorModel] | None:
    """Returns readings (n, 6), pose in the body (default: its axes) and errors of an IMU; else None, with a note."""
    file, description = folder / "data.csv", folder / "sensor.yaml"
    if not file.exists():
        return None
    tree = read_yaml(description) if description.is_file() else {}
    if missing := [name for name in _DENSITIES if tree.get(name) is None]:
        notes.append(f"The readings in {readings.INERTIAL.folder} are not used: sensor.yaml states no `{missing[0]}`.")
        return None
    rate, walk, force = (_deviation(tree, name, description) for name in _DENSITIES)
    bias = readings.USUAL_BIAS_MPS2 if tree.get(_BIAS) is None else _deviation(tree, _BIAS, description)
    walks = readings.USUAL_FORCE_WALK if tree.get(_WALK) is None else _deviation(tree, _WALK, description)
    pose = rigid(pose_of(tree, "T_BS", description), "T_BS", description) if "T_BS" in tree else np.eye(4)
    inertial = _read_csv(file, readings.INERTIAL, np.ones(readings.INERTIAL.n), notes)
    if inertial is None:
        return None
    return inertial, pose, ImuErrorModel(rate, walk, force, walks, readings.USUAL_RATE_BIAS_RADPS, bias)


def _deviation(tree: Mapping[str, Any], name: str, file: Path) -> float:
    value = tree[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= _LARGEST_DEVIATION:
        allowed = f"a number from 0 to {_LARGEST_DEVIATION:g}"
        raise TwinError(f"{file}: {name}", f"{str(value)[:60]!r} is not allowed", allowed)
    return float(value)


def write_readings(root: Path, contents: RunContents) -> None:
    """Writes the readings of each sensor to folders in `root`, with the sigmas of the scenario unless one is unset."""
    for name, (columns, reading, keys) in _WRITTEN.items():
        given = [(frame.time_s, getattr(frame.readings, reading)) for frame in contents.frames]
        rows = [(t, [f"{value:.12g}" for value in np.atleast_1d(values)]) for t, values in given if values is not None]
        if rows:
            (root / name).mkdir(exist_ok=True)
            write_csv(root / name, columns, rows)
            if all(sigmas := contents.sigmas(*keys)):
                write_sensor(root / name, {"sensor_type": name[:-1], "sigma": sigmas})
    if contents.imu is not None:
        _write_imu(root / "imu0", contents.imu)


def _write_imu(folder: Path, imu: RecordedImu) -> None:
    folder.mkdir()
    values = np.hstack([imu.readings.rates_radps, imu.readings.specific_forces_mps2]).tolist()
    rows = [(time_s, map(repr, row)) for time_s, row in zip(imu.readings.times_s, values, strict=True)]
    write_csv(folder, _IMU_COLUMNS, rows)
    tree = {"sensor_type": "imu", "T_BS": pose_table(np.eye(4)), "rate_hz": float(imu.rate_hz), **imu.noise._asdict()}
    if imu.accelerometer_bias_mps2 is not None:
        tree[_BIAS] = float(imu.accelerometer_bias_mps2)
    write_sensor(folder, tree)


def write_csv(folder: Path, columns: str, rows: Iterable[tuple[float, Iterable[str]]]) -> None:
    """Writes data.csv; `columns` are the names of the columns after the timestamp [ns], `rows` times [s] and texts."""
    lines = [",".join([str(timestamp_ns(time_s)), *texts]) for time_s, texts in rows]
    (folder / "data.csv").write_text("\n".join([f"#timestamp [ns],{columns}", *lines, ""]), encoding="utf-8")


def write_sensor(folder: Path, tree: dict[str, Any]) -> None:
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None)
    (folder / "sensor.yaml").write_text(text, encoding="utf-8")


def pose_table(pose: Array) -> dict[str, Any]:
    return {"cols": 4, "rows": 4, "data": [float(value) for value in pose.ravel()]}


def timestamp_ns(time_s: float) -> int:
    """Returns the timestamp [ns] of a time since the start of the survey: this time plus one second."""
    return _FIRST_NS + round(time_s * 1e9)
