"""Dead reckoning from frame to frame: visual motion fused with DVL, pressure and AHRS readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Readings
from twin.estimate.navigation.dvl import DvlModel, DvlState, fuse_dvl
from twin.estimate.navigation.pose_filter import PressureAhrsModel, ReadingGates, fuse_pressure_ahrs, predict
from twin.kernels import kernel


class DeadReckoningState(NamedTuple):
    """State of dead reckoning after a frame. The arrays are not modified in place.

    The covariances refer to [rotation, translation] (rad, m) in the axes of the current camera.
    """

    f2f: Array  #: (4, 4) world_from_camera from frame-to-frame motion alone
    #: online, cov: (4, 4), (6, 6) online estimate of world_from_camera, and its covariance.
    online: Array
    cov: Array
    #: since_node, since_node_cov: (4, 4), (6, 6) motion since the last node from vision and DVL, and its covariance.
    since_node: Array
    since_node_cov: Array


class FrameAiding(NamedTuple):
    """Error models of the sensors that are read at every frame, and the state of the DVL integration."""

    pressure_ahrs: PressureAhrsModel  #: error model of the pressure sensor and the AHRS
    dvl: DvlModel  #: error model of the DVL
    dvl_state: DvlState  #: state of the DVL integration; its arrays are modified in place
    gates: ReadingGates  #: states of the gates that reject readings; their arrays are modified in place


def readings_as_arrays(readings: Readings) -> tuple[float, Array, Array]:
    """Returns height z [m], roll, pitch, yaw (3,) [rad] and body velocity (3,) [m/s]; NaN where there is no reading."""
    height, angles, velocity = readings.pressure_z_m, readings.ahrs_rpy_rad, readings.dvl_mps
    missing = np.full(3, np.nan)
    return (
        np.nan if height is None else height,
        missing if angles is None else angles,
        missing if velocity is None else velocity,
    )


@kernel
def dead_reckon(
    last: DeadReckoningState,
    aiding: FrameAiding,
    a_from_b: Array,
    cov: Array,
    height_m: float,
    rpy_rad: Array,
    velocity_mps: Array,
) -> tuple[DeadReckoningState, Array]:
    """Advances dead reckoning by one frame; the states of the DVL integration and of the gates are modified in place.

    Args:
        a_from_b, cov: (4, 4), (6, 6) visual motion since the previous frame and its covariance.
        height_m, rpy_rad: readings of pressure sensor [m] and AHRS, roll, pitch and yaw (3,) [rad]; NaN without.
        velocity_mps: (3,) reading of the DVL, in body axes [m/s]; NaN without.

    Returns:
        The new state, and the motion (4, 4) of this frame after fusion with the DVL.
    """
    motion, motion_cov = fuse_dvl(aiding.dvl_state, aiding.dvl, a_from_b, cov, velocity_mps, aiding.gates)
    online, online_cov = predict(last.online, last.cov, motion, motion_cov)
    online, online_cov = fuse_pressure_ahrs(online, online_cov, aiding.pressure_ahrs, height_m, rpy_rad, aiding.gates)
    since_node, since_node_cov = predict(last.since_node, last.since_node_cov, motion, motion_cov)
    f2f = geometry.compose(last.f2f, a_from_b)
    return DeadReckoningState(f2f, online, online_cov, since_node, since_node_cov), motion
