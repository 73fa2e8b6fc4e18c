"""Navigation sensors: pressure, attitude, velocity over ground, acoustic fixes and beacons, each with its noise."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Readings, SensorNoise, Sighting, StereoRig
from twin.scenario.model import NavigationConfig

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

_LAMP_M = 0.05  # a beacon stands out this far from what is behind it


class NavigationSensors:
    """All navigation sensors of a vehicle; those that are not listed as aiding say nothing.

    Args:
        settings: which sensors aid, and how often an acoustic fix is taken.
        noise: as their data sheets give it; the beacons stand where they were surveyed.
        rng: a stream for each of "navigation" (pressure and attitude), "dvl", "usbl", "beacons".
        project: the true left camera: frame's pixels (n, 2) of points (n, 3) in it; the believed one where None.
    """

    def __init__(
        self,
        settings: NavigationConfig,
        noise: SensorNoise,
        rig: StereoRig,
        rng: Mapping[str, np.random.Generator],
        project: Callable[[Array], Array] | None = None,
    ):
        self._project = rig.project if project is None else project
        self._aiding, self._noise, self._rig, self._rng = settings.aiding, noise, rig, rng
        self._dvl = DopplerLog(noise, rng["dvl"])
        self._usbl = AcousticFix(noise, settings.usbl_interval_s, rng["usbl"])

    def read(
        self, time_s: float, world_from_body: Array, twist_body: Array, depth_m: Callable[[], Depth] | None
    ) -> Readings:
        """What they say now.

        Args:
            world_from_body: (4, 4) true pose.
            twist_body: (6,) true [angular, linear] velocity in the body [rad/s, m/s].
            depth_m: gives the true depth (height, width) of the left image at a keyframe; else None.
        """
        readings = read_sensors(
            world_from_body, self._rig.body_from_camera, self._noise, self._aiding, self._rng["navigation"]
        )
        velocity = self._dvl.read(twist_body[3:])
        fix = sightings = None
        if depth_m is not None:
            world_from_camera = world_from_body @ self._rig.body_from_camera
            fix = self._usbl.read(time_s, world_from_camera[:3, 3])
            if "beacons" in self._aiding:
                sightings = sight_beacons(
                    world_from_camera, depth_m(), self._project, self._noise, self._rng["beacons"]
                )
        return replace(
            readings,
            dvl_mps=velocity if "dvl" in self._aiding else None,
            usbl_m=fix if "usbl" in self._aiding else None,
            beacons=sightings,
        )

    def gauges(self) -> Gauges:
        """Those that say something at every frame, as compiled loops read them."""
        level, attitude, velocity = (name in self._aiding for name in ("pressure", "ahrs", "dvl"))
        return Gauges(
            self._rig.body_from_camera, self._noise.pressure_m, attitude_sigmas(self._noise), self._dvl.gain,
            self._noise.dvl_mps, level, attitude, velocity,
        )  # fmt: skip

    def noise(self, n_frames: int) -> tuple[Array, Array]:
        """Standard normal numbers of these (n_frames, 4) and (n_frames, 3), as `read` would draw them."""
        return self._rng["navigation"].standard_normal((n_frames, 4)), self._rng["dvl"].standard_normal((n_frames, 3))


class Gauges(NamedTuple):
    """The sensors that say something at every frame, their deviations, and which of them are fitted."""

    body_from_camera: Array
    pressure_m: float
    attitude_rad: Array
    dvl_gain: float
    dvl_mps: float
    tells_height: bool
    tells_attitude: bool
    tells_velocity: bool


@njit(cache=True, nogil=True)
def read_gauges(gauges, world_from_body, twist_body, numbers, dvl_numbers):
    """Height [m], attitude (3,) [rad] and velocity (3,) [m/s] as read; NaN where a sensor is not fitted."""
    height, angles = _level(world_from_body, gauges.body_from_camera, gauges.pressure_m, gauges.attitude_rad, numbers)
    velocity = _logged(twist_body[3:], gauges.dvl_gain, gauges.dvl_mps, dvl_numbers)
    nothing = np.full(3, np.nan)
    return (
        height if gauges.tells_height else np.nan,
        angles if gauges.tells_attitude else nothing,
        velocity if gauges.tells_velocity else nothing,
    )


def read_sensors(
    world_from_body: Array,
    body_from_camera: Array,
    noise: SensorNoise,
    aiding: Collection[str],
    rng: np.random.Generator,
) -> Readings:
    """What pressure gauge and AHRS say, where `aiding` lists them; both are drawn, so that no draw depends on the list.

    The pressure gauge sits in the left camera's housing: its depth is the camera's own, and no attitude enters by a
    lever arm. The attitude and heading reference tells roll, pitch and yaw of the body.

    Args:
        world_from_body, body_from_camera: (4, 4) true poses.
        rng: a stream that serves these sensors alone.
    """
    height, angles = _level(
        world_from_body, body_from_camera, noise.pressure_m, attitude_sigmas(noise), rng.standard_normal(4)
    )
    return Readings(
        pressure_z_m=height if "pressure" in aiding else None, ahrs_rpy_rad=angles if "ahrs" in aiding else None
    )


def attitude_sigmas(noise: SensorNoise) -> Array:
    """Deviations of roll, pitch and yaw (3,) [rad]."""
    return np.array([noise.attitude_rad, noise.attitude_rad, noise.heading_rad])


@njit(cache=True, nogil=True)
def _level(world_from_body, body_from_camera, pressure_m, attitude_rad, numbers):
    """Height [m] and attitude (3,) [rad] by the gauge and the AHRS whose noise is these standard normal numbers."""
    up, arm = world_from_body[2], body_from_camera[:3, 3]
    height = (up[0] * arm[0] + up[2] * arm[2]) + (up[1] * arm[1] + up[3])
    angles = geometry.rpy_from_rotation(world_from_body[:3, :3]) + attitude_rad * numbers[1:]
    return height + pressure_m * numbers[0], geometry.wrap_angle(angles)


class DopplerLog:
    """Velocity over ground with white noise and a scale error that is drawn once and stays."""

    def __init__(self, noise: SensorNoise, rng: np.random.Generator):
        self._sigma_mps, self._rng = noise.dvl_mps, rng
        self.gain = 1 + noise.dvl_scale * float(rng.standard_normal())

    def read(self, velocity_mps: Array) -> Array:
        """The reading (3,) of a true velocity (3,) of the body's origin, in the body [m/s]."""
        return _logged(velocity_mps, self.gain, self._sigma_mps, self._rng.standard_normal(3))


