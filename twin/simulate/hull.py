"""Hull of the vehicle of a scenario; timestep and speed limits of the physics."""

import math

import numpy as np

from twin.core.geometry import Array
from twin.scenario.model import VehicleConfig
from twin.simulate.hydrodynamics import GRAVITY_MPS2, Hull, angular_first
from twin.simulate.parameters import parameters_of

MAX_TIMESTEP_S = 1 / 120
#: The same for a vehicle that is steered by fins, which flies four times as fast: 1 mm in 60 s of a rough sea.
MAX_TIMESTEP_WITH_FINS_S = 1 / 480
SPEED_LIMIT_MPS, RATE_LIMIT_RADPS = 20.0, 50.0  # far above any speed of the vehicle; reached only by divergence


def physics_timestep_s(frame_rate_hz: float, vehicle: VehicleConfig | None = None) -> float:
    """Returns the longest timestep up to that of the vehicle that divides the frame period into whole steps."""
    longest_s = MAX_TIMESTEP_WITH_FINS_S if vehicle is not None and vehicle.is_steered_by_fins else MAX_TIMESTEP_S
    return 1 / (frame_rate_hz * math.ceil(1 / (frame_rate_hz * longest_s) - 1e-9))


def whole_timesteps(duration_s: float, timestep_s: float) -> int:
    """Returns the number of timesteps in a duration; raises ValueError if it is not a whole number from 1."""
    n_steps = round(duration_s / timestep_s)
    if n_steps < 1 or abs(n_steps * timestep_s - duration_s) > 1e-6 * duration_s:
        raise ValueError(f"{duration_s} s is not a whole number of timesteps of {timestep_s} s")
    return n_steps


def trimmed_hull(vehicle: VehicleConfig) -> Hull:
    """Returns the hull of a vehicle with the factors and the buoyancy of a scenario."""
    rov = parameters_of(vehicle)
    weight_n = rov.mass_kg * GRAVITY_MPS2
    return Hull(
        inertia=np.array([*rov.inertia_kgm2, *[rov.mass_kg] * 3]),
        added_inertia=vehicle.added_mass_factor * _both_angular_first(rov.added_mass),
        linear_drag=vehicle.drag_factor * _both_angular_first(rov.linear_drag),
        quadratic_drag=vehicle.drag_factor * _both_angular_first(rov.quadratic_drag), drag_centre_m=rov.drag_centre_m,
        centre_of_buoyancy_m=rov.centre_of_buoyancy_m, weight_n=weight_n, buoyancy_n=weight_n + vehicle.buoyancy_n,
    )  # fmt: skip


def _both_angular_first(matrix: Array) -> Array:
    return np.ascontiguousarray(angular_first(angular_first(matrix).T).T)
