"""The DVL as an aid: its velocity summed to a displacement, of a frame for the online position, of a node for GA."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin import geometry
from twin.geometry import Array
from twin.records import SensorNoise, StereoRig


class Displacement(NamedTuple):
    """How far the body's origin went since a node, in the body's axes at that node.

    Args:
        since: number of that node.
        metres: (3,) as the log says; its scale error makes it (1 + s) times too long, in the whole survey alike.
        cov: (3, 3) by the log's white noise and the error of the attitude between.
    """

    since: int
    metres: Array
    cov: Array


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
    origin = geometry.inverse(body_from_camera)[:3, 3].copy()  # of the body, in the camera
    mount = np.ascontiguousarray(body_from_camera[:3, :3])
    turn = mount @ np.ascontiguousarray(a_from_b[:3, :3])
    joint = body_from_camera @ a_from_b
    moved = np.ascontiguousarray(joint[:3, :3]) @ origin + joint[:3, 3]
    by_motion = np.empty((3, 6))
    by_motion[:, :3], by_motion[:, 3:] = turn @ -geometry.skew(origin), turn
    return moved, by_motion


@njit(cache=True, nogil=True)
def logged(way, beams, a_from_b, cov, velocity):
    """The camera's motion (4, 4) of a frame, with covariance (6, 6), and what the log says of it fused in.

    Args:
        way: since the last node, which goes on.
        a_from_b, cov: by vision; unchanged without two readings.
        velocity: (3,) reading at the frame's end, in the body; NaN: none.
    """
    last = way.velocity.copy()
    way.velocity[:] = velocity
    if np.isnan(last[0]) or np.isnan(velocity[0]):
        way.whole[0] = False
        return a_from_b, cov
    mount = np.ascontiguousarray(beams.body_from_camera[:3, :3])
    turn = mount @ np.ascontiguousarray(a_from_b[:3, :3]) @ np.ascontiguousarray(mount.T)
    step = (last + turn @ velocity) / 2 * beams.step_s
    fused, fused_cov = fuse(a_from_b, cov, step, _step_cov(way, beams, step), beams.body_from_camera)
    _sum(way, beams, mount, step, fused, fused_cov)
    return fused, fused_cov


@njit(cache=True, nogil=True)
def _step_cov(way, beams, step):
    """Covariance of a frame's displacement. The scale error adds up along the path L since the node: the frames'
    shares s^2 ((L + l)^2 - L^2) have the sum s^2 L^2."""
    length = max(np.sqrt(np.dot(step, step)), 1e-12)
    grown = (2 * way.path_m[0] + length) / length
    return np.eye(3) * beams.white_m2 + beams.scale2 * grown * np.outer(step, step)


@njit(cache=True, nogil=True)
def _sum(way, beams, mount, step, a_from_b, cov):
    """Adds a frame to the displacement since the node."""
    way.metres[:] = way.metres + way.turn @ step
    way.path_m[0] += np.sqrt(np.dot(step, step))
    way.cov[:] = way.cov + np.eye(3) * beams.white_m2
    way.turn[:] = way.turn @ mount @ np.ascontiguousarray(a_from_b[:3, :3]) @ np.ascontiguousarray(mount.T)
    to_node = way.turn @ mount
    way.turn_cov[:] = way.turn_cov + to_node @ np.ascontiguousarray(cov[:3, :3]) @ np.ascontiguousarray(to_node.T)


@njit(cache=True, nogil=True)
def _walked_cov(way):
    lever = geometry.skew(way.metres)  # the attitude's error at the end bounds the one on the way
    return way.cov + lever @ way.turn_cov @ np.ascontiguousarray(lever.T)


@njit(cache=True, nogil=True)
def _start(way):
    """Starts anew at a node; the last reading is kept."""
    way.turn[:], way.turn_cov[:] = np.eye(3), 0.0
    way.metres[:], way.cov[:], way.path_m[:], way.whole[:] = 0.0, 0.0, 0.0, True


@njit(cache=True, nogil=True)
def fuse(a_from_b, cov, step, step_cov, body_from_camera):
    """Kalman update of a camera's motion by a measured displacement of the body's origin.

    Args:
        a_from_b, cov: (4, 4), (6, 6).
        step, step_cov: (3,), (3, 3) in the body before the motion [m].
    """
    predicted, by_motion = body_displacement(a_from_b, body_from_camera)
    spread = by_motion @ cov
    gain = np.linalg.solve(spread @ np.ascontiguousarray(by_motion.T) + step_cov, spread).T
    keep = np.eye(6) - gain @ by_motion
    moved = a_from_b @ geometry.exp(gain @ (step - predicted))
    fused = keep @ cov @ np.ascontiguousarray(keep.T) + gain @ step_cov @ gain.T
    return moved, fused
