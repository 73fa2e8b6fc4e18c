"""Kalman filter of the camera's motion from frame to frame, predicted by an inertial measurement unit (IMU)."""

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import GRAVITY_MPS2, ImuErrorModel, ImuReadings, StereoRig
from twin.kernels import kernel

_FIRST_VELOCITY, _FIRST_ACCELERATION = 1.0, 0.3  # sigmas at the first reading [m/s], [m/s2]
_GRAVITY_SIGMA = 0.01  # of the strength of gravity, which varies over the Earth by more, but is not known better [m/s2]
#: Above the first chi2 (6 degrees of freedom) a measured pose has less weight, as errors of vision have heavier tails
#: than those of the prediction; above the second it is rejected.
_WEIGHTED, _GATE = 20.0, 300.0
_LONGEST_S = 0.1  # readings that are farther apart leave a gap
#: Density of the noise of angular rates and specific forces in gaps between readings [rad/s/sqrt(Hz), m/s2/sqrt(Hz)].
_GAP_RATE, _GAP_FORCE = 0.3, 0.5
_VELOCITY, _GRAVITY, _RATE_BIAS, _FORCE_BIAS = (slice(k, k + 3) for k in (6, 9, 12, 15))


class InertialFilter:
    """Extended Kalman filter of pose, velocity, direction of gravity and biases of an IMU; see `MotionFilter`.

    The state is that of the body, whose axes are those of the IMU, and velocity and gravity are in its axes, so that a
    new reference changes the pose alone (robocentric: Bloesch et al. 2017, "Iterated extended Kalman filter based
    visual-inertial odometry"). Between measured poses the IMU predicts the motion: w = w_m - b_w, dv/dt = f_m - b_f + g
    - w x v, dg/dt = -w x g. Direction of gravity and bias of the accelerometer start as unknown as they are; a motion
    is predicted as well as their sum is known. Errors (18,) are [rotation, translation (as `MotionFilter`), velocity,
    gravity, bias of the rates, bias of the specific forces]. `pose` and `velocity`, of the camera, are as those of
    `MotionFilter`.
    """

    def __init__(self, rig: StereoRig, noise: ImuErrorModel, first: ImuReadings, velocity: Array):
        self._camera_from_body = geometry.inverse(rig.body_from_camera)
        self._to_body = geometry.adjoint(rig.body_from_camera)
        self._to_camera = geometry.adjoint(self._camera_from_body)
        self._noise = noise
        self._pose = self._camera_from_body.copy()
        twist, force = self._to_body @ velocity, first.specific_forces_mps2.mean(axis=0)
        self._state = np.concatenate([twist[3:], -force, np.zeros(6)])
        self._rate, self._force, self._last_s = first.rates_radps[-1].copy(), force, float(first.times_s[-1])
        self._reading_s = self._last_s
        cov = np.zeros((18, 18))
        cov[_VELOCITY, _VELOCITY] = np.eye(3) * _FIRST_VELOCITY**2
        cov[_RATE_BIAS, _RATE_BIAS] = np.eye(3) * noise.rate_bias**2
        cov[_FORCE_BIAS, _FORCE_BIAS] = bias = np.eye(3) * noise.force_bias**2
        cov[_GRAVITY, _GRAVITY] = bias + np.eye(3) * _FIRST_ACCELERATION**2  # gravity is taken to be -(f + b)
        cov[_GRAVITY, _FORCE_BIAS] = cov[_FORCE_BIAS, _GRAVITY] = bias
        self._cov = cov
        self._fix_gravity()

    @property
    def pose(self) -> Array:
        return self._pose @ geometry.inverse(self._camera_from_body)

    @property
    def velocity(self) -> Array:
        return self._to_camera @ np.concatenate([self._rate - self._state[6:9], self._state[:3]])

    @property
    def cov(self) -> Array:
        return self._to_camera @ self._cov[:6, :6] @ self._to_camera.T

    def restart(self) -> None:
        """Makes the last frame the reference: its pose becomes the identity, exactly; the rest remains."""
        self._pose = self._camera_from_body.copy()
        self._cov[:6], self._cov[:, :6] = 0.0, 0.0

    def predict(self, interval_s: float, imu: ImuReadings | None = None) -> None:
        """Predicts the pose of the next frame from the readings up to its time; without any, the motion continues."""
        end_s, is_gap = self._last_s + interval_s, imu is None
        times_s, rates, forces = np.array([end_s]), self._rate[None], self._force[None]
        if imu is not None and len(imu.times_s):
            end_s = self._reading_s = float(imu.times_s[-1])
            times_s, rates, forces = (np.ascontiguousarray(part, np.float64) for part in imu)
        n = self._noise
        noise = n.rate_density**2, n.rate_walk**2, n.force_density**2, n.force_walk**2
        self._pose, self._state, self._cov = _propagate(
            self._pose, self._state, self._cov, self._last_s, self._rate, self._force, times_s, rates, forces, noise,
            is_gap or end_s - self._reading_s > _LONGEST_S,
        )  # fmt: skip
        self._rate, self._force, self._last_s = rates[-1].copy(), forces[-1].copy(), end_s
        self._fix_gravity()

    def correct(self, measured: Array, cov: Array) -> bool:
        """Fuses a measured pose (4, 4) with its covariance (6, 6); returns whether it agrees with the prediction."""
        innovation = geometry.log(geometry.inverse(self._pose) @ measured @ self._camera_from_body)
        cov = self._to_body @ cov @ self._to_body.T
        chi2 = float(innovation @ np.linalg.solve(self._cov[:6, :6] + cov, innovation))
        if not chi2 <= _GATE:  # nor if it is NaN
            return False
        expected = self._cov[:6, :6] + cov * max(1.0, chi2 / _WEIGHTED)
        gain = np.asarray(np.linalg.solve(expected, self._cov[:6]).T, np.float64)
        self._update(gain, innovation, np.eye(6, 18))
        return True

    def _fix_gravity(self) -> None:
        """Fuses the strength of gravity, which is known."""
        gravity, row = self._state[3:6], np.zeros((1, 18))
        strength = float(np.linalg.norm(gravity))
        row[0, _GRAVITY] = gravity / strength
        gain = self._cov @ row.T / (row @ self._cov @ row.T + _GRAVITY_SIGMA**2)
        self._update(gain, np.array([GRAVITY_MPS2 - strength]), row)

    def _update(self, gain: Array, innovation: Array, jacobian: Array) -> None:
        step = gain @ innovation
        self._pose = geometry.nearest_rigid(self._pose @ geometry.exp(step[:6]))
        self._state = self._state + step[6:]
        updated = self._cov - gain @ jacobian @ self._cov
        self._cov = (updated + updated.T) / 2


