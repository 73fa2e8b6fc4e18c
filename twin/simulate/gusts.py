"""Gusts: a Gauss-Markov process with the covariance sigma^2 exp(-|t| / T), the same for any timestep of the physics.

Single gusts, of faults, have a known start, end and velocity.
"""

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel
from twin.scenario.model import CurrentConfig

GUST_INTERVAL_S = 0.1  #: time between the values of a series [s]
_REPEAT = 60  # the series repeats after this multiple of the correlation time, or after an hour if that is longer
_HOUR_S = 3600.0
_RISE_S = 1.0  # in which a single gust rises, and falls
_VERTICAL = 0.5  # default ratio of the standard deviations, vertical to horizontal: about 1.2 u* to 2.3 u*


def gust_series(current: CurrentConfig, rng: np.random.Generator | None) -> Array:
    """Returns velocities (n, 3) of the gusts [m/s] every `GUST_INTERVAL_S`, periodic; (0, 3) without gusts.

    The covariance of the values is exact: the circulant matrix of the covariances of the period has the eigenvalues
    with which white noise is weighted (Davies & Harte 1987, Biometrika 74, 95).
    """
    if rng is None or current.gust_mps == 0:
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
    """Adds the gusts of a `gust_series` at a time to a flow (5, 3), see `sea.flow_at`.

    Between the values they are a cubic with a continuous rate (Catmull-Rom), so that the physics converges with the
    square of its timestep.
    """
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
    """Adds `single_gusts` at a time to a flow (5, 3), see `sea.flow_at`; they rise and fall with a continuous rate."""
    for start_s, end_s, east, north, up in gusts:
        for sign, since_s in ((1.0, time_s - start_s), (-1.0, time_s - end_s)):
            if since_s <= 0.0:
                continue
            share = min(1.0, since_s / _RISE_S)
            velocity = sign * share * share * (3 - 2 * share)
            rate = sign * 6 * share * (1 - share) / _RISE_S
            for i, mps in enumerate((east, north, up)):
                flow[0, i] += velocity * mps
                flow[1, i] += rate * mps
