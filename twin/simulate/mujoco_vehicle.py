"""Vehicle simulated by MuJoCo under a force that produces the acceleration of the hydrodynamic model."""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.errors import SurveyAborted
from twin.scenario.model import VehicleConfig
from twin.scenes.gl import MjModel, mujoco
from twin.simulate.compiled_vehicle import AT_REST
from twin.simulate.contact import contact_error, nothing
from twin.simulate.fins import add_fins, command_fins, fins_of, step_fins, velocity_through_water
from twin.simulate.hull import RATE_LIMIT_RADPS, SPEED_LIMIT_MPS, trimmed_hull, whole_timesteps
from twin.simulate.hydrodynamics import free_joint_acceleration, twist_from_free_joint
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import Sea, flow_at
from twin.simulate.sensors import inertial_quantities
from twin.simulate.tether import NO_TETHER, Tether, add_tether
from twin.simulate.thrusters import command_thrusters, lagged_thrusters, step_thrusters, thruster_wrench


class MujocoVehicle:
    """Vehicle under thrust, drag and current, simulated by MuJoCo with an MjData of its own.

    MuJoCo's step (velocity first, then position with the new velocity) is interpreted as leapfrog integration: the
    velocity of the free joint refers to half a timestep before the pose. Without drag and thrust, energy is then
    conserved to second order in the timestep. The free body "vehicle" of the model has its origin at the centre of
    gravity; it starts at a pose `world_from_body` (4, 4), with a velocity (3,) in the world. `tether.snag` and
    `sea.single_gusts` can be modified in place.
    """

    def __init__(
        self, model: MjModel, vehicle: VehicleConfig, sea: Sea, world_from_body: Array, tether: Tether = NO_TETHER,
        start_velocity_mps: Array = AT_REST,
    ):  # fmt: skip
        self.tether = tether
        self._model, self._data = model, mujoco.MjData(model)
        self._hull, self.sea = trimmed_hull(vehicle), sea
        self._body = model.body("vehicle").id
        joint = int(model.body_jntadr[self._body])
        first_q, first_v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self._dofs = slice(first_v, first_v + 6)
        self._velocity = self._data.qvel[self._dofs]  # a view into MjData
        self._acceleration = np.zeros(6)
        self._kick = 0.5  # the first step advances the velocity by half a timestep, see the class docstring
        self.thrusters = lagged_thrusters(parameters_of(vehicle), model.opt.timestep)
        self._fins = fins_of(vehicle, model.opt.timestep)
        self._history: deque[str] = deque(maxlen=3)
        self._data.qpos[first_q : first_q + 3] = world_from_body[:3, 3]
        self._data.qpos[first_q + 3 : first_q + 7] = geometry.quaternion_wxyz(world_from_body[:3, :3])
        self._velocity[:3] = start_velocity_mps
        mujoco.mj_step1(model, self._data)
        self.after_timestep: Callable[[Array], None] | None = None  #: called with `inertial` after each timestep
        self.touched: Callable[[Array], str] = nothing  #: the obstacle that the hull touches at a pose, "" for none

    def __getstate__(self) -> dict[str, Any]:
        whole = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self._model, whole))
        mujoco.mj_getState(self._model, self._data, state, whole)
        return vars(self) | {"_data": state, "_velocity": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_setState(self._model, self._data, state["_data"], mujoco.mjtState.mjSTATE_INTEGRATION)
        self._velocity = self._data.qvel[self._dofs]
        mujoco.mj_step1(self._model, self._data)

    @property
    def time_s(self) -> float:
        return float(self._data.time)

    @property
    def world_from_body(self) -> Array:
        return geometry.pose(self._rotation, self._data.xpos[self._body])

    @property
    def twist_body(self) -> Array:
        return twist_from_free_joint(self._rotation, self._velocity_now())

    @property
    def inertial(self) -> Array:
        """Returns the true [angular rate, specific force] (6,) in body axes [rad/s, m/s2], at the time of the pose."""
        velocity = self._velocity_now()
        acceleration = self._acceleration_at(velocity, thruster_wrench(self.thrusters))
        return inertial_quantities(self._rotation, velocity[3:], acceleration[:3])

    @property
    def _rotation(self) -> Array:
        return self._data.xmat[self._body].reshape(3, 3)

    def _velocity_now(self) -> Array:
        """Returns the velocity of the free joint (6,), ordered as `qvel`, at the same time as the current pose."""
        return self._velocity + 0.5 * self._model.opt.timestep * self._acceleration

    def _acceleration_at(self, velocity: Array, wrench: Array) -> Array:
        at = self._data.xpos[self._body]
        flow = flow_at(self.sea, self.time_s, at)
        add_fins(wrench, self._fins, velocity_through_water(self._rotation, velocity, flow))
        add_tether(wrench, self.tether, self.sea, self.time_s, self._rotation, at, velocity)
        return free_joint_acceleration(self._hull, self._rotation, velocity, flow, wrench)

    def step(self, command: Array, duration_s: float) -> None:
        """Simulates as `CompiledVehicle.step` does, with all obstacles."""
        n_steps = whole_timesteps(duration_s, self._model.opt.timestep)
        n_thrusters = len(self.thrusters.steady_n)
        command_thrusters(self.thrusters, command[:n_thrusters])
        command_fins(self._fins, command[n_thrusters:])
        for _ in range(n_steps):
            self._advance(thruster_wrench(self.thrusters))
            step_thrusters(self.thrusters)
            step_fins(self._fins)
            if self.after_timestep is not None:
                self.after_timestep(self.inertial)
            if obstacle := self.touched(self.world_from_body):
                raise contact_error(obstacle, self.time_s, self.world_from_body)
        self._history.append(self._described_state())

    def _advance(self, wrench: Array) -> None:
        model, data = self._model, self._data
        velocity = self._velocity_now()
        target = self._acceleration_at(velocity, wrench)
        self._check_divergence(target, velocity)
        acceleration, force = np.zeros(model.nv), np.zeros(model.nv)
        acceleration[self._dofs] = self._kick * target
        mujoco.mj_mulM(model, data, force, acceleration)
        # `target` contains gravity and gyroscopic terms: MuJoCo's own (bias and passive forces) are cancelled.
        data.qfrc_applied[self._dofs] = (force + data.qfrc_bias - data.qfrc_passive)[self._dofs]
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)
        self._acceleration, self._kick = target, 1.0

    def _check_divergence(self, acceleration: Array, velocity: Array) -> None:
        speeds = np.abs(velocity).reshape(2, 3).max(axis=1)
        if np.isfinite(acceleration).all() and speeds[0] < SPEED_LIMIT_MPS and speeds[1] < RATE_LIMIT_RADPS:
            return
        states = "; ".join([*self._history, self._described_state()])
        raise SurveyAborted(f"the physics diverged at {self.time_s:.3f} s; last states: {states}")

    def _described_state(self) -> str:
        linear, angular = np.round(self._velocity, 4).reshape(2, 3).tolist()
        position_m = np.round(self._data.xpos[self._body], 4).tolist()
        return f"{self.time_s:.3f} s: at {position_m} m, {linear} m/s, {angular} rad/s"
