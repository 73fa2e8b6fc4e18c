"""Storage of the keyframes' images and disparities on disk."""

import threading
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.checkpoint import check_hash
from twin.core.records import Image
from twin.estimate.vision import matching
from twin.estimate.vision.disparity import DenseMatch

_Grays = tuple[matching.Gray, matching.Gray]  # of the left and the right image
_CACHE_BYTES = 64 * 2**20


def remove_disparities(folder: Path) -> None:
    """Removes the disparities that an `ImageSpool` stored, after the last use of its keyframes."""
    for file in folder.glob("*_disparity.npy"):
        file.unlink(missing_ok=True)


class ImageSpool:
    """Stores stereo pairs as lossless PNG in a folder, created if missing, with a cache of the last grey levels used.

    The images have full size, the grey levels are binned. `gray` may be called by several threads. Methods but `close`
    raise OSError if files could not be read or written.
    """

    def __init__(self, folder: Path, binning: int = 1):
        self.folder, self.binning = folder, binning
        self._hashes: dict[Path, str] = {}  # of the files written so far
        folder.mkdir(parents=True, exist_ok=True)
        self._start()

    def _start(self) -> None:
        self._writer = ThreadPoolExecutor(1)  # compresses in the background
        self._lock = threading.Lock()  # links are measured in other threads
        self._writing: Future[None] | None = None
        self._gray: OrderedDict[int, tuple[NDArray[np.float16], NDArray[np.float16]]] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        if self._writing is not None:
            self._writing.result()  # the next `flush` raises its error again
        return {"folder": self.folder, "binning": self.binning, "_hashes": self._hashes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        for file, expected in self._hashes.items():
            check_hash(file, expected)
        self._start()

    def put(self, row: int, left: Image, right: Image, gray: _Grays, dense: DenseMatch | None = None) -> None:
        """Stores the full stereo pair of a keyframe, which another thread writes; binned grey levels and disparity."""
        self.flush()
        self._writing = self._writer.submit(self._write, row, left, right, dense)
        with self._lock:
            self._cache(row, gray)

    def flush(self) -> None:
        """Waits until the last pair is written."""
        if (writing := self._writing) is not None:
            try:
                writing.result()
            finally:
                if self._writing is writing:  # other threads may have waited, too
                    self._writing = None

    def close(self) -> None:
        """Waits until all pairs are written, ends the thread, frees the cache; an error of the last is not raised."""
        self._writer.shutdown()
        self.free_cache()

    def free_cache(self) -> None:
        with self._lock:
            self._gray.clear()

    def pair(self, row: int) -> tuple[Image, Image]:
        """Returns the left and the right image (H, W, 3) of the keyframe at frame index `row`."""
        return self.left(row), self.right(row)

    def left(self, row: int) -> Image:
        return self._read(row, "left")

    def right(self, row: int) -> Image:
        return self._read(row, "right")

    def disparity(self, row: int) -> DenseMatch:
        self.flush()
        file = self._path(row, "disparity", ".npy")
        try:
            return DenseMatch.unpacked(np.load(file))
        except (ValueError, EOFError) as error:
            raise OSError(f"{file} cannot be read: {error}") from None

    def gray(self, row: int) -> _Grays:
        """Returns the binned grey levels of both images of the keyframe at frame index `row`, in half precision."""
        with self._lock:
            if row not in self._gray:
                left, right = self.pair(row)
                self._cache(row, (matching.gray(left, self.binning), matching.gray(right, self.binning)))
            self._gray.move_to_end(row)
            left, right = self._gray[row]
        return left.astype(np.float32), right.astype(np.float32)

    def _cache(self, row: int, pair: _Grays) -> None:
        self._gray[row] = pair[0].astype(np.float16), pair[1].astype(np.float16)
        while len(self._gray) > 1 and len(self._gray) * pair[0].nbytes > _CACHE_BYTES:
            self._gray.popitem(last=False)

    def _write(self, row: int, left: Image, right: Image, dense: DenseMatch | None) -> None:
        for side, image in (("left", left), ("right", right)):
            data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
            self._write_file(self._path(row, side), data)
        if dense is not None:
            stream = BytesIO()
            np.save(stream, dense.packed())
            self._write_file(self._path(row, "disparity", ".npy"), stream.getvalue())

    def _write_file(self, file: Path, data: bytes) -> None:
        file.write_bytes(data)
        self._hashes[file] = sha256(data).hexdigest()

    def _path(self, row: int, side: str, suffix: str = ".png") -> Path:
        return self.folder / f"{row:06d}_{side}{suffix}"

    def _read(self, row: int, side: str) -> Image:
        self.flush()
        path = self._path(row, side)
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if len(data) else None
        if image is None:
            raise OSError(f"{path} is damaged: it is not a readable PNG")
        return np.asarray(image, np.uint8)
