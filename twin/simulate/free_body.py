"""The same vehicle without a world around it: compiled, for surveys that are not rendered.

MuJoCo's step of a free body is (velocity first, position with the new velocity, the turn by the body's rate); with
nothing to collide with, nothing of it is left out here. `vehicle.Vehicle` and this one agree to rounding.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scenes.bluerov2 import BLUEROV2_HEAVY
from twin import config, geometry
from twin.errors import SurveyAborted
from twin.simulate.hydrodynamics import free_joint_acceleration, twist_of_free_joint
from twin.simulate.thrusters import LaggedThrusters
from twin.simulate.vehicle import RATE_LIMIT_RADPS, SPEED_LIMIT_MPS, hull_of

Array = NDArray[np.float64]


class FreeBody:
    """The BlueROV2 Heavy under thrust, drag and current.

    Args:
        vehicle: trim and factors.
        current_mps: steady current, east, north, up.
        world_from_body: (4, 4) pose at the start, at rest.
        timestep_s: of the physics.
    """

    def __init__(self, vehicle: config.Vehicle, current_mps: Array, world_from_body: Array, timestep_s: float):
        self._hull, self._current, self._timestep_s = hull_of(vehicle), np.array(current_mps, float), timestep_s
        self._thrusters = LaggedThrusters(BLUEROV2_HEAVY, timestep_s)
        self._pose = np.array(world_from_body, float)
        self._velocity = np.zeros(6)  # of the free joint, half a step before the pose
        self._acceleration = np.zeros(6)
        self._kick = 0.5  # the first one brings the velocity to the half step only
        self._steps = 0

    @property
    def world_from_body(self) -> Array:
        """True pose (4, 4)."""
        return self._pose.copy()

    @property
    def twist_body(self) -> Array:
        """True [angular, linear] velocity in the body (6,) [rad/s, m/s], at the instant of the pose."""
        velocity = self._velocity + 0.5 * self._timestep_s * self._acceleration
        return twist_of_free_joint(self._pose[:3, :3], velocity)

    def step(self, thruster_u: Array, duration_s: float) -> None:
        """Holds thruster commands (8,) in [-1, 1] for a whole number of physics steps.

        Raises:
            SurveyAborted: the motion is not finite or absurdly fast.
        """
        n_steps = round(duration_s / self._timestep_s)
        self._thrusters.command(thruster_u)
        wrenches = self._thrusters.wrenches(n_steps)
        self._kick = _advance(
            self._pose, self._velocity, self._acceleration, self._kick, wrenches, self._hull, self._current,
            self._timestep_s,
        )  # fmt: skip
        self._steps += n_steps
        speeds = np.abs(self._velocity)
        if not (speeds[:3].max() < SPEED_LIMIT_MPS and speeds[3:].max() < RATE_LIMIT_RADPS):
            raise SurveyAborted(f"the physics diverged at {self._steps * self._timestep_s:.3f} s")


@njit(cache=True, nogil=True)
def _advance(pose, velocity, acceleration, kick, wrenches, hull, current, timestep):
    """Steps pose (4, 4), velocity (6,) and acceleration (6,) in place, a wrench (6,) each; returns the next kick."""
    for wrench in wrenches:
        now = velocity + 0.5 * timestep * acceleration
        rotation = pose[:3, :3].copy()
        acceleration[:] = free_joint_acceleration(hull, rotation, now, current, wrench)
        velocity += kick * timestep * acceleration
        kick = 1.0
        pose[:3, 3] += timestep * velocity[:3]
        pose[:3, :3] = rotation @ geometry.so3_exp(timestep * velocity[3:])
    return kick
