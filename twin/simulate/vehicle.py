"""The vehicle in the world: MuJoCo moves the body under the wrench that yields the hydrodynamic acceleration."""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scenes.bluerov2 import BLUEROV2_HEAVY
from scenes.gl import MjModel, mujoco
from twin.core import geometry
from twin.errors import SurveyAborted
from twin.scenario.model import VehicleConfig
from twin.simulate.hull import RATE_LIMIT_RADPS, SPEED_LIMIT_MPS, hull_of
from twin.simulate.hydrodynamics import free_joint_acceleration, twist_of_free_joint
from twin.simulate.thrusters import LaggedThrusters

Array = NDArray[np.float64]


class HasModel(Protocol):
    """A compiled world with one free body named "vehicle"."""

    @property
    def model(self) -> MjModel: ...


class Vehicle:
    """The BlueROV2 Heavy under thrust, drag and current, stepped by MuJoCo on data of its own.

    MuJoCo's step (velocity first, then position with the new velocity) is read as leapfrog: the joint's velocity lives
    half a step before its pose. So energy neither leaks nor grows, to second order in the step.

    Args:
        world: model with a free body "vehicle", its origin in the centre of gravity.
        vehicle: trim and factors.
        current_mps: steady current, east, north, up.
        world_from_body: (4, 4) pose at the start, at rest.
    """

    def __init__(self, world: HasModel, vehicle: VehicleConfig, current_mps: Array, world_from_body: Array):
        self._model, self._data = world.model, mujoco.MjData(world.model)
        self._hull, self._current = hull_of(vehicle), np.array(current_mps, dtype=float)
        self._body = self._model.body("vehicle").id
        joint = int(self._model.body_jntadr[self._body])
        first_q, first_v = int(self._model.jnt_qposadr[joint]), int(self._model.jnt_dofadr[joint])
        self._velocity = self._data.qvel[first_v : first_v + 6]  # a view
        self._dofs = slice(first_v, first_v + 6)
        self._acceleration = np.zeros(6)
        self._kick = 0.5  # the first one brings the velocity to the half step only
        self._thrusters = LaggedThrusters(BLUEROV2_HEAVY, self._model.opt.timestep)
        self._last: deque[tuple[float, Array, Array]] = deque(maxlen=3)
        self._data.qpos[first_q : first_q + 3] = world_from_body[:3, 3]
        self._data.qpos[first_q + 3 : first_q + 7] = geometry.quaternion_wxyz(world_from_body[:3, :3])
        mujoco.mj_step1(self._model, self._data)

    @property
    def time_s(self) -> float:
        return float(self._data.time)

    @property
    def world_from_body(self) -> Array:
        """True pose (4, 4)."""
        return geometry.pose(self._rotation, self._data.xpos[self._body])

    @property
    def twist_body(self) -> Array:
        """True [angular, linear] velocity in the body (6,) [rad/s, m/s], at the instant of the pose."""
        return twist_of_free_joint(self._rotation, self._velocity_now())

    @property
    def _rotation(self) -> Array:
        return self._data.xmat[self._body].reshape(3, 3)

    def _velocity_now(self) -> Array:
        return self._velocity + 0.5 * self._model.opt.timestep * self._acceleration

    def step(self, thruster_u: Array, duration_s: float) -> None:
        """Holds thruster commands (8,) in [-1, 1] for a whole number of physics steps.

        Raises:
            SurveyAborted: the motion is not finite or absurdly fast.
        """
        n_steps = round(duration_s / self._model.opt.timestep)
        if n_steps < 1 or abs(n_steps * self._model.opt.timestep - duration_s) > 1e-6 * duration_s:
            raise ValueError(f"{duration_s} s is no whole number of steps of {self._model.opt.timestep} s")
        self._thrusters.command(thruster_u)
        for _ in range(n_steps):
            self._advance(self._thrusters.wrench())
            self._thrusters.step()
        self._last.append(self._state())

    def _advance(self, wrench: Array) -> None:
        """One physics step under a wrench (6,) of the thrusters in the body."""
        model, data = self._model, self._data
        velocity = self._velocity_now()
        wanted = free_joint_acceleration(self._hull, self._rotation, velocity, self._current, wrench)
        self._refuse_divergence(wanted, velocity)
        acceleration, force = np.zeros(model.nv), np.zeros(model.nv)
        acceleration[self._dofs] = self._kick * wanted
        mujoco.mj_mulM(model, data, force, acceleration)
        # Gravity and gyroscopic terms of MuJoCo's own are part of the bias and cancel: ours replace them.
        data.qfrc_applied[self._dofs] = (force + data.qfrc_bias - data.qfrc_passive)[self._dofs]
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)
        self._acceleration, self._kick = wanted, 1.0

    def _refuse_divergence(self, acceleration: Array, velocity: Array) -> None:
        speeds = np.abs(velocity).reshape(2, 3).max(axis=1)
        if np.isfinite(acceleration).all() and speeds[0] < SPEED_LIMIT_MPS and speeds[1] < RATE_LIMIT_RADPS:
            return
        states = "; ".join(_describe(*state) for state in [*self._last, self._state()])
        raise SurveyAborted(f"the physics diverged at {self.time_s:.3f} s; last states: {states}")

    def _state(self) -> tuple[float, Array, Array]:
        return self.time_s, self._data.xpos[self._body].copy(), self._velocity.copy()


def _describe(time_s: float, position_m: Array, velocity: Array) -> str:
    linear, angular = np.round(velocity, 4).reshape(2, 3).tolist()
    return f"{time_s:.3f} s: at {np.round(position_m, 4).tolist()} m, {linear} m/s, {angular} rad/s"