@njit(cache=True, nogil=True)
def _logged(velocity_mps, gain, sigma_mps, numbers):
    return gain * velocity_mps + sigma_mps * numbers


class AcousticFix:
    """USBL: a position now and then. The keyframes trigger it, so that a fix belongs to a stereo pair's instant."""

    def __init__(self, noise: SensorNoise, interval_s: float, rng: np.random.Generator):
        self._sigma_m, self._interval_s, self._rng = noise.usbl_m, interval_s, rng
        self._next_s = 0.0

    def read(self, time_s: float, position_m: Array) -> Array | None:
        """The fix (3,) at a keyframe where the true position is this (3,) [m]; None where none is due yet."""
        if time_s < self._next_s - 1e-9:
            return None
        self._next_s = time_s + self._interval_s
        return position_m + self._sigma_m * self._rng.standard_normal(3)


def sight_beacons(
    world_from_camera: Array,
    depth_m: Depth,
    project: Callable[[Array], Array],
    noise: SensorNoise,
    rng: np.random.Generator,
) -> tuple[Sighting, ...]:
    """What a detector says of the beacons in the left image; the floor hides what lies behind it.

    Noise is drawn for every beacon, so that no draw depends on which of them are in view.

    Args:
        depth_m: (height, width) of the left image.
        project: pixels (n, 2) of points (n, 3) in the left camera.
    """
    beacons = np.array(noise.beacons_m).reshape(-1, 3)
    errors_px = noise.beacon_px * rng.standard_normal((len(beacons), 2))
    points = geometry.transform(geometry.inverse(world_from_camera), beacons)
    pixels = project(points)
    visible = (k for k in range(len(beacons)) if _in_view(pixels[k], points[k, 2], depth_m))
    return tuple(Sighting(k, (float(u), float(v))) for k in visible for u, v in [pixels[k] + errors_px[k]])


def _in_view(pixel: Array, distance_m: float, depth_m: Depth) -> bool:
    rows, columns = depth_m.shape
    if not (0 <= pixel[0] <= columns - 1 and 0 <= pixel[1] <= rows - 1):  # NaN lies nowhere
        return False
    column, row = np.rint(pixel).astype(int)
    return bool(distance_m < depth_m[row, column] + _LAMP_M)
