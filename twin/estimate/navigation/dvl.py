"""The DVL as an aid: its velocity summed to a displacement, of a frame for the online position, of a node for GA."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Displacement, SensorNoise, StereoRig
from twin.estimate.navigation.pose_filter import updated


class Beams(NamedTuple):
    """What is believed of the log: its mount, time between readings, variance of a frame's way by white noise [m2],
    and that of its scale error."""

    body_from_camera: Array
    step_s: float
    white_m2: float
    scale2: float


class Way(NamedTuple):
    """What the log has said since the last node; all arrays are changed in place.

    Args:
        velocity: (3,) the last reading [m/s]; NaN: none.
        turn, turn_cov: (3, 3) of the body since the node, and its covariance.
        metres, cov: (3,), (3, 3) displacement in the body at the node, and what white noise makes it err by.
        path_m: (1,) length of the way.
        whole: (1,) whether every reading was there.
    """

    velocity: Array
    turn: Array
    turn_cov: Array
    metres: Array
    cov: Array
    path_m: Array
    whole: NDArray[np.bool_]


class VelocityLog:
    """Sums velocities by the trapezoidal rule, turned by the attitude since the last node.

    Each reading enters two neighbouring frames with half its noise: counted as independent, frames of variance
    (sigma dt)^2 have the right sum.
    """

    def __init__(self, rig: StereoRig, noise: SensorNoise):
        step_s = 1 / rig.frame_rate_hz
        self.beams = Beams(rig.body_from_camera, step_s, (noise.dvl_mps * step_s) ** 2, noise.dvl_scale**2)
        square = (3, 3)
        self.way = Way(
            np.full(3, np.nan), np.eye(3), np.zeros(square), np.zeros(3), np.zeros(square), np.zeros(1),
            np.ones(1, np.bool_),
        )  # fmt: skip
        self._node = 0

    def at_node(self, number: int) -> Displacement | None:
        """The displacement from the last node to this one, where the next one starts; None where a reading lacks."""
        node, self._node, way = self._node, number, self.way
        walked = Displacement(node, way.metres.copy(), _walked_cov(way)) if way.whole[0] else None
        _start(way)
        return walked


@njit(cache=True, nogil=True)
def body_displacement(a_from_b: Array, body_from_camera: Array) -> tuple[Array, Array]:
    """Way (3,) of the body's origin in the earlier body for a motion of the camera, and its derivative (3, 6) by it."""
    camera_from_body = geometry.inverse(body_from_camera)
    turn = geometry.compose(body_from_camera, a_from_b)
    lever, by_motion = geometry.skew(camera_from_body[:3, 3]), np.zeros((3, 6))
    for i in range(3):
        for k in range(3):
            by_motion[i, 3 + k] = turn[i, k]
            for m in range(3):
                by_motion[i, k] -= turn[i, m] * lever[m, k]
    return geometry.compose(turn, camera_from_body)[:3, 3].copy(), by_motion


@njit(cache=True, nogil=True)
def logged(way, beams, a_from_b, cov, velocity):
    """The camera's motion (4, 4) of a frame, with covariance (6, 6), and what the log says of it fused in.

    Args:
        way: since the last node, which goes on.
        a_from_b, cov: by vision; unchanged without two readings.
        velocity: (3,) reading at the frame's end, in the body; NaN: none.
    """
    last = way.velocity.copy()
    geometry.put(way.velocity, velocity)
    if np.isnan(last[0]) or np.isnan(velocity[0]):
        way.whole[0] = False
        return a_from_b, cov
    turned, step = _of_body(a_from_b, beams.body_from_camera), np.empty(3)
    for i in range(3):
        now = turned[i, 0] * velocity[0] + turned[i, 1] * velocity[1] + turned[i, 2] * velocity[2]
        step[i] = (last[i] + now) / 2 * beams.step_s
    fused, fused_cov = fuse(a_from_b, cov, step, _step_cov(way, beams, step), beams.body_from_camera)
    _sum(way, beams, step, fused, fused_cov)
    return fused, fused_cov


@njit(cache=True, nogil=True)
def _of_body(a_from_b, body_from_camera):
    """The motion (4, 4) of the body for one of the camera."""
    return geometry.compose(geometry.compose(body_from_camera, a_from_b), geometry.inverse(body_from_camera))


@njit(cache=True, nogil=True)
def _length(step):
    return np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])


@njit(cache=True, nogil=True)
def _step_cov(way, beams, step):
    """Covariance of a frame's displacement. The scale error adds up along the path L since the node: the frames'
    shares s^2 ((L + l)^2 - L^2) have the sum s^2 L^2."""
    length = max(_length(step), 1e-12)
    grown, cov = (2 * way.path_m[0] + length) / length, np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            cov[i, k] = beams.scale2 * grown * step[i] * step[k] + (beams.white_m2 if i == k else 0.0)
    return cov


@njit(cache=True, nogil=True)
def _sum(way, beams, step, a_from_b, cov):
    """Adds a frame to the displacement since the node."""
    way.path_m[0] += _length(step)
    for i in range(3):
        way.metres[i] += way.turn[i, 0] * step[0] + way.turn[i, 1] * step[1] + way.turn[i, 2] * step[2]
        way.cov[i, i] += beams.white_m2
    geometry.put(way.turn, geometry.product(way.turn, _of_body(a_from_b, beams.body_from_camera)[:3, :3]))
    to_node = geometry.product(way.turn, beams.body_from_camera[:3, :3])
    grown = geometry.product(geometry.product(to_node, cov[:3, :3]), to_node.T)
    geometry.put(way.turn_cov, way.turn_cov + grown)


@njit(cache=True, nogil=True)
def _walked_cov(way):
    lever = geometry.skew(way.metres)  # the attitude's error at the end bounds the one on the way
    return way.cov + geometry.product(geometry.product(lever, way.turn_cov), lever.T)


@njit(cache=True, nogil=True)
def _start(way):
    """Starts anew at a node; the last reading is kept."""
    geometry.put(way.turn, np.eye(3))
    way.turn_cov[:], way.metres[:], way.cov[:], way.path_m[:], way.whole[:] = 0.0, 0.0, 0.0, 0.0, True


@njit(cache=True, nogil=True)
def fuse(a_from_b, cov, step, step_cov, body_from_camera):
    """Kalman update of a camera's motion by a measured displacement of the body's origin.

    Args:
        a_from_b, cov: (4, 4), (6, 6).
        step, step_cov: (3,), (3, 3) in the body before the motion [m].
    """
    expected, by_motion = body_displacement(a_from_b, body_from_camera)
    return updated(a_from_b, cov, step - expected, by_motion, step_cov)
