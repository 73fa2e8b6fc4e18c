"""From frame to frame: what a measured motion and the navigation sensors make of where the vehicle believes it is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Readings
from twin.estimate.navigation.dvl import Beams, Way, logged
from twin.estimate.navigation.pose_filter import Level, aided, predicted


class Reckoning(NamedTuple):
    """Poses (4, 4) and covariances (6, 6) that every frame moves on.

    Args:
        f2f: world_from_camera by frame-to-frame motion alone.
        online, cov: world_from_camera as believed.
        walked, walked_cov: motion since the last node.
    """

    f2f: Array
    online: Array
    cov: Array
    walked: Array
    walked_cov: Array


class Instruments(NamedTuple):
    """What is believed of the sensors that speak at every frame, and what the velocity log said since the last node."""

    level: Level
    beams: Beams
    way: Way


def said(readings: Readings) -> tuple[float, Array, Array]:
    """Height [m], attitude (3,) [rad] and velocity (3,) [m/s] of readings; NaN where there is none."""
    height, angles, velocity = readings.pressure_z_m, readings.ahrs_rpy_rad, readings.dvl_mps
    nothing = np.full(3, np.nan)
    return (
        np.nan if height is None else height,
        nothing if angles is None else angles,
        nothing if velocity is None else velocity,
    )


@njit(cache=True, nogil=True)
def reckon(last, instruments, a_from_b, cov, height_m, rpy_rad, velocity_mps):
    """The reckoning after one frame, and the motion (4, 4) that it rests on.

    Args:
        last: `Reckoning` of the frame before.
        a_from_b, cov: motion by vision since then.
        height_m, rpy_rad, velocity_mps: readings; NaN where a sensor says nothing.
    """
    moved, moved_cov = logged(instruments.way, instruments.beams, a_from_b, cov, velocity_mps)
    online, online_cov = predicted(last.online, last.cov, moved, moved_cov)
    online, online_cov = aided(online, online_cov, instruments.level, height_m, rpy_rad)
    walked, walked_cov = predicted(last.walked, last.walked_cov, moved, moved_cov)
    return Reckoning(geometry.compose(last.f2f, a_from_b), online, online_cov, walked, walked_cov), moved
