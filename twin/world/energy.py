"""Energy of a survey, planned or flown, from the velocities through the mean current."""

from __future__ import annotations

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import Energy
from twin.core.records import Trajectory
from twin.simulate.energy import energy_of
from twin.simulate.sea import make_sea, mean_current_mps
from twin.world.mission import Mission
from twin.world.path_checks import body_velocities

_INTERVAL_S = 0.5  # between the velocities of a flown path


def planned_velocities(mission: Mission) -> Array:
    """Returns the planned velocities (n, 3) through the mean current at all frames, in the body [m/s]."""
    flown = mission.plan.all_references()
    n_hold, yaw = mission.n_frames - len(flown.position), np.asarray(flown.yaw)
    velocities = np.vstack([flown.velocity, np.zeros((n_hold, 3))])
    current = mean_current_mps(make_sea(mission.scenario), float(flown.position[:, 2].mean()))
    return body_velocities(np.append(yaw, np.full(n_hold, yaw[-1])), velocities - current)


def planned_energy(mission: Mission) -> Energy:
    return energy_of(mission.scenario.vehicle, planned_velocities(mission), 1 / mission.rig.frame_rate_hz)


def flown_energy(mission: Mission, path: Trajectory) -> Energy:
    """Returns the energy of a flight along the true path of the left camera."""
    n, vehicle = max(1, round(_INTERVAL_S * mission.rig.frame_rate_hz)), mission.scenario.vehicle
    times_s, positions = path.times_s[::n], path.positions[::n]
    if len(times_s) < 2 or vehicle.dynamics == "kinematic":
        return Energy()
    current = mean_current_mps(make_sea(mission.scenario), float(positions[:, 2].mean()))
    yaw = geometry.heading_of_camera(path.world_from_camera[::n][:-1])
    velocities = np.diff(positions, axis=0) / np.diff(times_s)[:, None] - current
    return energy_of(vehicle, body_velocities(yaw, velocities), float(times_s[1] - times_s[0]))
