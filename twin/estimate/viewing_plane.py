"""Choice of the axes of a mosaic or an elevation map, whose z axis points from the floor towards the cameras."""

from __future__ import annotations

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array

#: Largest angle of the optical axis from straight down for which heights are measured along z of the world.
_MAX_TILT_RAD = np.deg2rad(45.0)


def viewing_plane(world_from_camera: Array) -> Array:
    """Returns plane_from_world (4, 4), the transformation from the world to axes in which heights are measured along z.

    The identity if the optical axis is within 45 degrees of straight down, else the smallest rotation that turns it to
    -z.
    """
    axis = world_from_camera[:3, 2]
    angle = float(np.arccos(np.clip(-axis[2], -1.0, 1.0)))
    if angle <= _MAX_TILT_RAD:
        return np.eye(4)
    turn = np.cross(axis, [0.0, 0.0, -1.0])
    length = np.linalg.norm(turn)
    direction = np.array([1.0, 0.0, 0.0]) if length < 1e-9 else turn / length  # straight up: any horizontal axis
    return geometry.pose(geometry.so3_exp(direction * angle), np.zeros(3))
