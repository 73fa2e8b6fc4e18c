"""Procedural terrains: flat, sand ripples, fractal ground, coral reef, cliffs."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.errors import TwinError
from twin.terrains.ground_cover import DEFAULT_COVERS
from twin.terrains.noise import fractal_field
from twin.terrains.terrain import Terrain, texture_shape
from twin.terrains.textures import TextureSource, painted_texture
from twin.terrains.walls import walls_of

Heights = NDArray[np.float32]
MAX_SLOPE = float(np.tan(np.deg2rad(60.0)))  #: limit of the slope (rise over run) of a reef, see `_limit_slope`


def generate(
    kind: str, size_m: tuple[float, float], relief_m: float, base_m: float, grid_m: float, texture: TextureSource,
    seed: int | np.random.SeedSequence,
) -> Terrain:  # fmt: skip
    """Returns a terrain of one of KINDS, centred at the origin, with heights from base_m to base_m + relief_m.

    Without relief, the height is base_m everywhere. The arguments are those of `generate_from`. Raises TwinError if the
    kind or the cover is unknown, or the terrain is too large for memory.
    """
    if kind not in KINDS:
        raise TwinError("terrain.kind", f"unknown kind {kind!r}", ", ".join(KINDS))
    heights = KINDS[kind] if relief_m > 0 else _flat

    def scaled(x_m: NDArray[np.float64], y_m: NDArray[np.float64], rng: np.random.Generator) -> Heights:
        return scale_to_relief(heights((len(y_m), len(x_m)), grid_m, relief_m, rng), relief_m, base_m)

    return generate_from(scaled, size_m, grid_m, texture, texture.cover or DEFAULT_COVERS[kind], seed)


def generate_from(
    heights: Callable[[NDArray[np.float64], NDArray[np.float64], np.random.Generator], NDArray[np.floating]],
    size_m: tuple[float, float], grid_m: float, texture: TextureSource, cover: str,
    seed: int | np.random.SeedSequence,
) -> Terrain:  # fmt: skip
    """Returns a terrain centred at the origin, with heights from a function and a generated texture.

    The function returns the heights (ny, nx) [m] at x (nx,) and y (ny,) of the nodes [m], given a random generator. The
    extent along x and y is rounded up to whole cells; `cover` is a key of `ground_cover.COVERS`, and `texture` has the
    side of a texel and the texture of walls, its files are not used. Raises TwinError if the cover is unknown, or the
    terrain is too large for memory.
    """
    nx, ny = (max(1, int(np.ceil(extent / grid_m - 1e-6))) + 1 for extent in size_m)
    shape = texture_shape((ny, nx), grid_m, texture.texel_m(((nx - 1) * grid_m, (ny - 1) * grid_m)))
    shape_rng, texture_rng = np.random.default_rng(seed).spawn(2)
    west_m, south_m = -(nx - 1) * grid_m / 2, -(ny - 1) * grid_m / 2
    columns, rows = np.arange(nx, dtype=np.float64), np.arange(ny, dtype=np.float64)
    height_m = np.asarray(heights(west_m + grid_m * columns, south_m + grid_m * rows, shape_rng), np.float32)
    texel_m = (nx - 1) * grid_m / shape[1]
    texels = painted_texture(cover, height_m, shape, texel_m, texture_rng)
    walls = walls_of(height_m, grid_m, texture, cover, texel_m, texels)
    return Terrain(height_m, grid_m, west_m, south_m, texels, texel_m, walls=walls)


def scale_to_relief(heights: Heights, relief_m: float, base_m: float) -> Heights:
    """Scales heights (ny, nx) linearly to [base_m, base_m + relief_m]; if all are equal, they become base_m."""
    low, extent = float(heights.min()), float(np.ptp(heights))
    fraction = (heights - low) / extent if extent > 0 else np.zeros_like(heights)
    return (base_m + relief_m * fraction.astype(np.float64)).astype(np.float32)


def _flat(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    return np.zeros(shape, np.float32)


def _ripples(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    """Generates asymmetric ripples with meandering crests, about 0.1 wavelength high at most, on broad undulations."""
    length_m = max(0.35, 8 * grid_m)
    crest_m = min(0.1 * length_m, 0.6 * relief_m)
    row, col = np.indices(shape, dtype=np.float32)
    heading = rng.uniform(0, np.pi)
    along_m = (col * np.cos(heading) + row * np.sin(heading)).astype(np.float32) * grid_m
    wander_m = 0.25 * length_m * fractal_field(shape, 5 * length_m / grid_m, 0.35, rng)
    phase = 2 * np.pi * (along_m + wander_m) / length_m
    wave = np.sin(phase + 0.5 * np.sin(phase))
    broad = fractal_field(shape, max(shape) / 2, 0.25, rng)
    return (crest_m / 2 * wave + max(relief_m - crest_m, 0) / 5 * broad).astype(np.float32)


def _fractal(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    """Generates a fractional Brownian surface with Hurst exponent 0.9, typical of many seafloors."""
    return fractal_field(shape, max(max(shape) / 4, 8), 2**-0.9, rng)


def _reef(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    """Generates a reef: rough ground with ledges and coral heads (bommies), and slopes up to about 60 deg."""
    base = 0.14 * relief_m * fractal_field(shape, 4.0 / grid_m, 0.5, rng)
    ledge_m = 0.25 * relief_m
    height = base + 0.6 * ledge_m * _staircase(base / ledge_m)
    height = np.maximum(height, height.mean() + _bommies(shape, grid_m, relief_m, rng))
    height += 0.025 * relief_m * fractal_field(shape, 0.3 / grid_m, 0.6, rng)
    return _limit_slope(height.astype(np.float32), relief_m, grid_m)


def _cliffs(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    """Generates rough terraces in three levels; the walls between them rise within one cell of the grid."""
    level = fractal_field(shape, max(2.0 / grid_m, 8), 0.5, rng)
    terrace = np.searchsorted(np.quantile(level, [1 / 3, 2 / 3]), level)
    rough_m = 0.04 * relief_m * fractal_field(shape, max(0.5 / grid_m, 4), 0.6, rng)
    return (0.4 * relief_m * terrace + rough_m).astype(np.float32)


def _staircase(level: Heights) -> Heights:
    """Returns terraces: levels rounded to the nearest integer, with smooth transitions halfway between integers."""
    step = np.floor(level)
    t = np.clip((level - step - 0.35) / 0.3, 0, 1)
    return (step + t * t * (3 - 2 * t)).astype(np.float32)


def _bommies(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    """Generates domes with steep, lobed flanks, one per 3 square metres (at least three); far from them, -relief_m."""
    result = np.full(shape, -relief_m, np.float32)
    ny, nx = shape
    lobes = fractal_field(shape, 0.5 / grid_m, 0.6, rng)
    for _ in range(max(3, int(nx * ny * grid_m**2 / 3))):
        radius_m = 0.25 + 0.65 * rng.random() ** 2
        top_m = relief_m * rng.uniform(0.35, 0.85) * min(1.0, radius_m / (0.6 * relief_m + 0.1))
        centre = rng.uniform((0, 0), (ny, nx))
        reach = int(2 * radius_m / grid_m) + 2
        r0, c0 = (max(0, int(v) - reach) for v in centre)
        r1, c1 = int(centre[0]) + reach, int(centre[1]) + reach
        patch = result[r0:r1, c0:c1]
        row, col = np.ogrid[r0 : r0 + patch.shape[0], c0 : c0 + patch.shape[1]]
        distance = np.hypot(row - centre[0], col - centre[1]) * grid_m / radius_m
        distance = distance * (1 + 0.12 * lobes[r0:r1, c0:c1])
        dome = top_m * (1 - np.clip(distance, 0, 1.6) ** 4)
        np.maximum(patch, dome, out=patch)
    return result


def _limit_slope(height: Heights, relief_m: float, grid_m: float) -> Heights:
    """Smooths heights, at most 12 times, until the 99.5th percentile of the slope is MAX_SLOPE at the given relief."""
    sigma_px = 0.5
    for _ in range(12):
        north, east = np.gradient(scale_to_relief(height, relief_m, 0.0), grid_m)
        if np.percentile(np.hypot(north, east), 99.5) <= MAX_SLOPE:
            return height
        height = np.asarray(cv2.GaussianBlur(height, (0, 0), sigma_px), np.float32)
        sigma_px *= 1.3
    return height


KINDS = {"flat": _flat, "ripples": _ripples, "fractal": _fractal, "reef": _reef, "cliffs": _cliffs}
