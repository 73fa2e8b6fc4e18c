"""Seafloor textures: generated from materials such as sand, rock and coral, or made from a photo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.user_files import MOST_IMAGE_BYTES, read_bytes, reading
from twin.errors import TwinError
from twin.terrains.file_header import TEXTURE_FIELD, check_texel_count, eight_bits, image_size
from twin.terrains.ground_cover import COVERS, paint
from twin.terrains.noise import fractal_field, pink_noise
from twin.terrains.quilting import BLOCK_FRACTION, MIN_BLOCK_PX, even_lighting, quilt

_PHOTOS = "a PNG, JPEG, TIFF, BMP or WebP image"
COARSEN_TEXELS = 40_000_000  #: largest number of texels of a floor with `TextureSource.coarsen`
_STEEP = 1.5  # slope, rise over run, above which the material no longer depends on it
_QUILT_SEED = 1  #: a texture from a photo is the same for every seed of a survey


@dataclass(frozen=True)
class TextureSource:
    """Source of the texture of a floor.

    Args:
        px_m: side of a texel on the floor, and of a pixel of the photo.
        photo_file: photo of a piece of floor; None: the texture is generated.
        tiling: "stochastic": the texture is made of pieces of the photo without visible repetition, after slow
            variations of its brightness are removed; "repeat": the photo is repeated unchanged.
        orthophoto_file: GeoTIFF that replaces the texture wherever it has valid pixels; None: no orthophoto.
        cover: materials of a generated texture, a key of `ground_cover.COVERS`; None: those of the kind of floor.
        coarsen: whether texels of a large floor are larger than px_m, so that there are not more than COARSEN_TEXELS.
        in_images: whether the texture is seen in images; if not, the texels of a floor from a file have the side of
            the cells of its height grid.
        walls: whether steep parts of the floor have a texture of their own, see `walls.Walls`.
    """

    px_m: float
    photo_file: str | Path | None = None
    tiling: Literal["stochastic", "repeat"] = "stochastic"
    orthophoto_file: str | Path | None = None
    cover: str | None = None
    coarsen: bool = False
    in_images: bool = True
    walls: bool = False

    def texel_m(self, size_m: tuple[float, float]) -> float:
        """Returns the side of the texels of a floor of the given extent along x and y [m]."""
        least_m = float(np.sqrt(size_m[0] * size_m[1] / COARSEN_TEXELS))
        return max(self.px_m, least_m) if self.coarsen else self.px_m


def generate_texture(
    cover: str, height_m: NDArray[np.float32], shape: tuple[int, int], texel_m: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Generates the texture of a height grid.

    Height, slope and noise determine the material of a texel; the structure of the material and pink noise down to
    single texels determine its tone.

    Args:
        cover: a key of `ground_cover.COVERS`.
        height_m: (ny, nx) heights, row 0 = south.
        shape: (rows, cols) of the texture.
    Returns:
        (rows, cols, 3) uint8 RGB, row 0 = north.
    Raises:
        TwinError: the cover is unknown.
    """
    if cover not in COVERS:
        raise TwinError("terrain.cover", f"unknown cover {cover!r}", ", ".join(COVERS))
    tone = _tone(shape, rng)
    material = _material_level(height_m, shape, texel_m, rng)
    return paint(material, tone, texel_m, cover, rng)


