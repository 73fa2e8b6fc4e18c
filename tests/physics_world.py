"""The least world that physics needs: one free body under gravity, with the hull's mass and inertia."""

from types import SimpleNamespace

import numpy as np

from scenes.bluerov2 import BLUEROV2_HEAVY
from scenes.gl import mujoco
from twin.scenario.model import VehicleConfig
from twin.simulate.vehicle import Vehicle

STILL = np.zeros(3)
IDLE = np.zeros(8)


def bare_world(timestep_s: float = 1 / 120) -> SimpleNamespace:
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep_s
    body = spec.worldbody.add_body(name="vehicle")
    body.add_freejoint()
    body.mass, body.inertia, body.explicitinertial = BLUEROV2_HEAVY.mass_kg, BLUEROV2_HEAVY.inertia_kgm2, True
    return SimpleNamespace(model=spec.compile())


def vehicle(pose=None, current_mps=STILL, timestep_s=1 / 120, buoyancy_n=0.0, **factors) -> Vehicle:
    section = VehicleConfig(buoyancy_n=buoyancy_n, **factors)
    return Vehicle(bare_world(timestep_s), section, current_mps, np.eye(4) if pose is None else pose)
