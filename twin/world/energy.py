"""Energy of a survey, planned or flown, from the velocities through the current without gusts and waves."""

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import Energy
from twin.core.records import Trajectory
from twin.simulate.energy import energy_of
from twin.simulate.sea import make_sea, mean_current_mps
from twin.simulate.tether import steady_pulls, tether_of
from twin.world.mission import Mission
from twin.world.path_checks import body_velocities

_INTERVAL_S = 0.5  # between the velocities of a flown path
_CURRENTS = 500  # along a path, between which the current is interpolated


def planned_motion(mission: Mission) -> tuple[Array, Array]:
    """Returns the planned velocities (n, 3) through the mean current at all frames, and the pulls (n, 6) of the tether.

    Both are in the body [m/s, N m, N].
    """
    flown = mission.plan.all_references()
    n_hold = mission.n_frames - len(flown.position)
    velocities = np.vstack([flown.velocity, np.zeros((n_hold, 3))])
    yaw = np.pad(np.asarray(flown.yaw), (0, n_hold), "edge")
    times_s = np.arange(len(yaw)) / mission.rig.frame_rate_hz
    return _in_current(mission, times_s, np.pad(flown.position, ((0, n_hold), (0, 0)), "edge"), yaw, velocities)


def planned_energy(mission: Mission) -> Energy:
    velocities, pulls = planned_motion(mission)
    return energy_of(mission.scenario.vehicle, velocities, 1 / mission.rig.frame_rate_hz, pulls)


def flown_energy(mission: Mission, path: Trajectory) -> Energy:
    """Returns the energy of a flight along the true path of the left camera."""
    n, vehicle = max(1, round(_INTERVAL_S * mission.rig.frame_rate_hz)), mission.scenario.vehicle
    times_s, positions = path.times_s[::n], path.positions[::n]
    if len(times_s) < 2 or vehicle.dynamics == "kinematic":
        return Energy()
    yaw = geometry.heading_of_camera(path.world_from_camera[::n][:-1])
    velocities = np.diff(positions, axis=0) / np.diff(times_s)[:, None]
    through_water, pulls = _in_current(mission, times_s[:-1], positions[:-1], yaw, velocities)
    return energy_of(vehicle, through_water, float(times_s[1] - times_s[0]), pulls)


def _in_current(
    mission: Mission, times_s: Array, positions: Array, yaw: Array, velocities: Array
) -> tuple[Array, Array]:  # fmt: skip
    sea, rows = make_sea(mission.scenario), np.unique(np.linspace(0, len(times_s) - 1, _CURRENTS).astype(int))
    known = np.array([mean_current_mps(sea, float(positions[k, 2]), float(times_s[k])) for k in rows])
    current = np.column_stack([np.interp(times_s, times_s[rows], column) for column in known.T])
    tether = tether_of(mission.scenario.tether, mission.start[:3, 3])
    return body_velocities(yaw, velocities - current), steady_pulls(tether, current, positions, yaw, velocities)
