"""Surfaces that built-in shapes are made of, and three-dimensional noise for their relief and colour."""

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array

Faces = NDArray[np.int64]
#: Vertices (n, 3) and faces (m, 3), counter-clockwise as seen from outside.
Surface = tuple[Array, Faces]

WAVES = 20  #: plane waves per octave of noise
SPHERE_DIVISIONS = 5  #: times that each of the 20 faces of an icosahedron is divided into four: 20,480 triangles


def sphere() -> Surface:
    """Returns a unit sphere with nearly equal triangles."""
    import trimesh  # imported here: it takes 0.3 s, and most scenarios have no objects

    ball = trimesh.creation.icosphere(subdivisions=SPHERE_DIVISIONS, radius=1.0)
    return np.asarray(ball.vertices, np.float64), np.asarray(ball.faces, np.int64)


def tube(path: Array, radius: Array, n_sides: int) -> Surface:
    """Returns a tube with closed ends along a path (k, 3) without equal consecutive points, with radii (k,)."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.cross(tangent[0], np.eye(3)[np.abs(tangent[0]).argmin()])
    acrosses = np.empty_like(tangent)
    for k, along in enumerate(tangent):
        across = across - along * (across @ along)  # carried along the path without twist
        across /= np.linalg.norm(across)
        acrosses[k] = across
    angle = 2 * np.pi * np.arange(n_sides) / n_sides
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    outwards = cos * acrosses[:, None] + sin * np.cross(tangent, acrosses)[:, None]
    rings = path[:, None] + radius[:, None, None] * outwards
    begin = np.arange(n_sides)
    end, first = begin + (len(path) - 1) * n_sides, np.full(n_sides, len(path) * n_sides)
    caps = [[first, np.roll(begin, -1), begin], [first + 1, end, np.roll(end, -1)]]
    faces = [ring_faces(len(path), n_sides), *(np.stack(cap, axis=1) for cap in caps)]
    return np.concatenate([rings.reshape(-1, 3), path[:1], path[-1:]]), np.concatenate(faces)


def ring_faces(n_rings: int, n_sides: int, closed: bool = False) -> Faces:
    """Returns the triangles (m, 3) between rings of vertices, numbered ring by ring; `closed`: also last to first."""
    ring = np.arange(n_rings * n_sides).reshape(n_rings, n_sides)
    lower, upper = (ring, np.roll(ring, -1, axis=0)) if closed else (ring[:-1], ring[1:])
    return quad_faces(lower, np.roll(lower, -1, axis=1), np.roll(upper, -1, axis=1), upper)


def quad_faces(a: Faces, b: Faces, c: Faces, d: Faces) -> Faces:
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def turned(profile: Array, n_sides: int) -> Surface:
    """Returns a surface of revolution about z of a closed outline (k, 2) of radii and heights, counter-clockwise."""
    angle = 2 * np.pi * np.arange(n_sides) / n_sides
    radius, height = profile[:, :1], profile[:, 1:]
    rings = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.repeat(height, n_sides, axis=1)], axis=-1)
    return rings.reshape(-1, 3), ring_faces(len(profile), n_sides, closed=True)


def resampled(outline: Array, n: int) -> Array:
    closed = np.concatenate([outline, outline[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.arange(n) / n * along[-1]
    return np.stack([np.interp(at, along, closed[:, k]) for k in range(2)], axis=1)


def box(size: tuple[float, float, float], n: tuple[int, int, int]) -> Surface:
    """Returns a box of extents `size` about the origin, its sides divided into `n` cells along x, y, z."""
    parts, faces, count = [], [], 0
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        a, b = np.meshgrid(np.linspace(-0.5, 0.5, n[i] + 1), np.linspace(-0.5, 0.5, n[j] + 1), indexing="ij")
        for end in (-0.5, 0.5):
            points = np.empty((*a.shape, 3))
            points[..., i], points[..., j], points[..., axis] = a * size[i], b * size[j], end * size[axis]
            node = count + np.arange(a.size).reshape(a.shape)
            quads = [node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]]
            faces.append(quad_faces(*(quads if end > 0 else quads[::-1])))
            parts.append(points.reshape(-1, 3))
            count += a.size
    return np.concatenate(parts), np.concatenate(faces)


def noise(points: Array, coarsest: float, octaves: int, rng: np.random.Generator, gain: float = 0.5) -> Array:
    """Returns smooth random values (n,) at points (n, 3), standard deviation about 1: octaves k of gain^k."""
    # Each octave is a sum of plane waves of the wavelength coarsest / 2^k.
    total, power = np.zeros(len(points)), 0.0
    for k in range(octaves):
        waves = rng.standard_normal((WAVES, 3))
        waves *= 2 * np.pi * 2.0**k / coarsest / np.linalg.norm(waves, axis=1, keepdims=True)
        phase = rng.uniform(0, 2 * np.pi, WAVES)
        angle = (points @ waves.T + phase).astype(np.float32)  # the cosine of single precision is three times faster
        total += gain**k * np.sqrt(2 / WAVES) * np.cos(angle).sum(axis=1)
        power += gain ** (2 * k)
    return total / np.sqrt(power)


def mottled(albedo: Array, points: Array, contrast: float, rng: np.random.Generator) -> Array:
    """Returns a random albedo (n, 3) at points (n, 3) with the mean `albedo` and the relative deviation `contrast`."""
    values = 0.7 * noise(points, 0.25, 4, rng, gain=0.8) + 0.7 * rng.standard_normal(len(points))
    return albedo * np.exp(contrast * values - contrast**2 / 2)[:, None]
