"""Light of the lamps in the water: unscattered, scattered any number of times by small angles, or once by any angle.

A lamp of intensity I(theta) causes, at the distance d on a plane perpendicular to its light, the illuminance

    (I(theta) exp(-c d) + S(theta, d)) / d^2,

with c the attenuation and S = exp(-a d) times the beam convolved with the kernel of `spread.lamp_mixture`; S is 0 with
single scattering. Light that floor and water send back and shadows in scattered light are neglected.
"""

from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.imaging.light.lamps import LightSources, beam_share
from twin.imaging.light.phase_function import BandWater
from twin.imaging.light.shading import RANGE_SCALE_M
from twin.imaging.light.spread import LAMP_SIGMA_RAD, NODES_M, Receiver, lamp_mixture, over_path, ring_shares
from twin.imaging.light.water import Medium
from twin.kernels import kernel

Beam: TypeAlias = tuple[tuple[float, ...], ...]

LAMP_RADIUS_M = 0.03  # shortest distance to a lamp: the radius of its housing
ANGLE_STEPS, SOFT_STEPS = 256, 64  # steps of sqrt(1 - cos(angle)) from 0 to 1, for all light and for scattered light
PATH_STEPS = 96  # number of steps of d / (d + RANGE_SCALE_M) from 0 to 1
RINGS, AZIMUTHS = 120, 24  # rings around the straight path, and directions on one half of each ring


class LampLight:
    """Light of the lamps on particles in the water, in the axes of one camera."""

    def __init__(self, sources: LightSources, water: Medium):
        self.sources, self.water = sources, water
        soft = water.scatters_repeatedly
        self._tables = [_light(beam, water, "particle")[1] for beam in sources.beam] if soft else None

    def lux(self, lamp: int, points: Array) -> tuple[Array, Array]:
        """Returns the light (..., 3) of a lamp on particles for R, G, B [lx], and unit directions (..., 3) from it.

        It is the illuminance of a plane that faces the lamp; scattered light counts equally from all directions. Below
        the distance `LAMP_RADIUS_M` the light is that at this distance, and the directions are shorter than 1.
        """
        sources, position, axis = self.sources, self.sources.position_m[lamp], self.sources.axis[lamp]
        strength = sources.intensity_cd[lamp] * sources.colour[lamp]
        if self._tables is not None:
            points = np.ascontiguousarray(points, np.float64)
            lux, from_lamp = np.empty_like(points), np.empty_like(points)
            flat = points.reshape(-1, 3), position, axis, strength, self._tables[lamp]
            _from_table(*flat, lux.reshape(-1, 3), from_lamp.reshape(-1, 3))
            return lux, from_lamp
        from_lamp = points - position
        distance = np.maximum(np.linalg.norm(from_lamp, axis=-1), LAMP_RADIUS_M)[..., None]
        from_lamp /= distance
        share = beam_share(from_lamp @ axis, sources.beam[lamp])[..., None]
        return share * np.exp(-self.water.attenuation_per_m * distance) / distance**2 * strength, from_lamp


def floor_tables(sources: LightSources, water: Medium) -> NDArray[np.float32]:
    """Returns the light of each lamp on a floor (lamps, 2, n, m, 4), relative to `LightSources.intensity_cd`.

    Axes: lamp; scattered light S, then all light, I exp(-c d) + S; even steps of sqrt(1 - cos(angle)) and of d / (d +
    RANGE_SCALE_M), each from 0 to 1; R, G, B, 0. Empty in water without multiple scattering, and without lamps.
    """
    if not (water.scatters_repeatedly and len(sources.beam)):
        return np.zeros((0, 2, 0, 0, 4), np.float32)
    return with_a_zero(np.array([_light(beam, water, "floor") for beam in sources.beam]))


def with_a_zero(table: Array) -> NDArray[np.float32]:
    """Returns a table (..., 3) of R, G, B padded with a zero to (..., 4), so that an entry lies in one cache line."""
    return np.concatenate([table, np.zeros((*table.shape[:-1], 1))], axis=-1).astype(np.float32)


