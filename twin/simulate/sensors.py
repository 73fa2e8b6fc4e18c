"""Navigation sensors, each with noise: pressure, attitude, Doppler velocity log, acoustic positioning, beacons, IMU."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import BeaconDetection, Depth, ImuReadings, Readings, SensorNoise, StereoRig
from twin.errors import TwinError
from twin.kernels import kernel
from twin.scenario.model import ImuConfig, NavigationConfig
from twin.simulate.hydrodynamics import GRAVITY_MPS2
from twin.simulate.reading_times import is_due

_BEACON_HEIGHT_M = 0.05  # a beacon that is at least this far behind the surface in the image is occluded


class PerFrameSensors(NamedTuple):
    """Parameters of the sensors that are read at every frame: pressure sensor, AHRS and Doppler velocity log (DVL)."""

    body_from_camera: Array  #: (4, 4) pose of the left camera in the body
    pressure_sigma_m: float  #: standard deviation of the height from pressure
    pressure_resolution_m: float  #: step of this height; 0: none
    attitude_sigmas_rad: Array  #: (3,) standard deviations of roll, pitch and yaw
    dvl_gain: float  #: 1 + scale error of the DVL, which is constant over a survey
    dvl_sigma_mps: float  #: standard deviation of each component of the DVL velocity
    #: has_pressure, has_ahrs, has_dvl: whether each sensor is used for aiding.
    has_pressure: bool
    has_ahrs: bool
    has_dvl: bool


class NavigationSensors:
    """Navigation sensors of a vehicle; the sensors in `navigation.aiding` and the IMU return readings.

    Noise is sampled for every sensor and every beacon, used or not, so that random numbers do not depend on these;
    `rng` has a generator for "navigation" (pressure and attitude), "dvl", "usbl" and "beacons". `project` projects
    points (n, 3) in left camera axes to pixels (n, 2) as truly calibrated; None: as `rig`, the believed calibration.
    """

    def __init__(
        self, settings: NavigationConfig, noise: SensorNoise, rig: StereoRig, rng: Mapping[str, np.random.Generator],
        project: Callable[[Array], Array] | None = None, imu: InertialSensor | None = None,
    ):  # fmt: skip
        self._settings, self._noise, self._rng, self._imu = settings, noise, rng, imu
        self._project = rig.project if project is None else project
        self._next_fix_s = 0.0
        gain = 1 + noise.dvl_scale * float(rng["dvl"].standard_normal())
        used = (name in settings.aiding for name in ("pressure", "ahrs", "dvl"))
        self.per_frame = PerFrameSensors(
            rig.body_from_camera, noise.pressure_m, noise.pressure_resolution_m, noise.attitude_sigmas_rad, gain,
            noise.dvl_mps, *used,
        )  # fmt: skip
        self._frame_rate_hz, self._n_frames = rig.frame_rate_hz, 0

    def read(
        self, time_s: float, world_from_body: Array, twist_body: Array, depth_m: Callable[[], Depth] | None
    ) -> Readings:
        """Returns simulated readings of one frame; acoustic fixes and beacons are read at keyframes only.

        Pose (4, 4) and [angular, linear] velocity (6,) in body axes [rad/s, m/s] are true; `depth_m` returns the true
        depth (height, width) of the left image along the optical axis [m], None if the frame is not a keyframe.
        """
        sensors, aiding = self.per_frame, self._settings.aiding
        (numbers,), (dvl_numbers,) = self.draw_noise(1)
        height, angles, velocity = read_per_frame_sensors(sensors, world_from_body, twist_body, numbers, dvl_numbers)
        fix = beacons = None
        if depth_m is not None:
            world_from_camera = world_from_body @ sensors.body_from_camera
            fix = self._acoustic_fix(time_s, world_from_camera[:3, 3])
            beacons = self._detect_beacons(world_from_camera, depth_m()) if "beacons" in aiding else None
        return Readings(
            pressure_z_m=None if np.isnan(height) else height, ahrs_rpy_rad=None if np.isnan(angles).any() else angles,
            dvl_mps=None if np.isnan(velocity).any() else velocity, usbl_m=fix if "usbl" in aiding else None,
            beacons=beacons, imu=None if self._imu is None else self._imu.read(),
        )  # fmt: skip

    def draw_noise(self, n_frames: int) -> tuple[Array, Array]:
        """Samples standard normal numbers (n_frames, 4) for pressure and attitude, and (n_frames, 3) for the DVL.

        They are NaN at frames without a reading, for the next `n_frames` frames.
        """
        navigation = self._rng["navigation"].standard_normal((n_frames, 4))
        dvl, settings = self._rng["dvl"].standard_normal((n_frames, 3)), self._settings
        frames, self._n_frames = self._n_frames + np.arange(n_frames), self._n_frames + n_frames
        numbers = navigation[:, :1], navigation[:, 1:], dvl
        rates_hz = settings.pressure_rate_hz, settings.ahrs_rate_hz, settings.dvl_rate_hz
        for rate_hz, of_sensor in zip(rates_hz, numbers, strict=True):
            if rate_hz is not None:
                of_sensor[~is_due(rate_hz, frames, self._frame_rate_hz)] = np.nan
        return navigation, dvl

    def _acoustic_fix(self, time_s: float, position_m: Array) -> Array | None:
        """Returns the ultra-short-baseline (USBL) position (3,) of the left camera; None within the interval."""
        if time_s < self._next_fix_s - 1e-9:
            return None
        self._next_fix_s = time_s + self._settings.usbl_interval_s
        return position_m + self._noise.usbl_m * self._rng["usbl"].standard_normal(3)

    def _detect_beacons(self, world_from_camera: Array, depth_m: Depth) -> tuple[BeaconDetection, ...]:
        beacons = np.array(self._noise.beacons_m).reshape(-1, 3)
        errors_px = self._noise.beacon_px * self._rng["beacons"].standard_normal((len(beacons), 2))
        points = geometry.transform(geometry.inverse(world_from_camera), beacons)
        pixels = self._project(points)
        visible = (k for k in range(len(beacons)) if _in_view(pixels[k], points[k, 2], depth_m))
        return tuple(BeaconDetection(k, (float(u), float(v))) for k in visible for u, v in [pixels[k] + errors_px[k]])


@kernel
def read_per_frame_sensors(sensors, world_from_body, twist_body, numbers, dvl_numbers):
    """Returns simulated readings of the `PerFrameSensors`; the readings of sensors not used for aiding are NaN.

    These are height of the left camera [m], roll, pitch and yaw of the body (3,) [rad], and velocity (3,) of the body's
    origin over ground in body axes [m/s]. The pressure sensor is in the housing of the left camera: its reading needs
    no lever-arm correction, which attitude errors would affect. Pose and twist are those of `NavigationSensors.read`,
    the standard normal numbers (4,) and (3,) those of `NavigationSensors.draw_noise`.
    """
    up, arm = world_from_body[2], sensors.body_from_camera[:3, 3]
    height = (up[0] * arm[0] + up[2] * arm[2]) + (up[1] * arm[1] + up[3])
    height += sensors.pressure_sigma_m * numbers[0]
    if sensors.pressure_resolution_m > 0:
        height = np.round(height / sensors.pressure_resolution_m) * sensors.pressure_resolution_m
    angles = geometry.rpy_from_rotation(world_from_body[:3, :3]) + sensors.attitude_sigmas_rad * numbers[1:]
    velocity = sensors.dvl_gain * twist_body[3:] + sensors.dvl_sigma_mps * dvl_numbers
    unused = np.full(3, np.nan)
    return (
        height if sensors.has_pressure else np.nan,
        geometry.wrap_angle(angles) if sensors.has_ahrs else unused,
        velocity if sensors.has_dvl else unused,
    )


def _in_view(pixel: Array, distance_m: float, depth_m: Depth) -> bool:
    """Returns whether a point is inside the image and less than `_BEACON_HEIGHT_M` behind the surface in the image."""
    rows, columns = depth_m.shape
    if not (0 <= pixel[0] <= columns - 1 and 0 <= pixel[1] <= rows - 1):  # also true for NaN
        return False
    column, row = np.rint(pixel).astype(int)
    return bool(distance_m < depth_m[row, column] + _BEACON_HEIGHT_M)


def inertial_quantities(rotation: Array, rate_radps: Array, acceleration_mps2: Array) -> Array:
    """Returns the true [angular rate, R' (a + g z)] (6,) in body axes [rad/s, m/s2], of the body's origin."""
    # R: rotation (3, 3) world_from_body, a: acceleration (3,) of the origin of the body in world axes, z up
    return np.concatenate([rate_radps, rotation.T @ (acceleration_mps2 + [0.0, 0.0, GRAVITY_MPS2])])


def imu_rate_hz(settings: ImuConfig, motion_rate_hz: float) -> float:
    """Returns the rate of the readings [Hz], by default that of the simulated motion; TwinError if it is above that."""
    if settings.rate_hz is None:
        return motion_rate_hz
    if settings.rate_hz > motion_rate_hz * (1 + 1e-9):
        problem = f"{settings.rate_hz:g}: above the rate of the simulated motion"
        raise TwinError("imu.rate_hz", problem, f"up to {motion_rate_hz:g} with this vehicle and rig.frame_rate_hz")
    return settings.rate_hz


class InertialSensor:
    """Inertial measurement unit at the origin of the body.

    The true motion is interpolated linearly at the times of the readings, k / rate. Noise model of Kalibr: at a rate f,
    white noise of density s has the standard deviation s sqrt(f), and the bias changes from reading to reading by steps
    of w / sqrt(f), with w the density of its random walk. `start` (6,) is the first of the values that `add` gets at
    `motion_rate_hz`; `rng` is of this sensor only.
    """

    def __init__(self, settings: ImuConfig, motion_rate_hz: float, start: Array, rng: np.random.Generator):
        self._rate_hz, self._motion_rate_hz, self._rng = imu_rate_hz(settings, motion_rate_hz), motion_rate_hz, rng
        densities = settings.gyroscope_noise_density, settings.accelerometer_noise_density
        walks = settings.gyroscope_random_walk, settings.accelerometer_random_walk
        biases = settings.gyroscope_bias_sigma_radps, settings.accelerometer_bias_sigma_mps2
        self._sigma = np.repeat(densities, 3) * math.sqrt(self._rate_hz)
        self._walk = np.repeat(walks, 3) / math.sqrt(self._rate_hz)
        self._bias = np.repeat(biases, 3) * rng.standard_normal(6)
        self._true, self._first = [start], 0  # values since the last call of `read`, and the number of the first one
        self._n_read = 0

    def add(self, true: Array) -> None:
        """Adds the true [angular rate, specific force] (6,) of the next step, in body axes [rad/s, m/s2]."""
        self._true.append(true)

    def read(self) -> ImuReadings:
        """Returns the readings since the last call, or since 0 s, up to the time of the last value added."""
        last = self._first + len(self._true) - 1
        ratio = self._motion_rate_hz / self._rate_hz
        end = math.floor(last / ratio + 1e-9) + 1
        numbers = np.arange(self._n_read, end)
        positions, known = numbers * ratio, np.arange(self._first, last + 1)
        true = np.column_stack([np.interp(positions, known, column) for column in np.transpose(self._true)])
        white, steps = self._rng.standard_normal((len(numbers), 2, 6)).transpose(1, 0, 2)
        biases = self._bias + np.cumsum(np.vstack([np.zeros(6), self._walk * steps]), axis=0)
        self._bias = biases[-1]
        values = true + biases[:-1] + self._sigma * white
        self._true, self._first, self._n_read = self._true[-1:], last, end
        return ImuReadings(numbers / self._rate_hz, values[:, :3], values[:, 3:])
