"""The built-in shapes by name, with their usual albedo."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from twin.terrains.objects import organisms, things
from twin.terrains.objects.coloured_mesh import Mesh


class Shape(NamedTuple):
    """Built-in shape."""

    build: Callable[..., Mesh]  #: makes a mesh of the shape from its albedo (3,) and a random generator
    albedo: tuple[float, float, float]  #: usual albedo for R, G, B
    variants: int = 4  #: number of different meshes that the objects of one entry of `[[objects]]` share
    sways: bool = False  #: whether the object bends in the current


SHAPES = {
    "boulder": Shape(things.boulder, (0.38, 0.36, 0.32)),
    "brain_coral": Shape(organisms.brain_coral, (0.52, 0.47, 0.24)),
    "branching_coral": Shape(organisms.branching_coral, (0.55, 0.42, 0.25)),
    "table_coral": Shape(organisms.table_coral, (0.45, 0.36, 0.30)),
    "sponge": Shape(organisms.sponge, (0.55, 0.25, 0.30)),
    "sea_star": Shape(organisms.sea_star, (0.75, 0.28, 0.12)),
    "pipe": Shape(things.pipe, (0.80, 0.80, 0.76), 1),
    "crate": Shape(things.crate, (0.42, 0.30, 0.18), 2),
    "tyre": Shape(things.tyre, (0.06, 0.06, 0.06), 2),
    "bottle": Shape(things.bottle, (0.12, 0.30, 0.14), 1),
    "kelp": Shape(organisms.kelp, (0.30, 0.28, 0.08), sways=True),
}


def build_shape(name: str, albedo: tuple[float, float, float] | None, rng: np.random.Generator, **form: float) -> Mesh:
    """Returns one mesh of a built-in shape (key of SHAPES) with an albedo; None: the usual one.

    `form` are proportions of the shape, e.g. `width` of a pipe of length 1.
    """
    shape = SHAPES[name]
    return shape.build(np.array(shape.albedo if albedo is None else albedo), rng, **form)
