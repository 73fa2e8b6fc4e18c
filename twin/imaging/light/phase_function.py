"""Phase functions of sea water: the share of scattered light per unit of solid angle [1/sr], which integrates to 1."""

from collections.abc import Callable
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from twin.core.geometry import Array

CELLS = 4096  # number of cells of a table
_GAUSS = np.polynomial.legendre.leggauss(6)
MOLECULAR_PER_M, MOLECULAR_NM, MOLECULAR_EXPONENT = 0.00288, 500.0, 4.32  # see `molecular_scattering_per_m`

#: Phase function of Petzold's average particle: angle [deg], density [1/sr]. Mean of the volume scattering functions
#: that Petzold (1972, SIO Ref. 72-78) measured in San Diego Harbor (NUC 2200, 2040, 2240), each without the share of
#: the water molecules and divided by its scattering coefficient, as defined by Mobley et al. (1993, Appl. Opt. 32,
#: 7484). At smaller angles the report extends the first values as a power of the angle.
PETZOLD = (
    (0.1, 1.7782e3), (0.1259, 1.3039e3), (0.1585, 9.5648e2), (0.1995, 7.0369e2), (0.2512, 5.1705e2),
    (0.3162, 3.7882e2), (0.3981, 2.7819e2), (0.5012, 2.0247e2), (0.631, 1.4533e2), (0.7943, 1.0293e2),
    (1.0, 7.2081e1), (1.2589, 4.9910e1), (1.5849, 3.4173e1), (1.9953, 2.2958e1), (2.5119, 1.5258e1),
    (3.1623, 1.0083e1), (3.9811, 6.6236e0), (5.0119, 4.3250e0), (6.3096, 2.8256e0), (7.9433, 1.8309e0),
    (10.0, 1.1602e0), (15.0, 4.9259e-1), (20.0, 2.4597e-1), (25.0, 1.4808e-1), (30.0, 8.6626e-2),
    (35.0, 5.9681e-2), (40.0, 4.2354e-2), (45.0, 3.0854e-2), (50.0, 2.2893e-2), (55.0, 1.7089e-2),
    (60.0, 1.3202e-2), (65.0, 1.0515e-2), (70.0, 8.5297e-3), (75.0, 7.0078e-3), (80.0, 5.8677e-3),
    (85.0, 4.9724e-3), (90.0, 4.3079e-3), (95.0, 3.7935e-3), (100.0, 3.4136e-3), (105.0, 3.1222e-3),
    (110.0, 2.9172e-3), (115.0, 2.8005e-3), (120.0, 2.6878e-3), (125.0, 2.5721e-3), (130.0, 2.4749e-3),
    (135.0, 2.3743e-3), (140.0, 2.3253e-3), (145.0, 2.3082e-3), (150.0, 2.3589e-3), (155.0, 2.5006e-3),
    (160.0, 2.6568e-3), (165.0, 2.8302e-3), (170.0, 3.0275e-3), (175.0, 3.0885e-3), (180.0, 3.1509e-3),
)  # fmt: skip
#: Integral of these values over the sphere with log-log interpolation; Petzold's own rule of integration gives 1.
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
    """Returns the phase function of Petzold's average particle [1/sr]: log-log interpolation of the table `PETZOLD`."""
    log_angle, log_density = np.log(np.deg2rad([row[0] for row in PETZOLD])), np.log([row[1] for row in PETZOLD])
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
    table = _densities(scatterers)
    at = np.sqrt(np.sqrt(np.maximum((1 - cosine) / 2, 0.0))) * CELLS - 0.5
    at = np.clip(at, 0.0, CELLS - 1.001)
    cell = at.astype(np.intp)
    low = table[cell]
    return low + (at - cell)[..., None] * (table[cell + 1] - low)


@lru_cache(maxsize=64)
def _densities(scatterers: tuple[Scatterer, ...]) -> Array:
    return np.stack([table_of(scatterer).density_per_sr for scatterer in scatterers], axis=-1)
