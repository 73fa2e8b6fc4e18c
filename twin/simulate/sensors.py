"""Navigation sensors: pressure, attitude, velocity over ground, acoustic fixes and beacons, each with its noise."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin import geometry
from twin.config import Navigation
from twin.records import Readings, SensorNoise, Sighting, StereoRig

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
        settings: Navigation,
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
            depth_m: gives the true depth (height, width) of the left image at a key point; else None.
        """
        world_from_camera = world_from_body @ self._rig.body_from_camera
        readings = read_sensors(
            world_from_body, self._rig.body_from_camera, self._noise, self._aiding, self._rng["navigation"]
        )
        velocity = self._dvl.read(twist_body[3:])
        fix = sightings = None
        if depth_m is not None:
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
    pressure_noise, *attitude_noise = rng.standard_normal(4)
    height = float(world_from_body[2] @ body_from_camera[:, 3])
    sigmas = np.array([noise.attitude_rad, noise.attitude_rad, noise.heading_rad])
    angles = geometry.rpy_from_rotation(world_from_body[:3, :3]) + sigmas * attitude_noise
    return Readings(
        pressure_z_m=height + noise.pressure_m * float(pressure_noise) if "pressure" in aiding else None,
        ahrs_rpy_rad=geometry.wrap_angle(angles) if "ahrs" in aiding else None,
    )


class DopplerLog:
    """Velocity over ground with white noise and a scale error that is drawn once and stays."""

    def __init__(self, noise: SensorNoise, rng: np.random.Generator):
        self._sigma_mps, self._rng = noise.dvl_mps, rng
        self._gain = 1 + noise.dvl_scale * float(rng.standard_normal())

    def read(self, velocity_mps: Array) -> Array:
        """The reading (3,) of a true velocity (3,) of the body's origin, in the body [m/s]."""
        return self._gain * velocity_mps + self._sigma_mps * self._rng.standard_normal(3)


class AcousticFix:
    """USBL: a position now and then. The key points trigger it, so that a fix belongs to a stereo pair's instant."""

    def __init__(self, noise: SensorNoise, interval_s: float, rng: np.random.Generator):
        self._sigma_m, self._interval_s, self._rng = noise.usbl_m, interval_s, rng
        self._next_s = 0.0

    def read(self, time_s: float, position_m: Array) -> Array | None:
        """The fix (3,) at a key point where the true position is this (3,) [m]; None where none is due yet."""
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
