"""The same vehicle without a world around it: compiled, for surveys that are not rendered.

MuJoCo's step of a free body is (velocity first, position with the new velocity, the turn by the body's rate); with
nothing to collide with, nothing of it is left out here. `vehicle.Vehicle` and this one agree to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scenes.bluerov2 import BLUEROV2_HEAVY
from twin.core import geometry
from twin.errors import SurveyAborted
from twin.scenario.model import VehicleConfig
from twin.simulate.hull import RATE_LIMIT_RADPS, SPEED_LIMIT_MPS, hull_of
from twin.simulate.hydrodynamics import Hull, free_joint_acceleration, twist_of_free_joint
from twin.simulate.thrusters import LaggedThrusters, Thrusters, pass_step, set_command, wrench_of

Array = NDArray[np.float64]


class Body(NamedTuple):
    """A body in water; arrays of its state are changed in place.

    Args:
        pose: (4, 4) true pose.
        velocity: (6,) of the free joint, half a step before the pose.
        acceleration: (6,) of the last step.
        kick: (1,) steps by which the next one moves the velocity: the first brings it to the half step only.
        thrusters, hull: of the vehicle.
        current: (3,) [m/s].
        timestep_s: of the physics.
    """

    pose: Array
    velocity: Array
    acceleration: Array
    kick: Array
    thrusters: Thrusters
    hull: Hull
    current: Array
    timestep_s: float


class FreeBody:
    """The BlueROV2 Heavy under thrust, drag and current.

    Args:
        vehicle: trim and factors.
        current_mps: steady current, east, north, up.
        world_from_body: (4, 4) pose at the start, at rest.
        timestep_s: of the physics.
    """

    def __init__(self, vehicle: VehicleConfig, current_mps: Array, world_from_body: Array, timestep_s: float):
        thrusters = LaggedThrusters(BLUEROV2_HEAVY, timestep_s).parts
        self.body = Body(
            np.array(world_from_body, float), np.zeros(6), np.zeros(6), np.full(1, 0.5), thrusters, hull_of(vehicle),
            np.array(current_mps, float), timestep_s,
        )  # fmt: skip
        self._time_s = 0.0

    @property
    def world_from_body(self) -> Array:
        """True pose (4, 4)."""
        return self.body.pose.copy()

    @property
    def twist_body(self) -> Array:
        """True [angular, linear] velocity in the body (6,) [rad/s, m/s], at the instant of the pose."""
        return twist_of(self.body)

    def step(self, thruster_u: Array, duration_s: float) -> None:
        """Holds thruster commands (8,) in [-1, 1] for a whole number of physics steps.

        Raises:
            SurveyAborted: the motion is not finite or absurdly fast.
        """
        advance(self.body, thruster_u, round(duration_s / self.body.timestep_s))
        self.passed(duration_s)

    def passed(self, duration_s: float) -> None:
        """Notes that the body was moved for so long. Raises SurveyAborted."""
        self._time_s += duration_s
        if is_lost(self.body):
            raise SurveyAborted(f"the physics diverged at {self._time_s:.3f} s")


@njit(cache=True, nogil=True)
def twist_of(body):
    """As `FreeBody.twist_body`."""
    velocity = body.velocity + 0.5 * body.timestep_s * body.acceleration
    return twist_of_free_joint(body.pose[:3, :3], velocity)


@njit(cache=True, nogil=True)
def is_lost(body):
    """Whether the motion is not finite or absurdly fast."""
    speed, rate = np.abs(body.velocity[:3]).max(), np.abs(body.velocity[3:]).max()
    return not (speed < SPEED_LIMIT_MPS and rate < RATE_LIMIT_RADPS)


@njit(cache=True, nogil=True)
def advance(body, command, n_steps):
    """So many steps under commands (8,)."""
    thrusters, pose, velocity, acceleration = body.thrusters, body.pose, body.velocity, body.acceleration
    set_command(thrusters, command)
    for _ in range(n_steps):
        now = velocity + 0.5 * body.timestep_s * acceleration
        wrench = wrench_of(thrusters)
        geometry.put(acceleration, free_joint_acceleration(body.hull, pose[:3, :3], now, body.current, wrench))
        velocity += body.kick[0] * body.timestep_s * acceleration
        body.kick[0] = 1.0
        turn = geometry.so3_exp(body.timestep_s * velocity[3:])
        turned = geometry.compose(pose, geometry.pose(turn, np.zeros(3)))
        for i in range(3):
            turned[i, 3] += body.timestep_s * velocity[i]
        geometry.put(pose, turned)
        pass_step(thrusters)
