"""Built-in shapes of reef organisms: corals, sponge, sea star and kelp; their largest extent is about 1.

Each function makes a mesh from the albedo (3,) for R, G, B and a random generator.
"""

from __future__ import annotations

import numpy as np

from twin.terrains.objects.coloured_mesh import Mesh, joined, mesh_of
from twin.terrains.objects.primitives import Array, mottled, noise, quad_faces, resampled, sphere, tube, turned


def brain_coral(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a brain coral: a flattened ball with meandering ridges, brighter than the grooves between them."""
    ball, faces = sphere()
    bumps = 1 + 0.05 * noise(ball, 1.2, 2, rng)
    meander = np.tanh(2.5 * np.sin(4.0 * noise(ball, 0.55, 2, rng, gain=0.3)))
    points = ball * (bumps + 0.02 * meander)[:, None] * [0.5, 0.5, 0.38]
    colour = albedo * (0.8 + 0.35 * meander)[:, None]
    return mesh_of(points, faces, mottled(colour, points, 0.08, rng))


def branching_coral(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a branching coral: a thicket of branches that fork and taper, brighter towards the top."""
    parts: list[Mesh] = []
    for angle in rng.uniform(0, 2 * np.pi, 9):
        lean = rng.uniform(0.1, 0.9)
        direction = np.array([lean * np.cos(angle), lean * np.sin(angle), 1.0])
        _branch(parts, np.append(0.05 * direction[:2], 0.0), direction, 0.24, 0.035, albedo, rng)
    return joined(parts)


def _branch(
    parts: list[Mesh], start: Array, direction: Array, length: float, radius: float, albedo: Array,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Adds a branch and the branches that fork from it to `parts`."""
    bend = 0.25 * rng.standard_normal(3)
    share = np.linspace(0, 1, 12)[:, None]
    path = start + length * share * (direction / np.linalg.norm(direction) + bend * share / 2)
    thickness = radius * (1 - 0.35 * share[:, 0])
    thickness[-1] *= 0.6
    points, faces = tube(path, thickness, 10)
    tip = np.clip((points[:, 2:] - 0.25) * 1.5, 0, 0.6)
    parts.append(mesh_of(points, faces, mottled(albedo * (1 - tip) + tip * 0.85, points, 0.12, rng)))
    if length < 0.11:
        return
    for _ in range(int(rng.integers(2, 4))):
        fork = direction / np.linalg.norm(direction) + 0.7 * rng.standard_normal(3)
        fork[2] = max(fork[2], 0.15)
        at = path[int(rng.integers(7, 12))]
        _branch(parts, at, fork, length * rng.uniform(0.6, 0.8), radius * 0.72, albedo, rng)


def table_coral(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a table coral: a thin plate on a stem, which overhangs the floor on all sides."""
    outline = np.array([[0.004, 0.0], [0.11, 0.0], [0.07, 0.12], [0.06, 0.24], [0.20, 0.30], [0.47, 0.325], [0.5, 0.34],
                        [0.47, 0.355], [0.25, 0.345], [0.004, 0.33]])  # fmt: skip
    points, faces = turned(resampled(outline, 110), 128)
    radius = np.hypot(points[:, 0], points[:, 1])
    rim = np.clip(radius / 0.5, 0, 1) ** 3
    around = points * [1, 1, 0] / np.maximum(radius, 1e-9)[:, None]
    points[:, :2] *= (1 + 0.12 * rim * noise(around, 1.3, 4, rng, gain=0.6))[:, None]
    points[:, 2] += 0.012 * noise(points * [1, 1, 0], 0.3, 4, rng) * np.clip(points[:, 2] * 5, 0, 1)
    top = np.clip((points[:, 2] - 0.33) * 40, 0, 1)
    points[:, 2] += 0.012 * top * np.abs(noise(points, 0.06, 2, rng))  # branchlets
    edge = np.clip((rim - 0.75) * 3, 0, 0.5)[:, None]
    colour = albedo * (1 - edge) + 0.8 * edge
    return mesh_of(points, faces, mottled(colour, points, 0.22, rng))


def sponge(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a barrel sponge: hollow, with vertical ribs."""
    outline = np.array([[0.004, 0.0], [0.24, 0.0], [0.36, 0.25], [0.40, 0.5], [0.36, 0.8], [0.27, 0.98], [0.24, 1.0],
                        [0.20, 0.97], [0.24, 0.75], [0.20, 0.35], [0.004, 0.3]])  # fmt: skip
    points, faces = turned(resampled(outline, 110), 128)
    around = np.arctan2(points[:, 1], points[:, 0])
    radius = np.hypot(points[:, 0], points[:, 1])
    outside = np.clip((radius - 0.2) * 10, 0, 1)
    ribs = np.abs(np.sin(11 * around + 1.5 * noise(points, 0.5, 2, rng)))
    grown = 1 + outside * (0.07 * ribs - 0.04) + 0.05 * noise(points, 0.8, 3, rng)
    points[:, :2] *= grown[:, None]
    colour = albedo * (0.65 + 0.45 * ribs)[:, None]
    return mesh_of(points, faces, mottled(colour, points, 0.15, rng))


def sea_star(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a sea star with five arms, flat on the floor."""
    ball, faces = sphere()
    around = np.arctan2(ball[:, 1], ball[:, 0])
    arms = 0.16 + 0.34 * np.abs(np.cos(2.5 * around)) ** 2.2
    level = np.hypot(ball[:, 0], ball[:, 1])
    points = np.stack([ball[:, 0] * arms, ball[:, 1] * arms, 0.075 * ball[:, 2]], axis=1)
    points[:, 2] *= 1 - 0.5 * level + 0.05 * noise(points, 0.08, 2, rng)
    ridge = np.exp(-((np.sin(2.5 * around) * level / 0.25) ** 2))
    return mesh_of(points, faces, mottled(albedo * (0.75 + 0.45 * ridge)[:, None], points, 0.2, rng))


def kelp(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a kelp plant with a height of about 1: ribbons with wavy edges that rise from a common base."""
    return joined([_blade(angle, albedo, rng) for angle in rng.uniform(0, 2 * np.pi, 12)])


def _blade(angle: float, albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns one ribbon of kelp, a sheet that is seen from both sides."""
    length, width = rng.uniform(0.55, 1.0), rng.uniform(0.03, 0.05)
    n_along, n_across = 72, 7
    share, side = np.meshgrid(np.linspace(0, 1, n_along), np.linspace(-1, 1, n_across), indexing="ij")
    half = width * np.clip(np.minimum(share * 12, (1 - share) * 5), 0.08, 1)
    out = 0.02 + 0.16 * share**1.5 * rng.uniform(0.4, 1.4)
    ruffle = 0.02 * side**2 * np.sin(2 * np.pi * 9 * share + rng.uniform(0, 6)) * side
    x, y, z = out + ruffle, half * side, length * share
    c, s = np.cos(angle), np.sin(angle)
    points = np.stack([c * x - s * y, s * x + c * y, z], axis=-1).reshape(-1, 3)
    node = np.arange(n_along * n_across).reshape(n_along, n_across)
    a, b, d, e = node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]
    faces = quad_faces(a, b, d, e)
    midrib = np.exp(-((side.ravel() / 0.3) ** 2))
    return mesh_of(points, faces, mottled(albedo * (1 - 0.35 * midrib)[:, None], points, 0.15, rng))
