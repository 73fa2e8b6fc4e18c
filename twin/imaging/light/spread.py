"""Multiple scattering of light near its straight path, as mixtures of Gaussians: the spread of a beam, and of an image.

In small-angle theory (Wells 1969; 1973, AGARD Lecture Series 61), the light of a lamp at the distance d is the beam
convolved, in the angle at the lamp, with a kernel of the Hankel transform

    exp(-a d - b d (1 - K(k))),

K being that of light scattered once, per b d; the kernel of an image is that of the reversed path. Here K is exact for
single scattering at any angle: with the scattering angle t = alpha + beta, alpha at the point and beta at the lamp,

    k1(beta) = integral over t > beta of p(t) g(t - beta) exp(-a d (path / d - 1)),  per d(beta) d(azimuth),

with path / d = (sin(alpha) + sin(beta)) / sin(t), and g(alpha) the cosine for a floor, 1 for a particle. For a camera
at the range r, a ray scattered by t at u r meets the floor at tan(beta) = (1 - u) tan(t), with the weight p(t) sin(t)
and absorption on the excess path.
"""

from functools import cache, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import j1

from twin.core.geometry import Array
from twin.imaging.light.phase_function import BandWater, Scatterer, phase_at

#: Receiver of lamp light: a floor, whose response is the cosine, or a particle, whose response is 1 in all directions.
Receiver = Literal["floor", "particle"]

ANGLES = 140  # number of cells of the scattering angle, even in its logarithm
LEAST_RAD, MOST_TAN = 1e-5, 20.0  # outer edge of the innermost ring; that of a camera's outermost ring, as a tangent
_MOST_TURNED = np.pi / 2 * 0.999  # largest scattering angle of a ray of the camera
STEPS = 24  # number of positions of a scattering along a ray of the camera
MAX_GROWTH = 1.0  # upper limit of b d (K - 1), the logarithm of the transform relative to exp(-a d)
WEIGHT_OF_TOTAL = 10.0  # weight of the integral of the kernel in the fit of a mixture
#: Lengths of the path at which kernels are computed [m]; between them, values per scattered light are interpolated.
NODES_M = tuple(np.geomspace(0.05, 30.0, 22).tolist())
#: Standard deviations of the Gaussians of the kernel of a lamp [rad].
LAMP_SIGMA_RAD = 2.0 ** np.arange(-12.0, 0.5)


@lru_cache(maxsize=64)  # limited, as the surveys of a study may have many waters
def lamp_mixture(water: BandWater, distances_m: tuple[float, ...], receiver: Receiver) -> Array:
    """Returns a lamp's kernel, relative to exp(-a d): weights (n, m) of Gaussians of `LAMP_SIGMA_RAD`."""
    once = _lamp_rings(water, distances_m)[0 if receiver == "floor" else 1]
    return _mixtures(once, _rings(np.pi), water.scattering_per_m * np.array(distances_m), LAMP_SIGMA_RAD)


@lru_cache(maxsize=64)
def camera_mixture(water: BandWater, ranges_m: tuple[float, ...], sigmas: tuple[float, ...]) -> Array:
    """Returns a camera's kernel, relative to exp(-a r): weights (n, m) of Gaussians of given tangents; 0 = no blur."""
    once = np.array([_camera_rings(water, r) for r in ranges_m])
    return _mixtures(once, _rings(MOST_TAN), water.scattering_per_m * np.array(ranges_m), np.array(sigmas))


def ring_shares(edges: Array, sigmas: Array) -> Array:
    """Returns the share (n, m) of m normalised Gaussians in each of n rings with edges (n + 1,)."""
    beyond = np.exp(-(edges[:, None] ** 2) / (2 * sigmas**2))
    return beyond[:-1] - beyond[1:]


def over_path(share: Array, scattering_per_m: float, path_m: Array) -> Array:
    """Returns values (..., m) at path lengths (m,) [m], from `share` (..., nodes) of 1 - exp(-b d) at `NODES_M`."""
    of_scattered = share / -np.expm1(-scattering_per_m * np.array(NODES_M))
    at = np.interp(np.log(np.maximum(path_m, 1e-9)), np.log(NODES_M), np.arange(len(NODES_M)))
    low = np.minimum(at.astype(int), len(NODES_M) - 2)
    part = at - low
    found = of_scattered[..., low] * (1 - part) + of_scattered[..., low + 1] * part
    return found * -np.expm1(-scattering_per_m * path_m)


@cache
def _rings(most: float) -> Array:
    """Returns the edges (ANGLES + 1,) of rings: 0, then values up to `most` with a constant ratio."""
    return np.concatenate([[0.0], np.geomspace(LEAST_RAD, most, ANGLES)])


def _middle(edges: Array) -> Array:
    """Returns the middle of each ring: the geometric mean of its edges; for the innermost ring, half its outer edge."""
    return np.concatenate([[edges[1] / 2], np.sqrt(edges[1:-1] * edges[2:])])


