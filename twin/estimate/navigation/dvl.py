"""Integration of DVL velocities: displacements per frame for the online pose, and per node for the global alignment."""

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Displacement, Mask, SensorNoise, StereoRig
from twin.estimate.navigation.kalman import DVL, fuse_reading
from twin.kernels import kernel

_MOST_INTERVALS = 2.5  # between readings of a slow DVL, of which one may be missing
#: Standard deviation of the rate of change of the acceleration: the trapezoidal rule is wrong by T^3 / 12 times that.
_JERK_MPS3 = 0.5


class DvlModel(NamedTuple):
    """Error model of the DVL."""

    body_from_camera: Array  #: (4, 4) pose of the left camera in the body
    step_s: float  #: time since the previous frame [s]
    white_m2: float  #: variance of each component of a frame's displacement due to white noise [m^2]
    scale_variance: float  #: variance of the scale error (a relative error of the velocity)
    longest_gap_s: float  #: longest time between readings that vision bridges [s]; 0: each frame has a reading


class DvlState(NamedTuple):
    """Integration of DVL velocities since the last node. All arrays are modified in place."""

    velocity: Array  #: (3,) last reading, in body axes [m/s]; NaN if the last frame had none
    #: node_from_body, rotation_cov: (3, 3), (3, 3) rotation of the body since the node, and its covariance in the body
    #: axes at the node [rad^2].
    node_from_body: Array
    rotation_cov: Array
    #: displacement_m, cov: (3,), (3, 3) displacement of the body's origin since the node, in the body axes at the node
    #: [m], and its covariance due to white noise [m^2].
    displacement_m: Array
    cov: Array
    path_m: Array  #: (1,) path length since the node [m]
    complete: Mask  #: (1,) false if the reading at the node or at a frame after it is missing
    #: since_reading, since_reading_cov: (4, 4), (6, 6) visual motion since the last reading or node, if later, and its
    #: covariance; valid if `gap_s` is not zero.
    since_reading: Array
    since_reading_cov: Array
    gap_s: Array  #: (1,) time since the last reading or node, up to the last frame [s]


class MotionUpdate(NamedTuple):
    """Motion of a frame after fusion with the DVL."""

    motion: Array  #: (4, 4) motion since the previous frame or, if the reading is the first one for a while, since then
    cov: Array  #: (6, 6) its covariance
    #: replaced, replaced_cov: (4, 4), (6, 6) visual motion of the frames before this one that `motion` replaces, and
    #: its covariance.
    replaced: Array
    replaced_cov: Array
    duration_s: float  #: time of `motion`


class DvlIntegrator:
    """Integrates DVL velocities, rotated into the body axes at the last node, by the trapezoidal rule.

    Each reading has half weight in two consecutive displacements. The variance of their sum, (n - 1/2) (sigma dt)^2 for
    readings of deviation sigma, is approximated by independent displacements of variance (sigma dt)^2.
    """

    def __init__(self, rig: StereoRig, noise: SensorNoise):
        self._rig, self._noise, self._node = rig, noise, 0
        displacement = np.zeros(3), np.zeros((3, 3)), np.zeros(1)
        since_reading = np.eye(4), np.zeros((6, 6)), np.zeros(1)
        self.state = DvlState(
            np.full(3, np.nan), np.eye(3), np.zeros((3, 3)), *displacement, np.ones(1, np.bool_), *since_reading
        )

    def model(self, interval_s: float) -> DvlModel:
        white_m2, gap_s = (self._noise.dvl_mps * interval_s) ** 2, _MOST_INTERVALS * self._noise.dvl_interval_s
        return DvlModel(self._rig.body_from_camera, interval_s, white_m2, self._noise.dvl_scale**2, gap_s)

    def interrupt(self) -> None:
        """Ends the integration, because the motion since the last reading is not known."""
        self.state.velocity[:], self.state.gap_s[:], self.state.complete[:] = np.nan, 0.0, False

    def resume(self, velocity_mps: Array) -> None:
        """Lets the integration of displacements start from a reading (3,) that was not fused."""
        self.state.velocity[:], self.state.gap_s[:] = velocity_mps, 0.0

    def displacement_at_node(self, number: int) -> Displacement | None:
        """Returns the displacement since the last node, and restarts the integration; None if a reading is missing."""
        state, node, self._node = self.state, self._node, number
        if state.gap_s[0] > 0:
            accumulate_visual(state, self._rig.body_from_camera, state.since_reading, state.since_reading_cov)
            state.velocity[:], state.gap_s[:] = np.nan, 0.0  # vision alone up to the next reading
        complete = state.complete[0]
        displacement = Displacement(node, state.displacement_m.copy(), _displacement_cov(state)) if complete else None
        state.node_from_body[:], state.complete[:] = np.eye(3), True
        for sums in (state.rotation_cov, state.displacement_m, state.cov, state.path_m):
            sums[:] = 0.0
        return displacement


@kernel
def body_displacement(a_from_b: Array, body_from_camera: Array) -> tuple[Array, Array]:
    """Returns the displacement (3,) [m] of the body by a motion of the camera, in the body axes before it."""
    # and its Jacobian (3, 6) with respect to an increment of the motion, in the axes of the later camera
    camera_from_body = geometry.inverse(body_from_camera)
    body_a_from_b = geometry.compose(body_from_camera, a_from_b)
    lever, by_motion = geometry.skew(camera_from_body[:3, 3]), np.zeros((3, 6))
    for i in range(3):
        for k in range(3):
            by_motion[i, 3 + k] = body_a_from_b[i, k]
            for m in range(3):
                by_motion[i, k] -= body_a_from_b[i, m] * lever[m, k]
    return geometry.compose(body_a_from_b, camera_from_body)[:3, 3].copy(), by_motion


