"""Phase functions of sea water: the share of scattered light per unit of solid angle [1/sr], which integrates to 1."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel

CELLS = 4096  # number of cells of a table
_GAUSS = np.polynomial.legendre.leggauss(6)
MOLECULAR_PER_M, MOLECULAR_NM, MOLECULAR_EXPONENT = 0.00288, 500.0, 4.32  # see `molecular_scattering_per_m`

#: Integral of `petzold.csv` over the sphere with log-log interpolation; Petzold's own rule of integration gives 1.
PETZOLD_INTEGRAL = 0.997385


class PhaseTable(NamedTuple):
    """A phase function, constant in n cells of equal width in ((1 - cos(angle)) / 2)^(1/4), narrow where steep."""

    density_per_sr: Array  # (n,) mean of the phase function over each cell
    cumulative: Array  # (n + 1,) share of the scattered light whose scattering angle is below each cell boundary
    cumulative_angle: Array  # (n + 1,) integral of density times angle up to each boundary, divided by `angle_integral`
    angle_integral: float  # integral of density times angle from 0 to pi [rad^2/sr]
    beyond: Array  # (n + 1,) integral of the density over the angle, from each cell boundary to pi [rad/sr]


ParticleFunction = Literal["petzold", "fournier_forand", "henyey_greenstein"]


class Scatterer(NamedTuple):
    """Molecules and particles that scatter the light of one band."""

    particles: ParticleFunction = "petzold"  # phase function of the particles
    molecular_share: float = 0.0  # share of the molecules in the scattering coefficient
    # those of the phase function: index and slope (Fournier-Forand), mean cosine (Henyey-Greenstein)
    parameters: tuple[float, ...] = ()


class BandWater(NamedTuple):
    """Optical properties of the water in one colour band."""

    absorption_per_m: float  # absorption coefficient a [1/m]
    scattering_per_m: float  # scattering coefficient b [1/m]
    scatterer: Scatterer = Scatterer()  # molecules and particles that scatter the light


def molecular(angle: Array) -> Array:
    """Returns the phase function of pure sea water [1/sr] (Morel 1974; Mobley 1994, eq. 3.30)."""
    return 3 / (4 * np.pi * (3 + 0.835)) * (1 + 0.835 * np.cos(angle) ** 2)


def molecular_scattering_per_m(wavelength_nm: Array) -> Array:
    """Returns the scattering coefficient of pure sea water [1/m]: 0.00288 (wavelength / 500 nm)^-4.32 (Morel 1974)."""
    return MOLECULAR_PER_M * (np.asarray(wavelength_nm, float) / MOLECULAR_NM) ** -MOLECULAR_EXPONENT


def petzold(angle: Array) -> Array:
    """Returns the phase function of Petzold's average particle [1/sr]: log-log interpolation of `petzold.csv`."""
    degrees, density = np.loadtxt(Path(__file__).parent / "petzold.csv", delimiter=",", unpack=True)
    log_angle, log_density = np.log(np.deg2rad(degrees)), np.log(density)
    wanted = np.log(np.maximum(angle, 1e-12))
    slope = (log_density[1] - log_density[0]) / (log_angle[1] - log_angle[0])
    below = np.minimum(wanted - log_angle[0], 0.0) * slope
    return np.exp(np.interp(wanted, log_angle, log_density) + below) / PETZOLD_INTEGRAL


def henyey_greenstein(angle: Array, mean_cosine: float) -> Array:
    """Returns the phase function of Henyey & Greenstein (1941) with the mean cosine g, -1 < g < 1."""
    g = mean_cosine
    # (1 - g)^2 + 4 g sin^2(angle / 2) is 1 + g^2 - 2 g cos(angle) without cancellation
    return (1 - g**2) / (4 * np.pi * ((1 - g) ** 2 + 4 * g * np.sin(angle / 2) ** 2) ** 1.5)


def fournier_forand(angle: Array, index: float, slope: float) -> Array:
    """Returns the phase function of Fournier & Forand (1994), in the form of Mobley et al. (2002, Appl. Opt. 41, 1035).

    `index` of the particles relative to water is above 1, `slope` of the size distribution from 3 to 5.
    """
    nu, end = (3 - slope) / 2, np.asarray(4 / (3 * (index - 1) ** 2))
    sine2 = np.maximum(np.sin(angle / 2) ** 2, 1e-16)
    d = end * sine2
    d = np.where(np.abs(d - 1) < 1e-4, 1 + 1e-4, d)  # the formula is 0/0 at d = 1, where p is smooth
    power = d**nu
    forward = nu * (1 - d) - (1 - power) + (d * (1 - power) - nu * (1 - d)) / sine2
    backward = (1 - end**nu) / (16 * np.pi * (end - 1) * end**nu) * (3 * np.cos(angle) ** 2 - 1)
    return forward / (4 * np.pi * (1 - d) ** 2 * power) + backward


_OF_PARTICLES: dict[ParticleFunction, Callable[..., Array]] = {
    "petzold": petzold, "fournier_forand": fournier_forand, "henyey_greenstein": henyey_greenstein
}  # fmt: skip


def phase_of(scatterer: Scatterer, angle: Array) -> Array:
    """Returns the phase function [1/sr] of molecules and particles at scattering angles of any shape [rad]."""
    share, particles = scatterer.molecular_share, _OF_PARTICLES[scatterer.particles]
    return share * molecular(angle) + (1 - share) * particles(angle, *scatterer.parameters)


@lru_cache(maxsize=64)
def table_of(scatterer: Scatterer) -> PhaseTable:
    """Returns the table of a phase function, normalised to an integral of 1 over the sphere."""
    edges = np.linspace(0.0, 1.0, CELLS + 1)
    angle = 2 * np.arcsin(edges**2)
    middle, half = (edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2
    x = middle[:, None] + half[:, None] * _GAUSS[0]
    light = phase_of(scatterer, 2 * np.arcsin(x**2)) * 16 * np.pi * x**3  # d(solid angle) = 16 pi x^3 dx
    share = (light * _GAUSS[1]).sum(1) * half
    share /= share.sum()
    density = share / (4 * np.pi * np.diff(edges**4))
    cumulative = np.concatenate([[0.0], np.cumsum(share)])
    weighted = np.concatenate([[0.0], np.cumsum(density * np.diff(angle**2) / 2)])
    beyond = np.concatenate([np.cumsum((density * np.diff(angle))[::-1])[::-1], [0.0]])
    return PhaseTable(density, cumulative / cumulative[-1], weighted / weighted[-1], float(weighted[-1]), beyond)


def phase_at(scatterers: tuple[Scatterer, ...], cosine: Array) -> Array:
    """Returns the phase function (..., n) [1/sr] of n scatterers at cosines (...), by interpolation of the tables."""
    found = _interpolated(_densities(scatterers), np.ravel(cosine))
    return found.reshape(*cosine.shape, found.shape[1])


@kernel
def _interpolated(table, cosine):
    found = np.empty((cosine.size, table.shape[1]))
    for i in range(cosine.size):
        at = np.sqrt(np.sqrt(max((1 - cosine[i]) / 2, 0.0))) * CELLS - 0.5
        at = min(max(at, 0.0), CELLS - 1.001)
        cell = int(max(0.0, at))  # also of NaN, which gives NaN
        for k in range(table.shape[1]):
            found[i, k] = table[cell, k] + (at - cell) * (table[cell + 1, k] - table[cell, k])
    return found


@lru_cache(maxsize=64)
def _densities(scatterers: tuple[Scatterer, ...]) -> Array:
    return np.stack([table_of(scatterer).density_per_sr for scatterer in scatterers], axis=-1)
