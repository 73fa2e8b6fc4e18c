"""Navigation sensors, each with noise: pressure, attitude, Doppler velocity log, acoustic positioning, beacons, IMU."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import BeaconDetection, Readings, SensorNoise, StereoRig
from twin.kernels import kernel
from twin.scenario.model import NavigationConfig
from twin.simulate.inertial_sensor import InertialSensor

Depth = NDArray[np.float32]

_BEACON_HEIGHT_M = 0.05  # a beacon that is at least this far behind the surface in the image is occluded


class NavigationSensors:
    """Navigation sensors of a vehicle; the sensors in `navigation.aiding` and the IMU return readings.

    Args:
        settings: the sensors used for aiding, and the interval of acoustic fixes.
        noise: standard deviations from the data sheets, and the surveyed positions of the beacons.
        rig: believed calibration of the stereo rig.
        rng: random generators by name: "navigation" (pressure and attitude), "dvl", "usbl", "beacons".
        project: projects points (n, 3) in left camera axes to pixels (n, 2) with the true calibration; None: the
            projection of `rig`.
        imu: inertial measurement unit; None: the vehicle has none.
    """

    def __init__(
        self,
        settings: NavigationConfig,
        noise: SensorNoise,
        rig: StereoRig,
        rng: Mapping[str, np.random.Generator],
        project: Callable[[Array], Array] | None = None,
        imu: InertialSensor | None = None,
    ):
        self._project = rig.project if project is None else project
        self._aiding, self._noise, self._rig, self._rng = settings.aiding, noise, rig, rng
        self._imu = imu
        self._dvl = DopplerVelocityLog(noise, rng["dvl"])
        self._usbl = AcousticPositioning(noise, settings.usbl_interval_s, rng["usbl"])

    def read(
        self, time_s: float, world_from_body: Array, twist_body: Array, depth_m: Callable[[], Depth] | None
    ) -> Readings:
        """Returns simulated readings of one frame; acoustic fixes and beacons are read at keyframes only.

        Args:
            world_from_body: (4, 4) true pose.
            twist_body: (6,) true [angular, linear] velocity in body axes [rad/s, m/s].
            depth_m: function that returns the true depth (height, width) of the left image along the optical axis [m];
                None if the frame is not a keyframe.
        """
        readings = read_pressure_and_attitude(
            world_from_body, self._rig.body_from_camera, self._noise, self._aiding, self._rng["navigation"]
        )
        velocity = self._dvl.read(twist_body[3:])
        fix = sightings = None
        if depth_m is not None:
            world_from_camera = world_from_body @ self._rig.body_from_camera
            fix = self._usbl.read(time_s, world_from_camera[:3, 3])
            if "beacons" in self._aiding:
                sightings = detect_beacons(
                    world_from_camera, depth_m(), self._project, self._noise, self._rng["beacons"]
                )
        return replace(
            readings,
            dvl_mps=velocity if "dvl" in self._aiding else None,
            usbl_m=fix if "usbl" in self._aiding else None,
            beacons=sightings,
            imu=None if self._imu is None else self._imu.read(),
        )

    def per_frame_sensors(self) -> PerFrameSensors:
        """Returns the parameters of the sensors that are read at every frame, in a form for compiled code."""
        pressure, ahrs, dvl = (name in self._aiding for name in ("pressure", "ahrs", "dvl"))
        return PerFrameSensors(
            self._rig.body_from_camera, self._noise.pressure_m, self._noise.attitude_sigmas_rad, self._dvl.gain,
            self._noise.dvl_mps, pressure, ahrs, dvl,
        )  # fmt: skip

    def draw_noise(self, n_frames: int) -> tuple[Array, Array]:
        """Samples the standard normal numbers that `read` would sample for the per-frame sensors in the next frames.

        Returns:
            Numbers (n_frames, 4) for pressure and attitude, and (n_frames, 3) for the Doppler velocity log.
        """
        return self._rng["navigation"].standard_normal((n_frames, 4)), self._rng["dvl"].standard_normal((n_frames, 3))


class PerFrameSensors(NamedTuple):
    """Parameters of the sensors that are read at every frame: pressure sensor, AHRS and Doppler velocity log (DVL).

    Args:
        body_from_camera: (4, 4) pose of the left camera in the body.
        pressure_sigma_m: standard deviation of the height from pressure.
        attitude_sigmas_rad: (3,) standard deviations of roll, pitch and yaw.
        dvl_gain: 1 + scale error of the Doppler velocity log.
        dvl_sigma_mps: standard deviation of each component of the DVL velocity.
        has_pressure, has_ahrs, has_dvl: whether each sensor is used for aiding.
    """

    body_from_camera: Array
    pressure_sigma_m: float
    attitude_sigmas_rad: Array
    dvl_gain: float
    dvl_sigma_mps: float
    has_pressure: bool
    has_ahrs: bool
    has_dvl: bool


@kernel
def read_per_frame_sensors(sensors, world_from_body, twist_body, numbers, dvl_numbers):
    """Returns simulated readings of the per-frame sensors; the readings of sensors not used for aiding are NaN.

    Args:
        sensors: `PerFrameSensors`.
        world_from_body: (4, 4) true pose.
        twist_body: (6,) true [angular, linear] velocity in body axes [rad/s, m/s].
        numbers, dvl_numbers: (4,) and (3,) standard normal numbers, see `NavigationSensors.draw_noise`.
    Returns:
        Height of the left camera [m], roll, pitch and yaw of the body (3,) [rad], and velocity (3,) in body axes [m/s].
    """
    height, angles = _height_and_attitude(
        world_from_body, sensors.body_from_camera, sensors.pressure_sigma_m, sensors.attitude_sigmas_rad, numbers
    )
    velocity = _dvl_velocity(twist_body[3:], sensors.dvl_gain, sensors.dvl_sigma_mps, dvl_numbers)
    unused = np.full(3, np.nan)
    return (
        height if sensors.has_pressure else np.nan,
        angles if sensors.has_ahrs else unused,
        velocity if sensors.has_dvl else unused,
    )


def read_pressure_and_attitude(
    world_from_body: Array,
    body_from_camera: Array,
    noise: SensorNoise,
    aiding: Collection[str],
    rng: np.random.Generator,
) -> Readings:
    """Returns simulated readings of the pressure sensor and of the attitude and heading reference system (AHRS).

    The pressure sensor is in the housing of the left camera and measures the height of this camera; its reading
    therefore needs no lever-arm correction, which attitude errors would affect. The AHRS measures roll, pitch and yaw
    of the body. Noise is sampled for both sensors even if unused, so that random numbers do not depend on `aiding`.

    Args:
        world_from_body, body_from_camera: (4, 4) true pose of the body, and pose of the left camera in the body.
        aiding: names of the sensors used for aiding; the readings of the others are None.
        rng: random generator of these two sensors only.
    """
    height, angles = _height_and_attitude(
        world_from_body, body_from_camera, noise.pressure_m, noise.attitude_sigmas_rad, rng.standard_normal(4)
    )
    return Readings(
        pressure_z_m=height if "pressure" in aiding else None, ahrs_rpy_rad=angles if "ahrs" in aiding else None
    )


@kernel
def _height_and_attitude(world_from_body, body_from_camera, pressure_sigma_m, attitude_sigmas_rad, numbers):
    """Returns measured height of the left camera [m] and roll, pitch, yaw (3,) of the body [rad].

    `numbers` (4,) are standard normal.
    """
    up, arm = world_from_body[2], body_from_camera[:3, 3]
    height = (up[0] * arm[0] + up[2] * arm[2]) + (up[1] * arm[1] + up[3])
    angles = geometry.rpy_from_rotation(world_from_body[:3, :3]) + attitude_sigmas_rad * numbers[1:]
    return height + pressure_sigma_m * numbers[0], geometry.wrap_angle(angles)


class DopplerVelocityLog:
    """Doppler velocity log (DVL): velocity over ground, with white noise and a scale error constant over the survey.

    Args:
        noise: standard deviations of the white noise and of the scale error.
        rng: random generator of this sensor only.
    """

    def __init__(self, noise: SensorNoise, rng: np.random.Generator):
        self._sigma_mps, self._rng = noise.dvl_mps, rng
        self.gain = 1 + noise.dvl_scale * float(rng.standard_normal())

    def read(self, velocity_mps: Array) -> Array:
        """Returns the measured velocity (3,) for the true velocity (3,) of the body's origin, in body axes [m/s]."""
        return _dvl_velocity(velocity_mps, self.gain, self._sigma_mps, self._rng.standard_normal(3))


