"""Motion of the water at any time and place: mean current, tide, gusts and waves.

Gusts are a Gauss-Markov process with the covariance sigma^2 exp(-|t| / T), the same for any timestep of the physics;
single gusts, of faults, have a known start, end and velocity.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel
from twin.scenario.model import CurrentConfig, Scenario
from twin.simulate.current_file import read_current
from twin.simulate.waves import CALM, Waves, add_waves, wave_components

#: Heights between which a profile of the current is interpolated [m].
_PROFILE_M = np.geomspace(0.01, 500.0, 200)
GUST_INTERVAL_S = 0.1  #: time between the values of a series [s]
_REPEAT = 60  # the series repeats after this multiple of the correlation time, or after an hour if that is longer
_HOUR_S = 3600.0
GUST_RISE_S = 1.0  # in which a single gust rises, and falls
_VERTICAL = 0.5  # default ratio of the standard deviations, vertical to horizontal: about 1.2 u* to 2.3 u*


class Sea(NamedTuple):
    """Motion of the water as a function of time and place, for compiled code."""

    times_s: Array  #: (t,) of `mean_mps`, increasing
    heights_m: Array  #: (h,) of `mean_mps`, above the reference plane, increasing
    mean_mps: Array  #: (t, h, 3) mean current, interpolated linearly, constant beyond the first and the last
    tide: Array  #: (4,) amplitude to east and north [m/s], angular frequency [rad/s], phase [rad]
    gusts_mps: Array  #: (n, 3) `gust_series`
    waves: Waves
    single_gusts: Array  #: (k, 5) `single_gusts`; its rows are set when they start


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


def mean_current_mps(sea: Sea, height_m: float, time_s: float = 0.0) -> Array:
    """Returns the current (3,) at a height and a time, without gusts and waves."""
    calm, position = sea._replace(gusts_mps=np.zeros((0, 3)), waves=CALM), np.array([0.0, 0.0, height_m])
    return flow_at(calm, time_s, position)[0].copy()


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


def gust_series(current: CurrentConfig, rng: np.random.Generator | None) -> Array:
    """Returns velocities (n, 3) of the gusts [m/s] every `GUST_INTERVAL_S`, periodic; (0, 3) without gusts."""
    # The covariance of the values is exact: the circulant matrix of the covariances of the period has the eigenvalues
    # with which white noise is weighted (Davies & Harte 1987, Biometrika 74, 95).
    if rng is None or not (current.gust_mps or current.gust_vertical_mps):
        return np.zeros((0, 3))
    vertical = current.gust_vertical_mps
    sigma = np.array([1.0, 1.0, _VERTICAL]) * current.gust_mps
    if vertical is not None:
        sigma[2] = vertical
    n = 2 * round(max(_HOUR_S, _REPEAT * current.gust_time_s) / GUST_INTERVAL_S / 2)
    lag_s = GUST_INTERVAL_S * np.minimum(np.arange(n), n - np.arange(n))
    power = np.maximum(np.fft.rfft(np.exp(-lag_s / current.gust_time_s)).real, 0.0)
    white = np.fft.rfft(rng.standard_normal((n, 3)), axis=0)
    return np.ascontiguousarray(sigma * np.fft.irfft(white * np.sqrt(power)[:, None], n, axis=0))


@kernel
def add_gusts(series, time_s, flow):
    """Adds a `gust_series` at a time to a flow (5, 3) (`flow_at`), by a cubic with a continuous rate (Catmull-Rom)."""
    # so that the physics converges with the square of its timestep
    n = len(series)
    if n == 0:
        return
    k = int(time_s / GUST_INTERVAL_S)
    s = time_s / GUST_INTERVAL_S - k
    for i in range(3):
        a, b, c, d = series[(k - 1) % n, i], series[k % n, i], series[(k + 1) % n, i], series[(k + 2) % n, i]
        linear, square, cube = c - a, 2 * a - 5 * b + 4 * c - d, 3 * (b - c) + d - a
        flow[0, i] += b + 0.5 * s * (linear + s * (square + s * cube))
        flow[1, i] += 0.5 * (linear + s * (2 * square + 3 * s * cube)) / GUST_INTERVAL_S


def single_gusts(n: int) -> Array:
    """Returns n gusts that have not begun: rows (n, 5) of start, end [s] and velocity to east, north and up [m/s]."""
    return np.tile([np.inf, np.inf, 0.0, 0.0, 0.0], (n, 1))


@kernel
def add_single_gusts(gusts, time_s, flow):
    """Adds `single_gusts` at a time to a flow (5, 3), see `flow_at`; they rise and fall with a continuous rate."""
    for start_s, end_s, east, north, up in gusts:
        for sign, since_s in ((1.0, time_s - start_s), (-1.0, time_s - end_s)):
            if since_s <= 0.0:
                continue
            share = min(1.0, since_s / GUST_RISE_S)
            velocity = sign * share * share * (3 - 2 * share)
            rate = sign * 6 * share * (1 - share) / GUST_RISE_S
            for i, mps in enumerate((east, north, up)):
                flow[0, i] += velocity * mps
                flow[1, i] += rate * mps