def generate_wall_texture(
    cover: str, shape: tuple[int, int], extent_m: tuple[float, float], spacing_m: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Generates the texture of the steep parts of a floor, with the materials that `generate_texture` gives them.

    Args:
        cover: a key of `ground_cover.COVERS`.
        shape: (rows, cols) of the texture; rows run down from the highest to the lowest point of the floor.
        spacing_m: distance between the nodes of the height grid of the floor.
    Returns:
        (rows, cols, 3) uint8 RGB.
    """
    tone = _tone(shape, rng)
    cols, rows = (max(2, round(extent / spacing_m) + 1) for extent in extent_m)
    patches = fractal_field((rows, cols), 1.0 / spacing_m, 0.6, rng)
    height = np.linspace(1.0, 0.0, rows, dtype=np.float32)[:, None]
    material = _resized_level(_level(height, np.float32(_STEEP), patches), shape)
    return paint(material, tone, extent_m[0] / shape[1], cover, rng)


def _tone(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Returns the pink noise (rows, cols) of a generated texture, mean 128."""
    return pink_noise(shape, int(np.clip(np.log2(max(shape)), 3, 11)), 20.0, rng)


def _material_level(
    height_m: NDArray[np.float32], shape: tuple[int, int], texel_m: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Returns the level (rows, cols), 0 to 255, that selects the material of each texel; see `ground_cover.paint`.

    It increases with height and slope, and varies at random in patches of up to 1 m.
    """
    north_up = np.ascontiguousarray(height_m[::-1])
    relief_m = max(float(np.ptp(north_up)), 1e-6)
    spacing_px = shape[1] / (height_m.shape[1] - 1)
    down, right = np.gradient(north_up, spacing_px * texel_m)
    patch_px = 1.0 / (spacing_px * texel_m)  # patches of 1 m and smaller
    patches = fractal_field(height_m.shape, patch_px, 0.6, rng)
    height = (north_up - north_up.min()) / relief_m
    return _resized_level(_level(height, np.hypot(down, right), patches), shape)


def _level(
    height: NDArray[np.float32], slope: NDArray[np.float32] | np.float32, patches: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Returns the level of the material at nodes, not limited to 0 to 255."""
    return 40 + 110 * height + 60 * np.clip(slope, 0, _STEEP) + 26 * patches


def _resized_level(level: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Returns a level at nodes (ny, nx) as the level 0 to 255 of the texels (rows, cols)."""
    small = np.clip(cv2.GaussianBlur(level, (0, 0), 1.0), 0, 255).astype(np.uint8)
    return np.asarray(cv2.resize(small, shape[::-1], interpolation=cv2.INTER_LINEAR), np.uint8)


def read_image(file: Path) -> NDArray[np.uint8]:
    """Reads an image file as (rows, cols, 3) uint8 RGB.

    Raises:
        TwinError: the file does not exist, is not an image, or has more than MAX_TEXELS pixels.
    """
    check_texel_count(*image_size(file, TEXTURE_FIELD, _PHOTOS), file)
    data = read_bytes(file, TEXTURE_FIELD, _PHOTOS, MOST_IMAGE_BYTES)
    with reading(file, TEXTURE_FIELD, _PHOTOS):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH)
    if image is not None and image.dtype == np.uint16:
        image = eight_bits(np.asarray(image, np.uint16), int(image.max()))
    if image is None or image.dtype != np.uint8:
        raise TwinError(TEXTURE_FIELD, f"{str(file)!r} is not an image", _PHOTOS)
    return np.asarray(image, dtype=np.uint8)


def texture_from_photo(
    source: TextureSource, shape: tuple[int, int], extent_m: tuple[float, float]
) -> NDArray[np.uint8]:
    """Returns the texture (rows, cols, 3) uint8 RGB of a floor, made from a photo of a part of it.

    With the tiling "stochastic", slow variations of the brightness are removed, the photo is resampled to the size of
    the texels, and the texture is quilted from pieces of it. With "repeat", or if the shorter side of the photo is
    less than BLOCK_FRACTION * MIN_BLOCK_PX before or after the resampling, the photo is repeated as tiles. Features
    keep the size that they have on the floor.

    Args:
        source: source of the texture, with a photo.
        shape: (rows, cols) of the texture.
        extent_m: extent of the texture along x and y.
    Raises:
        TwinError: the photo is missing, not an image or too large.
    """
    assert source.photo_file is not None
    photo = read_image(Path(source.photo_file))
    if source.tiling == "repeat" or min(photo.shape[:2]) < BLOCK_FRACTION * MIN_BLOCK_PX:
        return tile_image(photo, source.px_m, shape, extent_m)
    texel_m = extent_m[0] / shape[1]
    photo = _scaled(even_lighting(photo), source.px_m / texel_m)
    if min(photo.shape[:2]) < BLOCK_FRACTION * MIN_BLOCK_PX:
        return tile_image(photo, texel_m, shape, extent_m)
    return quilt(photo, shape, np.random.default_rng(_QUILT_SEED))


def _scaled(photo: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    """Returns a photo (h, w, 3) resampled so that its numbers of rows and columns are multiplied by a factor."""
    rows, cols = (max(1, round(n * factor)) for n in photo.shape[:2])
    if (rows, cols) == photo.shape[:2]:
        return photo
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(photo, (cols, rows), interpolation=method), np.uint8)


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
    """Returns the image row or column (n,) at each of n texel centres along one axis."""
    centres_m = (np.arange(n) + 0.5) * (extent_m / n)
    return np.floor(centres_m / image_px_m).astype(np.int64) % period