@kernel
def _propagate(pose, state, cov, last_s, last_rate, last_force, times_s, rates, forces, noise, is_gap):
    """Returns pose (4, 4), state (12,) [velocity, gravity, biases] and covariance (18, 18) at the last reading."""
    # the mean of two readings is held between them, the motion is of second order; white noise of density s adds s^2 dt
    state = state.copy()
    for k in range(len(times_s)):
        dt = times_s[k] - last_s
        if dt <= 0:
            last_rate, last_force = rates[k], forces[k]
            continue
        rate, force = (last_rate + rates[k]) / 2 - state[6:9], (last_force + forces[k]) / 2 - state[9:12]
        rate_density2, force_density2 = noise[0], noise[2]
        if is_gap or dt > _LONGEST_S:
            rate_density2, force_density2 = rate_density2 + _GAP_RATE**2, force_density2 + _GAP_FORCE**2
        velocity, gravity = state[:3].copy(), state[3:6].copy()
        turn = np.ascontiguousarray(geometry.so3_exp(rate * dt).T)
        change = (geometry.so3_exp(rate * (dt / 2)) @ force + gravity) * dt  # in the axes at the earlier reading
        twist = np.concatenate((rate * dt, (velocity + change / 2) * dt))
        pose = geometry.compose(pose, geometry.exp(twist))
        state[:3], state[3:6] = turn @ (velocity + change), turn @ gravity
        advance = np.eye(18)
        w, v, g = geometry.skew(rate) * dt, geometry.skew(velocity + change / 2) * dt, geometry.skew(gravity) * dt
        for i in range(3):
            for j in range(3):
                for at in (0, 3, 6, 9):
                    advance[at + i, at + j] -= w[i, j]
                advance[3 + i, j] -= v[i, j]
                advance[6 + i, 12 + j] -= v[i, j]  # d(w x v) by the bias of the rate
                advance[9 + i, 12 + j] -= g[i, j]
            advance[i, 12 + i] -= dt
            advance[3 + i, 6 + i] += dt
            advance[6 + i, 9 + i] += dt
            advance[6 + i, 15 + i] -= dt
        cov = advance @ cov @ np.ascontiguousarray(advance.T)
        for i in range(3):
            cov[i, i] += rate_density2 * dt
            cov[6 + i, 6 + i] += force_density2 * dt
            cov[12 + i, 12 + i] += noise[1] * dt
            cov[15 + i, 15 + i] += noise[3] * dt
        last_s, last_rate, last_force = times_s[k], rates[k], forces[k]
    return pose, state, cov
