"""Folders of sensors in an EuRoC-like data set, read and written: pressure0, ahrs0, dvl0, usbl0, imu0.

In each folder, `data.csv` has the time [ns] and the values, and `sensor.yaml` their standard deviations (`sigma`: one
number, or one per value) or, for the IMU, its noise in the terms of Kalibr.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from twin.core.geometry import Array
from twin.datasets import readings
from twin.datasets.kalibr import pose_of
from twin.datasets.readings import RecordedReadings, SensorQuantity, SensorSeries, UncheckedReadings
from twin.datasets.run_contents import RecordedImu, RunContents
from twin.datasets.text_files import read_numbered_table, read_yaml
from twin.errors import TwinError
from twin.estimate.navigation.vertical import InertialNoise

_LARGEST_DEVIATION = 100.0
_BIAS = "accelerometer_bias_sigma"  # of the bias of each specific force [m/s2]; not in EuRoC's own files
_DENSITIES = ("gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density")
_FIRST_NS = 1_000_000_000  # timestamp of a frame at 0 s; times in EuRoC data sets are never 0


class _Written(NamedTuple):
    """A sensor as it is written: names of its columns, field of `Readings`, and keys of its standard deviations."""

    columns: str
    reading: str
    sigmas: tuple[str, ...]


_WRITTEN = {
    "pressure0": _Written("height of the left camera above z = 0 [m]", "pressure_z_m", ("pressure_sigma_m",)),
    "ahrs0": _Written(
        "roll [rad],pitch [rad],yaw [rad]",
        "ahrs_rpy_rad",
        ("attitude_sigma_deg", "attitude_sigma_deg", "heading_sigma_deg"),
    ),
    "dvl0": _Written("forward [m s^-1],left [m s^-1],up [m s^-1]", "dvl_mps", ("dvl_sigma_mps",) * 3),
    "usbl0": _Written("x [m],y [m],z [m]", "usbl_m", ("usbl_sigma_m",) * 3),
}
#: Columns of imu0/data.csv as in the EuRoC data set: angular rates and specific forces of the sensor, in its axes.
_IMU_COLUMNS = (
    "w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)


def read_folder(root: Path, body_from_left: Array) -> RecordedReadings | None:
    """Returns the readings in pressure0, ahrs0, dvl0 and, without an attitude, the vertical by imu0; None without any.

    A sensor without standard deviations is not used, nor are readings with a value that is empty or not finite.

    Raises:
        TwinError: a file is damaged, or a value is impossible.
    """
    notes: list[str] = []
    quantities = (readings.HEIGHT, readings.ATTITUDE, readings.VELOCITY)
    height, attitude, velocity = (_read_sensor(root / one.folder, one, notes) for one in quantities)
    vertical = None if attitude is not None else _read_vertical(root / readings.INERTIAL.folder, notes)
    if not notes and height is attitude is velocity is vertical is None:
        return None
    return RecordedReadings(body_from_left, height, attitude, velocity, vertical, tuple(notes))


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
    recorded = UncheckedReadings(quantity.folder, times_s, values, lambda k: f"{file}:{lines[k]}")
    return readings.checked_series(quantity, recorded, sigmas, notes)


def _read_sigmas(file: Path, n: int) -> Array | None:
    """Returns the standard deviations (n,) in a file sensor.yaml; None if the file or `sigma` is missing."""
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


def _read_vertical(folder: Path, notes: list[str]) -> SensorSeries | None:
    """Returns the direction of the vertical by an IMU; None without one, or with a note on why it is not used.

    By default the axes of the IMU are those of the body, and its bias is `readings.USUAL_BIAS_MPS2`.
    """
    file, description = folder / "data.csv", folder / "sensor.yaml"
    if not file.exists():
        return None
    tree = read_yaml(description) if description.is_file() else {}
    if missing := [name for name in _DENSITIES if tree.get(name) is None]:
        notes.append(f"The readings in {readings.INERTIAL.folder} are not used: sensor.yaml states no `{missing[0]}`.")
        return None
    rate, walk, force = (_deviation(tree, name, description) for name in _DENSITIES)
    bias = readings.USUAL_BIAS_MPS2 if tree.get(_BIAS) is None else _deviation(tree, _BIAS, description)
    axes = pose_of(tree, "T_BS", description)[:3, :3] if "T_BS" in tree else np.eye(3)
    if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3):
        raise TwinError(f"{description}: T_BS", "is not a rigid motion", "a rotation matrix and a translation [m]")
    inertial = _read_csv(file, readings.INERTIAL, np.ones(readings.INERTIAL.n), notes)
    if inertial is None:
        return None
    return readings.vertical_series(
        readings.INERTIAL.folder, inertial, axes, InertialNoise(rate, walk, force), bias, notes
    )


def _deviation(tree: Mapping[str, Any], name: str, file: Path) -> float:
    """Returns a noise density or standard deviation of a file; raises TwinError unless it is a number from 0 to 100."""
    value = tree[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= _LARGEST_DEVIATION:
        allowed = f"a number from 0 to {_LARGEST_DEVIATION:g}"
        raise TwinError(f"{file}: {name}", f"{str(value)[:60]!r} is not allowed", allowed)
    return float(value)


def write_readings(root: Path, contents: RunContents) -> None:
    """Writes the readings of each recorded sensor, and all readings of the IMU, to their folders in `root`.

    The standard deviations are those in the section [navigation] of the scenario; `sensor.yaml` is not written if it
    states none or if one of them is 0.
    """
    for name, sensor in _WRITTEN.items():
        rows = [(frame.time_s, getattr(frame.readings, sensor.reading)) for frame in contents.frames]
        lines = [
            ",".join([str(timestamp_ns(time_s)), *(f"{value:.12g}" for value in np.atleast_1d(values))])
            for time_s, values in rows
            if values is not None
        ]
        sigmas = contents.sigmas(*sensor.sigmas)
        if lines:
            (root / name).mkdir(exist_ok=True)
            write_csv(root / name, sensor.columns, lines)
            if all(sigmas):
                write_sensor(root / name, {"sensor_type": name[:-1], "sigma": sigmas})
    if contents.imu is not None:
        _write_imu(root / "imu0", contents.imu)


def _write_imu(folder: Path, imu: RecordedImu) -> None:
    """Writes the readings of the IMU, whose axes are those of the body, with full precision."""
    folder.mkdir()
    values = np.hstack([imu.readings.rates_radps, imu.readings.specific_forces_mps2]).tolist()
    lines = [
        ",".join([str(timestamp_ns(time_s)), *map(repr, row)])
        for time_s, row in zip(imu.readings.times_s, values, strict=True)
    ]
    write_csv(folder, _IMU_COLUMNS, lines)
    tree = {"sensor_type": "imu", "T_BS": pose_table(np.eye(4)), "rate_hz": float(imu.rate_hz), **imu.noise._asdict()}
    if imu.accelerometer_bias_mps2 is not None:
        tree[_BIAS] = float(imu.accelerometer_bias_mps2)
    write_sensor(folder, tree)


def write_csv(folder: Path, columns: str, lines: list[str]) -> None:
    """Writes data.csv with lines that begin with a timestamp [ns]; `columns` are the names of the other columns."""
    (folder / "data.csv").write_text("\n".join([f"#timestamp [ns],{columns}", *lines, ""]), encoding="utf-8")


def write_sensor(folder: Path, tree: dict[str, Any]) -> None:
    """Writes sensor.yaml."""
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None)
    (folder / "sensor.yaml").write_text(text, encoding="utf-8")


def pose_table(pose: Array) -> dict[str, Any]:
    """Returns a pose (4, 4) in the form in which sensor.yaml states T_BS."""
    return {"cols": 4, "rows": 4, "data": [float(value) for value in pose.ravel()]}


def timestamp_ns(time_s: float) -> int:
    """Returns the timestamp [ns] of a time since the start of the survey: this time plus one second."""
    return _FIRST_NS + round(time_s * 1e9)
