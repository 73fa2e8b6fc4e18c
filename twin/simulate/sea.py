"""Motion of the water at any time and place: mean current, tide, gusts and waves."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel
from twin.scenario.model import CurrentConfig, Scenario
from twin.simulate.current_file import read_current
from twin.simulate.gusts import add_gusts, add_single_gusts, gust_series, single_gusts
from twin.simulate.waves import CALM, Waves, add_waves, wave_components

#: Heights between which a profile of the current is interpolated [m].
_PROFILE_M = np.geomspace(0.01, 500.0, 200)


class Sea(NamedTuple):
    """Motion of the water as a function of time and place, for compiled code."""

    times_s: Array  #: (t,) of `mean_mps`, increasing
    heights_m: Array  #: (h,) of `mean_mps`, above the reference plane, increasing
    mean_mps: Array  #: (t, h, 3) mean current, interpolated linearly, constant beyond the first and the last
    tide: Array  #: (4,) amplitude to east and north [m/s], angular frequency [rad/s], phase [rad]
    gusts_mps: Array  #: (n, 3) `gusts.gust_series`
    waves: Waves
    single_gusts: Array  #: (k, 5) `gusts.single_gusts`; its rows are set when they start


def make_sea(scenario: Scenario, rng: np.random.Generator | None = None) -> Sea:
    """Returns the sea of a scenario; `rng` draws gusts and waves, None: it has none of them, for checks.

    Raises TwinError if the file of the current cannot be read, or waves have no depth.
    """
    current = scenario.current
    times_s, heights_m, mean_mps = _mean(current, scenario.waves.depth_m or scenario.sun.depth_m)
    rate = 2 * math.pi / (3600 * current.tide_period_h)
    tide = np.array([*current.tide_mps, rate, math.radians(current.tide_phase_deg)])
    return Sea(
        times_s, heights_m, mean_mps, tide, gust_series(current, rng),
        wave_components(scenario.waves, scenario.sun.depth_m, rng),
        single_gusts(sum(fault.type == "gust" for fault in scenario.faults)),
    )  # fmt: skip


def steady_current(velocity_mps: Array) -> Sea:
    """Returns the sea with a steady, uniform current (3,): east, north, up."""
    mean = np.array(velocity_mps, float).reshape(1, 1, 3)
    return Sea(np.zeros(1), np.zeros(1), mean, np.zeros(4), np.zeros((0, 3)), CALM, single_gusts(0))


def _mean(current: CurrentConfig, depth_m: float) -> tuple[Array, Array, Array]:
    if current.file is not None:
        return read_current(current, Path(current.file), depth_m)
    velocity = np.array(current.velocity_mps, float)
    if current.profile == "uniform":
        return np.zeros(1), np.zeros(1), velocity.reshape(1, 1, 3)
    if current.profile == "power":
        factor = (_PROFILE_M / current.reference_height_m) ** current.exponent
    else:
        full = math.log(current.reference_height_m / current.roughness_m)
        factor = np.maximum(np.log(_PROFILE_M / current.roughness_m), 0.0) / full
    return np.zeros(1), _PROFILE_M, (factor[:, None] * velocity)[None]


def mean_current_mps(sea: Sea, height_m: float) -> Array:
    """Returns the current (3,) at 0 s and a height, without gusts and waves."""
    return flow_at(sea._replace(gusts_mps=np.zeros((0, 3)), waves=CALM), 0.0, np.array([0.0, 0.0, height_m]))[0].copy()


def strongest_currents_mps(sea: Sea, lowest_m: float, highest_m: float) -> Array:
    """Returns the currents (n, 3) between two heights at the times of the table, with the tide to either side."""
    heights = np.unique([lowest_m, highest_m, *(h for h in sea.heights_m if lowest_m < h < highest_m)])
    mean = [[np.interp(heights, sea.heights_m, column) for column in table.T] for table in sea.mean_mps]
    currents = np.moveaxis(np.array(mean), 1, 2).reshape(-1, 3)
    tide = np.array([*sea.tide[:2], 0.0])
    return np.unique(np.concatenate([currents + tide, currents - tide]), axis=0)


@kernel
def flow_at(sea, time_s, position):
    """Returns the flow (5, 3) at a time and a position (3,) in the world.

    Its rows are velocity [m/s], rate of change of the velocity at this position [m/s2], and the gradient: the changes
    of each component of the velocity along x, y, z [1/s].
    """
    flow = np.zeros((5, 3))
    _add_mean(sea, time_s, position[2], flow)
    if sea.tide[0] != 0.0 or sea.tide[1] != 0.0:
        angle = sea.tide[2] * time_s + sea.tide[3]
        for i in range(2):
            flow[0, i] += sea.tide[i] * math.cos(angle)
            flow[1, i] -= sea.tide[i] * sea.tide[2] * math.sin(angle)
    add_gusts(sea.gusts_mps, time_s, flow)
    add_single_gusts(sea.single_gusts, time_s, flow)
    add_waves(sea.waves, time_s, position, flow)
    return flow


@kernel
def _add_mean(sea, time_s, height_m, flow):
    t, in_time, interval_s = _place(sea.times_s, time_s)
    h, in_height, spacing_m = _place(sea.heights_m, height_m)
    later, above = min(t + 1, len(sea.times_s) - 1), min(h + 1, len(sea.heights_m) - 1)
    for i in range(3):
        low = sea.mean_mps[t, h, i] + in_time * (sea.mean_mps[later, h, i] - sea.mean_mps[t, h, i])
        high = sea.mean_mps[t, above, i] + in_time * (sea.mean_mps[later, above, i] - sea.mean_mps[t, above, i])
        flow[0, i] += low + in_height * (high - low)
        if spacing_m > 0.0:
            flow[2 + i, 2] += (high - low) / spacing_m
        if interval_s > 0.0:
            before = sea.mean_mps[t, h, i] + in_height * (sea.mean_mps[t, above, i] - sea.mean_mps[t, h, i])
            after = sea.mean_mps[later, h, i] + in_height * (sea.mean_mps[later, above, i] - sea.mean_mps[later, h, i])
            flow[1, i] += (after - before) / interval_s


@kernel
def _place(nodes, value):
    """Returns the node (index) before a value, its share of the interval, and the interval; 0 beyond the nodes."""
    if not value > nodes[0]:  # also NaN, of a diverged pose
        return 0, 0.0, 0.0
    if value >= nodes[-1]:
        return len(nodes) - 1, 0.0, 0.0
    k = np.searchsorted(nodes, value, side="right") - 1
    return k, (value - nodes[k]) / (nodes[k + 1] - nodes[k]), nodes[k + 1] - nodes[k]
