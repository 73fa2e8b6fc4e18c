"""The DVL as an aid: its velocity summed to a displacement, of a frame for the online position, of a node for GA."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin import geometry
from twin.estimate.motion import Motion
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


class VelocityLog:
    """Sums velocities by the trapezoidal rule, turned by the attitude since the last node.

    Each reading enters two neighbouring frames with half its noise: counted as independent, frames of variance
    (sigma dt)^2 have the right sum.
    """

    def __init__(self, rig: StereoRig, noise: SensorNoise):
        self._body_from_camera, self._step_s = rig.body_from_camera, 1 / rig.frame_rate_hz
        self._noise = noise
        self._velocity: Array | None = None
        self._start(0)

    def _start(self, node: int) -> None:
        self._node = node
        self._turn, self._turn_cov = np.eye(3), np.zeros((3, 3))
        self._metres, self._cov, self._path_m, self._whole = np.zeros(3), np.zeros((3, 3)), 0.0, True

    def aid(self, motion: Motion, velocity_mps: Array | None) -> Motion:
        """The camera's motion of this frame with what the log says of it fused in; unchanged without two readings.

        Args:
            motion: of the frame, by vision.
            velocity_mps: (3,) reading at the frame's end, in the body.
        """
        last, self._velocity = self._velocity, velocity_mps
        if last is None or velocity_mps is None:
            self._whole = False
            return motion
        turn = self._body_from_camera[:3, :3] @ motion.a_from_b[:3, :3] @ self._body_from_camera[:3, :3].T
        step = (last + turn @ velocity_mps) / 2 * self._step_s
        fused = fuse(motion, step, self._step_cov(step), self._body_from_camera)
        self._sum(step, fused)
        return fused

    def _step_cov(self, step: Array) -> Array:
        """Covariance of a frame's displacement. The scale error adds up along the path L since the node: the frames'
        shares s^2 ((L + l)^2 - L^2) have the sum s^2 L^2."""
        length = max(float(np.linalg.norm(step)), 1e-12)
        grown = (2 * self._path_m + length) / length
        white = np.eye(3) * (self._noise.dvl_mps * self._step_s) ** 2
        return white + self._noise.dvl_scale**2 * grown * np.outer(step, step)

    def _sum(self, step: Array, motion: Motion) -> None:
        """Adds a frame to the displacement since the node."""
        self._metres = self._metres + self._turn @ step
        self._path_m += float(np.linalg.norm(step))
        self._cov = self._cov + np.eye(3) * (self._noise.dvl_mps * self._step_s) ** 2
        camera = self._body_from_camera[:3, :3]
        self._turn = self._turn @ camera @ motion.a_from_b[:3, :3] @ camera.T
        to_node = self._turn @ camera
        self._turn_cov = self._turn_cov + to_node @ motion.cov[:3, :3] @ to_node.T

    def at_node(self, number: int) -> Displacement | None:
        """The displacement from the last node to this one, where the next one starts; None where a reading lacks."""
        lever = geometry.skew(self._metres)  # the attitude's error at the end bounds the one on the way
        cov = self._cov + lever @ self._turn_cov @ lever.T
        walked = Displacement(self._node, self._metres, cov) if self._whole else None
        self._start(number)
        return walked


def fuse(motion: Motion, step: Array, step_cov: Array, body_from_camera: Array) -> Motion:
    """Kalman update of a camera's motion by a measured displacement of the body's origin.

    Args:
        step, step_cov: (3,), (3, 3) in the body before the motion [m].
    """
    predicted, by_motion = body_displacement(motion.a_from_b, body_from_camera)
    gain = np.linalg.solve(by_motion @ motion.cov @ by_motion.T + step_cov, by_motion @ motion.cov).T
    keep = np.eye(6) - gain @ by_motion
    return motion._replace(
        a_from_b=motion.a_from_b @ geometry.exp(gain @ (step - predicted)),
        cov=keep @ motion.cov @ keep.T + gain @ step_cov @ gain.T,
    )


def body_displacement(a_from_b: Array, body_from_camera: Array) -> tuple[Array, Array]:
    """Way (3,) of the body's origin in the earlier body for a motion of the camera, and its derivative (3, 6) by it."""
    origin = geometry.inverse(body_from_camera)[:3, 3]  # of the body, in the camera
    turn = body_from_camera[:3, :3] @ a_from_b[:3, :3]
    moved = geometry.transform(body_from_camera @ a_from_b, origin[None])[0]
    return moved, turn @ np.hstack([-geometry.skew(origin), np.eye(3)])
