"""MuJoCo model of a free-floating vehicle, which is a mass without a shape."""

import numpy as np

from twin.core.geometry import Array
from twin.scenes.gl import MjModel, mujoco


def build(timestep_s: float, mass_kg: float, inertia_kgm2: Array | tuple[float, ...]) -> MjModel:
    """Compiles the vehicle into a MuJoCo model with gravity, without buoyancy, drag, thrust and contacts.

    The free joint of its body "vehicle" is qpos[0:7] (position, quaternion wxyz) and qvel[0:6]; `inertia_kgm2` are the
    moments of inertia (3,) about its axes.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep_s
    body = spec.worldbody.add_body(name="vehicle")  # its origin is the centre of gravity
    body.add_freejoint(name="vehicle")
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass_kg, np.zeros(3), np.array(inertia_kgm2)
    return spec.compile()
