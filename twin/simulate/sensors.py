"""Navigation sensors: pressure and attitude with white noise."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from twin import geometry
from twin.records import Readings, SensorNoise

Array = NDArray[np.float64]


def read_sensors(
    world_from_body: Array,
    body_from_camera: Array,
    noise: SensorNoise,
    aiding: Collection[str],
    rng: np.random.Generator,
) -> Readings:
    """What the sensors in `aiding` ("pressure", "ahrs") say; all are drawn, so that no draw depends on what is listed.

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
