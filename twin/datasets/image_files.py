"""Reading of image files (PNG, JPEG, TIFF; 8 or 16 bits; grey, colour or Bayer) as 8-bit RGB."""

import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from twin.core.records import Image
from twin.core.user_files import MOST_IMAGE_BYTES, is_file, read_bytes
from twin.errors import TwinError

Bayer = Literal["RGGB", "GRBG", "GBRG", "BGGR"]
BAYER: tuple[Bayer, ...] = ("RGGB", "GRBG", "GBRG", "BGGR")
_MOST_PIXELS = 2**28
#: Bytes with which a complete file of a format ends (before padding with zeros).
_PARTS = {"PNG": (b"IDAT", b"IEND\xaeB`\x82"), "JPEG": (b"\xff\xda", b"\xff\xd9")}  # pixels, and the end of an image
_N_SAMPLES = 8  # number of images from which the number of used bits is determined


class UnreadableImage(Exception):  # noqa: N818 (the frame is skipped)
    """An image cannot be used; the message is a short reason without the file name, for counts by reason."""


class ImageFormat(NamedTuple):
    """Format of the values of images, for the conversion to 8-bit RGB."""

    bits: int = 8  #: number of bits in use in 16-bit images; 8 for 8-bit images
    #: pattern of raw images: the colours of the first two pixels of the first row, then of the second row; None: no raw
    #: images.
    bayer: Bayer | None = None


class StoredImage(Protocol):
    """Image that is not stored in a separate file, for example a message of a bag."""

    @property
    def name(self) -> str: ...

    def size_px(self) -> tuple[int, int]:
        """Returns (width, height) [px]; raises UnreadableImage if the image is damaged or of an unknown encoding."""
        ...

    def pixels(self, size_px: tuple[int, int]) -> NDArray[Any]:
        """Returns the values of the image, (H, W) or (H, W, channels) in the order BGR(A), uint8 or uint16.

        Raises UnreadableImage if the image is damaged, of an unknown encoding, or (width, height) is not `size_px`.
        """
        ...


#: An image of a data set: a PNG, JPEG or TIFF file, or an image that is stored in another way.
ImageSource = Path | StoredImage


def image_size(image: ImageSource) -> tuple[int, int]:
    """Returns (width, height) of an image [px], from its header; raises UnreadableImage if it cannot be used."""
    width, height = image_header(_contents(image))[:2] if isinstance(image, Path) else image.size_px()
    if width * height > _MOST_PIXELS:
        raise UnreadableImage("too many pixels")
    return width, height


def read_rgb(image: ImageSource, size_px: tuple[int, int], form: ImageFormat) -> Image:
    """Returns an image as 8-bit RGB (H, W, 3), demosaiced only if it has no colours; may raise UnreadableImage."""
    pixels = _pixels(image, size_px)
    if pixels.dtype == np.uint16:
        pixels = np.clip(pixels.astype(np.float32) * (255 / (2**form.bits - 1)) + 0.5, 0, 255).astype(np.uint8)
    if form.bayer is not None and pixels.ndim == 2:
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_Bayer{form.bayer}2RGB")), np.uint8)
    codes = {2: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    return np.asarray(cv2.cvtColor(pixels, codes[2 if pixels.ndim == 2 else pixels.shape[2]]), np.uint8)


def image_format(images: Sequence[ImageSource], size_px: tuple[int, int], bayer: Bayer | None) -> ImageFormat:
    """Returns the format of the images of a data set, from a sample of up to `_N_SAMPLES` of them.

    Cameras with 10, 12 or 14 bits use only the lower bits of 16-bit images. The number of used bits, at least 8, holds
    the largest value of the sample; it is one for both cameras, so that grey levels stay comparable. Images that cannot
    be read are left out. Raises TwinError if a Bayer pattern is given, but an image of the sample has colours already.
    """
    largest = 0
    for k in np.unique(np.linspace(0, len(images) - 1, _N_SAMPLES).astype(int)):
        try:
            pixels = _pixels(images[k], size_px)
        except UnreadableImage:
            continue
        if bayer is not None and pixels.ndim == 3:
            raise TwinError("--bayer", f"{images[k].name} has colours already", "raw images of one band")
        if pixels.dtype == np.uint16:
            largest = max(largest, int(pixels.max()))
    return ImageFormat(max(8, largest.bit_length()), bayer)


def _contents(file: Path) -> bytes:
    if not is_file(file):
        raise UnreadableImage("missing")
    try:
        return read_bytes(file, most_bytes=MOST_IMAGE_BYTES)
    except TwinError as error:
        raise UnreadableImage("too large" if error.problem.startswith("is too large") else "unreadable") from None


def image_header(data: bytes) -> tuple[int, int, str]:
    """Returns width, height [px] and format ("PNG", "JPEG", "TIFF") of an image file; may raise UnreadableImage."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on damaged metadata, which are not used
            image = PillowImage.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF"))
        return image.width, image.height, str(image.format)
    except PillowImage.DecompressionBombError:
        raise UnreadableImage("too many pixels") from None
    except (OSError, ValueError, SyntaxError):
        raise UnreadableImage("no image" if data else "empty file") from None


def _pixels(image: ImageSource, size_px: tuple[int, int]) -> NDArray[Any]:
    pixels = decoded(_contents(image), size_px) if isinstance(image, Path) else image.pixels(size_px)
    if pixels.shape[1::-1] != size_px:
        raise UnreadableImage("another size")
    return pixels


def decoded(data: bytes, size_px: tuple[int, int]) -> NDArray[Any]:
    """Returns the values of a PNG, JPEG or TIFF; raises UnreadableImage unless grey or RGB, 8 or 16 bit, `size_px`."""
    width, height, kind = image_header(data)
    if (width, height) != size_px:
        raise UnreadableImage("another size")
    if width * height > _MOST_PIXELS:
        raise UnreadableImage(f"more than {_MOST_PIXELS} pixels")
    if kind in _PARTS and data.rfind(_PARTS[kind][1]) < data.rfind(_PARTS[kind][0]):  # other data may follow the end
        raise UnreadableImage("truncated")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise UnreadableImage("truncated" if kind == "TIFF" else "damaged")
    if pixels.dtype not in (np.uint8, np.uint16) or (pixels.ndim == 3 and pixels.shape[2] not in (3, 4)):
        raise UnreadableImage("not grey or RGB with 8 or 16 bits")
    return pixels
