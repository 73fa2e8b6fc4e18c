"""Frames of a data set for the estimators: images read, rectified and checked; unusable images are counted."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import Frame, Image
from twin.datasets.calibration import StereoCalibration
from twin.datasets.dataset import Dataset, StereoImages
from twin.datasets.image_files import Bayer, ImageSource, UnreadableImage, image_format, image_size, read_rgb
from twin.errors import TwinError
from twin.recordings.rectification import Rectification, rectification

_OUT_OF_ORDER = "time out of order"
_N_SIZES = 5  # number of readable images whose sizes are compared
_NOMINAL_HZ = 1.0  # frame rate of a data set without two frames at different times


class RecordedFrames:
    """Rectified frames of a data set, one at a time. A frame that cannot be used is skipped and counted.

    `n_read` is the number of frames of the data set that have been read, usable or not.

    Times are relative to the first frame, at `start_s` in the clock of the data set. Frames out of the order of time
    are skipped (`increasing`). `skipped` counts frames and right images that could not be used, by reason, while they
    are read.

    Raises TwinError if no left image can be read, the calibration does not fit the images or cannot be rectified with
    the field of view, or a Bayer pattern is given for images that have colours.
    """

    def __init__(
        self, dataset: Dataset, calibration: StereoCalibration, bayer: Bayer | None = None, fov_deg: float | None = None
    ):
        self.dataset = dataset
        self.size_px = _usual_size(dataset)
        sized = calibration.for_images(*self.size_px)
        self.rectification: Rectification = rectification(sized, _frame_rate_hz(dataset), fov_deg)
        sources = [*(frame.left for frame in dataset.images), *(f.right for f in dataset.images if f.right is not None)]
        self._format = image_format(sources, self.size_px, bayer)
        self._in_order = increasing(np.array([frame.time_s for frame in dataset.images]))
        self.start_s = dataset.images[int(np.argmax(self._in_order))].time_s
        self.skipped, self.n_read = Counter[str](), 0

    def __len__(self) -> int:
        """Returns the number of frames of the data set, including those that will be skipped."""
        return len(self.dataset.images)

    def __iter__(self) -> Iterator[Frame]:
        """Yields the usable frames, with indices from 0; `right` is None if the right image cannot be used."""
        return self.following(0, 0)

    def following(self, n_read: int, index: int, skipped: Counter[str] | None = None) -> Iterator[Frame]:
        """Yields the usable frames after the first `n_read`, from `index` on; `skipped` counts those before."""
        self.skipped, self.n_read = Counter[str](skipped), n_read
        if skipped is None and self.dataset.n_right_only:
            self.skipped["right image without left image"] = self.dataset.n_right_only
        for images, in_order in zip(self.dataset.images[n_read:], self._in_order[n_read:], strict=True):
            self.n_read += 1
            if not in_order:
                self.skipped[_OUT_OF_ORDER] += 1
                continue
            frame = self._frame(images, index)
            if frame is not None:
                yield frame
                index += 1

    def _frame(self, images: StereoImages, index: int) -> Frame | None:
        left = self._read(images.left, "left")
        if left is None:
            return None
        return Frame(index, images.time_s - self.start_s, left, self._read(images.right, "right"))

    def spread(self, n: int) -> Iterator[Frame]:
        """Yields at most n frames with both images, in the order of time and spread evenly over the data set.

        Images that cannot be used are left out, and counted in `skipped`. The index is the row in the data set.
        """
        both = np.array([images.right is not None for images in self.dataset.images])
        rows = np.flatnonzero(both & self._in_order)
        for row in rows[:: -(-len(rows) // n)]:
            frame = self._frame(self.dataset.images[row], int(row))
            if frame is not None and frame.right is not None:
                yield frame

    @property
    def unused(self) -> int:
        """Returns the number of frames skipped so far; a frame without a usable right image is not skipped."""
        return sum(n for reason, n in self.skipped.items() if reason == _OUT_OF_ORDER or reason.startswith("left"))

    def _read(self, image: ImageSource | None, side: Literal["left", "right"]) -> Image | None:
        """Returns the rectified image (RGB); if it cannot be used, adds the reason to `skipped` and returns None."""
        try:
            if image is None:
                raise UnreadableImage("missing")
            return self.rectification.rectified(read_rgb(image, self.size_px, self._format), side)
        except UnreadableImage as error:
            self.skipped[f"{side} image: {error}"] += 1
            return None

    def first_pair(self) -> Frame:
        """Returns the first frame with both images; raises TwinError if there is none."""
        for frame in self:
            if frame.right is not None:
                return frame
        reasons = "; ".join(f"{reason}: {count}" for reason, count in self.skipped.items())
        raise TwinError(str(self.dataset.folder), f"has no usable stereo pair ({reasons})", "at least one stereo pair")


def increasing(times_s: Array) -> NDArray[np.bool_]:
    """Returns a mask (n,) of a longest increasing subsequence (Schensted 1961): one wrong time excludes one frame."""
    ends: list[float] = []  # for each length, the smallest last time of a sequence
    rows: list[int] = []  # and its row
    before = np.full(len(times_s), -1)
    for k, time_s in enumerate(times_s.tolist()):
        length = bisect_left(ends, time_s)
        if length < len(ends) and ends[length] == time_s:
            continue  # of frames at the same time, the first one is kept
        before[k] = rows[length - 1] if length else -1
        ends[length : length + 1], rows[length : length + 1] = [time_s], [k]
    kept = np.zeros(len(times_s), np.bool_)
    k = rows[-1] if rows else -1
    while k >= 0:
        kept[k], k = True, int(before[k])
    return kept


def _usual_size(dataset: Dataset) -> tuple[int, int]:
    """Returns the most frequent (width, height) of the first `_N_SIZES` readable left images [px]."""
    sizes, problem = Counter[tuple[int, int]](), ""
    for frame in dataset.images:
        try:
            sizes[image_size(frame.left)] += 1
        except UnreadableImage as error:
            problem = problem or f"{frame.left.name}: {error}"
        if sizes.total() == _N_SIZES:
            break
    if not sizes:
        allowed = "grey or RGB images with 8 or 16 bits; files: PNG, JPEG or TIFF"
        raise TwinError(str(dataset.folder), f"has no readable left image ({problem})", allowed)
    return sizes.most_common(1)[0][0]


def _frame_rate_hz(dataset: Dataset) -> float:
    intervals = np.diff([frame.time_s for frame in dataset.images])
    intervals = intervals[intervals > 0]
    return 1 / float(np.median(intervals)) if len(intervals) else _NOMINAL_HZ
