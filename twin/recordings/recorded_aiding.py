"""Recorded readings as aiding of a replay: those of each frame, their noise, and a start that fits them."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Frame, ImuReadings, Readings, SensorNoise, StereoRig, Trajectory
from twin.core.series import nearest_index
from twin.core.settings import EstimatorSettings
from twin.datasets.readings import RecordedReadings, SensorSeries
from twin.errors import TwinError
from twin.estimate import Navigator

#: Largest time between an exposure and a reading of pressure or attitude that belongs to it: as a fraction of the
#: interval between frames, and absolute [s].
_SHARE, _MOST_S = 0.25, 0.01
#: Velocities are interpolated between readings whose interval is at most this many times the median interval.
_MOST_GAP = 2.5
_FIRST_IMU_S, _ROUNDING_S = 0.05, 1e-6
_START_FRAMES = 60  # number of frames whose readings determine the start
#: Prior standard deviations of the first node in directions that readings determine: rotation [rad] and height [m].
_LOOSE_RAD, _LOOSE_M = 0.1, 1.0
_EXACT = 1e-12  # variance of the coordinates that the first node defines [m^2]
_EXACT_RAD2 = 1e-12  # variance of its heading, if it defines that of the world [rad^2]


class Start(NamedTuple):
    """Pose at the first frame, as far as readings determine it."""

    world_from_camera: Array  #: (4, 4) pose of the rectified left camera in a world whose z axis points up
    #: (6, 6) covariance of this pose [rotation, translation] in camera axes (rad, m); None: the pose is exact.
    cov: Array | None = None
    #: (6, 6) covariance with which the alignments hold the first node: large in the directions in which the readings of
    #: all nodes determine its pose; None: the pose is exact.
    prior_cov: Array | None = None


class _FirstReadings(NamedTuple):
    rotations: list[Array]  #: world_from_camera (3, 3) of the first frame by each attitude
    verticals: list[Array]  #: direction (3,) of the vertical in camera axes at the first frame by each reading
    heights: list[tuple[float, Array]]  #: recorded heights, with the motion (3,) since the first frame in its axes


class Aiding:
    """Readings that a replay uses; `notes` are sentences on those not used, and on assumptions about their times.

    Heights need the direction of gravity, so they are used only with an attitude or a vertical. Velocities are
    interpolated to frames, so with fewer velocities than frames the errors of consecutive frames are correlated; their
    standard deviation is increased by the root of the number of frames per reading.

    `left_from_rectified` and `body_from_camera` are poses (4, 4) of the rectified left camera, in the recorded one and
    in the body; `start_s` is the time of the first frame in the clock of the data set. `noise` is the noise of the
    readings, the default for sensors that are not used. With `imu`, the readings of the IMU are used for the motion
    between frames; TwinError if there are none.
    """

    def __init__(
        self, readings: RecordedReadings, left_from_rectified: Array, start_s: float, frame_rate_hz: float,
        imu: bool = False,
    ):  # fmt: skip
        self._imu = None
        if imu and readings.inertial is None:
            raise TwinError("--imu", "no readings of an IMU at the origin of the body", "a data set with them")
        self.body_from_camera = readings.body_from_left @ left_from_rectified
        self.notes = readings.notes
        height, vertical = readings.height, readings.vertical if readings.attitude is None else None
        if height is not None and readings.attitude is None and vertical is None:
            self.notes += ("The heights from pressure are not used: no attitude states the direction of gravity.",)
            height = None
        given = {"pressure": height, "attitude": readings.attitude, "vertical": vertical, "dvl": readings.velocity}
        self._series = {
            name: series._replace(times_s=series.times_s - start_s)
            for name, series in given.items()
            if series is not None
        }
        self._limit_s = min(_MOST_S, _SHARE / frame_rate_hz)
        self.noise = _noise(self._series, frame_rate_hz)
        if imu and readings.inertial is not None:
            recorded = readings.inertial.readings
            self._imu = recorded._replace(times_s=recorded.times_s - start_s)
            self.noise = replace(self.noise, imu=readings.inertial.errors)
        self._height_m = 0.0  # added to the recorded heights

    @property
    def used(self) -> list[str]:
        """Returns the names of the sensors that are used: "pressure", "attitude", "vertical", "dvl", "imu"."""
        return [*self._series, *(["imu"] if self._imu is not None else [])]

    def at(self, time_s: float, since_s: float | None = None) -> Readings:
        """Returns the readings at a time [s] since the first frame (IMU: from `since_s`); None without one near it."""
        # height and attitude are the nearest, others interpolated; `since_s` None: of the last `_FIRST_IMU_S`
        series, limit_s = self._series.get, self._limit_s
        height, attitude = (_nearest(series(name), time_s, limit_s) for name in ("pressure", "attitude"))
        up, velocity = (_interpolated(series(name), time_s) for name in ("vertical", "dvl"))
        return Readings(
            pressure_z_m=None if height is None else float(height[0]) + self._height_m,
            ahrs_rpy_rad=attitude,
            dvl_mps=velocity,
            up=None if up is None else up / np.linalg.norm(up),
            imu=self._imu_between(time_s - _FIRST_IMU_S if since_s is None else since_s, time_s),
        )

    def _imu_between(self, start_s: float, end_s: float) -> ImuReadings | None:
        """Returns the readings of the IMU after a time, up to another; None without any."""
        if self._imu is None:
            return None
        first, last = np.searchsorted(self._imu.times_s, [start_s + _ROUNDING_S, end_s + _ROUNDING_S], "right")
        return None if first == last else ImuReadings(*(part[first:last] for part in self._imu))

    def start(
        self, frames: Iterable[Frame], rig: StereoRig, settings: EstimatorSettings, over_plane: Array,
        known: Array | None = None,
    ) -> Start | None:  # fmt: skip
        """Returns the start that fits the first readings of gravity and height; None without attitude and vertical.

        The motion over the first frames is estimated from the images alone. With it, each attitude gives a rotation of
        the camera at the first frame, and the start has their mean. Without an attitude, each vertical gives its
        direction at the first frame; the start has their mean, and the heading over the plane of the floor. Each
        recorded height gives an offset between the recorded heights and those of the world; `at` adds the mean offset
        from now on.

        If none of the first frames has a height, heights are not used from now on. If none of them has an attitude or a
        vertical and `known` is None, none of these and no heights are used from now on, and the result is None. In both
        cases, a sentence on this is added to `notes`.

        `over_plane` (4, 4) is the pose of the left camera above the floor plane of the first stereo pair, from which
        the start has its height; `known` (4, 4) is an exact start.
        """
        gravity = next((name for name in ("attitude", "vertical") if name in self._series), None)
        if gravity is None:
            return None
        found = self._first_readings(self._first_motions(frames, rig, settings))
        rotation = self._first_rotation(found, over_plane[:3, :3]) if known is None else known[:3, :3]
        first = f"the first {_START_FRAMES} frames"
        if not found.heights or rotation is None:
            self._leave_out(
                "pressure", f"The heights from pressure are not used: {first} do not relate them to the start."
            )
        if rotation is None:
            self._leave_out(gravity, f"The {gravity} is not used: none of {first} has one.")
            return None
        height_m = float((over_plane if known is None else known)[2, 3])
        offsets = [height_m + rotation[2] @ moved - height for height, moved in found.heights]
        self._height_m = float(np.mean(offsets)) if offsets else 0.0
        if known is not None:
            return Start(known)
        cov = np.diag([0.0, 0.0, 0.0, 1e-8, 1e-8, 1e-8])
        cov[:3, :3] = self._start_cov(rotation, len(found.rotations))
        pose = geometry.pose(rotation, np.array([0.0, 0.0, height_m]))
        return Start(pose, cov, _prior_cov(rotation, bool(found.heights), gravity == "attitude"))

    def _leave_out(self, name: str, note: str) -> None:
        if self._series.pop(name, None) is not None:
            self.notes += (note,)

    def _first_rotation(self, found: _FirstReadings, over_plane: Array) -> Array | None:
        """Returns the rotation (3, 3) of the first frame; one by verticals has the heading of `over_plane`."""
        if found.rotations:
            return geometry.nearest_rigid(geometry.pose(np.mean(found.rotations, axis=0), np.zeros(3)))[:3, :3]
        if not found.verticals:
            return None
        up = over_plane @ np.mean(found.verticals, axis=0)
        across = geometry.skew(up) @ np.array([0.0, 0.0, 1.0])
        sine = float(np.linalg.norm(across))
        axis = across / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
        return geometry.so3_exp(axis * np.arctan2(sine, up[2])) @ over_plane

    def _start_cov(self, rotation: Array, n_attitudes: int) -> Array:
        if "attitude" not in self._series:
            return rotation.T @ np.diag([self.noise.up_rad**2, self.noise.up_rad**2, _EXACT_RAD2]) @ rotation
        camera_from_body = geometry.inverse(self.body_from_camera)[:3, :3]
        variances = np.diag(self.noise.attitude_sigmas_rad**2)
        return np.diag(np.diag(camera_from_body @ variances @ camera_from_body.T)) / n_attitudes

    def _first_readings(self, motions: Iterable[tuple[Array, Readings]]) -> _FirstReadings:
        camera_from_body = geometry.inverse(self.body_from_camera)[:3, :3]
        found = _FirstReadings([], [], [])
        for moved, readings in motions:
            if readings.ahrs_rpy_rad is not None:
                world_from_camera = geometry.rotation_from_rpy(*readings.ahrs_rpy_rad) @ camera_from_body.T
                found.rotations.append(world_from_camera @ moved[:3, :3].T)
            if readings.up is not None:
                found.verticals.append(moved[:3, :3] @ camera_from_body @ readings.up)
            if readings.pressure_z_m is not None:
                found.heights.append((readings.pressure_z_m, moved[:3, 3]))
        return found

    def _first_motions(
        self, frames: Iterable[Frame], rig: StereoRig, settings: EstimatorSettings
    ) -> list[tuple[Array, Readings]]:
        """Returns the poses (4, 4) in the first camera, and readings, of first frames with measured motion."""
        found = []
        with Navigator(rig, replace(settings, use_ga=False, use_f2m=False), np.eye(4)) as navigator:
            for frame in islice(frames, _START_FRAMES):
                estimate = navigator.update(frame)
                if estimate.status == "ok" or not found:
                    found.append((estimate.world_from_camera, self.at(frame.time_s)))
        return found

    def residuals(self, path: Trajectory) -> dict[str, float]:
        """Returns the RMS of (path - reading) / sigma, about 1, of "pressure", "attitude", "vertical" that have any."""
        camera_from_body = geometry.inverse(self.body_from_camera)[:3, :3]
        parts = {name: list[Array]() for name in ("pressure", "attitude", "vertical")}
        for time_s, pose in zip(path.times_s, path.world_from_camera, strict=True):
            found = self.at(float(time_s))
            if found.pressure_z_m is not None:
                parts["pressure"].append(np.array([pose[2, 3] - found.pressure_z_m]) / self.noise.pressure_m)
            if found.ahrs_rpy_rad is not None:
                turned = geometry.rotation_from_rpy(*found.ahrs_rpy_rad).T @ pose[:3, :3] @ camera_from_body
                parts["attitude"].append(geometry.so3_log(turned) / self.noise.attitude_sigmas_rad)
            if found.up is not None:
                across = geometry.skew(camera_from_body @ found.up) @ pose[2, :3]
                parts["vertical"].append(across * 1.5**0.5 / self.noise.up_rad)  # two of its three components vary
        return {name: float(np.sqrt(np.mean(np.square(rows)))) for name, rows in parts.items() if rows}


def _noise(series: Mapping[str, SensorSeries], frame_rate_hz: float) -> SensorNoise:
    noise, sigmas = SensorNoise(), {name: one.sigmas for name, one in series.items()}
    if "pressure" in series:
        noise = replace(noise, pressure_m=float(sigmas["pressure"][0]))
    if "attitude" in series:
        roll, pitch, yaw = sigmas["attitude"].tolist()
        noise = replace(noise, attitude_rad=max(roll, pitch), heading_rad=yaw)
    if "vertical" in series:
        noise = replace(noise, up_rad=float(sigmas["vertical"][0]))
    if "dvl" in series:
        frames_per_reading = max(1.0, _interval_s(series["dvl"]) * frame_rate_hz)
        noise = replace(noise, dvl_mps=float(sigmas["dvl"].max() * frames_per_reading**0.5))
    return noise


def _prior_cov(rotation: Array, has_height: bool, has_heading: bool) -> Array:
    """Returns `Start.prior_cov`: large for tilt and, if recorded, for height and heading; otherwise small."""
    axes = np.diag([_LOOSE_RAD**2, _LOOSE_RAD**2, _LOOSE_RAD**2 if has_heading else _EXACT_RAD2])
    world = np.diag([_EXACT, _EXACT, _LOOSE_M**2 if has_height else _EXACT])
    cov = np.zeros((6, 6))
    cov[:3, :3], cov[3:, 3:] = rotation.T @ axes @ rotation, rotation.T @ world @ rotation
    return (cov + cov.T) / 2


def _interval_s(series: SensorSeries) -> float:
    return float(np.median(np.diff(series.times_s))) if len(series.times_s) > 1 else 0.0


def _nearest(series: SensorSeries | None, time_s: float, limit_s: float) -> Array | None:
    """Returns the reading (k,) nearest to a time; None if it is more than `limit_s` away, or there are no readings."""
    if series is None:
        return None
    k = int(nearest_index(series.times_s, np.array([time_s]))[0])
    return series.values[k].copy() if abs(series.times_s[k] - time_s) <= limit_s else None


def _interpolated(series: SensorSeries | None, time_s: float) -> Array | None:
    """Returns the reading (k,) interpolated linearly at a time; None before, after and in gaps between the readings."""
    if series is None or not series.times_s[0] - 1e-6 <= time_s <= series.times_s[-1] + 1e-6:
        return None
    last = len(series.times_s) - 1
    k = int(np.clip(np.searchsorted(series.times_s, time_s), min(1, last), last))
    before = max(k - 1, 0)
    gap_s = float(series.times_s[k] - series.times_s[before])
    away_s = np.abs(series.times_s[[before, k]] - time_s).min()
    if gap_s > _MOST_GAP * _interval_s(series) and away_s > 1e-6:
        return None
    share = (time_s - series.times_s[before]) / gap_s if gap_s > 0 else 0.0
    return series.values[before] + share * (series.values[k] - series.values[before])
