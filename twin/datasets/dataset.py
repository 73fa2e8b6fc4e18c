"""Recorded data set as readers return it (images, calibration, truth), and the interface of readers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import Trajectory
from twin.datasets.calibration import StereoCalibration

#: Largest time between the two images of a stereo pair, as a fraction of the median interval between left images [s].
_PAIR_SHARE, _PAIR_MOST_S = 0.25, 0.01


class ImageTime(NamedTuple):
    """An image file and the time of its exposure [s], in the clock of the data set."""

    time_s: float
    file: Path


class StereoImages(NamedTuple):
    """Image files of one frame; `right` is None if no right image belongs to the left one.

    Args:
        time_s: time of the left image [s], in the clock of the data set.
        left, right: image files.
    """

    time_s: float
    left: Path
    right: Path | None


@dataclass(frozen=True)
class Dataset:
    """A recorded stereo data set.

    Args:
        folder: folder of the data set; all images lie in it.
        images: frames in the order of the data set.
        calibration: calibration of the cameras; None if the data set has none.
        truth: recorded poses of the left camera (before rectification), in the clock of the data set; None if the data
            set has none. It is never given to the estimators.
        n_right_only: number of right images without a left image.
        notes: sentences on the assumptions that the reader made.
    """

    folder: Path
    images: Sequence[StereoImages]
    calibration: StereoCalibration | None
    truth: Trajectory | None = None
    n_right_only: int = 0
    notes: tuple[str, ...] = ()


class Reader(Protocol):
    """Reader of one layout of data sets; other packages register their readers as entry points `twin.readers`.

    Attributes:
        name: short name of the layout, for messages.
        layout: description of the layout in a few words, for messages.
    """

    name: str
    layout: str

    name: str
    layout: str

    def recognises(self, folder: Path) -> bool:
        """Returns whether a folder has this layout."""
        ...

    def read(self, folder: Path) -> Dataset:
        """Returns the data set in a folder; image files are not opened.

        Raises:
            TwinError: a file of the data set is missing or damaged.
        """
        ...


def pair_by_time(left: Sequence[ImageTime], right: Sequence[ImageTime]) -> tuple[list[StereoImages], int]:
    """Returns the frames of two cameras with synchronised clocks, and the number of right images without a left image.

    The right image of a frame is the one nearest in time to the left image, if the times differ by at most a quarter of
    the median interval between left images and by at most 10 ms. The order of the left images is kept.
    """
    if not left or not right:
        return [StereoImages(*one, None) for one in left], len(right)
    left_s, right_s = np.array([one.time_s for one in left]), np.array([one.time_s for one in right])
    order = np.argsort(right_s, kind="stable")
    nearest = order[nearest_index(right_s[order], left_s)]
    intervals = np.abs(np.diff(left_s))
    limit_s = min(_PAIR_MOST_S, _PAIR_SHARE * float(np.median(intervals)) if len(intervals) else _PAIR_MOST_S)
    paired = np.abs(right_s[nearest] - left_s) <= limit_s
    frames = [
        StereoImages(one.time_s, one.file, right[int(k)].file if ok else None)
        for one, k, ok in zip(left, nearest, paired, strict=True)
    ]
    return frames, len(right) - len(set(nearest[paired].tolist()))


def nearest_index(sorted_s: Array, times_s: Array) -> NDArray[np.int64]:
    """Returns the index (n,) of the element of the sorted times (m,) that is nearest to each of the times (n,)."""
    after = np.clip(np.searchsorted(sorted_s, times_s), 1, max(len(sorted_s) - 1, 1))
    last = len(sorted_s) - 1
    low, high = np.minimum(after - 1, last), np.minimum(after, last)
    return np.where(np.abs(sorted_s[high] - times_s) < np.abs(sorted_s[low] - times_s), high, low)
