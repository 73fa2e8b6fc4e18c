"""Compiled rigid-body simulation of the vehicle without MuJoCo, for surveys that are not rendered.

The integration scheme is that of MuJoCo for a free body without contacts: it updates the velocity first, then the
position with the new velocity and the rotation with the new angular velocity. The results equal those of
`mujoco_vehicle.MujocoVehicle` within rounding errors.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.errors import SurveyAborted
from twin.kernels import kernel
from twin.scenario.model import VehicleConfig
from twin.simulate.contact import OPEN_WATER, FloorField, contact_error, touches_floor
from twin.simulate.fins import Fins, add_fins, command_fins, fins_of, step_fins, velocity_through_water
from twin.simulate.hull import RATE_LIMIT_RADPS, SPEED_LIMIT_MPS, trimmed_hull, whole_timesteps
from twin.simulate.hydrodynamics import Hull, free_joint_acceleration, twist_from_free_joint
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import Sea, flow_at
from twin.simulate.tether import NO_TETHER, Tether, add_tether
from twin.simulate.thrusters import ThrusterState, command_thrusters, lagged_thrusters, step_thrusters, thruster_wrench

AT_REST = np.zeros(3)


class RigidBodyState(NamedTuple):
    """State [linear in world, angular in body axes] [m/s, rad/s] and parameters of a body; changes in place."""

    pose: Array  #: (4, 4) true pose world_from_body
    velocity: Array  #: (6,) velocity half a timestep before the time of the pose
    acceleration: Array  #: (6,) rate of change of `velocity` in the last step
    kick: Array  #: (1,) number of timesteps over which the next step integrates: 0.5 in the first (leapfrog), then 1
    thrusters: ThrusterState
    fins: Fins
    hull: Hull
    sea: Sea
    timestep_s: float
    n_steps: NDArray[np.int64]  #: (1,) number of timesteps since 0 s
    floor: FloorField  #: floor that the hull must not touch
    tether: Tether
    #: (1,) number of timesteps that were not simulated since the hull touched the floor; -1 if it did not.
    left: NDArray[np.int64]


class CompiledVehicle:
    """Vehicle under thrust, drag and current, integrated by compiled code.

    It starts at a pose `world_from_body` (4, 4), with a velocity (3,) in the world; its hull must not touch `floor`.
    """

    def __init__(
        self, vehicle: VehicleConfig, sea: Sea, world_from_body: Array, timestep_s: float,
        floor: FloorField = OPEN_WATER, tether: Tether = NO_TETHER, start_velocity_mps: Array = AT_REST,
    ):  # fmt: skip
        thrusters = lagged_thrusters(parameters_of(vehicle), timestep_s)
        velocity = np.concatenate([start_velocity_mps, np.zeros(3)])
        self.state = RigidBodyState(
            np.array(world_from_body, float), velocity, np.zeros(6), np.full(1, 0.5), thrusters,
            fins_of(vehicle, timestep_s), trimmed_hull(vehicle), sea, timestep_s, np.zeros(1, np.int64), floor, tether,
            np.full(1, -1),
        )  # fmt: skip
        self.sea, self.tether, self.thrusters, self._time_s = sea, tether, thrusters, 0.0

    @property
    def world_from_body(self) -> Array:
        return self.state.pose.copy()

    @property
    def twist_body(self) -> Array:
        """Returns the true [angular, linear] velocity (6,) in body axes [rad/s, m/s], at the time of the pose."""
        return body_twist(self.state.pose, self.state.velocity, self.state.acceleration, self.state.timestep_s)

    def step(self, command: Array, duration_s: float) -> None:
        """Simulates `duration_s`, whole timesteps (else ValueError), under commands (n,) in [-1, 1].

        The commands are those of the thrusters, then those of the movable fins. Raises SurveyAborted if the physics
        diverged, or the hull touches the floor.
        """
        advance(self.state, command, whole_timesteps(duration_s, self.state.timestep_s))
        self.advance_clock(duration_s)

    def advance_clock(self, duration_s: float) -> None:
        """Advances the clock after `advance`, and raises SurveyAborted as `step` does."""
        self._time_s += duration_s
        if (left := int(self.state.left[0])) >= 0:
            raise contact_error("the floor", self._time_s - left * self.state.timestep_s, self.state.pose)
        if has_ended(self.state.velocity, self.state.left):
            raise SurveyAborted(f"the physics diverged at {self._time_s:.3f} s")


@kernel
def body_twist(pose, velocity, acceleration, timestep_s):
    return twist_from_free_joint(pose[:3, :3], velocity + 0.5 * timestep_s * acceleration)


@kernel
def has_ended(velocity, left):
    """Returns whether the hull touches the floor, or the physics diverged: a velocity is NaN or reaches a limit."""
    speed, rate = np.abs(velocity[:3]).max(), np.abs(velocity[3:]).max()
    return left[0] >= 0 or not (speed < SPEED_LIMIT_MPS and rate < RATE_LIMIT_RADPS)


@kernel
def advance(body, command, n_steps):
    """Advances the state by `n_steps` timesteps under commands (n,); stops early if the hull touches the floor."""
    thrusters, pose, velocity, acceleration = body.thrusters, body.pose, body.velocity, body.acceleration
    n_thrusters = len(thrusters.steady_n)
    command_thrusters(thrusters, command[:n_thrusters])
    command_fins(body.fins, command[n_thrusters:])
    for n in range(n_steps):
        now = velocity + 0.5 * body.timestep_s * acceleration
        flow = flow_at(body.sea, body.n_steps[0] * body.timestep_s, pose[:3, 3])
        wrench = thruster_wrench(thrusters)
        add_fins(wrench, body.fins, velocity_through_water(pose[:3, :3], now, flow))
        add_tether(wrench, body.tether, body.sea, body.n_steps[0] * body.timestep_s, pose[:3, :3], pose[:3, 3], now)
        geometry.copy_into(acceleration, free_joint_acceleration(body.hull, pose[:3, :3], now, flow, wrench))
        velocity += body.kick[0] * body.timestep_s * acceleration
        body.kick[0] = 1.0
        body.n_steps[0] += 1
        rotation = geometry.so3_exp(body.timestep_s * velocity[3:])
        next_pose = geometry.compose(pose, geometry.pose(rotation, np.zeros(3)))
        for i in range(3):
            next_pose[i, 3] += body.timestep_s * velocity[i]
        geometry.copy_into(pose, next_pose)
        step_thrusters(thrusters)
        step_fins(body.fins)
        if touches_floor(body.floor, pose):
            body.left[0] = n_steps - 1 - n
            return
