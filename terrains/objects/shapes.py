"""Built-in shapes, about 1 in extent, made from the albedo (3,) for R, G, B and a random generator."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from twin.terrains.objects.coloured_mesh import Mesh, joined, mesh_of
from twin.terrains.objects.primitives import Array, box, mottled, noise, quad_faces, resampled, sphere, tube, turned


def brain_coral(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a brain coral: a flattened ball with meandering ridges, brighter than the grooves between them."""
    ball, faces = sphere()
    bumps = 1 + 0.05 * noise(ball, 1.2, 2, rng)
    meander = np.tanh(2.5 * np.sin(4.0 * noise(ball, 0.55, 2, rng, gain=0.3)))
    points = ball * (bumps + 0.02 * meander)[:, None] * [0.5, 0.5, 0.38]
    colour = albedo * (0.8 + 0.35 * meander)[:, None]
    return mesh_of(points, faces, mottled(colour, points, 0.08, rng))


def branching_coral(albedo: Array, rng: np.random.Generator) -> Mesh:
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


def boulder(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a boulder: a flattened ball with relief at all scales, and algae on its upper side."""
    ball, faces = sphere()
    stretch = rng.uniform([0.75, 0.55, 0.45], [1.0, 0.9, 0.75])
    relief = 1 + 0.13 * noise(ball, 1.6, 6, rng, gain=0.55)
    points = ball * relief[:, None] * stretch / 2
    algae = np.clip(0.5 * noise(points, 0.5, 3, rng) + 1.5 * ball[:, 2] - 0.4, 0, 1)[:, None]
    colour = albedo * (1 - 0.6 * algae) + 0.6 * algae * np.array([0.30, 0.33, 0.20])
    return mesh_of(points, faces, mottled(colour, points, 0.25, rng))


def pipe(albedo: Array, rng: np.random.Generator, width: float = 0.125) -> Mesh:
    wall = 0.08 * width
    outline = resampled(
        np.array([[width / 2, -0.5], [width / 2, 0.5], [width / 2 - wall, 0.5], [width / 2 - wall, -0.5]]), 220
    )
    points, faces = turned(outline, 64)
    points = points[:, [2, 0, 1]]
    return mesh_of(points, faces, mottled(albedo, points, 0.06, rng))


def crate(albedo: Array, rng: np.random.Generator) -> Mesh:
    size = (1.0, 0.7, 0.5)
    points, faces = box(size, (72, 52, 36))
    outward = np.abs(points) >= np.array(size) / 2 - 1e-9
    slat = 0.125
    depth = np.zeros(len(points))
    tone = np.zeros(len(points))
    for axis, along in ((0, 2), (1, 2), (2, 1)):  # slats of the sides are level, those of the lid run along x
        at = points[:, along] / slat + 0.5
        gap = np.abs(at - np.rint(at)) < 0.07
        side = outward[:, axis] & (outward.sum(axis=1) == 1)
        depth = np.where(side & gap, 0.03, depth)
        tone = np.where(side, np.sin(37.0 * np.floor(at) + 11.0 * axis), tone)
    points = points - np.sign(points) * outward * depth[:, None]
    colour = albedo * (1 + 0.2 * tone - 0.7 * (depth > 0))[:, None]
    return mesh_of(points, faces, mottled(colour, points, 0.12, rng))


def tyre(albedo: Array, rng: np.random.Generator) -> Mesh:
    angle = 2 * np.pi * np.arange(72) / 72
    section = np.stack([0.36 + 0.14 * np.cos(angle), 0.11 * np.tanh(1.6 * np.sin(angle)) / np.tanh(1.6)], axis=1)
    points, faces = turned(section, 144)
    around = np.arctan2(points[:, 1], points[:, 0])
    outer = np.hypot(points[:, 0], points[:, 1]) > 0.45
    tread = 0.012 * (np.sin(40 * around + 6 * np.sign(points[:, 2])) > 0) * outer
    points = points * (1 + tread / 0.5)[:, None]
    return mesh_of(points, faces, mottled(albedo, points, 0.3, rng))


def bottle(albedo: Array, rng: np.random.Generator) -> Mesh:
    inner = 0.004
    outline = resampled(
        np.array([
            [inner, 0.0], [0.13, 0.0], [0.14, 0.02], [0.14, 0.6], [0.12, 0.68], [0.05, 0.78], [0.045, 0.96],
            [0.055, 0.965], [0.055, 1.0], [inner, 1.0],
        ]), 150,
    )  # fmt: skip
    points, faces = turned(outline, 64)
    points = points[:, [2, 0, 1]]
    label = ((points[:, 0] > 0.2) & (points[:, 0] < 0.45))[:, None]
    colour = np.where(label, 0.4 * albedo + 0.45, albedo)
    return mesh_of(points, faces, mottled(colour, points, 0.1, rng))


class Shape(NamedTuple):
    build: Callable[..., Mesh]  #: makes a mesh of the shape from its albedo (3,) and a random generator
    albedo: tuple[float, float, float]  #: usual albedo for R, G, B
    variants: int = 4  #: number of different meshes that the objects of one entry of `[[objects]]` share
    sways: bool = False  #: whether the object bends in the current


SHAPES = {
    "boulder": Shape(boulder, (0.38, 0.36, 0.32)),
    "brain_coral": Shape(brain_coral, (0.52, 0.47, 0.24)),
    "branching_coral": Shape(branching_coral, (0.55, 0.42, 0.25)),
    "table_coral": Shape(table_coral, (0.45, 0.36, 0.30)),
    "sponge": Shape(sponge, (0.55, 0.25, 0.30)),
    "sea_star": Shape(sea_star, (0.75, 0.28, 0.12)),
    "pipe": Shape(pipe, (0.80, 0.80, 0.76), 1),
    "crate": Shape(crate, (0.42, 0.30, 0.18), 2),
    "tyre": Shape(tyre, (0.06, 0.06, 0.06), 2),
    "bottle": Shape(bottle, (0.12, 0.30, 0.14), 1),
    "kelp": Shape(kelp, (0.30, 0.28, 0.08), sways=True),
}


def build_shape(name: str, albedo: tuple[float, float, float] | None, rng: np.random.Generator, **form: float) -> Mesh:
    """Returns one mesh of a key of SHAPES; `form` are its proportions, e.g. `width` of a pipe of length 1."""
    shape = SHAPES[name]
    return shape.build(np.array(shape.albedo if albedo is None else albedo), rng, **form)
