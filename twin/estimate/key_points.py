"""The key points of a survey: what is kept of each in memory, and their images spooled to disk."""

from __future__ import annotations

import threading
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.estimate import matching
from twin.estimate.stereo import StereoPoints
from twin.estimate.velocity_log import Displacement
from twin.geometry import Array
from twin.records import Image, Readings

_CACHE_BYTES = 192 * 2**20


@dataclass
class KeyPoint:
    """One stereo pair of the path.

    Args:
        number: counts the key points from 0.
        row: index of its frame in the trajectories.
        track: number of its track, from 1.
        world_from_camera: (4, 4) best pose so far.
        points: matched points of the pair while it is the newest.
        readings: of the navigation sensors.
        walked: displacement since the node before by the DVL; None without.
        walked_cov: (6, 6) what the motions up to here err by in sum, less what the mosaic told, in the world's axes.
    """

    number: int
    row: int
    track: int
    world_from_camera: Array
    points: StereoPoints | None
    readings: Readings
    walked: Displacement | None = None
    walked_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))


class ImageSpool:
    """Stereo pairs on disk as lossless PNG, the latest normalised ones in memory too.

    Memory stays bounded however long the survey is.

    Args:
        binning: of the normalised ones.
    """

    def __init__(self, folder: Path, binning: int = 1):
        self.folder, self.binning = folder, binning
        folder.mkdir(parents=True, exist_ok=True)
        self._writer = ThreadPoolExecutor(1)  # compression takes the second core
        self._lock = threading.Lock()  # links are measured by other threads
        self._writing: Future[None] | None = None
        self._normalised: OrderedDict[int, tuple[matching.Image, matching.Image]] = OrderedDict()

    def put(self, row: int, left: Image, right: Image, normalised: tuple[matching.Image, matching.Image]) -> None:
        """Stores the pair (height, width, 3) of the key point at this frame.

        Raises:
            OSError: the disk was full for this pair or the one before.
        """
        self.settle()
        self._writing = self._writer.submit(self._write, row, left, right)
        with self._lock:
            self._remember(row, normalised)

    def settle(self) -> None:
        """Waits for what is being written. Raises OSError where that failed."""
        if self._writing is not None:
            writing, self._writing = self._writing, None
            writing.result()

    def pair(self, row: int) -> tuple[Image, Image]:
        """Left and right image as recorded."""
        self.settle()
        return self._read(row, "left"), self._read(row, "right")

    def normalised(self, row: int) -> tuple[matching.Image, matching.Image]:
        """Left and right image, binned and locally normalised."""
        with self._lock:
            if row not in self._normalised:
                left, right = self.pair(row)
                even = [matching.normalise(image, self.binning) for image in (left, right)]
                self._remember(row, (even[0], even[1]))
            self._normalised.move_to_end(row)
            return self._normalised[row]

    def _remember(self, row: int, pair: tuple[matching.Image, matching.Image]) -> None:
        self._normalised[row] = pair
        while len(self._normalised) * 2 * pair[0].nbytes > _CACHE_BYTES:
            self._normalised.popitem(last=False)

    def _write(self, row: int, left: Image, right: Image) -> None:
        for side, image in (("left", left), ("right", right)):
            data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
            self._path(row, side).write_bytes(data.tobytes())

    def _path(self, row: int, side: str) -> Path:
        return self.folder / f"{row:06d}_{side}.png"

    def _read(self, row: int, side: str) -> NDArray[np.uint8]:
        data = np.fromfile(self._path(row, side), np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)
