"""Yaw, pitch and roll of a camera as photogrammetry and marine imaging define them: zero for one that looks down."""

import numpy as np

from twin.core.records import Array

#: Rotation from the axes (top of the image, right, line of sight) to those of the camera (right, down, line of sight).
_CAMERA_FROM_TOP_RIGHT_SIGHT = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
#: Rotation from the axes (east, north, up) to (north, east, down).
_NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def yaw_pitch_roll_deg(world_from_camera: Array) -> tuple[float, float, float]:
    """Returns yaw (0 to 360), pitch (-90 to 90) and roll (-180 to 180) of a camera [deg], as iFDO and Metashape do.

    With R the rotation from (top of the image, right, line of sight) to (north, east, down), R = R_z(yaw) R_y(pitch)
    R_x(roll): a camera with zero angles looks straight down, with the top of the image to the north. Yaw grows
    clockwise as seen from above; a positive pitch raises the line of sight towards the top of the image.
    `world_from_camera` is a pose (4, 4) or a rotation (3, 3) in the world (x east, y north, z up).
    """
    r = _NED_FROM_ENU @ world_from_camera[:3, :3] @ _CAMERA_FROM_TOP_RIGHT_SIGHT
    yaw = np.arctan2(r[1, 0], r[0, 0])
    pitch = np.arcsin(np.clip(-r[2, 0], -1.0, 1.0))
    roll = np.arctan2(r[2, 1], r[2, 2])
    return float(np.rad2deg(yaw)) % 360.0, float(np.rad2deg(pitch)), float(np.rad2deg(roll))