@kernel
def fuse_dvl(state, model, a_from_b, cov, velocity, gates):
    """Fuses the visual motion since the last reading with the DVL readings, and adds it to the integration."""
    # `velocity` (3,) of this frame in body axes [m/s], NaN without; motion and covariance are unchanged without one, or
    # if it contradicts the visual motion. The integration becomes incomplete if it does, or if the last reading is too
    # long ago.
    nothing = np.eye(4), np.zeros((6, 6))
    before, before_cov, motion, motion_cov, duration_s = nothing[0], nothing[1], a_from_b, cov, model.step_s
    if state.gap_s[0] > 0:
        before, before_cov = state.since_reading.copy(), state.since_reading_cov.copy()
        motion = geometry.compose(before, a_from_b)
        motion_cov = geometry.transport_covariance(before_cov, a_from_b) + cov
        duration_s = state.gap_s[0] + model.step_s
    visual = MotionUpdate(a_from_b, cov, nothing[0], nothing[1], model.step_s)
    if np.isnan(velocity[0]) and duration_s < model.longest_gap_s:
        geometry.copy_into(state.since_reading, motion)
        geometry.copy_into(state.since_reading_cov, motion_cov)
        state.gap_s[0] = duration_s
        return visual
    last = state.velocity.copy()
    geometry.copy_into(state.velocity, velocity)
    state.gap_s[0] = 0.0
    if np.isnan(velocity[0]) or np.isnan(last[0]):
        if np.isnan(velocity[0]) or model.longest_gap_s == 0:
            state.complete[0] = False
        else:
            accumulate_visual(state, model.body_from_camera, motion, motion_cov)
        return visual
    rotation, step = _body_motion(motion, model.body_from_camera), np.empty(3)
    for i in range(3):
        now = rotation[i, 0] * velocity[0] + rotation[i, 1] * velocity[1] + rotation[i, 2] * velocity[2]
        step[i] = (last[i] + now) / 2 * duration_s
    white_m2 = model.white_m2
    if duration_s > model.step_s:
        white_m2 = white_m2 * (duration_s / model.step_s) ** 2 + (_JERK_MPS3 * duration_s**3 / 12) ** 2
    step_cov = _step_cov(state, model.scale_variance, white_m2, step)
    fused, fused_cov, used = fuse_displacement(motion, motion_cov, step, step_cov, model.body_from_camera, gates)
    if not used:
        state.velocity[:], state.complete[0] = np.nan, False
        return visual
    state.path_m[0] += _length(step)
    _accumulate(state, model.body_from_camera, step, white_m2 * np.eye(3), fused, fused_cov)
    return MotionUpdate(fused, fused_cov, before, before_cov, duration_s)


@kernel
def accumulate_visual(state, body_from_camera, motion, cov):
    """Adds a visual motion (4, 4), with covariance (6, 6), that no readings enclose to the integration."""
    step, by_motion = body_displacement(motion, body_from_camera)
    step_cov = geometry.product(geometry.product(by_motion, cov), by_motion.T)
    in_node = geometry.product(geometry.product(state.node_from_body, step_cov), state.node_from_body.T)
    _accumulate(state, body_from_camera, step, in_node, motion, cov)


@kernel
def _body_motion(a_from_b, body_from_camera):
    return geometry.compose(geometry.compose(body_from_camera, a_from_b), geometry.inverse(body_from_camera))


@kernel
def _length(step):
    return np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])


@kernel
def _step_cov(state, scale_variance, white_m2, step):
    """Returns the covariance (3, 3) [m^2] of a frame's displacement `step` (3,) due to white noise and scale error."""
    # the scale error s accumulates: a displacement l after a path L adds s^2 ((L + l)^2 - L^2) along its direction
    length = max(_length(step), 1e-12)
    growth, cov = (2 * state.path_m[0] + length) / length, np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            cov[i, k] = scale_variance * growth * step[i] * step[k] + (white_m2 if i == k else 0.0)
    return cov


@kernel
def _accumulate(state, body_from_camera, step, step_cov, a_from_b, cov):
    """Adds a motion with its displacement (3,) in the body axes before it [m], and its noise (3, 3) at the node."""
    node_from_body = state.node_from_body
    for i in range(3):
        state.displacement_m[i] += (
            node_from_body[i, 0] * step[0] + node_from_body[i, 1] * step[1] + node_from_body[i, 2] * step[2]
        )
        for k in range(3):
            state.cov[i, k] += step_cov[i, k]
    rotation = _body_motion(a_from_b, body_from_camera)[:3, :3]
    geometry.copy_into(node_from_body, geometry.product(node_from_body, rotation))
    node_from_camera = geometry.product(node_from_body, body_from_camera[:3, :3])
    added = geometry.product(geometry.product(node_from_camera, cov[:3, :3]), node_from_camera.T)
    geometry.copy_into(state.rotation_cov, state.rotation_cov + added)


@kernel
def _displacement_cov(state):
    """Returns the covariance (3, 3) [m^2] of the displacement since the node due to white noise and attitude error."""
    lever = geometry.skew(state.displacement_m)  # conservative: applies the final attitude error to the whole path
    return state.cov + geometry.product(geometry.product(lever, state.rotation_cov), lever.T)


@kernel
def fuse_displacement(a_from_b, cov, step, step_cov, body_from_camera, gates):
    """Returns a motion, its covariance and whether it was used, after a Kalman update with a body displacement."""
    # (3,) [m], with its covariance (3, 3), in the axes of the body before the motion
    expected, by_motion = body_displacement(a_from_b, body_from_camera)
    return fuse_reading(a_from_b, cov, step - expected, by_motion, step_cov, gates, DVL)
