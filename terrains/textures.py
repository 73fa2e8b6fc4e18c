"""Seafloor textures: generated sand, rock and coral, or an image repeated as tiles."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from terrains.file_header import TEXTURE_FIELD, check_texel_count, image_size
from terrains.noise import fractal_field, pink_noise
from twin.errors import TwinError

#: Albedo of each material as 8-bit RGB: dark, medium and bright tone.
SAND = ((104, 92, 70), (176, 161, 130), (236, 226, 204))
DETRITUS = ((62, 52, 38), (122, 107, 82), (190, 176, 148))
ROCK = ((32, 34, 32), (98, 98, 90), (178, 174, 160))
ALGAE = ((30, 40, 24), (92, 98, 66), (166, 164, 118))
CORAL = ((78, 42, 44), (160, 98, 84), (238, 196, 172))

#: Four materials of each kind of floor, ordered from low and flat to high and steep ground.
MATERIALS = {
    "flat": (SAND, SAND, SAND, DETRITUS),
    "ripples": (DETRITUS, SAND, SAND, SAND),
    "fractal": (SAND, DETRITUS, ROCK, ALGAE),
    "reef": (SAND, ALGAE, ROCK, CORAL),
    "cliffs": (SAND, ALGAE, ROCK, CORAL),
    "file": (SAND, ALGAE, ROCK, CORAL),
}
LEVELS = 256 // 4  #: tones per material in the palette


def generate_texture(
    kind: str, height_m: NDArray[np.float32], shape: tuple[int, int], texel_m: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Generates the texture of a height grid.

    The palette has four materials with 64 tones each. Height, slope and noise determine the material of a texel; pink
    noise down to single texels determines its tone.

    Args:
        kind: kind of floor, a key of MATERIALS.
        height_m: (ny, nx) heights, row 0 = south.
        shape: (rows, cols) of the texture.
        texel_m: side of a texel.
        rng: random generator.
    Returns:
        (rows, cols, 3) uint8 RGB, row 0 = north.
    """
    octaves = int(np.clip(np.log2(max(shape)), 3, 11))
    tone = pink_noise(shape, octaves, 20.0, rng)
    material = _material_level(height_m, shape, texel_m, rng)
    index = cv2.addWeighted(material, 1.0, tone, 0.34, -0.34 * 128)
    index = cv2.LUT(index, (np.arange(256) // LEVELS * LEVELS).astype(np.uint8))
    tone = cv2.LUT(tone, (np.arange(256) * LEVELS // 256).astype(np.uint8))
    return _colour(cv2.add(index, tone, dst=index), _palette(MATERIALS[kind]))


def _material_level(
    height_m: NDArray[np.float32], shape: tuple[int, int], texel_m: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Returns the level (rows, cols), 0 to 255, that selects the material of each texel before the tone is added.

    It increases with height and slope, and varies at random in patches of up to 1 m.
    """
    north_up = np.ascontiguousarray(height_m[::-1])
    relief_m = max(float(np.ptp(north_up)), 1e-6)
    spacing_px = shape[1] / (height_m.shape[1] - 1)
    down, right = np.gradient(north_up, spacing_px * texel_m)
    patch_px = 1.0 / (spacing_px * texel_m)  # patches of 1 m and smaller
    patches = fractal_field(height_m.shape, patch_px, 0.6, rng)
    height = (north_up - north_up.min()) / relief_m
    level = 40 + 110 * height + 60 * np.clip(np.hypot(down, right), 0, 1.5) + 26 * patches
    small = np.clip(cv2.GaussianBlur(level, (0, 0), 1.0), 0, 255).astype(np.uint8)
    return np.asarray(cv2.resize(small, shape[::-1], interpolation=cv2.INTER_LINEAR), np.uint8)


def _palette(materials: tuple[tuple[tuple[int, int, int], ...], ...]) -> NDArray[np.uint8]:
    """Returns the palette (256, 3) uint8 RGB: 64 tones of each material, from dark to bright."""
    knots, tones = [0, LEVELS / 2, LEVELS], np.arange(LEVELS) + 0.5
    ramps = [np.stack([np.interp(tones, knots, c) for c in zip(*m, strict=True)], axis=1) for m in materials]
    return np.rint(np.concatenate(ramps)).astype(np.uint8)


def _colour(index: cv2.typing.MatLike, palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns the palette colours (rows, cols, 3) of an index image."""
    return np.asarray(cv2.merge([cv2.LUT(index, np.ascontiguousarray(palette[:, k])) for k in range(3)]), np.uint8)


def read_image(file: Path) -> NDArray[np.uint8]:
    """Reads an image file as (rows, cols, 3) uint8 RGB.

    Raises:
        TwinError: the file does not exist, is not an image, or has more than MAX_TEXELS pixels.
    """
    if not file.is_file():
        raise TwinError(TEXTURE_FIELD, f"no such file {str(file)!r}", "an image file")
    if (size := image_size(file)) is not None:
        check_texel_count(*size, file)
    try:
        image = None if size is None else cv2.imdecode(np.fromfile(file, np.uint8), cv2.IMREAD_COLOR_RGB)
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise TwinError(TEXTURE_FIELD, f"{str(file)!r} is not an image", "PNG, JPEG, TIFF or another image")
    return np.asarray(image, dtype=np.uint8)


def tile_image(
    image: NDArray[np.uint8], image_px_m: float, shape: tuple[int, int], extent_m: tuple[float, float]
) -> NDArray[np.uint8]:
    """Repeats an image as tiles from the north-west corner, with nearest-neighbour sampling; returns the texture.

    Args:
        image: (h, w, 3) image.
        image_px_m: side of an image pixel on the floor.
        shape: (rows, cols) of the result.
        extent_m: extent of the result along x and y.
    Returns:
        (rows, cols, 3) uint8.
    """
    cols = _tiled_index(shape[1], extent_m[0], image_px_m, image.shape[1])
    rows = _tiled_index(shape[0], extent_m[1], image_px_m, image.shape[0])
    return image[rows][:, cols]


def _tiled_index(n: int, extent_m: float, image_px_m: float, period: int) -> NDArray[np.int64]:
    """Returns the image row or column (n,) at each of n texel centres along one axis.

    Args:
        n: number of texels.
        extent_m: extent of the texture.
        image_px_m: side of an image pixel on the floor.
        period: number of rows or columns of the image.
    """
    centres_m = (np.arange(n) + 0.5) * (extent_m / n)
    return np.floor(centres_m / image_px_m).astype(np.int64) % period
