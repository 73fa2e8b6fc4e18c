"""Seafloor textures: generated from materials such as sand, rock and coral, or made from a photo."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image
from twin.errors import TwinError
from twin.terrains.file_header import TEXTURE_FIELD, decoded, eight_bits
from twin.terrains.ground_cover import COVERS, Painting
from twin.terrains.noise import fractal_field, pink_noise
from twin.terrains.quilting import BLOCK_FRACTION, MIN_BLOCK_PX, even_lighting, quilt
from twin.terrains.terrain import PaintedTexture

_PHOTOS = "a PNG, JPEG, TIFF, BMP or WebP image"
COARSEN_TEXELS = 40_000_000  #: largest number of texels of a floor with `TextureSource.coarsen`
_STEEP = 1.5  # slope, rise over run, above which the material no longer depends on it
_QUILT_SEED = 1  #: a texture from a photo is the same for every seed of a survey


@dataclass(frozen=True)
class TextureSource:
    """Source of the texture of a floor."""

    px_m: float  #: side of a texel on the floor, and of a pixel of the photo
    photo_file: str | Path | None = None  #: photo of a piece of floor; None: the texture is generated
    #: "stochastic": pieces of the photo without visible repetition; "repeat": the photo is repeated unchanged
    tiling: Literal["stochastic", "repeat"] = "stochastic"
    orthophoto_file: str | Path | None = None  #: GeoTIFF that replaces the texture wherever it has valid pixels
    cover: str | None = None  #: materials of a generated texture, a key of `COVERS`; None: those of the kind of floor
    coarsen: bool = False  #: whether texels are larger than px_m if there would be more than COARSEN_TEXELS
    #: whether the texture is seen in images; if not, the texels of a floor from a file have the side of its cells
    in_images: bool = True
    walls: bool = False  #: whether steep parts of the floor have a texture of their own, see `Walls`

    def texel_m(self, size_m: tuple[float, float]) -> float:
        least_m = float(np.sqrt(size_m[0] * size_m[1] / COARSEN_TEXELS))
        return max(self.px_m, least_m) if self.coarsen else self.px_m


def painted_texture(
    cover: str, height_m: NDArray[np.float32], shape: tuple[int, int], texel_m: float, rng: np.random.Generator
) -> PaintedTexture:
    """Returns the texture of `begin_texture`, not begun yet; raises TwinError if the cover is unknown."""
    if cover not in COVERS:
        raise TwinError("terrain.cover", f"unknown cover {cover!r}", ", ".join(COVERS))
    return PaintedTexture((*shape, 3), partial(begin_texture, cover, height_m, shape, texel_m, rng), rng)


def begin_texture(
    cover: str, height_m: NDArray[np.float32], shape: tuple[int, int], texel_m: float, rng: np.random.Generator
) -> Painting:
    """Returns a texture (rows, cols, 3) to be painted, row 0 = north, of a height grid (ny, nx), row 0 = south.

    Height, slope and noise, in patches of up to 1 m, determine the material of a texel, one of those of `cover`, a key
    of `COVERS`; its structure and pink noise down to single texels determine the tone.
    """
    tone = _tone(shape, rng)
    north_up = np.ascontiguousarray(height_m[::-1])
    spacing_m = shape[1] / (height_m.shape[1] - 1) * texel_m
    down, right = np.gradient(north_up, spacing_m)
    patches = fractal_field(height_m.shape, 1.0 / spacing_m, 0.6, rng)
    height = (north_up - north_up.min()) / max(float(np.ptp(north_up)), 1e-6)
    return Painting(_material(height, np.hypot(down, right), patches, shape), tone, texel_m, cover, rng)


def begin_wall_texture(
    cover: str, shape: tuple[int, int], extent_m: tuple[float, float], spacing_m: float, floor: PaintedTexture
) -> Painting:
    """Returns a texture (rows, cols, 3) of steep parts; rows run down from the floor's highest to its lowest point."""
    _, rng = floor.begun, floor.rng  # the random numbers after those of the floor
    tone = _tone(shape, rng)
    cols, rows = (max(2, round(extent / spacing_m) + 1) for extent in extent_m)
    patches = fractal_field((rows, cols), 1.0 / spacing_m, 0.6, rng)
    height = np.linspace(1.0, 0.0, rows, dtype=np.float32)[:, None]
    return Painting(_material(height, np.float32(_STEEP), patches, shape), tone, extent_m[0] / shape[1], cover, rng)


def _tone(shape: tuple[int, int], rng: np.random.Generator) -> Image:
    return pink_noise(shape, int(np.clip(np.log2(max(shape)), 3, 11)), 20.0, rng)


def _material(
    height: NDArray[np.float32], slope: NDArray[np.float32] | np.float32, patches: NDArray[np.float32],
    shape: tuple[int, int],
) -> Image:  # fmt: skip
    """Returns the level (rows, cols), 0 to 255, that selects the material of each texel, from values at the nodes."""
    level = 40 + 110 * height + 60 * np.clip(slope, 0, _STEEP) + 26 * patches
    small = np.clip(cv2.GaussianBlur(level, (0, 0), 1.0), 0, 255).astype(np.uint8)
    return np.asarray(cv2.resize(small, shape[::-1], interpolation=cv2.INTER_LINEAR), np.uint8)


def read_image(file: Path) -> Image:
    """Returns an image file as (rows, cols, 3) uint8 RGB; raises TwinError if it is none or too large."""
    image = decoded(file, TEXTURE_FIELD, _PHOTOS, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH)
    if image is not None and image.dtype == np.uint16:
        image = eight_bits(np.asarray(image, np.uint16), int(image.max()))
    if image is None or image.dtype != np.uint8:
        raise TwinError(TEXTURE_FIELD, f"{str(file)!r} is not an image", _PHOTOS)
    return np.asarray(image, dtype=np.uint8)


def texture_from_photo(source: TextureSource, shape: tuple[int, int], extent_m: tuple[float, float]) -> Image:
    """Returns a texture (rows, cols, 3) uint8 RGB made from the photo of `source`, whose features keep their size.

    It is quilted from the evenly lit, resampled photo or, with the tiling "repeat" or a photo with less than
    BLOCK_FRACTION * MIN_BLOCK_PX along a side, made of repeated tiles. Raises TwinError like `read_image`.
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


def _scaled(photo: Image, factor: float) -> Image:
    rows, cols = (max(1, round(n * factor)) for n in photo.shape[:2])
    if (rows, cols) == photo.shape[:2]:
        return photo
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(photo, (cols, rows), interpolation=method), np.uint8)


def tile_image(image: Image, image_px_m: float, shape: tuple[int, int], extent_m: tuple[float, float]) -> Image:
    rows, cols = (
        np.floor((np.arange(n) + 0.5) * (extent / n) / image_px_m).astype(np.int64) % period
        for n, extent, period in zip(shape, extent_m[::-1], image.shape, strict=False)
    )
    return image[rows][:, cols]
