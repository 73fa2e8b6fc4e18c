"""Recorded data set as readers return it (images, calibration, truth), and the interface of readers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Trajectory
from twin.core.series import nearest_index
from twin.datasets.calibration import StereoCalibration
from twin.datasets.image_files import ImageSource
from twin.datasets.readings import RecordedReadings
from twin.errors import TwinError

#: Largest time between the two images of a stereo pair: as a fraction of the median interval between left images, and
#: absolute [s].
_PAIR_SHARE, _PAIR_MOST_S = 0.25, 0.01
#: latest time, and shortest and longest median interval of the frames of a data set [s]
_LATEST_S, _SHORTEST_S, _LONGEST_S = 1e11, 1e-5, 1e5
_UNIT_QUATERNION = 0.01  # largest deviation of the norm of a quaternion from 1
T = TypeVar("T")


class ImageTime(NamedTuple):
    """Time of an exposure [s], in the clock of the data set, and its image."""

    time_s: float
    file: ImageSource


class StereoImages(NamedTuple):
    """Images of one frame, at the time of the left one in the clock of the data set."""

    time_s: float
    left: ImageSource
    right: ImageSource | None  #: None if no right image belongs to the left one


@dataclass(frozen=True)
class Dataset:
    """A recorded stereo data set.

    A TwinError in place of the calibration, the truth or the readings stands for one that cannot be used; it is raised
    unless the user gives another one, or replays without the readings.
    """

    folder: Path  #: folder or file of the data set; all images lie in it
    images: Sequence[StereoImages]  #: frames in the order of the data set
    calibration: StereoCalibration | TwinError | None
    #: poses of the left camera (before rectification), in the clock of the data set; never given to the estimators.
    truth: Trajectory | TwinError | None = None
    n_right_only: int = 0  #: number of right images that belong to no left image
    notes: tuple[str, ...] = ()  #: sentences on the assumptions that the reader made
    #: (n,) times of all frames, with or without a left image [s]; None: the times of `images`.
    frame_times_s: Array | None = None
    #: (4, 4) pose of the left camera in the body that recorded poses refer to; None if unknown.
    body_from_left: Array | None = None
    readings: RecordedReadings | TwinError | None = None  #: recorded readings of navigation sensors
    true_map: Path | None = None  #: GeoTIFF of the true heights in the frame of the recorded poses


class Reader(Protocol):
    """Reader of one layout of data sets; other packages register readers under the entry points `twin.readers`."""

    name: str  #: short name of the layout, for messages
    layout: str  #: its description in a few words, for messages

    def recognises(self, folder: Path) -> bool:
        """Returns whether a folder, or a file, has this layout."""
        ...

    def read(self, folder: Path) -> Dataset:
        """Returns the data set in a folder or file; images are not decoded.

        An error in the calibration, the truth or the readings is returned in `Dataset`; TwinError is raised if another
        file is missing or damaged.
        """
        ...


def check_times(dataset: Dataset) -> None:
    """Raises TwinError unless times are below 1e11 s, and the median of differing intervals is 1e-5 to 1e5 s."""
    times_s = np.array([frame.time_s for frame in dataset.images], np.float64)
    wrong = np.flatnonzero(~(np.abs(times_s) <= _LATEST_S))
    if len(wrong):
        problem = f"the time of {dataset.images[int(wrong[0])].left.name[:100]} is {times_s[wrong[0]]:g} s"
        raise TwinError(str(dataset.folder), problem, f"seconds, up to {_LATEST_S:g}")
    intervals = np.abs(np.diff(times_s))
    intervals = intervals[intervals > 0]
    if len(intervals) and not _SHORTEST_S <= (interval_s := float(np.median(intervals))) <= _LONGEST_S:
        problem = f"the median interval between its frames is {interval_s:g} s"
        raise TwinError(str(dataset.folder), problem, f"times in seconds, {_SHORTEST_S:g} to {_LONGEST_S:g} s apart")


def value_or_error(read: Callable[[], T]) -> T | TwinError:
    try:
        return read()
    except TwinError as error:
        return error


def are_rotations(quaternions: Array) -> bool:
    """Returns whether quaternions (..., 4) are of unit length, up to rounding; false if one is not finite."""
    return bool((np.abs(np.linalg.norm(quaternions, axis=-1) - 1) < _UNIT_QUATERNION).all())


def trajectory_of(times_s: Array, positions: Array, quaternions_wxyz: Array) -> Trajectory | None:
    """Returns the trajectory of positions (n, 3) and quaternions (n, 4); None without any, or if one is no rotation."""
    if not len(times_s) or not are_rotations(quaternions_wxyz):
        return None
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = geometry.rotation_from_wxyz(quaternions_wxyz), positions
    return Trajectory(times_s, poses)


def pair_by_time(left: Sequence[ImageTime], right: Sequence[ImageTime]) -> tuple[list[StereoImages], int]:
    """Returns the frames of two cameras with a common clock, and the number of right images that belong to no frame.

    There is one frame per left image, in their order. Its right image is the one nearest in time, if the times differ
    by at most 10 ms and by at most a quarter of the median interval between left images; otherwise it has none. Raises
    TwinError if no left image has one.
    """
    if not left or not right:
        return [StereoImages(*one, None) for one in left], len(right)
    left_s, right_s = np.array([one.time_s for one in left]), np.array([one.time_s for one in right])
    order = np.argsort(right_s, kind="stable")
    nearest = order[nearest_index(right_s[order], left_s)]
    intervals = np.abs(np.diff(left_s))
    intervals = intervals[intervals > 0]
    limit_s = min(_PAIR_MOST_S, _PAIR_SHARE * float(np.median(intervals)) if len(intervals) else _PAIR_MOST_S)
    gaps_s = np.abs(right_s[nearest] - left_s)
    paired = gaps_s <= limit_s
    if not paired.any():
        problem = f"those of the two cameras differ by {1000 * np.median(gaps_s):.4g} ms (median)"
        raise TwinError("times of the images", problem, f"stereo pairs with times up to {1000 * limit_s:.4g} ms apart")
    frames = [
        StereoImages(one.time_s, one.file, right[int(k)].file if ok else None)
        for one, k, ok in zip(left, nearest, paired, strict=True)
    ]
    return frames, len(right) - len(set(nearest[paired].tolist()))
