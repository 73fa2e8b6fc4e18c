"""Vehicle without dynamics: it stays level at constant height and moves at the commanded horizontal velocity."""

from collections.abc import Callable

import numpy as np

from twin.core.geometry import Array
from twin.errors import SurveyAborted
from twin.simulate.contact import contact_error, nothing
from twin.simulate.sensors import inertial_quantities


class KinematicVehicle:
    """Vehicle that moves at the horizontal part of the commanded velocity, without rotation, thrust, drag or current.

    It is that of Negahdaripour & Madjidi (2003, section V-A), at first at rest and level at the pose `world_from_body`.
    `inertial`, `after_timestep` and `touched` are those of `MujocoVehicle`, with the steps of `step`: the acceleration
    is the change of velocity at the start of the last step, divided by the duration of the step.
    """

    def __init__(self, world_from_body: Array):
        self.world_from_body = world_from_body.copy()
        self.time_s = 0.0
        self._velocity = np.zeros(3)
        self.inertial = inertial_quantities(world_from_body[:3, :3], np.zeros(3), np.zeros(3))
        self.after_timestep: Callable[[Array], None] | None = None
        self.touched: Callable[[Array], str] = nothing

    @property
    def twist_body(self) -> Array:
        return np.concatenate([np.zeros(3), self._velocity @ self.world_from_body[:3, :3]])

    def step(self, command: Array, duration_s: float) -> None:
        """Moves the vehicle by a horizontal velocity (3,) [m/s]; SurveyAborted if not finite or the hull touches."""
        if not np.isfinite(command).all():
            raise SurveyAborted(f"the commanded velocity is not finite at {self.time_s:.3f} s")
        velocity = np.array([command[0], command[1], 0.0])
        acceleration = (velocity - self._velocity) / duration_s
        self._velocity = velocity
        pose = self.world_from_body.copy()
        pose[:3, 3] += self._velocity * duration_s
        self.world_from_body = pose
        self.time_s += duration_s
        self.inertial = inertial_quantities(pose[:3, :3], np.zeros(3), acceleration)
        if self.after_timestep is not None:
            self.after_timestep(self.inertial)
        if obstacle := self.touched(pose):
            raise contact_error(obstacle, self.time_s, pose)
