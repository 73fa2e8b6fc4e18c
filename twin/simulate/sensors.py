"""Navigation sensors, each with noise: pressure, attitude, Doppler velocity log, acoustic positioning, beacons, IMU."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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


class PerFrameSensors(NamedTuple):
    """Parameters of the sensors that are read at every frame: pressure sensor, AHRS and Doppler velocity log (DVL)."""

    body_from_camera: Array  #: (4, 4) pose of the left camera in the body
    pressure_sigma_m: float  #: standard deviation of the height from pressure
    attitude_sigmas_rad: Array  #: (3,) standard deviations of roll, pitch and yaw
    dvl_gain: float  #: 1 + scale error of the DVL, which is constant over a survey
    dvl_sigma_mps: float  #: standard deviation of each component of the DVL velocity
    #: has_pressure, has_ahrs, has_dvl: whether each sensor is used for aiding.
    has_pressure: bool
    has_ahrs: bool
    has_dvl: bool


class NavigationSensors:
    """Navigation sensors of a vehicle; the sensors in `navigation.aiding` and the IMU return readings.

    Noise is sampled for every sensor and every beacon, used or not, so that random numbers do not depend on these.

    Args:
        rig: believed calibration of the stereo rig.
        rng: random generators by name: "navigation" (pressure and attitude), "dvl", "usbl", "beacons".
        project: projects points (n, 3) in left camera axes to pixels (n, 2) with the true calibration; None: the
            projection of `rig`.
        imu: inertial measurement unit; None: the vehicle has none.

    Attributes:
        per_frame: parameters of the sensors that are read at every frame, also for compiled code.
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
            rig.body_from_camera, noise.pressure_m, noise.attitude_sigmas_rad, gain, noise.dvl_mps, *used
        )

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
        sensors, aiding = self.per_frame, self._settings.aiding
        (numbers,), (dvl_numbers,) = self.draw_noise(1)
        height, angles, velocity = read_per_frame_sensors(sensors, world_from_body, twist_body, numbers, dvl_numbers)
        fix = beacons = None
        if depth_m is not None:
            world_from_camera = world_from_body @ sensors.body_from_camera
            fix = self._acoustic_fix(time_s, world_from_camera[:3, 3])
            beacons = self._detect_beacons(world_from_camera, depth_m()) if "beacons" in aiding else None
        return Readings(
            pressure_z_m=height if sensors.has_pressure else None,
            ahrs_rpy_rad=angles if sensors.has_ahrs else None,
            dvl_mps=velocity if sensors.has_dvl else None,
            usbl_m=fix if "usbl" in aiding else None,
            beacons=beacons,
            imu=None if self._imu is None else self._imu.read(),
        )

    def draw_noise(self, n_frames: int) -> tuple[Array, Array]:
        """Samples standard normal numbers of the next frames.

        Returns:
            Numbers (n_frames, 4) for pressure and attitude, and (n_frames, 3) for the Doppler velocity log.
        """
        return self._rng["navigation"].standard_normal((n_frames, 4)), self._rng["dvl"].standard_normal((n_frames, 3))

    def _acoustic_fix(self, time_s: float, position_m: Array) -> Array | None:
        """Returns the ultra-short-baseline (USBL) position (3,) of the left camera at a keyframe.

        None if the interval since the last fix has not elapsed.
        """
        if time_s < self._next_fix_s - 1e-9:
            return None
        self._next_fix_s = time_s + self._settings.usbl_interval_s
        return position_m + self._noise.usbl_m * self._rng["usbl"].standard_normal(3)

    def _detect_beacons(self, world_from_camera: Array, depth_m: Depth) -> tuple[BeaconDetection, ...]:
        """Returns the detections of the beacons in the left image that neither floor nor objects occlude."""
        beacons = np.array(self._noise.beacons_m).reshape(-1, 3)
        errors_px = self._noise.beacon_px * self._rng["beacons"].standard_normal((len(beacons), 2))
        points = geometry.transform(geometry.inverse(world_from_camera), beacons)
        pixels = self._project(points)
        visible = (k for k in range(len(beacons)) if _in_view(pixels[k], points[k, 2], depth_m))
        return tuple(BeaconDetection(k, (float(u), float(v))) for k in visible for u, v in [pixels[k] + errors_px[k]])


@kernel
def read_per_frame_sensors(sensors, world_from_body, twist_body, numbers, dvl_numbers):
    """Returns simulated readings of the `PerFrameSensors`; the readings of sensors not used for aiding are NaN.

    The pressure sensor is in the housing of the left camera and measures the height of this camera; its reading
    therefore needs no lever-arm correction, which attitude errors would affect.

    Args:
        world_from_body: (4, 4) true pose.
        twist_body: (6,) true [angular, linear] velocity in body axes [rad/s, m/s].
        numbers, dvl_numbers: (4,) and (3,) standard normal numbers, see `NavigationSensors.draw_noise`.
    Returns:
        Height of the left camera [m], roll, pitch and yaw of the body (3,) [rad], and velocity (3,) of the body's
        origin over ground, in body axes [m/s].
    """
    up, arm = world_from_body[2], sensors.body_from_camera[:3, 3]
    height = (up[0] * arm[0] + up[2] * arm[2]) + (up[1] * arm[1] + up[3])
    height += sensors.pressure_sigma_m * numbers[0]
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
