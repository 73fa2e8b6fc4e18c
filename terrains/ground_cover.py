"""Materials of generated floors: ramps of colours from dark to bright, and structures that move texels along them."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.threads import in_row_bands
from twin.kernels import kernel
from twin.terrains.noise import cells, fractal_noise, lattice_table, value_noise

GRAINS, STONES, CRACKS, POLYPS, BLADES, BURROWS, SHELLS = range(7)
Colour = tuple[int, int, int]
Part = tuple[int, int, int, int]  #: first row of an image, row after its last, and so its columns


class Cover(NamedTuple):
    dark: Colour  #: albedo as 8-bit RGB at the ends and in the middle of the ramp
    medium: Colour
    bright: Colour
    structure: int  #: one of GRAINS to SHELLS
    size_m: float  #: distance between the elements of the structure
    strength: float  #: change along the ramp where the value of the structure is 1, as a fraction of the ramp
    noise: float  #: change along the ramp as the pink noise increases from 0 to 255, as a fraction of the ramp


SAND = Cover((112, 99, 76), (178, 163, 132), (232, 222, 200), SHELLS, 0.11, 0.45, 1.05)
RUBBLE = Cover((40, 36, 30), (132, 122, 104), (208, 200, 182), STONES, 0.055, 0.75, 0.75)
ROCK = Cover((44, 38, 34), (122, 106, 92), (196, 180, 158), CRACKS, 0.17, 0.6, 1.0)
ALGAE = Cover((30, 38, 24), (94, 98, 64), (164, 162, 116), GRAINS, 0.03, 0.3, 1.0)
CORAL = Cover((92, 58, 48), (168, 118, 90), (236, 204, 172), POLYPS, 0.022, 0.6, 0.8)
SEAGRASS = Cover((22, 34, 18), (66, 86, 46), (142, 154, 98), BLADES, 0.012, 0.8, 0.7)
FRAGMENTS = Cover((58, 50, 40), (164, 148, 120), (236, 226, 206), STONES, 0.03, 0.8, 0.9)
CORALLINE = Cover((46, 34, 32), (140, 106, 98), (222, 184, 174), CRACKS, 0.17, 0.6, 1.0)
MUD = Cover((58, 52, 44), (112, 102, 88), (164, 154, 138), BURROWS, 0.13, 0.7, 1.15)

#: Four materials of each cover, ordered from low and level to high and steep ground.
COVERS = {
    "sand": (SAND, SAND, SAND, SAND),
    "rubble": (SAND, RUBBLE, RUBBLE, RUBBLE),
    "rock": (SAND, ROCK, ROCK, ALGAE),
    "reef": (SAND, RUBBLE, ROCK, CORAL),
    "coral": (SAND, FRAGMENTS, CORALLINE, CORALLINE),
    "seagrass": (SAND, SEAGRASS, SEAGRASS, SEAGRASS),
    "mud": (MUD, MUD, MUD, RUBBLE),
}
DEFAULT_COVERS = {
    "flat": "sand", "ripples": "sand", "fractal": "rock", "reef": "reef", "cliffs": "reef", "file": "reef",
}  # fmt: skip
EDGE_M = 0.12  #: size of the largest lobes of the border between two materials [m]


class Painting:
    """Floor with the four materials of `cover`, a key of COVERS, each part of which is painted when it is asked for.

    Quarters of `material` (rows, cols) belong to one of them each, with transitions; `tone` (rows, cols) is pink noise.
    """

    def __init__(
        self, material: NDArray[np.uint8], tone: NDArray[np.uint8], texel_m: float, cover: str, rng: np.random.Generator
    ):
        covers = COVERS[cover]
        bands = [np.array([c.dark, c.medium, c.bright]).T for c in covers]
        tones = np.linspace(0.0, 1.0, 256)
        ramps = np.array([[np.interp(tones, (0.0, 0.5, 1.0), band) for band in ramp] for ramp in bands], np.float32)
        structure = np.array([c.structure for c in covers], np.int64)
        numbers = np.array([[c.size_m, c.strength, c.noise] for c in covers])
        ramps = np.ascontiguousarray(ramps.swapaxes(1, 2))
        self._colour = np.zeros((*material.shape, 3), np.uint8)  # pages without colours take no RAM
        self._inputs: tuple[Any, ...] = material, tone, texel_m, ramps, structure, numbers, lattice_table(rng)
        self._painted: list[Part] = []

    def within(self, part: Part) -> NDArray[np.uint8]:
        """Returns the colours (rows, cols, 3) uint8, which are painted at least in a part."""
        top, bottom, left, right = part
        if not any(t <= top and bottom <= b and n <= left and right <= r for t, b, n, r in self._painted):
            arguments = *self._inputs, self._colour, left, right
            in_row_bands(lambda first, end: _paint(*arguments, top + first, top + end), bottom - top)
            self._painted.append(part)
            if part == (0, self._colour.shape[0], 0, self._colour.shape[1]):
                self._inputs = ()  # frees material and tone
        return self._colour


@kernel
def _paint(material, tone, texel_m, ramps, structure, numbers, table, colour, left, right, first, end):
    """Fills a part of `colour` (rows, cols, 3); ramps (4, 256, 3), structures (4,) and `numbers` (4, 3) of `Cover`."""
    alike = [bool(np.all(ramps[k] == ramps[k + 1])) for k in range(3)]
    for r in range(first, end):
        for c in range(left, right):
            noise = (tone[r, c] - 128.0) / 256.0
            x, y = c * texel_m, r * texel_m
            level = material[r, c] / 64.0 - 0.5  # 0, 1, 2, 3: nothing but one of the materials
            k = int(min(max(np.floor(level), 0.0), 2.0))
            if not alike[k]:
                level += 0.22 * fractal_noise(x / EDGE_M, y / EDGE_M, 3, table, 9)
                level = min(max(level, float(k)), k + 1.0)
            share = min(max((level - k - 0.35) / 0.3, 0.0), 1.0)
            share = 0.0 if alike[k] else share * share * (3.0 - 2.0 * share)
            lower = 0.5 + numbers[k, 2] * noise
            upper = 0.5 + numbers[k + 1, 2] * noise
            if share < 1.0:
                lower += numbers[k, 1] * _structure(structure[k], x, y, numbers[k, 0], table)
            if share > 0.0:
                upper += numbers[k + 1, 1] * _structure(structure[k + 1], x, y, numbers[k + 1, 0], table)
            one = ramps[k, int(min(max(lower, 0.0), 1.0) * 255.0)]
            two = ramps[k + 1, int(min(max(upper, 0.0), 1.0) * 255.0)]
            for band in range(3):
                colour[r, c, band] = np.uint8((1.0 - share) * one[band] + share * two[band] + 0.5)


@kernel
def _structure(kind, x, y, size, table):
    """Returns the change along the ramp, about -1 to 1, due to a structure at the point (x, y) [m]."""
    if kind == GRAINS:
        return fractal_noise(x / size, y / size, 3, table, 0)
    if kind == BLADES:
        return _blades(x / size, y / size, table)
    if kind == CRACKS:
        ridge = abs(fractal_noise(x / size, y / size, 4, table, 0))
        pits = max(fractal_noise(6.0 * x / size, 6.0 * y / size, 2, table, 3) - 0.35, 0.0)
        crust = fractal_noise(0.4 * x / size, 0.4 * y / size, 3, table, 4)
        return 0.55 * crust - 0.6 * (1.0 - min(ridge / 0.1, 1.0)) - 0.9 * pits
    u, v = x / size, y / size
    if kind in (STONES, POLYPS):  # irregular outlines
        u += 0.3 * fractal_noise(2.0 * x / size, 2.0 * y / size, 1, table, 5)
        v += 0.3 * fractal_noise(2.0 * x / size, 2.0 * y / size, 1, table, 6)
    nearest, second, own = cells(u, v, table, 0)
    if kind == STONES:
        gap = min((second - nearest) / 0.25, 1.0)
        buried = fractal_noise(0.35 * x / size, 0.35 * y / size, 2, table, 7)
        return (
            0.9 * (own - 0.5) + 0.3 * (0.4 - nearest) - 0.8 * (1.0 - gap) ** 2 * min(max(1.0 + 1.5 * buried, 0.3), 1.3)
        )
    if kind == POLYPS:
        colony = cells(u / 12.0, v / 12.0, table, 2)
        edge = 1.0 - min((colony[1] - colony[0]) / 0.08, 1.0)
        return 0.9 * (colony[2] - 0.5) + 0.9 * (0.35 - nearest) - 0.9 * edge
    radius = 0.04 + 0.08 * own * own  # burrows and shells, in units of the distance between them
    if kind == BURROWS:
        return -1.0 * _soft(radius - nearest, 0.03) + 0.35 * _soft(2.4 * radius - nearest, 0.08) if own < 0.7 else 0.0
    return (0.9 if own < 0.3 else -0.5) * _soft(0.5 * radius - nearest, 0.02) if own < 0.5 else 0.0


@kernel
def _blades(x, y, table):
    """Returns the change along the ramp due to crossing blades of seagrass in three layers; x, y in their widths."""
    x += 12.0 * fractal_noise(x / 45.0, y / 45.0, 2, table, 0)
    y += 12.0 * fractal_noise(x / 45.0, y / 45.0, 2, table, 1)
    tone = -1.0
    for layer in range(3):
        angle = 0.4 + (layer - 1) * 0.75
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        stroke = value_noise(along / 14.0 + 0.37 * np.floor(across), across, table, 11 + layer)
        density = 0.25 * fractal_noise(x / 60.0, y / 60.0, 2, table, 21)
        tone = max(tone, 2.0 * (stroke - 0.66 + density) - 0.12 * layer)
    return min(tone, 0.6)


@kernel
def _soft(inside, width):
    return min(max(inside / width + 0.5, 0.0), 1.0)
