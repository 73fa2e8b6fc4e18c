"""Procedural floors: flat, sand ripples, fractal ground, coral reef."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from terrains.noise import fractal_field
from terrains.terrain import Terrain, TerrainFault, texture_shape
from terrains.textures import paint

Heights = NDArray[np.float32]
STEEPEST = float(np.tan(np.deg2rad(60.0)))  #: slope that generated floors keep to, but for one cell in 200


def generate(
    kind: str,
    size_m: tuple[float, float],
    relief_m: float,
    base_m: float,
    grid_m: float,
    texture_px_m: float,
    seed: int | np.random.SeedSequence,
) -> Terrain:
    """A floor centred at the origin, its lowest point at base_m and its highest relief_m above (a flat one is flat).

    Args:
        size_m: least extent along x and y; whole cells of grid_m make it up.
    Raises:
        TerrainFault: unknown kind, or a floor too large for memory.
    """
    if kind not in KINDS:
        raise TerrainFault("terrain.kind", f"unknown kind {kind!r}", ", ".join(KINDS))
    nx, ny = (max(1, int(np.ceil(extent / grid_m - 1e-6))) + 1 for extent in size_m)
    shape = texture_shape((ny, nx), grid_m, texture_px_m)
    form, colours = np.random.default_rng(seed).spawn(2)
    form_of = KINDS[kind] if relief_m > 0 else _flat
    height_m = span(form_of((ny, nx), grid_m, relief_m, form), relief_m, base_m)
    texel_m = (nx - 1) * grid_m / shape[1]
    texture = paint(kind, height_m, shape, texel_m, colours)
    return Terrain(height_m, grid_m, -(nx - 1) * grid_m / 2, -(ny - 1) * grid_m / 2, texture, texel_m)


def span(shape_of_floor: Heights, relief_m: float, base_m: float) -> Heights:
    """The same floor, its heights mapped linearly onto [base_m, base_m + relief_m]; a flat one stays flat at base_m."""
    low, extent = float(shape_of_floor.min()), float(np.ptp(shape_of_floor))
    share = (shape_of_floor - low) / extent if extent > 0 else np.zeros_like(shape_of_floor)
    return (base_m + relief_m * share.astype(np.float64)).astype(np.float32)


def _flat(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    return np.zeros(shape, np.float32)


def _ripples(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    """Sand ripples: wandering crests with a gentle and a steep flank, a tenth of their length high, on broad swells."""
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
    """Fractional Brownian ground with Hurst exponent 0.9, which is that of many sea floors."""
    return fractal_field(shape, max(max(shape) / 4, 8), 2**-0.9, rng)


def _reef(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    """A spur-and-groove base under coral heads (bommies), mounds and ledges, roughened, up to about 60 deg steep."""
    base = 0.14 * relief_m * fractal_field(shape, 4.0 / grid_m, 0.5, rng)
    ledge_m = 0.25 * relief_m
    height = base + 0.6 * ledge_m * _staircase(base / ledge_m)
    height = np.maximum(height, height.mean() + _bommies(shape, grid_m, relief_m, rng))
    height += 0.025 * relief_m * fractal_field(shape, 0.3 / grid_m, 0.6, rng)
    return _soften(height.astype(np.float32), relief_m, grid_m)


def _staircase(level: Heights) -> Heights:
    """Whole steps with smooth risers."""
    step = np.floor(level)
    share = np.clip((level - step - 0.35) / 0.3, 0, 1)
    return (step + share * share * (3 - 2 * share)).astype(np.float32)


def _bommies(shape: tuple[int, int], grid_m: float, relief_m: float, rng: np.random.Generator) -> Heights:
    """Domes with steep, lobed flanks, 0.25 to 0.9 m in radius, about one to 3 square metres; -relief_m elsewhere."""
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


def _soften(height: Heights, relief_m: float, grid_m: float) -> Heights:
    """The floor smoothed just as far as its steepest half percent, once spanned to the relief, keeps to 60 deg."""
    sigma_px = 0.5
    for _ in range(12):
        north, east = np.gradient(span(height, relief_m, 0.0), grid_m)
        if np.percentile(np.hypot(north, east), 99.5) <= STEEPEST:
            return height
        height = np.asarray(cv2.GaussianBlur(height, (0, 0), sigma_px), np.float32)
        sigma_px *= 1.3
    return height


KINDS: dict[str, Callable[[tuple[int, int], float, float, np.random.Generator], Heights]] = {
    "flat": _flat,
    "ripples": _ripples,
    "fractal": _fractal,
    "reef": _reef,
}