def _light(beam: Array, water: Medium, receiver: Receiver) -> tuple[Array, Array]:
    """Returns S and I exp(-c d) + S, the scattered light and all light of a lamp, relative to its `intensity_cd`."""
    at = np.linspace(0, SOFT_STEPS, ANGLE_STEPS + 1)
    low = np.minimum(at.astype(int), SOFT_STEPS - 1)
    coarse = _softened(tuple(map(tuple, beam.tolist())), water.bands, receiver)
    soft = coarse[low] + (at - low)[:, None, None] * (coarse[low + 1] - coarse[low])
    share, every = beam_share(1 - np.linspace(0.0, 1.0, ANGLE_STEPS + 1) ** 2, beam), soft.copy()
    every[:, :-1] += share[:, None, None] * np.exp(-water.attenuation_per_m * _path_m()[:, None])
    return soft, every


@lru_cache(maxsize=64)
def _softened(beam: Beam, bands: tuple[BandWater, ...], receiver: Receiver) -> Array:
    """Returns the scattered light S (SOFT_STEPS + 1, PATH_STEPS + 1, 3) of a lamp; the arguments are hashable."""
    rings, path_m = _on_rings(beam), _path_m()
    out = np.zeros((SOFT_STEPS + 1, PATH_STEPS + 1, 3))
    for k, band in enumerate(bands):
        if band.scattering_per_m:
            share = rings @ lamp_mixture(band, NODES_M, receiver).T
            out[:, :-1, k] = over_path(share, band.scattering_per_m, path_m)
            out[:, :-1, k] *= np.exp(-band.absorption_per_m * path_m)
    return out


def _path_m() -> Array:
    """Returns the distances (PATH_STEPS,) of the tables [m], without the last, which is infinite."""
    x = np.linspace(0.0, 1.0, PATH_STEPS + 1)[:-1]
    return RANGE_SCALE_M * x / (1 - x)


@lru_cache(maxsize=64)
def _on_rings(beam: Beam) -> Array:
    """Returns the means (SOFT_STEPS + 1, m) of a beam around each of n directions, weighted by each of m Gaussians."""
    edges = np.concatenate([[0.0], np.geomspace(1e-3, np.pi, RINGS)])
    cosine = 1 - np.linspace(0.0, 1.0, SOFT_STEPS + 1)[:, None, None] ** 2
    azimuth = (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS * np.pi
    ring = ((edges[1:] + edges[:-1]) / 2)[:, None]
    along = cosine * np.cos(ring) + np.sqrt(1 - cosine**2) * np.sin(ring) * np.cos(azimuth)
    mean = beam_share(along, np.array(beam)).mean(-1)
    return mean @ ring_shares(edges, LAMP_SIGMA_RAD)


@kernel(error_model="numpy", fastmath={"arcp", "contract"})
def _from_table(points, position, axis, strength, table, lux, from_lamp):
    rows, cols = table.shape[0] - 1, table.shape[1] - 1
    for k in range(points.shape[0]):
        x, y, z = points[k, 0] - position[0], points[k, 1] - position[1], points[k, 2] - position[2]
        d = max(np.sqrt(x * x + y * y + z * z), LAMP_RADIUS_M)
        from_lamp[k, 0], from_lamp[k, 1], from_lamp[k, 2] = x / d, y / d, z / d
        cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / d
        if cosine <= 0:
            lux[k, 0], lux[k, 1], lux[k, 2] = 0.0, 0.0, 0.0
            continue
        row, col = np.sqrt(max(1 - cosine, 0.0)) * rows, d / (d + RANGE_SCALE_M) * cols
        i, j = min(int(row), rows - 1), min(int(col), cols - 1)
        u, v = row - i, col - j
        for c in range(3):
            near = table[i, j, c] + u * (table[i + 1, j, c] - table[i, j, c])
            far = table[i, j + 1, c] + u * (table[i + 1, j + 1, c] - table[i, j + 1, c])
            lux[k, c] = strength[c] * (near + v * (far - near)) / (d * d)
