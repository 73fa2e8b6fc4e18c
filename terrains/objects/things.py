"""Built-in shapes of inanimate objects: boulder, pipe, crate, tyre and bottle; their largest extent is about 1.

Each function makes a mesh from the albedo (3,) for R, G, B and a random generator.
"""

from __future__ import annotations

import numpy as np

from twin.terrains.objects.coloured_mesh import Mesh, mesh_of
from twin.terrains.objects.primitives import Array, box, mottled, noise, resampled, sphere, turned


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
    """Returns an open pipe of length 1 along x; `width` is its outer diameter."""
    wall = 0.08 * width
    outline = resampled(
        np.array([[width / 2, -0.5], [width / 2, 0.5], [width / 2 - wall, 0.5], [width / 2 - wall, -0.5]]), 220
    )
    points, faces = turned(outline, 64)
    points = points[:, [2, 0, 1]]
    return mesh_of(points, faces, mottled(albedo, points, 0.06, rng))


def crate(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a closed wooden crate whose sides are slats with grooves between them."""
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
    """Returns a tyre that lies flat: a torus with a flattened section and a tread."""
    angle = 2 * np.pi * np.arange(72) / 72
    section = np.stack([0.36 + 0.14 * np.cos(angle), 0.11 * np.tanh(1.6 * np.sin(angle)) / np.tanh(1.6)], axis=1)
    points, faces = turned(section, 144)
    around = np.arctan2(points[:, 1], points[:, 0])
    outer = np.hypot(points[:, 0], points[:, 1]) > 0.45
    tread = 0.012 * (np.sin(40 * around + 6 * np.sign(points[:, 2])) > 0) * outer
    points = points * (1 + tread / 0.5)[:, None]
    return mesh_of(points, faces, mottled(albedo, points, 0.3, rng))


def bottle(albedo: Array, rng: np.random.Generator) -> Mesh:
    """Returns a bottle that lies along x."""
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
