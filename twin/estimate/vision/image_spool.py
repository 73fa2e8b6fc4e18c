"""Images of the keyframes, spooled to disk."""

from __future__ import annotations

import threading
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image
from twin.estimate.vision import matching

_CACHE_BYTES = 384 * 2**20


class ImageSpool:
    """Stereo pairs on disk as lossless PNG, the grey levels of the latest in memory too.

    Memory stays bounded however long the survey is.

    Args:
        binning: of the grey levels.
    """

    def __init__(self, folder: Path, binning: int = 1):
        self.folder, self.binning = folder, binning
        folder.mkdir(parents=True, exist_ok=True)
        self._writer = ThreadPoolExecutor(1)  # compression takes the second core
        self._lock = threading.Lock()  # links are measured by other threads
        self._writing: Future[None] | None = None
        self._gray: OrderedDict[int, tuple[NDArray[np.float16], NDArray[np.float16]]] = OrderedDict()

    def put(self, row: int, left: Image, right: Image, gray: tuple[matching.Gray, matching.Gray]) -> None:
        """Stores the pair (height, width, 3) of the keyframe at this frame.

        Raises:
            OSError: the disk was full for this pair or the one before.
        """
        self.settle()
        self._writing = self._writer.submit(self._write, row, left, right)
        with self._lock:
            self._remember(row, gray)

    def settle(self) -> None:
        """Waits for what is being written. Raises OSError where that failed."""
        if self._writing is not None:
            writing, self._writing = self._writing, None
            writing.result()

    def pair(self, row: int) -> tuple[Image, Image]:
        """Left and right image as recorded."""
        self.settle()
        return self._read(row, "left"), self._read(row, "right")

    def gray(self, row: int) -> tuple[matching.Gray, matching.Gray]:
        """Grey levels of the left and right image, binned (`matching.gray`)."""
        with self._lock:
            if row not in self._gray:
                left, right = self.pair(row)
                self._remember(row, (matching.gray(left, self.binning), matching.gray(right, self.binning)))
            self._gray.move_to_end(row)
            left, right = self._gray[row]
        return left.astype(np.float32), right.astype(np.float32)

    def _remember(self, row: int, pair: tuple[matching.Gray, matching.Gray]) -> None:
        self._gray[row] = pair[0].astype(np.float16), pair[1].astype(np.float16)
        while len(self._gray) * pair[0].nbytes > _CACHE_BYTES:
            self._gray.popitem(last=False)

    def _write(self, row: int, left: Image, right: Image) -> None:
        for side, image in (("left", left), ("right", right)):
            data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
            self._path(row, side).write_bytes(data.tobytes())

    def _path(self, row: int, side: str) -> Path:
        return self.folder / f"{row:06d}_{side}.png"

    def _read(self, row: int, side: str) -> NDArray[np.uint8]:
        data = np.fromfile(self._path(row, side), np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)