@lru_cache(maxsize=64)
def _phase_on_rings(scatterer: Scatterer, most: float) -> Array:
    """Returns the phase function (ANGLES,) in the middle of each of the rings of `_rings`."""
    return phase_at((scatterer,), np.cos(_middle(_rings(most))))[:, 0]


@cache
def _lamp_geometry() -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
    """Returns the n cells of angle beta at the lamp and scattering angle t above it, sorted by beta, then t."""
    # number (n,) of the ring of t, first cell (ANGLES,) of each beta, response of floor and particle times the part of
    # the cell of beta below t (2, n), and path / d - 1 (n,)
    edges = _rings(np.pi)
    t, beta = _middle(edges), edges[:-1, None]
    inside = np.clip(t - beta, 0.0, np.diff(edges)[:, None])  # the part of each cell of beta that is below t
    beta = np.minimum(beta + inside / 2, t)
    excess = (np.sin(beta) + np.sin(t - beta)) / np.maximum(np.sin(t), 1e-12) - 1
    below, response = inside > 0, np.stack([np.maximum(np.cos(t - beta), 0.0), np.ones_like(beta)])
    first = np.append(0, np.cumsum(below.sum(1))[:-1])
    return np.nonzero(below)[1], first, (response * inside)[:, below], np.maximum(excess, 0.0)[below]


@lru_cache(maxsize=8)
def _lamp_rings(water: BandWater, distances_m: tuple[float, ...]) -> Array:
    """Returns the light (2, n, ANGLES) scattered once in rings of the angle at the lamp, divided by b d exp(-a d)."""
    ring, first, width, excess = _lamp_geometry()  # of floor and particle
    density = 2 * np.pi * _phase_on_rings(water.scatterer, np.pi) * np.diff(_rings(np.pi))
    passed = np.exp(-water.absorption_per_m * np.array(distances_m)[:, None] * excess)
    return np.array([np.add.reduceat(passed * light, first, axis=1) for light in width * density[ring]])


@cache
def _camera_geometry() -> tuple[Array, Array, Array]:
    """Returns the geometry of light that is scattered by the angle t at the fraction u of a ray of the camera."""
    edges = _rings(_MOST_TURNED)
    t = _middle(edges)
    u = (np.arange(STEPS) + 0.5)[:, None] / STEPS
    tangent = (1 - u) * np.tan(t)
    excess = u + (1 - u) / np.cos(t) - np.sqrt(1 + tangent**2)
    ring = np.minimum(np.searchsorted(_rings(MOST_TAN), tangent, side="right") - 1, ANGLES - 1)
    solid = 4 * np.pi * np.diff(np.sin(edges / 2) ** 2)
    return ring, excess, solid


def _camera_rings(water: BandWater, range_m: float) -> Array:
    """Returns the light (ANGLES,) scattered once between floor and camera, divided by b r exp(-a r)."""
    ring, excess, solid = _camera_geometry()
    density = _phase_on_rings(water.scatterer, _MOST_TURNED) * solid
    light = density / STEPS * np.exp(-water.absorption_per_m * range_m * excess)
    return np.asarray(np.bincount(ring.ravel(), light.ravel(), ANGLES), np.float64)


def _mixtures(once: Array, edges: Array, thickness: Array, sigmas: Array) -> Array:
    """Returns the weights (n, m) >= 0 of Gaussians fitted to exp(-t) (exp(t K) - 1), light scattered at least once."""
    least, most = sigmas[sigmas > 0].min(), sigmas.max()
    k = np.concatenate([[0.0], np.geomspace(0.2 / most, 3 / least, 40)])  # frequencies
    transform = once @ _ring_transforms(k, edges).T
    t = thickness[:, None]
    # exp(-t) (exp(t K) - 1); without the limit, light near a lamp would grow without bound in very turbid water
    wanted = np.exp(np.minimum(t * (transform - 1), MAX_GROWTH)) * -np.expm1(-t * transform)
    basis = np.exp(-(k[:, None] ** 2) * sigmas**2 / 2)
    basis[0] *= WEIGHT_OF_TOTAL
    return np.array([_fit(basis, row) for row in wanted])


def _fit(basis: Array, wanted: Array) -> Array:
    total = wanted[0]
    if total <= 0:
        return np.zeros(basis.shape[1])
    rows = wanted / total
    rows[0] *= WEIGHT_OF_TOTAL
    return nnls(basis, rows, maxiter=100 * basis.shape[1])[0] * total


def _ring_transforms(k: Array, edges: Array) -> Array:
    """Returns the Hankel transforms (n, rings) of uniform rings, each with the integral 1."""
    at = np.where(k[:, None] > 0, edges * j1(k[:, None] * edges) / np.maximum(k[:, None], 1e-12), edges**2 / 2)
    return 2 * np.diff(at, axis=1) / np.diff(edges**2)
