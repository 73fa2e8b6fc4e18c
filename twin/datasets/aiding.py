"""Recorded readings as aiding of a replay: those of each frame, their noise, and a start that fits them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.nearest import nearest_index
from twin.core.records import Frame, Readings, SensorNoise, StereoRig, Trajectory
from twin.core.settings import EstimatorSettings
from twin.datasets.readings import RecordedReadings, SensorSeries
from twin.estimate import Navigator

#: Largest time between an exposure and a reading of pressure or attitude that belongs to it: as a fraction of the
#: interval between frames, and absolute [s].
_SHARE, _MOST_S = 0.25, 0.01
#: Velocities are interpolated between readings whose interval is at most this many times the median interval.
_MOST_GAP = 2.5
_START_FRAMES = 60  # number of frames whose readings determine the start
#: Prior standard deviations of the first node in directions that readings determine: rotation [rad] and height [m].
_LOOSE_RAD, _LOOSE_M = 0.1, 1.0
_EXACT = 1e-12  # variance of the coordinates that the first node defines [m^2]


class Start(NamedTuple):
    """Pose at the first frame, as far as readings determine it.

    Args:
        world_from_camera: (4, 4) pose of the rectified left camera in a world whose z axis points up.
        cov: (6, 6) covariance of this pose [rotation, translation] in camera axes (rad, m); None: the pose is exact.
        prior_cov: (6, 6) covariance with which the alignments hold the first node: large in the directions in which the
            readings of all nodes determine its pose; None: the pose is exact.
    """

    world_from_camera: Array
    cov: Array | None = None
    prior_cov: Array | None = None


class Opening(NamedTuple):
    """First frames of a replay, from which its start is found.

    Args:
        frames: the frames, from the first one on.
        rig: calibration of the frames.
        settings: settings of the estimators.
        plane_from_camera: (4, 4) pose of the left camera above the floor plane of the first stereo pair; a start from
            readings has its height above this plane.
    """

    frames: Iterable[Frame]
    rig: StereoRig
    settings: EstimatorSettings
    plane_from_camera: Array


class Aiding:
    """Readings that a replay uses.

    Heights need the direction of gravity, so they are used only with an attitude.

    Args:
        readings: recorded readings.
        left_from_rectified: (4, 4) pose of the rectified left camera in the recorded one.
        start_s: time of the first frame in the clock of the data set [s].
        frame_rate_hz: nominal rate of the frames.

    Attributes:
        body_from_camera: (4, 4) pose of the rectified left camera in the body.
        noise: noise of the readings, for the estimators. The noise of the velocity is that of a frame: readings are
            interpolated, so with fewer readings than frames the errors of consecutive frames are correlated, and the
            standard deviation is increased by the root of the number of frames per reading.
        notes: sentences on readings that are not used, and on assumptions about their times.
    """

    def __init__(self, readings: RecordedReadings, left_from_rectified: Array, start_s: float, frame_rate_hz: float):
        self.body_from_camera = readings.body_from_left @ left_from_rectified
        self.notes = readings.notes
        self._attitude, self._velocity = (_moved(series, start_s) for series in (readings.attitude, readings.velocity))
        self._height = None if self._attitude is None else _moved(readings.height, start_s)
        if readings.height is not None and self._attitude is None:
            self.notes += ("The heights from pressure are not used: no attitude states the direction of gravity.",)
        self._limit_s = min(_MOST_S, _SHARE / frame_rate_hz)
        self.noise = self._noise(frame_rate_hz)
        self._height_m = 0.0  # added to the recorded heights

    @property
    def used(self) -> list[str]:
        """Returns the names of the sensors that are used: "pressure", "attitude", "dvl"."""
        series = {"pressure": self._height, "attitude": self._attitude, "dvl": self._velocity}
        return [name for name, one in series.items() if one is not None]

    def at(self, time_s: float) -> Readings:
        """Returns the readings of the frame at a time [s] since the first frame.

        Height and attitude are the readings nearest in time, the velocity is interpolated; None where a sensor is not
        used or has no reading near this time.
        """
        height, attitude = (_nearest(series, time_s, self._limit_s) for series in (self._height, self._attitude))
        return Readings(
            pressure_z_m=None if height is None else float(height[0]) + self._height_m,
            ahrs_rpy_rad=attitude,
            dvl_mps=_interpolated(self._velocity, time_s),
        )

    def start(self, opening: Opening, known: Array | None = None) -> Start | None:
        """Returns the start that fits the first readings of attitude and height; None without an attitude.

        The motion over the first frames is estimated from the images alone. With it, each reading of the attitude gives
        a rotation of the camera at the first frame, and the start has the mean of these rotations. Each recorded height
        gives an offset between the recorded heights and those of the world; `at` adds the mean offset from now on.

        If none of the first frames has a height, heights are not used from now on. If none of them has an attitude and
        `known` is None, neither attitudes nor heights are used from now on, and the result is None. In both cases, a
        sentence on this is added to `notes`.

        Args:
            opening: the first frames.
            known: (4, 4) exact pose at the first frame, which becomes the start; None: it is found from the readings.
        """
        if self._attitude is None:
            return None
        camera_from_body = geometry.inverse(self.body_from_camera)[:3, :3]
        rotations, heights = [], []
        for moved, found in self._first_motions(opening):
            if found.ahrs_rpy_rad is not None:
                world_from_camera = geometry.rotation_from_rpy(*found.ahrs_rpy_rad) @ camera_from_body.T
                rotations.append(world_from_camera @ moved[:3, :3].T)
            if found.pressure_z_m is not None:
                heights.append((found.pressure_z_m, moved[:3, 3]))
        if not heights or (known is None and not rotations):
            self._leave_out_height()
        if known is None and not rotations:
            self._attitude = None
            self.notes += (f"The attitude is not used: none of the first {_START_FRAMES} frames has one.",)
            return None
        mean = np.mean(rotations, axis=0) if known is None else known[:3, :3]
        rotation = geometry.nearest_rigid(geometry.pose(mean, np.zeros(3)))[:3, :3]
        height_m = float((opening.plane_from_camera if known is None else known)[2, 3])
        offsets = [height_m + rotation[2] @ moved - height for height, moved in heights]
        self._height_m = float(np.mean(offsets)) if offsets else 0.0
        if known is not None:
            return Start(known)
        angles = np.diag(camera_from_body @ np.diag(self.noise.attitude_sigmas_rad**2) @ camera_from_body.T)
        return Start(
            geometry.pose(rotation, np.array([0.0, 0.0, height_m])),
            np.diag([*(angles / len(rotations)), 1e-8, 1e-8, 1e-8]),
            _prior_cov(rotation, bool(heights)),
        )

    def _leave_out_height(self) -> None:
        """Ends the use of the recorded heights, because their offset is unknown, and adds a note."""
        if self._height is not None:
            self._height = None
            self.notes += (
                f"The heights from pressure are not used: the first {_START_FRAMES} frames do not relate them to the "
                "start.",
            )

    def _first_motions(self, opening: Opening) -> list[tuple[Array, Readings]]:
        """Returns poses (4, 4) in the axes of the camera at the first frame, and the readings at these poses.

        They are those of the first frame and of the frames, among the first `_START_FRAMES`, whose motion was measured.
        """
        found = []
        settings = replace(opening.settings, use_ga=False, use_f2m=False)
        with Navigator(opening.rig, settings, np.eye(4)) as navigator:
            for frame in islice(opening.frames, _START_FRAMES):
                estimate = navigator.update(frame)
                if estimate.status == "ok" or not found:
                    found.append((estimate.world_from_camera, self.at(frame.time_s)))
        return found

    def _noise(self, frame_rate_hz: float) -> SensorNoise:
        """Returns the noise of the readings; sensors that are not used have the default noise."""
        noise = SensorNoise()
        if self._height is not None:
            noise = replace(noise, pressure_m=float(self._height.sigmas[0]))
        if self._attitude is not None:
            roll, pitch, yaw = (float(sigma) for sigma in self._attitude.sigmas)
            noise = replace(noise, attitude_rad=max(roll, pitch), heading_rad=yaw)
        if self._velocity is not None:
            frames_per_reading = max(1.0, _interval_s(self._velocity) * frame_rate_hz)
            noise = replace(noise, dvl_mps=float(self._velocity.sigmas.max() * frames_per_reading**0.5))
        return noise

    def residuals(self, path: Trajectory) -> dict[str, float]:
        """Returns the RMS of (path - reading) / sigma at the frames of a path, for "pressure" and for "attitude".

        About 1 is expected. A sensor without readings is left out; velocities are not compared.

        Args:
            path: poses of the rectified left camera in the world of the replay.
        """
        camera_from_body = geometry.inverse(self.body_from_camera)[:3, :3]
        parts: dict[str, list[Array]] = {"pressure": [], "attitude": []}
        for time_s, pose in zip(path.times_s, path.world_from_camera, strict=True):
            found = self.at(float(time_s))
            if found.pressure_z_m is not None:
                parts["pressure"].append(np.array([pose[2, 3] - found.pressure_z_m]) / self.noise.pressure_m)
            if found.ahrs_rpy_rad is not None:
                turned = geometry.rotation_from_rpy(*found.ahrs_rpy_rad).T @ pose[:3, :3] @ camera_from_body
                parts["attitude"].append(geometry.so3_log(turned) / self.noise.attitude_sigmas_rad)
        return {name: float(np.sqrt(np.mean(np.square(rows)))) for name, rows in parts.items() if rows}


def _prior_cov(rotation: Array, has_height: bool) -> Array:
    """Returns `Start.prior_cov`: large for the rotation and, if heights are used, for the height; otherwise small.

    Args:
        rotation: (3, 3) rotation world_from_camera of the start.
        has_height: whether recorded heights are used.
    """
    world = np.diag([_EXACT, _EXACT, _LOOSE_M**2 if has_height else _EXACT])
    cov = np.zeros((6, 6))
    cov[:3, :3], cov[3:, 3:] = np.eye(3) * _LOOSE_RAD**2, rotation.T @ world @ rotation
    return (cov + cov.T) / 2


def _moved(series: SensorSeries | None, start_s: float) -> SensorSeries | None:
    """Returns the readings with times relative to `start_s`; None if there are none."""
    return None if series is None else series._replace(times_s=series.times_s - start_s)


def _interval_s(series: SensorSeries) -> float:
    """Returns the median interval between the readings [s]; 0 for a single reading."""
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
    if gap_s > _MOST_GAP * _interval_s(series):
        return None
    share = (time_s - series.times_s[before]) / gap_s if gap_s > 0 else 0.0
    return series.values[before] + share * (series.values[k] - series.values[before])