@kernel
def _dvl_velocity(velocity_mps, gain, sigma_mps, numbers):
    """Returns the measured velocity (3,) [m/s]; `numbers` (3,) are standard normal."""
    return gain * velocity_mps + sigma_mps * numbers


class AcousticPositioning:
    """Ultra-short baseline (USBL) positioning, triggered by keyframes so that each fix coincides with a stereo pair.

    Args:
        noise: standard deviation of each coordinate of a fix.
        interval_s: shortest time between two fixes.
        rng: random generator of this sensor only.
    """

    def __init__(self, noise: SensorNoise, interval_s: float, rng: np.random.Generator):
        self._sigma_m, self._interval_s, self._rng = noise.usbl_m, interval_s, rng
        self._next_s = 0.0

    def read(self, time_s: float, position_m: Array) -> Array | None:
        """Returns the measured position (3,) at a keyframe; None if the interval since the last fix has not elapsed.

        Args:
            position_m: (3,) true position of the left camera in the world.
        """
        if time_s < self._next_s - 1e-9:
            return None
        self._next_s = time_s + self._interval_s
        return position_m + self._sigma_m * self._rng.standard_normal(3)


def detect_beacons(
    world_from_camera: Array,
    depth_m: Depth,
    project: Callable[[Array], Array],
    noise: SensorNoise,
    rng: np.random.Generator,
) -> tuple[BeaconDetection, ...]:
    """Returns simulated detections of the beacons that are inside the left image and not occluded by floor or objects.

    Noise is sampled for every beacon, in view or not, so that random numbers do not depend on the beacons in view.

    Args:
        world_from_camera: (4, 4) true pose of the left camera.
        depth_m: (height, width) true depth of the left image along the optical axis [m].
        project: projects points (n, 3) in left camera axes to pixels (n, 2).
        noise: standard deviation of column and row of a detected beacon, and surveyed positions of the beacons.
    """
    beacons = np.array(noise.beacons_m).reshape(-1, 3)
    errors_px = noise.beacon_px * rng.standard_normal((len(beacons), 2))
    points = geometry.transform(geometry.inverse(world_from_camera), beacons)
    pixels = project(points)
    visible = (k for k in range(len(beacons)) if _in_view(pixels[k], points[k, 2], depth_m))
    return tuple(BeaconDetection(k, (float(u), float(v))) for k in visible for u, v in [pixels[k] + errors_px[k]])


def _in_view(pixel: Array, distance_m: float, depth_m: Depth) -> bool:
    """Returns whether a point is inside the image and less than `_BEACON_HEIGHT_M` behind the surface in the image."""
    rows, columns = depth_m.shape
    if not (0 <= pixel[0] <= columns - 1 and 0 <= pixel[1] <= rows - 1):  # also true for NaN
        return False
    column, row = np.rint(pixel).astype(int)
    return bool(distance_m < depth_m[row, column] + _BEACON_HEIGHT_M)
