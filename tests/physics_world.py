"""Minimal MuJoCo model for tests of the physics: one free body with the mass and inertia of the BlueROV2."""

import numpy as np

from twin.scenario.model import VehicleConfig
from twin.scenes.gl import MjModel, mujoco
from twin.simulate.mujoco_vehicle import MujocoVehicle
from twin.simulate.sea import steady_current

STILL = np.zeros(3)
IDLE = np.zeros(8)


def bare_model(timestep_s: float = 1 / 120) -> MjModel:
    """Returns a compiled model with the free body "vehicle" under gravity, and nothing else."""
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep_s
    body = spec.worldbody.add_body(name="vehicle")
    body.add_freejoint()
    rov = VehicleConfig()
    body.mass, body.inertia, body.explicitinertial = rov.mass_kg, np.array(rov.inertia_kgm2), True
    return spec.compile()


def vehicle(pose=None, current_mps=STILL, timestep_s=1 / 120, buoyancy_n=0.0, **factors) -> MujocoVehicle:
    """Returns a MuJoCo vehicle, neutrally buoyant in still water by default."""
    section = VehicleConfig(buoyancy_n=buoyancy_n, **factors)
    sea = steady_current(np.array(current_mps))
    return MujocoVehicle(bare_model(timestep_s), section, sea, np.eye(4) if pose is None else pose)
